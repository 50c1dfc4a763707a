"""Evaluation of weighted paths in blocks that fit in memory, over devices, for active intervals."""

import math
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key

from ..engine.devices import over_devices, share
from ..engine.progress import metered_scan, metered_while_loop
from ..models.bridge_problem import Intervals
from .base import WeightedPaths

Block = Callable[[Key[Array, "I n"], Intervals, Bool[Array, " I"] | None], WeightedPaths]


def block_over_devices(function: Block) -> Block:
    """`function` with its draws split over devices: interval by interval, which each then has its
    own work done on one device only, or across all of them where that balances better."""

    def split(keys, intervals, active):
        num_intervals, num_draws = keys.shape
        if share(num_intervals) * num_draws <= num_intervals * share(num_draws):
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
    """`function`, row by row of its arguments, on blocks of at most `most_rows` rows.

    Active intervals come first, and blocks without any are not run.
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
        order = jnp.argsort(~active, stable=True)
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
        _, made = metered_scan(
            lambda _, i: (None, numbered_block(i)), None, jnp.arange(num_blocks), progress_meter
        )
    else:
        numbered_block = jax.jit(numbered_block)  # for its shapes and in the loop traced once
        shapes = jax.eval_shape(numbered_block, jnp.int32(0))
        nothing = jax.tree.map(
            lambda leaf: jnp.zeros((num_blocks, *leaf.shape), leaf.dtype), shapes
        )

        def going_on(state):
            i, _ = state
            return (i < num_blocks) & (rows[i // num_columns, 0] < num_active)

        def next_block(state):
            i, made = state
            block = numbered_block(i)
            return i + 1, jax.tree.map(lambda all, one: all.at[i].set(one), made, block)

        def progress(state):
            return state[0].astype(jnp.float32) / num_blocks

        init = (jnp.int32(0), nothing)
        _, made = metered_while_loop(going_on, next_block, init, progress, progress_meter)

    def join(leaf):
        leaf = leaf.reshape(num_rows, num_columns, *leaf.shape[1:])
        leaf = jnp.moveaxis(leaf, 1, 2).reshape(rows.size, columns.size, *leaf.shape[4:])
        leaf = leaf[:num_intervals, :num_draws]
        return leaf if active is None else leaf[jnp.argsort(order)]

    made = jax.tree.map(join, made)
    return made if active is None else masked(made, active)


def masked(made: WeightedPaths, active: Bool[Array, " I"]) -> WeightedPaths:
    """Nothing for the intervals that are not active."""

    def keep(leaf, otherwise):
        mask = active.reshape(-1, *[1] * (leaf.ndim - 1))
        return jnp.where(mask, leaf, otherwise)

    return WeightedPaths(
        keep(made.paths, jnp.nan),
        keep(made.log_weights, -jnp.inf),
        keep(made.found, False),
        keep(made.truncated, False),
        keep(made.num_simulated, 0),
        keep(made.num_nonfinite, 0),
        keep(made.log_halving, jnp.nan),
        keep(made.log_coarse, jnp.nan),
    )


# XLA's loops on CPU may be twice as fast where lanes fill whole vectors, of so many numbers. Few
# lanes are not worth a copy.
_VECTOR, _WORTH_FILLING = 16, 256


def _even_blocks(size: int, most: int, unit: int) -> Int[Array, "blocks length"]:
    """0, ..., size - 1 in blocks of one length, a multiple of `unit`, the last of them repeated to
    fill up."""
    num_blocks = -(-size // max(most, 1))
    length = -(-size // num_blocks)
    length = -(-length // unit) * unit
    return jnp.minimum(jnp.arange(num_blocks * length), size - 1).reshape(num_blocks, length)
