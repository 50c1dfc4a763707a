"""Times and values as a record of segments with the same number of steps.

A long interval between two times consists of several segments, with missing observations at their
ends. Hence every record has K segments of N steps, for any times, and needs one program only.
"""

import dataclasses
from collections.abc import Callable, Sequence
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
from ..models.jumps import Jump, Jumps
from ..models.linear import LinearTransition
from ..schemes import num_splits, remaining_after_splits

# Cost of the end of a segment (observation, resampling), in steps.
_STEPS_PER_SEGMENT = 4
# Smallest number of splits of a last step. Without splits a single step would be of first order.
_FEWEST_SPLITS = 3


class Steps(NamedTuple):
    """Lengths δ of steps, the times at their middles, and their transitions if these are known.

    Time-dependent coefficients are evaluated at the middles. `jump` is the possible jump at the
    beginning of a step, `None` without `jumps`.
    """

    dt: Float[Array, "*steps"]
    time: Float[Array, "*steps"]
    transition: LinearTransition | None
    jump: Jump | None


class Record(eqx.Module):
    """Record of K segments with N steps each.

    - `clock`: the caller's time, with the first time as origin.
    - `since`: times of the ends of segments since the first time, shape (K + 1,).
    - `dt`: lengths of the steps, shape (K, N). A path does not move in a step of length zero.
    - `values`: observations at the ends of segments, shape (K + 1, m), NaN for missing values.
    - `which`: index of the end of a segment for each observation. An earlier `initial_time` has
        none.
    - `jump`: possible jump at the beginning of each segment, leading axis K; `None` without jumps.
    - `lengths`: lengths of the steps of a segment, before any coarsening, in units of equal steps.
    """

    clock: Clock
    since: Float[Array, " ends"]
    dt: Float[Array, "K N"]
    values: Float[Array, "ends m"]
    which: Int[Array, " n"]
    jump: Jump | None
    lengths: tuple[float, ...] = eqx.field(static=True)

    @property
    def num_steps(self) -> int:
        """Return N, the number of steps per segment."""
        return self.dt.shape[-1]

    @property
    def num_equal_steps(self) -> int:
        """Return the number of steps per segment before splits of the last one."""
        return round(sum(self.lengths))

    @property
    def durations(self) -> Float[Array, " K"]:
        """Return the lengths of the segments, as sums of steps.

        Differences of large times would lose precision.
        """
        return jnp.sum(self.dt, axis=1)

    @property
    def times(self) -> Float[Array, " ends"]:
        """Return the caller's times of the ends of segments."""
        return self.clock(self.since)

    @property
    def first_time(self) -> Float[Array, ""]:
        """Return the caller's first time."""
        return _first_time(self)

    def grid(self) -> Float[Array, " points"]:
        """Return the times of all points, since the first time."""
        return jnp.append(self._beginnings().ravel(), self.since[-1])

    @property
    def stored(self) -> Int[np.ndarray, " points"]:
        """Return the indices of the points that users see, without those of split steps."""
        K, N = self.dt.shape[-2:]  # the same for all records of a stack
        begins = np.arange(K)[:, None] * N + np.arange(self.num_equal_steps)
        return np.append(begins.ravel(), K * N)

    def middles(self) -> Float[Array, "K N"]:
        """Return the times at the middles of all steps."""
        return self.clock(self._beginnings() + self.dt / 2)

    def jumps_of_steps(self) -> Jump | None:
        """Return the possible jumps at the beginnings of all steps, leading axes (K, N).

        The jump of a segment is in its first step of positive length.
        """
        if self.jump is None:
            return None
        moves = self.dt > 0
        is_first = moves & (jnp.cumsum(moves, axis=1) == 1)
        inputs = jnp.broadcast_to(
            self.jump.inputs[:, None], (*self.dt.shape, self.jump.inputs.shape[-1])
        )
        return Jump(inputs, self.jump.exists[:, None] & is_first)

    def _beginnings(self) -> Float[Array, "K N"]:
        """Return the times at which steps begin, since the first time."""
        within = jnp.cumsum(self.dt, axis=1) - self.dt  # begins with exactly zero
        return self.since[:-1, None] + within

    def with_split_ends(self) -> "Record":
        """Return the record with the last step of each segment split into ever shorter steps.

        The steps that end at observations are then short. If their law differs from that of the
        other steps, it hardly matters.
        """
        num = max(num_splits(self.num_steps), _FEWEST_SPLITS)
        num += (self.num_steps + num) % 2  # pairs of `coarsened` then contain all steps
        parts = -np.diff([1.0, *remaining_after_splits(num), 0.0])
        last = self.dt[:, -1:] * jnp.asarray(parts, self.dt.dtype)
        dt = jnp.concatenate([self.dt[:, :-1], last], axis=1)
        return dataclasses.replace(self, dt=dt, lengths=(*self.lengths[:-1], *parts.tolist()))

    def coarsened(self, level: int = 1) -> "Record":
        """Return the record with steps 2^`level` times as long.

        The shape (K, N) stays, so compiled programs can be used again. Each long step has its
        length in the last of its parts; the others have length zero. Hence the last step of a
        segment has noise, as an exact observation needs. If 2^`level` does not divide N, the first
        long step of each segment is shorter.
        """
        size = 2**level
        left_out = -self.num_steps % size  # padding in front, so that the last step is complete
        parts = jnp.pad(self.dt, ((0, 0), (left_out, 0))).reshape(len(self.dt), -1, size)
        dt = jnp.zeros_like(parts).at[..., -1].set(jnp.sum(parts, axis=-1))
        return dataclasses.replace(self, dt=dt.reshape(len(self.dt), -1)[:, left_out:])


