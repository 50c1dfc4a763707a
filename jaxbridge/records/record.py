"""Times and values as a record of segments with the same number of steps.

A long interval between two times consists of several segments, with missing observations at their
ends. Hence every record has K segments of N steps, for any times, and needs one program only.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..engine.checks import (
    Numbers,
    as_floating,
    check_num_steps,
    check_precision,
    count_steps,
    is_traced,
    missing_as_nan,
)
from ..engine.compiled import compiled_sooner
from ..engine.times import Clock, Times, as_times, check_increasing

# What the end of a segment costs, in steps.
_STEPS_PER_SEGMENT = 4


class Steps(NamedTuple):
    """Of steps, their lengths δ, and the times at their middles, where coefficients that depend on
    time are taken."""

    dt: Float[Array, "*steps"]
    time: Float[Array, "*steps"]


class Record(eqx.Module):
    """K segments of N steps.

    - `clock`: the caller's, whose origin is the first time.
    - `since`: times of the ends of segments since then, shape (K + 1,).
    - `dt`: the lengths of the steps of each, shape (K, N); a step of length zero stays where it is.
    - `values`: what is seen at these times, shape (K + 1, m), NaN where nothing is.
    - `which`: the place of each observation among the ends of segments.
    """

    clock: Clock
    since: Float[Array, " ends"]
    dt: Float[Array, "K N"]
    values: Float[Array, "ends m"]
    which: Int[Array, " n"]

    @property
    def num_steps(self) -> int:
        """N."""
        return self.dt.shape[-1]

    @property
    def durations(self) -> Float[Array, " K"]:
        """How long segments are: of times that are large rounding would leave little."""
        return jnp.sum(self.dt, axis=1)

    @property
    def times(self) -> Float[Array, " ends"]:
        """Return the caller's times of the ends of segments."""
        return self.clock(self.since)

    def grid(self) -> Float[Array, " points"]:
        """Return the times of all points since the first."""
        return jnp.append(self._beginnings().ravel(), self.since[-1])

    def steps(self) -> Steps:
        """All steps, shape (K, N)."""
        return Steps(self.dt, self.clock(self._beginnings() + self.dt / 2))

    def _beginnings(self) -> Float[Array, "K N"]:
        """Return the times at which steps begin, since the first."""
        within = jnp.cumsum(self.dt, axis=1) - self.dt  # first, so that a segment begins on time
        return self.since[:-1, None] + within

    def coarsened(self, level: int = 1) -> "Record":
        """The same with steps that are 2^level as long, the first of a segment what is left of N,
        for programs that are compiled for N: of each the last of its parts has the length and the
        others have none, so that the last of a segment has noise to be seen exactly."""
        size = 2**level
        left_out = -self.num_steps % size
        parts = jnp.pad(self.dt, ((0, 0), (left_out, 0))).reshape(len(self.dt), -1, size)
        dt = jnp.zeros_like(parts).at[..., -1].set(jnp.sum(parts, axis=-1))
        return dataclasses.replace(self, dt=dt.reshape(len(self.dt), -1)[:, left_out:])


def as_records(
    seen: list[tuple[Numbers, Numbers]],
    num_steps: int | None,
    step_size: float | None,
    initial_time: Numbers | None = None,
) -> list[Record]:
    """The records of times and of what was seen at them, `num_steps` between two times, or so many
    that none is longer than `step_size`; from `initial_time` on. All have the same N.

    **Raises:** `ValueError` that says what is wrong with which time or observation.
    """
    check = lambda times, values: _checked(times, values, initial_time)
    each = of_each(check, seen)
    widths = [values.shape[1] for _, values in each]
    if len(set(widths)) > 1:
        raise ValueError(
            "several records must have the same number of observed components (columns of "
            f"`observations`); got {widths}."
        )
    with jax.ensure_compile_time_eval():  # so that gaps that are known stay so
        gaps = jnp.concatenate([times.gaps for times, _ in each])
    num_steps, segments = _segments(gaps, num_steps, step_size)
    ends = np.cumsum([len(times.gaps) for times, _ in each])[:-1]
    counts = np.split(segments, ends)
    return [
        _cut(
            *times.clock(_dtype(times, values)), times.gaps, values, num_steps, tuple(mine.tolist())
        )
        for (times, values), mine in zip(each, counts, strict=True)
    ]


def split_records(times: Numbers, observations: Numbers) -> list[tuple[Numbers, Numbers]]:
    """Times and observations of each of several records: of lists of them, or of arrays with a
    leading axis; or of the only one. Records may share their `times`.

    **Raises:** `ValueError` where there are not as many of the one as of the other.
    """
    if _num_axes(observations) != 3 and not _has_rows(times):
        return [(times, observations)]
    rows: list[Any] = list(observations)  # pyright: ignore[reportArgumentType]
    when: list[Any] = len(rows) * [times]
    if _num_axes(times) > 1:
        when = list(times)  # pyright: ignore[reportArgumentType]
    if len(rows) == 0 or len(when) != len(rows):
        raise ValueError(
            "several records need a list of `times` and a list of `observations` of the same "
            f"length, at least one; got {len(when)} and {len(rows)}."
        )
    return list(zip(when, rows, strict=True))


