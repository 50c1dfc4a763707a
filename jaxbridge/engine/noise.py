"""Scans over time that draw their noise as they go, a stretch of steps at once.

Every lane (one simulated path) has its own key, and its numbers depend on that key and the
step only. So a result does not depend on how lanes are gathered into batches, and an accepted
path can be replayed from its key alone.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int, Key, PyTree, Shaped

from .lanes import Rows, join_rows, split_rows

# Drawing for many steps at once spreads the cost of deriving keys; drawing for all of them
# would double the memory of a long path.
_LONGEST_STRETCH = 64


class Store(NamedTuple):
    """Where the output of each step goes: row `slots[i]` of `rows`, whose last is for waste."""

    slots: Int[Array, " N"]
    rows: Shaped[Array, "rows ..."]


def stretches(num_steps: int) -> tuple[int, int]:
    """How many stretches of noise there are, and how many steps each is for."""
    num_stretches = -(-num_steps // _LONGEST_STRETCH)
    return num_stretches, -(-num_steps // num_stretches)


def noisy_scan(
    step: Callable[[Any, tuple[Any, Any]], tuple[Any, Any]],
    init: PyTree,
    keys: Key[Array, " lanes"],
    draw: Callable[[Key[Array, ""], int], PyTree],
    xs: PyTree,
    num_steps: int,
    *,
    reverse: bool = False,
    store: Store | None = None,
    over: Callable[[Any], Bool[Array, " lanes"]] | None = None,
) -> tuple[PyTree, PyTree]:
    """`lax.scan` of `step(carry, (noise, x)) -> (carry, y)` over `num_steps` steps.

    `draw(key, k)` gives one lane's noise for k steps, with leading axis k; `step` sees one
    step of it, lanes in the last axis. `xs` has leading axis `num_steps`; with `reverse` it is
    read, and the `y` written, from the last to the first. With a `store` only the rows it asks
    for are kept, and returned in place of all `y`. With `over`, nothing but the carry is
    returned, and it is final once every lane is over: no further stretch is simulated.
    """
    num_stretches, length = stretches(num_steps)
    num_idle = num_stretches * length - num_steps  # steps that fill up the last stretch
    slots, rows = (None, None) if store is None else store

    # Between steps the coordinates of points are arrays of their own. The compiler sees that they
    # are joined only to be taken apart again.
    def one_step(carry, inputs):
        carry, rows = carry
        noise, active, slot, x = inputs
        carry = join_rows(carry)
        stepped, y = step(carry, (noise, join_rows(x)))
        if active is not None:
            stepped = jax.tree.map(lambda new, old: jnp.where(active, new, old), stepped, carry)
        stepped, y = split_rows(stepped), split_rows(y)
        if rows is None:
            return (stepped, None), y
        return (stepped, _keep(rows, y, slot)), None

    def one_stretch(carry, inputs):
        index, active, slots, xs = inputs
        stretch_keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, index)
        noise = jax.vmap(lambda key: draw(key, length), out_axes=-1)(stretch_keys)
        carry, rows = carry
        init = split_rows(carry), rows
        inputs = noise, active, slots, split_rows(xs, axis=1)
        (carry, rows), ys = lax.scan(one_step, init, inputs, reverse=reverse)
        return (join_rows(carry), rows), join_rows(ys, axis=1)

    if num_stretches == 1:
        (carry, rows), ys = one_stretch((init, rows), (0, None, slots, xs))
        return carry, ys if store is None else rows

    def split(leaf, **padding):
        idle = (num_idle, 0) if reverse else (0, num_idle)
        widths = [idle] + [(0, 0)] * (leaf.ndim - 1)
        padded = jnp.pad(leaf, widths, **padding)
        return padded.reshape(num_stretches, length, *leaf.shape[1:])

    def join(leaf):
        leaf = leaf.reshape(num_stretches * length, *leaf.shape[2:])
        return leaf[num_idle:] if reverse else leaf[:num_steps]

    if store is not None:
        slots = split(slots, constant_values=store.rows.shape[0] - 1)
    active = split(jnp.ones(num_steps, dtype=bool)) if num_idle else None
    # Idle steps repeat an input, for what they made of zeros could spoil derivatives.
    xs = jax.tree.map(lambda leaf: split(leaf, mode="edge"), xs)
    inputs = (jnp.arange(num_stretches), active, slots, xs)
    if over is not None:

        def next_stretch(state):
            index, carry = state
            stretch = jax.tree.map(lambda leaf: leaf[index], inputs)
            (carry, _), _ = one_stretch((carry, None), stretch)
            return index + 1, carry

        def going_on(state):
            index, carry = state
            return (index < num_stretches) & ~jnp.all(over(carry))

        return lax.while_loop(going_on, next_stretch, (0, init))[1], None
    (carry, rows), ys = lax.scan(one_stretch, (init, rows), inputs, reverse=reverse)
    return carry, jax.tree.map(join, ys) if store is None else rows


def _keep(
    rows: Shaped[Array, "rows ..."], y: Shaped[Array, "..."] | Rows, slot: Int[Array, ""]
) -> Shaped[Array, "rows ..."]:
    """The rows of a store with `y` in this one."""
    if not isinstance(y, Rows):
        return lax.dynamic_update_index_in_dim(rows, y, slot, 0)
    for j, row in enumerate(y):
        rows = lax.dynamic_update_slice(rows, row[None, None], (slot, j, 0))
    return rows
