"""The tree of random keys: it defines the inputs of each random number.

```text
key
├─ interval i                       first_keys(key, I)
│  └─ attempt j                     attempt_keys(keys, i, j)
│     ├─ reversed path | driven path | coupling         of a proposal, split_each(keys, 3)
│     │  └─ chunk c of steps        fold_in_each(keys, c), if there are several chunks
│     │     └─ normal and uniform numbers, of one draw
│     └─ start | path | coupling    of an associated path, split_each(keys, 3)
│        └─ ...
└─ purpose                          key_for("burn-in", key)
```

A path is therefore a function of its interval and its number. It does not depend on other paths, on
the batch or on the device. Methods that weigh or step use a split of the interval's key in place of
attempt j.
"""

import zlib

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key


def key_for(purpose: str, key: Key[Array, ""]) -> Key[Array, ""]:
    """Derive a key for a purpose, apart from the numbered keys.

    A caller may therefore use one key for several calls on the same bridges.
    """
    # A checksum is the same in every process; Python's `hash` of a string is not.
    return jax.random.fold_in(key, zlib.crc32(purpose.encode()))


def first_keys(key: Key[Array, ""], num: int) -> Key[Array, " num"]:
    """Derive the keys with numbers 0, ..., `num` - 1."""
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(num))


def attempt_keys(
    keys: Key[Array, " P"], problem: Int[Array, " lanes"], number: Int[Array, " lanes"]
) -> Key[Array, " lanes"]:
    """Derive the key of each attempt from the key of its problem and its number."""
    return jax.vmap(jax.random.fold_in)(keys[problem], number)


def fold_in_each(keys: Key[Array, " lanes"], number: int | Int[Array, ""]) -> Key[Array, " lanes"]:
    """Fold one number into the key of each lane."""
    return jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, number)


def split_each(keys: Key[Array, " lanes"], num: int) -> Key[Array, "num lanes"]:
    """Split each key into `num` keys, which are the first axis of the result."""
    return jax.vmap(lambda key: jax.random.split(key, num), out_axes=1)(keys)
