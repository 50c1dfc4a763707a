"""Normal random walks of θ, with a covariance S Sᵀ that the warm-up adapts (Vihola 2012):

    S Sᵀ ← e^{2 κ_i (α_i - α*)} S [I + η_i (α_i - α*) ξ ξᵀ / |ξ|²] Sᵀ,

from the acceptance rates α_i of moves S ξ. The first factor, with κ_i = 6 / (i + 5), adapts the
size of the moves in tens of iterations; the second factor alone needs hundreds. κ follows
Garthwaite, Fan & Sisson (2016): 1 / (α* (1 - α*)) divided by i.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..engine.checks import Numbers, as_floating, is_traced
from ..engine.linalg import any_cholesky, any_inverse
from .priors import GivenDensity, NormalDensity

# Acceptance rates that random walks are tuned to; less than without noise in the likelihood.
_TARGET = 0.2


def first_root(
    covariance: Numbers | None,
    log_prior: NormalDensity | GivenDensity,
    theta: Float[Array, " p"],
) -> Float[Array, "p p"]:
    """S of the first moves: of the given covariance, or a tenth of what the prior or θ spans."""
    p = theta.shape[0]
    if covariance is not None:
        matrix = as_floating("covariance", covariance).astype(theta.dtype)
        if matrix.shape not in ((p,), (p, p)):
            raise ValueError(
                f"`covariance` must have shape ({p},) or ({p}, {p}); got shape {matrix.shape}."
            )
        matrix = jnp.diag(matrix) if matrix.ndim == 1 else matrix
        if not is_traced(matrix):
            known = np.asarray(matrix, float)
            symmetric = np.allclose(known, known.T, rtol=1e-5)
            if not (np.all(np.isfinite(known)) and symmetric and np.linalg.eigvalsh(known)[0] > 0):
                raise ValueError(
                    "`covariance` must be finite, symmetric and positive definite; got "
                    f"{covariance}."
                )
        return any_cholesky(matrix)
    if isinstance(log_prior, NormalDensity):
        variance = any_inverse(log_prior.precision)
        return 0.1 * jnp.diag(jnp.sqrt(jnp.diagonal(variance)))
    return 0.1 * jnp.diag(jnp.maximum(jnp.abs(theta), 0.1))


def learnt(
    root: Float[Array, "p p"],
    noise: Float[Array, " p"],
    rate: Float[Array, ""],
    number: Int[Array, ""],
    learning: Bool[Array, ""],
) -> Float[Array, "p p"]:
    """S after a move with this noise, accepted with probability `rate` (none where that is NaN), in
    the iteration of this number, from one on; as it was unless the chain is still learning."""
    gain = jnp.minimum(1.0, len(noise) * number.astype(root.dtype) ** (-2 / 3))
    excess = jnp.where(jnp.isnan(rate), 0, rate) - _TARGET
    moved = root @ (noise / jnp.maximum(jnp.linalg.norm(noise), 1e-6))
    new = any_cholesky(root @ root.T + gain * excess * jnp.outer(moved, moved))
    new = new * jnp.exp(6 / (number.astype(root.dtype) + 5) * excess)
    return jnp.where(learning & jnp.all(jnp.isfinite(new)), new, root)
