"""Rejection sampling of many problems side by side, until each has its successes.

A problem is an interval that lacks bridges, or a bridge that lacks hits. Its attempts are
numbered 0, 1, 2, ..., and what an attempt does depends on its problem and number only; the j-th
success is the problem's j-th result. Thousands of attempts run at once, in lanes: each round
gives every lane to a problem that still lacks successes, more lanes to those that lack more
or succeed less often. So results do not depend on the number of lanes, and no lane waits for
the slowest problem.
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
    """What one attempt in each lane came to: `outputs` are arrays with lanes in the first axis,
    `finite` is false where a path left the finite numbers."""

    success: Bool[Array, " lanes"]
    finite: Bool[Array, " lanes"]
    outputs: PyTree


class Accepted(NamedTuple):
    """The successes of P problems, `wanted` rows for each, in order.

    - `outputs`: those of the successful attempts; rows that were not filled are as they were.
    - `number`: of the successful attempt, -1 for a row that was not filled.
    - `num_found`: successes of each problem.
    - `num_trials`: attempts of each problem up to its last success, or up to the bound.
    - `num_nonfinite`: how many of them left the finite numbers.
    """

    outputs: PyTree
    number: Int[Array, " rows"]
    num_found: Int[Array, " P"]
    num_trials: Int[Array, " P"]
    num_nonfinite: Int[Array, " P"]


class Search(NamedTuple):
    """How many successes each problem wants, the bound on its attempts, how many of them run side
    by side, and what shows progress."""

    wanted: int
    max_attempts: Int[Array, ""]
    num_lanes: int
    progress_meter: diffrax.AbstractProgressMeter | None = None


class _State(NamedTuple):
    accepted: Accepted
    num_tried: Int[Array, " P"]  # with the attempts that turned out not to be needed


def rejection_sample(
    attempt: Callable[[Int[Array, " lanes"], Int[Array, " lanes"]], Attempts],
    rows: PyTree,
    active: Bool[Array, " P"],
    search: Search,
) -> Accepted:
    """Run `attempt(problem, number)` until each active problem has the successes that it wants, or
    has run out of tries. `rows`: arrays with leading axis P × wanted, to be filled. Lanes are split
    over devices: see `over_devices` for the arrays that `attempt` needs."""
    wanted, max_attempts, num_lanes, progress_meter = search
    num_rows = active.shape[0] * wanted
    attempts = over_devices(attempt, (0, 0))

    def pending(state: _State):
        return active & (state.accepted.num_found < wanted) & (state.num_tried < max_attempts)

    def one_round(state: _State) -> _State:
        accepted, num_tried = state
        first, problem, place = _assign_lanes(
            accepted.num_found, num_tried, pending(state), wanted, num_lanes
        )
        number = num_tried[problem] + place
        made = attempts(problem, number)
        tried = number < max_attempts
        success = tried & made.success
        rank = accepted.num_found[problem] + _before(success, first[problem])
        needed = tried & (rank < wanted) & active[problem]
        row = jnp.where(success & needed, problem * wanted + rank, num_rows)
        everyone = jnp.ones_like(tried)
        counted = (row < num_rows, needed, needed & ~made.finite, everyone)
        *counts, num_run = _count(counted, problem, len(active))
        accepted = _add(accepted, made.outputs, number, row, counts)
        return _State(accepted, num_tried + num_run)

    def progress(state: _State):
        return jnp.sum(state.accepted.num_found).astype(jnp.float32) / num_rows

    nothing = jnp.zeros(active.shape, jnp.int32)
    empty = Accepted(rows, jnp.full(num_rows, -1, jnp.int32), nothing, nothing, nothing)
    init = _State(empty, nothing)
    going_on = lambda state: jnp.any(pending(state))
    return metered_while_loop(going_on, one_round, init, progress, progress_meter).accepted


def over_problems(
    run: Callable[[PyTree, PyTree, Search], PyTree], each: PyTree, shared: PyTree, search: Search
) -> PyTree:
    """`run(each, shared, search)`, results in the order of the problems; `each` has arrays with
    leading axis P, and all problems share the other.

    Under `vmap` the problems of all batches are run as those of one, which `vmap` by itself would
    not do: each batch would have lanes of its own, and wait for the slowest. Where batches differ
    in what their problems share, as in parameters, it is left to do so; also in what functions of
    a model close over.
    """
    arrays, rest = eqx.partition((shared, search.max_attempts), eqx.is_array)

    def given(arrays):
        shared, max_attempts = eqx.combine(arrays, rest)
        return shared, search._replace(max_attempts=max_attempts)

    # What `run` closes over is an argument, too: the rule is told whether it is batched.
    traced = lambda each, arrays: run(each, *given(arrays))
    converted = eqx.filter_closure_convert(traced, each, arrays)
    closed_over, converted = eqx.partition(converted, eqx.is_array)

    def plain(closed_over, each, arrays):
        return eqx.combine(closed_over, converted)(each, arrays)

    def folded(axis_size, in_batched, closed_over, each, arrays):
        differ, batched, shared_differ = in_batched
        if any(jax.tree.leaves((differ, shared_differ))):
            in_axes = jax.tree.map(lambda batched: 0 if batched else None, tuple(in_batched))
            results = jax.vmap(plain, in_axes, axis_size=axis_size)(closed_over, each, arrays)
            return results, jax.tree.map(lambda _: True, results)

        def fold(leaf, batched):
            if not batched:
                leaf = jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
            return leaf.reshape(-1, *leaf.shape[2:])

        each = jax.tree.map(fold, each, batched)
        shared, search = given(arrays)
        num_wanted = len(jax.tree.leaves(each)[0]) * search.wanted
        num_lanes = min(max(num_wanted, search.num_lanes), axis_size * search.num_lanes)
        results = over_problems(run, each, shared, search._replace(num_lanes=num_lanes))
        results = jax.tree.map(lambda leaf: leaf.reshape(axis_size, -1, *leaf.shape[1:]), results)
        return results, jax.tree.map(lambda _: True, results)

    together = jax.custom_batching.custom_vmap(plain)
    together.def_vmap(folded)
    return together(closed_over, each, arrays)


def _before(success: Bool[Array, " lanes"], first: Int[Array, " lanes"]) -> Int[Array, " lanes"]:
    """How many succeeded in the lanes from the `first` of the same problem up to this one: lanes of
    one problem lie side by side, in the order of their numbers."""
    before = jnp.cumsum(success, dtype=jnp.int32) - success.astype(jnp.int32)
    return before - before[first]


def _count(
    lanes: tuple[Bool[Array, " lanes"], ...], problem: Int[Array, " lanes"], num_problems: int
) -> Int[Array, "kinds P"]:
    """How many of the lanes of each kind each problem has."""
    each = jnp.stack(lanes, axis=1).astype(jnp.int32)  # one loop over lanes for all
    return jax.ops.segment_sum(each, problem, num_problems, indices_are_sorted=True).T


def _add(
    accepted: Accepted,
    outputs: PyTree,
    number: Int[Array, " lanes"],
    row: Int[Array, " lanes"],
    counts: Sequence[Int[Array, " P"]],
) -> Accepted:
    """With the attempts that are kept, those with a row, and what was counted of all."""
    num_found, num_needed, num_nonfinite = counts

    def keep(rows, values):
        return rows.at[row].set(values, mode="drop")

    return Accepted(
        jax.tree.map(keep, accepted.outputs, outputs),
        keep(accepted.number, number),
        accepted.num_found + num_found,
        accepted.num_trials + num_needed,
        accepted.num_nonfinite + num_nonfinite,
    )


_PARTS = 2**23  # of all lanes


def _assign_lanes(
    num_found: Int[Array, " P"],
    num_tried: Int[Array, " P"],
    pending: Bool[Array, " P"],
    wanted: int,
    num_lanes: int,
) -> tuple[Int[Array, " P"], Int[Array, " lanes"], Int[Array, " lanes"]]:
    """The first lane of each problem; each lane's problem, and its place among that problem's
    lanes. Lanes go in proportion to the trials still expected to be needed."""
    found, tried = num_found.astype(jnp.float32), num_tried.astype(jnp.float32)
    rate = (found + 1) / (tried + 2)
    need = jnp.where(pending, (wanted - found) / rate, 0)
    # Sums of whole parts cannot decrease, which rounded sums may: a problem's lanes must not
    # overlap the next's.
    part = jnp.ceil(need / jnp.maximum(jnp.sum(need), 1) * _PARTS).astype(jnp.int32)
    sums = jnp.cumsum(part).astype(jnp.float32)
    last = jnp.round(sums / jnp.maximum(sums[-1], 1) * num_lanes).astype(jnp.int32)
    last = last.at[-1].set(num_lanes)
    first = jnp.concatenate([jnp.zeros(1, jnp.int32), last[:-1]])
    lanes = jnp.arange(num_lanes, dtype=jnp.int32)
    problem = jnp.searchsorted(last, lanes, side="right").astype(jnp.int32)
    return first, problem, lanes - first[problem]
