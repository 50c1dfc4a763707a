"""Times and values as a record of segments, each of the same number of steps.

Between two times that are far apart there are several segments, at whose ends nothing is seen. So
every record is K segments of N steps, whatever its times, and one program.
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
    check_count,
    check_increasing,
    check_precision,
    is_traced,
    steps_of_size,
    time_steps,
)
from ..engine.compiled import compiled_sooner

# What the end of a segment costs, in steps.
_STEPS_PER_SEGMENT = 4


class Steps(NamedTuple):
    """Of steps, their lengths δ, and the times at their middles, where coefficients that depend on
    time are taken."""

    dt: Float[Array, "*steps"]
    time: Float[Array, "*steps"]


class Record(eqx.Module):
    """K segments of N steps.

    - `times`: t of their ends, shape (K + 1,).
    - `dt`: the lengths of the steps of each, shape (K, N); a step of length zero stays where it is.
    - `values`: what is seen at these times, shape (K + 1, m), NaN where nothing is.
    - `which`: the place of each observation among the ends of segments.
    """

    times: Float[Array, " ends"]
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

    def grid(self) -> Float[Array, " points"]:
        """The times of all points."""
        return jnp.append(self._beginnings().ravel(), self.times[-1])

    def steps(self) -> Steps:
        """All steps, shape (K, N)."""
        return Steps(self.dt, self._beginnings() + self.dt / 2)

    def _beginnings(self) -> Float[Array, "K N"]:
        """The times at which steps begin."""
        within = jnp.cumsum(self.dt, axis=1) - self.dt  # first, so that a segment begins on time
        return self.times[:-1, None] + within

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
    widths = [values.shape[1] for _, _, values in each]
    if len(set(widths)) > 1:
        raise ValueError(
            "several records must be seen alike, with as many columns of `observations`; got "
            f"{widths}."
        )
    with jax.ensure_compile_time_eval():  # so that gaps that are known stay so
        gaps = jnp.concatenate([gaps for _, gaps, _ in each])
    num_steps, segments = _segments(gaps, num_steps, step_size)
    ends = np.cumsum([len(gaps) for _, gaps, _ in each])[:-1]
    counts = np.split(segments, ends)
    return [
        _cut(times, gaps, values, num_steps, tuple(mine.tolist()))
        for (times, gaps, values), mine in zip(each, counts, strict=True)
    ]


def split_records(times: Numbers, observations: Numbers) -> list[tuple[Numbers, Numbers]]:
    """Times and observations of each of several records: of lists of them, or of arrays with a
    leading axis; or of the only one. Records may share their `times`.

    **Raises:** `ValueError` where there are not as many of the one as of the other.
    """
    if _num_axes(observations) != 3:
        return [(times, observations)]
    rows: list[Any] = list(observations)  # pyright: ignore[reportArgumentType]
    when: list[Any] = len(rows) * [times]
    if _num_axes(times) > 1:
        when = list(times)  # pyright: ignore[reportArgumentType]
    if len(rows) == 0 or len(when) != len(rows):
        raise ValueError(
            "several records are a list of `times` and a list of `observations`, as long and not "
            f"empty; got {len(when)} and {len(rows)}."
        )
    return list(zip(when, rows, strict=True))


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


def _checked(
    times: Numbers, observations: Numbers, initial_time: Numbers | None
) -> tuple[Float[Array, " n"], Float[Array, " gaps"], Float[Array, "n m"]]:
    """Times, the gaps between them, and values.

    **Raises:** `ValueError` that says what is wrong with which time or observation.
    """
    values = as_floating("observations", _filled("observations", observations))
    times = _filled("times", times)
    if initial_time is not None:
        times, values = _from_initial(initial_time, times, values)
    times, gaps = time_steps("times", times)
    if times.ndim != 1 or values.ndim != 2 or values.shape[0] != times.shape[0]:
        raise ValueError(
            "`times` must have shape (n,) and `observations` (n, m), a row for each of them; got "
            f"{times.shape} and {values.shape}."
        )
    if times.shape[0] < 2 or values.shape[1] == 0:
        raise ValueError(
            "a record has two times or more, at each of which there is something to be seen: "
            f"`observations` have shape {values.shape}."
        )
    check_precision("`times` and `observations`", jnp.promote_types(times.dtype, values.dtype))
    if not is_traced(times):
        check_increasing(np.asarray(times), np.asarray(gaps))
    if not is_traced(values):
        infinite = np.argwhere(np.isinf(values))
        if infinite.size:
            i, j = infinite[0]
            raise ValueError(f"`observations[{i}, {j}]` is infinite: NaN says it was not seen.")
    return times, gaps, values


@compiled_sooner
def _cut(
    times: Float[Array, " n"],
    gaps: Float[Array, " gaps"],
    values: Float[Array, "n m"],
    num_steps: int,
    segments: tuple[int, ...],
) -> Record:
    """The record, with so many segments to each gap."""
    dtype = jnp.promote_types(times.dtype, values.dtype)
    which = np.concatenate([[0], np.cumsum(segments)])
    ends = jnp.full((which[-1] + 1, values.shape[1]), jnp.nan, dtype).at[which].set(values)
    gap = np.repeat(np.arange(len(segments)), segments)
    within = np.concatenate([np.arange(n) for n in segments])
    dt = (gaps / jnp.asarray(np.array(segments) * num_steps, gaps.dtype))[gap]
    start = times[gap] + jnp.asarray(within * num_steps, dt.dtype) * dt
    all_times = jnp.append(start, times[-1])
    dt = jnp.broadcast_to(dt[:, None], (len(dt), num_steps))
    return Record(all_times.astype(dtype), dt.astype(dtype), ends, jnp.asarray(which))


def _filled(name: str, values: Numbers) -> Numbers:
    """What a masked array of NumPy holds, with NaN in the place of what is masked."""
    if not isinstance(values, np.ma.MaskedArray):
        return values
    if name == "times" and np.ma.getmaskarray(values).any():
        raise ValueError("`times` has masked entries: leave them out, with their observations.")
    return np.ma.filled(values.astype(float), np.nan)


def _from_initial(initial_time: Numbers, times: Numbers, values: Array) -> tuple[Numbers, Array]:
    """With a time of its own for the initial law, where that is before all that is seen."""
    if is_traced(times, initial_time):
        raise ValueError("`initial_time` must be known when compiling, and so must `times`.")
    known, first = np.asarray(times), float(np.asarray(initial_time))
    if not np.isfinite(first) or (known.size and known.flat[0] < first):
        raise ValueError(
            f"`times` must begin at `initial_time` = {first} or later; they do at {known.flat[0]}."
        )
    if known.ndim != 1 or known.size == 0 or known[0] == first:
        return times, values
    nothing = jnp.full((1, *values.shape[1:]), jnp.nan, values.dtype)
    return np.concatenate([[first], known]), jnp.concatenate([nothing, values])


def _segments(
    gaps: Array, num_steps: int | None, step_size: float | None
) -> tuple[int, Int[np.ndarray, " n"]]:
    """N, and of how many segments each gap is made."""
    if step_size is None:
        num_steps = check_count("num_steps", 10 if num_steps is None else num_steps)
        return num_steps, np.ones(gaps.shape[0], int)
    wanted = steps_of_size(gaps, num_steps, step_size)

    def cost(steps: int) -> int:
        return int(np.sum(-(-wanted // steps)) * (steps + _STEPS_PER_SEGMENT))

    best = min(np.unique(wanted).tolist(), key=cost)
    return int(best), -(-wanted // best)
