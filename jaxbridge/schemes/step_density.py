"""The law of one step, from x in a time δ: what a path's weight is made of.

The target of a weighted path is a Markov chain on its grid, whose steps are normal,

    x' ~ N(μ(x), δ σ(x) S(x) σ(x)ᵀ).

Each step has a probability density, so the weights have the chain's own transition density as
their mean: finite, whatever the model. How near that is to p_T is the step error.

`EulerDensity`, μ = x + αδ and S = I, is O(δ) away, for any σ. For constant σ more is known. In the
coordinates of the noise, with β = σ⁻¹α and A = ∇β, the first terms of Itô's and Taylor's expansion
(Kloeden & Platen 1992, section 14.2) are normal as well, `ItoTaylorDensity`,

    x + βδ + ½δ² (Aβ + ½Δβ) + ∫_0^δ [I + (δ-s) A] dW_s,

with S = I + ½δ(A + Aᵀ) + ⅓δ² AAᵀ ≥ ¼ I however long the step, and O(δ²) away from p_T.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..engine.linalg import cholesky, dot, matmul, matvec, quadratic_form, solve_lower, total
from ..models.dynamics import Dynamics
from ..models.sigma import AbstractSigma


class StepLaw(NamedTuple):
    """N(μ, δ σ S σᵀ), the law of a step from one point in a time δ.

    - `mean`: μ, shape (d,).
    - `sigma`: σ at the point.
    - `covariance`: S in the coordinates of the noise, shape (d, d), or a number, shape (), for a
        multiple of I.
    - `dt`: δ.
    """

    mean: Float[Array, "d *lanes"]
    sigma: AbstractSigma
    covariance: Float[Array, "..."]
    dt: Float[Array, "*lanes"]

    @property
    def matrix(self) -> Float[Array, "d d"]:
        """S, also where it is a number."""
        S, d = self.covariance, self.mean.shape[0]
        return S * jnp.eye(d, dtype=self.mean.dtype) if S.ndim == 0 else S

    def point(self, xi: Float[Array, " d"]) -> Float[Array, " d"]:
        """μ + √δ σ L ξ, with S = L Lᵀ."""
        S = self.covariance
        noise = jnp.sqrt(S) * xi if S.ndim == 0 else matvec(cholesky(S), xi)
        return self.mean + jnp.sqrt(self.dt) * self.sigma.mv(noise)

    def noise(self, point: Float[Array, " d"]) -> Float[Array, " d"]:
        """ξ of the step to this point."""
        S, scaled = self.covariance, self._scaled(point)
        return scaled / jnp.sqrt(S) if S.ndim == 0 else solve_lower(cholesky(S), scaled)

    def log_relative(self, point: Float[Array, " d"]) -> Float[Array, ""]:
        """log of the density, but for factors that all laws with this σ and δ share:
        ½ (d - |ξ|² - log det S), of which sums along a path stay small."""
        scaled = self._scaled(point)
        if self.covariance.ndim == 0:
            square, log_det = dot(scaled, scaled) / self.covariance, self._log_det()
        else:
            square, log_det = quadratic_form(self.covariance, scaled)
        return (scaled.shape[0] - square - log_det) / 2

    def log_relative_of_noise(self, xi: Float[Array, " d"]) -> Float[Array, ""]:
        """The same at the point of this noise."""
        return (xi.shape[0] - dot(xi, xi) - self._log_det()) / 2

    def log_density(self, point: Float[Array, " d"]) -> Float[Array, ""]:
        """Of the step to this point, in units of space to the power -d."""
        scale = self.sigma.log_abs_det() + point.shape[0] * jnp.log(2 * np.pi * self.dt) / 2
        return self.log_relative(point) - point.shape[0] / 2 - scale

    def _scaled(self, point):
        return self.sigma.solve(point - self.mean) / jnp.sqrt(self.dt)

    def _log_det(self):
        if self.covariance.ndim == 0:
            return self.mean.shape[0] * jnp.log(self.covariance)
        return quadratic_form(self.covariance, jnp.zeros_like(self.mean))[1]


class LinearStep(NamedTuple):
    """A step of dX = [c + F X] dt + σ dW: x' ~ N(`decay` x + `integral` c, `covariance`), with
    matrices of shape (d, d)."""

    decay: Float[Array, "d d"]
    integral: Float[Array, "d d"]
    covariance: Float[Array, "d d"]


class StepsFrom(NamedTuple):
    """Steps from one point, as functions of their length δ.

    - `law`: the law of the step.
    - `decay`: the derivative of the mean of σ⁻¹x' in σ⁻¹x, shape (d, d), where the drift is linear.
    """

    law: Callable[[Float[Array, ""]], StepLaw]
    decay: Callable[[Float[Array, ""]], Float[Array, "d d"]]


class AbstractStepDensity(eqx.Module):
    """The normal law of a step. `order` is p of the error O(δ^p) that it adds up to along a path,
    in the mean over paths."""

    order: ClassVar[int]

    @abstractmethod
    def steps_from(self, dynamics: Dynamics, x: Float[Array, " d"]) -> StepsFrom:
        """The law of a step from x."""

    @abstractmethod
    def linear_step(
        self, F: Float[Array, "d d"], V: Float[Array, "d d"], dt: Float[Array, ""]
    ) -> LinearStep:
        """The same of a linear process with V = σσᵀ, of which it is a closed form."""


class EulerDensity(AbstractStepDensity):
    """The Euler scheme, N(x + α(x) δ, V(x) δ), for any σ: O(δ) along a path.

    **Example:**

    ```python
    proposal = jb.ModifiedDiffusionBridge(density=jb.EulerDensity())
    ```
    """

    order: ClassVar[int] = 1

    def steps_from(self, dynamics, x):
        drift, sigma, d = dynamics.drift(x), dynamics.sigma(x).root(), x.shape[0]

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
    """Itô's and Taylor's expansion of weak order 2, for constant σ: O(δ²) along a path.

    It calls for the first and second derivatives of the drift along the columns of σ, by autodiff.

    **Raises:** `ValueError`, when it is used, for a σ that depends on the state.

    **Example:**

    ```python
    proposal = jb.Guided(density=jb.ItoTaylorDensity())  # the default for constant σ
    ```
    """

    order: ClassVar[int] = 2

    def steps_from(self, dynamics, x):
        if dynamics.sigma_varies:
            raise ValueError(
                "`ItoTaylorDensity` is for constant σ, but this one depends on the state: choose "
                "`EulerDensity()`."
            )
        sigma, d = dynamics.sigma(x), x.shape[0]
        along = [_along(dynamics.drift, x, column) for column in _columns(sigma, x)]
        slopes, bends = zip(*along, strict=True)
        drift = dynamics.drift(x)
        beta = sigma.solve(drift)
        # σ (Aβ + ½ Δβ), and A with columns σ⁻¹ (∇α σ_k).
        bent = total(jnp.stack([slopes[k] * beta[k] + bends[k] / 2 for k in range(d)]))
        A = jnp.stack([sigma.solve(slope) for slope in slopes], axis=1)
        twice, square, identity = A + A.T, matmul(A, A.T), jnp.eye(d, dtype=x.dtype)

        def law(dt):
            S = identity + dt / 2 * twice + dt**2 / 3 * square
            return StepLaw(x + dt * drift + dt**2 / 2 * bent, sigma, S, dt)

        def decay(dt):
            return identity + dt * A + dt**2 / 2 * matmul(A, A)

        return StepsFrom(law, decay)

    def linear_step(self, F, V, dt):
        identity = jnp.eye(F.shape[0], dtype=F.dtype)
        integral = dt * identity + dt**2 / 2 * F
        flow = matmul(F, V)
        covariance = dt * V + dt**2 / 2 * (flow + flow.T) + dt**3 / 3 * matmul(flow, F.T)
        return LinearStep(identity + matmul(F, integral), integral, covariance)


def check_step_density(density: AbstractStepDensity | None) -> AbstractStepDensity | None:
    """What the user gave as `density`; `None` leaves it to the model."""
    if not (density is None or isinstance(density, AbstractStepDensity)):
        raise TypeError(
            f"`density` must be `EulerDensity()` or `ItoTaylorDensity()`; got {density!r}."
        )
    return density


def most_accurate_density(sigma_varies: bool) -> AbstractStepDensity:
    """That which the model has."""
    return EulerDensity() if sigma_varies else ItoTaylorDensity()


def _columns(sigma: AbstractSigma, x: Float[Array, " d"]) -> list[Float[Array, " d"]]:
    """Those of σ."""
    return [sigma.mv(jnp.asarray(unit, x.dtype)) for unit in np.eye(x.shape[0])]


def _along(field, x: Float[Array, " d"], direction: Float[Array, " d"]):
    """∂f[v] and ∂²f[v, v]."""

    def first(y):
        return jax.jvp(field, (y,), (direction,))[1]

    return jax.jvp(first, (x,), (direction,))
