"""Validation of numeric arguments (arrays, keys, counts, step sizes), and stopped derivatives.

Checks need values, so they are skipped for traced arrays.
"""

import datetime
import reprlib
from collections.abc import Sequence
from numbers import Real
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Int, PyTree

from .devices import replicate

# Anything that `jnp.asarray` accepts: an array, a number, a (nested) list of numbers.
Numbers = ArrayLike | Sequence[Any]

# Trials are numbered by 32-bit integers.
_MOST_TRIALS = 2**30

# Longer grids exhaust the memory: each point has coordinates, noise and weights.
_MOST_STEPS = 2**26


def as_array(value: Numbers) -> Array:
    """Convert `value` to an array that is replicated on all devices.

    - A Python number keeps its weak type, so it adopts the precision of the arrays that it meets.
    - Integers outside the range of JAX's integers become floating point numbers; JAX would wrap
      them.
    """
    with jax.transfer_guard("allow"):  # the caller intends this transfer
        return replicate(jnp.asarray(_without_wide_integers(value)))


def _without_wide_integers(value: Numbers) -> Numbers:
    """Return `value`, as a NumPy array of float64 where `jnp.asarray` would misread it.

    Such values contain integers that would wrap, or real numbers stored as Python objects.
    """
    if isinstance(value, jax.Array | float) or is_traced(value):
        return value
    array = np.asarray(value)
    if array.dtype == object and all(_is_real(entry) for entry in array.flat):
        return array.astype(float)
    if array.dtype.kind not in "iu" or array.size == 0:
        return value
    limits = np.iinfo(jax.dtypes.canonicalize_dtype(array.dtype))
    if limits.min <= array.min() and array.max() <= limits.max:
        return value
    return array.astype(float)


def _is_real(entry: Any) -> bool:
    """Return whether the entry is a real number and not a Boolean."""
    return isinstance(entry, Real) and not isinstance(entry, bool)


def drop_weak_type(array: Array) -> Array:
    """Drop the weak type of an array if JAX computes in single precision only.

    Weak and strong types would otherwise each compile a program of their own. In double precision
    the weak type matters, and stays.
    """
    single = array.dtype == jax.dtypes.canonicalize_dtype(np.float64) == np.float32
    return lax.convert_element_type(array, np.float32) if single else array


def as_real(name: str, value: Numbers) -> Array:
    """Convert `value` to an array of floating point numbers or integers.

    A concrete value stays concrete while a program around it is traced, so that it can be checked.

    **Raises:** `TypeError` for other types, and `ValueError` for integers out of range.
    """
    _refuse_dates(name, value)
    try:
        if is_traced(value):
            array = as_array(value)
        else:
            with jax.ensure_compile_time_eval():
                array = as_array(value)
    except OverflowError as error:
        raise ValueError(
            f"`{name}` has integers beyond the range of JAX's integers. Pass floating point "
            "numbers instead."
        ) from error
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"`{name}` must be real numbers in an array; got {reprlib.repr(value)}."
        ) from error
    if not any(jnp.issubdtype(array.dtype, kind) for kind in (jnp.floating, jnp.integer)):
        raise TypeError(
            f"`{name}` must be real numbers; got dtype {array.dtype}. Convert them to floats."
        )
    return array


def _refuse_dates(name: str, value: Any) -> None:
    """Raise `TypeError` for dates and time differences, with the line of code that converts them.

    The unit of time belongs to the model and cannot be guessed.
    """
    entry = value
    if getattr(getattr(value, "dtype", None), "kind", None) == "O":
        entry = np.asarray(value, object).ravel().tolist()
    while isinstance(entry, list | tuple) and entry:
        entry = entry[0]
    kind = getattr(getattr(entry, "dtype", None), "kind", None)
    if kind == "m" or isinstance(entry, datetime.timedelta):
        raise TypeError(
            f"`{name}` must be real numbers, in the model's unit of time; got time differences. "
            "Convert them to numbers, for example to days: "
            f"`np.asarray({name}, 'timedelta64[us]') / np.timedelta64(1, 'D')`."
        )
    if kind == "M" or isinstance(entry, datetime.date):
        raise TypeError(
            f"`{name}` must be real numbers, in the model's unit of time; got dates. Convert them "
            "to numbers, for example to days since a date of your choice: "
            f"`(np.asarray({name}, 'datetime64[us]') - np.datetime64('2000-01-01')) / "
            "np.timedelta64(1, 'D')`."
        )


