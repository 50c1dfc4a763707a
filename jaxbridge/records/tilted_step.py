"""Normal step, conditioned on observations at its end and tilted by later observations.

Points are relative to a point ξ' of the path of the linearisation, u = x' - ξ'. Let a step be u ~
N(e, Λ Λᵀ), with Λ of shape (d, m). The observation is a scalar y = c·u + N(0, ρ). Let b = Λᵀc and s
= |b|² + ρ. Given y the step has the law

    N(e + Λ b (y - c·e) / s, Λ⁺ Λ⁺ᵀ),    Λ⁺ = Λ (I - b bᵀ / (s (1 + √(ρ/s)))).

This is Potter's square root (Bierman 1977, chapter V). It allows ρ = 0; then Λ⁺ᵀ c = 0.

The step is then tilted by h(u) = exp(rᵀu - ½ uᵀH u). Let M = I + ΛᵀHΛ = ℛ ℛᵀ and v = ℛ⁻¹ Λᵀ (r -
He). The tilted step is

    e + Λ ℛ⁻ᵀ (v + ζ),  ζ ~ N(0, I),    ∫ h dN = exp(rᵀe - ½ eᵀHe + ½ |v|²) / det ℛ.

Neither formula needs an inverse of Λ. Hence Λ may be singular, zero, or have fewer columns than
rows.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..engine.linalg import (
    cholesky,
    dot,
    log_of_product,
    matmul,
    matvec,
    solve_lower,
    solve_lower_transposed,
)
from .observations import Scalars


class Information(NamedTuple):
    """Quadratic function log h(u) = rᵀu - ½ uᵀH u + constant."""

    shift: Float[Array, " d"]
    precision: Float[Array, "d d"]

    def log(self, u: Float[Array, " d"]) -> Float[Array, ""]:
        """Return log h(u) up to the constant."""
        return dot(self.shift, u) - dot(u, matvec(self.precision, u)) / 2


class NormalStep(NamedTuple):
    """Normal law N(e, Λ Λᵀ)."""

    mean: Float[Array, " d"]
    root: Float[Array, "d m"]


class Seen(NamedTuple):
    """Factors of the conditioning on one scalar observation.

    - `along`: b.
    - `factor`: 1 / (s (1 + √(ρ/s))), the factor of b bᵀ in Λ⁺.
    - `gain`: Λ b / s.
    - `variance`: s.
    - `left`: √(ρ/s).
    """

    along: Float[Array, " m"]
    factor: Float[Array, ""]
    gain: Float[Array, " d"]
    variance: Float[Array, ""]
    left: Float[Array, ""]


def seen_of(root: Float[Array, "d m"], row: Float[Array, " d"], variance) -> Seen:
    """Return the factors for an observation c·u + N(0, ρ).

    If s = 0 the observation is known in advance, and conditioning changes nothing.
    """
    along = matvec(root.T, row)
    total = dot(along, along) + variance
    safe = jnp.where(total > 0, total, 1)
    ratio = variance / safe
    exact = ratio <= 0
    # The inner `where` keeps the derivative of the root finite at zero.
    left = jnp.where(exact, 0, jnp.sqrt(jnp.where(exact, 1, ratio)))
    return Seen(along, 1 / (safe * (1 + left)), matvec(root, along) / safe, total, left)


def root_after(root: Float[Array, "d m"], factors: Seen) -> Float[Array, "d m"]:
    """Return Λ⁺, the root of the covariance after an observation."""
    return root - factors.factor * matvec(root, factors.along)[:, None] * factors.along


def given(
    step: NormalStep, scalars: Scalars, rounding: Float[Array, " n"] | None = None
) -> tuple[NormalStep, Float[Array, ""], list[Seen]]:
    """Condition a step on the scalar observations at its end, which are relative to ξ'.

    **Returns:** the step, the log density of the observations, and the factors for each. An
    observation with s = 0 contributes 0 to the log density if its residual is at most `rounding`,
    and -inf otherwise.
    """
    log_density, factors = jnp.zeros((), step.mean.dtype), []
    slack = jnp.zeros_like(scalars.values) if rounding is None else rounding
    for row, value, variance, is_seen, error in zip(*scalars, slack, strict=True):
        factor = seen_of(step.root, row, variance)
        residual = value - dot(row, step.mean)
        is_known = factor.variance == 0
        total = jnp.where(is_known, 1, factor.variance)
        log = residual**2 / total + jnp.log(2 * np.pi * total)
        log = jnp.where(is_known, jnp.where(jnp.abs(residual) <= error, 0, jnp.inf), log)
        log_density -= jnp.where(is_seen, log, 0) / 2
        step = NormalStep(step.mean + factor.gain * residual, root_after(step.root, factor))
        factors.append(factor)
    return step, log_density, factors


class Tilted(NamedTuple):
    """Step tilted by h.

    - `step`: the step before tilting, with mean e and root Λ.
    - `factor`: ℛ.
    - `shift`: v.
    - `exponent`: log h(e) + ½ |v|².
    """

    step: NormalStep
    factor: Float[Array, "m m"]
    shift: Float[Array, " m"]
    exponent: Float[Array, ""]

    @property
    def log_integral(self) -> Float[Array, ""]:
        """Return log ∫ h dN."""
        return self.exponent - self._log_det()

    def pulled(self, zeta: Float[Array, " m"]) -> Float[Array, " m"]:
        """Return z = ℛ⁻ᵀ (v + ζ).

        The step before tilting leads to the same point with the noise z as the tilted step with ζ.
        """
        return solve_lower_transposed(self.factor, self.shift + zeta)

    def point(self, pulled: Float[Array, " m"]) -> Float[Array, " d"]:
        """Return the point e + Λ z."""
        return self.step.mean + matvec(self.step.root, pulled)

    def log_ratio(self, zeta: Float[Array, " m"], pulled: Float[Array, " m"]) -> Float[Array, ""]:
        """Return the log density of the step before tilting minus that of the tilted step.

        It is log N(z; 0, I) - log N(ζ; 0, I) - log det ℛ. It is at most ½|ζ|², because det ℛ ≥ 1.
        """
        # (|ζ|² - |z|²) / 2 as a product, which avoids cancellation.
        return dot(zeta - pulled, zeta + pulled) / 2 - self._log_det()

    def _log_det(self) -> Float[Array, ""]:
        """Return log det ℛ, from the diagonal of ℛ."""
        return log_of_product([self.factor[j, j] for j in range(self.factor.shape[0])])

    def noise(self, pulled: Float[Array, " m"]) -> Float[Array, " m"]:
        """Return ζ for z = ℛ⁻ᵀ (v + ζ)."""
        return matvec(self.factor.T, pulled) - self.shift


def tilt_factor(
    root: Float[Array, "d m"], h: Information
) -> tuple[Float[Array, "m m"], Float[Array, "d m"]]:
    """Return ℛ of I + ΛᵀHΛ = ℛ ℛᵀ, and HΛ."""
    half = matmul(h.precision, root)
    K = matmul(root.T, half)
    # Rounding makes K slightly asymmetric.
    return cholesky(jnp.eye(K.shape[0], dtype=K.dtype) + (K + K.T) / 2), half


def tilted(step: NormalStep, h: Information) -> Tilted:
    """Return the step tilted by h."""
    e, root = step
    factor, _ = tilt_factor(root, h)
    v = solve_lower(factor, matvec(root.T, h.shift - matvec(h.precision, e)))
    return Tilted(step, factor, v, h.log(e) + dot(v, v) / 2)


def coordinates(
    displacement: Float[Array, " m"], factors: list[Seen], hidden: Float[Array, " n"]
) -> Float[Array, " m"]:
    """Return q with Λ⁺ q = Λ `displacement`, for the observations of `given`.

    Λ⁺ maps the direction b of an exact observation to zero, so q is not determined along b. There q
    has the component `hidden`, one number per observation. Under the law of the noise this
    component is N(0, 1) and independent of the path.
    """
    # The factors are inverted in the order of the observations.
    q = displacement
    for factor, free in zip(factors, hidden, strict=True):
        square, exact = dot(factor.along, factor.along), factor.left == 0
        is_nonzero = square > 0
        share = dot(factor.along, q) / jnp.where(is_nonzero, square, 1)
        noisy_share = share / jnp.where(exact, 1, factor.left)
        new_share = jnp.where(
            exact, free * lax.rsqrt(jnp.where(is_nonzero, square, 1)), noisy_share
        )
        q = q + jnp.where(is_nonzero, new_share - share, 0) * factor.along
    return q
