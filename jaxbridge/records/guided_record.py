"""Guide of a whole record: the quantities of all guided steps, computed before the simulation.

The module also simulates guided paths with their weights, and recovers the noise of a path.

The *knots* of a path are x_0 and the ends of the normal parts of its steps (`guided_steps`). They
determine the path and its noise, which a path alone does not if steps are quadratic in the noise.
For normal steps they are the path itself. At the ends of segments they are its points.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key, PyTree

from ..engine.lanes import over_lanes, over_points
from ..engine.linalg import sum_of_many
from ..engine.recursion import recursion
from ..models.diffusion import Diffusion
from ..schemes import relative_change, solve_root
from .guided_steps import (
    Guide,
    GuidedLaw,
    end_of_step,
    guided_law,
    guided_start,
    relative,
)
from .information_filter import information_filter
from .initial import initial_law, log_ratio
from .linearisation import LinearisedStep, linear_step
from .observations import Row, Scalars, log_density_of
from .problem import RecordProblem
from .record import Steps
from .segments import at_every_step, flat, following, split_first, split_last
from .tilted_step import NormalStep


class Guidance(NamedTuple):
    """Quantities that guide the paths of a record, at given parameters.

    - `initial`: normal law of X(t_0).
    - `start`: guided law of X(t_0).
    - `linear`: steps of the linear process, leading axes (K, N).
    - `steps`: guides of all steps, leading axes (K, N).
    - `first`: scalar observations of X(t_0), relative to the point ξ of the linearisation there.
    - `scalars`: those at the ends of segments, relative to ξ in the same way, leading axis K.
    """

    initial: NormalStep
    start: GuidedLaw
    linear: LinearisedStep
    steps: Guide
    first: Scalars
    scalars: Scalars


def guided(
    problem: RecordProblem,
    model: Diffusion,
    points: Float[Array, "points d"],
    rate: Float[Array, ""] | None = None,
) -> Guidance:
    """Return the guide that is linearised along these points.

    `rate` is the discount rate (`forgetting`), by default none.
    """
    motion, record = problem.motion(model), problem.steps(model)
    initial = initial_law(problem.initial, model, problem.like)
    K, N = problem.num_segments, problem.num_steps
    of_segments = lambda leaf: leaf.reshape(K, N, *leaf.shape[1:])
    here, next_here = of_segments(points[:-1]), of_segments(points[1:])

    def linear(point, next_point, step):
        return linear_step(motion, point, next_point, step)

    steps = jax.vmap(over_points(linear))(here, next_here, record)
    # Observations are at the ends of segments, which are N points apart.
    scalars = jax.vmap(relative)(problem.scalars(model), points[::N])
    first, later = split_first(scalars)
    return _guidance(initial, steps, first, later, (here, next_here, record), rate)


def forgetful(guide: Guidance, rate: Float[Array, ""]) -> Guidance:
    """Return the same guide with this discount rate (`forgetting`)."""
    # The linear process does not depend on the rate, so only h is computed again.
    steps = guide.steps
    path = steps.point, steps.next_point, steps.step
    return _guidance(guide.initial, guide.linear, guide.first, guide.scalars, path, rate)


def _guidance(
    initial: NormalStep,
    linear: LinearisedStep,
    first: Scalars,
    scalars: Scalars,
    path: tuple[Float[Array, "K N d"], Float[Array, "K N d"], Steps],
    rate: Float[Array, ""] | None,
) -> Guidance:
    """Return the guide for a linear process along a path and for scalar observations."""
    here, next_here, steps = path
    # h_{i+1} to the power exp(-γ δ) enters step i.
    power = None if rate is None else jnp.exp(-rate * steps.dt)
    h = information_filter(linear, scalars, power=power)
    guides = Guide(here, h, next_here, following(h), steps)
    h_first = jax.tree.map(lambda leaf: leaf[0, 0], h)
    start = guided_start(initial, first, here[0, 0], h_first)
    return Guidance(initial, start, linear, guides, first, scalars)


class _GuidedPath(NamedTuple):
    """Guided path with its knots, and the log weights of its start and of its steps."""

    path: Float[Array, "points d"]
    knots: Float[Array, "points d"]
    log_start: Float[Array, ""]
    log_steps: Float[Array, " steps"]


def path_and_log_weight(
    problem: RecordProblem, model: Diffusion, guide: Guidance, noise: Float[Array, "points d"]
) -> tuple[Float[Array, "points d"], Float[Array, ""]]:
    """Return the path of this noise, and its log weight.

    `noise[0]` determines x_0, and `noise[i]` step i.
    """
    guided_path = _guided_path(problem, model, guide, noise)
    return guided_path.path, _log_weight(problem, model, guide, guided_path)


def knots_and_log_weight(
    problem: RecordProblem, model: Diffusion, guide: Guidance, noise: Float[Array, "points d"]
) -> tuple[Float[Array, "points d"], Float[Array, ""]]:
    """Return the knots of the path of this noise, and its log weight."""
    guided_path = _guided_path(problem, model, guide, noise)
    return guided_path.knots, _log_weight(problem, model, guide, guided_path)


def path_and_log_weights(
    problem: RecordProblem, model: Diffusion, guide: Guidance, noise: Float[Array, "points d"]
) -> tuple[Float[Array, "points d"], Float[Array, " ends"]]:
    """Return the path of this noise, and the log weights of its start and of each segment.

    The log weights are those of `particle_filter`: each is multiplied by h at the end of the
    segment and divided by h at its beginning. Hence they vary little, and they are nearly
    independent. Their sum is the log weight of the path, up to rounding errors of h.
    """
    guided_path = _guided_path(problem, model, guide, noise)
    K, N = problem.num_segments, problem.num_steps
    by_segment = jnp.sum(guided_path.log_steps.reshape(K, N), axis=1)
    ends, steps = guided_path.path[::N], guide.steps
    log_h = jax.vmap(lambda h, point, x: h.log(x - point))
    first, last = (jax.tree.map(lambda leaf, i=i: leaf[:, i], steps) for i in (0, -1))
    before = log_h(first.h, first.point, ends[:-1])
    after = log_h(last.next_h, last.next_point, ends[1:])
    start = (guided_path.log_start + before[0])[None]
    log_weights = jnp.concatenate([start, by_segment + after - before])
    return guided_path.path, log_weights + _corrections(problem, model, guide, guided_path.path)


def _guided_path(
    problem: RecordProblem, model: Diffusion, guide: Guidance, noise: Float[Array, "points d"]
) -> _GuidedPath:
    """Return the path of this noise."""
    motion, is_normal = problem.motion(model), problem.density.is_normal
    start, log_start = guide.start.point_and_log_weight(noise[0])
    steps = flat(guide.steps), at_every_step(guide.scalars, problem.num_steps)
    is_last = np.arange(1, len(noise)) % problem.num_steps == 0

    def one(x, inputs):
        zeta, step, scalars, is_last = inputs
        law = motion.law(x, step.step)
        knot, log_weight = guided_law(law, step, scalars).point_and_log_weight(zeta)
        point = end_of_step(law, knot, is_last)
        return point, (None if is_normal else knot, log_weight)

    inputs = (noise[1:], *steps, jnp.asarray(is_last))
    points, (knots, log_steps) = recursion(one, start, inputs)
    path = jnp.concatenate([start[None], points])
    knots = path if knots is None else jnp.concatenate([start[None], knots])
    return _GuidedPath(path, knots, log_start, log_steps)


def _log_weight(
    problem: RecordProblem, model: Diffusion, guide: Guidance, guided_path: _GuidedPath
) -> Float[Array, ""]:
    """Return the log weight of a path."""
    log_weight = guided_path.log_start + sum_of_many(guided_path.log_steps)
    return log_weight + jnp.sum(_corrections(problem, model, guide, guided_path.path))


def path_of_knots(
    problem: RecordProblem, model: Diffusion, knots: Float[Array, "points d"]
) -> Float[Array, "points d"]:
    """Return the path with these knots."""
    if problem.density.is_normal:
        return knots
    K, N = problem.num_segments, problem.num_steps
    motion = problem.motion(model)
    # Segments begin at known points, so they are lanes.
    of_segments = lambda leaf: jnp.moveaxis(leaf.reshape(K, N, *leaf.shape[1:]), 0, -1)
    inner, steps = jax.tree.map(of_segments, (knots[1:], flat(problem.steps(model))))

    def one(x, inputs):
        of_lane = lambda x, knot, step: end_of_step(motion.law(x, step), knot)
        x = over_lanes(-1, -1, -1)(of_lane)(x, *inputs)
        return x, x

    bent, ends = split_last((inner, steps))
    _, points = lax.scan(one, knots[:-1:N].T, bent)
    path = jnp.moveaxis(jnp.concatenate([points, ends[0][None]]), -1, 0)
    return jnp.concatenate([knots[:1], path.reshape(K * N, -1)])


def pair_noise(
    noise: Float[Array, "points d"], lengths: tuple[float, ...]
) -> Float[Array, "points d"]:
    """Return the noise of steps that join pairs of steps, on the grid of `Record.coarsened`.

    `lengths` are those of the steps of a segment. The shape is that of the fine grid. The scaled
    sum of each pair is the noise of its second step; its first step has no length on that grid.
    """
    # The first step of a segment with odd N has no partner and remains.
    odd = len(lengths) % 2
    scale = np.sqrt(lengths)[:, None]
    segments = noise[1:].reshape(-1, len(lengths), noise.shape[-1])
    scaled = segments * scale.astype(noise.dtype)
    total = np.hypot(scale[odd::2], scale[odd + 1 :: 2]).astype(noise.dtype)
    sums = (scaled[:, odd::2] + scaled[:, odd + 1 :: 2]) / total
    pairs = jnp.stack([segments[:, odd::2], sums], axis=2)
    pairs = pairs.reshape(len(segments), -1, noise.shape[-1])
    segments = jnp.concatenate([segments[:, :odd], pairs], axis=1)
    return jnp.concatenate([noise[:1], segments.reshape(-1, noise.shape[-1])])


def _map_steps(of_step: Callable, *steps: PyTree) -> PyTree:
    """Evaluate `of_step` for all steps in lanes. Steps are the first axis of all arrays."""
    last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), steps)
    results = over_lanes(*[-1] * len(steps))(of_step)(*last)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), results)


def noise_and_log_weight(
    key: Key[Array, ""],
    problem: RecordProblem,
    model: Diffusion,
    guide: Guidance,
    knots: Float[Array, "points d"],
) -> tuple[Float[Array, "points d"], Float[Array, ""]]:
    """Return noise that leads to the path with these knots, and the log weight of the path.

    This is the inverse of `knots_and_log_weight`. Components of the noise that do not move the path
    are drawn afresh.
    """
    path = path_of_knots(problem, model, knots)
    motion = problem.motion(model)
    scalars = at_every_step(guide.scalars, problem.num_steps)
    hidden = jax.random.normal(key, (len(path), scalars.values.shape[1]), path.dtype)
    solve = functools.partial(solve_root, guide.initial.root)
    first, log_start = guide.start.noise_and_log_weight(path[0], solve, hidden[0])
    # The noise of exactly known components of x_0 has no effect, so it is drawn afresh.
    still = jnp.diagonal(guide.initial.root) == 0
    fresh = jax.random.normal(jax.random.fold_in(key, 1), first.shape, path.dtype)

    def of_step(x, knot, step, scalars, hidden):
        law = motion.law(x, step.step)
        step_law = guided_law(law, step, scalars)
        return step_law.noise_and_log_weight(knot, law.solve, hidden)

    steps = path[:-1], knots[1:], flat(guide.steps), scalars, hidden[1:]
    zeta, log_weights = _map_steps(of_step, *steps)
    noise = jnp.concatenate([jnp.where(still, fresh, first)[None], zeta])
    log_weight = log_start + sum_of_many(log_weights)
    return noise, log_weight + jnp.sum(_corrections(problem, model, guide, path))


def _corrections(
    problem: RecordProblem, model: Diffusion, guide: Guidance, path: Float[Array, "points d"]
) -> Float[Array, " ends"]:
    """Return the terms of the log weights for a general observation model and initial law.

    They belong to the ends of segments, and are zero for a `LinearGaussian` and a normal initial
    law.
    """
    of_points = over_points(correction(problem, model))
    at_observations = of_points(problem.rows, path[:: problem.num_steps])
    of_start = log_ratio(problem.initial, model, guide.initial, path[0])
    return at_observations.at[0].add(of_start)


def log_observation_densities(
    problem: RecordProblem, model: Diffusion, scalars: Scalars, states: Float[Array, "ends d"]
) -> Float[Array, " ends"]:
    """Return log g of the observations, given the states at the ends of segments."""
    corrected = correction(problem, model)

    def log_g(scalars, row, x):
        return log_density_of(scalars, x) + corrected(row, x)

    return over_points(log_g)(scalars, problem.rows, states)


def change_by_coarse_steps(
    log_weights: Float[Array, " ends"], log_coarse: Float[Array, " ends"]
) -> Float[Array, ""]:
    """Return the relative change of the likelihood by steps of twice the size, from one path.

    The arguments are the log weights of the start and of each segment (`path_and_log_weights`) for
    both step sizes. With D_k the difference for segment k, the result is Σ (e^{D_k} - 1), to second
    order. The change e^D - 1 of the whole path, D = Σ D_k, has the same mean to leading order, but
    a variance that increases with the square of the number of segments. The result is -1 for a path
    that has weight zero with half as many steps.
    """
    D = log_coarse - log_weights
    is_lost = ~jnp.all(jnp.isfinite(log_coarse))
    return jnp.where(is_lost, -1, jnp.sum(relative_change(D, jnp.zeros_like(D))))


def correction(
    problem: RecordProblem, model: Diffusion
) -> Callable[[Row, Float[Array, " d"]], Float[Array, ""]]:
    """Return a function of an observation and a state: the log weight's term for a general model.

    The term is log g minus the log density of the guess. It is NaN outside the state space. The
    last state of a path begins no step, so this check is needed there.
    """
    inside = model.state_space()

    def of(row, x):
        value = problem.observation.correction(row, x, model.params)
        return value if inside is None else jnp.where(inside(x), value, jnp.nan)

    return of
