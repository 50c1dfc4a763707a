"""How a pair of copies of the diffusion lies, seen from the driven one (section 2.1)."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..engine.linalg import safe_norm
from ..models.dynamics import Dynamics
from ..models.sigma import AbstractSigma


class Frame(NamedTuple):
    """How the pair (x, x') lies, seen from the driven process x'.

    `sigma` is σ(x'), or the root R of the scheme's noise; `u`, shape (d,), the unit vector along
    `σ(x')⁻¹(x - x')`, zero where the two are equal; `gap` the length of that vector, in square
    roots of a unit of time. Schemes may look at the pair after the drift of their step; `Heun`
    takes u after half of it, and the gap before.
    """

    sigma: AbstractSigma
    u: Float[Array, " d"]
    gap: Float[Array, ""]


def frame(sigma: AbstractSigma, x: Float[Array, " d"], driven: Float[Array, " d"]) -> Frame:
    """u and |v| of section 2.1, for `sigma` = σ(x') and `driven` = x'."""
    return frame_of(sigma, x - driven)


def frame_of(sigma: AbstractSigma, difference: Float[Array, " d"]) -> Frame:
    """The frame of a difference of two states."""
    v = sigma.solve(difference)
    gap = safe_norm(v)
    return Frame(sigma, v / jnp.where(gap > 0, gap, 1), gap)


def frame_after_drift(
    dynamics: Dynamics, x: Float[Array, " d"], driven: Float[Array, " d"], dt: Float[Array, ""]
) -> Frame:
    """The gap when each has gone α δ."""
    drift = dynamics.drift(x) - dynamics.drift(driven)
    return frame_of(dynamics.sigma(driven), x - driven + drift * dt)
