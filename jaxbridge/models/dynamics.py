"""The coefficients of one stochastic differential equation, for compiled loops."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..engine.linalg import total
from .sigma import AbstractSigma
from .tracing import uses_argument


class Dynamics(NamedTuple):
    """The coefficients of one stochastic differential equation, ready for a compiled loop.

    `drift` maps a point, shape (d,), to a vector (d,); `sigma` maps it to σ(x);
    `sigma_varies` tells whether σ depends on the point at all.
    """

    drift: Callable[[Array], Array]
    sigma: Callable[[Array], AbstractSigma]
    sigma_varies: bool


# The coefficients at a time.
DynamicsAt = Callable[[Float[Array, ""] | None], Dynamics]


def ito_correction(dynamics: Dynamics, x: Float[Array, " d"]) -> Float[Array, " d"]:
    """½ Σ_jk ∂_k σ_ij σ_kj, by which Itô's drift exceeds Stratonovich's."""

    def column(y, j):
        return dynamics.sigma(y).as_matrix(y.shape[0], y.dtype)[:, j]

    correction = jnp.zeros_like(x)
    for j in range(dynamics.sigma(x).as_matrix(x.shape[0], x.dtype).shape[1]):
        correction += jax.jvp(functools.partial(column, j=j), (x,), (column(x, j),))[1]
    return correction / 2


def weighted_divergence(
    product: Callable[[Array, Array], Array],
    log_nu: Callable[[Array], Array],
    x: Float[Array, " d"],
    varies: bool,
) -> Float[Array, " d"]:
    """ν⁻¹ Σ_j ∂_j(ν M_ij) = M ∇log ν + div M, for a matrix field given by `product(x, v)` =
    M(x) v; div M is left out where M does not vary."""
    flux = product(x, jax.grad(log_nu)(x))
    if varies:

        def column(direction):
            return jax.jvp(lambda y: product(y, direction), (x,), (direction,))[1]

        flux += total(jax.vmap(column)(jnp.eye(x.shape[0], dtype=x.dtype)))
    return flux


def stationary_flux(
    dynamics: Dynamics, log_nu: Callable, x: Float[Array, " d"], divergence: bool
) -> Float[Array, " d"]:
    """V ∇log ν + div V = α + α*, div V only where it is called for."""

    def product(y, v):
        sigma = dynamics.sigma(y)
        return sigma.mv(sigma.mv_transpose(v))

    return weighted_divergence(product, log_nu, x, divergence)


def is_linear(dynamics: Dynamics, like: Float[Array, " d"]) -> bool:
    """Whether the drift is linear, α(0) + A x, and σ constant."""
    jacobian = jax.jacfwd(dynamics.drift)
    return not (dynamics.sigma_varies or uses_argument(jacobian, like))