def as_records(
    pairs: list[tuple[Numbers, Numbers]],
    num_steps: int | None,
    step_size: float | None,
    initial_time: Numbers | None = None,
    jumps: list[Jumps | None] | None = None,
) -> list[Record]:
    """Validate times and observations; split the intervals of each record into segments and steps.

    **Arguments:**

    - `pairs`: times and observations of each record.
    - `num_steps`, `step_size`: number of steps between two times, or their maximum length. N is the
        same for all records.
    - `initial_time`: time of the initial law, if it is before the first time.
    - `jumps`: those of each record, in a list.

    **Raises:** `ValueError` that names the invalid time or observation.
    """
    check = lambda times, values: _check_record(times, values, initial_time)
    checked = of_each(check, pairs)
    widths = [values.shape[1] for _, values in checked]
    if len(set(widths)) > 1:
        raise ValueError(
            "several records must have the same number of observed components (columns of "
            f"`observations`); got {widths}."
        )
    all_times, observed, at_gaps = zip(*_with_jumps(checked, jumps), strict=True)
    with jax.ensure_compile_time_eval():  # so that concrete intervals stay concrete inside `jit`
        gaps = jnp.concatenate([times.gaps for times in all_times])
    num_steps, segments = _segments(gaps, num_steps, step_size)
    ends = np.cumsum([len(times.gaps) for times in all_times])[:-1]
    counts = np.split(segments, ends)
    return [
        _split_into_segments(
            *times.clock(_dtype(times, values)),
            times.gaps,
            values,
            jump,
            num_steps,
            tuple(segment_counts.tolist()),
            is_observed,
        )
        for times, (_, values), is_observed, jump, segment_counts in zip(
            all_times, checked, observed, at_gaps, counts, strict=True
        )
    ]


