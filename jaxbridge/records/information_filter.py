"""The backward information filter: h_i from h_{i+1}, and from what is seen at t_{i+1}.

For a linear step u' = A u + a + Λ ζ everything that is seen later makes log h_i quadratic. Numbers
that are seen at its end come first (`tilted_step.given`): they make the mean e = E u + f of the
step, with E = A and f = a at first, and log h_i what the log densities of their residuals are. Then
h_{i+1} is integrated: with W = ℛ⁻¹ Λᵀ H,

    log h_i += (r - Wᵀℛ⁻¹Λᵀr)ᵀ e - ½ eᵀ (H - WᵀW) e.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from ..engine.linalg import dot, matmul, matvec, solve_lower
from .linearisation import LinearisedStep
from .observation import Scalars
from .segments import at_every_step, flat
from .tilted_step import Information, root_after, seen_of, tilt_factor


def back(h: Information, step: LinearisedStep, scalars: Scalars) -> Information:
    """h_i, from h_{i+1} and what is seen at the end of the step."""
    E, f, root = step
    shift, precision = jnp.zeros_like(f), jnp.zeros_like(E)
    for row, value, variance, is_seen in zip(*scalars, strict=True):
        seen = seen_of(root, row, variance)
        slope, residual = matvec(E.T, row), value - dot(row, f)
        weight = jnp.where(is_seen, 1 / seen.variance, 0)
        shift += slope * residual * weight
        precision += slope[:, None] * slope * weight
        E = E - seen.gain[:, None] * slope
        f = f + seen.gain * residual
        root = root_after(root, seen)
    factor, half = tilt_factor(root, h)
    W = jnp.stack([solve_lower(factor, row) for row in half])  # Wᵀ
    w = solve_lower(factor, matvec(root.T, h.shift))
    H = h.precision - matmul(W, W.T)
    r = h.shift - matvec(W, w) - matvec(H, f)
    shift = shift + matvec(E.T, r)
    precision = precision + matmul(E.T, matmul(H, E))
    return Information(shift, (precision + precision.T) / 2)


def information_filter(
    steps: LinearisedStep,
    scalars: Scalars,
    each: Callable[[Callable], Callable] = lambda function: function,
) -> Information:
    """h at the beginning of every step, for steps with leading axes (K, N), and what is seen at the
    ends of segments, leading axis K. `each` maps a function of one point over lanes, where there
    are any, in the last axis."""
    K, N = steps.shift.shape[:2]
    shift, decay = steps.shift[0, 0], steps.decay[0, 0]
    last = Information(jnp.zeros_like(shift), jnp.zeros_like(decay))

    def one(h, inputs):
        h = each(back)(h, *inputs)
        return h, h

    inputs = flat(steps), at_every_step(scalars, N)
    # For derivatives the states are kept: to keep all between them takes longer than to redo it.
    _, h = lax.scan(jax.checkpoint(one, prevent_cse=False), last, inputs, reverse=True)
    return jax.tree.map(lambda leaf: leaf.reshape(K, N, *leaf.shape[1:]), h)
