"""Discrete exact observations as intervals with steps, and their combination with the parameters.

The module validates `times`, `observations`, `num_steps` and `step_size` for all functions that
take exact observations.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.checks import (
    Numbers,
    check_key,
    check_num_steps,
    check_precision,
    count_steps,
    index_without_compiling,
    is_traced,
)
from ..engine.compiled import compiled_sooner
from ..engine.times import as_times, check_increasing
from ..models.bridge_problem import Intervals, as_intervals
from ..models.diffusion import Diffusion
from ..models.tracing import uses_argument
from ..records import as_rows, of_each, split_records
from .parameters import Parameters, theta_of_model

# Numbers of steps are rounded to so many levels per factor of two.
_LEVELS_PER_OCTAVE = 2
# Cost of one more group, in steps of paths. Its compilation takes some seconds, about the time of
# so many steps in a thousand sweeps.
_STEPS_PER_GROUP = 2**15


class Group(NamedTuple):
    """Intervals with the same number of steps; `which` are their positions among all intervals."""

    intervals: Intervals
    which: Int[np.ndarray, " I"]
    num_steps: int


def as_observations(model: Diffusion, times: Numbers, observations: Numbers) -> Intervals:
    """Return the intervals between n + 1 observations, or those of several records in sequence.

    **Raises:** `ValueError` that names the invalid time or observation.
    """
    one = lambda times, observations: _intervals(model, times, observations)
    intervals = of_each(one, split_records(times, observations))
    with jax.ensure_compile_time_eval():  # concrete values stay concrete inside `jit`
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *intervals)


def _intervals(model: Diffusion, times: Numbers, observations: Numbers) -> Intervals:
    """Return the intervals of one record, after all checks."""
    grid = as_times("times", _unmasked("times", times))
    observations = as_rows(_unmasked("observations", observations))
    if len(grid.shape) != 1:
        raise ValueError(f"`times` must have shape (n + 1,); got shape {grid.shape}.")
    if observations.ndim != 2 or observations.shape[0] != grid.shape[0]:
        raise ValueError(
            f"`observations` must have shape ({grid.shape[0]}, d), one row per entry of `times`; "
            f"got shape {observations.shape}."
        )
    if grid.shape[0] < 2:
        raise ValueError(
            f"`times` and `observations` need at least two entries; got {grid.shape[0]}."
        )
    check_precision("`times` and `observations`", jnp.promote_types(grid.dtype, observations.dtype))
    check_increasing(grid)
    if not is_traced(observations):
        _check_finite(np.asarray(observations))
        _check_state_space(model, observations)
    # Slices of JAX arrays would compile a program for each shape.
    before, after = (
        index_without_compiling(observations, slice(-1)),
        index_without_compiling(observations, slice(1, None)),
    )
    intervals, _, _ = as_intervals(before, after, grid.gaps)
    return intervals


def _check_finite(observations: np.ndarray) -> None:
    """Raise `ValueError` for the first observation that is not finite."""
    finite = np.isfinite(observations)
    missing = np.flatnonzero(~finite.all(axis=1))
    if not missing.size:
        return
    i = missing[0]
    if finite[i].any():
        which = ", ".join(map(str, np.flatnonzero(~finite[i])))
        raise ValueError(
            f"`observations[{i}]` = {observations[i]} has no finite number for coordinate {which}, "
            "but exact observations must be complete: leave out this row, with its time, or pass "
            "an `observation` to functions that take records."
        )
    raise ValueError(
        f"`observations[{i}]` = {observations[i]} is not finite: leave out observations that are "
        "missing, with their times."
    )


def _unmasked(name: str, values: Numbers) -> Numbers:
    """Return the data of a masked NumPy array.

    **Raises:** `ValueError` if an entry is masked.
    """
    if not isinstance(values, np.ma.MaskedArray):
        return values
    mask = np.ma.getmaskarray(values)
    if mask.any():
        place = np.argwhere(mask)[0]
        which = f"`{name}[{place[0]}]`" if place.size else f"`{name}`"
        all_masked = place.size < 2 or mask[place[0]].all()
        coordinate = "" if all_masked else f", in coordinate {place[1]},"
        raise ValueError(
            f"{which} is masked{coordinate} but observations must be complete: leave out the whole "
            "row with its time."
        )
    return values.data


def _check_state_space(model: Diffusion, observations: Array) -> None:
    """Raise `ValueError` for the first observation outside the model's state space."""
    # The coefficients of a traced model have no values yet.
    if is_traced(model):
        return

    good = _inside(model, observations)
    if not is_traced(good) and not np.all(np.asarray(good)):
        i = int(np.argmin(good))
        raise ValueError(
            f"`observations[{i}]` = {np.asarray(observations[i])} is outside the state space: "
            "drift, σ or the stationary density of the model is not finite there. Check the "
            "observation and the model's `params`."
        )


