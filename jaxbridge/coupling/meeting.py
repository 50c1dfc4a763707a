"""Meeting rules: whether the pair meets between two grid points (section 2.5 of the paper).

The rules use the whitened coordinates of the driven process, `σ(x')⁻¹`. In them the gap `x - x'`
moves along its own direction u only, to leading order, because the coupling makes the noise
orthogonal to u equal. Along u it is a Brownian motion. With

    D_i = |σ(x'_i)⁻¹(x_i - x'_i)|,    D_{i+1} = uᵀσ(x'_i)⁻¹(x_{i+1} - x'_{i+1}),

a meeting is a visit of this Brownian motion to zero, on its way from D_i to D_{i+1}.

The direction of the gap needs care, because the drift turns the gap during the step. If u is the
direction at the beginning of the step, the two pass each other at a distance of O(δ^{3/2}). The
joined path then has a jump of that size. For constant σ the schemes therefore take u from the gap
at the moment when the noise of the step begins to act (`AbstractScheme.frame`). The noise then
moves the gap straight through zero. For a scheme x + m(x) + R ΔW with constant R, this is the gap
after the drift:

    D_i u = R⁻¹[x_i + m(x_i) - x'_i - m(x'_i)],    D_{i+1} = D_i + uᵀ(ΔW - ΔW').

This choice is exact at any δ, by the following argument. Condition on the noise orthogonal to
uᵀ(ΔW-ΔW'), and let x_{i+1} and x'_{i+1} change places. The density of (ΔW, ΔW') then changes by the
factor exp(-2 D_i D_{i+1} / (s δ)) only, which is the probability of a crossing. So if X has the
transition probabilities of the scheme, the joined path has exactly the same ones. For γ = -1 this
is the maximal coupling of two normal laws by reflection (Bou-Rabee, Eberle & Zimmer 2020).
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
    """One time step of the pair: the data for a meeting rule.

    - `frame`: the frame in which the noise of the step is coupled.
    - `x`, `x_next`: the states of X before and after the step, shape (d,).
    - `driven`, `driven_next`: the states of X' before and after the step, shape (d,).
    - `dt`: the step size, shape ().
    - `gap_variance`: variance of the gap along `frame.u` per unit of time, shape ().
    """

    frame: Frame
    x: Float[Array, " d"]
    x_next: Float[Array, " d"]
    driven: Float[Array, " d"]
    driven_next: Float[Array, " d"]
    dt: Float[Array, ""]
    gap_variance: Float[Array, ""]

    def along_u(self, vector: Float[Array, " d"]) -> Float[Array, ""]:
        """Return uᵀσ(x'_i)⁻¹ `vector`."""
        return dot(self.frame.u, self.frame.sigma.solve(vector))

    def gap_next(self) -> Float[Array, ""]:
        """Return D_{i+1}, the gap along u after the step in noise coordinates.

        It is negative if X and X' have passed each other.
        """
        return self.along_u(self.x_next - self.driven_next)


class AbstractMeeting(eqx.Module):
    """Base class of meeting rules, which decide whether a pair meets during a step.

    Class attributes:

    - `draws_uniform`: whether the rule needs a uniform random number. If not, none is sampled and
        `uniform` is `None`.
    - `looks_ahead`: if true, the direction u of the gap is taken after the drift of the step. If
        false, it is taken at the beginning of the step, as in the paper.
    """

    draws_uniform: ClassVar[bool]
    looks_ahead: ClassVar[bool]

    @abstractmethod
    def met(
        self, step: PairStep, forward: Dynamics, uniform: Float[Array, ""] | None
    ) -> Bool[Array, ""]:
        """Return whether the pair meets in this step. `forward` has the drift and σ of X and X'."""


class SignTest(AbstractMeeting):
    """Meeting rule of equation (crit1): the gap changes its sign, `D_i D_{i+1} < 0`.

    It detects about half of the meetings, so results have an error of O(√δ). With a `radius`, in
    units of space, it also requires `|x_i - x'_i| ≤ radius`; the paper uses 0.05.

    **Raises:** `ValueError` for a `radius` that is not a positive number.

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
            raise ValueError(
                f"`radius` must be a positive number; got {radius}. Omit it for no bound."
            )

    def met(self, step, forward, uniform):
        # The first gap is a norm, so the product is negative if and only if the next gap is.
        crossed = step.frame.gap * step.gap_next() < 0
        # A gap of zero has no sign to change, but the pair has met.
        touching = step.frame.gap == 0
        if self.radius is not None:
            crossed &= safe_norm(step.x - step.driven) <= self.radius
        return crossed | touching


class ReflectionPlane(AbstractMeeting):
    """Meeting rule of equation (coupling), for γ = -1: X crosses the plane in which X' mirrors it,

        uᵀσ⁻¹ (x_{i+1} - x_i - α(x_i) δ) ≤ -½ D_i,

    where D_i is the length of σ⁻¹ (x_i - x'_i), and u its direction. If the drifts at x_i and x'_i
    are equal, this is the rule of `SignTest()`. Results have an error of O(√δ), as for
    `SignTest()`. `Coupling` raises `ValueError` for this rule with another γ.

    **Example:**

    ```python
    coupling = jb.Coupling(-1.0, meeting=jb.ReflectionPlane())
    ```
    """

    draws_uniform: ClassVar[bool] = False
    looks_ahead: ClassVar[bool] = False

    def met(self, step, forward, uniform):
        # The move of X without its drift: the plane reflects the noise only.
        noise = step.along_u(step.x_next - step.x - forward.drift(step.x) * step.dt)
        return noise <= -step.frame.gap / 2


class BrownianCrossing(AbstractMeeting):
    """Random meeting rule: the gap is a Brownian bridge within a step, and reaches zero with

        P(met | D_i, D_{i+1}) = min(1, exp(-2 D_i D_{i+1} / (s δ))).

    Here s is the variance of the gap per unit of time, 2(1-γ) for the γ-coupling. The error of the
    rule depends on σ and on the scheme:

    - constant σ: no error with `Euler` and `GaussianTransition`, O(δ²) with `Heun`;
    - state-dependent σ: O(δ).

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
        moving = step.gap_variance > 0  # a gap without noise cannot close
        scale = jnp.where(moving, step.gap_variance * step.dt, 1)
        # Gaps of opposite signs give a positive exponent: the crossing is certain.
        exponent = jnp.where(moving, -2 * step.frame.gap * gap_next / scale, -jnp.inf)
        # A gap that is already closed counts as a meeting, also at index 0.
        exponent = jnp.where(step.frame.gap > 0, exponent, 0)
        return uniform < jnp.exp(exponent)
