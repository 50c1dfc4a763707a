"""What is given: numbers, which become arrays, keys and counts; and what has no derivative."""

import datetime
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

from .devices import whole

# Anything `jnp.asarray` takes: an array, a number, a (nested) list of numbers.
Numbers = ArrayLike | Sequence[Any]

# Trials are numbered in 32 bits.
_MOST_TRIALS = 2**30

# Grids of more points, each with coordinates, noise and weights, exhaust the memory.
_MOST_STEPS = 2**26


def as_array(value: Numbers) -> Array:
    """`value` as an array, whole on every device; a number of Python's keeps its weak type, which
    follows the precision of what it meets. Integers that JAX's integers cannot hold, which would
    wrap, become floating point numbers."""
    with jax.transfer_guard("allow"):  # what is given is meant to be handed over
        return whole(jnp.asarray(_without_wide_integers(value)))


def _without_wide_integers(value: Numbers) -> Numbers:
    """Return `value`, as a NumPy array of double precision if it has integers that would wrap, or
    real numbers as objects of Python."""
    if isinstance(value, jax.Array | float) or is_traced(value):
        return value
    known = np.asarray(value)
    if known.dtype == object and all(_is_real(entry) for entry in known.flat):
        return known.astype(float)
    if known.dtype.kind not in "iu" or known.size == 0:
        return value
    fits = np.iinfo(jax.dtypes.canonicalize_dtype(known.dtype))
    if fits.min <= known.min() and known.max() <= fits.max:
        return value
    return known.astype(float)


def _is_real(entry: Any) -> bool:
    return isinstance(entry, Real) and not isinstance(entry, bool)


def settled(array: Array) -> Array:
    """The array without a weak type where all is of single precision, so that there is nothing to
    follow: programs would be compiled once for numbers of Python's and once more for others."""
    single = array.dtype == jax.dtypes.canonicalize_dtype(np.float64) == np.float32
    return lax.convert_element_type(array, np.float32) if single else array


def as_real(name: str, value: Numbers) -> Array:
    """`value` as an array, which must be of floating point or whole numbers.

    A value that is known stays known while a program around it is traced, so it can be checked.
    Raises `TypeError`, naming the argument, for anything else.
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
            f"`{name}` has integers beyond the range of JAX's; pass floating point numbers."
        ) from error
    except (TypeError, ValueError) as error:
        raise TypeError(f"`{name}` must be real numbers in an array; got {value!r}.") from error
    if not any(jnp.issubdtype(array.dtype, kind) for kind in (jnp.floating, jnp.integer)):
        raise TypeError(f"`{name}` must be real numbers; got dtype {array.dtype}.")
    return array


def _refuse_dates(name: str, value: Any) -> None:
    """Raise `TypeError` for dates and for differences of dates, with the line that converts them: a
    model has a unit of time of its own, which is not guessed."""
    first = value
    if getattr(getattr(value, "dtype", None), "kind", None) == "O":
        first = np.asarray(value, object).ravel().tolist()
    while isinstance(first, list | tuple) and first:
        first = first[0]
    kind = getattr(getattr(first, "dtype", None), "kind", None)
    if kind == "m" or isinstance(first, datetime.timedelta):
        raise TypeError(
            f"`{name}` must be real numbers, in the model's unit of time; got differences of "
            "dates. Convert them to numbers, for instance of days: "
            f"`np.asarray({name}, 'timedelta64[us]') / np.timedelta64(1, 'D')`."
        )
    if kind == "M" or isinstance(first, datetime.date):
        raise TypeError(
            f"`{name}` must be real numbers, in the model's unit of time; got dates. Convert them "
            "to numbers, for instance of days since a date of your choice: "
            f"`(np.asarray({name}, 'datetime64[us]') - np.datetime64('2000-01-01')) / "
            "np.timedelta64(1, 'D')`."
        )


def missing_as_nan(values: Numbers) -> Numbers:
    """Return observations in which `None` and the `NA` of pandas are NaN; all else as it is."""
    leaves = jax.tree.leaves(values, is_leaf=lambda leaf: leaf is None)
    if any(isinstance(leaf, jax.Array) or _has_plain_type(leaf) for leaf in leaves):
        return values
    try:
        entries = np.asarray(values, object)
    except (TypeError, ValueError):  # of no rectangular shape
        return values
    missing = np.array(
        [entry is None or type(entry).__name__ == "NAType" for entry in entries.flat]
    )
    if not missing.any():
        return values
    filled = entries.copy()
    filled[missing.reshape(entries.shape)] = np.nan
    return filled


def _has_plain_type(values: Any) -> bool:
    """Whether these are arrays of NumPy's own types, in which nothing can be missing but NaN."""
    return isinstance(values, np.ndarray) and values.dtype != object


def as_floating(name: str, value: Numbers) -> Array:
    """`value` as an array of floating point numbers, whole numbers in JAX's default type."""
    array = as_real(name, value)
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    with jax.ensure_compile_time_eval():
        return array.astype(float)


