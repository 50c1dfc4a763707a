"""Diagnostics of Markov chains: effective sample sizes and potential scale reduction."""

import math
import reprlib

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaincc
from jaxtyping import Array, Bool, Float

from .checks import Numbers, as_floating
from .compiled import compiled_sooner
from .entry import public_entry

# A spread of at most so many units in the last place is rounding error.
_ROUNDING = 64.0
# Number of draws without which the halves of a chain have no variance.
_FEWEST = 4


def vary(draws: Float[Array, "..."], axis: int | tuple[int, ...]) -> Bool[Array, "..."]:
    """Return whether draws differ, along these axes, by more than rounding errors."""
    spread, size = jnp.std(draws, axis=axis), jnp.max(jnp.abs(draws), axis=axis)
    return spread > _ROUNDING * float(jnp.finfo(draws.dtype).eps) * size


@compiled_sooner
def p_uniform(uniforms: Float[Array, "n m"]) -> Float[Array, " m"]:
    """Return the p-value of Neyman's smooth test (1937) that each column is uniform on (0, 1).

    It compares four moments, those of the first Legendre polynomials. NaN entries are left out.
    """
    exist, u = ~jnp.isnan(uniforms), 2 * uniforms - 1
    legendre = (u, (3 * u**2 - 1) / 2, (5 * u**3 - 3 * u) / 2, (35 * u**4 - 30 * u**2 + 3) / 8)
    number = jnp.sum(exist, axis=0).astype(u.dtype)
    # P_j has the variance 1 / (2 j + 1) under the uniform law.
    statistic = sum(
        (2 * j + 1) * jnp.sum(jnp.where(exist, P, 0), axis=0) ** 2 / number
        for j, P in enumerate(legendre, start=1)
    )
    return gammaincc(jnp.full_like(number, 2.0), statistic / 2)


@public_entry
def effective_sample_size(draws: Numbers, *, chains: bool = False) -> Float[Array, "..."]:
    """Estimate the effective sample size of one chain, n / (1 + 2 Σ_t ρ_t), or of several.

    Autocorrelations ρ_t of adjacent lags are summed in pairs. The estimate uses the pairs before
    the first sum that is not positive, with the sums made non-increasing (Geyer 1992). The result
    is NaN where a draw is not finite, 1 for a constant chain, and at most n log₁₀ n.

    With `chains=True` the result is that of all chains together. Correlations are then relative to
    the variance of all draws (Vehtari et al. 2021), so chains that disagree have a small effective
    sample size. Neither a sum over the chains nor one long chain of all draws shows this.

    **Example:**

    ```python
    draws = jax.random.normal(key, (1000, 2))  # such as `chain.paths[:, 25]`
    jb.effective_sample_size(draws)  # shape (2,)
    ```

    **Arguments:**

    - `draws`: one chain of at least 4 draws, shape (n, ...), or several, shape (chains, n, ...).
    - `chains`: whether the first axis is that of several chains, as in `potential_scale_reduction`.

    **Returns:** effective sample sizes, shape (...).

    **Raises:** `ValueError` for fewer than 4 draws in a chain; `TypeError` for draws that are not
    real numbers, or unless `chains` is true or false.
    """
    if not isinstance(chains, bool):
        raise TypeError(f"`chains` must be `True` or `False`; got {reprlib.repr(chains)}.")
    if chains:
        return effective_size_of_chains(_as_chains(draws))
    draws = as_floating("draws", draws)
    if draws.ndim == 0 or draws.shape[0] < 4:
        raise ValueError(
            f"`draws` must be a chain of at least 4 draws, shape (n, ...); got shape {draws.shape}."
        )
    return _effective_sample_size(draws)


@jax.jit
def _effective_sample_size(draws):
    n = draws.shape[0]
    covariance = _autocovariance(draws)
    varies = vary(draws, 0)
    size = n / _correlation_time(covariance / jnp.where(varies, covariance[0], 1))
    # Antithetic chains can exceed n, but the excess is poorly determined: bound it.
    size = jnp.where(varies, jnp.minimum(size, n * math.log10(n)), 1)
    return jnp.where(jnp.isfinite(covariance[0]), size, jnp.nan)


