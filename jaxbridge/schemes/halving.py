"""Estimates for N/2 steps from paths of N steps, without further simulation.

Every other point of a path is a path on the grid of N/2 steps. Its target law has steps of twice
the size, with the density q_2δ. Together with any density r(x'| x, x'') of the points between, this
defines a law of complete paths. With weights w for the law of N steps,

    E[w e^D h(path)] = the same expectation for N/2 steps,
    D = Σ log [q_2δ(x, x'') r(x'| x, x'')] - log [q_δ(x, x') q_δ(x', x'')],

a sum over pairs of steps. D varies less the closer r is to the law of x' under N steps. The module
takes r from the model linearised at x, with σ as at x. There the second step has a density
n(x''| x, x'), normal with a mean linear in x', and both steps together have a normal density
n_2(x''| x). Then r = q_δ n / n_2, and

    D = Σ log [q_2δ(x, x'') / n_2(x''| x)] + log [n(x''| x, x') / q_δ(x', x'')].

The variance of D depends on the model:

- constant, invertible σ: O(δ²). The difference then has an error of a fraction of the standard
  error of the estimate;
- constant σ with fewer columns than rows, and constant ∇α σ: O(δ);
- otherwise O(1), like log weights, or slightly less.

Euler steps of a σ with fewer columns than rows have no density, and so no D. An error of O(δ^p) is
the difference divided by 2^p - 1 (`step_error`).

If N is odd, the last step is left out and D is scaled up. For N = 1 D is NaN.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..engine.lanes import over_lanes
from ..models.dynamics import Dynamics, DynamicsAt
from .step_density import AbstractStepDensity

# D is worked out for one in so many paths, but for so many at least.
_LOOKED_SHARE, _LOOKED_SHARE_WHERE_SIGMA_VARIES, _FEWEST_LOOKED = 32, 2, 64


def log_halving_of_pair(
    density: AbstractStepDensity,
    dynamics: Dynamics | tuple[Dynamics, Dynamics, Dynamics],
    points: tuple[Float[Array, " d"], Float[Array, " d"], Float[Array, " d"]],
    dt: tuple[Float[Array, ""], Float[Array, ""]],
) -> Float[Array, ""]:
    """The part of D of a pair of steps of these lengths, through x, x' and x''. Where coefficients
    depend on time there are those of both steps together, of the first, and of the second."""
    (x, middle, x_next), (first, second) = points, dt
    if isinstance(dynamics, Dynamics):
        steps = 3 * (density.steps_from(dynamics, x),)
        law = density.steps_from(dynamics, middle).law(second)
    else:
        steps = [density.steps_from(each, x) for each in dynamics]
        law = density.steps_from(dynamics[2], middle).law(second)
    twice, once, again = steps[0].law(first + second), steps[1].law(first), steps[2].law(second)
    # If the drift were linear, the law of both steps, and of the second from x'.
    decay = steps[2].decay(second)
    both = again.after(once, decay, x)
    linear = again._replace(mean=again.mean + again.carried(decay, middle - x))
    value = twice.log_relative(x_next) - both.log_relative(x_next)
    value += linear.log_relative(x_next) - law.log_relative(x_next)
    if not isinstance(dynamics, Dynamics) or dynamics.sigma_varies:
        value += law.log_scale - linear.log_scale + both.log_scale - twice.log_scale
    return value


def log_halving_of_all_steps(
    log_halving: Float[Array, "*rows"], num_steps: int
) -> Float[Array, "*rows"]:
    """D as if all steps had been in pairs; NaN of a single step. What overflowed was of steps out
    of all proportion, and the other density is taken to be zero."""
    paired = num_steps - num_steps % 2
    if not paired:
        return jnp.full_like(log_halving, jnp.nan)
    return jnp.where(jnp.isfinite(log_halving), log_halving * (num_steps / paired), -jnp.inf)


def log_halving_of_paths(
    density: AbstractStepDensity,
    dynamics: Dynamics | DynamicsAt,
    dt: Float[Array, "N P"],
    paths: Float[Array, "P points d"],
    time: Float[Array, "N P"] | None = None,
) -> Float[Array, " P"]:
    """D of given paths, with the lengths of their steps in the columns of `dt`; where coefficients
    depend on time, there are those at a time, and `time` at the middles of steps."""
    num_steps, num_pairs = dt.shape[0], dt.shape[0] // 2
    if num_pairs == 0:
        return jnp.full(paths.shape[0], jnp.nan, paths.dtype)
    points = lax.optimization_barrier(jnp.moveaxis(paths, (0, 1), (-1, -2)))

    def one(x, middle, x_next, first, second, *times):
        points, dt = (x, middle, x_next), (first, second)
        if isinstance(dynamics, Dynamics):
            return log_halving_of_pair(density, dynamics, points, dt)
        early, late = times
        each = dynamics(early + second / 2), dynamics(early), dynamics(late)
        return log_halving_of_pair(density, each, points, dt)

    def every_other(leaf, shift):
        leaf = leaf[..., shift : shift + 2 * num_pairs : 2, :][..., :num_pairs, :]
        return leaf.reshape(*leaf.shape[:-2], -1)

    pairs = [every_other(points, shift) for shift in (0, 1)]
    pairs.append(every_other(points[:, 2:], 0))
    steps = [every_other(dt, shift) for shift in (0, 1)]
    if time is not None:
        steps += [every_other(time, shift) for shift in (0, 1)]
    lanes = *pairs, *steps
    parts = over_lanes(*len(lanes) * [-1])(one)(*lanes)
    log_halving = jnp.sum(parts.reshape(num_pairs, -1), axis=0)
    return log_halving_of_all_steps(log_halving, num_steps)


def num_looked(num_draws: int, sigma_varies: bool) -> int:
    """Of how many paths of an interval D is worked out: of few where it is hardly random."""
    share = _LOOKED_SHARE_WHERE_SIGMA_VARIES if sigma_varies else _LOOKED_SHARE
    return min(num_draws, max(_FEWEST_LOOKED, num_draws // share))
