"""Backward information filter: h_i from h_{i+1} and from the observations at t_{i+1}.

For a linear step u' = A u + a + Λ ζ, log h_i is quadratic. First the step is conditioned on the
scalar observations at its end (`tilted_step.given`). This gives the mean e = E u + f of the step,
starting from E = A and f = a. The log densities of the residuals are the first part of log h_i.
Then h_{i+1} is integrated: with W = ℛ⁻¹ Λᵀ H,

    log h_i += (r - Wᵀℛ⁻¹Λᵀr)ᵀ e - ½ eᵀ (H - WᵀW) e.

The derivative of h_i with respect to h_{i+1} has a simpler form. Given all later observations, u'
has the mean Γu + m of the tilted step. A small change of log h_{i+1} changes log h_i by its
conditional mean. Hence

    Ḣ_i = Γᵀ Ḣ Γ,   ṙ_i = Γᵀ (ṙ - Ḣ m),   Γ = (I - G H) E,   m = (I - G H) f + G r.

Here G = Λ (ℛ ℛᵀ)⁻¹ Λᵀ is the covariance of u' given all later observations.

With a discount rate (`forgetting`), a power of h_{i+1} below one enters the step.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..engine.linalg import dot, matmul, matvec, solve_lower, solve_lower_transposed
from ..engine.recursion import StateDerivative, recursion
from .linearisation import LinearisedStep
from .observations import Scalars
from .segments import at_every_step, flat
from .tilted_step import Information, root_after, seen_of, tilt_factor


class _Mean(NamedTuple):
    """Mean E u + f of a step given the scalar observations at its end, and its root Λ."""

    slope: Float[Array, "d d"]
    shift: Float[Array, " d"]
    root: Float[Array, "d m"]


def back(h: Information, step: LinearisedStep, scalars: Scalars) -> Information:
    """Return h_i, from h_{i+1} and the scalar observations at the end of the step."""
    (E, f, root), of_scalars = _condition(step, scalars)
    factor, half = tilt_factor(root, h)
    W = jnp.stack([solve_lower(factor, row) for row in half])  # Wᵀ
    w = solve_lower(factor, matvec(root.T, h.shift))
    H = h.precision - matmul(W, W.T)
    r = h.shift - matvec(W, w) - matvec(H, f)
    shift = of_scalars.shift + matvec(E.T, r)
    precision = of_scalars.precision + matmul(E.T, matmul(H, E))
    # Rounding makes the precision slightly asymmetric.
    return Information(shift, (precision + precision.T) / 2)


def _condition(step: LinearisedStep, scalars: Scalars) -> tuple[_Mean, Information]:
    """Condition a step on the scalar observations at its end.

    **Returns:** the conditional mean and root, and the log density of the observations as a
    quadratic function of the beginning of the step.
    """
    E, f, root = step
    shift, precision = jnp.zeros_like(f), jnp.zeros_like(E)
    for row, value, variance, is_seen in zip(*scalars, strict=True):
        factors = seen_of(root, row, variance)
        slope, residual = matvec(E.T, row), value - dot(row, f)
        # A missing scalar has row 0 and thus gain 0, so only the weight needs a mask.
        weight = jnp.where(is_seen, 1 / factors.variance, 0)
        shift += slope * residual * weight
        precision += slope[:, None] * slope * weight
        E = E - factors.gain[:, None] * slope
        f = f + factors.gain * residual
        root = root_after(root, factors)
    return _Mean(E, f, root), Information(shift, precision)


def _power_of(h: Information, power: Float[Array, ""] | None) -> Information:
    """Return h to the given power; h itself if `power` is `None`."""
    return h if power is None else Information(power * h.shift, power * h.precision)


def _tilted_mean(h: Information, inputs: tuple[LinearisedStep, Scalars, Array | None]):
    """Return Γ, m and the power of h_{i+1} in the step."""
    step, scalars, power = inputs
    (E, f, root), _ = _condition(step, scalars)
    h = _power_of(h, power)
    factor, half = tilt_factor(root, h)

    def pulled(v):
        """Return Λ (ℛ ℛᵀ)⁻¹ v."""
        return matvec(root, solve_lower_transposed(factor, solve_lower(factor, v)))

    gain = jnp.stack([pulled(row) for row in half])  # H G
    m = f - matvec(gain.T, f) + pulled(matvec(root.T, h.shift))
    return E - matmul(gain.T, E), m, power


def _change_of_h(mean: tuple[Array, Array, Array | None], h_dot: Information) -> Information:
    """Return the change of h_i for a change of h_{i+1}."""
    slope, shift, power = mean
    h_dot = _power_of(h_dot, power)
    r = matvec(slope.T, h_dot.shift - matvec(h_dot.precision, shift))
    return Information(r, matmul(slope.T, matmul(h_dot.precision, slope)))


def information_filter(
    steps: LinearisedStep,
    scalars: Scalars,
    over_lanes: Callable[[Callable], Callable] | None = None,
    power: Float[Array, "K N"] | None = None,
) -> Information:
    """Return h at the beginning of every step.

    **Arguments:**

    - `steps`: steps of the linear process, leading axes (K, N).
    - `scalars`: observations at the ends of segments, leading axis K.
    - `over_lanes`: maps a function of one point over lanes in the last axis. Pass it if there are
        lanes; derivatives are then not available.
    - `power`: power of h_{i+1} that enters each step, by default 1.
    """
    K, N = steps.shift.shape[:2]
    # h = 1 after the last observation; the recursion runs backwards in time.
    last = Information(jnp.zeros_like(steps.shift[0, 0]), jnp.zeros_like(steps.decay[0, 0]))
    by_step = flat(steps), at_every_step(scalars, N), None if power is None else power.ravel()
    inputs = jax.tree.map(lambda leaf: leaf[::-1], by_step)

    def one(h, inputs):
        step, scalars, power = inputs
        return back(_power_of(h, power), step, scalars), None

    if over_lanes is None:
        h, _ = recursion(one, last, inputs, StateDerivative(_tilted_mean, _change_of_h))
    else:
        of_lanes = over_lanes(lambda h, inputs: one(h, inputs)[0])
        h = lax.scan(lambda h, inputs: 2 * (of_lanes(h, inputs),), last, inputs)[1]
    return jax.tree.map(lambda leaf: leaf[::-1].reshape(K, N, *leaf.shape[1:]), h)
