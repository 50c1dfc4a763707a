"""Discretisation error of an estimate, from estimates on two coarser grids.

Grids whose steps join 1, 2 and 4 steps give the estimates L_0, L_1 and L_2. (The first step of a
coarser grid joins fewer if N is not divisible.) To leading order, the error of one step of length k
is C k^{p+1}. Hence the error of a grid is C S, with S the sum of k^{p+1} over its steps. Let
c_1 = L_1 - L_0 and c_2 = L_2 - L_1. Then

    error of L_0 = s c_1,        s = S_0 / (S_1 - S_0),
    c_2 = m c_1,                 m = (S_2 - S_1) / (S_1 - S_0).

If steps are equal and N is a power of two, then s = (2^p - 1)⁻¹ and m = 2^p. The difference
c_2 - m c_1 measures the terms of higher order that s c_1 omits. Suppose that changes continue to
shrink from grid to grid by the ratio ρ = c_2 / c_1. Then the omitted part is

    s |c_2 - m c_1| / (ρ - 1).

This is an upper bound if the error has terms of two orders only. It is infinite if changes do not
shrink or alternate in sign. Terms of two orders may also cancel by chance. Hence the uncertainty
always includes a fraction of s c_1, and all of it if N is too small for a third grid.
"""

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .step_error import StepError

# Least uncertainty, as a share of the estimated error, even if the three grids agree.
LEAST_UNCERTAINTY = 0.25


def num_splits(num_steps: int) -> int:
    """Return k = ⌈log₂ N⌉, the number of splits of the last of N steps.

    A last step of another law adds an error of the square of its length. After k splits it has
    about 1/N of the length of the others.
    """
    return math.ceil(math.log2(num_steps))


def remaining_after_splits(num: int) -> Float[np.ndarray, " num"]:
    """Return the remaining fractions ½, ¼, ..., 2^-k of a step after each of k splits."""
    return 0.5 ** np.arange(1, num + 1)


def steps_of_grid(lengths: Sequence[float], level: int) -> list[float]:
    """Return the lengths of the steps of a coarser grid, each of which joins 2^level steps.

    The first one joins fewer if their number is not divisible.
    """
    size = 2**level
    ends = range(len(lengths), 0, -size)
    return [sum(lengths[max(end - size, 0) : end]) for end in ends][::-1]


def num_coarse_grids(num_steps: int) -> int:
    """Return the number of coarser grids with fewer and fewer steps, at most two."""
    return min(num_steps - 1, 2)


def share_of_grid(order: int | float, lengths: Sequence[float]) -> float:
    """Return s, the discretisation error relative to the change on a grid of half as many steps.

    `lengths` are those of the steps, in any unit. A single step has no coarser grid: NaN. For an
    infinite order there is no error.
    """
    if math.isinf(order):
        return 0.0
    if len(lengths) == 1:
        return math.nan
    fine, coarse, _ = _sums(order, lengths)
    return fine / (coarse - fine)


def error_of_grids(
    values: Float[Array, " grids"],
    errors: Float[Array, " grids"],
    order: int | float,
    lengths: Sequence[float],
) -> StepError:
    """Return the step error of `values[0]`, from values on successively coarser grids.

    `errors` are the Monte Carlo standard errors of the values, `lengths` the lengths of the steps
    in any unit. For N = 1 there are no coarser grids, and the result is NaN. For an infinite order
    the error is zero.
    """
    if math.isinf(order):
        return StepError(*2 * [jnp.zeros_like(values[0])])
    if len(lengths) == 1:
        return StepError(*2 * [jnp.full_like(values[0], jnp.nan)])
    share = share_of_grid(order, lengths)
    change, noise = values[1] - values[0], jnp.hypot(errors[0], errors[1])
    estimate = share * change
    if num_coarse_grids(len(lengths)) < 2:
        return StepError(estimate, _finite(jnp.hypot(share * noise, estimate)))
    fine, coarse, coarser = _sums(order, lengths)
    ratio = (coarser - coarse) / (coarse - fine)
    next_change = values[2] - values[1]
    # Only the part beyond Monte Carlo error counts as discrepancy, because `noise` has that error.
    factors = np.array([ratio, 1 + ratio, 1]).astype(values.dtype)
    noise_level = jnp.sqrt(jnp.sum((factors * errors) ** 2))
    excess = jnp.maximum(jnp.abs(next_change - ratio * change) - noise_level, 0)
    # |c_1| (ρ - 1), with two Monte Carlo errors added.
    growth = next_change * jnp.sign(change) - jnp.abs(change)
    growth += 2 * jnp.hypot(noise, jnp.hypot(errors[1], errors[2]))
    size = jnp.abs(change)
    # ρ - 1 counts as at most m. A larger ratio is no reason for a smaller uncertainty.
    shrinking = jnp.minimum(growth, ratio * size)
    omitted = jnp.where(
        size > 0, excess * size / jnp.where(shrinking > 0, shrinking, 1), excess / ratio
    )
    omitted = jnp.where((shrinking > 0) | (size == 0), share * omitted, jnp.inf)
    uncertainty = jnp.hypot(share * noise, jnp.hypot(omitted, LEAST_UNCERTAINTY * estimate))
    return StepError(estimate, _finite(uncertainty))


def _finite(uncertainty: Float[Array, ""]) -> Float[Array, ""]:
    """Return the uncertainty, infinite if it is NaN because a grid has no value."""
    return jnp.where(jnp.isnan(uncertainty), jnp.inf, uncertainty)


def _sums(order: int | float, lengths: Sequence[float]) -> list[float]:
    """Return S of the three grids."""
    grids = [steps_of_grid(lengths, level) for level in range(3)]
    return [float(sum(k ** (order + 1) for k in grid)) for grid in grids]
