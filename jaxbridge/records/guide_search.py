"""Search for the path of the linearisation of a record, and a check of the resulting guide.

The first search starts from the path of the extended Kalman filter. If this filter diverges, the
search finds no path of finite weight, or one far from the observations. Then further searches start
from paths of particles that stay near the observations (`tracking`), improved by damped iterations
(`likely_path`). The result is the best path of all searches.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..engine.averages import nan_to_neg_inf
from ..engine.captured import without_captured_derivatives
from ..engine.checks import all_finite_leaves, without_derivatives
from ..engine.compiled import compiled_sooner, is_outermost
from ..engine.keys import key_for
from ..engine.verdict import Fault
from ..models.diffusion import Diffusion
from ..models.dynamics import is_linear
from ..schemes import solve_root
from .guided_record import Guidance, guided, path_and_log_weight
from .initial import calls_for_cover, initial_law, likeliest
from .likely_path import likely_path
from .linearisation import extended_kalman_path, stay_inside
from .observations import Scalars
from .problem import RecordProblem
from .segments import split_first
from .tracking import tracking_path

# Bounds of the iteration: number of linearisations, gain of the log weight below which it ends,
# and shortest step.
_MOST_TURNS, _NO_GAIN, _SHORTEST = 30, 0.5, 2.0**-10
# Maximum number of searches from paths of particles. They are needed if a residual exceeds the
# typical maximum of n normal numbers, √(2 log n), by more than `_BEYOND_NOISE`.
_MOST_PARTICLE_STARTS, _BEYOND_NOISE = 3, 1.0
# Larger than all finite log weights.
_NO_WEIGHT = 1e20


_POOR = (
    "The guide of a record is poor: its path has weight zero, or its distance from an observation "
    "exceeds √(2 log n) + 1 standard deviations of the noise, with n observed numbers. Start from "
    "likelier parameters (the model's `params`, or `init=`), use more `num_steps`, or check for "
    "outliers, which the noise must allow for."
)


class GuideCheck(NamedTuple):
    """Diagnostics of the guide of a record, at the parameters for which it was found.

    For several records all fields have a leading axis.

    - `log_weight`: log weight of the guided path without noise. -inf if this path diverges, leaves
        the state space, or does not explain an observation.
    - `largest_residual`: largest distance of an observation from the path of the linearisation, in
        standard deviations of the noise. Exact observations do not count. Infinite if the guide is
        not finite.
    - `num_observed`: number of observed numbers at all times, without missing ones.
    """

    log_weight: Float[Array, "*R"]
    largest_residual: Float[Array, "*R"]
    num_observed: Int[Array, "*R"]

    @property
    def is_usable(self) -> Bool[Array, "*R"]:
        """Return whether the guided path without noise has a positive weight.

        If not, paths with noise rarely have a positive weight either.
        """
        return self.log_weight > -jnp.inf

    @property
    def is_near(self) -> Bool[Array, "*R"]:
        """Return whether the guide is usable and its residuals are consistent with the noise."""
        return _is_near(self)

    @property
    def rank(self) -> Float[Array, "*R"]:
        """Return a score for comparing guides: the log weight if the guide is usable.

        Otherwise it is a value below all log weights, lower for a larger residual.
        """
        unusable = -_NO_WEIGHT * (1 + self.largest_residual)
        return jnp.where(self.is_usable, self.log_weight, unusable)

    def fault(self, hampered: Bool[Array, ""] | bool = True) -> Fault:
        """Return the fault of a poor guide.

        `hampered` states whether other diagnostics of the result show a problem. Only then is a
        poor guide a fault, because weights and chains are exact with any guide.
        """
        return Fault(jnp.any(~self.is_near) & hampered, _POOR)


@compiled_sooner
def _is_near(check: GuideCheck) -> Bool[Array, "*R"]:
    number = jnp.maximum(check.num_observed, 1).astype(check.largest_residual.dtype)
    largest = jnp.sqrt(2 * jnp.log(number)) + _BEYOND_NOISE
    return check.is_usable & (check.largest_residual < largest)


class Linearised(NamedTuple):
    """Linearisation of a record.

    - `points`: the path of the linearisation.
    - `guide`: the guide along this path.
    - `check`: diagnostics of the guide.
    """

    points: Float[Array, "points d"]
    guide: Guidance
    check: GuideCheck


def no_check(number: int, dtype: np.dtype) -> GuideCheck:
    """Return placeholder checks for `number` records, until there are checks."""
    zeros = jnp.zeros(number, dtype)
    return GuideCheck(zeros, zeros, jnp.zeros(number, jnp.int32))


@compiled_sooner
def check_guide(problem: RecordProblem, model: Diffusion, guide: Guidance) -> GuideCheck:
    """Return the diagnostics of this guide of a record, without derivatives."""
    problem, model, guide = without_derivatives((problem, model, guide))
    _, log_weight = _path_without_noise(problem, model, guide, guide.start.origin)
    return _check_of(guide, log_weight)


def _check_of(guide: Guidance, log_weight: Float[Array, ""]) -> GuideCheck:
    """Return the diagnostics of a guide whose path without noise has this weight."""
    num_observed = jnp.sum(guide.first.seen) + jnp.sum(guide.scalars.seen)
    # Along an exploding path h is not finite, and every path has weight zero.
    finite = all_finite_leaves((guide.start, guide.steps))
    residual = jnp.where(finite, _largest_residual(guide), jnp.inf)
    return GuideCheck(log_weight, residual, num_observed.astype(jnp.int32))


def _largest_residual(guide: Guidance) -> Float[Array, ""]:
    """Return the largest distance of an observation from the path of the linearisation.

    It is in standard deviations of the noise. Exact observations do not count.
    """

    def of(scalars: Scalars) -> Float[Array, ""]:
        noisy = scalars.seen & (scalars.variances > 0)
        size = jnp.abs(scalars.values) / jnp.sqrt(jnp.where(noisy, scalars.variances, 1))
        return jnp.max(jnp.where(noisy, size, 0))

    return jnp.maximum(of(guide.first), of(guide.scalars))


def _path_without_noise(
    problem: RecordProblem, model: Diffusion, guide: Guidance, begin: Float[Array, " d"]
) -> tuple[Float[Array, "points d"], Float[Array, ""]]:
    """Return the guided path without noise, and its log weight.

    If the law of X(t_0) is not normal, the path starts at `begin`.
    """
    noise = jnp.zeros((problem.num_segments * problem.num_steps + 1, problem.dim), begin.dtype)
    if calls_for_cover(problem.initial, model, problem.like):
        solve = functools.partial(solve_root, guide.initial.root)
        hidden = jnp.zeros_like(guide.first.values)
        noise = noise.at[0].set(guide.start.noise_and_log_weight(begin, solve, hidden)[0])
    path, log_weight = path_and_log_weight(problem, model, guide, noise)
    return path, nan_to_neg_inf(log_weight)


def linearised(problem: RecordProblem, model: Diffusion) -> Linearised:
    """Return the best path of linearisation that the searches find, and the guide along it.

    The path has no derivatives. The guide has derivatives with respect to the observations and the
    initial law, but not the model. Outside `jit` the searches from particles are compiled only if
    they are needed.
    """
    # Outside `jit` Python decides whether the second program has to be compiled at all.
    if not is_outermost():
        return _in_program(problem, model)
    best = _from_filter(problem, model)
    if best.check.is_near or _is_linear(problem, model):
        return best
    for number in range(_MOST_PARTICLE_STARTS):
        new = _from_particles(problem, model, jnp.int32(number))
        best = new if new.check.rank > best.check.rank else best
        if best.check.is_near:
            break
    return best


def _in_program(own_problem: RecordProblem, own_model: Diffusion) -> Linearised:
    """Return the same as `linearised`, inside a compiled program.

    The guide keeps its derivatives by the observations and the initial law, but not by the model.
    """
    problem, model = without_derivatives((own_problem, own_model))
    linear = _is_linear(problem, model)
    best = (_from_filter if linear else _best_of_loop)(problem, model)
    own_problem = without_captured_derivatives(own_problem)  # like the model's parameters
    guide = _guide_of((own_problem, best.guide), model=model, points=best.points)
    return best._replace(guide=guide)


def _is_linear(problem: RecordProblem, model: Diffusion) -> bool:
    """Return whether the guide is the same along any path."""
    dynamics = model.forward_at(problem.like)(problem.record.first_time)
    cover = calls_for_cover(problem.initial, model, problem.like)
    return is_linear(dynamics, problem.like) and not cover and problem.jumps_are_affine(model)


@compiled_sooner
def _best_of_loop(problem: RecordProblem, model: Diffusion) -> Linearised:
    """Search until a guide is near the observations, in a loop with one search for all starts."""
    first = _filter_start(problem, model)
    # Traced once, for the shapes and for the loop.
    search_from = jax.jit(lambda start: _search(problem, model, start))

    def search(state: tuple[Int[Array, ""], Linearised]) -> tuple[Int[Array, ""], Linearised]:
        number, best = state
        start = lax.cond(
            number == 0,
            lambda: first,
            lambda: _particle_start(problem, model, number - 1),
        )
        new = search_from(start)
        better = (number == 0) | (new.check.rank > best.check.rank)
        return number + 1, jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best)

    def goes_on(state: tuple[Int[Array, ""], Linearised]) -> Bool[Array, ""]:
        number, best = state
        return (number == 0) | ~best.check.is_near & (number <= _MOST_PARTICLE_STARTS)

    none = _zeros_like(jax.eval_shape(search_from, first))
    return lax.while_loop(goes_on, search, (jnp.int32(0), none))[1]


class _SearchStart(NamedTuple):
    """Start of a search.

    - `points`: points of the first linearisation.
    - `begin`: first point of paths without noise, if the law of X(t_0) is not normal.
    """

    points: Float[Array, "points d"]
    begin: Float[Array, " d"]


@compiled_sooner  # a separate program, common to all functions that take the record
def _from_filter(problem: RecordProblem, model: Diffusion) -> Linearised:
    """Search from the path of the extended Kalman filter."""
    return _search(problem, model, _filter_start(problem, model))


@compiled_sooner
def _from_particles(problem: RecordProblem, model: Diffusion, number: Int[Array, ""]) -> Linearised:
    """Search from the path of a particle."""
    return _search(problem, model, _particle_start(problem, model, number))


def _filter_start(problem: RecordProblem, model: Diffusion) -> _SearchStart:
    """Return the path of the extended Kalman filter, from a likely point where ν is not normal."""
    initial, scalars = initial_law(problem.initial, model, problem.like), problem.scalars(model)
    begin = likeliest(problem.initial, model, initial, split_first(scalars)[0])
    points = extended_kalman_path(
        problem.motion(model),
        initial._replace(mean=begin),
        problem.steps(model),
        scalars,
        model.state_space(),
    )
    return _SearchStart(points, begin)


def _particle_start(
    problem: RecordProblem, model: Diffusion, number: Int[Array, ""]
) -> _SearchStart:
    """Return a likely path near that of a particle which stays near the observations."""
    key = jax.random.fold_in(key_for("tracking", jax.random.key(0)), number)
    points = likely_path(problem, model, tracking_path(key, problem, model))
    return _SearchStart(points, points[0])


class _SearchState(NamedTuple):
    """State of the damped Gauss–Newton iteration.

    - `turn`: number of the iteration.
    - `points`: points of the next linearisation.
    - `best`, `check`: the best points so far, their guide and its check.
    - `path`: path without noise of the best guide.
    - `length`: length of the step from the best points towards this path.
    - `over`: whether the iteration has ended.
    """

    turn: Int[Array, ""]
    points: Float[Array, "points d"]
    best: tuple[Float[Array, "points d"], Guidance]
    check: GuideCheck
    path: Float[Array, "points d"]
    length: Float[Array, ""]
    over: Bool[Array, ""]


def _search(problem: RecordProblem, model: Diffusion, start: _SearchStart) -> Linearised:
    """Search from these points: linearise along the guided path without noise, and repeat.

    The criterion is the log weight of the path without noise. If it is large, weights fall with the
    noise. If it is small, the guide misses paths of larger weight. So an iteration must raise the
    weight, and steps are shortened until one does, for two reasons:

    - in excitable and chaotic systems the Gauss–Newton iteration may diverge for good;
    - between two wells its fixed point, the most likely path, guides worse than the means of the
        filter.
    """
    (points, begin), inside = start, model.state_space()

    @jax.jit  # traced once, for `eval_shape` and for the loop
    def at(points):
        guide = guided(problem, model, points)
        path, log_weight = _path_without_noise(problem, model, guide, begin)
        path = jnp.where(jnp.all(jnp.isfinite(path)), path, points)
        return (points, guide), _check_of(guide, log_weight), path

    def turn(search: _SearchState) -> _SearchState:
        new = at(search.points)
        # In the first iteration there is no earlier guide to compare with.
        gain = jnp.where(search.turn == 0, jnp.inf, new[1].rank - search.check.rank)
        better = (gain > _NO_GAIN) | (search.check.rank == -jnp.inf)
        old = search.best, search.check, search.path
        best, check, path = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
        settled = jnp.abs(gain) < _NO_GAIN
        length = jnp.where(better, jnp.minimum(2 * search.length, 1), search.length / 2)
        points = best[0] + length * (path - best[0])
        points = jnp.where(length == 1, path, points)  # without rounding errors
        if inside is not None:
            points = jax.vmap(functools.partial(stay_inside, inside))(best[0], points)
        over = settled | (length < _SHORTEST)
        return _SearchState(search.turn + 1, points, best, check, path, length, over)

    best, check = _zeros_like(jax.eval_shape(at, points)[:2])
    one = jnp.ones((), points.dtype)
    init = _SearchState(jnp.int32(0), points, best, check, points, one, jnp.zeros((), bool))
    goes_on = lambda search: ~search.over & (search.turn < _MOST_TURNS)
    final = lax.while_loop(goes_on, turn, init)
    return Linearised(*final.best, final.check)


def _zeros_like(shapes: PyTree) -> PyTree:
    """Return arrays of zeros with the shapes and dtypes of a pytree."""
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


@eqx.filter_custom_jvp
def _guide_of(
    problem_and_guide: tuple[RecordProblem, Guidance],
    *,
    model: Diffusion,
    points: Float[Array, "points d"],
) -> Guidance:
    """Return the present guide along these points.

    Its derivatives are those of the observations and of the initial law.
    """
    return problem_and_guide[1]


@_guide_of.def_jvp
def _guide_derivative(primals, tangents, *, model, points):
    """Return the guide and its derivative by the problem, at fixed model and points."""
    ((problem, guide),), ((change, _),) = primals, tangents
    along = lambda problem: guided(problem, model, points)
    return guide, eqx.filter_jvp(along, (problem,), (change,))[1]
