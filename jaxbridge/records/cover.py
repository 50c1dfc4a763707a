"""Mixture of normal laws that covers ν, for the initial state of a record if ν is not normal.

A single normal law may miss a mode of ν or have lighter tails. Then the importance ratio is
unbounded, and an estimate may be wrong with a small reported error. The mixture

    q(x) = ½ Σ_j w_j N(x; x_j, r_j² S) + ½ Σ_c N(x; m_c, S_c) / C

avoids both. The first part has kernels at draws x_j of ν with weights w_j; S is their covariance.
The width r_j of a kernel is the distance from x_j within which a sixteenth of the draws lie, in
units of √S, divided by √d. The second part has wide laws for the tails, up to eight times as wide
as ν. Given observations, and tilted by h, the law is a mixture again; its weights are multiplied by
the integrals. The importance ratio is ν/q.

The draws come from the model's sampler of ν. Without a sampler they start as points of a ladder
around the normal law in place of ν (`initial`), weighted by ν. Two rounds of draws from the
resulting mixture follow (population Monte Carlo; Cappé, Guillin, Marin & Robert 2004). Keys are
fixed, so q depends on parameters only. Results are exact for every q; only the effective sample
size depends on q.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float

from ..engine.averages import nan_to_neg_inf, normalise_weights
from ..engine.lanes import over_lanes
from ..engine.linalg import cholesky, is_finite, matmul, matvec, solve_lower
from ..models.diffusion import Diffusion
from .guided_steps import GuidedLaw, guided_start
from .initial import ladder, log_normal
from .observations import Scalars
from .tilted_step import Information, NormalStep

# Number of kernels, and of rounds of draws without a sampler.
_NUM_KERNELS, _NUM_ROUNDS = 256, 2
# Widths of the laws for the tails, relative to ν.
_WIDER = (1.0, 2.0, 4.0, 8.0)
# Share of all draws within the width of a kernel.
_NEAREST = 1 / 16


class Cover(NamedTuple):
    """Mixture of J normal laws."""

    log_shares: Float[Array, " J"]
    laws: NormalStep

    def log_density(self, x: Float[Array, " d"]) -> Float[Array, ""]:
        """Return log q(x)."""
        return logsumexp(self.log_shares + jax.vmap(lambda law: log_normal(law, x))(self.laws))

    def points(self, positions: Float[Array, " n"], zeta: Float[Array, "n d"]):
        """Sample points, from uniform positions and normal noise."""

        def one(j, zeta):
            return self.laws.mean[j] + matvec(self.laws.root[j], zeta)

        return jax.vmap(one)(chosen(self.log_shares, positions), zeta)

    def log_ratio(self, model: Diffusion, x: Float[Array, "d n"]) -> Float[Array, " n"]:
        """Return log ν - log q at each point, up to the constant of ν."""
        log_nu = model.prepared().log_stationary
        return over_lanes(-1)(lambda x: log_nu(x) - self.log_density(x))(x)


class CoveredStart(NamedTuple):
    """Laws of a cover, given the observation at t_0 and tilted by h_0, and their log shares."""

    laws: GuidedLaw
    log_shares: Float[Array, " J"]

    @property
    def log_integral(self) -> Float[Array, ""]:
        """Return the log of the integral of the cover times its tilt."""
        return logsumexp(self.log_shares)

    def points(
        self, positions: Float[Array, " n"], zeta: Float[Array, "d n"]
    ) -> Float[Array, "d n"]:
        """Sample x_0, from uniform positions and normal noise."""

        def one(j, zeta):
            law = jax.tree.map(lambda leaf: leaf[j], self.laws)
            return law.point_and_log_weight(zeta)[0]

        return jax.vmap(one, in_axes=(0, -1), out_axes=-1)(chosen(self.log_shares, positions), zeta)


def chosen(log_shares: Float[Array, " J"], positions: Float[Array, " n"]):
    """Return the index of the mixture component that each uniform number in `positions` selects.

    The cumulative shares are inverted.
    """
    bounds = jnp.cumsum(normalise_weights(nan_to_neg_inf(log_shares)))
    bounds = bounds / jnp.maximum(bounds[-1], jnp.finfo(bounds.dtype).tiny)
    return jnp.minimum(jnp.searchsorted(bounds, positions, side="right"), len(bounds) - 1)


def cover(model: Diffusion, normal: NormalStep) -> Cover:
    """Return the mixture q that covers ν; `normal` is the normal approximation of ν."""
    model, (d,), dtype = model.prepared(), normal.mean.shape, normal.mean.dtype
    keys = jax.random.split(jax.random.key(0), _NUM_ROUNDS + 1)
    # Fixed keys make the cover a function of the parameters only.
    equal_weights = jnp.zeros(_NUM_KERNELS, dtype)
    if model.has_sampler:
        keys = jax.random.split(keys[0], _NUM_KERNELS)
        return _fit_mixture(
            jax.vmap(model.sample_stationary)(keys).astype(dtype), equal_weights, normal
        )
    positions = (jnp.arange(_NUM_KERNELS, dtype=dtype) + 0.5) / _NUM_KERNELS
    points, log_weights = ladder(model, normal)
    law = _fit_mixture(points[chosen(log_weights, positions)], equal_weights, normal)
    for key in keys[1:]:
        points = law.points(positions, jax.random.normal(key, (_NUM_KERNELS, d), dtype))
        log_ratio = jax.vmap(lambda x, law=law: model.log_stationary(x) - law.log_density(x))
        law = _fit_mixture(points, nan_to_neg_inf(log_ratio(points)), normal)
    return law


def _fit_mixture(
    points: Float[Array, "M d"], log_weights: Float[Array, " M"], normal: NormalStep
) -> Cover:
    """Fit the mixture to weighted draws; draws that are not finite are left out."""
    (M, d), dtype = points.shape, points.dtype
    finite = jnp.all(is_finite(points), axis=1)
    points = jnp.where(finite[:, None], points, normal.mean)
    weights = normalise_weights(jnp.where(finite, log_weights, -jnp.inf))
    mean = weights @ points
    # A small part of the normal law's covariance, in case all draws are one point.
    S = (points - mean).T @ (weights[:, None] * (points - mean))
    root = cholesky(S + 1e-3 * matmul(normal.root, normal.root.T))
    usable = jnp.all(jnp.isfinite(root))
    root, mean = jnp.where(usable, root, normal.root), jnp.where(usable, mean, normal.mean)
    white = jax.vmap(lambda x: solve_lower(root, x - mean))(points)
    distance = jnp.sqrt(jnp.sum((white[:, None] - white) ** 2, axis=-1))
    order = jnp.argsort(distance, axis=1)
    near = jnp.cumsum(weights[order], axis=1) < _NEAREST
    reach = jnp.take_along_axis(distance, order, axis=1)
    reach = jnp.take_along_axis(reach, jnp.minimum(jnp.sum(near, axis=1), M - 1)[:, None], axis=1)
    # The distance in d dimensions grows like √d times the width.
    widths = jnp.maximum(reach[:, 0] / np.sqrt(d), 1e-3)
    wider = jnp.asarray(_WIDER, dtype)
    wide = jnp.concatenate([wider[:, None, None] * root, normal.root[None]])
    means = jnp.concatenate([jnp.broadcast_to(mean, (len(wider), d)), normal.mean[None]])
    kernels = NormalStep(points, widths[:, None, None] * root)
    laws = jax.tree.map(lambda *both: jnp.concatenate(both), kernels, NormalStep(means, wide))
    is_positive = weights > 0
    shares = jnp.where(is_positive, jnp.log(jnp.where(is_positive, weights, 1)), -jnp.inf)
    even = jnp.full(len(means), -np.log(len(means)), dtype)
    # Half of the mixture are kernels, and half wide laws.
    return Cover(jnp.concatenate([shares, even]) - np.log(2), laws)


def covered_start(
    law: Cover, scalars: Scalars, point: Float[Array, " d"], h: Information
) -> CoveredStart:
    """Return the cover given the observation at t_0, relative to the point, and tilted by h_0."""

    def one(part: NormalStep):
        tilted = guided_start(part, scalars, point, h)
        return tilted, tilted.log_integral

    laws, log_integrals = jax.vmap(one)(law.laws)
    return CoveredStart(laws, law.log_shares + log_integrals)
