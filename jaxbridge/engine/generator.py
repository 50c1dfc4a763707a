"""Threefry random numbers with unrolled rounds: the same numbers as JAX's, compiled faster.

Threefry-2x32 (Salmon, Moraes, Dror & Shaw 2011) turns a key and a count into two words, by twenty
rounds of

    x_0 ← x_0 + x_1,   x_1 ← (x_1 rotated by r) xor x_0.

After every fourth round, a word of the key is added to each of the two.

On CPUs, JAX compiles the rounds as a loop. Each place that derives keys or draws numbers then needs
a dozen kernels, which is half of the compilation time of a small program. Unrolled, each place is
one kernel, or a part of the kernels that read its numbers. Only draws of a single number still use
JAX's version. The numbers are equal bit by bit.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.random import define_prng_impl
from jaxtyping import Array, Key, PyTree, UInt32

Words = tuple[UInt32[Array, "*shape"], UInt32[Array, "*shape"]]

_ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)
_PARITY = np.uint32(0x1BD11BDA)
_MOST_NUMBERS = 2**32


def threefry(key: UInt32[Array, "2"], x: Words) -> Words:
    """Compute the two words for each count x = (x_0, x_1)."""
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
    """Return the counts 0, 1, 2, ..., each in two words."""
    if math.prod(shape) >= _MOST_NUMBERS:
        raise ValueError(
            f"JAX can draw at most 2³² numbers at once; got the shape {shape}. Draw fewer numbers "
            "in each call."
        )
    low = lax.iota(np.uint32, math.prod(shape)).reshape(shape)
    return jnp.zeros_like(low), low


def _keys_of(words: Words) -> UInt32[Array, "*shape 2"]:
    """Stack two words to keys.

    The barrier makes the compiler compute them once. Without it, every number that reads a key
    derives it again, because the compiler considers that cheap.
    """
    return lax.optimization_barrier(jnp.stack(words, axis=-1))


def _seed(seed):
    """Return the key data of a seed."""
    return jax.random.key_data(jax.random.key(seed, impl="threefry2x32"))


def _split(key, shape):
    """Split a key into keys of this shape."""
    return _keys_of(threefry(key, _counts(shape)))


def _fold_in(key, number):
    """Derive a key from a key and a number."""
    return _keys_of(threefry(key, (jnp.zeros((), np.uint32), number.astype(np.uint32))))


def _random_bits(key, width, shape):
    """Draw random bits of this width and shape."""
    if math.prod(shape) == 1:
        # An unrolled single number would be recomputed in each iteration of the loop that reads
        # it, and LLVM (JAX 0.10.2) may take minutes for a loop body of this length.
        jax_key = jax.random.wrap_key_data(key, impl="threefry2x32")
        return jax.random.bits(jax_key, shape, f"uint{width}")
    high, low = threefry(key, _counts(shape))
    if width == 64:
        return high.astype(np.uint64) << np.uint64(32) | low.astype(np.uint64)
    return (high ^ low).astype(f"uint{width}")


_UNROLLED = define_prng_impl(
    key_shape=(2,),
    seed=_seed,
    split=_split,
    random_bits=_random_bits,
    fold_in=_fold_in,
    name="threefry2x32, written out",
    tag="frw",
)


def with_unrolled_keys(tree: PyTree) -> PyTree:
    """Replace JAX's own threefry keys in the tree by keys of the unrolled generator."""
    return jax.tree.map(_unrolled, tree)


def with_plain_key(key: Key[Array, ""]) -> Key[Array, ""]:
    """Return a key of JAX's own generator in place of one of the unrolled generator.

    Some functions of `jax.random`, such as `poisson`, refuse all other generators.
    """
    if key.dtype != _unrolled(jax.random.key(0, impl="threefry2x32")).dtype:
        return key
    return jax.random.wrap_key_data(jax.random.key_data(key), impl="threefry2x32")


def _unrolled(leaf):
    """Convert one leaf; other leaves than threefry keys stay as they are."""
    if not (isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)):
        return leaf
    # The counts above are those of JAX's partitionable threefry only.
    partitionable = jax.config.jax_threefry_partitionable  # pyright: ignore[reportAttributeAccessIssue]
    if jax.random.key_impl(leaf) != "threefry2x32" or not partitionable:
        return leaf
    return jax.random.wrap_key_data(jax.random.key_data(leaf), impl=_UNROLLED)