@compiled_sooner
def _inside(model: Diffusion, observations: Float[Array, "n d"]) -> Bool[Array, " n"]:
    """Return whether the coefficients and the stationary density are finite at each point."""

    def finite(x):
        values = [model.drift(x), model.diffusion(x)]
        values += [model.log_stationary(x)] if model.has_density else []
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(value)) for value in values]))

    return jax.vmap(finite)(observations)


def step_groups(
    intervals: Intervals, num_steps: int | None, step_size: float | None
) -> tuple[Group, ...]:
    """Group the intervals by number of steps.

    With `num_steps`, by default 50, there is one group. With `step_size` no step is longer than
    about that. Intervals with similar numbers of steps then share a group, because each group is
    compiled separately.
    """

    def group(which: Int[np.ndarray, " I"], num_steps: int) -> Group:
        if len(which) == len(durations):
            return Group(intervals, which, num_steps)
        return Group(
            jax.tree.map(lambda leaf: index_without_compiling(leaf, which), intervals),
            which,
            num_steps,
        )

    durations = intervals.duration
    if step_size is None:
        num_steps = check_num_steps(50 if num_steps is None else num_steps, len(durations))
        return (group(np.arange(len(durations)), num_steps),)
    required = count_steps(durations, num_steps, step_size)
    # Grouping by level keeps the number of candidates for a group small.
    levels = np.ceil(np.log2(required) * _LEVELS_PER_OCTAVE)
    by_level = [required[levels == level] for level in np.unique(levels)]
    ends = _cheapest_groups(
        [int(numbers.max()) for numbers in by_level], [len(numbers) for numbers in by_level]
    )
    return tuple(
        group(np.flatnonzero((required > below) & (required <= most)), most)
        for below, most in zip([0, *ends[:-1]], ends, strict=True)
    )


def _cheapest_groups(numbers: list[int], counts: list[int]) -> list[int]:
    """Return the numbers of steps of the groups with the smallest total cost.

    A group contains the intervals that require at most its number of steps and more than that of
    the previous group. The cost is the number of all steps plus `_STEPS_PER_GROUP` per group.
    `numbers` are the required numbers of steps, increasing, and `counts` those of intervals with
    each of them.
    """
    # Dynamic programming: `best[k]` is the cheapest partition of the first k numbers.
    best: list[tuple[int, list[int]]] = [(0, [])]
    for last, number in enumerate(numbers, 1):
        ways = [
            (best[first][0] + _STEPS_PER_GROUP + number * sum(counts[first:last]), first)
            for first in range(last)
        ]
        cost, first = min(ways)
        best.append((cost, [*best[first][1], number]))
    return best[-1][1]


class Problem(NamedTuple):
    """Exact observations with unknown parameters.

    - `parameters`, `theta`: the unknown parameters, and their values in the model.
    - `intervals`, `groups`: all intervals between observations, and the same in groups with the
      same number of steps.
    """

    parameters: Parameters
    theta: Float[Array, " p"]
    intervals: Intervals
    groups: tuple[Group, ...]

    @property
    def like(self) -> Float[Array, " d"]:
        """Return a point of the state space."""
        return index_without_compiling(self.intervals.start, 0)

    @property
    def sigma_is_unknown(self) -> bool:
        """Return whether σ depends on the unknown parameters."""
        like, parameters = self.like, self.parameters
        return uses_argument(lambda theta: parameters.bind(theta).diffusion(like), self.theta)


def as_problem(
    key: Key[Array, ""],
    parameters: Parameters,
    times: Numbers,
    observations: Numbers,
    num_steps: int | None,
    step_size: float | None,
) -> Problem:
    """Validate the arguments common to all functions that take exact observations.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.
    """
    check_key(key)
    intervals = as_observations(parameters.model, times, observations)
    theta = theta_of_model(parameters, intervals.start.dtype)
    return Problem(parameters, theta, intervals, step_groups(intervals, num_steps, step_size))
