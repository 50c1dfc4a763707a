"""Systematic resampling: one uniform number selects all particles (Kitagawa 1996)."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def systematic(uniform: Float[Array, ""], weights: Float[Array, " P"]) -> Int[Array, " P"]:
    """Return P particles, in order, each on average as often as its share of the weights says.

    `uniform` is a uniform number in [0, 1).
    """
    P, dtype = len(weights), weights.dtype
    positions = (uniform + jnp.arange(P, dtype=dtype)) / P
    bounds = jnp.cumsum(weights)
    bounds = bounds / jnp.maximum(bounds[-1], jnp.finfo(dtype).tiny)
    return jnp.minimum(jnp.searchsorted(bounds, positions), P - 1)
