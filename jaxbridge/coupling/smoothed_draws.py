"""A start law for models without a sampler of ν: draws of ν, smoothed.

To draw from ν afresh for every trial takes a run of many relaxation times each. But any law μ with
a density serves if it is paid for (`start_laws`), so M runs are enough. Their ends x_j make

    μ(x) = λ E(x) + (1 - λ) M⁻¹ Σ_j Π_k K((x_k - x_jk) / h_k) / h_k,    K(u) = (1 - |u|)⁺,

where E has their mean and covariance and elliptical contours, E ∝ (1 - |L⁻¹(x - m)|²/ρ²)^α: near a
normal law, which serves in many dimensions, where kernels are far between; these serve where there
is more than one mode. λ and the widths of the kernels are those of a few with the largest effective
share of weights μ/ν under ν,

    (∫ μ)² / ∫ μ²/ν,

both integrals by draws of μ. Draws of ν would not do: where ν falls off fast and μ does not the
weights are large, and seldom seen.

Draws of μ cost nothing, and what rests on it is exact whether or not the runs have forgotten where
they started: that decides how near μ is to ν, and so how many trials a bridge takes. It ends
abruptly, so that ∫ μ²/ν is finite however fast ν falls off. Proposals whose x_0 is beyond it have
weight zero; bridges that they would have made are made from elsewhere.
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
# The variance of K, and α.
_VARIANCE, _POWER = 1 / 6, 8
# λ, and the widths of kernels beside those of Scott's rule.
_CANDIDATES = (1.0, 1.0), (0.5, 1.0), (0.5, 0.5), (0.0, 1.0), (0.0, 0.7), (0.0, 0.5), (0.0, 0.35)


class SmoothedDraws(eqx.Module):
    """μ, from its `points` x_j, shape (M, d), `widths` h, `mean` m, shapes (d,), `root` L, shape
    (d, d), and the `share` λ."""

    points: Float[Array, "M d"]
    widths: Float[Array, " d"]
    mean: Float[Array, " d"]
    root: Float[Array, "d d"]
    share: Float[Array, ""]

    def sample(self, key: Key[Array, ""], model: Diffusion) -> Float[Array, " d"]:
        """A draw of E or of one of the kernels."""
        keys, (d,), dtype = jax.random.split(key, 4), self.mean.shape, self.mean.dtype
        point = self.points[jax.random.randint(keys[0], (), 0, len(self.points))]
        first, second = jax.random.uniform(keys[1], (2, d), dtype)
        # Of a uniform point on a sphere in d + 2α + 2 dimensions d coordinates have the law E.
        normal = jax.random.normal(keys[2], (d + 2 * _POWER + 2,), dtype)
        inside = _radius(d) * normal[:d] / jnp.linalg.norm(normal)
        elliptical = jax.random.uniform(keys[3], dtype=dtype) < self.share
        kernel = point + self.widths * (first - second)
        return jnp.where(elliptical, self.mean + self.root @ inside, kernel)

    def log_density(self, x: Float[Array, " d"]) -> Float[Array, ""]:
        """log μ(x), -inf beyond all of it."""
        near = jnp.maximum(1 - jnp.abs((x - self.points) / self.widths), 0)
        kernels = _log(jnp.mean(jnp.prod(near, axis=1))) - jnp.sum(jnp.log(self.widths))
        white, d = solve_lower(self.root, x - self.mean), x.shape[0]
        left = jnp.maximum(1 - dot(white, white) / _radius(d) ** 2, 0)
        size = gammaln(d / 2 + _POWER + 1) - gammaln(_POWER + 1) - d * math.log(_radius(d))
        size -= d / 2 * math.log(math.pi) + jnp.sum(jnp.log(jnp.diagonal(self.root)))
        elliptical = _POWER * _log(left) + size
        shares = _log(1 - self.share), _log(self.share)
        return jnp.logaddexp(shares[0] + kernels, shares[1] + elliptical)


def smoothed_draws(
    key: Key[Array, ""],
    draws: Float[Array, "M d"],
    otherwise: Float[Array, " d"],
    model: Diffusion,
) -> SmoothedDraws:
    """The law of these draws of ν; those that are not finite give way to a point that is."""
    finite = jnp.all(is_finite(draws), axis=1, keepdims=True)
    fit = _fit(jnp.where(finite, draws, otherwise))

    def law_of(share, scale):
        smoother = eqx.tree_at(lambda law: law.widths, fit, scale * fit.widths)
        return eqx.tree_at(lambda law: law.share, smoother, share)

    shares, scales = np.array(_CANDIDATES).T.astype(fit.mean.dtype)
    efficiency = lambda share, scale: _log_efficiency(key, law_of(share, scale), model)
    best = jnp.argmax(jax.vmap(efficiency)(jnp.asarray(shares), jnp.asarray(scales)))
    return law_of(jnp.asarray(shares)[best], jnp.asarray(scales)[best])


def _log_efficiency(key: Key[Array, ""], law: SmoothedDraws, model: Diffusion) -> Float[Array, ""]:
    """log of (∫ μ)² / ∫ μ²/ν, over where ν > 0."""
    x = jax.vmap(lambda key: law.sample(key, model))(jax.random.split(key, NUM_DRAWS))
    log_ratio = jax.vmap(law.log_density)(x) - jax.vmap(lambda x: model.log_stationary(x))(x)
    inside = jnp.isfinite(log_ratio)

    def log_sum(values):
        return logsumexp(jnp.where(inside, values, -jnp.inf))

    found = 2 * log_sum(jnp.zeros_like(log_ratio)) - log_sum(log_ratio) - log_sum(-log_ratio)
    return jnp.where(jnp.any(inside), found, -jnp.inf)


def _fit(points: Float[Array, "M d"]) -> SmoothedDraws:
    """Mean and covariance, and Scott's rule for the widths."""
    num, d = points.shape
    mean, spread = jnp.mean(points, axis=0), jnp.std(points, axis=0)
    # If all are one point that is no law.
    spread = jnp.maximum(spread, 1e-3 * jnp.max(spread) + 1e-6 * (1 + jnp.max(jnp.abs(points))))
    white = (points - mean) / spread
    correlation = white.T @ white / num + 1e-4 * jnp.eye(d, dtype=points.dtype)
    root = spread[:, None] * any_cholesky(correlation)
    widths = spread * num ** (-1 / (d + 4)) / math.sqrt(_VARIANCE)
    return SmoothedDraws(points, widths, mean, root, jnp.zeros((), points.dtype))


def _radius(d: int) -> float:
    """ρ, with which the covariance of E is L Lᵀ."""
    return math.sqrt(d + 2 * _POWER + 2)


def _log(x: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(x > 0, jnp.log(jnp.where(x > 0, x, 1)), -jnp.inf)
