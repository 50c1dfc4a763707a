"""Normal laws of one step from x of length δ: the factors of the weight of a path.

The target of a weighted path is a Markov chain on its grid, with normal steps

    x' ~ N(μ(x), δ σ(x) S(x) σ(x)ᵀ).

(Steps of `QuadraticDensity` are functions of normal noise.) Each step, or its noise, has a
probability density. Hence the mean of the weights is the transition density of the
chain, which is finite for every model. Its distance from p_T is the discretisation error.

*Euler.* `EulerDensity` has μ = x + αδ and S = I. Its error is O(δ), for any σ.

*Constant σ.* In noise coordinates, let β = σ⁻¹α and A = ∇β. The first terms of the Itô–Taylor
expansion (Kloeden & Platen 1992, section 14.2) are normal as well. `ItoTaylorDensity` is the law of

    x + βδ + ½δ² (Aβ + ½Δβ) + ∫_0^δ [I + (δ-s) A] dW_s.

Here S = I + ½δ(A + Aᵀ) + ⅓δ² AAᵀ, which is at least ¼ I for every step size. The error is O(δ²).

*Hypoelliptic models*, with fewer columns than rows in σ. Noise enters only some coordinates, and
the drift carries it to the others. An Euler step has no noise in the others. The expansion above
holds in state coordinates. With F = ∇α its noise is

    ∫_0^δ [I + (δ-s) F] σ dW_s = √δ (σ + ½δ Fσ) ζ_1 + δ^{3/2} / √12 Fσ ζ_2,    ζ ~ N(0, I).

This is the strong scheme of order 1.5 (Kloeden & Platen, section 10.4; for hypoelliptic diffusions
Ditlevsen & Samson 2019). A state-dependent σ adds l (∫ s dW_s), with l = ∇σ α. The noise of
`HypoellipticDensity` is therefore

    √δ (σ + ½δ [Fσ + l]) ζ_1 + δ^{3/2} / √12 [Fσ - l] ζ_2.

The omitted term Σ ∇σ_k σ_j ∫∫ dW_j dW_k is not normal. Its contribution along a path is O(δ). If
each ∇σ_k σ_j vanishes, the total error is O(δ²). One such case is a σ that depends only on
coordinates without direct noise. In this case the second derivatives of σ that belong to l vanish,
too. The code replaces l_k by l_k / √(1 + δ² |l_k|² / |σ_k|²), which has the same order of accuracy.
Then σ + δl is nonzero wherever σ is.

*Linear drift and constant σ*. The transition is normal and known in closed form (`models.linear`).
`LinearDensity` is this law, so there is no discretisation error. `LocalLinearDensity` linearises
the drift at the start of each step.

Time-dependent coefficients are evaluated in the middle of a step, which preserves both orders.
"""

import functools
import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..engine.lanes import compute_once
from ..engine.linalg import (
    cholesky,
    matmul,
    matvec,
    semidefinite_cholesky,
    semidefinite_factor,
    solve,
    sum_first_axis,
)
from ..models import decisions
from ..models.diffusion import Diffusion
from ..models.dynamics import Dynamics
from ..models.linear import LinearTransition, linear_transition
from ..models.sigma import columns_of, covariance_of
from .step_law import DegenerateLaw, StepLaw, root_of_length


class LinearStep(NamedTuple):
    """Step of the linear process dX = [c + F X] dt + σ dW.

    Its law is x' ~ N(`decay` x + `integral` c, `covariance`), with matrices of shape (d, d).
    """

    decay: Float[Array, "d d"]
    integral: Float[Array, "d d"]
    covariance: Float[Array, "d d"]


