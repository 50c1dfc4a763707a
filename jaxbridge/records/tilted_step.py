"""Normal step, conditioned on observations at its end and tilted by later observations.

Points are relative to a point ξ' of the path of the linearisation, u = x' - ξ'. Let a step be
u ~ N(e, Λ Λᵀ), with Λ of shape (d, m). Given a scalar y = c·u + N(0, ρ), with b = Λᵀc and
s = |b|² + ρ, its law is

    N(e + Λ b (y - c·e) / s, Λ⁺ Λ⁺ᵀ),    Λ⁺ = Λ (I - b bᵀ / (s (1 + √(ρ/s)))).

This is Potter's square root (Bierman 1977, chapter V). It allows ρ = 0; then Λ⁺ᵀ c = 0.
Tilted by h(u) = exp(rᵀu - ½ uᵀH u), with M = I + ΛᵀHΛ = ℛ ℛᵀ and v = ℛ⁻¹ Λᵀ (r - He), the step is

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
from .observation import Scalars


class Information(NamedTuple):
    """log h(u) = rᵀu - ½ uᵀH u + constant."""

    shift: Float[Array, " d"]
    precision: Float[Array, "d d"]

    def log(self, u: Float[Array, " d"]) -> Float[Array, ""]:
        """log h(u)."""
        return dot(self.shift, u) - dot(u, matvec(self.precision, u)) / 2


class NormalStep(NamedTuple):
    """N(e, Λ Λᵀ)."""

    mean: Float[Array, " d"]
    root: Float[Array, "d m"]


class Seen(NamedTuple):
    """What one number that was seen makes of Λ: b, the factor of b bᵀ in Λ⁺, Λ b / s and s; and
    √(ρ/s)."""

    along: Float[Array, " m"]
    factor: Float[Array, ""]
    gain: Float[Array, " d"]
    variance: Float[Array, ""]
    left: Float[Array, ""]


def seen_of(root: Float[Array, "d m"], row: Float[Array, " d"], variance) -> Seen:
    """Of a number c·u + N(0, ρ). One that is known before it is seen, s = 0, moves nothing."""
    along = matvec(root.T, row)
    total = dot(along, along) + variance
    safe = jnp.where(total > 0, total, 1)
    ratio = variance / safe
    exact = ratio <= 0
    left = jnp.where(exact, 0, jnp.sqrt(jnp.where(exact, 1, ratio)))
    return Seen(along, 1 / (safe * (1 + left)), matvec(root, along) / safe, total, left)


def root_after(root: Float[Array, "d m"], seen: Seen) -> Float[Array, "d m"]:
    """Λ⁺."""
    return root - seen.factor * matvec(root, seen.along)[:, None] * seen.along


def given(
    step: NormalStep, scalars: Scalars, rounding: Float[Array, " n"] | None = None
) -> tuple[NormalStep, Float[Array, ""], list[Seen]]:
    """The step given what is seen at its end, relative to ξ' as it is; and the log density of
    that. A number that is known before it is seen has none: zero where it is as it must be, up to
    `rounding`, and else -inf."""
    log_density, each = jnp.zeros((), step.mean.dtype), []
    slack = jnp.zeros_like(scalars.values) if rounding is None else rounding
    for row, value, variance, is_seen, error in zip(*scalars, slack, strict=True):
        seen = seen_of(step.root, row, variance)
        residual = value - dot(row, step.mean)
        known = seen.variance == 0
        total = jnp.where(known, 1, seen.variance)
        log = residual**2 / total + jnp.log(2 * np.pi * total)
        log = jnp.where(known, jnp.where(jnp.abs(residual) <= error, 0, jnp.inf), log)
        log_density -= jnp.where(is_seen, log, 0) / 2
        step = NormalStep(step.mean + seen.gain * residual, root_after(step.root, seen))
        each.append(seen)
    return step, log_density, each


class Tilted(NamedTuple):
    """A step tilted by h: its mean e and root Λ before, ℛ and v, and log h(e) + ½ |v|²."""

    step: NormalStep
    factor: Float[Array, "m m"]
    shift: Float[Array, " m"]
    exponent: Float[Array, ""]

    @property
    def log_integral(self) -> Float[Array, ""]:
        """log ∫ h dN."""
        return self.exponent - self._log_det()

    def pulled(self, zeta: Float[Array, " m"]) -> Float[Array, " m"]:
        """z = ℛ⁻ᵀ (v + ζ), the noise of the same step before it is tilted."""
        return solve_lower_transposed(self.factor, self.shift + zeta)

    def point(self, pulled: Float[Array, " m"]) -> Float[Array, " d"]:
        """e + Λ z."""
        return self.step.mean + matvec(self.step.root, pulled)

    def log_ratio(self, zeta: Float[Array, " m"], pulled: Float[Array, " m"]) -> Float[Array, ""]:
        """Return log N(z; 0, I) - log N(ζ; 0, I) - log det ℛ: the density of the step before it is
        tilted over that of the tilted step. At most ½|ζ|², for det ℛ is at least one."""
        return dot(zeta - pulled, zeta + pulled) / 2 - self._log_det()

    def _log_det(self) -> Float[Array, ""]:
        return log_of_product([self.factor[j, j] for j in range(self.factor.shape[0])])

    def noise(self, pulled: Float[Array, " m"]) -> Float[Array, " m"]:
        """ζ of ℛ⁻ᵀ (v + ζ)."""
        return matvec(self.factor.T, pulled) - self.shift


def tilt_factor(
    root: Float[Array, "d m"], h: Information
) -> tuple[Float[Array, "m m"], Float[Array, "d m"]]:
    """ℛ of I + ΛᵀHΛ = ℛ ℛᵀ, and HΛ."""
    half = matmul(h.precision, root)
    K = matmul(root.T, half)
    return cholesky(jnp.eye(K.shape[0], dtype=K.dtype) + (K + K.T) / 2), half


def tilted(step: NormalStep, h: Information) -> Tilted:
    """The step tilted by h."""
    e, root = step
    factor, _ = tilt_factor(root, h)
    v = solve_lower(factor, matvec(root.T, h.shift - matvec(h.precision, e)))
    return Tilted(step, factor, v, h.log(e) + dot(v, v) / 2)


def coordinates(
    displacement: Float[Array, " m"], each: list[Seen], hidden: Float[Array, " n"]
) -> Float[Array, " m"]:
    """q of Λ⁺ q = Λ `displacement`, with what is seen as `given` has it. Along what is seen exactly
    q moves nothing, and is `hidden`, of which there is a number for each that is seen: under the
    law of the noise it is N(0, 1), and independent of the path."""
    q = displacement
    for seen, free in zip(each, hidden, strict=True):
        square, exact = dot(seen.along, seen.along), seen.left == 0
        some = square > 0
        share = dot(seen.along, q) / jnp.where(some, square, 1)
        kept = share / jnp.where(exact, 1, seen.left)
        wanted = jnp.where(exact, free * lax.rsqrt(jnp.where(some, square, 1)), kept)
        q = q + jnp.where(some, wanted - share, 0) * seen.along
    return q