def _with_jumps(
    checked: list[tuple[Times, Array]], jumps: list[Jumps | None] | None
) -> list[tuple[Times, tuple[bool, ...], Jump | None]]:
    """Add the times of the jumps of each record to its times.

    **Returns:** for each record all times, whether each is one of the record, and the possible jump
    at the beginning of each interval between them.
    """
    entries = len(checked) * [None] if jumps is None else jumps
    example = next((entry for entry in entries if entry is not None), None)

    def split(record: tuple[Times, Array], entry: Jumps | None):
        times, values = record
        all_times, is_observed, jump = times, np.ones(times.shape[0], bool), None
        if entry is not None:
            all_times, is_observed, jump = entry.split(times)
        elif example is not None:
            none = jnp.zeros(len(times.gaps), bool)
            jump = Jump(jnp.repeat(example.inputs[:1], len(none), axis=0), none)
        # An earlier `initial_time` has no row.
        num_before = times.shape[0] - len(values)
        is_observed[np.flatnonzero(is_observed)[:num_before]] = False
        return all_times, tuple(is_observed.tolist()), jump

    return of_each(split, list(zip(checked, entries, strict=True)))


def split_records(times: Numbers, observations: Numbers) -> list[tuple[Numbers, Numbers]]:
    """Return the times and observations of each record.

    Several records are lists of times and observations, or arrays with a leading axis. They may
    share `times`.

    **Raises:** `ValueError` if the numbers of times and observations differ.
    """
    if not are_several(times, observations):
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


def are_several(times: Numbers, observations: Numbers) -> bool:
    """Return whether the arguments are lists of records, or have a leading axis of records."""
    return _num_axes(observations) == 3 or _has_rows(times)


def check_is_one(name: str, times: Numbers, observations: Numbers, instead: str) -> None:
    """Raise `ValueError` if the function `name` was passed several records."""
    if are_several(times, observations):
        raise ValueError(
            f"`{name}` takes one record, with `times` of shape (n,) and `observations` of shape "
            f"(n, m): {instead} for each of several records."
        )


def _has_rows(times: Numbers) -> bool:
    """Return whether `times` contains several rows, each with two times or more."""
    # Times of shape (n, 1) count as one record; its check reports the wrong shape.
    several = isinstance(times, list | tuple | np.ndarray | jax.Array) and _num_axes(times) == 2
    return several and len(times) > 0 and len(times[0]) > 1  # pyright: ignore


def of_each(function: Callable[..., Any], pairs: Sequence[tuple[Any, Any]]) -> list[Any]:
    """Evaluate `function(times, observations)` for each record, or another function of two values.

    **Raises:** the errors of `function`. If there are several records, the message begins with the
    number of the record.
    """
    if len(pairs) == 1:
        return [function(*pairs[0])]
    results = []
    for number, (times, observations) in enumerate(pairs):
        try:
            results.append(function(times, observations))
        except (ValueError, TypeError) as error:
            raise type(error)(f"in record {number}: {error}") from error
    return results


def _num_axes(value: Any) -> int:
    """Return the number of axes of an array, or of nested lists by their first entries."""
    if hasattr(value, "ndim"):
        return value.ndim
    is_list = isinstance(value, list | tuple)
    return 1 + _num_axes(value[0]) if is_list and value else int(is_list)


def as_rows(observations: Numbers) -> Float[Array, "n m"]:
    """Return observations as an array with one row per time.

    `None` and masked values become NaN. A series of numbers becomes one column.
    """
    values = as_floating("observations", missing_as_nan(_unmask("observations", observations)))
    return values[:, None] if values.ndim == 1 else values


def as_times_and_rows(times: Numbers, observations: Numbers) -> tuple[Times, Float[Array, "n m"]]:
    """Return the times of one record, and its observations with one row per time.

    **Raises:** `ValueError` for other shapes.
    """
    values = as_rows(observations)
    checked_times = as_times("times", _unmask("times", times))
    shape = checked_times.shape
    if len(shape) != 1 or values.ndim != 2 or values.shape[0] != shape[0]:
        raise ValueError(
            "`times` must have shape (n,) and `observations` (n, m), one row per time; got "
            f"{shape} and {values.shape}."
        )
    return checked_times, values


