"""Scans over time that draw their noise on the way, one chunk of steps at a time.

Each lane (one simulated path) has its own key. Its noise depends on that key and on the step only.
Results therefore do not depend on the batch, and an accepted path can be replayed from its key
alone.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, Shaped

from .keys import fold_in_each
from .lanes import Rows, join_rows, split_rows

# Long chunks spread the cost of deriving keys. Noise of all steps at once would double the memory
# of a long path.
_LONGEST_CHUNK = 64


class Store(NamedTuple):
    """Destination of the steps' outputs: step i writes row `slots[i]` of `rows`.

    The last row receives outputs that are not wanted.
    """

    slots: Int[Array, " N"]
    rows: Shaped[Array, "rows ..."]


def chunk_shape(num_steps: int) -> tuple[int, int]:
    """Return the number of chunks and the number of steps in each, at most 64."""
    num_chunks = -(-num_steps // _LONGEST_CHUNK)
    return num_chunks, -(-num_steps // num_chunks)


def normals_and_uniforms(
    key: Key[Array, ""], num_normals: int, num_uniforms: int, num_steps: int, dtype
) -> tuple[Float[Array, "normals steps"], Float[Array, "uniforms steps"]]:
    """Sample N(0, 1) and U(0, 1) numbers for `num_steps` steps from one draw of bits."""
    # The interval (-1, 1) is open: erf⁻¹(±1) is infinite.
    lowest = np.nextafter(np.asarray(-1, dtype), np.asarray(0, dtype))
    shape = num_normals + num_uniforms, num_steps
    uniforms = jax.random.uniform(key, shape, dtype, lowest, 1)
    normals = math.sqrt(2) * lax.erf_inv(uniforms[:num_normals])
    return normals, (1 + uniforms[num_normals:]) / 2


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
    """Run `lax.scan` of `step(carry, (noise, x)) -> (carry, y)` over `num_steps` steps.

    - `draw(key, k)` returns one lane's noise for k steps, with leading axis k. `step` receives the
      noise of one step, with lanes in the last axis.
    - `xs` has leading axis `num_steps`. With `reverse`, `xs` is read and `y` is written from the
      last step to the first.
    - With a `store`, only the requested rows are stored, and returned in place of all `y`.
    """
    layout = _Chunks(num_steps, *chunk_shape(num_steps), reverse)
    rows = None if store is None else store.rows
    run_chunk = _chunk_of(step, keys, draw, layout)
    (carry, rows), ys = layout.scan(run_chunk, (init, rows), layout.inputs(xs, store))
    return carry, layout.join(ys) if store is None else rows


def noisy_scan_until(
    is_over: Callable[[Any], Bool[Array, " lanes"]],
    step: Callable[[Any, tuple[Any, Any]], tuple[Any, None]],
    init: PyTree,
    keys: Key[Array, " lanes"],
    draw: Callable[[Key[Array, ""], int], PyTree],
    xs: PyTree,
    num_steps: int,
) -> PyTree:
    """Run the scan of `noisy_scan` until `is_over(carry)` holds in all lanes; return the carry.

    The test runs once for each chunk, so further steps must not change the carry of a lane that is
    over.
    """
    layout = _Chunks(num_steps, *chunk_shape(num_steps))
    run_chunk, inputs = _chunk_of(step, keys, draw, layout), layout.inputs(xs, None)

    def next_chunk(state):
        index, carry = state
        (carry, _), _ = run_chunk((carry, None), jax.tree.map(lambda leaf: leaf[index], inputs))
        return index + 1, carry

    def continues(state):
        index, carry = state
        return (index < layout.num_chunks) & ~jnp.all(is_over(carry))

    if layout.num_chunks == 1:
        return next_chunk((0, init))[1]
    return lax.while_loop(continues, next_chunk, (0, init))[1]


class _Chunks(NamedTuple):
    """Split of the steps into chunks of one length; idle steps fill the last chunk."""

    num_steps: int
    num_chunks: int
    length: int
    reverse: bool = False

    @property
    def num_idle(self) -> int:
        """Return the number of idle steps."""
        return self.num_chunks * self.length - self.num_steps

    def inputs(self, xs: PyTree, store: Store | None) -> tuple:
        """Return for each chunk its number, the mask of active steps, their slots and their `xs`.

        The mask is `None` without idle steps, and the slots are `None` without a store.
        """
        active = self._split(jnp.ones(self.num_steps, bool)) if self.num_idle else None
        # Idle steps repeat an input: derivatives at zeros might be NaN, even if masked later.
        xs = jax.tree.map(lambda leaf: self._split(leaf, mode="edge"), xs)
        slots = None
        if store is not None:
            slots = self._split(store.slots, constant_values=store.rows.shape[0] - 1)
        return jnp.arange(self.num_chunks), active, slots, xs

    def scan(self, run_chunk: Callable, state: PyTree, inputs: PyTree) -> tuple[PyTree, PyTree]:
        """Scan `run_chunk` over all chunks; a single chunk runs without a loop."""
        if self.num_chunks > 1:
            return lax.scan(run_chunk, state, inputs, reverse=self.reverse)
        state, ys = run_chunk(state, jax.tree.map(lambda leaf: leaf[0], inputs))
        return state, jax.tree.map(lambda leaf: leaf[None], ys)

    def join(self, ys: PyTree) -> PyTree:
        """Concatenate the outputs of all chunks, without those of idle steps."""

        def join(leaf):
            leaf = leaf.reshape(-1, *leaf.shape[2:])
            return leaf[self.num_idle :] if self.reverse else leaf[: self.num_steps]

        return jax.tree.map(join, ys)

    def _split(self, leaf: Shaped[Array, "N ..."], **padding) -> Shaped[Array, "chunks k ..."]:
        """Reshape the leading axis to (chunks, steps of a chunk), padded by idle steps."""
        if self.num_idle:
            idle = (self.num_idle, 0) if self.reverse else (0, self.num_idle)
            leaf = jnp.pad(leaf, [idle] + [(0, 0)] * (leaf.ndim - 1), **padding)
        return leaf.reshape(self.num_chunks, self.length, *leaf.shape[1:])


def _chunk_of(
    step: Callable, keys: Key[Array, " lanes"], draw: Callable, layout: _Chunks
) -> Callable:
    """Return the function that runs one chunk, from a carry and the rows of a store or `None`."""

    # Between steps, each coordinate of a point is an array of its own (see `Rows`). The compiler
    # removes the joins that are split again at once.
    def run_step(state, inputs):
        carry, rows = state
        noise, active, slot, x = inputs
        carry = join_rows(carry)
        stepped, y = step(carry, (noise, join_rows(x)))
        if active is not None:
            stepped = jax.tree.map(lambda new, old: jnp.where(active, new, old), stepped, carry)
        stepped, y = split_rows(stepped), split_rows(y)
        return ((stepped, None), y) if rows is None else ((stepped, _set_row(rows, y, slot)), None)

    def run_chunk(state, inputs):
        carry, rows = state
        index, active, slots, xs = inputs
        # Each derivation of keys takes time to compile, so a single chunk uses the keys as given.
        chunk_keys = keys if layout.num_chunks == 1 else fold_in_each(keys, index)
        noise = jax.vmap(lambda key: draw(key, layout.length), out_axes=-1)(chunk_keys)
        inputs = noise, active, slots, split_rows(xs, axis=1)
        init = split_rows(carry), rows
        (carry, rows), ys = lax.scan(run_step, init, inputs, reverse=layout.reverse)
        return (join_rows(carry), rows), join_rows(ys, axis=1)

    return run_chunk


def _set_row(
    rows: Shaped[Array, "rows ..."], y: Shaped[Array, "..."] | Rows, slot: Int[Array, ""]
) -> Shaped[Array, "rows ..."]:
    """Return the rows of a store with row `slot` replaced by `y`."""
    if not isinstance(y, Rows):
        return lax.dynamic_update_index_in_dim(rows, y, slot, 0)
    for j, row in enumerate(y):
        rows = lax.dynamic_update_slice(rows, row[None, None], (slot, j, 0))
    return rows
