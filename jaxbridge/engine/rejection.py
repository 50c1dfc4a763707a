"""Numbered trials of many problems side by side, until each has its successes.

A problem is an interval that lacks bridges, or a bridge that lacks hits. Its trials are
numbered 0, 1, 2, ..., and what a trial does depends on its problem and number only; the j-th
success is the problem's j-th result. Thousands of trials run at once, in lanes: each round
gives every lane to a problem that still lacks successes, more lanes to those that lack more
or succeed less often. So results do not depend on the number of lanes, and no lane waits for
the slowest problem.
"""

import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from .devices import num_devices, over_devices


class Trials(NamedTuple):
    """What one trial in each lane came to: `outputs` are arrays with lanes in the first axis,
    `finite` is false where a path left the finite numbers."""

    success: Bool[Array, " lanes"]
    finite: Bool[Array, " lanes"]
    outputs: PyTree


class Found(NamedTuple):
    """The successes of P problems, `wanted` rows for each, in order.

    - `outputs`: those of the successful trials; rows that were not filled are as they were.
    - `number`: of the successful trial, -1 for a row that was not filled.
    - `num_found`: successes of each problem.
    - `num_trials`: trials of each problem up to its last success, or up to the bound.
    - `num_nonfinite`: how many of them left the finite numbers.
    """

    outputs: PyTree
    number: Int[Array, " rows"]
    num_found: Int[Array, " P"]
    num_trials: Int[Array, " P"]
    num_nonfinite: Int[Array, " P"]


class _Search(NamedTuple):
    found: Found
    num_tried: Int[Array, " P"]  # with the trials that turned out not to be needed
    meter: Any


def search(
    trial: Callable[[Int[Array, " lanes"], Int[Array, " lanes"]], Trials],
    rows: PyTree,
    active: Bool[Array, " P"],
    wanted: int,
    max_trials: Int[Array, ""],
    num_lanes: int,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> Found:
    """Run `trial(problem, number)` until each active problem has `wanted` successes, or has
    run out of tries. `rows`: arrays with leading axis P × wanted, to be filled. Lanes are split
    over devices: see `over_devices` for the arrays that `trial` needs."""
    num_problems = active.shape[0]
    num_rows = num_problems * wanted
    progress_meter = diffrax.NoProgressMeter() if progress_meter is None else progress_meter
    trials = over_devices(trial, (0, 0))

    def pending(state: _Search):
        return active & (state.found.num_found < wanted) & (state.num_tried < max_trials)

    def one_round(state: _Search) -> _Search:
        found, num_tried, _ = state
        first, problem, place = _assign_lanes(
            found.num_found, num_tried, pending(state), wanted, num_lanes
        )
        number = num_tried[problem] + place
        made = trials(problem, number)
        tried = number < max_trials
        success = tried & made.success
        # The lanes of one problem lie side by side, in the order of their numbers.
        successes = jnp.cumsum(success, dtype=jnp.int32)
        successes_before = successes - success.astype(jnp.int32)
        rank = found.num_found[problem] + successes_before - successes_before[first[problem]]
        needed = tried & (rank < wanted) & active[problem]
        row = jnp.where(success & needed, problem * wanted + rank, num_rows)

        def keep(rows, values):
            return rows.at[row].set(values, mode="drop")

        def count(lanes):
            return jax.ops.segment_sum(
                lanes.astype(jnp.int32), problem, num_problems, indices_are_sorted=True
            )

        num_found = found.num_found + count(success & needed)
        progress = jnp.sum(num_found).astype(jnp.float32) / num_rows
        found = Found(
            jax.tree.map(keep, found.outputs, made.outputs),
            keep(found.number, number),
            num_found,
            found.num_trials + count(needed),
            found.num_nonfinite + count(needed & ~made.finite),
        )
        num_tried += count(jnp.ones_like(tried))
        return _Search(found, num_tried, progress_meter.step(state.meter, progress))

    nothing = jnp.zeros(num_problems, jnp.int32)
    found = Found(rows, jnp.full(num_rows, -1, jnp.int32), nothing, nothing, nothing)
    state = _Search(found, nothing, progress_meter.init())
    state = lax.while_loop(lambda state: jnp.any(pending(state)), one_round, state)
    progress_meter.close(state.meter)
    return state.found


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
    share = jnp.cumsum(need) / jnp.maximum(jnp.sum(need), 1)
    # Rounded sums of floats need not increase, and a problem's lanes must not overlap the next's.
    last = lax.cummax(jnp.round(share * num_lanes).astype(jnp.int32)).at[-1].set(num_lanes)
    first = jnp.concatenate([jnp.zeros(1, jnp.int32), last[:-1]])
    lanes = jnp.arange(num_lanes, dtype=jnp.int32)
    problem = jnp.searchsorted(last, lanes, side="right").astype(jnp.int32)
    return first, problem, lanes - first[problem]


def numbered_keys(
    keys: Key[Array, " P"], problem: Int[Array, " lanes"], number: Int[Array, " lanes"]
) -> Key[Array, " lanes"]:
    """The key of each trial, from that of its problem."""
    return jax.vmap(jax.random.fold_in)(keys[problem], number)


def key_for(purpose: str, key: Key[Array, ""]) -> Key[Array, ""]:
    """A key that no numbering of problems or trials leads to, so that a caller may use one key
    for several calls on the same bridges."""
    return jax.random.fold_in(key, zlib.crc32(purpose.encode()))


# See `linalg`: beyond this many numbers per array, reductions that a user's model may contain
# are not safe in XLA's loops on CPU.
_MOST_NUMBERS = 2**15

# With fewer, much of the time of a step goes into what it costs however many lanes there are.
_ENOUGH_LANES = 256


def default_num_lanes(num_wanted: int, num_steps: int, point: Float[Array, "P d"]) -> int:
    """As many lanes as successes are wanted, within a bound on the memory of their paths on each
    device: 16 MiB, or what `_ENOUGH_LANES` need, up to 512 MiB.

    A lane holds two paths and their noise.
    """
    d = point.shape[1]
    bytes_per_lane = 3 * d * (num_steps + 1) * point.dtype.itemsize
    fitting = max(2**24 // bytes_per_lane, min(_ENOUGH_LANES, 2**29 // bytes_per_lane), 1)
    return min(num_devices() * min(fitting, most_lanes(d)), max(num_wanted, 64))


def most_lanes(d: int) -> int:
    """How many lanes may run side by side, for points in R^d."""
    return max(1, min(8_192, _MOST_NUMBERS // d))
