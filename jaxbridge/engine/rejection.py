"""Rejection sampling of many problems side by side, until each has its successes.

A problem is an interval that needs bridges, or a bridge that needs hits. Its attempts are numbered
0, 1, 2, .... An attempt depends on its problem and number only, and the j-th success is the
problem's j-th result.

Thousands of attempts run at once, one in each lane. Every round assigns all lanes to problems that
still need successes; problems that need more, or succeed less often, get more lanes. Results
therefore do not depend on the number of lanes, and no lane waits for the slowest problem.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree

from .devices import over_devices
from .progress import metered_while_loop


class Attempts(NamedTuple):
    """Results of one attempt in each lane.

    - `success`: whether the attempt succeeded.
    - `finite`: false if the path left the finite numbers.
    - `outputs`: arrays with lanes in the first axis.
    """

    success: Bool[Array, " lanes"]
    finite: Bool[Array, " lanes"]
    outputs: PyTree


class Accepted(NamedTuple):
    """Successes of P problems, in order, `wanted` rows for each problem.

    - `outputs`: outputs of the successful attempts; unfilled rows keep their initial values.
    - `number`: number of the successful attempt, -1 for an unfilled row.
    - `num_found`: successes of each problem.
    - `num_trials`: attempts of each problem up to its last success, or up to the bound.
    - `num_nonfinite`: number of these attempts that left the finite numbers.
    """

    outputs: PyTree
    number: Int[Array, " rows"]
    num_found: Int[Array, " P"]
    num_trials: Int[Array, " P"]
    num_nonfinite: Int[Array, " P"]


class Search(NamedTuple):
    """Settings of a rejection sampler.

    - `wanted`: successes that each problem needs.
    - `max_attempts`: bound on the attempts of each problem.
    - `num_lanes`: attempts that run side by side.
    - `progress_meter`: meter that shows the share of successes found.
    """

    wanted: int
    max_attempts: Int[Array, ""]
    num_lanes: int
    progress_meter: diffrax.AbstractProgressMeter | None = None


class _State(NamedTuple):
    """State of the loop over rounds."""

    accepted: Accepted
    num_tried: Int[Array, " P"]  # including attempts after the last needed success


def rejection_sample(
    attempt: Callable[[Int[Array, " lanes"], Int[Array, " lanes"]], Attempts],
    rows: PyTree,
    active: Bool[Array, " P"],
    search: Search,
) -> Accepted:
    """Run `attempt(problem, number)` until each active problem has its successes.

    A problem also ends after `max_attempts`. `rows` are arrays with leading axis P × wanted, whose
    rows successes replace. Lanes are split over devices: see `over_devices` for arrays that
    `attempt` closes over.
    """
    wanted, max_attempts, num_lanes, progress_meter = search
    num_rows = active.shape[0] * wanted  # results of one problem are adjacent
    attempts = over_devices(attempt, (0, 0))

    def pending(state: _State):
        return active & (state.accepted.num_found < wanted) & (state.num_tried < max_attempts)

    def run_round(state: _State) -> _State:
        accepted, num_tried = state
        first, problem, place = _assign_lanes(
            accepted.num_found, num_tried, pending(state), wanted, num_lanes
        )
        number = num_tried[problem] + place
        results = attempts(problem, number)
        is_allowed = number < max_attempts
        success = is_allowed & results.success
        rank = accepted.num_found[problem] + _before(success, first[problem])
        needed = is_allowed & (rank < wanted) & active[problem]
        # Row `num_rows` does not exist: `_add` drops what is written there.
        row = jnp.where(success & needed, problem * wanted + rank, num_rows)
        all_lanes = jnp.ones_like(is_allowed)
        counted = (row < num_rows, needed, needed & ~results.finite, all_lanes)
        *counts, num_run = _count(counted, problem, len(active))
        accepted = _add(accepted, results.outputs, number, row, counts)
        return _State(accepted, num_tried + num_run)

    def progress(state: _State):
        return jnp.sum(state.accepted.num_found).astype(jnp.float32) / num_rows

    zeros = jnp.zeros(active.shape, jnp.int32)
    empty = Accepted(rows, jnp.full(num_rows, -1, jnp.int32), zeros, zeros, zeros)
    init = _State(empty, zeros)
    continues = lambda state: jnp.any(pending(state))
    return metered_while_loop(continues, run_round, init, progress, progress_meter).accepted


def over_problems(
    run: Callable[[PyTree, PyTree, Search], PyTree],
    problems: PyTree,
    shared: PyTree,
    search: Search,
) -> PyTree:
    """Return `run(problems, shared, search)`, with results in the order of the problems.

    `problems` has arrays with leading axis P; all problems share `shared`.

    Under `vmap`, the problems of all batches run as those of one batch. A plain `vmap` would give
    each batch lanes of its own, which all wait for the slowest batch. It is used only if the
    batches differ in `shared` (such as parameters) or in values that `run` closes over.
    """
    arrays, static_parts = eqx.partition((shared, search.max_attempts), eqx.is_array)

    def unpack(arrays):
        shared, max_attempts = eqx.combine(arrays, static_parts)
        return shared, search._replace(max_attempts=max_attempts)

    # Closed-over values become arguments, so that the batching rule sees whether they are batched.
    run_packed = lambda problems, arrays: run(problems, *unpack(arrays))
    converted = eqx.filter_closure_convert(run_packed, problems, arrays)
    closed_over, converted = eqx.partition(converted, eqx.is_array)

    def run_one_batch(closed_over, problems, arrays):
        return eqx.combine(closed_over, converted)(problems, arrays)

    def run_folded(axis_size, in_batched, closed_over, problems, arrays):
        closed_over_differ, batched, shared_differ = in_batched
        if any(jax.tree.leaves((closed_over_differ, shared_differ))):
            in_axes = jax.tree.map(lambda batched: 0 if batched else None, tuple(in_batched))
            results = jax.vmap(run_one_batch, in_axes, axis_size=axis_size)(
                closed_over, problems, arrays
            )
            return results, jax.tree.map(lambda _: True, results)

        def fold(leaf, batched):
            if not batched:
                leaf = jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
            return leaf.reshape(-1, *leaf.shape[2:])

        problems = jax.tree.map(fold, problems, batched)
        shared, search = unpack(arrays)
        num_wanted = len(jax.tree.leaves(problems)[0]) * search.wanted
        num_lanes = min(max(num_wanted, search.num_lanes), axis_size * search.num_lanes)
        results = over_problems(run, problems, shared, search._replace(num_lanes=num_lanes))
        results = jax.tree.map(lambda leaf: leaf.reshape(axis_size, -1, *leaf.shape[1:]), results)
        return results, jax.tree.map(lambda _: True, results)

    run_batched = jax.custom_batching.custom_vmap(run_one_batch)
    run_batched.def_vmap(run_folded)
    return run_batched(closed_over, problems, arrays)


def _before(success: Bool[Array, " lanes"], first: Int[Array, " lanes"]) -> Int[Array, " lanes"]:
    """Count the successes of the same problem in earlier lanes.

    Lanes of one problem are adjacent, in the order of their attempt numbers, and begin at `first`.
    """
    before = jnp.cumsum(success, dtype=jnp.int32) - success.astype(jnp.int32)
    return before - before[first]


def _count(
    lanes: tuple[Bool[Array, " lanes"], ...], problem: Int[Array, " lanes"], num_problems: int
) -> Int[Array, "kinds P"]:
    """Count, for each problem, its lanes of each kind."""
    kinds = jnp.stack(lanes, axis=1).astype(jnp.int32)  # one loop over lanes for all
    return jax.ops.segment_sum(kinds, problem, num_problems, indices_are_sorted=True).T


def _add(
    accepted: Accepted,
    outputs: PyTree,
    number: Int[Array, " lanes"],
    row: Int[Array, " lanes"],
    counts: Sequence[Int[Array, " P"]],
) -> Accepted:
    """Return `accepted` with the rows of this round and its counts added."""
    num_found, num_needed, num_nonfinite = counts

    def write_rows(rows, values):
        return rows.at[row].set(values, mode="drop")

    return Accepted(
        jax.tree.map(write_rows, accepted.outputs, outputs),
        write_rows(accepted.number, number),
        accepted.num_found + num_found,
        accepted.num_trials + num_needed,
        accepted.num_nonfinite + num_nonfinite,
    )


# Number of parts of all lanes. Sums of parts must be exact in float32: at most 2²⁴.
_PARTS = 2**23


def _assign_lanes(
    num_found: Int[Array, " P"],
    num_tried: Int[Array, " P"],
    pending: Bool[Array, " P"],
    wanted: int,
    num_lanes: int,
) -> tuple[Int[Array, " P"], Int[Array, " lanes"], Int[Array, " lanes"]]:
    """Return the first lane of each problem, the problem of each lane, and the lane's place there.

    Lanes are assigned in proportion to the expected number of further attempts.
    """
    successes, attempts = num_found.astype(jnp.float32), num_tried.astype(jnp.float32)
    rate = (successes + 1) / (attempts + 2)  # Laplace's rule: positive before the first success
    need = jnp.where(pending, (wanted - successes) / rate, 0)
    # The lanes of one problem must not overlap those of the next. Sums of integer parts cannot
    # decrease, whereas rounded sums of floats may.
    part = jnp.ceil(need / jnp.maximum(jnp.sum(need), 1) * _PARTS).astype(jnp.int32)
    sums = jnp.cumsum(part).astype(jnp.float32)
    last = jnp.round(sums / jnp.maximum(sums[-1], 1) * num_lanes).astype(jnp.int32)
    last = last.at[-1].set(num_lanes)  # no lane is left over by rounding
    first = jnp.concatenate([jnp.zeros(1, jnp.int32), last[:-1]])
    lanes = jnp.arange(num_lanes, dtype=jnp.int32)
    problem = jnp.searchsorted(last, lanes, side="right").astype(jnp.int32)
    return first, problem, lanes - first[problem]
