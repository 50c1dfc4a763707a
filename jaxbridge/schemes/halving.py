"""Estimates for N/2 steps from paths of N steps, without further simulation.

Every other point of a path is a path on the grid of N/2 steps. Its target law has steps of twice
the size, with the density q_2δ. Together with any density r(x'| x, x'') of the points between, this
defines a law of complete paths. Weights w for the law of N steps satisfy

    E[w e^D h(path)] = the same expectation for N/2 steps.

Here D is a sum over pairs of steps,

    D = Σ log [q_2δ(x, x'') r(x'| x, x'')] - log [q_δ(x, x') q_δ(x', x'')].

D varies less the closer r is to the law of x' under N steps. The module
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

# D is computed for one in this many paths, but for at least the minimum. For a state-dependent σ D
# varies as much as the weights, so it needs more paths.
_PATHS_PER_D, _PATHS_PER_D_IF_SIGMA_VARIES, _FEWEST_WITH_D = 32, 2, 64


def log_halving_of_pair(
    density: AbstractStepDensity,
    dynamics: Dynamics | tuple[Dynamics, Dynamics, Dynamics],
    points: tuple[Float[Array, " d"], Float[Array, " d"], Float[Array, " d"]],
    dt: tuple[Float[Array, ""], Float[Array, ""]],
) -> Float[Array, ""]:
    """Return the summand of D for a pair of steps.

    - `dynamics`: for time-dependent coefficients three values: for both steps together, for the
        first step, and for the second step.
    - `points`: x, x' and x''.
    - `dt`: lengths of the two steps.
    """
    (x, middle, x_next), (first, second) = points, dt
    if isinstance(dynamics, Dynamics):
        steps = 3 * (density.steps_from(dynamics, x),)
        law = density.steps_from(dynamics, middle).law(second)
    else:
        steps = [density.steps_from(coefficients, x) for coefficients in dynamics]
        law = density.steps_from(dynamics[2], middle).law(second)
    double_law, first_law, second_law = (
        steps[0].law(first + second),
        steps[1].law(first),
        steps[2].law(second),
    )
    # For the model linearised at x: the laws n_2 of both steps and n of the second step from x'.
    decay = steps[2].decay(second)
    both = second_law.after(first_law, decay, x)
    linear = second_law._replace(mean=second_law.mean + second_law.carried(decay, middle - x))
    # log [q_2δ(x, x'') / n_2(x''| x)] + log [n(x''| x, x') / q_δ(x', x'')].
    value = double_law.log_relative(x_next) - both.log_relative(x_next)
    value += linear.log_relative(x_next) - law.log_relative(x_next)
    if not isinstance(dynamics, Dynamics) or dynamics.sigma_varies:
        # `log_relative` omits the scale, which cancels for constant σ only.
        value += law.log_scale - linear.log_scale + both.log_scale - double_law.log_scale
    return value


def log_halving_of_all_steps(
    log_halving: Float[Array, "*rows"], num_steps: int
) -> Float[Array, "*rows"]:
    """Return D scaled up to all steps if N is odd; NaN for a single step.

    A non-finite D becomes -inf. It overflowed because of far too long steps, for which the density
    of N/2 steps counts as zero.
    """
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
    """Return D of given paths, shape (P,).

    - `dynamics`: for time-dependent coefficients a function of time.
    - `dt`: lengths of the steps, one column per path.
    - `time`: for time-dependent coefficients, the times at the middles of steps.
    """
    if density.is_exact:
        return jnp.zeros(paths.shape[0], paths.dtype)
    num_steps, num_pairs = dt.shape[0], dt.shape[0] // 2
    if num_pairs == 0:
        return jnp.full(paths.shape[0], jnp.nan, paths.dtype)
    # (d, N+1, P), written out: loops over lanes that are not adjacent would not vectorise.
    points = lax.optimization_barrier(jnp.moveaxis(paths, (0, 1), (-1, -2)))

    def of_pair(x, middle, x_next, first, second, *times):
        points, dt = (x, middle, x_next), (first, second)
        if isinstance(dynamics, Dynamics):
            return log_halving_of_pair(density, dynamics, points, dt)
        early, late = times
        coefficients = dynamics(early + second / 2), dynamics(early), dynamics(late)
        return log_halving_of_pair(density, coefficients, points, dt)

    def every_other(leaf, shift):
        leaf = leaf[..., shift : shift + 2 * num_pairs : 2, :][..., :num_pairs, :]
        return leaf.reshape(*leaf.shape[:-2], -1)

    pairs = [every_other(points, shift) for shift in (0, 1)]
    pairs.append(every_other(points[:, 2:], 0))
    steps = [every_other(dt, shift) for shift in (0, 1)]
    if time is not None:
        steps += [every_other(time, shift) for shift in (0, 1)]
    lanes = *pairs, *steps
    parts = over_lanes(*len(lanes) * [-1])(of_pair)(*lanes)
    log_halving = jnp.sum(parts.reshape(num_pairs, -1), axis=0)
    return log_halving_of_all_steps(log_halving, num_steps)


def num_looked(num_draws: int, sigma_varies: bool) -> int:
    """Return the number of paths per interval for which D is computed."""
    paths_per_d = _PATHS_PER_D_IF_SIGMA_VARIES if sigma_varies else _PATHS_PER_D
    return min(num_draws, max(_FEWEST_WITH_D, num_draws // paths_per_d))
