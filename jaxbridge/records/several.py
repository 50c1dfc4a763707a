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
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..engine.arguments import as_sequence, check_instance
from ..engine.checks import Numbers
from ..engine.compiled import compiled_sooner, is_outermost
from ..models.diffusion import Diffusion
from ..models.jumps import JumpMap, Jumps, JumpsLike
from ..schemes import AbstractStepDensity
from .guide_search import GuideCheck, linearised
from .initial import Initial
from .observations import AbstractObservation
from .problem import RecordProblem, check_clock, check_domain, problem_of
from .record import Record, are_several, as_records, split_records


class Records(eqx.Module):
    """R records with a common model. Arrays of `stacked.record` have the axis of records first.

    `num_times` holds the number of times of each record, including times of missing observations,
    and `num_segments` its number of segments before they are padded. `are_listed` states whether
    the caller passed a list, possibly of one record.
    """

    stacked: RecordProblem
    num_times: tuple[int, ...] = eqx.field(static=True)
    num_segments: tuple[int, ...] = eqx.field(static=True)
    are_listed: bool = eqx.field(static=True)

    @property
    def number(self) -> int:
        """Return R, the number of records."""
        return len(self.num_times)

    def problem(self, number: int, padded: bool = False) -> RecordProblem:
        """Return one of the records; if `padded`, with as many segments as the longest one."""
        record = _entry(self.stacked.record, jnp.int32(number))
        if not padded:
            K, num_times = self.num_segments[number], self.num_times[number]
            record = dataclasses.replace(
                record,
                since=record.since[: K + 1],
                dt=record.dt[:K],
                values=record.values[: K + 1],
                which=record.which[:num_times],
                jump=jax.tree.map(lambda leaf: leaf[:K], record.jump),
            )
        return dataclasses.replace(self.stacked, record=record)

    def coarsened(self, level: int = 1) -> "Records":
        """Return the records with steps 2^`level` times as long."""
        record = _coarsened(self.stacked.record, level)
        return dataclasses.replace(self, stacked=dataclasses.replace(self.stacked, record=record))

    @property
    def moving(self) -> Bool[Array, " N"]:
        """Return the mask of the steps of a segment that have a positive length in any record.

        The other steps can be left out.
        """
        return jnp.any(self.stacked.record.dt > 0, axis=(0, 1))

    def each(self, function: Callable, *mapped: PyTree) -> Any:
        """Evaluate `function(problem, *mapped)` for each record.

        `mapped` and all results have a leading axis of records.
        """

        def one(record: Record, *mapped: PyTree):
            return function(dataclasses.replace(self.stacked, record=record), *mapped)

        arguments = self.stacked.record, *mapped
        if self.number > 1:
            return jax.vmap(one)(*arguments)
        # A single record is not mapped, because `vmap` evaluates both branches of a `cond`.
        return _with_axis(one(*_entry(arguments, 0)))

    def num_points(self, number: int) -> int:
        """Return the number of points of a path of this record that users see."""
        return self.num_segments[number] * self.stacked.record.num_equal_steps + 1

    def by_observation(self, values: Float[Array, "..."], axis: int) -> Array:
        """Return the entries at observations of values at the ends of segments.

        `axis` is that of the ends; records are before it. Entries beyond the last observation of a
        record are NaN.
        """
        which, number = self.stacked.record.which, max(self.num_times)
        real = np.arange(number) < np.array(self.num_times)[:, None]
        at = lambda leaf, which, real: jnp.where(
            real.reshape(-1, *[1] * (leaf.ndim - axis)), jnp.take(leaf, which, axis - 1), jnp.nan
        )
        return jax.vmap(at, (axis - 1, 0, 0), axis - 1)(values, which, real)

    def at_observations(
        self, values: Float[Array, "R ends"], worse: Callable[[Array, Array], Array]
    ) -> Float[Array, " n"]:
        """Return the entries at observations, record after record.

        `values` has an entry for each end of a segment. `worse` joins the entry of x_0, which may
        be earlier, and that of the first observation.
        """

        def of_record(values, which, number):
            # `which` is padded to the longest record, so only its first entries count.
            read = values[which[:number]]
            return read.at[0].set(worse(values[0], read[0]))

        each = zip(values, self.stacked.record.which, self.num_times, strict=True)
        return jnp.concatenate([of_record(*record) for record in each])


def as_record_problems(
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    observation: AbstractObservation,
    initial: Initial,
    *,
    num_steps: int | None = None,
    step_size: float | None = None,
    initial_time: Numbers | None = None,
    density: AbstractStepDensity | None = None,
    jumps: JumpsLike = None,
    **limits: bool,
) -> Records:
    """Validate the arguments common to all functions that take one or several records.

    `limits` are `any_constant` and `normal_steps` of `problem_of`.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.
    """
    pairs = split_records(times, observations)
    jump_map, of_records = _as_jumps(jumps, len(pairs))
    records = as_records(pairs, num_steps, step_size, initial_time, of_records)
    problem = problem_of(model, records[0], observation, initial, density, jump_map, **limits)
    for record in records[1:]:
        check_domain(model, observation, record)
        check_clock(model, observation, record)
    num_times = tuple(len(record.which) for record in records)
    num_segments = tuple(len(record.dt) for record in records)
    record = _stacked([problem.on_grid(record) for record in records])
    are_listed = are_several(times, observations)
    stacked_problem = dataclasses.replace(problem, record=record)
    return Records(stacked_problem, num_times, num_segments, are_listed)


