"""Discretisation schemes, each with its step and its inverse.

A bridge is built from a path that was simulated backwards, so each scheme must also answer:
which noise drives the forward equation along a given path? (equation (Wrev) of the paper for
Euler). Steps have length δ, in units of time; noise increments are N(0, δ I).

The inverse must use the forward drift. To take the negative of the noise that generated the
reversed path would be wrong by O(δ) per step, which adds up to the drift itself.
"""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..engine.linalg import cholesky, inverse, matmul, matvec, solve
from ..models import decisions
from ..models.diffusion import Dynamics, is_linear, ito_correction
from ..models.linear import linear_transition
from ..models.sigma import Constant, Diagonal
from .frame import Frame, frame, frame_of


class AbstractScheme(eqx.Module):
    """A one-step scheme. All methods act on one point of shape (d,); `dt` is a scalar.

    `stratonovich` says whether it works with Stratonovich's form of the equation.
    """

    stratonovich: ClassVar[bool]

    @abstractmethod
    def fitted(
        self, dynamics: Dynamics, like: Float[Array, " d"], dt: Float[Array, ""]
    ) -> "AbstractScheme":
        """The scheme with all that depends on the equation and the step size but not on the
        point, such as matrix functions, worked out. One without such things returns itself."""

    @abstractmethod
    def step(
        self,
        dynamics: Dynamics,
        x: Float[Array, " d"],
        dt: Float[Array, ""],
        dw: Float[Array, " d"],
    ) -> Float[Array, " d"]:
        """The point reached from `x` after `dt` with noise increment `dw`."""

    @abstractmethod
    def noise(
        self,
        dynamics: Dynamics,
        x: Float[Array, " d"],
        x_next: Float[Array, " d"],
        dt: Float[Array, ""],
    ) -> Float[Array, " d"]:
        """The noise increment that takes `x` to `x_next` in `dt`: the inverse of `step`."""

    @abstractmethod
    def frame(
        self,
        dynamics: Dynamics,
        x: Float[Array, " d"],
        driven: Float[Array, " d"],
        dt: Float[Array, ""],
    ) -> Frame:
        """How a pair lies for the noise of the step, once the drift of it is done (`meeting`)."""


class Euler(AbstractScheme):
    """Euler–Maruyama, `x + α(x)δ + σ(x)ΔW`, as in the paper. Its inverse is exact.

    Strong order ½ (1 for constant σ), weak order 1.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, scheme=jb.Euler())
    ```
    """

    stratonovich: ClassVar[bool] = False

    def fitted(self, dynamics, like, dt):
        return self

    def step(self, dynamics, x, dt, dw):
        return x + dynamics.drift(x) * dt + dynamics.sigma(x).mv(dw)

    def noise(self, dynamics, x, x_next, dt):
        return dynamics.sigma(x).solve(x_next - x - dynamics.drift(x) * dt)

    def frame(self, dynamics, x, driven, dt):
        return _frame_after_drift(dynamics, x, driven, dt)


class Milstein(AbstractScheme):
    """Milstein's scheme for diagonal noise, where σ_i depends on x_i alone (which covers d = 1):

        x_i + α_i δ + σ_i ΔW_i + ½ σ_i ∂_iσ_i (ΔW_i² - δ).

    Strong order 1. The inverse solves the quadratic for the root that tends to the Euler
    noise as ∂σ → 0; it is exact as long as `1 + ∂_iσ_i ΔW_i > 0`, which fails with a
    probability that vanishes faster than any power of δ. Of a step that no increment explains it
    is the fold, ΔW_i = -1/∂_iσ_i, whose step comes nearest. For constant σ this is Euler.

    **Raises:** `ValueError`, when it is used, for a σ that is a full, state-dependent matrix.

    **Example:**

    ```python
    model = jb.Diffusion(  # its stationary law is a Student's t
        lambda x, p: -x, lambda x, p: jnp.sqrt(1 + x**2), lambda x, p: -2 * jnp.log1p(x @ x)
    )
    coupling = jb.Coupling(0.5, scheme=jb.Milstein())
    bridges = jb.sample_bridges(key, model, [0.0], [1.0], 2.0, num_bridges=100, coupling=coupling)
    ```
    """

    stratonovich: ClassVar[bool] = False

    def fitted(self, dynamics, like, dt):
        return self

    def step(self, dynamics, x, dt, dw):
        sigma = dynamics.sigma(x)
        step = x + dynamics.drift(x) * dt + sigma.mv(dw)
        if not dynamics.sigma_varies:
            return step
        return step + sigma.mv(self._slope(dynamics, x)) * (dw**2 - dt) / 2

    def noise(self, dynamics, x, x_next, dt):
        euler = dynamics.sigma(x).solve(x_next - x - dynamics.drift(x) * dt)
        if not dynamics.sigma_varies:
            return euler
        slope = self._slope(dynamics, x)
        increment = euler + slope * dt / 2  # = ΔW + ½ ∂σ ΔW²
        discriminant = 1 + 2 * slope * increment
        # At the fold ΔW = -1/∂σ, and no increment explains a step past it.
        past = discriminant <= 0
        increment = jnp.where(past, -0.5 / jnp.where(past, slope, 1), increment)
        return 2 * increment / (1 + _root(discriminant))

    def frame(self, dynamics, x, driven, dt):
        return _frame_after_drift(dynamics, x, driven, dt)

    @staticmethod
    def _slope(dynamics: Dynamics, x: Float[Array, " d"]) -> Float[Array, " d"]:
        """∂_iσ_i(x)."""

        def diagonal(y):
            sigma = dynamics.sigma(y)
            if isinstance(sigma, Diagonal):
                return sigma.diagonal
            if y.shape[0] == 1:
                return sigma.as_matrix(1, y.dtype)[0]
            raise ValueError(
                "`Milstein` is for scalar or diagonal noise: let `diffusion` return the "
                "diagonal of σ, shape (d,), or choose `Heun` or `Euler`."
            )

        return jax.jvp(diagonal, (x,), (jnp.ones_like(x),))[1]


