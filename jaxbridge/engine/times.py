"""Times on the caller's clock, which may be far from zero.

Single precision resolves a Julian date of this century only to a quarter of a day. All differences
of times are therefore taken in double precision before rounding. Coefficients that depend on time
itself, such as seasons, receive the caller's time, rounded once. Times are refused if this rounding
is not small compared with a step.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .checks import Numbers, as_floating, is_traced, missing_as_nan

# Largest rounding error of single-precision times, relative to their smallest difference.
_MOST_MOVED = 0.01
# Largest rounding error of the times at which coefficients are evaluated, relative to a step.
_MOST_OF_A_STEP = 0.002


class Clock(NamedTuple):
    """Clock of the caller, as a function of the time since its origin.

    `origin` is the sum of two numbers: the second is the rounding error of the first.
    """

    origin: Float[Array, "2"]

    def __call__(self, since: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Convert times since the origin to the caller's times.

        Only the final sum has a rounding error that matters.
        """
        return self.origin[0] + (self.origin[1] + since)

    def exactly(self, since: Float[Array, " n"]) -> Float[Array | np.ndarray, " n"]:
        """Return the caller's times without loss of their differences.

        They are a NumPy array of double precision if the precision of `since` cannot hold the
        differences. Traced times stay in that precision.
        """
        times = self(since)
        if is_traced(times):
            return times
        elapsed = np.asarray(since, float)
        steps = np.diff(elapsed)
        smallest = np.min(steps[steps > 0], initial=np.inf)
        if _spacing(float(np.max(np.abs(times), initial=0)), since.dtype) <= _MOST_MOVED * smallest:
            return times
        return np.sum(np.asarray(self.origin, float)) + elapsed


class Times(NamedTuple):
    """Times and their differences.

    - `values`: shape (..., n), of double precision unless they are traced.
    - `gaps`: differences of successive times along the last axis, in the precision of the input.
    """

    values: np.ndarray | Array
    gaps: Float[Array, "*I gaps"]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.values.shape

    @property
    def dtype(self) -> jnp.dtype:
        return self.gaps.dtype

    def preceded(self, name: str, first: Numbers) -> "Times":
        """Return the same times with the time `first` before them, unless they begin with it.

        **Raises:** `ValueError` if `first` is an array, not finite or after the first of the times,
        or if either is traced; `TypeError` for other types than numbers.
        """
        if is_traced(self.values, first):
            raise ValueError(
                f"`{name}` and `times` must be concrete; got traced values. Pass them as static "
                "values, or close over them."
            )
        if as_floating(name, first).shape != ():
            raise ValueError(f"`{name}` must be a number, shape (); got {first!r}.")
        values, first = np.asarray(self.values), np.asarray(first, float)
        if not np.isfinite(first):
            raise ValueError(f"`{name}` must be finite; got {first}.")
        if values.size and values.flat[0] < first:
            raise ValueError(
                f"`times` must begin at `{name}` = {first} or later; they begin at "
                f"{values.flat[0]}. Pass an earlier `{name}`."
            )
        if values.ndim != 1 or values.size == 0 or values[0] == first:
            return self
        with jax.ensure_compile_time_eval():
            gap = jnp.asarray(values[:1] - first, self.dtype)
            return Times(np.concatenate([[first], values]), jnp.concatenate([gap, self.gaps]))

    def clock(self, dtype: jnp.dtype) -> tuple[Clock, Float[Array, "*I n"]]:
        """Return a clock whose origin is the first time, and the times since then."""
        if is_traced(self.values):
            times = jnp.asarray(self.values, dtype)
            return Clock(jnp.stack([times[0], jnp.zeros_like(times[0])])), times - times[0]
        values = np.asarray(self.values)
        first = values[0].astype(dtype)
        # Two numbers of single precision hold the origin to about twice its digits.
        origin = np.stack([first, (values[0] - first).astype(dtype)])
        with jax.ensure_compile_time_eval():  # concrete times stay concrete
            return Clock(jnp.asarray(origin)), jnp.asarray((values - values[0]).astype(dtype))