def missing_as_nan(values: Numbers) -> Numbers:
    """Replace `None` and the `NA` of pandas by NaN in observations; return all others unchanged."""
    leaves = jax.tree.leaves(values, is_leaf=lambda leaf: leaf is None)
    if any(isinstance(leaf, jax.Array) or _has_plain_type(leaf) for leaf in leaves):
        return values
    try:
        entries = np.asarray(values, object)
    except (TypeError, ValueError):  # not rectangular: `as_real` reports it later
        return values
    missing = np.array(
        # By name: pandas is not a dependency.
        [entry is None or type(entry).__name__ == "NAType" for entry in entries.flat]
    )
    if not missing.any():
        return values
    filled = entries.copy()
    filled[missing.reshape(entries.shape)] = np.nan
    return filled


def _has_plain_type(values: Any) -> bool:
    """Return whether the values are an array of a NumPy dtype.

    In such an array, only NaN can mark a missing value.
    """
    return isinstance(values, np.ndarray) and values.dtype != object


def as_floating(name: str, value: Numbers) -> Array:
    """Convert `value` to floating point numbers; integers get JAX's default float dtype."""
    array = as_real(name, value)
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    with jax.ensure_compile_time_eval():
        return array.astype(float)


def is_traced(*trees) -> bool:
    """Return whether any leaf of the trees is traced, so that its value cannot be inspected."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def index_without_compiling(values: Array, index: Any) -> Array:
    """Return `values[index]`, computed by NumPy if both are concrete.

    This avoids compiling a program for each shape. Arrays that were committed to a device stay
    there.
    """
    if is_traced(values, index) or getattr(values, "committed", False):
        return values[index]
    return jnp.asarray(np.asarray(values)[index])


def cast_floats(tree: PyTree, dtype) -> PyTree:
    """Convert all floating point arrays of the tree to `dtype`."""
    return jax.tree.map(
        lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, tree
    )


def as_numbers(values: dict[str, Numbers]) -> dict[str, Array]:
    """Convert each value to a floating point scalar of shape ().

    **Raises:** `ValueError` for arrays of other shapes.
    """
    numbers = {name: as_floating(name, value) for name, value in values.items()}
    for name, value in numbers.items():
        if value.shape != ():
            raise ValueError(f"`{name}` must be a number, shape (); got shape {value.shape}.")
    return numbers


def check_range(
    name: str, value: Array, *, positive: bool = False, nonnegative: bool = False
) -> None:
    """Raise `ValueError` if an entry is not finite or has the wrong sign.

    `positive` requires entries above zero, `nonnegative` requires entries of zero or more. Traced
    values are not checked.
    """
    if is_traced(value):
        return
    entries = np.asarray(value)
    valid = np.isfinite(entries)
    valid = valid & (entries > 0) if positive else valid
    valid = valid & (entries >= 0) if nonnegative else valid
    if not np.all(valid):
        requirement = "positive" if positive else "zero or more" if nonnegative else "finite"
        raise ValueError(f"`{name}` must be {requirement}; got {entries}.")


def check_precision(names: str, dtype: jnp.dtype) -> None:
    """Raise `TypeError` if the named arrays have less than single precision."""
    if dtype.itemsize < 4:
        raise TypeError(
            f"{names} must be float32 or float64; got {dtype}, which is too coarse for short steps "
            "of a path."
        )


def is_positive_definite(matrix: np.ndarray) -> bool:
    """Return whether a matrix is finite, symmetric and positive definite, in any units."""
    diagonal = np.diagonal(matrix)
    if not np.all(np.isfinite(matrix)) or np.any(diagonal <= 0):
        return False
    scale = np.sqrt(diagonal)
    correlation = matrix / scale[:, None] / scale
    is_symmetric = np.allclose(correlation, correlation.T, atol=1e-5)
    return bool(is_symmetric and np.linalg.eigvalsh(correlation)[0] > 0)


def all_finite_leaves(tree: PyTree) -> Bool[Array, ""]:
    """Return whether all floating point numbers in the tree are finite."""
    # Integers and static parts are always finite.
    leaves = [leaf for leaf in jax.tree.leaves(tree) if eqx.is_inexact_array(leaf)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves] or [True]))


def without_derivatives(tree: PyTree) -> PyTree:
    """Return the tree with all derivatives stopped."""
    return jax.tree.map(
        lambda leaf: lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf, tree
    )


@eqx.filter_custom_jvp
def nondifferentiable(tree: PyTree) -> PyTree:
    """Return the tree; raise `TypeError` if a derivative of it is taken."""
    return tree


@nondifferentiable.def_jvp
def _refuse(primals, tangents):
    """Raise the error for derivatives of simulations whose course depends on the parameters."""
    raise TypeError(
        "These results have no derivative path by path: whether a pair meets, how often a bridge "
        "is hit, or which path is continued also depends on the parameters. Apply "
        "`jax.lax.stop_gradient` to the parameters when you sample, and differentiate a likelihood "
        "of the paths."
    )


@eqx.filter_custom_jvp
def nondifferentiable_choice(tree: PyTree) -> PyTree:
    """Return the tree; raise `TypeError` if a derivative is taken, since it may hold a coupling."""
    return tree


@nondifferentiable_choice.def_jvp
def _refuse_choice(primals, tangents):
    """Raise the error for derivatives of a choice of proposals."""
    raise TypeError(
        "This choice may select couplings, which have no derivative path by path: whether a pair "
        "meets also depends on the parameters. Choose a guided proposal first, outside of `grad`: "
        "`choice = choose_proposal(..., candidates=[ModifiedDiffusionBridge(), Guided()])`. "
        "Then pass `proposal=choice`, which is differentiable."
    )


def count_steps(durations: Array, num_steps: int | None, step_size: float) -> Int[np.ndarray, " I"]:
    """Return the number of steps of each interval, such that no step is longer than `step_size`.

    A step may be longer by a factor of 1 + 1e-4, so that rounded durations do not add a step.

    **Raises:** `ValueError` if `num_steps` is given too, if durations are traced, if `step_size` is
    not a positive number, or if all intervals together need more than 2²⁶ steps.
    """
    if num_steps is not None:
        raise ValueError("Pass `num_steps` or `step_size`, not both.")
    if is_traced(durations):
        raise ValueError(
            "`step_size` needs concrete `times`; got traced ones. Pass `num_steps` instead."
        )
    if is_traced(step_size) or as_floating("step_size", step_size).shape != ():
        raise ValueError(f"`step_size` must be a concrete number; got {step_size!r}.")
    step_size = float(step_size)
    if not step_size > 0:
        raise ValueError(f"`step_size` must be a positive number; got {step_size!r}.")
    counts = np.ceil(np.asarray(durations, float) / step_size * (1 - 1e-4)).clip(1)
    if not np.sum(counts) <= _MOST_STEPS:  # refuses NaN, too
        smallest = 1.01 * np.sum(np.asarray(durations, float)) / _MOST_STEPS
        raise ValueError(
            f"`step_size` = {step_size:g} needs {np.sum(counts):.3g} steps in all; the limit is "
            f"2²⁶ = {_MOST_STEPS:,} steps. Pass a `step_size` of {smallest:.2g} or more."
        )
    return counts.astype(int)


def check_num_steps(value, num_intervals: int) -> int:
    """Return `num_steps`, the number of steps of each interval.

    **Raises:** `TypeError` if it is not an integer; `ValueError` if it is below 1, or if all
    intervals together have more than 2²⁶ steps.
    """
    num_steps = check_count("num_steps", value)
    if num_steps * num_intervals > _MOST_STEPS:
        raise ValueError(
            f"`num_steps` = {num_steps:,} for {num_intervals:,} intervals exceed the limit of "
            f"2²⁶ = {_MOST_STEPS:,} steps in all. Pass fewer steps."
        )
    return num_steps


def check_key(key) -> None:
    """Raise an error unless `key` is one typed key.

    **Raises:** `TypeError` for other types; `ValueError` for an array of keys.
    """
    if not (isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
        raise TypeError(f"`key` must be a typed key, `jax.random.key(seed)`; got {key!r}.")
    if key.shape != ():
        raise ValueError(
            f"`key` must be a single key; got an array of keys of shape {key.shape}. Pass one of "
            "them, such as `key[0]`."
        )


def check_count(name: str, value, minimum: int = 1, maximum: int = 2**31 - 1) -> int:
    """Return `value` as an integer between `minimum` and `maximum`.

    **Raises:** `TypeError` if it is not an integer; `ValueError` if it is out of the range.
    """
    # `bool` is a subclass of `int`.
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"`{name}` must be a static Python integer; got {value!r}.")
    if value < minimum:
        raise ValueError(f"`{name}` must be at least {minimum}; got {value}.")
    if value > maximum:
        raise ValueError(f"`{name}` must be at most {maximum}; got {value}.")
    return int(value)


def check_bound(name: str, value: Numbers | None, default: int) -> Int[Array, ""]:
    """Return an upper bound on the number of trials as an int32 array, by default `default`.

    The bound is an array, so a new value does not compile the program again.

    **Raises:** as `check_count`, and `ValueError` for more than 2³⁰ trials.
    """
    if value is None:
        value = min(default, _MOST_TRIALS)
    elif not is_traced(value):
        value = check_count(name, value)
        if value > _MOST_TRIALS:
            raise ValueError(f"`{name}` must be at most 2³⁰; got {value}.")
    return jnp.asarray(value, jnp.int32)
