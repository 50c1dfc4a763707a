"""Several records that share a model.

Given the parameters records are independent, so likelihoods multiply and paths move separately. The
records are lanes of one program. Each has as many segments as the longest one; additional segments
have steps of length zero and missing observations.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ..engine.checks import Numbers
from ..engine.compiled import compiled_sooner
from ..models.diffusion import Diffusion
from ..schemes import AbstractStepDensity
from .guide_search import GuideCheck, linearised
from .initial import Initial
from .observation import Observation
from .problem import RecordProblem, check_clock, check_domain, problem_of
from .record import Record, as_records, split_records


class Records(eqx.Module):
    """R records, whose axis is the first of all arrays of `stacked.record`; and how many times each
    has something, or nothing, to be seen at."""

    stacked: RecordProblem
    num_times: tuple[int, ...] = eqx.field(static=True)

    @property
    def number(self) -> int:
        """R."""
        return len(self.num_times)

    def coarsened(self, level: int = 1) -> "Records":
        """The same with steps that are 2^level as long."""
        record = _coarsened(self.stacked.record, level)
        return Records(dataclasses.replace(self.stacked, record=record), self.num_times)

    @property
    def moving(self) -> Bool[Array, " N"]:
        """Which steps of a segment have a length in any of the records: others are left out."""
        return jnp.any(self.stacked.record.dt > 0, axis=(0, 1))

    def each(self, function: Callable, *mapped: PyTree) -> Any:
        """`function(problem, *mapped)` of each record, with their axis in front of what is mapped
        and of all results."""

        def one(record: Record, *mapped: PyTree):
            return function(dataclasses.replace(self.stacked, record=record), *mapped)

        arguments = self.stacked.record, *mapped
        if self.number > 1:
            return jax.vmap(one)(*arguments)
        # A single record takes no lanes: under `vmap` both branches of a `cond` would be run.
        return _with_axis(one(*_without_axis(arguments)))

    def at_observations(self, values: Float[Array, "R ends"]) -> Float[Array, " n"]:
        """What belongs to the ends of segments, at all observations, record after record."""
        each = zip(values, self.stacked.record.which, self.num_times, strict=True)
        return jnp.concatenate([mine[which[:num]] for mine, which, num in each])


def as_record_problems(
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    observation: Observation,
    initial: Initial,
    *,
    num_steps: int | None = None,
    step_size: float | None = None,
    initial_time: Numbers | None = None,
    density: AbstractStepDensity | None = None,
    for_weights: bool = False,
) -> Records:
    """What the arguments that all who read one record, or several, share say (`for_weights` as in
    `as_record_problem`).

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.
    """
    seen = split_records(times, observations)
    records = as_records(seen, num_steps, step_size, initial_time)
    law = density, False, for_weights
    problem = problem_of(model, records[0], observation, initial, *law)
    for record in records[1:]:
        check_domain(model, observation, record)
        check_clock(model, observation, record)
    num_times = tuple(len(record.which) for record in records)
    return Records(dataclasses.replace(problem, record=_stacked(records)), num_times)


# One program each, where there would be one for every array.
@compiled_sooner
def _stacked(records: list[Record]) -> Record:
    """Records of one length, with an axis in front."""
    num_segments = max(len(record.dt) for record in records)
    num_times = max(len(record.which) for record in records)
    same = [_padded(record, num_segments, num_times) for record in records]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *same)


@compiled_sooner
def _coarsened(stacked: Record, level: int) -> Record:
    return jax.vmap(lambda record: record.coarsened(level))(stacked)


@compiled_sooner
def _without_axis(tree: PyTree) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[0], tree)


@compiled_sooner
def _with_axis(tree: PyTree) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[None], tree)


def _padded(record: Record, num_segments: int, num_times: int) -> Record:
    """With so many segments, the last of which have no length and nothing to be seen."""
    more, last = num_segments - record.dt.shape[0], record.since[-1]
    return Record(
        record.clock,
        jnp.pad(record.since, (0, more), constant_values=last),
        jnp.pad(record.dt, ((0, more), (0, 0))),
        jnp.pad(record.values, ((0, more), (0, 0)), constant_values=jnp.nan),
        jnp.pad(record.which, (0, num_times - len(record.which))),
    )


def stacked(*alike: PyTree) -> tuple[PyTree, PyTree]:
    """The arrays of what is of one form, for instance on several grids, in a leading axis; and all
    else, which `equinox.combine` joins to those of one: so that they go through one program."""
    arrays, rest = zip(*(eqx.partition(each, eqx.is_array) for each in alike), strict=True)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *arrays), rest[0]


def linearisations(
    records: Records, model: Diffusion
) -> tuple[Float[Array, "R points d"], GuideCheck]:
    """The points along which each record is linearised, and how good a guide that makes."""

    def one(problem: RecordProblem):
        points, _, check = linearised(problem, model)
        return points, check

    return records.each(one)