class StepsFrom(NamedTuple):
    """Steps from one point, as two functions of the step size δ.

    - `law`: returns the law of the step, a `StepLaw`, or a `DegenerateLaw` if σ is not invertible.
    - `decay`: returns the derivative of the mean of x' with respect to x for the linearised drift,
        shape (d, d). It is in noise coordinates (σ⁻¹x' and σ⁻¹x), or in state coordinates if σ is
        not invertible.
    """

    law: Callable[[Float[Array, ""]], Any]
    decay: Callable[[Float[Array, ""]], Float[Array, "d d"]]


class AbstractStepDensity(eqx.Module):
    """Base class of step densities: the normal law of one step of a target chain.

    Class attributes:

    - `order`: p in the error O(δ^p) along a path, in the mean over paths; infinite if there is no
        error.
    - `is_normal`: whether a step is normal, or else a map of normal noise (`StepLaw.bent`).
    - `cost`: seconds of a step relative to an Euler step, measured for d ≤ 3.
    """

    order: ClassVar[float]
    is_normal: ClassVar[bool] = True
    cost: ClassVar[float] = 1.0

    @property
    def is_exact(self) -> bool:
        """Return whether there is no discretisation error."""
        return math.isinf(self.order)

    @property
    def usual_order(self) -> float:
        """Return the order that reported errors of densities and bridges assume.

        It is `order` if steps are normal, and 1.5 if they are quadratic in the noise.
        """
        # Higher terms make the errors of quadratic steps shrink more slowly at first: for CIR and
        # Jacobi diffusions by factors of 2.9 to 3.1 from 4 to 8 steps, and of 3.3 to 3.8 from 16 to
        # 32. Of 83 densities with 6 and 10 steps, 20 had errors clear of the noise. With 1.5, the
        # reported errors are .5 to 1.5 times these.
        return float(self.order) if self.is_normal else 1.5

    @abstractmethod
    def steps_from(self, dynamics: Dynamics, x: Float[Array, " d"]) -> StepsFrom:
        """Return the law of a step from `x` as functions of the step size."""

    @abstractmethod
    def linear_step(
        self, F: Float[Array, "d d"], V: Float[Array, "d d"], dt: Float[Array, ""]
    ) -> LinearStep:
        """Return the step of a linear process with drift matrix `F` and V = σσᵀ, in closed form."""


class EulerDensity(AbstractStepDensity):
    """Step density of the Euler scheme, N(x + α(x) δ, V(x) δ), for any σ.

    Its error is O(δ) along a path. In a hypoelliptic model the coordinates without direct noise
    have no noise within a step.

    **Example:**

    ```python
    proposal = jb.ModifiedDiffusionBridge(density=jb.EulerDensity())
    ```
    """

    order: ClassVar[float] = 1

    def steps_from(self, dynamics, x):
        drift, sigma, d = dynamics.drift(x), dynamics.sigma(x).root(), x.shape[0]
        if not sigma.invertible:
            return _degenerate_euler(dynamics, x)

        def law(dt):
            return StepLaw(x + drift * dt, sigma, jnp.ones((), x.dtype), dt)

        def decay(dt):
            def of_column(column):
                return sigma.solve(jax.jvp(dynamics.drift, (x,), (column,))[1])

            A = jax.vmap(of_column, 1, 1)(sigma.as_matrix(d, x.dtype))
            return jnp.eye(d, dtype=x.dtype) + dt * A

        return StepsFrom(law, decay)

    def linear_step(self, F, V, dt):
        identity = jnp.eye(F.shape[0], dtype=F.dtype)
        return LinearStep(identity + F * dt, identity * dt, V * dt)


