"""Normal law of one step from x, of length δ, in two representations.

- `StepLaw`, for an invertible σ: N(μ, δ σ S σᵀ), stored in noise coordinates, with S near I.
- `DegenerateLaw`, for hypoelliptic models, in which noise enters only some coordinates directly:
  N(μ, Λ Λᵀ) with Λ lower triangular. A coordinate without noise has a zero on the diagonal of Λ,
  and then there is no density.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..engine.linalg import (
    cholesky,
    dot,
    matmul,
    matvec,
    quadratic_form,
    semidefinite_factor,
    solve_lower,
    sum_first_axis,
)
from ..models.sigma import AbstractSigma


class StepLaw(NamedTuple):
    """Normal law N(μ, δ σ S σᵀ) of one step of length δ from one point, for an invertible σ.

    - `mean`: μ, shape (d,).
    - `sigma`: σ at the point.
    - `covariance`: S in noise coordinates, shape (d, d), or a scalar for a multiple of I.
    - `dt`: δ.
    - `curvature`: Q of the quadratic part of a step that is not normal (`bent`), shape (d, d, d);
        `None` for a normal law.
    """

    mean: Float[Array, "d *lanes"]
    sigma: AbstractSigma
    covariance: Float[Array, "..."]
    dt: Float[Array, "*lanes"]
    curvature: Float[Array, "d d d"] | None = None

    @property
    def matrix(self) -> Float[Array, "d d"]:
        """Return S as a matrix, shape (d, d), also if `covariance` is a scalar."""
        S, d = self.covariance, self.mean.shape[0]
        return S * jnp.eye(d, dtype=self.mean.dtype) if S.ndim == 0 else S

    @property
    def root(self) -> Float[Array, "d d"]:
        """Return Λ of N(μ, Λ Λᵀ), shape (d, d); zero for δ = 0."""
        root = self.sigma.as_matrix(self.mean.shape[0], self.mean.dtype) * root_of_length(self.dt)
        S = self.covariance
        return root * jnp.sqrt(S) if S.ndim == 0 else matmul(root, cholesky(S))

    def solve(self, displacement: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return Λ⁻¹ times the displacement; zero for δ = 0."""
        moving = self.dt > 0
        # The replaced length avoids 0 / 0, which would make derivatives NaN.
        safe = self._replace(dt=jnp.where(moving, self.dt, 1))
        return jnp.where(moving, safe.noise(safe.mean + displacement), 0)

    def point(self, xi: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the point μ + √δ σ L ξ, with S = L Lᵀ."""
        S = self.covariance
        noise = jnp.sqrt(S) * xi if S.ndim == 0 else matvec(cholesky(S), xi)
        return self.mean + jnp.sqrt(self.dt) * self.sigma.mv(noise)

    def end(self, xi: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the end of the step with the noise ξ ~ N(0, I)."""
        return self.bent(self.point(xi))

    def bent(self, point: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the end of the step whose normal part ends in `point`,

            x' = point + ½ δ σ Σ_jl Q_·jl (n_j n_l - S_jl),    point = μ + √δ σ n.

        For δ = 0 it is `point` itself.
        """
        if self.curvature is None:
            return point
        moving = self.dt > 0
        n = self._replace(dt=jnp.where(moving, self.dt, 1))._scaled(point)  # avoids 0 / 0
        square = (n[:, None] * n - self.covariance).reshape(-1)
        rows = self.curvature.reshape(n.shape[0], -1)
        bent = point + self.dt / 2 * self.sigma.mv(matvec(rows, square))
        return jnp.where(moving, bent, point)

    def noise(self, point: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the noise ξ ~ N(0, I) of the step to `point`, the inverse of `point(ξ)`."""
        S, scaled = self.covariance, self._scaled(point)
        return scaled / jnp.sqrt(S) if S.ndim == 0 else solve_lower(cholesky(S), scaled)

    def log_relative(self, point: Float[Array, " d"]) -> Float[Array, ""]:
        """Return ½ (d - |ξ|² - log det S), the log density without a term of σ, δ and d.

        All laws with the same σ and δ share the omitted term. Sums along a path stay small, which
        limits rounding errors.
        """
        scaled = self._scaled(point)
        if self.covariance.ndim == 0:
            square, log_det = dot(scaled, scaled) / self.covariance, self._log_det()
        else:
            square, log_det = quadratic_form(self.covariance, scaled)
        # E|ξ|² = d, so the terms of a sum along a path have means near zero.
        return (scaled.shape[0] - square - log_det) / 2

    def log_relative_of_noise(self, xi: Float[Array, " d"]) -> Float[Array, ""]:
        """Return `log_relative` of the point that the noise `xi` leads to."""
        return (xi.shape[0] - dot(xi, xi) - self._log_det()) / 2

    @property
    def log_scale(self) -> Float[Array, ""]:
        """Return log |det σ|, which `log_relative` omits."""
        return self.sigma.log_abs_det()

    def carried(
        self, decay: Float[Array, "d d"], displacement: Float[Array, " d"]
    ) -> Float[Array, " d"]:
        """Return the displacement after a linear step, with `decay` in noise coordinates."""
        return self.sigma.mv(matvec(decay, self.sigma.solve(displacement)))

    def after(
        self, first: "StepLaw", decay: Float[Array, "d d"], x: Float[Array, " d"]
    ) -> "StepLaw":
        """Return the law at the end of two steps from `x`: `first`, then a linear step.

        `self` is the law of that linear step if it started in `x`. `decay` is its matrix, in noise
        coordinates.
        """
        dt = first.dt + self.dt
        if first.sigma is self.sigma:
            covariance = first.dt * matmul(matmul(decay, first.matrix), decay.T)
        else:  # at another time: the noise of the first step in the coordinates of this one
            columns = [self.sigma.solve(column) for column in first.root.T]
            root = matmul(decay, jnp.stack(columns, axis=1))
            covariance = matmul(root, root.T)
        covariance = (covariance + self.dt * self.matrix) / dt
        mean = self.mean + self.carried(decay, first.mean - x)
        return StepLaw(mean, self.sigma, covariance, dt)

    def log_density(self, point: Float[Array, " d"]) -> Float[Array, ""]:
        """Return the log density of the step to `point`, in units of space to the power -d."""
        scale = self.log_scale + point.shape[0] * jnp.log(2 * np.pi * self.dt) / 2
        return self.log_relative(point) - point.shape[0] / 2 - scale

    def _scaled(self, point):
        """Return n of the step to `point` = μ + √δ σ n."""
        return self.sigma.solve(point - self.mean) / jnp.sqrt(self.dt)

    def _log_det(self):
        """Return log det S."""
        if self.covariance.ndim == 0:
            return self.mean.shape[0] * jnp.log(self.covariance)
        return quadratic_form(self.covariance, jnp.zeros_like(self.mean))[1]


class DegenerateLaw(NamedTuple):
    """Normal law N(μ, Λ Λᵀ), possibly singular, of one step of length δ.

    - `mean`: μ, shape (d,).
    - `root`: Λ, lower triangular, shape (d, d). The diagonal of Λ is zero for coordinates without
        noise.
    - `dt`: δ.
    """

    mean: Float[Array, "d *lanes"]
    root: Float[Array, "d d *lanes"]
    dt: Float[Array, "*lanes"]

    @property
    def _moves(self):
        """Return the mask of the coordinates with noise."""
        return jnp.diagonal(self.root) > 0

    def end(self, xi: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the end of the step with the noise ξ ~ N(0, I)."""
        return self.mean + matvec(self.root, xi)

    def solve(self, displacement: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return Λ⁻¹ times the displacement; zero for coordinates without noise."""
        return solve_root(self.root, displacement)

    def log_relative(self, point: Float[Array, " d"]) -> Float[Array, ""]:
        """Return ½ (d - |ξ|²) - log det Λ, the log density without a term that depends on d only.

        Return NaN if the law has no density.
        """
        xi = self.solve(point - self.mean)
        log_det = sum_first_axis(jnp.log(jnp.where(self._moves, jnp.diagonal(self.root), jnp.nan)))
        return (xi.shape[0] - dot(xi, xi)) / 2 - log_det

    @property
    def log_scale(self) -> Float[Array, ""]:
        """Return zero: `log_relative` omits no term that depends on the law."""
        return jnp.zeros((), self.mean.dtype)

    def carried(
        self, decay: Float[Array, "d d"], displacement: Float[Array, " d"]
    ) -> Float[Array, " d"]:
        """Return the displacement after a linear step, with `decay` in state coordinates."""
        return matvec(decay, displacement)

    def after(
        self, first: "DegenerateLaw", decay: Float[Array, "d d"], x: Float[Array, " d"]
    ) -> "DegenerateLaw":
        """Return the law at the end of two steps from `x`: `first`, then a linear step.

        `self` is the law of that linear step if it started in `x`. `decay` is its matrix, in state
        coordinates.
        """
        mean = self.mean + self.carried(decay, first.mean - x)
        # Λ Λᵀ of both steps is the sum of two squares, hence the square of the joined matrix.
        both = jnp.concatenate([matmul(decay, first.root), self.root], axis=1)
        return DegenerateLaw(mean, semidefinite_factor(both), first.dt + self.dt)


def solve_root(root: Float[Array, "d d"], displacement: Float[Array, " d"]) -> Float[Array, " d"]:
    """Return Λ⁻¹ times the displacement for a lower triangular Λ.

    Coordinates with a zero on the diagonal of Λ have no noise; their result is zero.
    """
    still = jnp.diagonal(root) == 0
    # Ones on the diagonal keep the triangular system solvable.
    safe = root + jnp.diag(jnp.where(still, 1, 0).astype(root.dtype))
    return jnp.where(still, 0, solve_lower(safe, displacement))


def root_of_length(dt: Float[Array, ""]) -> Float[Array, ""]:
    """Return √δ, with derivative zero instead of infinity at δ = 0."""
    moving = dt > 0
    return jnp.where(moving, jnp.sqrt(jnp.where(moving, dt, 1)), 0)
