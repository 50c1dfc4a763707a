"""A whole record, guided: what the steps of its paths need, worked out before any is simulated."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.averages import proper
from ..engine.checks import without_derivatives
from ..engine.compiled import compiled_sooner
from ..engine.lanes import over_lanes, over_points
from ..engine.linalg import sum_of_many
from ..engine.recursion import recursion
from ..models.diffusion import Diffusion
from ..schemes import solve_root
from .guided_steps import (
    Guide,
    GuidedLaw,
    guided_law,
    guided_start,
    guided_step,
    relative,
    target_law,
)
from .information_filter import information_filter
from .initial import calls_for_cover, initial_law, likeliest, log_ratio
from .linearisation import LinearisedStep, extended_kalman_path, linear_step
from .observation import Row, Scalars
from .problem import RecordProblem
from .record import Steps
from .segments import at_every_step, flat, following, split_first
from .tilted_step import NormalStep

# How often the path along which the process is linearised is found anew from the last; what log
# weights gain by it that is worth no further turn; and the shortest of its steps.
_MOST_TURNS, _NO_GAIN, _SHORTEST = 30, 0.5, 2.0**-10


class Guidance(NamedTuple):
    """What guides paths at some parameters.

    - `initial`: the normal law of X(t_0); `start`: the guided one, with its log weight.
    - `linear`: the steps of the linear process, and `steps`: the guides of all steps, leading axes
        (K, N).
    - `first`, `scalars`: what is seen of X(t_0), and at the ends of the segments, leading axis K,
        counted from ξ.
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
    """Linearised along these points; `rate` is that at which it forgets, if it does."""
    dynamics_at, record = model.forward_at(problem.like), problem.record.steps()
    initial = initial_law(problem.initial, model, problem.like)
    K, N = problem.num_segments, problem.num_steps
    of_segments = lambda leaf: leaf.reshape(K, N, *leaf.shape[1:])
    here, there = of_segments(points[:-1]), of_segments(points[1:])

    def linear(point, next_point, step):
        dynamics = dynamics_at(step.time)
        return linear_step(problem.density, dynamics, point, next_point, step.dt)

    steps = jax.vmap(over_points(linear))(here, there, record)
    scalars = jax.vmap(relative)(problem.scalars(model), points[::N])
    first, rest = split_first(scalars)
    return _with_h(initial, steps, first, rest, (here, there, record), rate)


def forgetful(guide: Guidance, rate: Float[Array, ""]) -> Guidance:
    """The same, which forgets at this rate (`forgetting`)."""
    steps = guide.steps
    path = steps.point, steps.next_point, steps.step
    return _with_h(guide.initial, guide.linear, guide.first, guide.scalars, path, rate)


def _with_h(
    initial: NormalStep,
    linear: LinearisedStep,
    first: Scalars,
    scalars: Scalars,
    path: tuple[Float[Array, "K N d"], Float[Array, "K N d"], Steps],
    rate: Float[Array, ""] | None,
) -> Guidance:
    """A linear process along a path, and what is seen of it, with what follows of them."""
    here, there, steps = path
    kept = None if rate is None else jnp.exp(-rate * steps.dt)
    h = information_filter(linear, scalars, kept=kept)
    guides = Guide(here, h, there, following(h), steps)
    h_first = jax.tree.map(lambda leaf: leaf[0, 0], h)
    start = guided_start(initial, first, here[0, 0], h_first)
    return Guidance(initial, start, linear, guides, first, scalars)


def path_and_log_weight(
    problem: RecordProblem, model: Diffusion, guide: Guidance, noise: Float[Array, "points d"]
) -> tuple[Float[Array, "points d"], Float[Array, ""]]:
    """The path that this noise makes, and its log weight: `noise[0]` makes x_0."""
    density, dynamics_at = problem.density, model.forward_at(problem.like)
    start = guide.start.point(noise[0])
    steps = flat(guide.steps), at_every_step(guide.scalars, problem.num_steps)

    def one(x, inputs):
        zeta, step, scalars = inputs
        law = guided_step(density, dynamics_at, x, step, scalars)
        return law.point(zeta), law.log_weight

    points, log_weights = recursion(one, start, (noise[1:], *steps))
    path = jnp.concatenate([start[None], points])
    log_weight = guide.start.log_weight + sum_of_many(log_weights)
    return path, log_weight + corrections(problem, model, guide, path)


def _of_each_step(of_step: Callable, *steps: PyTree) -> PyTree:
    """`of_step` of all steps, which are the first axes of arrays, side by side."""
    last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), steps)
    each = over_lanes(*[-1] * len(steps))(of_step)(*last)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), each)


def noise_and_log_weight(
    key: Key[Array, ""],
    problem: RecordProblem,
    model: Diffusion,
    guide: Guidance,
    path: Float[Array, "points d"],
) -> tuple[Float[Array, "points d"], Float[Array, ""]]:
    """The inverse of `path_and_log_weight`: noise that makes this path, where none moves it drawn
    afresh."""
    density, dynamics_at = problem.density, model.forward_at(problem.like)
    scalars = at_every_step(guide.scalars, problem.num_steps)
    hidden = jax.random.normal(key, (len(path), scalars.values.shape[1]), path.dtype)
    first = guide.start.noise(path[0], functools.partial(solve_root, guide.initial.root), hidden[0])
    # What the law of x_0 does not leave to noise is not moved by it, either.
    still = jnp.diagonal(guide.initial.root) == 0
    fresh = jax.random.normal(jax.random.fold_in(key, 1), first.shape, path.dtype)

    def of_step(x, x_next, step, scalars, hidden):
        law = target_law(density, dynamics_at, x, step.step)
        made = guided_law(law, x, step, scalars)
        return made.noise(x_next, law.solve, hidden), made.log_weight

    steps = path[:-1], path[1:], flat(guide.steps), scalars, hidden[1:]
    zeta, log_weights = _of_each_step(of_step, *steps)
    noise = jnp.concatenate([jnp.where(still, fresh, first)[None], zeta])
    log_weight = guide.start.log_weight + sum_of_many(log_weights)
    return noise, log_weight + corrections(problem, model, guide, path)