def _dtype(times: Times, values: Array) -> jnp.dtype:
    """Return the dtype of paths."""
    return jnp.promote_types(times.dtype, values.dtype)


def _check_record(
    times: Numbers, observations: Numbers, initial_time: Numbers | None
) -> tuple[Times, Float[Array, "n m"]]:
    """Validate the times and observations of one record.

    **Returns:** the times, and the observations as an array with one row per time. An earlier
    `initial_time` precedes these times, without a row.

    **Raises:** `ValueError` that names the invalid time or observation.
    """
    checked_times, values = as_times_and_rows(times, observations)
    if initial_time is not None:
        checked_times = checked_times.preceded("initial_time", initial_time)
    if checked_times.shape[0] < 2 or values.shape[1] == 0:
        raise ValueError(
            "a record needs at least two times (an earlier `initial_time` counts as one) and one "
            f"observed component; got `observations` of shape {values.shape}."
        )
    check_precision("`times` and `observations`", _dtype(checked_times, values))
    check_increasing(checked_times)
    if not is_traced(values):
        infinite = np.argwhere(np.isinf(values))
        if infinite.size:
            i, j = infinite[0]
            raise ValueError(f"`observations[{i}, {j}]` is infinite: pass NaN for a missing value.")
    return checked_times, values


@compiled_sooner
def _first_time(record: Record) -> Float[Array, ""]:
    return record.times[0]


@compiled_sooner
def _split_into_segments(
    clock: Clock,
    since: Float[Array, " n"],
    gaps: Float[Array, " gaps"],
    values: Float[Array, "observed m"],
    jump: Jump | None,
    num_steps: int,
    segments: tuple[int, ...],
    is_observed: tuple[bool, ...],
) -> Record:
    """Return the record with the given number of segments in each interval between two times.

    `is_observed` states which of the times have a row of `values`; `jump` has the intervals first.
    """
    dtype = since.dtype
    which = np.concatenate([[0], np.cumsum(segments)])
    num_ends, begins = which[-1] + 1, which[:-1]
    which = which[np.asarray(is_observed)]
    gap = np.repeat(np.arange(len(segments)), segments)
    if jump is not None:
        # Other segments than the first of an interval have arbitrary inputs.
        is_first = np.isin(np.arange(num_ends - 1), begins)
        jump = Jump(jump.inputs[gap].astype(dtype), jump.exists[gap] & is_first)
    ends = jnp.full((num_ends, values.shape[1]), jnp.nan, dtype).at[which].set(values)
    within = np.concatenate([np.arange(n) for n in segments])
    dt = (gaps / jnp.asarray(np.array(segments) * num_steps, gaps.dtype))[gap].astype(dtype)
    start = since[gap] + jnp.asarray(within * num_steps, dtype) * dt
    dt = jnp.broadcast_to(dt[:, None], (len(dt), num_steps))
    since = jnp.append(start, since[-1])
    return Record(clock, since, dt, ends, jnp.asarray(which), jump, num_steps * (1.0,))


def _unmask(name: str, values: Numbers) -> Numbers:
    """Return a masked NumPy array with NaN in place of masked values; other values unchanged."""
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
    """Return N, and the number of segments of each interval between two times.

    With `step_size`, N minimises the total cost of all segments, N + `_STEPS_PER_SEGMENT` each.
    """
    if step_size is None:
        num_steps = check_num_steps(10 if num_steps is None else num_steps, gaps.shape[0])
        return num_steps, np.ones(gaps.shape[0], int)
    step_counts = count_steps(gaps, num_steps, step_size)

    def cost(steps: int) -> int:
        # -(-a // b) is a / b rounded up.
        return int(np.sum(-(-step_counts // steps)) * (steps + _STEPS_PER_SEGMENT))

    best = min(np.unique(step_counts).tolist(), key=cost)
    return int(best), -(-step_counts // best)
