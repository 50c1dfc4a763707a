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
from jaxtyping import Array, Bool, Float, Int

from ..engine.averages import proper
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
from .observation import Scalars
from .problem import RecordProblem
from .segments import split_first
from .tracking import tracking_path

# How often the path along which the process is linearised is found anew from the last; what log
# weights gain by it that is worth no further turn; and the shortest of its steps.
_MOST_TURNS, _NO_GAIN, _SHORTEST = 30, 0.5, 2.0**-10
# From how many particles' paths it is searched for at most. How far from an observation a path may
# be that calls for no other start: so much beyond the largest of n normal numbers.
_MOST_PARTICLE_STARTS, _BEYOND_NOISE = 3, 1.0
# Beyond all log weights of paths that have one.
_NO_WEIGHT = 1e20


_POOR = (
    "The guide of a record is poor: its path has weight zero, or its distance from an observation "
    "exceeds √(2 log n) + 1 standard deviations of the noise, with n observations. Start from "
    "likelier parameters (the model's `params`, or `init=`), use more `num_steps`, or check for "
    "outliers, which the noise must allow for."
)


class GuideCheck(NamedTuple):
    """Diagnostics of the guide of a record, at the parameters for which it was found.

    Several records have a leading axis.

    - `log_weight`: log weight of the guided path without noise. -inf if this path diverges, leaves
        the state space, or does not explain an observation.
    - `largest_residual`: largest distance of an observation from the path of the linearisation, in
        standard deviations of the noise. Exact observations do not count. Infinite if the guide is
        not finite.
    - `num_observed`: number of observed components.
    """

    log_weight: Float[Array, "*R"]
    largest_residual: Float[Array, "*R"]
    num_observed: Int[Array, "*R"]

    @property
    def is_usable(self) -> Bool[Array, "*R"]:
        """Whether the guided path without noise has a positive weight.

        If not, paths with noise rarely have one.
        """
        return self.log_weight > -jnp.inf

    @property
    def is_near(self) -> Bool[Array, "*R"]:
        """Whether the guide is usable and its residuals are consistent with the noise."""
        number = jnp.maximum(self.num_observed, 1).astype(self.largest_residual.dtype)
        largest = jnp.sqrt(2 * jnp.log(number)) + _BEYOND_NOISE
        return self.is_usable & (self.largest_residual < largest)

    @property
    def rank(self) -> Float[Array, "*R"]:
        """Score for comparing guides: the log weight if it is finite.

        Otherwise a value below all log weights, which falls with the largest residual.
        """
        unusable = -_NO_WEIGHT * (1 + self.largest_residual)
        return jnp.where(self.is_usable, self.log_weight, unusable)

    def fault(self, hampered: Bool[Array, ""] | bool = True) -> Fault:
        """Return the fault of a poor guide.

        Weights and chains are exact with any guide. A result with other diagnostics passes as
        `hampered` whether these show a problem; only then is a poor guide a fault.
        """
        return Fault(jnp.any(~self.is_near) & hampered, _POOR)


class Linearised(NamedTuple):
    """The points along which the process is linearised, what guides paths there, and how good that
    is."""

    points: Float[Array, "points d"]
    guide: Guidance
    check: GuideCheck


def no_check(number: int, dtype: np.dtype) -> GuideCheck:
    """Return what stands in for the check of each of so many records until there is one."""
    nothing = jnp.zeros(number, dtype)
    return GuideCheck(nothing, nothing, jnp.zeros(number, jnp.int32))


@compiled_sooner
def check_guide(problem: RecordProblem, model: Diffusion, guide: Guidance) -> GuideCheck:
    """Return the diagnostics of this guide of a record. No derivatives."""
    problem, model, guide = without_derivatives((problem, model, guide))
    _, log_weight = _path_without_noise(problem, model, guide, guide.start.origin)
    return _check_of(guide, log_weight)


def _check_of(guide: Guidance, log_weight: Float[Array, ""]) -> GuideCheck:
    """Return the diagnostics of a guide whose path without noise has this weight."""
    num_observed = jnp.sum(guide.first.seen) + jnp.sum(guide.scalars.seen)
    # Along a path that explodes h is not finite, and no path has a weight.
    finite = all_finite_leaves((guide.start, guide.steps))
    residual = jnp.where(finite, _largest_residual(guide), jnp.inf)
    return GuideCheck(log_weight, residual, num_observed.astype(jnp.int32))


def _largest_residual(guide: Guidance) -> Float[Array, ""]:
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


def linearised(problem: RecordProblem, model: Diffusion) -> Linearised:
    """Return the best path found, and the guide along it. The points have no derivatives, and the
    guide none by the model.

    The starts from particles are a program of their own, which is compiled where it is called for.
    """
    if not is_outermost():
        return _in_program(problem, model)
    found = _from_filter(problem, model)
    if found.check.is_near or _is_linear(problem, model):
        return found
    for number in range(_MOST_PARTICLE_STARTS):
        new = _from_particles(problem, model, jnp.int32(number))
        found = new if new.check.rank > found.check.rank else found
        if found.check.is_near:
            break
    return found


def _in_program(own: RecordProblem, own_model: Diffusion) -> Linearised:
    """Return the same within a compiled program."""
    problem, model = without_derivatives((own, own_model))
    found = _from_filter(problem, model)
    if not _is_linear(problem, model):
        found = _best_of_loop(problem, model, found)
    own = without_captured_derivatives(own)  # as if it were in the model's parameters
    guide = _guide_of((own, found.guide), model=model, points=found.points)
    return found._replace(guide=guide)


