"""Diffusions with a given stationary density: Langevin's, and the general recipe."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..engine.linalg import matvec
from .diffusion import Diffusion
from .dynamics import weighted_divergence
from .sigma import Triangular, root_of


def stationary_diffusion(
    log_density: Callable,
    V: Callable | None = None,
    Q: Callable | None = None,
    params: PyTree = None,
    *,
    normalised: bool = False,
) -> Diffusion:
    """Every diffusion with a given stationary density ν and diffusion matrix V:

        α = ½ ν⁻¹ div(ν (V + Q)),    σ = the Cholesky factor of V,

    for a skew-symmetric matrix field Q (Ma, Chen & Fox 2015). Its time reversal has -Q in the
    place of Q, so it is reversible if Q = 0.

    **Arguments:** functions `(x, params)` of one point `x` of shape (d,): `log_density`, log ν
    up to a constant; `V`, positive definite, shape (d, d), or (d,) for a diagonal, by default
    the identity; `Q`, shape (d, d), by default zero. `params`, any pytree, is what they receive;
    `normalised` as in `Diffusion`.

    **Raises:** `TypeError` for arguments that are not functions.

    **Example:**

    ```python
    swirl = jnp.array([[0.0, 1.0], [-1.0, 0.0]])
    model = jb.stationary_diffusion(lambda x, p: -x @ x / 2, Q=lambda x, p: swirl)
    ```
    """
    for name, function in [("log_density", log_density), ("V", V), ("Q", Q)]:
        if not (callable(function) or (function is None and name != "log_density")):
            raise TypeError(f"`{name}` must be a function `(x, params)`; got {function!r}.")
    return Diffusion(
        drift=_RecipeDrift(log_density, V, Q, 1),
        diffusion=None if V is None else _Root(V),
        log_stationary=log_density,
        params=params,
        reverse_drift=None if Q is None else _RecipeDrift(log_density, V, Q, -1),
        reversible=Q is None,
        normalised=normalised,
    )


def langevin(
    log_density: Callable, params: PyTree = None, *, normalised: bool = False
) -> Diffusion:
    """The Langevin diffusion `dX = ½ ∇log ν(X) dt + dW`: reversible, with stationary density ν.

    **Arguments:** `log_density`, `(x, params) -> ()`, is log ν up to a constant; `params`, any
    pytree, is what it receives; `normalised` as in `Diffusion`.

    **Example:**

    ```python
    double_well = jb.langevin(lambda x, p: -p * (x @ x - 1) ** 2, params=1.0)
    ```
    """
    return stationary_diffusion(log_density, params=params, normalised=normalised)


# The callables below are frozen dataclasses, so that models made twice from the same functions
# are equal and compile once.


@dataclasses.dataclass(frozen=True)
class _RecipeDrift:
    """½ ν⁻¹ div(ν (V ± Q))."""

    log_density: Callable
    V: Callable | None
    Q: Callable | None
    sign: int

    def __call__(self, x: Float[Array, " d"], params: PyTree) -> Float[Array, " d"]:
        def product(y, v):
            image = v if self.V is None else _multiply(self.V(y, params), v)
            if self.Q is not None:
                image += self.sign * _multiply(self.Q(y, params), v)
            return image

        varies = not (self.V is None and self.Q is None)
        return weighted_divergence(product, lambda y: self.log_density(y, params), x, varies) / 2


@dataclasses.dataclass(frozen=True)
class _Root:
    """σ with σσᵀ = V."""

    V: Callable

    def __call__(self, x: Float[Array, " d"], params: PyTree) -> Float[Array, " d"] | Triangular:
        V = jnp.asarray(self.V(x, params))
        return jnp.sqrt(V) if V.ndim == 1 else root_of(V)


def _multiply(matrix: Array, vector: Float[Array, " d"]) -> Float[Array, " d"]:
    matrix = jnp.asarray(matrix)
    return matrix * vector if matrix.ndim == 1 else matvec(matrix, vector)
