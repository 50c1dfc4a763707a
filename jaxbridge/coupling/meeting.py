"""Have the two diffusions met between two grid points? (section 2.5 of the paper)

The pair is looked at in the whitened coordinates of the driven process, `σ(x')⁻¹`, where to
leading order the gap `x - x'` moves only along its own direction u, as a Brownian motion: the
coupling makes the components orthogonal to u equal. With

    D_i = |σ(x'_i)⁻¹(x_i - x'_i)|,    D_{i+1} = uᵀσ(x'_i)⁻¹(x_{i+1} - x'_{i+1}),

a meeting is a visit of that Brownian motion, from D_i to D_{i+1}, to zero.

During a step the drift turns the gap, so with u from its beginning the two pass each other at a
distance of O(δ^{3/2}), which is the error of what is joined there. Where σ is constant, schemes
take u from the gap as it is when the noise of their step sets in (`AbstractScheme.frame`), which
then moves it straight through zero. For a scheme x + m(x) + R ΔW, with constant R, that is after
the drift,

    D_i u = R⁻¹[x_i + m(x_i) - x'_i - m(x'_i)],    D_{i+1} = D_i + uᵀ(ΔW - ΔW'),

and the joint law of (ΔW, ΔW') given what is orthogonal to uᵀ(ΔW - ΔW') stays the same if x_{i+1}
and x'_{i+1} change places, but for the factor exp(-2 D_i D_{i+1} / (s δ)) in its density. That is
the probability of a crossing, so, if X has the transition probabilities of the scheme, the joined
path has exactly these: meetings have no error of their own at any δ. (With γ = -1 this is the
maximal coupling of two normal laws by reflection; Bou-Rabee, Eberle & Zimmer 2020.)
"""

from abc import abstractmethod
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..engine.checks import as_floating, is_traced
from ..engine.linalg import dot, safe_norm
from ..models.dynamics import Dynamics
from ..schemes import Frame


class PairStep(NamedTuple):
    """One time step of the pair: everything a meeting rule may look at.

    `x`, `x_next` are the states of X and `driven`, `driven_next` those of X', shape (d,);
    `frame` is what the noise of the step, of length `dt`, was coupled in; `gap_variance` is the
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
    drawn and `uniform` is `None`. `looks_ahead` says whether the pair is seen, and coupled, as it
    is after the drift of the scheme's step, or as it is now, as in the paper.
    """

    draws_uniform: ClassVar[bool]
    looks_ahead: ClassVar[bool]

    @abstractmethod
    def met(
        self, step: PairStep, forward: Dynamics, uniform: Float[Array, ""] | None
    ) -> Bool[Array, ""]:
        """Whether the pair met."""


class SignTest(AbstractMeeting):
    """Equation (crit1): the gap has changed its sign, `D_i D_{i+1} < 0`.

    Sees about half of the meetings, so what it decides is off by O(√δ). With a `radius`, in
    units of space, `|x_i - x'_i| ≤ radius` is asked too; the paper uses 0.05.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, meeting=jb.SignTest(radius=0.05))
    ```
    """

    radius: Float[Array, ""] | None = None
    draws_uniform: ClassVar[bool] = False
    looks_ahead: ClassVar[bool] = False

    def __init__(self, radius: float | Float[Array, ""] | None = None):
        self.radius = None if radius is None else as_floating("radius", radius)
        if self.radius is None:
            return
        if self.radius.shape != () or not (is_traced(self.radius) or self.radius > 0):
            raise ValueError(f"`radius` must be a positive number; got {radius}.")

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

    **Example:**

    ```python
    coupling = jb.Coupling(-1.0, meeting=jb.ReflectionPlane())
    ```
    """

    draws_uniform: ClassVar[bool] = False
    looks_ahead: ClassVar[bool] = False

    def met(self, step, forward, uniform):
        noise = step.along_u(step.x_next - step.x - forward.drift(step.x) * step.dt)
        return noise <= -step.frame.gap / 2


class BrownianCrossing(AbstractMeeting):
    """Draw whether the Brownian gap reached zero between its two known ends,

        P(met | D_i, D_{i+1}) = min(1, exp(-2 D_i D_{i+1} / (s δ))),

    with s the variance of the gap per unit of time, 2(1-γ) for the γ-coupling. For constant σ
    without error of its own with `Euler` and `GaussianTransition`, and off by O(δ²) with `Heun`;
    off by O(δ) where σ depends on the state.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, meeting=jb.BrownianCrossing())  # the default
    ```
    """

    draws_uniform: ClassVar[bool] = True
    looks_ahead: ClassVar[bool] = True

    def met(self, step, forward, uniform):
        assert uniform is not None
        gap_next = step.gap_next()
        moving = step.gap_variance > 0  # a gap that does not move is crossed only if closed
        scale = jnp.where(moving, step.gap_variance * step.dt, 1)
        exponent = jnp.where(moving, -2 * step.frame.gap * gap_next / scale, -jnp.inf)
        exponent = jnp.where(step.frame.gap > 0, exponent, 0)
        return uniform < jnp.exp(exponent)