class ItoTaylorDensity(AbstractStepDensity):
    """Step density of the Itô–Taylor expansion of weak order 2, for constant σ.

    Its error is O(δ²) along a path. It needs the first and second derivatives of the drift along
    the columns of σ, which automatic differentiation computes. In a hypoelliptic model the drift
    carries noise to further coordinates within a step.

    **Raises:** `ValueError`, at the first use, for a state-dependent σ.

    **Example:**

    ```python
    proposal = jb.Guided(density=jb.ItoTaylorDensity())  # the default for nonlinear drift
    ```
    """

    order: ClassVar[float] = 2

    def steps_from(self, dynamics, x):
        _check_constant_sigma(self, dynamics)
        sigma, d = dynamics.sigma(x), x.shape[0]
        if not sigma.invertible:
            return _degenerate_ito_taylor(dynamics, x)
        along = [_along(dynamics.drift, x, column) for column in columns_of(sigma, x)]
        slopes, bends = zip(*along, strict=True)
        # Otherwise XLA may compute these derivatives again for each number that depends on them.
        drift, slopes, bends = compute_once((dynamics.drift(x), slopes, bends))
        beta = sigma.solve(drift)
        # σ (Aβ + ½ Δβ), and A with columns σ⁻¹ (∇α σ_k).
        bent = sum_first_axis(jnp.stack([slopes[k] * beta[k] + bends[k] / 2 for k in range(d)]))
        A = jnp.stack([sigma.solve(slope) for slope in slopes], axis=1)
        twice, square, identity = A + A.T, matmul(A, A.T), jnp.eye(d, dtype=x.dtype)

        def law(dt):
            S = identity + dt / 2 * twice + dt**2 / 3 * square
            return StepLaw(x + dt * drift + dt**2 / 2 * bent, sigma, S, dt)

        def decay(dt):
            return identity + dt * A + dt**2 / 2 * matmul(A, A)

        return StepsFrom(law, decay)

    def linear_step(self, F, V, dt):
        return _linear_ito_taylor(F, V, dt)


class HypoellipticDensity(AbstractStepDensity):
    """Step density of the Itô–Taylor expansion for hypoelliptic models with a state-dependent σ(x).

    σ has fewer columns than rows, and the drift carries noise to further coordinates within a step.

    - The error is O(δ) along a path, and discretisation errors are estimated accordingly.
    - The error is O(δ²) if noise does not change σ directly. An example is a noise of velocities
        that depends on positions.
    - For constant σ it equals `ItoTaylorDensity`.
    - Near a boundary where the derivative of σ is not finite (for instance of a square root) the
        Euler step may be more accurate.

    It needs the first and second derivatives of the drift along the columns of σ, and the first
    derivative of σ along the drift. Automatic differentiation computes them.

    **Raises:** `ValueError`, at the first use, for an invertible σ.

    **Example:**

    ```python
    volatility = jb.integrated(jb.Diffusion(lambda x, p: 1 - x, lambda x, p: jnp.sqrt(x)))
    density = jb.HypoellipticDensity()  # the default for records of such models
    ```
    """

    order: ClassVar[float] = 1

    def steps_from(self, dynamics, x):
        if dynamics.sigma(x).invertible:
            raise ValueError(
                "`HypoellipticDensity` needs a σ with fewer columns than rows, but σ of this model "
                "is invertible: leave out `density` for the most accurate default, or pass "
                "`ItoTaylorDensity()` (constant σ) or `EulerDensity()`."
            )
        return _degenerate_ito_taylor(dynamics, x)

    def linear_step(self, F, V, dt):
        return _linear_ito_taylor(F, V, dt)