def _as_jumps(
    jumps: JumpsLike, num_records: int
) -> tuple[JumpMap | None, list[Jumps | None] | None]:
    """Return the map of the jumps, and the jumps of each record.

    **Raises:** `ValueError` and `TypeError` for an invalid argument.
    """
    if jumps is None:
        return None, None
    if isinstance(jumps, Jumps):
        return jumps.map, [jumps for _ in range(num_records)]
    entries = as_sequence("jumps", jumps, "a `Jumps`, or a list with one entry per record")
    given = [entry for entry in entries if entry is not None]
    for entry in given:
        check_instance("jumps", entry, Jumps, "a `Jumps`, or a list of them and of `None`")
    if len(entries) != num_records or not given:
        raise ValueError(
            f"`jumps` must be a `Jumps`, or a list with one entry for each of {num_records} "
            "records: a `Jumps`, or `None` for a record without them. Got "
            f"{len(entries)} entries, {len(given)} of them `Jumps`."
        )
    first = given[0]
    if any(entry.map != first.map for entry in given):
        raise ValueError("all `jumps` must have the same function `apply`: define it once.")
    widths = [entry.inputs.shape[1] for entry in given]
    if len(set(widths)) > 1:
        raise ValueError(f"the `inputs` of all `jumps` must have as many columns; got {widths}.")
    return first.map, list(entries)


# Compiled as one program, because JAX would otherwise compile one for every array.
@compiled_sooner
def _stacked(records: list[Record]) -> Record:
    """Pad records to a common length and stack them in a leading axis."""
    num_segments = max(len(record.dt) for record in records)
    num_times = max(len(record.which) for record in records)
    same = [_padded(record, num_segments, num_times) for record in records]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *same)


@compiled_sooner
def _coarsened(stacked: Record, level: int) -> Record:
    """Return stacked records with steps 2^`level` times as long."""
    return jax.vmap(lambda record: record.coarsened(level))(stacked)


@compiled_sooner
def _entry(tree: PyTree, number: int | Int[Array, ""]) -> PyTree:
    """Return the entries of one record, without the leading axis."""
    return jax.tree.map(lambda leaf: leaf[number], tree)


@compiled_sooner
def _with_axis(tree: PyTree) -> PyTree:
    """Add the leading axis of a single record."""
    return jax.tree.map(lambda leaf: leaf[None], tree)


def _padded(record: Record, num_segments: int, num_times: int) -> Record:
    """Pad a record with segments of length zero and missing observations."""
    more, last = num_segments - record.dt.shape[0], record.since[-1]
    return Record(
        record.clock,
        jnp.pad(record.since, (0, more), constant_values=last),
        jnp.pad(record.dt, ((0, more), (0, 0))),
        jnp.pad(record.values, ((0, more), (0, 0)), constant_values=jnp.nan),
        jnp.pad(record.which, (0, num_times - len(record.which))),
        jax.tree.map(
            lambda leaf: jnp.pad(leaf, ((0, more), *(leaf.ndim - 1) * [(0, 0)])), record.jump
        ),
        record.lengths,
    )


def stacked(*alike: PyTree) -> tuple[PyTree, PyTree]:
    """Stack the arrays of pytrees of one structure, for instance of records on several grids.

    One compiled program then serves all of them.

    **Returns:** the arrays with a leading axis, and all other leaves. `equinox.combine` joins these
    to the arrays of one pytree.
    """
    arrays, others = zip(*(eqx.partition(tree, eqx.is_array) for tree in alike), strict=True)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *arrays), others[0]


def on_each_grid(function: Callable, *grids: PyTree) -> list:
    """Return `function(grid)` of each grid: pytrees of one structure with arrays of one shape.

    Inside a compiled program it is a loop, which compiles the function once. Outside, functions may
    decide in Python which programs they compile.
    """
    if is_outermost():
        return list(map(function, grids))
    arrays, others = stacked(*grids)
    results = lax.map(lambda arrays: function(eqx.combine(arrays, others)), arrays)
    return [jax.tree.map(lambda leaf, i=i: leaf[i], results) for i in range(len(grids))]


def linearisations(
    records: Records, model: Diffusion
) -> tuple[Float[Array, "R points d"], GuideCheck]:
    """Return the points of the linearisation of each record, and checks of the guides."""
    return records.each(lambda problem: points_and_check(problem, model))


def points_and_check(
    problem: RecordProblem, model: Diffusion
) -> tuple[Float[Array, "points d"], GuideCheck]:
    """Return the points of the linearisation of one record, and the check of its guide."""
    points, _, check = linearised(problem, model)
    return points, check
