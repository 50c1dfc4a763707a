"""The diffusion coefficient σ(x) at one point, as the operator its form calls for.

Six forms: the identity, a constant matrix (inverted outside the loop over time), a diagonal, a
full matrix that changes with the state, its lower triangular root, and a tall matrix, of noise in
fewer dimensions than the state has. Whoever holds an `AbstractSigma` multiplies and solves without
knowing which; what a form does not need is never computed. A tall one solves nothing, and says so.

The law of the diffusion is that of V = σσᵀ. So where only the law counts, and there is anything
to solve, a full σ(x) = L Q gives way to its root L, which solves without elimination or pivots and
does not turn: L(x) → L(x') as V(x) → V(x'), whatever Q does.
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
    matvec,
    solve,
    solve_lower,
    total,
)

NO_INVERSE = (
    "σ of this `model` has fewer columns than rows, so noise reaches only a part of the state at "
    "once, and what was asked for rests on an inverse of σ, as do couplings, bridges between exact "
    "states and transition densities. What does not: `simulate`, and with an `observation` "
    "`log_likelihood`, `smooth`, `innovations`, `gibbs`, `pmmh` and `maximum_likelihood`; a state "
    "that was seen exactly is `jb.LinearGaussian(covariance=0.0)`."
)


class AbstractSigma(eqx.Module):
    """σ(x) at one point: a linear map from noise, shape (d,), to space, shape (d,). `invertible`
    says whether it has an inverse: a tall one has noise of shape (m,), m < d, and none."""

    invertible: ClassVar[bool] = True

    @abstractmethod
    def mv(self, noise: Float[Array, " d"]) -> Float[Array, " d"]:
        """`σ w`."""

    @abstractmethod
    def mv_transpose(self, vector: Float[Array, " d"]) -> Float[Array, " d"]:
        """`σᵀ v`."""

    @abstractmethod
    def solve(self, vector: Float[Array, " d"]) -> Float[Array, " d"]:
        """`σ⁻¹ v`."""

    @abstractmethod
    def average(self, other: "AbstractSigma") -> "AbstractSigma":
        """`½ (σ + other)`, for two coefficients of one model."""

    @abstractmethod
    def log_abs_det(self) -> Float[Array, ""]:
        """`log |det σ|`."""

    @abstractmethod
    def as_matrix(self, dim: int, dtype) -> Float[Array, "d m"]:
        """`σ` as a dense matrix."""

    @abstractmethod
    def root(self) -> "AbstractSigma":
        """A root of V = σσᵀ: where σ varies one that V alone determines, however σ turns."""


class Identity(AbstractSigma):
    """σ = I."""

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
    """The same matrix everywhere, kept with its inverse."""

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

    def average(self, other):
        return self

    def log_abs_det(self):
        return log_abs_det(self.matrix)

    def as_matrix(self, dim, dtype):
        return self.matrix

    def root(self):
        return self


class Diagonal(AbstractSigma):
    """A diagonal matrix, given by its diagonal."""

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
        return total(jnp.log(jnp.abs(self.diagonal)))

    def as_matrix(self, dim, dtype):
        return jnp.diag(self.diagonal)

    def root(self):
        return Diagonal(jnp.abs(self.diagonal))


class AbstractMatrix(AbstractSigma):
    """A matrix that changes with the state, multiplied the same whatever its form."""

    matrix: eqx.AbstractVar[Float[Array, "d m"]]

    def mv(self, noise):
        return matvec(self.matrix, noise)

    def mv_transpose(self, vector):
        return matvec(self.matrix.T, vector)

    def average(self, other):
        assert isinstance(other, type(self))
        return type(self)((self.matrix + other.matrix) / 2)  # pyright: ignore

    def as_matrix(self, dim, dtype):
        return self.matrix


class Full(AbstractMatrix):
    """A full matrix."""

    matrix: Float[Array, "d d"]

    def solve(self, vector):
        return solve(self.matrix, vector)

    def log_abs_det(self):
        return log_abs_det(self.matrix)

    def root(self):
        return Triangular(lower_factor(self.matrix))


class Triangular(AbstractMatrix):
    """A lower triangular matrix with a positive diagonal."""

    matrix: Float[Array, "d d"]

    def solve(self, vector):
        return solve_lower(self.matrix, vector)

    def log_abs_det(self):
        return total(jnp.log(jnp.diagonal(self.matrix)))

    def root(self):
        return self


class Tall(AbstractMatrix):
    """A matrix of fewer columns than rows: V = σσᵀ has no inverse, and no density."""

    matrix: Float[Array, "d m"]
    invertible: ClassVar[bool] = False

    def solve(self, vector) -> NoReturn:
        raise ValueError(NO_INVERSE)

    def log_abs_det(self) -> NoReturn:
        raise ValueError(NO_INVERSE)

    def root(self):
        return self


def columns_of(sigma: AbstractSigma, x: Float[Array, " d"]) -> list[Float[Array, " d"]]:
    """The columns of σ at x."""
    num_columns = sigma.as_matrix(x.shape[0], x.dtype).shape[1]
    return [sigma.mv(jnp.asarray(unit, x.dtype)) for unit in np.eye(num_columns)]


def root_of(V: Float[Array, "d d"]) -> Triangular:
    """The lower triangular root of V."""
    return Triangular(cholesky(V))
