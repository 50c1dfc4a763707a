"""Scans over time that draw their noise as they go, a chunk of steps at once.

Every lane (one simulated path) has its own key, and its numbers depend on that key and the
step only. So a result does not depend on how lanes are gathered into batches, and an accepted
path can be replayed from its key alone.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, Shaped

from .keys import folded
from .lanes import Rows, join_rows, split_rows

# Drawing for many steps at once spreads the cost of deriving keys; drawing for all of them
# would double the memory of a long path.
_LONGEST_CHUNK = 64


class Store(NamedTuple):
    """Where the output of each step goes: row `slots[i]` of `rows`, whose last is for waste."""

    slots: Int[Array, " N"]
    rows: Shaped[Array, "rows ..."]


def chunks(num_steps: int) -> tuple[int, int]:
    """How many chunks of steps there are, and how many steps each is for."""
    num_chunks = -(-num_steps // _LONGEST_CHUNK)
    return num_chunks, -(-num_steps // num_chunks)


def normals_and_uniforms(
    key: Key[Array, ""], num_normals: int, num_uniforms: int, num_steps: int, dtype
) -> tuple[Float[Array, "normals steps"], Float[Array, "uniforms steps"]]:
    """N(0, 1) and U(0, 1) numbers of so many steps, from one draw of bits."""
    least = np.nextafter(np.asarray(-1, dtype), np.asarray(0, dtype))  # no number is infinite
    shape = num_normals + num_uniforms, num_steps
    both = jax.random.uniform(key, shape, dtype, least, 1)
    normals = math.sqrt(2) * lax.erf_inv(both[:num_normals])
    return normals, (1 + both[num_normals:]) / 2


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
) -> tuple[PyTree, PyTree]:
    """`lax.scan` of `step(carry, (noise, x)) -> (carry, y)` over `num_steps` steps.

    `draw(key, k)` gives one lane's noise for k steps, with leading axis k; `step` sees one
    step of it, lanes in the last axis. `xs` has leading axis `num_steps`; with `reverse` it is
    read, and the `y` written, from the last to the first. With a `store` only the rows it asks
    for are kept, and returned in place of all `y`.
    """
    cut = _Cut(num_steps, *chunks(num_steps), reverse)
    rows = None if store is None else store.rows
    one_chunk = _chunk_of(step, keys, draw, cut)
    (carry, rows), ys = cut.scan(one_chunk, (init, rows), cut.inputs(xs, store))
    return carry, cut.join(ys) if store is None else rows


def noisy_scan_until(
    over: Callable[[Any], Bool[Array, " lanes"]],
    step: Callable[[Any, tuple[Any, Any]], tuple[Any, None]],
    init: PyTree,
    keys: Key[Array, " lanes"],
    draw: Callable[[Key[Array, ""], int], PyTree],
    xs: PyTree,
    num_steps: int,
) -> PyTree:
    """The carry of the same scan, which is final once every lane is `over(carry)`: no further chunk
    is simulated."""
    cut = _Cut(num_steps, *chunks(num_steps))
    one_chunk, inputs = _chunk_of(step, keys, draw, cut), cut.inputs(xs, None)

    def next_chunk(state):
        index, carry = state
        (carry, _), _ = one_chunk((carry, None), jax.tree.map(lambda leaf: leaf[index], inputs))
        return index + 1, carry

    def going_on(state):
        index, carry = state
        return (index < cut.num_chunks) & ~jnp.all(over(carry))

    if cut.num_chunks == 1:
        return next_chunk((0, init))[1]
    return lax.while_loop(going_on, next_chunk, (0, init))[1]


class _Cut(NamedTuple):
    """Steps cut into chunks of one length, of which idle steps fill up the last."""

    num_steps: int
    num_chunks: int
    length: int
    reverse: bool = False

    @property
    def num_idle(self) -> int:
        return self.num_chunks * self.length - self.num_steps

    def inputs(self, xs: PyTree, store: Store | None) -> tuple:
        """Of each chunk: its number, which steps are active, their slots and their `xs`."""
        active = self._split(jnp.ones(self.num_steps, bool)) if self.num_idle else None
        # Idle steps repeat an input, for what they made of zeros could spoil derivatives.
        xs = jax.tree.map(lambda leaf: self._split(leaf, mode="edge"), xs)
        slots = None
        if store is not None:
            slots = self._split(store.slots, constant_values=store.rows.shape[0] - 1)
        return jnp.arange(self.num_chunks), active, slots, xs

    def scan(self, one_chunk: Callable, state: PyTree, inputs: PyTree) -> tuple[PyTree, PyTree]:
        if self.num_chunks > 1:
            return lax.scan(one_chunk, state, inputs, reverse=self.reverse)
        state, ys = one_chunk(state, jax.tree.map(lambda leaf: leaf[0], inputs))
        return state, jax.tree.map(lambda leaf: leaf[None], ys)

    def join(self, ys: PyTree) -> PyTree:
        """What the steps made, without what idle ones made."""

        def join(leaf):
            leaf = leaf.reshape(-1, *leaf.shape[2:])
            return leaf[self.num_idle :] if self.reverse else leaf[: self.num_steps]

        return jax.tree.map(join, ys)

    def _split(self, leaf: Shaped[Array, "N ..."], **padding) -> Shaped[Array, "chunks k ..."]:
        if self.num_idle:
            idle = (self.num_idle, 0) if self.reverse else (0, self.num_idle)
            leaf = jnp.pad(leaf, [idle] + [(0, 0)] * (leaf.ndim - 1), **padding)
        return leaf.reshape(self.num_chunks, self.length, *leaf.shape[1:])


def _chunk_of(step: Callable, keys: Key[Array, " lanes"], draw: Callable, cut: _Cut) -> Callable:
    """A chunk of steps, from the carry and the rows of a store, or none."""

    # Between steps the coordinates of points are arrays of their own. The compiler sees that they
    # are joined only to be taken apart again.
    def one_step(state, inputs):
        carry, rows = state
        noise, active, slot, x = inputs
        carry = join_rows(carry)
        stepped, y = step(carry, (noise, join_rows(x)))
        if active is not None:
            stepped = jax.tree.map(lambda new, old: jnp.where(active, new, old), stepped, carry)
        stepped, y = split_rows(stepped), split_rows(y)
        return ((stepped, None), y) if rows is None else ((stepped, _keep(rows, y, slot)), None)

    def one_chunk(state, inputs):
        carry, rows = state
        index, active, slots, xs = inputs
        # Each derivation of keys is a generator in the program, so one chunk goes without.
        mine = keys if cut.num_chunks == 1 else folded(keys, index)
        noise = jax.vmap(lambda key: draw(key, cut.length), out_axes=-1)(mine)
        inputs = noise, active, slots, split_rows(xs, axis=1)
        init = split_rows(carry), rows
        (carry, rows), ys = lax.scan(one_step, init, inputs, reverse=cut.reverse)
        return (join_rows(carry), rows), join_rows(ys, axis=1)

    return one_chunk


def _keep(
    rows: Shaped[Array, "rows ..."], y: Shaped[Array, "..."] | Rows, slot: Int[Array, ""]
) -> Shaped[Array, "rows ..."]:
    """The rows of a store with `y` in this one."""
    if not isinstance(y, Rows):
        return lax.dynamic_update_index_in_dim(rows, y, slot, 0)
    for j, row in enumerate(y):
        rows = lax.dynamic_update_slice(rows, row[None, None], (slot, j, 0))
    return rows
