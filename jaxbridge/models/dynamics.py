"""Coefficients of one stochastic differential equation, and quantities derived from them.

They are separate from the model because its parameters are already bound and prepared here.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..engine.linalg import sum_first_axis
from .sigma import AbstractSigma
from .tracing import is_affine


class Dynamics(NamedTuple):
    """Coefficients of one stochastic differential equation, ready for a compiled loop.

    - `drift`: maps a point, shape (d,), to the drift, shape (d,).
    - `sigma`: maps a point to the operator σ(x).
    - `sigma_varies`: whether σ depends on the point.
    """

    drift: Callable[[Array], Array]
    sigma: Callable[[Array], AbstractSigma]
    sigma_varies: bool


# Maps a time to the coefficients at that time.
DynamicsAt = Callable[[Float[Array, ""] | None], Dynamics]


def ito_correction(dynamics: Dynamics, x: Float[Array, " d"]) -> Float[Array, " d"]:
    """Return ½ Σ_jk ∂_k σ_ij σ_kj: the Itô drift minus the Stratonovich drift."""

    def column(y, j):
        return dynamics.sigma(y).as_matrix(y.shape[0], y.dtype)[:, j]

    # Column σ_j contributes its derivative in the direction of itself.
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
    """Return ν⁻¹ Σ_j ∂_j(ν M_ij) = M ∇log ν + div M for a matrix field M.

    `product(x, v)` is M(x) v. Unless M `varies`, div M is left out.
    """
    flux = product(x, jax.grad(log_nu)(x))
    if varies:
        # div M is the sum of the derivatives of M e_j in the directions e_j.
        def column(direction):
            return jax.jvp(lambda y: product(y, direction), (x,), (direction,))[1]

        flux += sum_first_axis(jax.vmap(column)(jnp.eye(x.shape[0], dtype=x.dtype)))
    return flux


def stationary_flux(
    dynamics: Dynamics, log_nu: Callable, x: Float[Array, " d"], divergence: bool
) -> Float[Array, " d"]:
    """Return V ∇log ν + div V, which equals α + α*. Compute div V only if `divergence`."""

    def product(y, v):
        sigma = dynamics.sigma(y)
        return sigma.mv(sigma.mv_transpose(v))

    return weighted_divergence(product, log_nu, x, divergence)


def is_linear(dynamics: Dynamics, like: Float[Array, " d"]) -> bool:
    """Return whether the drift is linear, α(0) + A x, and σ is constant."""
    return not dynamics.sigma_varies and is_affine(dynamics.drift, like)