class QuadraticDensity(AbstractStepDensity):
    """Law of steps of weak order 2 for an invertible, state-dependent σ(x).

    A step is a quadratic function of normal noise, so its law is not normal. Let b be a root of
    V = σσᵀ, L⁰ = α·∇ + ½ Σ V_ik ∂_i ∂_k and A = b⁻¹ ∇α b. Let further

        W_jlm = (b⁻¹ ∂V[b_j] b⁻ᵀ)_lm,    Q_jlm = (W_jlm + W_ljm + W_mjl) / 6.

    The step is x' = μ + √δ b [n + ½ √δ Σ_jl Q_·jl (n_j n_l - S_jl)] with n ~ N(0, S) and
    μ = x + αδ + ½δ² L⁰α. The covariance of n is

        S = I + ½δ M + δ²M²/12,    M = b⁻¹ L⁰V b⁻ᵀ + A + Aᵀ - Σ_jl Q_·jl Q_·jl.

    Its first three moments equal those of the diffusion up to O(δ³):

    - the mean is μ;
    - the third cumulant is 3 δ² Q in noise coordinates. This is ½ δ² (V∇V + ...), a sum over the
        three choices of the differentiated coordinate;
    - the quadratic part adds ½δ² Σ_jl Q_·jl Q_·jl to the covariance, which M subtracts.

    This gives weak order 2 (Kloeden & Platen 1992, section 14.5). All roots of V give the same law.
    The term of order δ² makes S at least ¼ I for every step size. It equals that of
    `ItoTaylorDensity` if Q = 0 and A is symmetric. Weights of paths use the density of n. An
    exactly observed end needs the density of x' itself, so the last step must have another law.

    V must be twice differentiable. At a point where its derivatives are not finite, the path is
    lost; `EulerDensity` needs no derivatives.
    """

    order: ClassVar[float] = 2
    is_normal: ClassVar[bool] = False
    cost: ClassVar[float] = 2.5

    def steps_from(self, dynamics, x):
        d, sigma = x.shape[0], dynamics.sigma(x).root()

        def coefficients(y):
            return dynamics.drift(y), covariance_of(dynamics.sigma(y), y)

        columns = jax.vmap(sigma.solve, in_axes=1, out_axes=1)  # b⁻¹ X

        def in_noise_coordinates(symmetric):
            return columns(columns(symmetric).T)  # b⁻¹ X b⁻ᵀ

        roots = sigma.as_matrix(d, x.dtype).T
        slopes, curvatures = jax.vmap(lambda column: _along(coefficients, x, column))(roots)
        drift, (A, turns), (bends, changes) = dynamics.drift(x), slopes, curvatures
        W, beta = jax.vmap(in_noise_coordinates)(turns), sigma.solve(drift)
        Q = (W + jnp.moveaxis(W, 0, 1) + jnp.moveaxis(W, 0, 2)) / 6
        rows = Q.reshape(d, -1)
        # L⁰f = Σ_k [β_k ∂f[b_k] + ½ ∂²f[b_k, b_k]], because α = b β.
        bend = sum_first_axis(beta[:, None] * A + bends / 2)
        change = sum_first_axis(beta[:, None, None] * W)
        change += in_noise_coordinates(sum_first_axis(changes)) / 2
        A = columns(A.T)
        M = change + A + A.T - matmul(rows, rows.T)
        identity = jnp.eye(d, dtype=x.dtype)

        def law(dt):
            S = identity + dt / 2 * M + dt**2 / 12 * matmul(M, M)
            return StepLaw(x + dt * drift + dt**2 / 2 * bend, sigma, S, dt, Q)

        def decay(dt):
            return identity + dt * A + dt**2 / 2 * matmul(A, A)

        return StepsFrom(law, decay)

    def linear_step(self, F, V, dt):
        return _linear_ito_taylor(F, V, dt)


class LinearDensity(AbstractStepDensity):
    """Transition density of a linear diffusion, α(x) = α(0) + F x with constant σ:

        x' ~ N(x + M_δ α(x), Γ_δ),    M_δ = ∫_0^δ e^{sF} ds,    Γ_δ = ∫_0^δ e^{sF} V e^{sFᵀ} ds.

    There is no discretisation error, whatever the step size and however fast the drift. σ may have
    fewer columns than rows. It has no public name, because linear models have it by default.
    """

    order: ClassVar[float] = math.inf

    def steps_from(self, dynamics, x):
        transition = functools.partial(_transition, dynamics, x)
        return _exponential_steps(dynamics, x, transition, bends=False)

    def linear_step(self, F, V, dt):
        return LinearStep(*linear_transition(F, V, dt))


