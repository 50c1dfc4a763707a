"""Discretisation error of an estimate, from estimates on two coarser grids.

Grids with step sizes 1, 2 and 4 times as large give the estimates L_0, L_1 and L_2. (The first step
of a coarser grid is shorter if N is not divisible.) To leading order, the error of one step of k
times the size is C k^{p+1}. Hence the error of a grid is C S, with S the sum of k^{p+1} over its
steps. With c_1 = L_1 - L_0 and c_2 = L_2 - L_1 it follows

    error of L_0 = s c_1,        s = S_0 / (S_1 - S_0),
    c_2 = m c_1,                 m = (S_2 - S_1) / (S_1 - S_0).

For N a power of two these are s = (2^p - 1)⁻¹ and m = 2^p. The difference c_2 - m c_1 measures the
terms of higher order that s c_1 omits. Suppose that changes continue to shrink from grid to grid by
the ratio ρ = c_2 / c_1. Then the omitted part is

    s |c_2 - m c_1| / (ρ - 1).

This is an upper bound if the error has terms of two orders only. It is infinite if changes do not
shrink or alternate in sign. Terms of two orders may also cancel by chance. Hence the uncertainty
always includes a fraction of s c_1, and all of it if N is too small for a third grid.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .step_error import StepError

# Of what is told, where the grids agree.
_DOUBTED = 0.25


def steps_of_grid(num_steps: int, level: int) -> list[int]:
    """Of how many of N steps each step of the grid of this level is made, 2^level but the first."""
    longest = 2**level
    first = num_steps % longest
    return [first] * (first > 0) + [longest] * (num_steps // longest)


def num_coarse_grids(num_steps: int) -> int:
    """How many coarser grids, of two at most, are each of fewer steps than the last."""
    return min(num_steps - 1, 2)


def share_of_grid(order: int, num_steps: int) -> float:
    """s: the step error as a share of what the grid of half as many steps changes."""
    fine, coarse, _ = _sums(order, num_steps)
    return fine / (coarse - fine)


def error_of_grids(
    values: Float[Array, " grids"],
    errors: Float[Array, " grids"],
    order: int,
    num_steps: int,
) -> StepError:
    """The step error of the first of the values of grids that are coarser and coarser, with Monte
    Carlo errors of their own; NaN if there is only one."""
    if num_steps == 1:
        return StepError(*2 * [jnp.full_like(values[0], jnp.nan)])
    share = share_of_grid(order, num_steps)
    change, noise = values[1] - values[0], jnp.hypot(errors[0], errors[1])
    told = share * change
    if num_coarse_grids(num_steps) < 2:
        return StepError(told, _finite(jnp.hypot(share * noise, told)))
    fine, coarse, coarser = _sums(order, num_steps)
    ratio = (coarser - coarse) / (coarse - fine)
    next_change = values[2] - values[1]
    # Of both what is beyond Monte Carlo error: it counts once, by itself.
    factors = np.array([ratio, 1 + ratio, 1]).astype(values.dtype)
    both = jnp.sqrt(jnp.sum((factors * errors) ** 2))
    off = jnp.maximum(jnp.abs(next_change - ratio * change) - both, 0)
    further = next_change * jnp.sign(change) - jnp.abs(change)
    further += 2 * jnp.hypot(noise, jnp.hypot(errors[1], errors[2]))
    size = jnp.abs(change)
    # ρ - 1, which is not to count for more than m: that is no reason for less doubt.
    shrinking = jnp.minimum(further, ratio * size)
    left_out = jnp.where(size > 0, off * size / jnp.where(shrinking > 0, shrinking, 1), off / ratio)
    left_out = jnp.where((shrinking > 0) | (size == 0), share * left_out, jnp.inf)
    doubt = jnp.hypot(share * noise, jnp.hypot(left_out, _DOUBTED * told))
    return StepError(told, _finite(doubt))


def _finite(doubt: Float[Array, ""]) -> Float[Array, ""]:
    """Infinite where a grid has no value."""
    return jnp.where(jnp.isnan(doubt), jnp.inf, doubt)


def _sums(order: int, num_steps: int) -> list[float]:
    """S of the three grids."""
    grids = [steps_of_grid(num_steps, level) for level in range(3)]
    return [float(sum(k ** (order + 1) for k in grid)) for grid in grids]
