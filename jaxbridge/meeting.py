"""Have the two diffusions met between two grid points? (section 2.5 of the paper)

The pair is looked at in the whitened coordinates of the driven process, `σ(x')⁻¹`, where to
leading order the gap `x - x'` moves only along its own direction u, as a Brownian motion: the
coupling makes the components orthogonal to u equal. With

    D_i = |σ(x'_i)⁻¹(x_i - x'_i)|,    D_{i+1} = uᵀσ(x'_i)⁻¹(x_{i+1} - x'_{i+1}),

a meeting is a visit of that Brownian motion, from D_i to D_{i+1}, to zero.
"""

from abc import abstractmethod
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .diffusion import Dynamics
from .linalg import dot, safe_norm
from .sigma import AbstractSigma


class Frame(NamedTuple):
    """How the pair (x, x') lies, seen from the driven process x'.

    `sigma` is σ(x'); `u`, shape (d,), the unit vector along `σ(x')⁻¹(x - x')`, zero where the
    two are equal; `gap` the length of that vector, in square roots of a unit of time.
    """

    sigma: AbstractSigma
    u: Float[Array, " d"]
    gap: Float[Array, ""]


def frame(sigma: AbstractSigma, x: Float[Array, " d"], driven: Float[Array, " d"]) -> Frame:
    """u and |v| of section 2.1, for `sigma` = σ(x') and `driven` = x'."""
    v = sigma.solve(x - driven)
    gap = safe_norm(v)
    return Frame(sigma, v / jnp.where(gap > 0, gap, 1), gap)


class PairStep(NamedTuple):
    """One time step of the pair: everything a meeting rule may look at.

    `x`, `x_next` are the states of X and `driven`, `driven_next` those of X', shape (d,);
    `frame` is taken at the beginning of the step, of length `dt`; `gap_variance` is the
    variance per unit of time of the gap along `frame.u`.
    """

    frame: Frame
    x: Float[Array, " d"]
    x_next: Float[Array, " d"]
    driven: Float[Array, " d"]
    driven_next: Float[Array, " d"]
    dt: Float[Array, ""]
    gap_variance: Float[Array, ""]

    def along_u(self, vector: Float[Array, " d"]) -> Float[Array, ""]:
        """uᵀσ(x'_i)⁻¹ applied to a vector."""
        return dot(self.frame.u, self.frame.sigma.solve(vector))

    def gap_next(self) -> Float[Array, ""]:
        """D_{i+1}, negative where the two have passed each other."""
        return self.along_u(self.x_next - self.driven_next)


class AbstractMeeting(eqx.Module):
    """A rule that decides whether a pair met during a step.

    `draws_uniform` says whether the rule needs a uniform number; where it does not, none is
    drawn and `uniform` is `None`.
    """

    draws_uniform: ClassVar[bool]

    @abstractmethod
    def met(
        self, step: PairStep, forward: Dynamics, uniform: Float[Array, ""] | None
    ) -> Bool[Array, ""]:
        """Whether the pair met."""


class SignTest(AbstractMeeting):
    """Equation (crit1): the gap has changed its sign, `D_i D_{i+1} < 0`.

    Sees about half of the meetings, so what it decides is off by O(√δ). With a `radius`, in
    units of space, `|x_i - x'_i| ≤ radius` is asked too; the paper uses 0.05.
    """

    radius: Float[Array, ""] | None = None
    draws_uniform: ClassVar[bool] = False

    def __init__(self, radius: float | Float[Array, ""] | None = None):
        self.radius = None if radius is None else jnp.asarray(radius)

    def met(self, step, forward, uniform):
        crossed = step.frame.gap * step.gap_next() < 0
        touching = step.frame.gap == 0
        if self.radius is not None:
            crossed &= safe_norm(step.x - step.driven) <= self.radius
        return crossed | touching


class ReflectionPlane(AbstractMeeting):
    """Equation (coupling), for γ = -1: X has crossed the plane in which X' mirrors it,

        uᵀσ⁻¹ (x_{i+1} - x_i - α(x_i) δ) ≤ -½ D_i.

    The same test as `SignTest()` where the two share their drift, and off by O(√δ) as well.
    """

    draws_uniform: ClassVar[bool] = False

    def met(self, step, forward, uniform):
        noise = step.along_u(step.x_next - step.x - forward.drift(step.x) * step.dt)
        return noise <= -step.frame.gap / 2


class BrownianCrossing(AbstractMeeting):
    """Draw whether the Brownian gap reached zero between its two known ends,

        P(met | D_i, D_{i+1}) = min(1, exp(-2 D_i D_{i+1} / (s δ))),

    with s the variance of the gap per unit of time, 2(1-γ) for the γ-coupling. Off by O(δ).
    """

    draws_uniform: ClassVar[bool] = True

    def met(self, step, forward, uniform):
        assert uniform is not None
        gap_next = step.gap_next()
        moving = step.gap_variance > 0  # a gap that does not move is crossed only if closed
        scale = jnp.where(moving, step.gap_variance * step.dt, 1)
        exponent = jnp.where(moving, -2 * step.frame.gap * gap_next / scale, -jnp.inf)
        exponent = jnp.where(step.frame.gap > 0, exponent, 0)
        return uniform < jnp.exp(exponent)
