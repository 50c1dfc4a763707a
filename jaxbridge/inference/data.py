"""Exact observations as intervals with steps, and their combination with the parameters."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int, Key

from ..engine.checks import (
    Numbers,
    check_key,
    check_num_steps,
    count_steps,
    index_without_compiling,
)
from ..models.bridge_problem import Intervals
from ..models.tracing import uses_argument
from ..records import as_observations
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
