"""The diffusion coefficient σ(x) at one point, as a linear operator.

There are six forms:

- The identity.
- A constant matrix, inverted once, outside the loop over time.
- A diagonal.
- A full matrix that depends on the state.
- A lower triangular matrix that depends on the state.
- A tall matrix, for noise in fewer dimensions than the state. It has no inverse.

Callers use the methods of `AbstractSigma` for all of them, and each form does only the work that it
needs.

The law of the diffusion depends on V = σσᵀ only. So the triangular root L may replace a full σ(x) =
L Q. Solving with L needs neither elimination nor pivots. L does not rotate: it is a smooth function
of V, whatever Q is.
"""

from abc import abstractmethod
from typing import ClassVar, NoReturn

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..engine.linalg import (
    any_inverse,
    cholesky,
    log_abs_det,
    lower_factor,
    matmul,
    matvec,
    solve,
    solve_lower,
    sum_first_axis,
)

NO_INVERSE = (
    "σ of this `model` has fewer columns than rows, so noise enters only some coordinates. "
    "Couplings, bridges between exact states and transition densities need an inverse of σ. Use "
    "`simulate`; or, with an `observation`, `log_likelihood`, `smooth`, `innovations`, `gibbs`, "
    "`pmmh` and `maximum_likelihood`. For an exactly observed state the `observation` is "
    "`jb.LinearGaussian(covariance=0.0)`."
)


class AbstractSigma(eqx.Module):
    """Operator σ(x) at one point: a linear map from noise, shape (d,), to space, shape (d,).

    `invertible` is false for a tall matrix only, whose noise has shape (m,), m < d.
    """

    invertible: ClassVar[bool] = True

    @abstractmethod
    def mv(self, noise: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return `σ w`."""

    @abstractmethod
    def mv_transpose(self, vector: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return `σᵀ v`."""

    @abstractmethod
    def solve(self, vector: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return `σ⁻¹ v`."""

    @abstractmethod
    def average(self, other: "AbstractSigma") -> "AbstractSigma":
        """Return `½ (σ + other)`, for two values of one model's σ."""

    @abstractmethod
    def log_abs_det(self) -> Float[Array, ""]:
        """Return `log |det σ|`."""

    @abstractmethod
    def as_matrix(self, dim: int, dtype) -> Float[Array, "d m"]:
        """Return `σ` as a dense matrix of `dim` rows."""

    @abstractmethod
    def root(self) -> "AbstractSigma":
        """Return a root of V = σσᵀ. If σ varies and is invertible, the root depends on V alone."""


class Identity(AbstractSigma):
    """Operator σ = I."""

    def mv(self, noise):
        return noise

    def mv_transpose(self, vector):
        return vector

    def solve(self, vector):
        return vector

    def average(self, other):
        return self

    def log_abs_det(self):
        return jnp.asarray(0.0)

    def as_matrix(self, dim, dtype):
        return jnp.eye(dim, dtype=dtype)

    def root(self):
        return self


class Constant(AbstractSigma):
    """Matrix that is the same at all points, stored with its inverse."""

    matrix: Float[Array, "d d"]
    inverse: Float[Array, "d d"]

    def __init__(self, matrix: Float[Array, "d d"], inverse: Float[Array, "d d"] | None = None):
        self.matrix = matrix
        self.inverse = any_inverse(matrix) if inverse is None else inverse

    def mv(self, noise):
        return matvec(self.matrix, noise)

    def mv_transpose(self, vector):
        return matvec(self.matrix.T, vector)

    def solve(self, vector):
        return matvec(self.inverse, vector)

    def average(self, other):  # both are the same constant
        return self

    def log_abs_det(self):
        return log_abs_det(self.matrix)

    def as_matrix(self, dim, dtype):
        return self.matrix

    def root(self):
        return self


class Diagonal(AbstractSigma):
    """Diagonal matrix, stored as its diagonal."""

    diagonal: Float[Array, " d"]

    def mv(self, noise):
        return self.diagonal * noise

    def mv_transpose(self, vector):
        return self.diagonal * vector

    def solve(self, vector):
        return vector / self.diagonal

    def average(self, other):
        assert isinstance(other, Diagonal)
        return Diagonal((self.diagonal + other.diagonal) / 2)

    def log_abs_det(self):
        return sum_first_axis(jnp.log(jnp.abs(self.diagonal)))

    def as_matrix(self, dim, dtype):
        return jnp.diag(self.diagonal)

    def root(self):
        # Signs of the diagonal do not affect V.
        return Diagonal(jnp.abs(self.diagonal))


class AbstractMatrix(AbstractSigma):
    """Matrix that depends on the state. Its subclasses share products and averages."""

    matrix: eqx.AbstractVar[Float[Array, "d m"]]

    def mv(self, noise):
        return matvec(self.matrix, noise)

    def mv_transpose(self, vector):
        return matvec(self.matrix.T, vector)

    def average(self, other):
        assert isinstance(other, type(self))
        # The average of two triangular matrices with positive diagonals is one, too.
        return type(self)((self.matrix + other.matrix) / 2)  # pyright: ignore

    def as_matrix(self, dim, dtype):
        return self.matrix


class Full(AbstractMatrix):
    """Square matrix without structure."""

    matrix: Float[Array, "d d"]

    def solve(self, vector):
        return solve(self.matrix, vector)

    def log_abs_det(self):
        return log_abs_det(self.matrix)

    def root(self):
        return Triangular(lower_factor(self.matrix))


class Triangular(AbstractMatrix):
    """Lower triangular matrix with a positive diagonal."""

    matrix: Float[Array, "d d"]

    def solve(self, vector):
        return solve_lower(self.matrix, vector)

    def log_abs_det(self):
        return sum_first_axis(jnp.log(jnp.diagonal(self.matrix)))

    def root(self):
        return self


class Tall(AbstractMatrix):
    """Matrix of fewer columns than rows. V = σσᵀ is singular, so it defines no density."""

    matrix: Float[Array, "d m"]
    invertible: ClassVar[bool] = False

    def solve(self, vector) -> NoReturn:
        raise ValueError(NO_INVERSE)

    def log_abs_det(self) -> NoReturn:
        raise ValueError(NO_INVERSE)

    def root(self):
        return self


def columns_of(sigma: AbstractSigma, x: Float[Array, " d"]) -> list[Float[Array, " d"]]:
    """Return the columns of σ at x."""
    num_columns = sigma.as_matrix(x.shape[0], x.dtype).shape[1]
    # By products with unit vectors, so that diagonals stay cheap.
    return [sigma.mv(jnp.asarray(unit, x.dtype)) for unit in np.eye(num_columns)]


def covariance_of(sigma: AbstractSigma, x: Float[Array, " d"]) -> Float[Array, "d d"]:
    """Return V = σσᵀ at x."""
    if isinstance(sigma, Diagonal):
        return jnp.diag(sigma.diagonal**2)
    matrix = sigma.as_matrix(x.shape[0], x.dtype)
    return matmul(matrix, matrix.T)


def root_of(V: Float[Array, "d d"]) -> Triangular:
    """Return the lower triangular root of V."""
    return Triangular(cholesky(V))