def _is_linear(problem: RecordProblem, model: Diffusion) -> bool:
    """Whether the guide is the same along any path."""
    dynamics = model.forward_at(problem.like)(problem.record.times[0])
    cover = calls_for_cover(problem.initial, model, problem.like)
    return is_linear(dynamics, problem.like) and not cover


def _best_of_loop(problem: RecordProblem, model: Diffusion, found: Linearised) -> Linearised:
    """Search from paths of particles until one is near what is seen, in a compiled loop."""

    def search(state: tuple[Int[Array, ""], Linearised]) -> tuple[Int[Array, ""], Linearised]:
        number, found = state
        new = _from_particles(problem, model, number)
        better = new.check.rank > found.check.rank
        return number + 1, jax.tree.map(lambda a, b: jnp.where(better, a, b), new, found)

    goes_on = lambda state: ~state[1].check.is_near & (state[0] < _MOST_PARTICLE_STARTS)
    return lax.while_loop(goes_on, search, (jnp.int32(0), found))[1]


class _Start(NamedTuple):
    """Points along which the process is first linearised, and where paths without noise begin where
    the law of X(t_0) is not normal."""

    points: Float[Array, "points d"]
    begin: Float[Array, " d"]


@compiled_sooner  # a program of its own, which all who read the record share
def _from_filter(problem: RecordProblem, model: Diffusion) -> Linearised:
    """Search from the path of the extended Kalman filter."""
    return _search(problem, model, _filter_start(problem, model))


@compiled_sooner
def _from_particles(problem: RecordProblem, model: Diffusion, number: Int[Array, ""]) -> Linearised:
    """Search from the path of a particle."""
    return _search(problem, model, _particle_start(problem, model, number))


def _filter_start(problem: RecordProblem, model: Diffusion) -> _Start:
    """Return the path of the extended Kalman filter, from a likely point where ν is not normal."""
    initial, scalars = initial_law(problem.initial, model, problem.like), problem.scalars(model)
    begin = likeliest(problem.initial, model, initial, split_first(scalars)[0])
    points = extended_kalman_path(
        problem.density,
        model.forward_at(problem.like),
        initial._replace(mean=begin),
        problem.record.steps(),
        scalars,
        model.state_space(),
    )
    return _Start(points, begin)


def _particle_start(problem: RecordProblem, model: Diffusion, number: Int[Array, ""]) -> _Start:
    """Return a likely path near that of a particle which stays near what is seen."""
    key = jax.random.fold_in(key_for("tracking", jax.random.key(0)), number)
    points = likely_path(problem, model, tracking_path(key, problem, model))
    return _Start(points, points[0])


class _Search(NamedTuple):
    """Of Gauss and Newton's iteration: the points of the next turn; the best so far, the check of
    it, and its path without noise; the length of the step to it, and whether it is
    over."""

    turn: Int[Array, ""]
    points: Float[Array, "points d"]
    best: tuple[Float[Array, "points d"], Guidance]
    check: GuideCheck
    path: Float[Array, "points d"]
    length: Float[Array, ""]
    over: Bool[Array, ""]


def _search(problem: RecordProblem, model: Diffusion, start: _Start) -> Linearised:
    """Search from these points: linearise along the path that is guided without noise, and repeat.

    What counts is the weight of the path without noise: where it is large, weights fall off as
    noise leads away from it, and where it is small paths that weigh more are missed. So a turn
    counts that raises it, and steps are shortened until one does: excitable and chaotic systems
    throw Gauss and Newton's iteration off for good, and between two wells its fixed point, the
    likeliest path, guides worse than the filter's means."""
    (points, begin), inside = start, model.state_space()

    @jax.jit  # for its shapes and in the loop traced once
    def at(points):
        guide = guided(problem, model, points)
        path, log_weight = _path_without_noise(problem, model, guide, begin)
        path = jnp.where(jnp.all(jnp.isfinite(path)), path, points)
        return (points, guide), _check_of(guide, log_weight), path

    def turn(search: _Search) -> _Search:
        new = at(search.points)
        gain = jnp.where(search.turn == 0, jnp.inf, new[1].rank - search.check.rank)
        better = (gain > _NO_GAIN) | (search.check.rank == -jnp.inf)
        old = search.best, search.check, search.path
        best, check, path = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
        settled = jnp.abs(gain) < _NO_GAIN
        length = jnp.where(better, jnp.minimum(2 * search.length, 1), search.length / 2)
        points = best[0] + length * (path - best[0])
        points = jnp.where(length == 1, path, points)
        if inside is not None:
            points = jax.vmap(functools.partial(stay_inside, inside))(best[0], points)
        over = settled | (length < _SHORTEST)
        return _Search(search.turn + 1, points, best, check, path, length, over)

    shapes = jax.eval_shape(at, points)[:2]
    best, check = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    one = jnp.ones((), points.dtype)
    init = _Search(jnp.int32(0), points, best, check, points, one, jnp.zeros((), bool))
    goes_on = lambda search: ~search.over & (search.turn < _MOST_TURNS)
    made = lax.while_loop(goes_on, turn, init)
    return Linearised(*made.best, made.check)


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
