"""The path along which a record is linearised, searched for, and a check of what was found."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..engine.averages import proper
from ..engine.checks import without_derivatives
from ..engine.compiled import compiled_sooner
from ..models.diffusion import Diffusion
from ..schemes import solve_root
from .guided_record import Guidance, guided, path_and_log_weight
from .initial import calls_for_cover, initial_law, likeliest
from .linearisation import extended_kalman_path
from .observation import Scalars
from .problem import RecordProblem
from .segments import split_first

# How often the path along which the process is linearised is found anew from the last; what log
# weights gain by it that is worth no further turn; and the shortest of its steps.
_MOST_TURNS, _NO_GAIN, _SHORTEST = 30, 0.5, 2.0**-10


class Linearised(NamedTuple):
    """The points along which the process is linearised, and what guides paths there."""

    points: Float[Array, "points d"]
    guide: Guidance


class GuideCheck(NamedTuple):
    """Diagnostics of a guide at the parameters of a model.

    - `log_weight`: of the guided path without noise; -inf where that path leaves the finite numbers
        or the state space, or explains no observation.
    - `largest_residual`: the largest distance of an observation from the path of linearisation, in
        standard deviations of its noise. Exact observations do not count.
    """

    log_weight: Float[Array, ""]
    largest_residual: Float[Array, ""]

    @property
    def is_usable(self) -> Bool[Array, ""]:
        """Whether the guided path without noise has a weight at all: where it has none, paths with
        noise seldom do."""
        return self.log_weight > -jnp.inf


@compiled_sooner
def check_guide(problem: RecordProblem, model: Diffusion, guide: Guidance) -> GuideCheck:
    """Return the diagnostics of this guide of a record. No derivatives."""
    problem, model, guide = without_derivatives((problem, model, guide))
    begin = likeliest(problem.initial, model, guide.initial, _first_scalars(problem, model))
    _, log_weight = _path_without_noise(problem, model, guide, begin)
    return GuideCheck(log_weight, largest_residual(guide))


def _first_scalars(problem: RecordProblem, model: Diffusion) -> Scalars:
    """Return what is seen of X(t_0)."""
    return split_first(problem.scalars(model))[0]


def largest_residual(guide: Guidance) -> Float[Array, ""]:
    """Return the largest distance of an observation from the path of linearisation, in standard
    deviations of its noise."""

    def of(scalars: Scalars) -> Float[Array, ""]:
        noisy = scalars.seen & (scalars.variances > 0)
        size = jnp.abs(scalars.values) / jnp.sqrt(jnp.where(noisy, scalars.variances, 1))
        return jnp.max(jnp.where(noisy, size, 0))

    return jnp.maximum(of(guide.first), of(guide.scalars))


def _path_without_noise(
    problem: RecordProblem, model: Diffusion, guide: Guidance, begin: Float[Array, " d"]
) -> tuple[Float[Array, "points d"], Float[Array, ""]]:
    """Return the guided path without noise and its log weight. It starts at `begin` where the law
    of X(t_0) is not normal."""
    noise = jnp.zeros((problem.num_segments * problem.num_steps + 1, problem.dim), begin.dtype)
    if calls_for_cover(problem.initial, model, problem.like):
        solve = functools.partial(solve_root, guide.initial.root)
        hidden = jnp.zeros_like(guide.first.values)
        noise = noise.at[0].set(guide.start.noise_and_log_weight(begin, solve, hidden)[0])
    path, log_weight = path_and_log_weight(problem, model, guide, noise)
    return path, proper(log_weight)


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
    begin = likeliest(problem.initial, model, initial, _first_scalars(problem, model))
    first = initial._replace(mean=begin)
    steps = problem.record.steps()
    points = extended_kalman_path(problem.density, dynamics_at, first, steps, scalars)

    @jax.jit  # for its shapes and in the loop traced once
    def at(points):
        guide = guided(problem, model, points)
        path, log_weight = _path_without_noise(problem, model, guide, begin)
        path = jnp.where(jnp.all(jnp.isfinite(path)), path, points)
        return Linearised(points, guide), log_weight, path

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