class _FittedLinearDensity(AbstractStepDensity):
    """`LinearDensity` of one model for one step size, with its transition."""

    transition: LinearTransition
    order: ClassVar[float] = math.inf

    def steps_from(self, dynamics, x):
        return _exponential_steps(dynamics, x, lambda dt: self.transition, bends=False)

    def linear_step(self, F, V, dt):
        return LinearStep(*self.transition)


def known_transition(
    density: AbstractStepDensity,
    dynamics: Dynamics,
    like: Float[Array, " d"],
    dt: Float[Array, ""],
) -> LinearTransition | None:
    """Return the transition in the time `dt` if it is that of each step, otherwise `None`.

    `like` is a point of the right shape and dtype.
    """
    is_linear = isinstance(density, LinearDensity)
    return _transition(dynamics, like, dt) if is_linear else None


def with_transition(
    density: AbstractStepDensity, transition: LinearTransition | None
) -> AbstractStepDensity:
    """Return the density of steps with this known transition, which need not compute it again."""
    return density if transition is None else _FittedLinearDensity(transition)


def _transition(
    dynamics: Dynamics, x: Float[Array, " d"], dt: Float[Array, ""]
) -> LinearTransition:
    """Return the transition of the equation linearised at x."""
    V = covariance_of(dynamics.sigma(x), x)
    return linear_transition(jax.jacfwd(dynamics.drift)(x), V, dt)


class LocalLinearDensity(AbstractStepDensity):
    """Step density of local linearisation, for stiff drift with constant σ.

    Each step is the transition of the diffusion that is linearised at its start (Ozaki 1992; Shoji
    & Ozaki 1998). With F = ∇α(x), M_δ = ∫_0^δ e^{sF} ds and Γ_δ = ∫_0^δ e^{sF} V e^{sFᵀ} ds,

        x' ~ N(x + M_δ [α(x) + ¼ δ Σ_k ∂²α(λ_k, λ_k)], Γ_δ).

    The second term in brackets is the mean change of the drift by the noise. It contains second
    derivatives of α in the directions λ_k; λ_k = σ_k for short steps and for fewer columns than
    rows. For an invertible σ, Σ_k λ_k λ_kᵀ = 2 σ (S⁻¹ + I)⁻¹ σᵀ with Γ_δ = δ σ S σᵀ. So the
    term is right for long steps in a contracting drift, and bounded in an expanding one.

    - Its error is O(δ²) along a path, like that of `ItoTaylorDensity`.
    - Steps may be longer than the relaxation time of a contracting drift, because e^{δF} is no
        polynomial. Their discretisation error is still reported as unknown; compare with twice as
        many steps.
    - A step takes two to three times as long, for the exponential of a matrix.
    - σ may have fewer columns than rows.

    For linear models it is not needed: their default steps are exact.

    **Raises:** `ValueError`, at the first use, for a state-dependent σ.

    **Example:**

    ```python
    proposal = jb.Guided(density=jb.LocalLinearDensity())
    ```
    """

    order: ClassVar[float] = 2
    cost: ClassVar[float] = 2.5

    def steps_from(self, dynamics, x):
        _check_constant_sigma(self, dynamics)
        transition = functools.partial(_transition, dynamics, x)
        return _exponential_steps(dynamics, x, transition, bends=True)

    def linear_step(self, F, V, dt):
        return LinearStep(*linear_transition(F, V, dt))


