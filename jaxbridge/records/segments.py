"""Conversion of arrays over the steps of a record between axes (K, N) and a single axis."""

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .observation import Scalars


def flat(tree: PyTree) -> PyTree:
    """With one axis of steps in the place of those of segments and their steps."""
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), tree)


def at_every_step(scalars: Scalars, num_steps: int) -> Scalars:
    """What is seen at the ends of segments, as what is seen at the ends of all steps: nothing at
    most of them. For loops that would else have a second body for the last step of a segment."""

    def spread(leaf, nothing):
        between = jnp.full((leaf.shape[0], num_steps - 1, *leaf.shape[1:]), nothing, leaf.dtype)
        return jnp.concatenate([between, leaf[:, None]], axis=1)

    return flat(Scalars(*map(spread, scalars, (0, 0, 1, False))))


def following(tree: PyTree) -> PyTree:
    """What belongs to the beginnings of steps, axes (K, N), at their ends: zero at the last."""

    def shifted(leaf):
        steps = flat(leaf)
        return jnp.concatenate([steps[1:], jnp.zeros_like(steps[:1])]).reshape(leaf.shape)

    return jax.tree.map(shifted, tree)


def split_last(tree: PyTree) -> tuple[PyTree, PyTree]:
    """All but the last, and the last, along the first axis."""
    return jax.tree.map(lambda leaf: leaf[:-1], tree), jax.tree.map(lambda leaf: leaf[-1], tree)


def split_first(tree: PyTree) -> tuple[PyTree, PyTree]:
    """The first, and all others, along the first axis."""
    return jax.tree.map(lambda leaf: leaf[0], tree), jax.tree.map(lambda leaf: leaf[1:], tree)
