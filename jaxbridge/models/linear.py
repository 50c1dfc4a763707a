"""The transition of a linear diffusion `dX = α(X) dt + σ dW`, α(x) = α(0) + A x, V = σσᵀ.

Given X_0 = x, X_t is normal with mean `x + M_t α(x)` and covariance Γ_t. For any A, invertible or
not:

    M_t = ∫_0^t e^{sA} ds;   e^{tA} = I + A M_t;   Γ_t = ∫_0^t e^{sA} V e^{sAᵀ} ds.

Taylor series give both integrals over a short time t / 2^k. Then the time is doubled k times:

    M_2s = M_s + e^{sA} M_s;   Γ_2s = Γ_s + e^{sA} Γ_s e^{sAᵀ}.

The second recursion only adds positive semidefinite terms. So short times lose no digits, and for
stable A long times do not overflow.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..engine.lanes import in_any_lane
from ..engine.linalg import matmul

# For ‖A‖ s ≤ 1/8 so many terms leave an error of a rounding, also in Γ, a series in 2 ‖A‖ s. If
# noise reaches a coordinate through others, the first terms of its variance are zero. More terms
# keep its relative error small, for noise that is integrated up to three times.
_MAX_SERIES_NORM, _NUM_TERMS, _MOST_INTEGRATIONS = 1 / 8, {4: 7, 8: 12}, 3
# Sufficient for 2^60 times the shortest relaxation time.
_MAX_DOUBLINGS = 64
# Most steps of paths need no more doublings.
_USUAL_DOUBLINGS = 4


class LinearTransition(NamedTuple):
    """Transition in a time t: `decay` = e^{tA}, `integral` = M_t and `covariance` = Γ_t.

    All three have shape (d, d).
    """

    decay: Float[Array, "d d"]
    integral: Float[Array, "d d"]
    covariance: Float[Array, "d d"]


@jax.custom_jvp
def linear_transition(
    A: Float[Array, "d d"], V: Float[Array, "d d"], t: Float[Array, ""]
) -> LinearTransition:
    """Return the transition in a time t ≥ 0, with as few doublings as the time needs."""
    doublings, moments = _over_short_time(A, V, t)
    _, moments = lax.while_loop(
        lambda state: state[0] < doublings,
        lambda state: (state[0] + 1, _double(state[1])),
        (jnp.zeros_like(doublings), moments),
    )
    return moments


@linear_transition.defjvp
def _tangents(primals, tangents):
    # A `while_loop` has no reverse mode. So derivatives use loops of fixed length, whose last
    # iterations change nothing, and which are left out where they are not needed.
    def transition(A, V, t):
        doublings, moments = _over_short_time(A, V, t)

        def double(i, moments):
            doubled = _double(moments)
            return jax.tree.map(
                lambda new, old: jnp.where(i < doublings, new, old), doubled, moments
            )

        for bounds in ((0, _USUAL_DOUBLINGS), (_USUAL_DOUBLINGS, _MAX_DOUBLINGS)):
            # A loop that is left out would otherwise return zeros for all of its iterations.
            loop = jax.checkpoint(functools.partial(lax.fori_loop, *bounds, double))
            needed = in_any_lane(doublings > bounds[0])
            moments = lax.cond(needed, loop, lambda moments: moments, moments)
        return moments

    return jax.jvp(transition, primals, tangents)


def _over_short_time(A, V, t) -> tuple[Float[Array, ""], LinearTransition]:
    """Return the number of doublings, and the transition in the time t / 2^doublings."""
    identity = jnp.eye(A.shape[0], dtype=A.dtype)
    # The ∞-norm of A. The number of doublings is a choice, so nothing here is differentiated.
    rate = lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(A), axis=1)))
    doublings = jnp.ceil(jnp.log2(jnp.maximum(lax.stop_gradient(t) * rate / _MAX_SERIES_NORM, 1)))
    doublings = jnp.minimum(doublings, _MAX_DOUBLINGS)  # the loop ends for infinite rates too
    s = t / 2**doublings
    term, covariance_term = s * identity, s * V
    integral, covariance = term, covariance_term
    # Term j of M_s is s^j A^{j-1} / j!. As Γ' = V + A Γ + Γ Aᵀ, term j of Γ_s follows from
    # term j - 1.
    num_terms = _NUM_TERMS[A.dtype.itemsize] + 2 * min(len(A) - 1, _MOST_INTEGRATIONS)
    for j in range(2, num_terms + 1):
        term = s / j * _product(A, term)
        product = _product(A, covariance_term)
        covariance_term = s / j * (product + product.T)
        integral, covariance = integral + term, covariance + covariance_term
    decay = identity + _product(A, integral)
    return doublings, LinearTransition(decay, integral, covariance)


def _double(moments: LinearTransition) -> LinearTransition:
    """Return the transition in twice the time."""
    decay, integral, covariance = moments
    propagated = _product(_product(decay, covariance), decay.T)
    return LinearTransition(
        _product(decay, decay),
        integral + _product(decay, integral),
        covariance + (propagated + propagated.T) / 2,  # symmetric in spite of rounding
    )


def _product(left: Float[Array, "d d"], right: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Return the product of two matrices, in elementwise operations for small ones."""
    return matmul(left, right) if left.shape[0] <= 16 else left @ right
