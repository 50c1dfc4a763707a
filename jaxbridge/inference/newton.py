"""Newton's method for a log-likelihood with Monte Carlo errors, and checks of its result.

A pass estimates the gradient g of log L at θ, the covariance S of its Monte Carlo error, and the
observed information I. The method has converged if the next step I⁻¹g is short,

    gᵀI⁻¹g ≤ max(10⁻³, 4 tr I⁻¹S),

in squares of standard errors. The point counts as a maximum if I - 4 S is positive definite.

A likelihood whose maximum is at infinity needs a further check. Far out, steps are short, too, and
I is small and positive, but log L does not fall as its curvature predicts. Hence each pass also
measures log L at θ ± d_j, with d_j = I⁻¹e_j / √(I⁻¹)_jj. This moves entry j by one standard error,
and the other entries to their optimum given entry j. The pass compares

    log L(θ) + gᵀd - log L(θ + d)   with   ½ dᵀId.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..engine.verdict import Fault
from .parameters import Parameters

# The two limits of the squared next step after convergence (see above).
_SHORT, _SHORT_IN_ERRORS = 1e-3, 4.0
# The longest step in standard errors, and the number of its halved lengths that are tried until one
# satisfies the constraint.
_LONGEST, _HALVINGS = 2.0, 8
_MOST_PASSES = 15
# Largest Monte Carlo error at a maximum, in standard errors.
_NOISE = 0.5
# Smallest fall at a maximum. A quadratic log L falls by ½ at one standard error from its maximum.
_LEAST_FALL = 0.1

_NO_MAXIMUM = (
    "No maximum was found (`newton` is false). Use more `num_iterations`, a larger learning rate "
    "or more `num_bridges`, or check that the likelihood has a maximum inside the constraint."
)
_NOT_INSIDE = (
    "There is no maximum inside: one standard error from the estimate the log-likelihood barely "
    "falls (`fall` is below 0.1 instead of 0.5), for instance because its maximum is at infinity. "
    "The data do not determine these parameters: fix some of them by `where=`, or use `gibbs` or "
    "`pmmh` with a prior."
)


class Slope(NamedTuple):
    """Log-likelihood near θ.

    - `gradient`, `covariance`: its gradient, and the covariance of its Monte Carlo error.
    - `information`: observed information.
    - `rises`: log-likelihood at each of 2p points around θ minus that at θ.
    """

    gradient: Float[Array, " p"]
    covariance: Float[Array, "p p"]
    information: Float[Array, "p p"]
    rises: Float[Array, "2 p"]


class Passes(NamedTuple):
    """State of Newton's method after `number` passes.

    - `theta`, `step`: θ of the next pass, and the step to it.
    - `longest`: bound on the length of this step, in standard errors.
    - `gain`: squared length of the full Newton step, in standard errors.
    - `offsets`: moves of θ at which the last pass evaluated log L.
    - `slope`, `details`: results of the last pass.
    - `memory`: values for the next pass.
    - `converged`: whether the method has converged.
    """

    number: Int[Array, ""]
    theta: Float[Array, " p"]
    step: Float[Array, " p"]
    longest: Float[Array, ""]
    gain: Float[Array, ""]
    offsets: Float[Array, "2 p p"]
    slope: Slope
    details: Any
    memory: Any
    converged: Bool[Array, ""]


def newton_passes(
    evaluate: Callable[[Int[Array, ""], Array, Array, Any], tuple[Slope, Any, Any]],
    parameters: Parameters,
    theta: Float[Array, " p"],
    memory: PyTree,
) -> Passes:
    """Iterate Newton's method from θ until it has converged, for at most 15 passes.

    `evaluate(i, θ, offsets, memory)` returns the `Slope` at θ with the rises at θ + offsets, any
    details, and the memory for the next pass.
    """
    evaluate = jax.jit(evaluate)  # traced once for both its shapes and the loop
    p = len(theta)
    offsets = jnp.zeros((2, p, p), theta.dtype)
    shapes = jax.eval_shape(evaluate, jnp.int32(0), theta, offsets, memory)[:2]
    slope, details = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def one(state: Passes) -> Passes:
        here = state.theta
        offsets = allowed_offsets(parameters, here, state.slope.information)
        slope, details, memory = evaluate(state.number, here, offsets, state.memory)
        step, longest, short = _next_step(parameters, state, slope)
        gain = slope.gradient @ ascent_direction(slope.gradient, slope.information)
        # The first pass has no information for its offsets, so a second one always follows.
        converged = short & (state.number > 0)
        next_point = here + step, step, longest, gain
        return Passes(state.number + 1, *next_point, offsets, slope, details, memory, converged)

    def goes_on(state: Passes) -> Bool[Array, ""]:
        return ~state.converged & (state.number < _MOST_PASSES)

    none, longest = jnp.zeros_like(theta[0]), jnp.full_like(theta[0], _LONGEST)
    at_start = theta, jnp.zeros_like(theta), longest, none
    no = jnp.array(False)
    start = Passes(jnp.int32(0), *at_start, offsets, slope, details, memory, no)
    return lax.while_loop(goes_on, one, start)


def is_maximum(slope: Slope) -> Bool[Array, ""]:
    """Return whether the information is positive definite by more than the Monte Carlo errors."""
    clear, _ = _in_units_of_curvature(_NOISE**2 * slope.information - slope.covariance)
    return jnp.all(jnp.linalg.eigvalsh(jnp.where(jnp.isfinite(clear), clear, -1)) > 0)


def _in_units_of_curvature(
    matrix: Float[Array, "p p"],
) -> tuple[Float[Array, "p p"], Float[Array, " p"]]:
    """Return the matrix in units of parameters in which its diagonal is ±1, and these units.

    Then rounding errors of a parameter with large curvature do not hide those of the others.
    """
    scale = jnp.sqrt(jnp.abs(jnp.diagonal(matrix)))
    scale = jnp.where((scale > 0) & jnp.isfinite(scale), scale, 1)
    return matrix / scale[:, None] / scale, scale


def falls(slope: Slope, offsets: Float[Array, "2 p p"]) -> Float[Array, "2 p"]:
    """Return the fall of log L from θ to each θ + offset, without the linear part of log L.

    It is scaled such that a quadratic function falls by ½. It is infinite if the likelihood is zero
    at that point, or if the constraint excludes the point.
    """
    linear = offsets @ slope.gradient
    quadratic = jnp.einsum("spi,ij,spj->sp", offsets, slope.information, offsets)
    fall = (linear - slope.rises) / jnp.where(quadratic > 0, quadratic, 1)
    measured = jnp.isfinite(slope.rises) & jnp.any(offsets != 0, axis=-1)
    return jnp.where(measured, fall, jnp.inf)


def maximum_faults(newton: Bool[Array, ""], fall: Float[Array, "2 p"]) -> tuple[Fault, Fault]:
    """Return the faults of a search that found no maximum, or one at infinity."""
    outside = newton & ~jnp.all(fall > _LEAST_FALL)
    return Fault(~newton, _NO_MAXIMUM), Fault(outside, _NOT_INSIDE)


def allowed_offsets(
    parameters: Parameters, theta: Float[Array, " p"], information: Float[Array, "p p"]
) -> Float[Array, "2 p p"]:
    """Return moves of each entry by one standard error, down and up.

    The other entries move to their maximum given this entry. A move is zero if it leaves the
    constraint, or if the information is not positive definite.
    """
    covariance = jnp.linalg.inv(information)
    variances = jnp.diagonal(covariance)
    ok = jnp.all(jnp.isfinite(covariance)) & jnp.all(variances > 0)
    moves = jnp.where(ok, covariance / jnp.sqrt(jnp.where(ok, variances, 1))[:, None], 0)
    offsets = jnp.stack([-moves, moves])
    allowed = jax.vmap(jax.vmap(lambda offset: parameters.allowed(theta + offset)))(offsets)
    return jnp.where(allowed[..., None], offsets, 0)


def ascent_direction(
    gradient: Float[Array, " p"], information: Float[Array, "p p"]
) -> Float[Array, " p"]:
    """Return Newton's step where log L is concave, and an ascending step elsewhere.

    Parameters are scaled such that the curvatures along the axes are ±1. Then the eigenvalues of
    the information are replaced by their absolute values, so every step ascends.
    """
    scaled, scale = _in_units_of_curvature(information)
    scaled = jnp.where(
        jnp.all(jnp.isfinite(scaled)), scaled, jnp.eye(len(scale), dtype=scale.dtype)
    )
    curvature, axes = jnp.linalg.eigh(scaled)
    # Rounding hides smaller curvatures.
    curvature = jnp.maximum(jnp.abs(curvature), 10 * jnp.finfo(scale.dtype).eps)
    return axes @ ((axes.T @ (gradient / scale)) / curvature) / scale


def longest_fraction(
    gain: Float[Array, ""], longest: Float[Array, ""] | float = _LONGEST
) -> Float[Array, ""]:
    """Return the factor at most 1 that shortens a step to the length `longest`.

    `gain` is the squared length of the step, in standard errors.
    """
    return longest / jnp.sqrt(jnp.maximum(gain, longest**2))


def _next_step(
    parameters: Parameters, state: Passes, slope: Slope
) -> tuple[Float[Array, " p"], Float[Array, ""], Bool[Array, ""]]:
    """Return the next step, the bound on its length, and whether the search has converged.

    The bound doubles while steps do not pass a maximum. If the last step led far beyond a maximum,
    or to a point without usable information, the next step takes three quarters of it back.
    """
    theta, (gradient, covariance, information, _) = state.theta, slope
    step = ascent_direction(gradient, information)
    gain = gradient @ step
    usable = jnp.all(jnp.isfinite(information)) & jnp.isfinite(gain)
    has_moved = jnp.any(state.step != 0)
    beyond = has_moved & (gradient @ state.step < 0)
    too_far = (beyond & (gain > state.gain)) | (has_moved & ~usable)
    longest = jnp.where(has_moved & ~beyond, 2 * state.longest, _LONGEST)
    forward = longest_fraction(gain, longest).astype(step.dtype) * step
    # Without usable information the next pass repeats this θ.
    forward = jnp.where(usable, forward, 0)
    fractions = 0.5 ** jnp.arange(_HALVINGS, dtype=step.dtype)
    trials = fractions[:, None] * forward
    allowed = jax.vmap(lambda move: parameters.allowed(theta + move))(trials)
    forward = jnp.where(jnp.any(allowed), trials[jnp.argmax(allowed)], 0)
    noise = jnp.trace(jnp.linalg.inv(information) @ covariance)
    short = gain <= jnp.maximum(_SHORT, _SHORT_IN_ERRORS * noise)
    back = jnp.where(too_far & ~short, -0.75 * state.step, forward)
    return back, longest, short & allowed[0] & usable
