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
    is_traced,
    steps_of_size,
    taken,
)
from ..engine.compiled import compiled_sooner
from ..engine.times import as_times, check_increasing
from ..models.bridge_problem import Intervals, as_intervals
from ..models.diffusion import Diffusion
from ..models.tracing import uses_argument
from ..records import as_rows, of_each, split_records
from .parameters import Parameters, theta_of_model

# Numbers of steps are looked at as so many per factor of two.
_LEVELS_PER_OCTAVE = 2
# A number of steps of its own takes seconds to compile, as long as so many steps of paths take in
# each of a thousand sweeps.
_STEPS_PER_GROUP = 2**15


class Group(NamedTuple):
    """Intervals with the same number of steps, and which of all intervals they are."""

    intervals: Intervals
    which: Int[np.ndarray, " I"]
    num_steps: int


def as_observations(model: Diffusion, times: Numbers, observations: Numbers) -> Intervals:
    """The intervals between n + 1 observations, or of several records, one after the other.

    **Raises:** `ValueError` that says what is wrong with which time or observation.
    """
    one = lambda times, observations: _intervals(model, times, observations)
    each = of_each(one, split_records(times, observations))
    with jax.ensure_compile_time_eval():  # so that what is known stays so
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *each)


def _intervals(model: Diffusion, times: Numbers, observations: Numbers) -> Intervals:
    """Those of one record."""
    known = as_times("times", _unmasked("times", times))
    observations = as_rows(_unmasked("observations", observations))
    if len(known.shape) != 1:
        raise ValueError(f"`times` must have shape (n + 1,); got shape {known.shape}.")
    if observations.ndim != 2 or observations.shape[0] != known.shape[0]:
        raise ValueError(
            f"`observations` must have shape ({known.shape[0]}, d), one row per entry of `times`; "
            f"got shape {observations.shape}."
        )
    if known.shape[0] < 2:
        raise ValueError(f"`observations` must be two or more; got {known.shape[0]}.")
    check_precision(
        "`times` and `observations`", jnp.promote_types(known.dtype, observations.dtype)
    )
    check_increasing(known)
    if not is_traced(observations):
        _check_finite(np.asarray(observations))
        _check_state_space(model, observations)
    before, after = taken(observations, slice(-1)), taken(observations, slice(1, None))
    intervals, _, _ = as_intervals(before, after, known.gaps)
    return intervals


def _check_finite(observations: np.ndarray) -> None:
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
    """What a masked array of NumPy holds, if nothing in it is masked."""
    if not isinstance(values, np.ma.MaskedArray):
        return values
    mask = np.ma.getmaskarray(values)
    if mask.any():
        place = np.argwhere(mask)[0]
        which = f"`{name}[{place[0]}]`" if place.size else f"`{name}`"
        whole = place.size < 2 or mask[place[0]].all()
        coordinate = "" if whole else f", in coordinate {place[1]},"
        raise ValueError(
            f"{which} is masked{coordinate} but observations must be complete: leave out the whole "
            "row with its time."
        )
    return values.data


def _check_state_space(model: Diffusion, observations: Array) -> None:
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
    """At which points coefficients and stationary density are finite."""

    def finite(x):
        values = [model.drift(x), model.diffusion(x)]
        values += [model.log_stationary(x)] if model.has_density else []
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(value)) for value in values]))

    return jax.vmap(finite)(observations)


def step_groups(
    intervals: Intervals, num_steps: int | None, step_size: float | None
) -> tuple[Group, ...]:
    """All intervals with `num_steps` steps; or each with so many that none is longer than about
    `step_size`, in groups that are worth their compilation."""

    def group(which: Int[np.ndarray, " I"], num_steps: int) -> Group:
        if len(which) == len(durations):
            return Group(intervals, which, num_steps)
        return Group(jax.tree.map(lambda leaf: taken(leaf, which), intervals), which, num_steps)

    durations = intervals.duration
    if step_size is None:
        num_steps = check_num_steps(50 if num_steps is None else num_steps, len(durations))
        return (group(np.arange(len(durations)), num_steps),)
    wanted = steps_of_size(durations, num_steps, step_size)
    levels = np.ceil(np.log2(wanted) * _LEVELS_PER_OCTAVE)
    alike = [wanted[levels == level] for level in np.unique(levels)]
    ends = _cheapest_groups(
        [int(numbers.max()) for numbers in alike], [len(each) for each in alike]
    )
    return tuple(
        group(np.flatnonzero((wanted > below) & (wanted <= most)), most)
        for below, most in zip([0, *ends[:-1]], ends, strict=True)
    )


def _cheapest_groups(numbers: list[int], counts: list[int]) -> list[int]:
    """The numbers of steps of groups, each of which serves intervals that call for as many or for
    fewer: those with the least sum of all steps and of what the groups cost. `numbers` increase,
    and `counts` are of the intervals that call for so many."""
    best: list[tuple[int, list[int]]] = [(0, [])]  # for the first 0, 1, ... of the numbers
    for last, number in enumerate(numbers, 1):
        ways = [
            (best[first][0] + _STEPS_PER_GROUP + number * sum(counts[first:last]), first)
            for first in range(last)
        ]
        cost, first = min(ways)
        best.append((cost, [*best[first][1], number]))
    return best[-1][1]


class Problem(NamedTuple):
    """The unknown parameters, with θ as it is in the model, and the intervals between the
    observations, in groups of one number of steps."""

    parameters: Parameters
    theta: Float[Array, " p"]
    intervals: Intervals
    groups: tuple[Group, ...]

    @property
    def like(self) -> Float[Array, " d"]:
        """A point of the state space."""
        return taken(self.intervals.start, 0)

    @property
    def sigma_is_unknown(self) -> bool:
        """Whether σ depends on the unknown parameters."""
        like, parameters = self.like, self.parameters
        return uses_argument(lambda theta: parameters.bind(theta).diffusion(like), self.theta)

    def check_sigma_known(self, instead: str) -> None:
        """Raise `ValueError` where σ depends on the unknown parameters, that says what to do."""
        self.parameters.model.check_invertible_sigma(self.like)
        if self.sigma_is_unknown:
            raise ValueError(
                "σ depends on the unknown parameters, but a complete path determines σ: " + instead
            )


def as_problem(
    key: Key[Array, ""],
    parameters: Parameters,
    times: Numbers,
    observations: Numbers,
    num_steps: int | None,
    step_size: float | None,
) -> Problem:
    """What the arguments that all ways of inference share say.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.
    """
    check_key(key)
    intervals = as_observations(parameters.model, times, observations)
    theta = theta_of_model(parameters, intervals.start.dtype)
    return Problem(parameters, theta, intervals, step_groups(intervals, num_steps, step_size))