def _exponential_steps(
    dynamics: Dynamics,
    x: Float[Array, " d"],
    transition_of: Callable[[Float[Array, ""]], LinearTransition],
    bends: bool,
) -> StepsFrom:
    """Return steps N(x + M_δ [α + ¼ δ Σ_k ∂²α(λ_k, λ_k)], Γ_δ), without the sum unless `bends`."""
    sigma, drift = dynamics.sigma(x), dynamics.drift(x)
    columns = jax.vmap(sigma.solve, in_axes=1, out_axes=1)  # σ⁻¹ X

    def law(dt):
        moving, transition = dt > 0, transition_of(dt)
        if sigma.invertible:
            S = columns(columns(transition.covariance / jnp.where(moving, dt, 1)).T)
            S = jnp.where(moving, S, jnp.eye(len(x), dtype=x.dtype))
            made = StepLaw(x, sigma, S, dt)
        else:
            root = jnp.where(moving, semidefinite_cholesky(transition.covariance), 0)
            made = DegenerateLaw(x, root, dt)
        slope = drift
        if bends:
            root = jnp.stack(columns_of(sigma, x), axis=1)
            if isinstance(made, StepLaw):
                root = matmul(root, cholesky(_mean_covariance(made.covariance)))
            bent = [_along(dynamics.drift, x, column)[1] for column in root.T]
            slope = drift + dt / 4 * sum_first_axis(jnp.stack(bent))
        mean = x + matvec(transition.integral, slope)
        return made._replace(mean=jnp.where(moving, mean, x))

    def decay(dt):
        matrix = transition_of(dt).decay
        if not sigma.invertible:
            return matrix
        return columns(matmul(matrix, sigma.as_matrix(len(x), x.dtype)))

    return StepsFrom(law, decay)