def corrections(
    problem: RecordProblem, model: Diffusion, guide: Guidance, path: Float[Array, "points d"]
) -> Float[Array, ""]:
    """What the log weight of a path takes where observations are not of their guess, and the
    initial law is not normal."""
    each = over_points(correction(problem, model))
    at_observations = each(problem.rows, path[:: problem.num_steps])
    return jnp.sum(at_observations) + log_ratio(problem.initial, model, guide.initial, path[0])


def correction(
    problem: RecordProblem, model: Diffusion
) -> Callable[[Row, Float[Array, " d"]], Float[Array, ""]]:
    """What the log weight takes where an observation is not of its guess, a function of it and of
    the state; NaN outside the state space, for of the last state no drift is asked."""
    inside = model.state_space()

    def of(row, x):
        value = problem.observation.correction(row, x, model.params)
        return value if inside is None else jnp.where(inside(x), value, jnp.nan)

    return of


class Linearised(NamedTuple):
    """The points along which the process is linearised, and what guides paths there."""

    points: Float[Array, "points d"]
    guide: Guidance


class _Search(NamedTuple):
    """Of Gauss and Newton's iteration: the points of the next turn; the best so far, the log weight
    of its path without noise, and that path; the length of the step to it, and whether it is
    over."""

    turn: Int[Array, ""]
    points: Float[Array, "points d"]
    best: Linearised
    log_weight: Float[Array, ""]
    path: Float[Array, "points d"]
    length: Float[Array, ""]
    over: Bool[Array, ""]


@compiled_sooner  # a program of its own, which all who read the record share
def linearised(problem: RecordProblem, model: Diffusion) -> Linearised:
    """Along the path of the extended Kalman filter, and then of the path that is guided without
    noise; both begin at a likely point where ν is not normal. The points have no derivatives, and
    the guide none by the model.

    What counts is the weight of the path without noise: where it is large, weights fall off as
    noise leads away from it, and where it is small paths that weigh more are missed. So a turn
    counts that raises it, and steps are shortened until one does: excitable and chaotic systems
    throw Gauss and Newton's iteration off for good, and between two wells its fixed point, the
    likeliest path, guides worse than the filter's means."""
    own, (problem, model) = problem, without_derivatives((problem, model))
    initial = initial_law(problem.initial, model, problem.like)
    dynamics_at, scalars = model.forward_at(problem.like), problem.scalars(model)
    begin = likeliest(problem.initial, model, initial, split_first(scalars)[0])
    first = initial._replace(mean=begin)
    steps = problem.record.steps()
    points = extended_kalman_path(problem.density, dynamics_at, first, steps, scalars)
    silence = jnp.zeros_like(points)

    @jax.jit  # for its shapes and in the loop traced once
    def at(points):
        guide = guided(problem, model, points)
        noise = silence
        if calls_for_cover(problem.initial, model, problem.like):
            solve = functools.partial(solve_root, guide.initial.root)
            hidden = jnp.zeros_like(guide.first.values)
            noise = silence.at[0].set(guide.start.noise(begin, solve, hidden))
        path, log_weight = path_and_log_weight(problem, model, guide, noise)
        path = jnp.where(jnp.all(jnp.isfinite(path)), path, points)
        return Linearised(points, guide), proper(log_weight), path

    def turn(search: _Search) -> _Search:
        new = at(search.points)
        gain = jnp.where(search.turn == 0, jnp.inf, new[1] - search.log_weight)
        better = (gain > _NO_GAIN) | (search.log_weight == -jnp.inf)
        old = search.best, search.log_weight, search.path
        best, log_weight, path = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
        settled = jnp.abs(gain) < _NO_GAIN
        length = jnp.where(better, jnp.minimum(2 * search.length, 1), search.length / 2)
        points = best.points + length * (path - best.points)
        points = jnp.where(length == 1, path, points)
        over = settled | (length < _SHORTEST)
        return _Search(search.turn + 1, points, best, log_weight, path, length, over)

    shapes, log_weight, _ = jax.eval_shape(at, points)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    zero, one = jnp.zeros((), log_weight.dtype), jnp.ones((), points.dtype)
    init = _Search(jnp.int32(0), points, nothing, zero, points, one, jnp.zeros((), bool))
    goes_on = lambda search: ~search.over & (search.turn < _MOST_TURNS)
    points, guide = lax.while_loop(goes_on, turn, init).best
    return Linearised(points, _guide_of((own, guide), model=model, points=points))


@eqx.filter_custom_jvp
def _guide_of(
    known: tuple[RecordProblem, Guidance], *, model: Diffusion, points: Float[Array, "points d"]
) -> Guidance:
    """The guide along these points, which is known; its derivatives are those of what was seen and
    where it began."""
    return known[1]


@_guide_of.def_jvp
def _guide_derivative(primals, tangents, *, model, points):
    ((problem, guide),), ((change, _),) = primals, tangents
    along = lambda problem: guided(problem, model, points)
    return guide, eqx.filter_jvp(along, (problem,), (change,))[1]