@jax.jit
def effective_size_of_chains(draws: Float[Array, "chains n ..."]) -> Float[Array, "..."]:
    """Estimate the joint effective sample size of several chains.

    Correlations are relative to the variance of all draws (Vehtari, Gelman, Simpson, Carpenter &
    Bürkner 2021):

        ρ_t = 1 - (W - mean of the chains' autocovariances at t) / V,   V = (n - 1)/n W + B.

    W is the variance within chains and B the variance of their means. Chains that disagree
    therefore have a small effective sample size, however long they are. For a single chain, the
    result is that of `effective_sample_size`. Chains of fewer than 4 draws count as one draw each.
    """
    num_chains, n = draws.shape[:2]
    if n < _FEWEST:
        return jnp.full(draws.shape[2:], num_chains, draws.dtype)
    if num_chains == 1:
        return effective_sample_size(draws[0])
    covariance = jnp.mean(jax.vmap(_autocovariance)(draws), axis=0) / (n - 1)
    within = covariance[0]
    overall = within * ((n - 1) / n) + jnp.var(jnp.mean(draws, axis=1), axis=0, ddof=1)
    varies = vary(draws, (0, 1))
    correlation = 1 - (within - covariance) / jnp.where(varies, overall, 1)
    total = num_chains * n
    size = total / _correlation_time(correlation.at[0].set(1))
    size = jnp.where(varies, jnp.minimum(size, total * math.log10(total)), num_chains)
    return jnp.where(jnp.isfinite(overall), size, jnp.nan)


def _autocovariance(draws: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Compute n times the autocovariance of one chain, for all lags."""
    n = draws.shape[0]
    centred = draws - jnp.mean(draws, axis=0)
    # Padding to length 2n turns the circular convolution into a linear one.
    spectrum = jnp.fft.rfft(centred, 2 * n, axis=0)
    return jnp.fft.irfft(jnp.abs(spectrum) ** 2, 2 * n, axis=0)[:n]


def _correlation_time(correlation: Float[Array, "n ..."]) -> Float[Array, "..."]:
    """Estimate 1 + 2 Σ_t ρ_t by Geyer's initial monotone sequence."""
    n = correlation.shape[0]
    pairs = correlation[: n // 2 * 2].reshape(n // 2, 2, *correlation.shape[1:]).sum(1)
    # Sums of adjacent pairs of a reversible chain are positive and decrease; noise hides that.
    positive = jnp.cumprod(pairs > 0, axis=0)
    pairs = jax.lax.cummin(jnp.where(positive, pairs, 0), axis=0)
    return jnp.maximum(2 * jnp.sum(pairs, axis=0) - 1, 1 / n)


@public_entry
def potential_scale_reduction(draws: Numbers) -> Float[Array, "..."]:
    """Compute R̂ from the halves of one or several chains (split version of Gelman & Rubin 1992).

    It is close to one if the halves agree. It is NaN if all draws are equal up to
    rounding.

    **Example:**

    ```python
    draws = jax.random.normal(key, (4, 1000, 2))  # such as `theta` of a posterior with four chains
    jb.potential_scale_reduction(draws)  # shape (2,)
    ```

    **Arguments:** `draws`: shape (chains, n, ...), with n ≥ 4.

    **Returns:** R̂, shape (...).

    **Raises:** `ValueError` for fewer than 4 draws in each chain.
    """
    return r_hat_of_chains(_as_chains(draws))


@jax.jit
def r_hat_of_chains(draws: Float[Array, "chains n ..."]) -> Float[Array, "..."]:
    """Compute R̂, which is NaN for chains of fewer than 4 draws."""
    if draws.shape[1] < _FEWEST:
        return jnp.full(draws.shape[2:], jnp.nan, draws.dtype)
    n = draws.shape[1] // 2
    halves = jnp.concatenate([draws[:, :n], draws[:, -n:]])
    between = jnp.var(jnp.mean(halves, axis=1), axis=0, ddof=1)
    within = jnp.mean(jnp.var(halves, axis=1, ddof=1), axis=0)
    R_hat = jnp.sqrt((n - 1) / n + between / within)
    return jnp.where(vary(draws, (0, 1)), R_hat, jnp.nan)


def _as_chains(draws: Numbers) -> Float[Array, "chains n ..."]:
    """Convert draws of several chains to floating point numbers.

    **Raises:** `ValueError` for fewer than 4 draws in each chain.
    """
    draws = as_floating("draws", draws)
    if draws.ndim < 2 or draws.shape[0] < 1 or draws.shape[1] < _FEWEST:
        raise ValueError(
            "`draws` must be chains of at least 4 draws each, shape (chains, n, ...); got shape "
            f"{draws.shape}."
        )
    return draws
