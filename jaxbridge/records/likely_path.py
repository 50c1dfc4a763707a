"""Most likely path given the observations, by damped iterations from a path of the diffusion.

A path is a function of its noise u. The Levenberg–Marquardt iteration minimises

    J(u) = ½ |u|² + ½ Σ (y - c·x)² / ρ

by Gauss–Newton steps with a penalty ½ λ |u - u_last|². It increases λ until J decreases (for
smoothers: Särkkä & Svensson 2020). With the penalty the noise of a step has the law
N(λ/(1+λ) u_last, I/(1+λ)), so the information filter solves the linear problem. The guided steps of
the diffusion then give a new path of the diffusion.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..engine.lanes import over_points
from ..engine.linalg import dot, matvec
from ..models.diffusion import Diffusion
from ..schemes import solve_root
from .guided_steps import guided_start, relative
from .information_filter import information_filter
from .initial import initial_law
from .linearisation import LinearisedStep, linear_step
from .observations import Scalars
from .problem import RecordProblem
from .segments import at_every_step, flat, following, split_first
from .tilted_step import NormalStep, given, tilted

# Maximum number of iterations; first λ, largest λ (then the iteration ends), and factors by which λ
# falls and grows; and the decrease of J that is too small for another iteration.
_MOST_ITERATIONS, _FIRST, _LARGEST, _DOWN, _UP, _NO_GAIN = 50, 1.0, 1e5, 0.2, 4.0, 0.25


class _Iterate(NamedTuple):
    """State of the iteration.

    - `iteration`: its number.
    - `path`, `cost`: a path of the diffusion, and its J.
    - `damping`: λ.
    - `ended`: whether the iteration has ended.
    """

    iteration: Int[Array, ""]
    path: Float[Array, "points d"]
    cost: Float[Array, ""]
    damping: Float[Array, ""]
    ended: Bool[Array, ""]


def likely_path(
    problem: RecordProblem, model: Diffusion, path: Float[Array, "points d"]
) -> Float[Array, "points d"]:
    """Return a path near a minimum of J, from a finite path inside the state space."""

    def iterate(last: _Iterate) -> _Iterate:
        new = _next_path(problem, model, last.path, last.damping)
        cost = _cost(problem, model, new)
        gain = last.cost - cost
        better = gain > 0
        small = last.damping * _DOWN
        damping = jnp.where(better, small, last.damping * _UP)
        # A small gain shows convergence only if λ is small; otherwise the step is short.
        ended = jnp.where(better, (gain < _NO_GAIN) & (last.damping < 0.1), damping > _LARGEST)
        path, cost = (jnp.where(better, a, b) for a, b in ((new, last.path), (cost, last.cost)))
        return _Iterate(last.iteration + 1, path, cost, damping, ended)

    dtype = path.dtype
    cost = _cost(problem, model, path)
    first = _Iterate(jnp.int32(0), path, cost, jnp.asarray(_FIRST, dtype), ~jnp.isfinite(cost))
    goes_on = lambda last: ~last.ended & (last.iteration < _MOST_ITERATIONS)
    return lax.while_loop(goes_on, iterate, first).path


def _cost(
    problem: RecordProblem, model: Diffusion, path: Float[Array, "points d"]
) -> Float[Array, ""]:
    """Return J. It is infinite for a path that is not finite or leaves the state space."""
    motion, N = problem.motion(model), problem.num_steps

    def of_step(x, x_next, step):
        law = motion.law(x, step)
        noise = law.solve(x_next - law.mean)
        return dot(noise, noise)

    squares = over_points(of_step)(path[:-1], path[1:], flat(problem.steps(model)))
    initial = initial_law(problem.initial, model, problem.like)
    first = solve_root(initial.root, path[0] - initial.mean)
    residuals = jax.vmap(_misfit)(problem.scalars(model), path[::N])
    cost = (jnp.sum(squares) + dot(first, first) + jnp.sum(residuals)) / 2
    good = jnp.isfinite(cost)
    if (inside := model.state_space()) is not None:
        good &= jnp.all(jax.vmap(inside)(path))
    return jnp.where(good, cost, jnp.inf)


def _misfit(scalars: Scalars, x: Float[Array, " d"]) -> Float[Array, ""]:
    """Return the sum of squared residuals, in variances of the noise.

    Exact observations do not count.
    """
    noisy = scalars.seen & (scalars.variances > 0)
    squares = (scalars.values - matvec(scalars.rows, x)) ** 2
    return jnp.sum(jnp.where(noisy, squares / jnp.where(noisy, scalars.variances, 1), 0))


def _next_path(
    problem: RecordProblem,
    model: Diffusion,
    path: Float[Array, "points d"],
    damping: Float[Array, ""],
) -> Float[Array, "points d"]:
    """Return the path of the next iteration, from the present one."""
    motion, steps = problem.motion(model), problem.steps(model)
    K, N = problem.num_segments, problem.num_steps
    # Mean, relative to u_last, and standard deviation of the noise with the penalty.
    mean_share, scale = damping / (1 + damping), 1 / jnp.sqrt(1 + damping)

    def linear(point, next_point, step):
        return linear_step(motion, point, next_point, step)

    linearised = over_points(linear)(path[:-1], path[1:], flat(steps))
    away = -linearised.shift  # Λ u, for the noise u of the last path
    segments = lambda leaf: leaf.reshape(K, N, *leaf.shape[1:])
    damped = LinearisedStep(
        linearised.decay, linearised.shift + mean_share * away, scale * linearised.root
    )
    first, later = split_first(jax.vmap(relative)(problem.scalars(model), path[::N]))
    h = information_filter(jax.tree.map(segments, damped), later)
    initial = initial_law(problem.initial, model, problem.like)
    mean = initial.mean + mean_share * (path[0] - initial.mean)
    h_first = jax.tree.map(lambda leaf: leaf[0, 0], h)
    start = guided_start(NormalStep(mean, scale * initial.root), first, path[0], h_first)

    def one(x, inputs):
        next_point, away, step, next_h, scalars = inputs
        law = motion.law(x, step)
        pushed = NormalStep(law.mean + mean_share * away - next_point, scale * law.root)
        pushed, _, _ = given(pushed, scalars)
        bent = tilted(pushed, next_h)
        # The step with noise zero is the most likely one.
        x = next_point + bent.point(bent.pulled(jnp.zeros_like(x)))
        return x, x

    x, _ = start.point_and_log_weight(jnp.zeros_like(path[0]))
    inputs = path[1:], away, flat(steps), flat(following(h)), at_every_step(later, N)
    return jnp.concatenate([x[None], lax.scan(one, x, inputs)[1]])