def _has_rows(times: Numbers) -> bool:
    """Whether there are the times of several records, each of two or more."""
    several = isinstance(times, list | tuple | np.ndarray | jax.Array) and _num_axes(times) == 2
    return several and len(times) > 0 and len(times[0]) > 1  # pyright: ignore


def of_each(function: Callable[..., Any], seen: list[tuple[Numbers, Numbers]]) -> list[Any]:
    """`function(times, observations)` of each record, whose errors say of which they are, if there
    are several.

    **Raises:** what it raises.
    """
    if len(seen) == 1:
        return [function(*seen[0])]
    made = []
    for number, (times, observations) in enumerate(seen):
        try:
            made.append(function(times, observations))
        except (ValueError, TypeError) as error:
            raise type(error)(f"in record {number}: {error}") from error
    return made


def _num_axes(value: Any) -> int:
    """Of an array, or of nested lists, by their first entries."""
    if hasattr(value, "ndim"):
        return value.ndim
    is_list = isinstance(value, list | tuple)
    return 1 + _num_axes(value[0]) if is_list and value else int(is_list)


def as_rows(observations: Numbers) -> Float[Array, "n m"]:
    """Return observations as an array, a row for each time; what is `None` or masked is NaN, and a
    series of numbers is one column."""
    values = as_floating("observations", missing_as_nan(_filled("observations", observations)))
    return values[:, None] if values.ndim == 1 else values


def _dtype(times: Times, values: Array) -> jnp.dtype:
    return jnp.promote_types(times.dtype, values.dtype)


def _checked(
    times: Numbers, observations: Numbers, initial_time: Numbers | None
) -> tuple[Times, Float[Array, "n m"]]:
    """Times and values.

    **Raises:** `ValueError` that says what is wrong with which time or observation.
    """
    values = as_rows(observations)
    known = as_times("times", _filled("times", times))
    if initial_time is not None:
        seen = known
        known = seen.preceded("initial_time", initial_time)
        nothing = jnp.full((len(known.gaps) - len(seen.gaps), *values.shape[1:]), jnp.nan)
        values = jnp.concatenate([nothing.astype(values.dtype), values])
    if len(known.shape) != 1 or values.ndim != 2 or values.shape[0] != known.shape[0]:
        raise ValueError(
            "`times` must have shape (n,) and `observations` (n, m), one row per time; got "
            f"{known.shape} and {values.shape}."
        )
    if known.shape[0] < 2 or values.shape[1] == 0:
        raise ValueError(
            "a record needs at least two times and one observed component; got `observations` of "
            f"shape {values.shape}."
        )
    check_precision("`times` and `observations`", _dtype(known, values))
    check_increasing(known)
    if not is_traced(values):
        infinite = np.argwhere(np.isinf(values))
        if infinite.size:
            i, j = infinite[0]
            raise ValueError(f"`observations[{i}, {j}]` is infinite: pass NaN for a missing value.")
    return known, values


@compiled_sooner
def _cut(
    clock: Clock,
    since: Float[Array, " n"],
    gaps: Float[Array, " gaps"],
    values: Float[Array, "n m"],
    num_steps: int,
    segments: tuple[int, ...],
) -> Record:
    """The record, with so many segments to each gap."""
    dtype = since.dtype
    which = np.concatenate([[0], np.cumsum(segments)])
    ends = jnp.full((which[-1] + 1, values.shape[1]), jnp.nan, dtype).at[which].set(values)
    gap = np.repeat(np.arange(len(segments)), segments)
    within = np.concatenate([np.arange(n) for n in segments])
    dt = (gaps / jnp.asarray(np.array(segments) * num_steps, gaps.dtype))[gap].astype(dtype)
    start = since[gap] + jnp.asarray(within * num_steps, dtype) * dt
    dt = jnp.broadcast_to(dt[:, None], (len(dt), num_steps))
    return Record(clock, jnp.append(start, since[-1]), dt, ends, jnp.asarray(which))


def _filled(name: str, values: Numbers) -> Numbers:
    """What a masked array of NumPy holds, with NaN in the place of what is masked."""
    if not isinstance(values, np.ma.MaskedArray):
        return values
    if name == "times" and np.ma.getmaskarray(values).any():
        raise ValueError(
            "`times` has masked entries: leave them out, together with their observations."
        )
    return np.ma.filled(values.astype(float), np.nan)


def _segments(
    gaps: Array, num_steps: int | None, step_size: float | None
) -> tuple[int, Int[np.ndarray, " n"]]:
    """N, and of how many segments each gap is made."""
    if step_size is None:
        num_steps = check_num_steps(10 if num_steps is None else num_steps, gaps.shape[0])
        return num_steps, np.ones(gaps.shape[0], int)
    wanted = count_steps(gaps, num_steps, step_size)

    def cost(steps: int) -> int:
        return int(np.sum(-(-wanted // steps)) * (steps + _STEPS_PER_SEGMENT))

    best = min(np.unique(wanted).tolist(), key=cost)
    return int(best), -(-wanted // best)
