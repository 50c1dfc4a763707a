"""Validation of arguments that are not numbers: functions, strings, flags and progress meters."""

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

# Errors of JAX when a function needs the values of traced arguments, as NumPy's functions do.
_NEED_VALUES = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.NonConcreteBooleanIndexError,
)

# Errors with a cause outside of the function: the device, the memory, guards against NaNs.
_NOT_THE_FUNCTIONS = (RuntimeError, FloatingPointError)


def check_function(name: str, function: Any, *signatures: str, optional: bool = False) -> None:
    """Raise `TypeError` unless `function` accepts the positional arguments of one of the
    signatures.

    Signatures are strings such as "(x, params)". With `optional`, the function may be `None`.
    """
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
    """Return whether `number` positional arguments fit, as far as the signature is known."""
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
    """Return `function` such that its errors are raised with its name."""
    return functools.partial(evaluated, name, function)


def evaluated(name: str, function: Callable, *args: Any) -> Any:
    """Return `function(*args)`, with errors that state the name of the function.

    **Raises:** `TypeError` if the function cannot be traced, or raises `TypeError` itself;
    `ValueError` for its other errors. `RuntimeError`, `FloatingPointError` and errors that already
    state the name pass unchanged.
    """
    try:
        return function(*args)
    except _NEED_VALUES as error:
        raise TypeError(
            f"`{name}` cannot be traced by JAX, because it needs the values of its arguments. "
            "Use `jax.numpy` instead of `numpy`, and `jnp.where` instead of `if`."
        ) from error
    except _NOT_THE_FUNCTIONS:
        raise
    except Exception as error:
        if f"`{name}`" in str(error):
            raise
        kind = TypeError if isinstance(error, TypeError) else ValueError
        raise kind(f"`{name}` raised {type(error).__name__}: {error}") from error


def as_returned(name: str, value: Any, complex_too: bool = False) -> Array:
    """Convert the result of a user function to an array of real numbers, or complex ones if
    allowed.

    Booleans are allowed, too.

    **Raises:** `TypeError` for other results.
    """
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise TypeError(
            f"`{name}` must return real numbers; it returned {shown(value)}."
        ) from error
    if jnp.iscomplexobj(array) and not complex_too:
        raise TypeError(
            f"`{name}` must return real numbers; it returned dtype {array.dtype}. Split a complex "
            "equation into real and imaginary parts."
        )
    if not (jnp.issubdtype(array.dtype, np.number) or array.dtype == bool):
        raise TypeError(f"`{name}` must return real numbers; it returned dtype {array.dtype}.")
    return array


def check_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Raise `ValueError` unless `value` is one of the choices."""
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
    """Raise `TypeError` unless `value` is an instance of `kind`, which the message calls `what`."""
    if not isinstance(value, kind):
        raise TypeError(f"`{name}` must be {what}; got {shown(value)}.")


def as_sequence(name: str, value: Any, what: str) -> tuple:
    """Return the entries of a list, a tuple, a range or an array as a tuple.

    **Raises:** `TypeError` for other types.
    """
    arrays = np.ndarray | jax.Array
    if not isinstance(value, list | tuple | range | arrays) or getattr(value, "ndim", 1) == 0:
        raise TypeError(f"`{name}` must be a sequence of {what}; got {shown(value)}.")
    return tuple(value)


def shown(value: Any) -> str:
    """Return a value's text for error messages: at most 200 characters, or its type if traced."""
    if is_traced(value):
        return f"a traced {type(value).__name__}".replace("Tracer", "value")
    text = f"the class `{value.__name__}`" if isinstance(value, type) else repr(value)
    return text if len(text) <= 200 else f"{text[:200]}..."


# Checks of arguments that all public functions share; the decorator in `entry` applies them.
SHARED = {
    "progress_meter": check_meter,
    "throw": check_flag,
    "for_density": check_flag,
    "normalised": check_flag,
}