class Heun(AbstractScheme):
    """Heun's predictor–corrector for the Stratonovich form of the equation,

        x + ½ [α_S(x) + α_S(x̃)] δ + ½ [σ(x) + σ(x̃)] ΔW,    α_S = α - ½ Σ_jk ∂_kσ_·j σ_kj,

    with x̃ the Euler point of the same form. Weak order 2 for constant σ, 1 otherwise.

    The inverse is that of the trapezoid rule along the path,
    `½ [σ(x) + σ(x⁺)] ξ = x⁺ - x - ½ [α_S(x) + α_S(x⁺)] δ`; after a predictor–corrector step it
    returns the noise up to O(δ^{3/2}), for constant σ up to O(δ^{5/2}).

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, scheme=jb.Heun())  # the default
    ```
    """

    stratonovich: ClassVar[bool] = True

    def fitted(self, dynamics, like, dt):
        return self

    def step(self, dynamics, x, dt, dw):
        drift, sigma = self._stratonovich_drift(dynamics, x), dynamics.sigma(x)
        predicted = x + drift * dt + sigma.mv(dw)
        drift = (drift + self._stratonovich_drift(dynamics, predicted)) / 2
        return x + drift * dt + sigma.average(dynamics.sigma(predicted)).mv(dw)

    def noise(self, dynamics, x, x_next, dt):
        drift = self._stratonovich_drift(dynamics, x) + self._stratonovich_drift(dynamics, x_next)
        sigma = dynamics.sigma(x).average(dynamics.sigma(x_next))
        return sigma.solve(x_next - x - drift * dt / 2)

    def frame(self, dynamics, x, driven, dt):
        """For constant σ the noise of the step is σ (I + ½ ∇α δ) ΔW, so the gap at its end lies
        along (I + ½ ∇α δ) u if u is taken after half the drift. The length stays that at the
        beginning, since D_{i+1} is measured at the end: it is their product that counts."""
        now = frame(dynamics.sigma(driven), x, driven)
        if dynamics.sigma_varies:
            return now
        half = _frame_after_drift(dynamics, x, driven, dt / 2)
        return now._replace(u=half.u)

    def _stratonovich_drift(self, dynamics: Dynamics, x: Float[Array, " d"]) -> Float[Array, " d"]:
        drift = dynamics.drift(x)
        corrected = decisions.stratonovich(self.stratonovich, dynamics.sigma_varies).simulated
        return drift - ito_correction(dynamics, x) if corrected else drift


class SemiImplicit(AbstractScheme):
    """The linearly implicit trapezoid rule, for stiff or superlinear drift,

        x + L⁻¹ [α(x) δ + σ(x) ΔW],    L = I - ½ δ ∇α(x),

    with ∇α by automatic differentiation. A step is one solve, and its inverse is explicit,
    `σ⁻¹ [L (x⁺ - x) - α δ]`. It does not overflow where explicit schemes do: of a linear drift it
    keeps the stationary law exactly however long the steps, and for α = -x³ far out a step
    leads to x/3. Strong order ½ (1 for constant σ), weak order 1, 2 for linear drift.

    Steps must be short beside the inverse of the positive eigenvalues of ½∇α, at which L is
    singular: those of the barrier in a double well.

    **Example:**

    ```python
    quartic = jb.langevin(lambda x, p: -(x @ x) ** 2 / 2)
    coupling = jb.Coupling(0.5, scheme=jb.SemiImplicit())
    bridges = jb.sample_bridges(key, quartic, [0.0], [1.0], 2.0, num_bridges=100, coupling=coupling)
    ```
    """

    stratonovich: ClassVar[bool] = False

    def fitted(self, dynamics, like, dt):
        return self

    def step(self, dynamics, x, dt, dw):
        drift, implicit = self._linearised(dynamics, x, dt)
        return x + solve(implicit, drift * dt + dynamics.sigma(x).mv(dw))

    def noise(self, dynamics, x, x_next, dt):
        drift, implicit = self._linearised(dynamics, x, dt)
        return dynamics.sigma(x).solve(matvec(implicit, x_next - x) - drift * dt)

    def frame(self, dynamics, x, driven, dt):
        """The root of the noise is L⁻¹σ, at x'."""
        drift, implicit = self._linearised(dynamics, x, dt)
        driven_drift, driven_implicit = self._linearised(dynamics, driven, dt)
        gone = solve(implicit, drift * dt) - solve(driven_implicit, driven_drift * dt)
        d, sigma = x.shape[0], dynamics.sigma(driven)
        units = [jnp.asarray(unit, x.dtype) for unit in np.eye(d)]
        whiten = jnp.stack([sigma.solve(matvec(driven_implicit, unit)) for unit in units], axis=1)
        root = solve(driven_implicit, sigma.as_matrix(d, x.dtype))
        return frame_of(Constant(root, whiten), x - driven + gone)

    def _linearised(self, dynamics: Dynamics, x: Float[Array, " d"], dt: Float[Array, ""]):
        """α and L at x."""
        slope = jax.jacfwd(dynamics.drift)(x)
        return dynamics.drift(x), jnp.eye(x.shape[0], dtype=x.dtype) - slope * dt / 2


