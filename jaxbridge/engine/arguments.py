"""Arguments that are no numbers: functions of the user, words, flags and progress meters."""

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .checks import is_traced

# What JAX raises where a function needs the values of what is traced, as NumPy's functions do.
_NEED_VALUES = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.NonConcreteBooleanIndexError,
)

# What has a cause outside of the function: the device, the memory, guards against NaNs.
_NOT_THE_FUNCTIONS = (RuntimeError, FloatingPointError)


def check_function(name: str, function: Any, *signatures: str, optional: bool = False) -> None:
    """Raise `TypeError` unless `function` can be called with the positional arguments of one of the
    signatures, such as "(x, params)", or is `None` where it is optional."""
    if optional and function is None:
        return
    wanted = " or ".join(f"`{signature}`" for signature in signatures)
    if not callable(function) or isinstance(function, type):
        raise TypeError(f"`{name}` must be a function {wanted}; got {shown(function)}.")
    if not any(_takes(function, len(signature.split(","))) for signature in signatures):
        raise TypeError(
            f"`{name}` must be a function {wanted}; got one with the arguments "
            f"{inspect.signature(function)}."
        )


def _takes(function: Callable, number: int) -> bool:
    """Return whether so many positional arguments fit, as far as the function shows it."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return True
    try:
        signature.bind(*[None] * number)
    except TypeError:
        return False
    return True


def named(name: str, function: Callable) -> Callable:
    """Return `function`, whose errors are raised with its name."""
    return functools.partial(evaluated, name, function)


def evaluated(name: str, function: Callable, *args: Any) -> Any:
    """Return `function(*args)`.

    **Raises:** `TypeError` where the function cannot be traced. The function's own errors are
    raised again with its name, a `TypeError` as such, all others as `ValueError`.
    """
    try:
        return function(*args)
    except _NEED_VALUES as error:
        raise TypeError(
            f"`{name}` cannot be traced by JAX, for it needs the values of its arguments: "
            "write it with `jax.numpy` in the place of `numpy`, and `jnp.where` in the place "
            "of `if`."
        ) from error
    except _NOT_THE_FUNCTIONS:
        raise
    except Exception as error:
        if f"`{name}`" in str(error):
            raise
        kind = TypeError if isinstance(error, TypeError) else ValueError
        raise kind(f"`{name}` raised {type(error).__name__}: {error}") from error


def as_returned(name: str, value: Any, complex_too: bool = False) -> Array:
    """Return what a function of the user returned as an array of real numbers, or of complex ones.

    **Raises:** `TypeError` for anything else.
    """
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise TypeError(
            f"`{name}` must return real numbers; it returned {shown(value)}."
        ) from error
    if jnp.iscomplexobj(array) and not complex_too:
        raise TypeError(
            f"`{name}` must return real numbers; it returned dtype {array.dtype}: write a complex "
            "equation in its real and imaginary parts."
        )
    if not (jnp.issubdtype(array.dtype, np.number) or array.dtype == bool):
        raise TypeError(f"`{name}` must return real numbers; it returned dtype {array.dtype}.")
    return array


def check_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Raise `ValueError` unless `value` is one of the words."""
    if not (isinstance(value, str) and value in choices):
        *others, last = (f'"{choice}"' for choice in choices)
        raise ValueError(f"`{name}` must be {', '.join(others)} or {last}; got {shown(value)}.")


def check_flag(name: str, value: Any) -> None:
    """Raise `TypeError` unless `value` is `True` or `False`."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"`{name}` must be `True` or `False`; got {shown(value)}.")


def check_meter(name: str, value: Any) -> None:
    """Raise `TypeError` unless `value` is `None` or a progress meter."""
    if not (value is None or isinstance(value, diffrax.AbstractProgressMeter)):
        raise TypeError(
            f"`{name}` must be `None` or a progress meter of diffrax, such as "
            f"`diffrax.TextProgressMeter()`; got {shown(value)}."
        )


def check_instance(name: str, value: Any, kind: type, what: str) -> None:
    """Raise `TypeError` unless `value` is of this kind, which the message calls `what`."""
    if not isinstance(value, kind):
        raise TypeError(f"`{name}` must be {what}; got {shown(value)}.")


def as_sequence(name: str, value: Any, what: str) -> tuple:
    """Return the values of a list, a tuple or an array.

    **Raises:** `TypeError` for anything else.
    """
    arrays = np.ndarray | jax.Array
    if not isinstance(value, list | tuple | range | arrays) or getattr(value, "ndim", 1) == 0:
        raise TypeError(f"`{name}` must be a sequence of {what}; got {shown(value)}.")
    return tuple(value)


def shown(value: Any) -> str:
    """Return a value in at most 200 characters, and of what is traced its type."""
    if is_traced(value):
        return f"a traced {type(value).__name__}".replace("Tracer", "value")
    text = f"the class `{value.__name__}`" if isinstance(value, type) else repr(value)
    return text if len(text) <= 200 else f"{text[:200]}..."


# Arguments that mean the same in all public functions, and are checked where these are entered.
SHARED = {
    "progress_meter": check_meter,
    "throw": check_flag,
    "for_density": check_flag,
    "normalised": check_flag,
}
