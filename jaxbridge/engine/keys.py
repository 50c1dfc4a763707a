"""The tree of keys: what random numbers depend on, and so what they do not depend on.

    key
    ├─ interval i                       numbered(key, I)
    │  └─ attempt j                     numbered_keys(keys, i, j)
    │     ├─ reversed path | driven path | coupling         of a proposal, split_each(keys, 3)
    │     │  └─ chunk c of steps        folded(keys, c), where there is more than one
    │     │     └─ normal and uniform numbers, of one draw
    │     └─ start | path | coupling    of an associated path, split_each(keys, 3)
    │        └─ ...
    └─ purpose                          key_for("burn-in", key)

So a path is a function of its interval and its number: of no neighbour, no batch and no device.
Methods that weigh or step have a split of the interval's key in the place of j.
"""

import zlib

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key


def key_for(purpose: str, key: Key[Array, ""]) -> Key[Array, ""]:
    """A key that no numbering leads to, so that a caller may use one key for several calls on the
    same bridges."""
    return jax.random.fold_in(key, zlib.crc32(purpose.encode()))


def numbered(key: Key[Array, ""], num: int) -> Key[Array, " num"]:
    """The keys of the first `num` of anything."""
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(num))


def numbered_keys(
    keys: Key[Array, " P"], problem: Int[Array, " lanes"], number: Int[Array, " lanes"]
) -> Key[Array, " lanes"]:
    """The key of each attempt, from that of its problem."""
    return jax.vmap(jax.random.fold_in)(keys[problem], number)


def folded(keys: Key[Array, " lanes"], number: int | Int[Array, ""]) -> Key[Array, " lanes"]:
    """The keys of what has this number in all lanes."""
    return jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, number)


def split_each(keys: Key[Array, " lanes"], num: int) -> Key[Array, "num lanes"]:
    """Each key split in `num`, which come first."""
    return jax.vmap(lambda key: jax.random.split(key, num), out_axes=1)(keys)