class GaussianTransition(AbstractScheme):
    """The exact transition of a linear diffusion, α(x) = α(0) + A x with constant σ,

        x + M_δ α(x) + R ΔW,    M_δ = ∫_0^δ e^{sA} ds,   R Rᵀ δ = Γ_δ,

    with the root R = σ L, L lower triangular, that tends to σ as δ → 0. Paths of the diffusion
    and of its time reversal have no step error at all, nor have bridges made of them, and
    transition densities by these, if the meeting rule is `BrownianCrossing`: at its grid points
    one step is as good as many. That is so for given parameters only. Where parameters are
    inferred from the paths (`gibbs`, `score`, `maximum_likelihood`) the likelihood of a path has a
    step error of its own, whatever the scheme, so there `num_steps` still counts.

    **Raises:** `ValueError`, when it is used, for a drift that is not linear, or σ that depends on
    the state.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, scheme=jb.GaussianTransition())
    bridges = jb.sample_bridges(key, model, start, end, 1.0, num_bridges=100, coupling=coupling)
    ```
    """

    stratonovich: ClassVar[bool] = False

    def fitted(self, dynamics, like, dt):
        if not is_linear(dynamics, like):
            raise ValueError(
                "`GaussianTransition` is for linear drift and constant σ; this model has "
                f"{'a σ that depends on the state' if dynamics.sigma_varies else 'another drift'}. "
                "Choose `Heun()`."
            )
        sigma = dynamics.sigma(like).as_matrix(like.shape[0], like.dtype)
        moments = linear_transition(jax.jacfwd(dynamics.drift)(like), matmul(sigma, sigma.T), dt)
        whitened = solve(sigma, solve(sigma, moments.covariance / dt).T)
        root = matmul(sigma, cholesky(whitened))
        return _FittedTransition(moments.integral, Constant(root, inverse(root)))

    def step(self, dynamics, x, dt, dw):
        return self.fitted(dynamics, x, dt).step(dynamics, x, dt, dw)

    def noise(self, dynamics, x, x_next, dt):
        return self.fitted(dynamics, x, dt).noise(dynamics, x, x_next, dt)

    def frame(self, dynamics, x, driven, dt):
        return self.fitted(dynamics, x, dt).frame(dynamics, x, driven, dt)


class _FittedTransition(AbstractScheme):
    """The same for one equation and one step size."""

    integral: Float[Array, "d d"]
    root: Constant
    stratonovich: ClassVar[bool] = False

    def fitted(self, dynamics, like, dt):
        return self

    def step(self, dynamics, x, dt, dw):
        return x + matvec(self.integral, dynamics.drift(x)) + self.root.mv(dw)

    def noise(self, dynamics, x, x_next, dt):
        return self.root.solve(x_next - x - matvec(self.integral, dynamics.drift(x)))

    def frame(self, dynamics, x, driven, dt):
        drift = dynamics.drift(x) - dynamics.drift(driven)
        return frame_of(self.root, x - driven + matvec(self.integral, drift))


def _root(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """√x, zero below zero; within rounding of zero a chord, whose slope is finite."""
    eps = jnp.finfo(x.dtype).eps
    return jnp.where(x > eps, jnp.sqrt(jnp.maximum(x, eps)), jnp.maximum(x, 0) / eps**0.5)


def _frame_after_drift(
    dynamics: Dynamics, x: Float[Array, " d"], driven: Float[Array, " d"], dt: Float[Array, ""]
) -> Frame:
    """The gap when each has gone α δ."""
    drift = dynamics.drift(x) - dynamics.drift(driven)
    return frame_of(dynamics.sigma(driven), x - driven + drift * dt)


def fitted_in_lanes(
    scheme: AbstractScheme,
    dynamics: Dynamics,
    like: Float[Array, " d"],
    dt: Float[Array, " lanes"],
) -> AbstractScheme:
    """The scheme of each lane: arrays get a trailing axis."""
    return jax.vmap(lambda dt: scheme.fitted(dynamics, like, dt), out_axes=-1)(dt)
