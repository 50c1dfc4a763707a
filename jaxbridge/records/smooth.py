"""Paths given a whole record: a Markov chain of paths, which move in blocks (`path_blocks`), or of
states and the bridges between them (`states`)."""

import dataclasses
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.averages import PathFunction, path_function
from ..engine.checks import Numbers, check_count, check_key
from ..engine.compiled import compiled_sooner
from ..engine.diagnostics import effective_size_of_chains, potential_scale_reduction
from ..engine.doors import door
from ..engine.progress import metered_scan
from ..engine.verdict import AbstractResult, Fault, Verdict, throw_where_untrustworthy
from ..models.diffusion import Diffusion
from ..models.sigma import columns_of
from ..schemes import (
    AbstractStepDensity,
    StepError,
    dominates,
    log_halving_of_paths,
    root_mean_square_in_sds,
    share_of_order,
    step_fault,
    unknown_where,
)
from .guide_search import GuideCheck, Linearised, linearised
from .guided_record import path_and_log_weight
from .initial import Initial
from .observation import Observation
from .path_blocks import Paths, blocks_of_both_cuts, has_segments, sweep, tuned
from .problem import RecordProblem, as_record_problem
from .states import Draws, sample_states
from .step_regime import steps_are_too_long

# R̂ beyond which chains disagree.
_MOST_R_HAT = 1.1
# A spread of so many units in the last place is rounding.
_ROUNDING = 64.0
# The variance of D of one segment beyond which its second order says nothing of the step error.
_MOST_VARIANCE = 1.0
# What changes by no more along a path, relative to its size, is constant.
_CONSTANT = 1e-3

_STUCK = (
    "A block of the path never moved. Take more `num_draws`, a shorter `block_length` or more "
    "steps; where the diffusion could have gone several ways, a `proposal`."
)
_CUT_OFF = (
    "Some weights of the `proposal` were cut off at its bound on the work. Allow more trials, or "
    "choose another."
)
_APART = "Chains disagree (R̂ above 1.1 at some points). Take more `num_draws` and `num_warmup`."


