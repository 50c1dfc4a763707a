"""Relative position of a coupled pair in noise coordinates (section 2.1 of the paper).

All schemes and couplings share these functions.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..engine.linalg import safe_norm
from ..models.dynamics import Dynamics
from ..models.sigma import AbstractSigma


class Frame(NamedTuple):
    """Relative position of the pair (x, x') in the noise coordinates of the driven process x'.

    - `sigma`: σ(x'), or the matrix R that multiplies the noise in the scheme.
    - `u`: unit vector along `σ(x')⁻¹(x - x')`, shape (d,); zero if x = x'.
    - `gap`: length of `σ(x')⁻¹(x - x')`, in square roots of the unit of time.

    Schemes may evaluate u and the gap after the drift of their step. `Heun` evaluates u after half
    of the drift, and the gap before it.
    """

    sigma: AbstractSigma
    u: Float[Array, " d"]
    gap: Float[Array, ""]


def frame(sigma: AbstractSigma, x: Float[Array, " d"], driven: Float[Array, " d"]) -> Frame:
    """Return the frame with u and |v| of section 2.1, for `sigma` = σ(x') and `driven` = x'."""
    return frame_of(sigma, x - driven)


def frame_of(sigma: AbstractSigma, difference: Float[Array, " d"]) -> Frame:
    """Return the frame of a difference of two states, x - x'."""
    v = sigma.solve(difference)
    gap = safe_norm(v)  # with a finite derivative at zero
    return Frame(sigma, v / jnp.where(gap > 0, gap, 1), gap)


def frame_after_drift(
    dynamics: Dynamics, x: Float[Array, " d"], driven: Float[Array, " d"], dt: Float[Array, ""]
) -> Frame:
    """Return the frame after both points have moved by their drift, α δ."""
    drift = dynamics.drift(x) - dynamics.drift(driven)
    return frame_of(dynamics.sigma(driven), x - driven + drift * dt)
