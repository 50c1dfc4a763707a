"""Conversion of arrays over the steps of a record between axes (K, N) and a single axis."""

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .observations import Scalars


def flat(tree: PyTree) -> PyTree:
    """Merge the first two axes, (K, N) of segments and their steps, into one axis of K N steps."""
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), tree)


def at_every_step(scalars: Scalars, num_steps: int) -> Scalars:
    """Return the observations at the ends of segments as observations at the ends of all steps.

    All but the last step of a segment have a missing observation. A loop over all steps then needs
    no second body for the last step of a segment.
    """

    def spread(leaf, missing):
        between = jnp.full((leaf.shape[0], num_steps - 1, *leaf.shape[1:]), missing, leaf.dtype)
        return jnp.concatenate([between, leaf[:, None]], axis=1)

    # Missing scalars have row 0, value 0 and variance 1.
    return flat(Scalars(*map(spread, scalars, (0, 0, 1, False))))


def following(tree: PyTree) -> PyTree:
    """Return quantities of the ends of steps, from those of their beginnings with axes (K, N).

    The last entry is zero.
    """

    def shifted(leaf):
        steps = flat(leaf)
        # h = 1 at the end of the record, so r = 0 and H = 0.
        return jnp.concatenate([steps[1:], jnp.zeros_like(steps[:1])]).reshape(leaf.shape)

    return jax.tree.map(shifted, tree)


def split_last(tree: PyTree) -> tuple[PyTree, PyTree]:
    """Split arrays along the first axis into all but the last entry, and the last entry."""
    return jax.tree.map(lambda leaf: leaf[:-1], tree), jax.tree.map(lambda leaf: leaf[-1], tree)


def split_first(tree: PyTree) -> tuple[PyTree, PyTree]:
    """Split arrays along the first axis into the first entry, and all other entries."""
    return jax.tree.map(lambda leaf: leaf[0], tree), jax.tree.map(lambda leaf: leaf[1:], tree)