class Smoothed(AbstractResult):
    """What `smooth` returns: draws of the path given all that was seen.

    - `times`: of the points, shape (K,); a NumPy array of double precision where they are too far
        from zero for the precision of paths.
    - `paths`: shape (chains, n, K, d).
    - `accepted`: the share of moves that were accepted, of each block in both ways to cut the
        record into blocks, shape (2, B); or of each state, shape (ends,), with a `proposal`.
    - `stuck`: the chains in which a block never moved, shape (chains,): `standard_error` is
        infinite if there is one, for draws of a path that stays tell nothing of their error.
    - `num_truncated`: how many weights of a `proposal` were cut off at a bound on the work, by
        which draws are not exact.
    - `guide`: diagnostics of the guide of the paths. A poor one is a fault where chains suffer.
    """

    times: Float[Array | np.ndarray, " K"]
    paths: Float[Array, "chains n K d"]
    accepted: Float[Array, "..."]
    stuck: Bool[Array, " chains"]
    num_truncated: Int[Array, ""]
    _problem: RecordProblem
    guide: GuideCheck | None = None

    def mean(self, fn: PathFunction = lambda path: path) -> PyTree:
        """The mean of `fn(path)`, a function of one path of shape (K, d), by default itself."""
        return jax.tree.map(lambda leaf: jnp.mean(leaf, axis=(0, 1)), self._values(fn))

    def standard_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """The Monte Carlo error of `mean(fn)`, entry by entry."""

        def error(leaf):
            made = jnp.std(leaf, axis=(0, 1)) / jnp.sqrt(effective_size_of_chains(leaf))
            return jnp.where(jnp.any(self.stuck), jnp.inf, made)

        return jax.tree.map(error, self._values(fn))

    def step_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Estimate the discretisation bias of `mean(fn)`, entry by entry, to its leading term.

        With half as many steps each path is e^D times as likely (`halving` in `schemes`). NaN where
        nothing is known: one step, Euler's steps where σ has fewer columns than rows, and steps so
        long that in some interval the variance of D is above 1, or that two of them are longer than
        the relaxation time of the drift, where the uncertainty is infinite. With a `proposal` of a
        scheme that is more accurate than `density` the estimate is too large.
        """
        return self._step_errors(fn)[0]

    def step_uncertainty(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Estimate the standard error of `step_error(fn)`, entry by entry. Where σ varies, or the
        noise ∇α σ that the drift leads on, it is at least `step_error` itself, which is known
        there up to a factor only."""
        return self._step_errors(fn)[1]

    def step_error_dominates(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Whether the step error of `mean(fn)` is beyond its standard error, or not known well
        enough to say, entry by entry: then more steps help, and more draws do not."""
        told = map(StepError, *map(jax.tree.leaves, self._step_errors(fn)))
        errors, treedef = jax.tree.flatten(self.standard_error(fn))
        return jax.tree.unflatten(treedef, list(map(dominates, told, errors)))

    def effective_sample_size(self, fn: PathFunction = lambda path: path) -> PyTree:
        """How many independent draws of `fn(path)` these are worth, entry by entry: few where
        chains disagree, as where each found one of two wells."""
        return jax.tree.map(effective_size_of_chains, self._values(fn))

    def r_hat(self, fn: PathFunction = lambda path: path) -> PyTree:
        """R̂ of `fn(path)`, from the halves of all chains: near one if they agree."""
        return jax.tree.map(potential_scale_reduction, self._values(fn))

    @property
    def verdict(self) -> Verdict:
        """Return the faults: a block that never moved, weights cut off, chains that disagree at
        some points, a poor guide beside one of these, a step error of the mean path that dominates
        and is beyond 0.05 standard deviations (root mean square)."""
        error, standard_error = self._errors_in_sds
        stuck, apart = jnp.any(self.stuck), ~self._chains_agree
        guide = () if self.guide is None else (self.guide.fault(stuck | apart),)
        return Verdict(
            (
                Fault(stuck, _STUCK),
                Fault(self.num_truncated > 0, _CUT_OFF),
                Fault(apart, _APART),
                *guide,
                step_fault(error, standard_error),
            )
        ).with_finite(self.mean(), standard_error)

    @property
    def _chains_agree(self) -> Bool[Array, ""]:
        return jnp.all((self.r_hat() < _MOST_R_HAT) | ~self._varies)

    @property
    def _varies(self) -> Bool[Array, "K d"]:
        """Where the path is not known but for rounding: what was observed exactly is."""
        sd, size = jnp.std(self.paths, axis=(0, 1)), jnp.max(jnp.abs(self.paths), axis=(0, 1))
        return sd > _ROUNDING * float(jnp.finfo(sd.dtype).eps) * size

    @property
    def _errors_in_sds(self) -> tuple[StepError, Float[Array, ""]]:
        """The step error of the mean path, and its standard error, in standard deviations of its
        points, root mean square."""
        variance = jnp.where(self._varies, jnp.var(self.paths, axis=(0, 1)), 0)
        in_sds = lambda value: root_mean_square_in_sds(value, variance)
        error = StepError(*map(in_sds, self._step_errors(lambda path: path)))
        return error, in_sds(self.standard_error())

    def _step_errors(self, fn: PathFunction) -> tuple[PyTree, PyTree]:
        values, problem = self._values(fn), self._problem
        D = _log_halving(problem, self.paths)
        known = jnp.max(jnp.var(D, axis=(0, 1))) <= _MOST_VARIANCE
        D = jnp.where(known, jnp.sum(D, axis=-1), jnp.nan)
        leaves, treedef = jax.tree.flatten(values)
        varies = _noise_varies(problem, self.paths[0, 0])
        share = share_of_order(problem.density.order)
        each = [_change(leaf, D, share, varies) for leaf in leaves]
        mean = jnp.mean(self.paths, axis=(0, 1))
        too_long = steps_are_too_long(problem, problem.model, mean)
        each = [unknown_where(too_long, error) for error in each]
        values, doubts = zip(*each, strict=True)
        return jax.tree.unflatten(treedef, values), jax.tree.unflatten(treedef, doubts)

    def _values(self, fn: PathFunction) -> PyTree:
        like = jax.ShapeDtypeStruct(self.paths.shape[-2:], self.paths.dtype)
        values = jax.vmap(jax.vmap(path_function("fn", fn, like)))(self.paths)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, self.paths.dtype), values)


@door
def smooth(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    observation: Observation,
    initial: Initial = None,
    num_draws: int = 1000,
    num_warmup: int = 200,
    num_chains: int = 4,
    block_length: int | None = None,
    proposal: Any = None,
    num_proposals: int | None = None,
    num_steps: int | None = None,
    step_size: float | None = None,
    initial_time: Numbers | None = None,
    density: AbstractStepDensity | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = False,
) -> Smoothed:
    """Draws of the path given a whole record, exact in the limit of many, up to the step error.

    **Arguments:**

    - `key`: a typed key.
    - `model`, `times`, `observations`, `observation`, `initial`, `num_steps`, `step_size`,
        `initial_time`, `density`: as in `innovations`.
    - `num_draws`: of each chain, after `num_warmup` in which the size of moves is learnt.
    - `num_chains`: chains, which start from guided paths that know nothing of each other.
    - `block_length`: how many intervals between observations move at once, by default 10: more
        where they are so close that neighbours tell much of each other, fewer where blocks are
        seldom accepted. Not with a `proposal`.
    - `proposal`: by default paths are guided by all that was seen, as by a linear process. Across
        gaps in which the diffusion could have gone several ways (wells, many relaxation times)
        give a proposal of bridges, as `sample_exact_bridges` takes them: a `Coupling`, or "auto",
        which tries several on each gap. Then the states at the times of observations move, with
        new bridges on both sides. That asks for a stationary law and for noise in all that is seen.
    - `num_proposals`: how many bridges of a `proposal` are made for each move of each gap, by
        default 10.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.
    - `throw`: raise an error at run time where the result is not `trustworthy`.

    **Returns:** `Smoothed`. Not differentiable: `innovations` is.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    **Example:**

    ```python
    seen = jb.LinearGaussian(covariance=0.01)
    made = jb.smooth(key, model, times, observations, observation=seen, num_draws=500)
    made.mean(), made.standard_error()
    ```
    """
    check_key(key)
    counts = (check_count("num_draws", num_draws), check_count("num_warmup", num_warmup, 0))
    num_chains = check_count("num_chains", num_chains)
    if proposal is None and num_proposals is not None:
        raise ValueError("`num_proposals` is for a `proposal`: give one, or leave this out.")
    if proposal is not None and block_length is not None:
        raise ValueError("`block_length` is for paths without a `proposal`: leave it out.")
    block_length = check_count("block_length", 10 if block_length is None else block_length, 2)
    arguments = (model, times, observations, observation, initial)
    options = {"step_size": step_size, "initial_time": initial_time, "density": density}
    problem = as_record_problem(*arguments, num_steps=num_steps, any_constant=True, **options)
    num_proposals = check_count("num_proposals", 10 if num_proposals is None else num_proposals)
    made = linearised(problem, model)
    if proposal is None:
        sizes = counts, num_chains, block_length
        drawn = _smooth(key, problem, made, *sizes, progress_meter)
    else:
        start_key, key = jax.random.split(key)
        firsts = _guided_paths(start_key, problem, made, num_chains)
        sizes = (*counts, num_proposals)
        drawn = sample_states(key, problem, proposal, firsts, sizes, progress_meter)
    paths = jnp.moveaxis(drawn.paths, 1, 0)
    found = (drawn.accepted, drawn.stuck, drawn.num_truncated)
    times = problem.record.clock.exactly(drawn.since)
    problem = dataclasses.replace(problem, record=drawn.record)
    smoothed = Smoothed(times, paths, *found, problem, made.check)
    return throw_where_untrustworthy(smoothed, "paths", model) if throw else smoothed


@compiled_sooner
def _guided_paths(
    key: Key[Array, ""], problem: RecordProblem, made: Linearised, num_chains: int
) -> Float[Array, "chains points d"]:
    """Guided paths that know nothing of each other, or where they left the finite numbers the one
    along which they are guided."""
    points, guide, _ = made

    def first(key):
        noise = jax.random.normal(key, points.shape, points.dtype)
        path, log_weight = path_and_log_weight(problem, problem.model, guide, noise)
        return jnp.where(jnp.isfinite(log_weight), path, points)

    return jax.vmap(first)(jax.random.split(key, num_chains))


@compiled_sooner
def _smooth(
    key: Key[Array, ""],
    problem: RecordProblem,
    made: Linearised,
    counts: tuple[int, int],
    num_chains: int,
    block_length: int,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> Draws:
    model, (num_draws, num_warmup) = problem.model, counts
    points, guide, _ = made
    start_key, key = jax.random.split(key)

    firsts = jnp.moveaxis(_guided_paths(start_key, problem, made, num_chains), 0, -1)
    (K, N), d = problem.record.dt.shape, problem.dim
    paths = Paths(firsts[0], firsts[1:].reshape(K, N, d, num_chains))
    both = blocks_of_both_cuts(problem, points, guide, block_length)

    def step(state, i):
        paths, log_scales = state
        mine = jax.random.fold_in(key, i)
        paths, taken = sweep(mine, problem, model, both, log_scales, paths)
        learnt = tuned(log_scales, taken, (i + 1).astype(points.dtype))
        path = jnp.concatenate([paths.start[None], paths.points.reshape(K * N, d, num_chains)])
        log_scales = jnp.where(i < num_warmup, learnt, log_scales)
        return (paths, log_scales), (jnp.moveaxis(path, -1, 0), taken)

    init = paths, jnp.zeros((2, both.segment.shape[-1]), points.dtype)
    _, made = metered_scan(step, init, jnp.arange(num_warmup + num_draws), progress_meter)
    drawn, taken = jax.tree.map(lambda leaf: leaf[num_warmup:], made)
    real = has_segments(problem, block_length)[..., None]
    stuck = jnp.any(real & ~jnp.any(taken, axis=0), axis=(0, 1))
    share = jnp.mean(taken.astype(points.dtype), axis=(0, -1))
    record = problem.record
    return Draws(record.grid(), drawn, share, stuck, jnp.int32(0), record)


@compiled_sooner
def _noise_varies(problem: RecordProblem, path: Float[Array, "K d"]) -> Bool[Array, ""]:
    """Whether the noise of a step depends on the state in leading order: σ does, or where it has
    fewer columns than rows ∇α σ, by which the drift leads it on, along this path."""
    model, like = problem.model, problem.like
    if model.sigma_varies(like) or model.sigma_is_invertible(like):
        return jnp.asarray(model.sigma_varies(like))
    dynamics = model.forward_at(like)(problem.record.times[0])

    def led_on(x):
        columns = columns_of(dynamics.sigma(x), x)
        return jnp.stack([jax.jvp(dynamics.drift, (x,), (column,))[1] for column in columns])

    each = jax.vmap(led_on)(path)
    return jnp.max(jnp.ptp(each, axis=0)) > _CONSTANT * jnp.max(jnp.abs(each))


@compiled_sooner
def _log_halving(
    problem: RecordProblem, paths: Float[Array, "chains n points d"]
) -> Float[Array, "chains n K"]:
    """Return D of each segment of each path: pairs of steps do not reach beyond one. NaN of one
    step."""
    (K, N), d, chains = problem.record.dt.shape, problem.dim, paths.shape[0]
    dynamics = problem.model.forward_at(problem.like)
    dt, time = (jnp.tile(leaf, (chains, 1)).T for leaf in problem.record.steps())
    if not problem.model.depends_on_time:
        dynamics, time = dynamics(None), None
    place = jnp.arange(K)[:, None] * N + jnp.arange(N + 1)

    def of_draw(path):
        segments = path[:, place].reshape(chains * K, N + 1, d)
        each = log_halving_of_paths(problem.density, dynamics, dt, segments, time)
        return each.reshape(chains, K)

    return jnp.moveaxis(lax.map(of_draw, jnp.moveaxis(paths, 1, 0)), 0, 1)


def _change(
    values: Float[Array, "chains n ..."],
    D: Float[Array, "chains n"],
    share: float,
    varies: Bool[Array, ""],
) -> StepError:
    """The share of E[e^D f] / E[e^D] - E[f] that is error, to second order in D: the covariance of
    f with D + ½ (D - ED)²."""
    D = D - jnp.mean(D)
    D = (D + D**2 / 2).reshape(*D.shape, *[1] * (values.ndim - 2))
    products = (values - jnp.mean(values, axis=(0, 1))) * (D - jnp.mean(D))
    error = jnp.std(products, axis=(0, 1)) / jnp.sqrt(effective_size_of_chains(products))
    told = share * jnp.mean(products, axis=(0, 1))
    return StepError(told, jnp.hypot(share * error, jnp.where(varies, told, 0)))