def _mean_covariance(S: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Return 2 (S⁻¹ + I)⁻¹, the harmonic mean of S and I.

    With S of a step, it is I for short steps, 2 S for long steps in a contracting drift, and at
    most 2 I in an expanding one.
    """
    identity = jnp.eye(len(S), dtype=S.dtype)
    mean = 2 * solve(S + identity, S)
    return (mean + mean.T) / 2  # symmetric in spite of rounding


def _check_constant_sigma(density: AbstractStepDensity, dynamics: Dynamics) -> None:
    """Raise `ValueError` for a state-dependent σ."""
    if dynamics.sigma_varies:
        raise ValueError(
            f"`{type(density).__name__}` is for constant σ, but σ of this model depends on the "
            "state: leave out `density` for the most accurate default, or pass `EulerDensity()`; "
            "for a σ with fewer columns than rows `HypoellipticDensity()`."
        )


def _linear_ito_taylor(F, V, dt) -> LinearStep:
    """Return the step of the Itô–Taylor expansion for a linear drift."""
    identity = jnp.eye(F.shape[0], dtype=F.dtype)
    integral = dt * identity + dt**2 / 2 * F
    flow = matmul(F, V)
    covariance = dt * V + dt**2 / 2 * (flow + flow.T) + dt**3 / 3 * matmul(flow, F.T)
    return LinearStep(identity + matmul(F, integral), integral, covariance)


def check_step_density(density: AbstractStepDensity | None) -> AbstractStepDensity | None:
    """Return the argument `density`; raise `TypeError` if it is no step density.

    `None` stands for the default of the model.
    """
    if not (density is None or isinstance(density, AbstractStepDensity)):
        raise TypeError(
            "`density` must be `EulerDensity()`, `ItoTaylorDensity()`, `LocalLinearDensity()` or "
            f"`HypoellipticDensity()`; got {density!r}."
        )
    return density


def most_accurate_density(
    model: Diffusion, like: Float[Array, " d"], normal_steps: bool = True
) -> AbstractStepDensity:
    """Return the most accurate step density of a model, for points like `like`.

    `normal_steps` requires normal steps, with which a path determines its noise. Without it, steps
    for an invertible, state-dependent σ are quadratic in the noise, up to ten dimensions.
    """
    sigma_varies, invertible = model.sigma_varies(like), model.sigma_is_invertible(like)
    if decisions.exact_steps(model.is_linear(like)).simulated:
        return LinearDensity()
    if not sigma_varies:
        return ItoTaylorDensity()
    if not invertible:
        return HypoellipticDensity()
    quadratic = decisions.quadratic_noise(invertible, sigma_varies, like.shape[0])
    return EulerDensity() if normal_steps or not quadratic.simulated else QuadraticDensity()


def _degenerate_euler(dynamics: Dynamics, x: Float[Array, " d"]) -> StepsFrom:
    """Return Euler steps for a σ without inverse."""
    drift, sigma = dynamics.drift(x), _matrix(dynamics, x)

    def law(dt):
        root = semidefinite_factor(root_of_length(dt) * sigma)
        return DegenerateLaw(x + drift * dt, root, dt)

    def decay(dt):
        return jnp.eye(x.shape[0], dtype=x.dtype) + dt * jax.jacfwd(dynamics.drift)(x)

    return StepsFrom(law, decay)


def _degenerate_ito_taylor(dynamics: Dynamics, x: Float[Array, " d"]) -> StepsFrom:
    """Return Itô–Taylor steps for a σ without inverse, without the terms Σ ∇σ_k σ_j."""
    sigma, drift = dynamics.sigma(x), dynamics.drift(x)
    columns = columns_of(sigma, x)
    slopes, bends = zip(*[_along(dynamics.drift, x, column) for column in columns], strict=True)
    # Fα + ½ Σ_k ∂²α(σ_k, σ_k), and Fσ.
    bent = jax.jvp(dynamics.drift, (x,), (drift,))[1] + sum_first_axis(jnp.stack(bends)) / 2
    diffusion, drift_slope = jnp.stack(columns, axis=1), jnp.stack(slopes, axis=1)
    sigma_slope = None  # l = ∇σ α, zero for constant σ
    if dynamics.sigma_varies:
        sigma_slope = jax.jvp(lambda y: _matrix(dynamics, y), (x,), (drift,))[1]

    def law(dt):
        # Coefficients of ζ_1 and ζ_2: Fσ + l and Fσ - l.
        root_dt, total, difference = root_of_length(dt), drift_slope, drift_slope
        if sigma_slope is not None:
            bounded = _bounded(sigma_slope, diffusion, dt)
            total, difference = drift_slope + bounded, drift_slope - bounded
        spread = [diffusion + dt / 2 * total, dt * np.sqrt(1 / 12).astype(x.dtype) * difference]
        root = semidefinite_factor(root_dt * jnp.concatenate(spread, axis=1))
        return DegenerateLaw(x + dt * drift + dt**2 / 2 * bent, root, dt)

    def decay(dt):
        F = jax.jacfwd(dynamics.drift)(x)
        return jnp.eye(x.shape[0], dtype=x.dtype) + dt * F + dt**2 / 2 * matmul(F, F)

    return StepsFrom(law, decay)


def _matrix(dynamics: Dynamics, x: Float[Array, " d"]) -> Float[Array, "d m"]:
    """Return σ(x) as a matrix, shape (d, m)."""
    return dynamics.sigma(x).as_matrix(x.shape[0], x.dtype)


def _bounded(
    slopes: Float[Array, "d m"], columns: Float[Array, "d m"], dt: Float[Array, ""]
) -> Float[Array, "d m"]:
    """Return l_k / √(1 + δ² |l_k|² / |σ_k|²) for all columns k of `slopes` and `columns`.

    A step of length δ then changes no column by more than its own length. Slopes of zero columns
    become zero.
    """
    square = jnp.sum(columns**2, axis=0)
    is_nonzero = square > 0
    change = dt**2 * jnp.sum(slopes**2, axis=0) / jnp.where(is_nonzero, square, 1)
    return slopes * jnp.where(is_nonzero, 1 / jnp.sqrt(1 + change), 0)


def _along(field, x: Float[Array, " d"], direction: Float[Array, " d"]):
    """Return the directional derivatives ∂f[v] and ∂²f[v, v] of a function f at x."""

    def first(y):
        return jax.jvp(field, (y,), (direction,))[1]

    return jax.jvp(first, (x,), (direction,))
