"""A start law for models without a sampler of ν: a smoothed sample from ν.

A fresh draw of ν for each trial would take a run of many relaxation times. Weights correct for any
start law μ with a density (`start_laws`), so M runs suffice. Their end points x_j give

    μ(x) = λ E(x) + (1 - λ) M⁻¹ Σ_j Π_k K((x_k - x_jk) / h_k) / h_k,    K(u) = (1 - |u|)⁺.

- E has elliptical contours and the mean and covariance of the x_j: E ∝ (1 - |L⁻¹(x - m)|²/ρ²)^α
    where this is positive. It is close to a normal law, and is useful in many dimensions, where
    kernels are far apart.
- The kernels are useful for laws with several modes.
- λ and the widths h maximise, over a few candidates, the effective share of weights μ/ν under ν:

    (∫ μ)² / ∫ μ²/ν.

Both integrals use draws of μ. Draws of ν are unsuitable: if ν falls off faster than μ, the large
weights are rare in a sample from ν.

Draws of μ are cheap, and results are exact even if the runs are not yet stationary. The length of
the runs decides only how close μ is to ν, and so the number of trials of a bridge.

μ has bounded support, so ∫ μ²/ν is finite however fast ν falls off. Proposals whose x_0 is outside
the support have weight zero. Their bridges arise from other proposals, with x_0 inside.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln, logsumexp
from jaxtyping import Array, Float, Key

from ..engine.linalg import any_cholesky, dot, is_finite, solve_lower
from ..models.diffusion import Diffusion

NUM_DRAWS = 512
# The variance of K, and the exponent α of E.
_VARIANCE, _POWER = 1 / 6, 8
# Candidates: λ, and a factor of the kernel widths of Scott's rule.
_CANDIDATES = (1.0, 1.0), (0.5, 1.0), (0.5, 0.5), (0.0, 1.0), (0.0, 0.7), (0.0, 0.5), (0.0, 0.35)


class SmoothedDraws(eqx.Module):
    """Start law μ of smoothed draws.

    - `points`: the draws x_j, shape (M, d).
    - `widths`: h, shape (d,).
    - `mean`: m, shape (d,).
    - `root`: L, shape (d, d).
    - `share`: λ, shape ().
    """

    points: Float[Array, "M d"]
    widths: Float[Array, " d"]
    mean: Float[Array, " d"]
    root: Float[Array, "d d"]
    share: Float[Array, ""]

    def sample(self, key: Key[Array, ""], model: Diffusion) -> Float[Array, " d"]:
        """Sample from μ: from E with probability λ, else from one of the kernels."""
        keys, (d,), dtype = jax.random.split(key, 4), self.mean.shape, self.mean.dtype
        point = self.points[jax.random.randint(keys[0], (), 0, len(self.points))]
        first, second = jax.random.uniform(keys[1], (2, d), dtype)
        # E is the law of d coordinates of a uniform point on a sphere in d + 2α + 2 dimensions.
        normal = jax.random.normal(keys[2], (d + 2 * _POWER + 2,), dtype)
        inside = _radius(d) * normal[:d] / jnp.linalg.norm(normal)
        # Both draws are computed; a uniform number selects one of them.
        elliptical = jax.random.uniform(keys[3], dtype=dtype) < self.share
        # The difference of two uniform numbers has the triangular density K.
        kernel = point + self.widths * (first - second)
        return jnp.where(elliptical, self.mean + self.root @ inside, kernel)

    def log_density(self, x: Float[Array, " d"]) -> Float[Array, ""]:
        """Return log μ(x), shape (); -inf outside the support."""
        triangles = jnp.maximum(1 - jnp.abs((x - self.points) / self.widths), 0)
        kernels = _log(jnp.mean(jnp.prod(triangles, axis=1))) - jnp.sum(jnp.log(self.widths))
        white, d = solve_lower(self.root, x - self.mean), x.shape[0]
        base = jnp.maximum(1 - dot(white, white) / _radius(d) ** 2, 0)
        # E is normalised by the integral of (1 - |y|²)^α over the unit ball, times ρ^d det L.
        log_constant = gammaln(d / 2 + _POWER + 1) - gammaln(_POWER + 1) - d * math.log(_radius(d))
        log_constant -= d / 2 * math.log(math.pi) + jnp.sum(jnp.log(jnp.diagonal(self.root)))
        elliptical = _POWER * _log(base) + log_constant
        # The density of the mixture, on the log scale.
        shares = _log(1 - self.share), _log(self.share)
        return jnp.logaddexp(shares[0] + kernels, shares[1] + elliptical)


def smoothed_draws(
    key: Key[Array, ""],
    draws: Float[Array, "M d"],
    otherwise: Float[Array, " d"],
    model: Diffusion,
) -> SmoothedDraws:
    """Return the start law of these draws of ν, with the best of the candidate λ and widths.

    The finite point `otherwise` replaces draws that are not finite.
    """
    finite = jnp.all(is_finite(draws), axis=1, keepdims=True)
    fit = _fit(jnp.where(finite, draws, otherwise))

    def candidate_law(share, scale):
        smoother = eqx.tree_at(lambda law: law.widths, fit, scale * fit.widths)
        return eqx.tree_at(lambda law: law.share, smoother, share)

    shares, scales = np.array(_CANDIDATES).T.astype(fit.mean.dtype)
    efficiency = lambda share, scale: _log_efficiency(key, candidate_law(share, scale), model)
    # The same key for all candidates reduces the noise of their comparison.
    best = jnp.argmax(jax.vmap(efficiency)(jnp.asarray(shares), jnp.asarray(scales)))
    return candidate_law(jnp.asarray(shares)[best], jnp.asarray(scales)[best])


def _log_efficiency(key: Key[Array, ""], law: SmoothedDraws, model: Diffusion) -> Float[Array, ""]:
    """Estimate the log of (∫ μ)² / ∫ μ²/ν, where both integrals are over the set ν > 0."""
    x = jax.vmap(lambda key: law.sample(key, model))(jax.random.split(key, NUM_DRAWS))
    log_ratio = jax.vmap(law.log_density)(x) - jax.vmap(lambda x: model.log_stationary(x))(x)
    # Both integrals are over the set ν > 0, where the weight μ/ν is finite.
    inside = jnp.isfinite(log_ratio)

    def log_sum(values):
        return logsumexp(jnp.where(inside, values, -jnp.inf))

    log_efficiency = (
        2 * log_sum(jnp.zeros_like(log_ratio)) - log_sum(log_ratio) - log_sum(-log_ratio)
    )
    return jnp.where(jnp.any(inside), log_efficiency, -jnp.inf)


def _fit(points: Float[Array, "M d"]) -> SmoothedDraws:
    """Fit mean and covariance to the points, and kernel widths by Scott's rule; λ = 0."""
    num, d = points.shape
    mean, spread = jnp.mean(points, axis=0), jnp.std(points, axis=0)
    # A lower bound on the spread: without it equal points would have no density.
    least = 1e-3 * jnp.max(spread) + 1e-6 * jnp.max(jnp.abs(points))
    spread = jnp.maximum(spread, jnp.where(least > 0, least, 1))
    white = (points - mean) / spread
    # The small multiple of I keeps the factorisation stable.
    correlation = white.T @ white / num + 1e-4 * jnp.eye(d, dtype=points.dtype)
    root = spread[:, None] * any_cholesky(correlation)
    widths = spread * num ** (-1 / (d + 4)) / math.sqrt(_VARIANCE)
    return SmoothedDraws(points, widths, mean, root, jnp.zeros((), points.dtype))


def _radius(d: int) -> float:
    """Return ρ, the radius for which the covariance of E is L Lᵀ."""
    return math.sqrt(d + 2 * _POWER + 2)


def _log(x: Float[Array, ""]) -> Float[Array, ""]:
    """Return log x, or -inf for x ≤ 0, with finite derivatives."""
    return jnp.where(x > 0, jnp.log(jnp.where(x > 0, x, 1)), -jnp.inf)
