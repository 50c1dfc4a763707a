"""Probability that a diffusion stays inside a region, given its points at times t_0 < ... < t_K.

The region is where some functions g are positive. A Brownian motion with constant drift and σ is
a Brownian bridge between two points. With s = |σᵀ∇g|², it leaves a half space g > 0 within a step δ
with the probability

    exp(-2 g(x_i) g(x_{i+1}) / (s δ)),

if both points are inside (Baldi 1995; Gobet 2000). Near a smooth boundary every diffusion is of
this kind up to O(δ). If s depends on the state, g / √s is the distance of each of the two points
from the boundary in units of the noise, with the mean of √s on the way there.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..engine.arguments import as_returned, check_function, named
from ..engine.checks import Numbers
from ..engine.compiled import compiled_sooner
from ..engine.entry import public_entry
from ..engine.lanes import over_points
from ..engine.linalg import matmul
from ..models.diffusion import Diffusion, check_diffusion
from ..models.dynamics import Dynamics
from ..models.sigma import columns_of
from ..models.tracing import uses_argument
from .path_likelihood import as_grid_and_paths, for_each_path

# Least s at the boundary, as a share of s at a point: far away the former is a guess.
_LEAST_SHARE = 1 / 16


@public_entry
def log_survival(
    model: Diffusion, times: Numbers, path: Numbers, inside: Callable
) -> Float[Array, "*batch K"]:
    """Return the log probabilities that paths have not left a region, given their points.

    **Arguments:**

    - `model`: the diffusion. Its drift is not used.
    - `times`, `path`: as in `path_log_likelihood`.
    - `inside`: differentiable function `(x)`, positive inside the region and negative outside, with
        a gradient that is not zero on the boundary.
        For an intersection of regions it returns one value for each.

    **Returns:** log probabilities of shape (..., K), in the dtype of `path`: entry k is that of no
    exit up to time k. They are -inf from the first point that is not inside. They are exact for a
    half space if σ and the drift are constant, otherwise up to O(δ) in the step δ. If no noise
    moves a point towards the boundary, only the points themselves count.

    The mean of their exponentials over bridges is the probability to stay inside between the end
    points, and over simulated paths it is 1 minus the distribution function of the first exit.

    **Raises:** `ValueError` for shapes that do not fit or times that do not increase; `TypeError`
    for arguments of other types and for half precision.

    **Example:**

    ```python
    inside = lambda x: 2.0 - x[0]  # below a threshold of 2
    log_stays = jb.log_survival(model, bridges.times, bridges.paths, inside)
    jnp.mean(jnp.exp(log_stays[:, -1]))
    ```
    """
    check_diffusion(model)
    check_function("inside", inside, "(x)")
    times, steps, path = as_grid_and_paths(times, path)
    batch, (num_points, d) = path.shape[:-2], path.shape[-2:]
    grids = for_each_path(times, batch), for_each_path(steps, batch)
    paths = path.reshape(-1, num_points, d)
    return _log_survival(model, *grids, paths, inside).reshape(*batch, num_points)


@compiled_sooner
def _log_survival(
    model: Diffusion,
    times: Float[Array, "P K"],
    steps: Float[Array, "P steps"],
    paths: Float[Array, "P K d"],
    inside: Callable,
) -> Float[Array, "P K"]:
    """Return `log_survival` of P paths, each with its own times."""
    dynamics_at = model.prepared().forward_at(paths[0, 0])

    def of_point(time, x):
        return distances(dynamics_at(time), named("inside", inside), x)

    values = over_points(of_point)(times.ravel(), paths.reshape(-1, paths.shape[-1]))
    g, root = (leaf.reshape(*times.shape, -1) for leaf in values)  # (P, K, number of functions)
    is_inside = g > 0
    both = is_inside[:, :-1] & is_inside[:, 1:]
    moves = root > 0
    can_leave = both & moves[:, :-1] & moves[:, 1:] & (steps[..., None] > 0)
    distance = g / jnp.where(moves, root, 1)
    exponent = 2 * distance[:, :-1] * distance[:, 1:] / jnp.where(can_leave, steps[..., None], 1)
    # Below, exponents are one where nothing can leave, so that derivatives are finite.
    log_stays = jnp.log(-jnp.expm1(-jnp.where(can_leave, exponent, 1)))
    log_stays = jnp.where(both, jnp.where(can_leave, log_stays, 0), -jnp.inf)
    first = jnp.where(is_inside[:, :1], jnp.zeros_like(g[:, :1]), -jnp.inf)
    each = jnp.sum(jnp.concatenate([first, log_stays], axis=1), axis=-1)
    return jnp.cumsum(each, axis=1)


def distances(
    dynamics: Dynamics, inside: Callable, x: Float[Array, " d"]
) -> tuple[Float[Array, " g"], Float[Array, " g"]]:
    """Return g(x) and the mean of √s = |σᵀ∇g| from x to the boundary, for all functions g.

    Towards the boundary s changes by -g ∂s/∂g to first order, with the derivative along V∇g.
    """

    def of_point(x):
        value = lambda x: jnp.atleast_1d(as_returned("inside", inside(x)).astype(x.dtype))
        g, slope = jax.linearize(value, x)
        columns = jnp.stack(columns_of(dynamics.sigma(x), x))
        along = jnp.stack([slope(column) for column in columns])
        return jnp.sum(along**2, axis=0), (g, along, columns)

    s, (g, along, columns) = of_point(x)
    if not uses_argument(lambda x: of_point(x)[0], x):
        return g, jnp.sqrt(s)
    moves = s > 0
    safe = jnp.where(moves, s, 1)
    change_of = lambda direction: jax.jvp(lambda x: of_point(x)[0], (x,), (direction,))[1]
    # A direction for each g, along which that g changes by one.
    changes = jax.vmap(change_of)(matmul((along / safe).T, columns))
    at_boundary = jnp.maximum(safe - g * jnp.diagonal(changes), _LEAST_SHARE * safe)
    mean = (jnp.sqrt(safe) + jnp.sqrt(at_boundary)) / 2
    return g, jnp.where(moves, mean, 0)
