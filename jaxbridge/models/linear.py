"""The transition of a linear diffusion `dX = α(X) dt + σ dW`, α(x) = α(0) + A x, V = σσᵀ.

Given X_0 = x, X_t is normal with mean `x + M_t α(x)` and covariance Γ_t,

    M_t = ∫_0^t e^{sA} ds,   e^{tA} = I + A M_t,   Γ_t = ∫_0^t e^{sA} V e^{sAᵀ} ds,

whether or not A is invertible. Both integrals by their Taylor series over a time t / 2^k short
enough for it, and then k times

    M_2s = M_s + e^{sA} M_s,   Γ_2s = Γ_s + e^{sA} Γ_s e^{sAᵀ},

of which the second adds positive terms only: no digits are lost for short times, and for stable
A nothing overflows for long ones.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..engine.linalg import matmul

# ‖A‖ s ≤ 1/16 and ten terms leave an error below 1e-16, also of Γ, whose series goes by 2 ‖A‖ s.
_SHORT, _NUM_TERMS = 1 / 16, 10
# Enough for times of 2^60 times the shortest relaxation time.
_MAX_DOUBLINGS = 64


class LinearTransition(NamedTuple):
    """e^{tA}, M_t and Γ_t, shape (d, d) each."""

    decay: Float[Array, "d d"]
    integral: Float[Array, "d d"]
    covariance: Float[Array, "d d"]


@jax.custom_jvp
def linear_transition(
    A: Float[Array, "d d"], V: Float[Array, "d d"], t: Float[Array, ""]
) -> LinearTransition:
    """The transition in a time t ≥ 0, from no more doublings than it takes."""
    doublings, moments = _over_short_time(A, V, t)
    _, moments = lax.while_loop(
        lambda state: state[0] < doublings,
        lambda state: (state[0] + 1, _double(state[1])),
        (jnp.zeros_like(doublings), moments),
    )
    return moments


@linear_transition.defjvp
def _tangents(primals, tangents):
    # A `while_loop` has no reverse mode: a derivative goes through all the doublings there can be.
    def transition(A, V, t):
        doublings, moments = _over_short_time(A, V, t)

        def double(i, moments):
            doubled = _double(moments)
            return jax.tree.map(
                lambda new, old: jnp.where(i < doublings, new, old), doubled, moments
            )

        return lax.fori_loop(0, _MAX_DOUBLINGS, double, moments)

    return jax.jvp(transition, primals, tangents)


def _over_short_time(A, V, t) -> tuple[Float[Array, ""], LinearTransition]:
    """How often to double a time short enough for the Taylor series, and the transition in it."""
    identity = jnp.eye(A.shape[0], dtype=A.dtype)
    rate = lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(A), axis=1)))
    doublings = jnp.ceil(jnp.log2(jnp.maximum(lax.stop_gradient(t) * rate / _SHORT, 1)))
    doublings = jnp.minimum(doublings, _MAX_DOUBLINGS)  # there is an end, whatever the numbers
    s = t / 2**doublings
    term, covariance_term = s * identity, s * V
    integral, covariance = term, covariance_term
    for j in range(2, _NUM_TERMS + 1):
        term = s / j * _product(A, term)
        flow = _product(A, covariance_term)
        covariance_term = s / j * (flow + flow.T)
        integral, covariance = integral + term, covariance + covariance_term
    decay = identity + _product(A, integral)
    return doublings, LinearTransition(decay, integral, covariance)


def _double(moments: LinearTransition) -> LinearTransition:
    decay, integral, covariance = moments
    grown = _product(_product(decay, covariance), decay.T)
    return LinearTransition(
        _product(decay, decay),
        integral + _product(decay, integral),
        covariance + (grown + grown.T) / 2,
    )


def _product(left: Float[Array, "d d"], right: Float[Array, "d d"]) -> Float[Array, "d d"]:
    return matmul(left, right) if left.shape[0] <= 16 else left @ right