def is_traced(*trees) -> bool:
    """Whether any value in the trees is abstract, so that it cannot be looked at."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def taken(values: Array, index: Any) -> Array:
    """`values[index]`: of numbers that are known without compiling a program for it, unless they
    were put on a device."""
    if is_traced(values, index) or getattr(values, "committed", False):
        return values[index]
    return jnp.asarray(np.asarray(values)[index])


def cast_floats(tree: PyTree, dtype) -> PyTree:
    """The tree with all its floating point arrays in one precision."""
    return jax.tree.map(
        lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, tree
    )


def as_numbers(values: dict[str, Numbers]) -> dict[str, Array]:
    """Numbers, shape (), by their names.

    **Raises:** `ValueError` for arrays.
    """
    numbers = {name: as_floating(name, value) for name, value in values.items()}
    for name, value in numbers.items():
        if value.shape != ():
            raise ValueError(f"`{name}` must be a number, shape (); got shape {value.shape}.")
    return numbers


def check_range(
    name: str, value: Array, *, positive: bool = False, nonnegative: bool = False
) -> None:
    """Raise `ValueError` where a visible entry is not finite, or not as large as it must be."""
    if is_traced(value):
        return
    entries = np.asarray(value)
    ok = np.isfinite(entries)
    ok = ok & (entries > 0) if positive else ok
    ok = ok & (entries >= 0) if nonnegative else ok
    if not np.all(ok):
        wanted = "positive" if positive else "zero or more" if nonnegative else "finite"
        raise ValueError(f"`{name}` must be {wanted}; got {entries}.")


def check_precision(names: str, dtype: jnp.dtype) -> None:
    """Raise `TypeError` where arrays of these names are of less than single precision."""
    if dtype.itemsize < 4:
        raise TypeError(
            f"{names} must be float32 or float64; got {dtype}, in which short steps of a path are "
            "lost."
        )


def all_finite_leaves(tree: PyTree) -> Bool[Array, ""]:
    """Whether all numbers in the tree are finite."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if eqx.is_inexact_array(leaf)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves] or [True]))


def without_derivatives(tree: PyTree) -> PyTree:
    """The tree as numbers, of which nothing is a function."""
    return jax.tree.map(
        lambda leaf: lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf, tree
    )


@eqx.filter_custom_jvp
def nondifferentiable(tree: PyTree) -> PyTree:
    """The tree, of which no derivative may be taken."""
    return tree


@nondifferentiable.def_jvp
def _refuse(primals, tangents):
    raise TypeError(
        "what corrects bridges to their exact law has no derivative path by path: whether a pair "
        "meets, and how often a bridge is hit, depends on the numbers of the model and of the "
        "coupling too. Apply `jax.lax.stop_gradient` to them where bridges are made, and "
        "differentiate a likelihood of their paths."
    )


@eqx.filter_custom_jvp
def nondifferentiable_choice(tree: PyTree) -> PyTree:
    """The tree, of which no derivative may be taken because of a choice that may be a coupling."""
    return tree


@nondifferentiable_choice.def_jvp
def _refuse_choice(primals, tangents):
    raise TypeError(
        "this choice may take couplings, which have no derivative path by path, for whether a pair "
        "meets depends on the parameters too. Choose before, outside of `grad`, between proposals "
        "that are pulled to the end point, `choice = choose_proposal(..., candidates="
        "[ModifiedDiffusionBridge(), Guided()])`, and pass `proposal=choice`: it is differentiable."
    )


def steps_of_size(
    durations: Array, num_steps: int | None, step_size: float
) -> Int[np.ndarray, " I"]:
    """How many steps each interval calls for, so that none is longer than about `step_size`.

    **Raises:** `ValueError` where `num_steps` is given too, durations are traced, or no size."""
    if num_steps is not None:
        raise ValueError("pass `num_steps` or `step_size`, not both.")
    if is_traced(durations):
        raise ValueError(
            "`step_size` divides intervals of known length; while `times` are traced pass "
            "`num_steps`."
        )
    if isinstance(step_size, bool) or not isinstance(step_size, int | float) or not step_size > 0:
        raise ValueError(f"`step_size` must be a positive number; got {step_size!r}.")
    wanted = np.ceil(np.asarray(durations, float) / step_size * (1 - 1e-4)).clip(1)
    if not np.sum(wanted) <= _MOST_STEPS:
        least = 1.01 * np.sum(np.asarray(durations, float)) / _MOST_STEPS
        raise ValueError(
            f"`step_size` = {step_size:g} asks for {np.sum(wanted):.3g} steps in all, and memory "
            f"is reserved for at most 2²⁶ = {_MOST_STEPS:,}: pass {least:.2g} or more."
        )
    return wanted.astype(int)


def check_num_steps(value, num_intervals: int) -> int:
    """Return `num_steps`, of each of so many intervals.

    **Raises:** `TypeError` for anything but an integer, `ValueError` for one below 1, and for more
    steps in all than memory is reserved for.
    """
    num_steps = check_count("num_steps", value)
    if num_steps * num_intervals > _MOST_STEPS:
        raise ValueError(
            f"`num_steps` = {num_steps:,} for {num_intervals:,} intervals are more than "
            f"2²⁶ = {_MOST_STEPS:,} steps in all, for which memory is reserved: take fewer."
        )
    return num_steps


def check_key(key) -> None:
    """Raise `TypeError` for anything but one typed key."""
    if not (isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
        raise TypeError(f"`key` must be a typed key, `jax.random.key(seed)`; got {key!r}.")
    if key.shape != ():
        raise ValueError(f"`key` must be a single key; got an array of keys, {key.shape}.")


def check_count(name: str, value, minimum: int = 1, maximum: int = 2**31 - 1) -> int:
    """A static whole number of at least `minimum` and at most `maximum`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"`{name}` must be a Python integer, known when compiling; got {value!r}.")
    if value < minimum:
        raise ValueError(f"`{name}` must be at least {minimum}; got {value}.")
    if value > maximum:
        raise ValueError(f"`{name}` must be at most {maximum}; got {value}.")
    return int(value)


def check_bound(name: str, value: Numbers | None, default: int) -> Int[Array, ""]:
    """A bound on numbered trials, by default `default`; traced, so that it can change without
    compiling again."""
    if value is None:
        value = min(default, _MOST_TRIALS)
    elif not is_traced(value):
        value = check_count(name, value)
        if value > _MOST_TRIALS:
            raise ValueError(f"`{name}` must be at most 2³⁰; got {value}.")
    return jnp.asarray(value, jnp.int32)
