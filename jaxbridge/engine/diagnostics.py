"""How good is a chain?"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .checks import Numbers, as_floating
from .doors import door


@door
def effective_sample_size(draws: Numbers) -> Float[Array, "..."]:
    """How many independent draws a chain is worth: n / (1 + 2 Σ_t ρ_t), with autocorrelations
    summed as far as sums of adjacent pairs are positive, and made to decrease (Geyer 1992). NaN
    where a draw is.

    `draws`: one chain, shape (n, ...), for instance `chain.paths[:, 25]`.

    **Example:**

    ```python
    draws = jax.random.normal(key, (1000, 2))  # as, of a chain, `chain.paths[:, 25]`
    jb.effective_sample_size(draws)  # shape (2,)
    ```
    """
    draws = as_floating("draws", draws)
    if draws.ndim == 0 or draws.shape[0] < 4:
        raise ValueError(
            f"`draws` must be a chain of at least 4, shape (n, ...); got {draws.shape}."
        )
    return _effective_sample_size(draws)


@jax.jit
def _effective_sample_size(draws):
    n = draws.shape[0]
    covariance = _autocovariance(draws)
    moving = covariance[0] > 0
    size = n / _correlation_time(covariance / jnp.where(moving, covariance[0], 1))
    # A chain that alternates can be worth more than n, but how much is not well determined.
    size = jnp.where(moving, jnp.minimum(size, n * math.log10(n)), 1)
    return jnp.where(jnp.isfinite(covariance[0]), size, jnp.nan)


@jax.jit
def effective_size_of_chains(draws: Float[Array, "chains n ..."]) -> Float[Array, "..."]:
    """How many independent draws several chains are worth together, with correlations relative to
    the variance of all draws,

        ρ_t = 1 - (W - mean of the chains' autocovariances at t) / V,   V = (n - 1)/n W + B,

    where W is the variance within chains and B that of their means (Vehtari, Gelman, Simpson,
    Carpenter & Bürkner 2021): chains that disagree are worth few draws, however many they have. Of
    a single chain as `effective_sample_size`."""
    num_chains, n = draws.shape[:2]
    if num_chains == 1:
        return effective_sample_size(draws[0])
    covariance = jnp.mean(jax.vmap(_autocovariance)(draws), axis=0) / (n - 1)
    within = covariance[0]
    overall = within * ((n - 1) / n) + jnp.var(jnp.mean(draws, axis=1), axis=0, ddof=1)
    moving = overall > 0
    correlation = 1 - (within - covariance) / jnp.where(moving, overall, 1)
    total = num_chains * n
    size = total / _correlation_time(correlation.at[0].set(1))
    size = jnp.where(moving, jnp.minimum(size, total * math.log10(total)), num_chains)
    return jnp.where(jnp.isfinite(overall), size, jnp.nan)


def _autocovariance(draws: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """n times that of one chain, for all lags."""
    n = draws.shape[0]
    centred = draws - jnp.mean(draws, axis=0)
    spectrum = jnp.fft.rfft(centred, 2 * n, axis=0)
    return jnp.fft.irfft(jnp.abs(spectrum) ** 2, 2 * n, axis=0)[:n]


def _correlation_time(correlation: Float[Array, "n ..."]) -> Float[Array, "..."]:
    """1 + 2 Σ_t ρ_t, summed as far as sums of adjacent pairs are positive, and made to decrease."""
    n = correlation.shape[0]
    pairs = correlation[: n // 2 * 2].reshape(n // 2, 2, *correlation.shape[1:]).sum(1)
    positive = jnp.cumprod(pairs > 0, axis=0)
    pairs = jax.lax.cummin(jnp.where(positive, pairs, 0), axis=0)
    return jnp.maximum(2 * jnp.sum(pairs, axis=0) - 1, 1 / n)


@door
def potential_scale_reduction(draws: Numbers) -> Float[Array, "..."]:
    """R̂ from the halves of several chains (Gelman & Rubin 1992, split): near one if they agree.

    `draws`: shape (chains, n, ...).

    **Example:**

    ```python
    draws = jax.random.normal(key, (4, 1000, 2))  # as `theta` of a posterior of four chains
    jb.potential_scale_reduction(draws)  # shape (2,)
    ```
    """
    draws = as_floating("draws", draws)
    if draws.ndim < 2 or draws.shape[1] < 4:
        raise ValueError(
            "`draws` must be chains of at least 4 draws each, shape (chains, n, ...); got "
            f"{draws.shape}."
        )
    return _potential_scale_reduction(draws)


@jax.jit
def _potential_scale_reduction(draws):
    n = draws.shape[1] // 2
    halves = jnp.concatenate([draws[:, :n], draws[:, -n:]])
    between = jnp.var(jnp.mean(halves, axis=1), axis=0, ddof=1)
    within = jnp.mean(jnp.var(halves, axis=1, ddof=1), axis=0)
    return jnp.sqrt((n - 1) / n + between / within)
