"""Evaluation of weighted paths in blocks that fit in memory, over devices, for active intervals.

All proposals use it for their draws.
"""

import math
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key

from ..engine.devices import lanes_per_device, over_devices
from ..engine.progress import metered_scan, metered_while_loop
from ..models.bridge_problem import Intervals
from .base import WeightedPaths

Block = Callable[[Key[Array, "I n"], Intervals, Bool[Array, " I"] | None], WeightedPaths]


def block_over_devices(function: Block) -> Block:
    """Return `function` with its draws split over devices.

    Each device gets either some of the intervals, or some of the draws of every interval. The split
    with the smaller number of rows per device is used; a row is one draw of one interval.
    """

    def split(keys, intervals, active):
        num_intervals, num_draws = keys.shape
        # With whole intervals on one device, work for an interval is not repeated on others.
        if lanes_per_device(num_intervals) * num_draws <= num_intervals * lanes_per_device(
            num_draws
        ):
            return over_devices(function, (0, 0, 0))(keys, intervals, active)
        return over_devices(function, (1, None, None), out_axis=1)(keys, intervals, active)

    return split


def in_blocks(
    function: Block,
    keys: Key[Array, "I n"],
    intervals: Intervals,
    most_rows: int,
    active: Bool[Array, " I"] | None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> WeightedPaths:
    """Return `function` of all keys and intervals, computed in blocks of about `most_rows` rows.

    A row is one draw of one interval. A block may be larger, to fill vector registers. Paths of
    intervals that are not active are marked as not found. Active intervals are sorted to the front,
    and blocks without active intervals are skipped.
    """
    num_intervals, num_draws = keys.shape
    unit = _VECTOR if num_draws >= _WORTH_FILLING else 1
    columns = _even_blocks(num_draws, most_rows, unit)
    unit = _VECTOR // math.gcd(columns.shape[1], _VECTOR)
    unit = unit if num_intervals * num_draws >= _WORTH_FILLING * unit else 1
    rows = _even_blocks(num_intervals, most_rows // columns.shape[1], unit)
    if rows.shape == (1, num_intervals) and columns.shape == (1, num_draws) and active is None:
        return function(keys, intervals, active)
    order = jnp.arange(num_intervals)
    num_active = jnp.int32(num_intervals)
    if active is not None:
        order = jnp.argsort(~active, stable=True)  # active intervals first
        num_active = jnp.sum(active, dtype=jnp.int32)

    def one_block(row, column):
        chosen = order[rows[row]]
        block_keys = keys[chosen[:, None], columns[column][None]]
        block = jax.tree.map(lambda leaf: leaf[chosen], intervals)
        return function(block_keys, block, None if active is None else active[chosen])

    num_rows, num_columns = rows.shape[0], columns.shape[0]
    num_blocks = num_rows * num_columns

    def numbered_block(i):
        return one_block(i // num_columns, i % num_columns)

    if active is None:
        _, paths = metered_scan(
            lambda _, i: (None, numbered_block(i)), None, jnp.arange(num_blocks), progress_meter
        )
    else:
        numbered_block = jax.jit(numbered_block)  # traced once, for shapes and for the loop
        shapes = jax.eval_shape(numbered_block, jnp.int32(0))
        zeros = jax.tree.map(lambda leaf: jnp.zeros((num_blocks, *leaf.shape), leaf.dtype), shapes)

        def has_next(state):
            i, _ = state
            return (i < num_blocks) & (rows[i // num_columns, 0] < num_active)

        def next_block(state):
            i, paths = state
            block = numbered_block(i)
            return i + 1, jax.tree.map(lambda all, one: all.at[i].set(one), paths, block)

        def progress(state):
            return state[0].astype(jnp.float32) / num_blocks

        init = (jnp.int32(0), zeros)
        _, paths = metered_while_loop(has_next, next_block, init, progress, progress_meter)

    def join(leaf):
        leaf = leaf.reshape(num_rows, num_columns, *leaf.shape[1:])
        leaf = jnp.moveaxis(leaf, 1, 2).reshape(rows.size, columns.size, *leaf.shape[4:])
        leaf = leaf[:num_intervals, :num_draws]
        return leaf if active is None else leaf[jnp.argsort(order)]

    paths = jax.tree.map(join, paths)
    return paths if active is None else masked(paths, active)


def masked(weighted: WeightedPaths, active: Bool[Array, " I"]) -> WeightedPaths:
    """Return the paths, marked as not found in intervals that are not active."""

    def mask_leaf(leaf, fill):
        mask = active.reshape(-1, *[1] * (leaf.ndim - 1))
        return jnp.where(mask, leaf, fill)

    return WeightedPaths(
        mask_leaf(weighted.paths, jnp.nan),
        mask_leaf(weighted.log_weights, -jnp.inf),
        mask_leaf(weighted.found, False),
        mask_leaf(weighted.truncated, False),
        mask_leaf(weighted.num_simulated, 0),
        mask_leaf(weighted.num_nonfinite, 0),
        mask_leaf(weighted.log_halving, jnp.nan),
        mask_leaf(weighted.log_coarse, jnp.nan),
        weighted.coarse_paths,  # without weight
    )


# On CPU, loops of XLA may be twice as fast if lanes fill complete vectors of this many numbers. For
# fewer lanes than the second number the copies cost more than this gains.
_VECTOR, _WORTH_FILLING = 16, 256


def _even_blocks(size: int, most: int, unit: int) -> Int[Array, "blocks length"]:
    """Return the indices 0, ..., size - 1 in blocks of equal length, at most about `most`.

    The length is rounded up to a multiple of `unit`. The last index is repeated to fill the last
    block.
    """
    num_blocks = -(-size // max(most, 1))
    length = -(-size // num_blocks)
    length = -(-length // unit) * unit
    return jnp.minimum(jnp.arange(num_blocks * length), size - 1).reshape(num_blocks, length)
