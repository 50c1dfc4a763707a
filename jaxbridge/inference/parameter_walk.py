"""Normal random walks of θ with moves S ξ, ξ ~ N(0, I).

The warm-up adapts their covariance S Sᵀ (Vihola 2012):

    S Sᵀ ← e^{2 κ_i (α_i - α*)} S [I + η_i (α_i - α*) ξ ξᵀ / |ξ|²] Sᵀ,    η_i = min(1, p i^(-2/3)).

Here α_i is the acceptance probability of iteration i, and α* the target. The first factor, with
κ_i = 6 / (i + 5), adapts the size of the moves in tens of iterations. The second factor alone needs
hundreds. κ follows Garthwaite, Fan & Sisson (2016), who use 1 / (α* (1 - α*)) divided by i.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..engine.checks import Numbers, as_floating, is_positive_definite, is_traced
from ..engine.linalg import any_cholesky, any_inverse
from .priors import GivenDensity, NormalDensity

# Target acceptance rate of random walks. It is below that for exact likelihoods, as noise requires.
_TARGET = 0.2


def first_root(
    covariance: Numbers | None,
    log_prior: NormalDensity | GivenDensity,
    theta: Float[Array, " p"],
) -> Float[Array, "p p"]:
    """Return S of the first moves, from `covariance` if it is not `None`.

    By default S is diagonal: a tenth of the prior's standard deviations, or of |θ| if the prior is
    not normal, where |θ| counts as at least 0.1.

    **Raises:** `ValueError` unless `covariance` has a valid shape and is positive definite.
    """
    p = theta.shape[0]
    if covariance is not None:
        matrix = as_floating("covariance", covariance).astype(theta.dtype)
        if matrix.shape not in ((p,), (p, p)):
            raise ValueError(
                f"`covariance` must have shape ({p},) or ({p}, {p}); got shape {matrix.shape}."
            )
        matrix = jnp.diag(matrix) if matrix.ndim == 1 else matrix
        if not is_traced(matrix):
            array = np.asarray(matrix, float)
            if not is_positive_definite(array):
                raise ValueError(
                    "`covariance` must be finite, symmetric and positive definite; got "
                    f"{covariance}."
                )
        return any_cholesky(matrix)
    if isinstance(log_prior, NormalDensity):
        variance = any_inverse(log_prior.precision)
        return 0.1 * jnp.diag(jnp.sqrt(jnp.diagonal(variance)))
    return 0.1 * jnp.diag(jnp.maximum(jnp.abs(theta), 0.1))


def adapt_covariance(
    root: Float[Array, "p p"],
    noise: Float[Array, " p"],
    rate: Float[Array, ""],
    number: Int[Array, ""],
    learning: Bool[Array, ""],
) -> Float[Array, "p p"]:
    """Adapt S after a move S ξ with this noise ξ and acceptance probability `rate`.

    `number` counts the iterations from one. A rate of NaN counts as zero. S remains unless the
    chain is `learning` and the new S is finite.
    """
    gain = jnp.minimum(1.0, len(noise) * number.astype(root.dtype) ** (-2 / 3))
    excess = jnp.where(jnp.isnan(rate), 0, rate) - _TARGET
    direction = root @ (noise / jnp.maximum(jnp.linalg.norm(noise), 1e-6))
    new = any_cholesky(root @ root.T + gain * excess * jnp.outer(direction, direction))
    # κ has i + 5 instead of i, so that the first moves do not change S by a large factor.
    new = new * jnp.exp(6 / (number.astype(root.dtype) + 5) * excess)
    return jnp.where(learning & jnp.all(jnp.isfinite(new)), new, root)