def as_times(name: str, times: Numbers) -> Times:
    """Validate times, and compute their differences before rounding.

    **Raises:** `TypeError` for other types than real numbers; `ValueError` for a single number, and
    if the precision of the input has spoilt the differences.
    """
    times = missing_as_nan(times)
    array = as_floating(name, times)
    if array.ndim == 0:
        raise ValueError(f"`{name}` must have shape (n,); got a single number, {times!r}.")
    if is_traced(times):
        return Times(array, jnp.diff(array))
    values = np.asarray(times)
    # Python numbers and integers lose nothing before this point.
    precision = values.dtype if np.issubdtype(values.dtype, np.floating) else np.dtype(float)
    values = values.astype(float)
    steps = np.diff(values)
    smallest = np.min(np.abs(steps[steps != 0]), initial=np.inf)
    rounded = np.any(values != np.round(values))  # distinct integers are exact
    spacing = _spacing(np.max(np.abs(values), initial=0), precision)
    if spacing > _MOST_MOVED * smallest and (rounded or spacing > 1):
        raise ValueError(
            f"`{name}` are too far from zero for their dtype {precision}: neighbours differ by "
            f"{smallest:g}, and numbers of this size are rounded to multiples of {spacing:g}. "
            "Pass them as a NumPy array of float64, or subtract the first time in float64."
        )
    with jax.ensure_compile_time_eval():
        return Times(values, jnp.asarray(steps, array.dtype))


def check_increasing(times: Times) -> None:
    """Raise `ValueError` if a time is missing or not after the one before it.

    Traced times are not checked.
    """
    if is_traced(times.values):
        return
    values = np.asarray(times.values)
    missing = np.flatnonzero(~np.isfinite(values))
    if missing.size:
        raise ValueError(
            f"`times` must be increasing numbers; got `times[{missing[0]}]` = "
            f"{values[missing[0]]}. Remove this time and its observation."
        )
    not_increasing = np.flatnonzero(np.asarray(times.gaps) <= 0)
    if not not_increasing.size:
        return
    i = not_increasing[0]
    pair = f"`times[{i}]` = {values[i]} and `times[{i + 1}]` = {values[i + 1]}"
    if values[i] <= values[i + 1]:
        raise ValueError(
            f"`times` must be increasing; got equal {pair}. Merge the observations of one time "
            "into one row, with one column for each reading or with their mean: `times, row = "
            "np.unique(times, return_inverse=True)`, `observations = "
            "np.array([observations[row == i].mean(axis=0) for i in range(len(times))])`."
        )
    raise ValueError(
        f"`times` must be increasing; got {pair}. Sort them and their observations: `order = "
        "np.argsort(times)`, `times, observations = times[order], observations[order]`."
    )


def check_resolved(clock: Clock, since: Array, steps: Array) -> None:
    """Raise `ValueError` if rounding moves the caller's times by too large a part of a step.

    It applies to coefficients that depend on time. Traced times are not checked.
    """
    if is_traced(clock, since, steps):
        return
    sizes = np.asarray(steps, float)
    typical = np.median(sizes[sizes > 0]) if np.any(sizes > 0) else np.inf
    first, second = np.asarray(clock.origin, float)
    furthest = np.max(np.abs(first + second + np.asarray(since, float)), initial=0)
    spacing = _spacing(furthest, since.dtype)
    if spacing / 2 > _MOST_OF_A_STEP * typical:
        raise ValueError(
            f"`times` are too far from zero for coefficients that depend on time in {since.dtype}: "
            f"at {furthest:g}, times are rounded to multiples of {spacing:g}, while steps are "
            f"{typical:g}. Subtract a constant from `times`, for example `times[0]` or whole "
            'periods, or compute in double precision: `jax.config.update("jax_enable_x64", True)`.'
        )


def _spacing(size: float, dtype: np.dtype) -> float:
    """Return the distance between neighbouring floating point numbers of this size."""
    return float(jnp.finfo(dtype).eps) * 2.0 ** np.floor(np.log2(size)) if size > 0 else 0.0
