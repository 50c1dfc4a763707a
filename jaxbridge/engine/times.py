"""Times of the caller's clock, which may be far from zero.

Single precision holds the Julian date of a day of this century only to a quarter of a day. So all
that follows from times follows from their differences, which are taken in double precision before
anything is rounded. What depends on the time itself, as seasons do, gets the caller's time, rounded
once; where that rounding is not small beside a step, it is refused.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .checks import Numbers, as_floating, is_traced, missing_as_nan

# By how much of their smallest difference single precision may have moved times that were given in
# it, and by how much of a step it may move the times at which coefficients are evaluated.
_MOST_MOVED, _MOST_OF_A_STEP = 0.01, 0.002


class Clock(NamedTuple):
    """The caller's clock: `origin` is the sum of two numbers, of which the second is what the
    precision of the first leaves out."""

    origin: Float[Array, "2"]

    def __call__(self, since: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the caller's times, given times since the origin, rounded once."""
        return self.origin[0] + (self.origin[1] + since)

    def exactly(self, since: Float[Array, " n"]) -> Float[Array | np.ndarray, " n"]:
        """Return the same times as a NumPy array of double precision where the precision of
        `since` cannot hold their differences."""
        times = self(since)
        if is_traced(times):
            return times
        known = np.asarray(since, float)
        steps = np.diff(known)
        smallest = np.min(steps[steps > 0], initial=np.inf)
        if _spacing(np.max(np.abs(times), initial=0), since.dtype) <= _MOST_MOVED * smallest:
            return times
        return np.sum(np.asarray(self.origin, float)) + known


class Times(NamedTuple):
    """Times, shape (..., n): `values`, of double precision unless they are traced; and `gaps`, the
    differences of successive ones, in the last axis, in the precision in which times were given."""

    values: np.ndarray | Array
    gaps: Float[Array, "*I gaps"]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.values.shape

    @property
    def dtype(self) -> jnp.dtype:
        return self.gaps.dtype

    def preceded(self, name: str, first: Numbers) -> "Times":
        """Return the same times with one before them, unless they begin with it.

        **Raises:** `ValueError` where it is not before them, or either is traced; `TypeError` for
        anything but a number.
        """
        if is_traced(self.values, first):
            raise ValueError(f"`{name}` must be known when compiling, and so must `times`.")
        if as_floating(name, first).shape != ():
            raise ValueError(f"`{name}` must be a number, shape (); got {first!r}.")
        values, first = np.asarray(self.values), np.asarray(first, float)
        if not np.isfinite(first) or (values.size and values.flat[0] < first):
            raise ValueError(
                f"`times` must begin at `{name}` = {first} or later; they do at {values.flat[0]}."
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
        origin = np.stack([first, (values[0] - first).astype(dtype)])
        with jax.ensure_compile_time_eval():  # so that what is known stays so
            return Clock(jnp.asarray(origin)), jnp.asarray((values - values[0]).astype(dtype))


def as_times(name: str, times: Numbers) -> Times:
    """Validate times, and take their differences before they are rounded.

    **Raises:** `TypeError` for anything but real numbers; `ValueError` where single precision, in
    which they were given, has spoilt the differences, or for a single number.
    """
    times = missing_as_nan(times)
    array = as_floating(name, times)
    if array.ndim == 0:
        raise ValueError(f"`{name}` must have shape (n,); got a single number, {times!r}.")
    if is_traced(times):
        return Times(array, jnp.diff(array))
    known = np.asarray(times)
    precision = known.dtype if np.issubdtype(known.dtype, np.floating) else np.dtype(float)
    known = known.astype(float)
    steps = np.diff(known)
    smallest = np.min(np.abs(steps[steps != 0]), initial=np.inf)
    rounded = np.any(known != np.round(known))  # whole numbers are exact, if they are distinct
    spacing = _spacing(np.max(np.abs(known), initial=0), precision)
    if spacing > _MOST_MOVED * smallest and (rounded or spacing > 1):
        raise ValueError(
            f"`{name}` are too far from zero for {precision}, in which they were given: neighbours "
            f"differ by {smallest:g}, and numbers of this size are rounded to multiples of "
            f"{spacing:g}. Pass them as a NumPy array of float64, or subtract the first "
            "before they are rounded."
        )
    with jax.ensure_compile_time_eval():
        return Times(known, jnp.asarray(steps, array.dtype))


def check_increasing(times: Times) -> None:
    """Raise `ValueError` where a time is missing, or is not after the one before it; silent while
    tracing."""
    if is_traced(times.values):
        return
    values = np.asarray(times.values)
    missing = np.flatnonzero(~np.isfinite(values))
    if missing.size:
        raise ValueError(
            f"`times` must increase, but `times[{missing[0]}]` = {values[missing[0]]} is missing: "
            "leave it out, with its observation."
        )
    back = np.flatnonzero(np.asarray(times.gaps) <= 0)
    if not back.size:
        return
    i = back[0]
    pair = f"`times[{i}]` = {values[i]} and `times[{i + 1}]` = {values[i + 1]}"
    if values[i] <= values[i + 1]:
        raise ValueError(
            f"`times` must increase, but {pair} are equal: merge the observations of one time into "
            "one row. Several readings are columns of the row, or their mean: `times, row = "
            "np.unique(times, return_inverse=True)`, `observations = "
            "np.array([observations[row == i].mean(axis=0) for i in range(len(times))])`."
        )
    raise ValueError(
        f"`times` must increase, but {pair} do not: sort them, with their observations: `order = "
        "np.argsort(times)`, `times, observations = times[order], observations[order]`."
    )


def check_resolved(clock: Clock, since: Array, steps: Array) -> None:
    """Raise `ValueError` where the caller's times are so far from zero that their precision moves
    them by much of a step, for coefficients that depend on time; silent while tracing."""
    if is_traced(clock, since, steps):
        return
    known = np.asarray(steps, float)
    typical = np.median(known[known > 0]) if np.any(known > 0) else np.inf
    first, second = np.asarray(clock.origin, float)
    furthest = np.max(np.abs(first + second + np.asarray(since, float)), initial=0)
    spacing = _spacing(furthest, since.dtype)
    if spacing / 2 > _MOST_OF_A_STEP * typical:
        raise ValueError(
            f"`times` are too far from zero for coefficients that depend on time in {since.dtype}: "
            f"at {furthest:g} it holds time only to multiples of {spacing:g}, beside steps of "
            f"{typical:g}. Subtract a constant from `times`, for instance `times[0]` or whole "
            'periods, or compute in double precision: `jax.config.update("jax_enable_x64", True)`.'
        )


def _spacing(size: float, dtype: np.dtype) -> float:
    """Return the distance between neighbouring numbers of this size."""
    return float(jnp.finfo(dtype).eps) * 2.0 ** np.floor(np.log2(size)) if size > 0 else 0.0
