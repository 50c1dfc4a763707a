"""JAX's random numbers by programs of fewer parts: threefry written out.

Threefry-2x32 (Salmon, Moraes, Dror & Shaw 2011) turns a key and a count into two words, by twenty
rounds of

    x_0 ← x_0 + x_1,   x_1 ← (x_1 rotated by r) xor x_0,

after every fourth of which a word of the key is added to each. On CPUs JAX makes a loop of these,
for which the compiler needs a dozen kernels at each place where keys are derived or numbers drawn:
half of the time that a small program takes to compile. Written out each place is one kernel, or
part of those that read its numbers; only a single number is left to JAX. The numbers are the same,
bit by bit.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.random import define_prng_impl
from jaxtyping import Array, PyTree, UInt32

Words = tuple[UInt32[Array, "*shape"], UInt32[Array, "*shape"]]

_ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)
_PARITY = np.uint32(0x1BD11BDA)
_MOST = 2**32


def threefry(key: UInt32[Array, "2"], x: Words) -> Words:
    """The two words for each count x = (x_0, x_1)."""
    words = [key[0], key[1], key[0] ^ key[1] ^ _PARITY]
    x0, x1 = x[0] + words[0], x[1] + words[1]
    for i in range(5):
        for r in _ROTATIONS[i % 2]:
            x0 = x0 + x1
            x1 = (x1 << np.uint32(r) | x1 >> np.uint32(32 - r)) ^ x0
        x0 = x0 + words[(i + 1) % 3]
        x1 = x1 + words[(i + 2) % 3] + np.uint32(i + 1)
    return x0, x1


def _counts(shape: tuple[int, ...]) -> Words:
    """0, 1, 2, ..., in two words."""
    if math.prod(shape) >= _MOST:
        raise ValueError(f"at most 2³² numbers can be drawn at once; got the shape {shape}.")
    low = lax.iota(np.uint32, math.prod(shape)).reshape(shape)
    return jnp.zeros_like(low), low


def _derived(words: Words) -> UInt32[Array, "*shape 2"]:
    """Keys of these words. Where they are read they are not to be derived again, number by number,
    which the compiler would take for cheap."""
    return lax.optimization_barrier(jnp.stack(words, axis=-1))


def _seed(seed):
    return jax.random.key_data(jax.random.key(seed, impl="threefry2x32"))


def _split(key, shape):
    return _derived(threefry(key, _counts(shape)))


def _fold_in(key, number):
    return _derived(threefry(key, (jnp.zeros((), np.uint32), number.astype(np.uint32))))


def _random_bits(key, width, shape):
    if math.prod(shape) == 1:
        # Written out it would be worked out anew in each turn of the loop that reads it, and LLVM
        # (of JAX 0.10.2) may take minutes for one with all of this in its body.
        own = jax.random.wrap_key_data(key, impl="threefry2x32")
        return jax.random.bits(own, shape, f"uint{width}")
    high, low = threefry(key, _counts(shape))
    if width == 64:
        return high.astype(np.uint64) << np.uint64(32) | low.astype(np.uint64)
    return (high ^ low).astype(f"uint{width}")


_WRITTEN_OUT = define_prng_impl(
    key_shape=(2,),
    seed=_seed,
    split=_split,
    random_bits=_random_bits,
    fold_in=_fold_in,
    name="threefry2x32, written out",
    tag="frw",
)


def with_keys_written_out(tree: PyTree) -> PyTree:
    """The same, but that its keys, where they are JAX's own, are read by what is above."""
    return jax.tree.map(_written_out, tree)


def _written_out(leaf):
    if not (isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)):
        return leaf
    partitionable = jax.config.jax_threefry_partitionable  # pyright: ignore[reportAttributeAccessIssue]
    if jax.random.key_impl(leaf) != "threefry2x32" or not partitionable:
        return leaf
    return jax.random.wrap_key_data(jax.random.key_data(leaf), impl=_WRITTEN_OUT)
