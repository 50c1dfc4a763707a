"""Markov chains of paths given a whole record.

Paths move in blocks (`path_blocks`), or states move together with the bridges between them
(`states`).
"""

import dataclasses
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..coupling import step_law_of
from ..engine.averages import PathFunction, as_path_function
from ..engine.checks import Numbers, check_count, check_key
from ..engine.compiled import compiled_sooner
from ..engine.diagnostics import effective_size_of_chains, r_hat_of_chains, vary
from ..engine.entry import public_entry
from ..engine.progress import metered_scan
from ..engine.verdict import AbstractResult, Fault, Verdict, throw_where_untrustworthy
from ..models.diffusion import Diffusion
from ..models.jumps import JumpsLike
from ..models.sigma import columns_of
from ..proposals import AbstractProposal, ProposalLike, as_proposal
from ..schemes import (
    AbstractStepDensity,
    StepError,
    dominates,
    log_halving_of_paths,
    root_mean_square_in_sds,
    share_of_grid,
    share_of_order,
    step_faults,
    unknown_where,
)
from .guide_search import GuideCheck, Linearised, linearised
from .guided_record import (
    Guidance,
    change_by_coarse_steps,
    knots_and_log_weight,
    noise_and_log_weight,
    pair_noise,
    path_and_log_weights,
    path_of_knots,
)
from .initial import Initial
from .observations import AbstractObservation
from .path_blocks import Paths, blocks_of_both_cuts, has_length, has_segments, sweep, tuned
from .problem import RecordProblem
from .several import as_record_problems
from .states import Draws, check_states, sample_states
from .step_regime import steps_are_too_long

# Chains disagree if R̂ exceeds this bound.
_MOST_R_HAT = 1.1
# If the variance of D of a segment exceeds this bound, the second-order expansion is unreliable.
_MOST_VARIANCE = 1.0
# With fewer paths than this share that have a coarse path, there is no estimate of step errors.
_LEAST_COARSE = 0.5
# A quantity counts as constant if its relative changes along a path are at most this large.
_CONSTANT = 1e-3

_STUCK = (
    "A block or a state of the path never moved. Use more `num_draws` or more steps. Without a "
    "`proposal`, also try a shorter `block_length`; if several ways are possible between "
    "observations, pass a `proposal`. With a `proposal`, use more `num_proposals`."
)
_CUT_OFF = (
    "Some weights of the `proposal` were truncated at its bound on the work. Increase the bound, "
    "or use another proposal."
)
# Longest stay of a point that is no fault: as a share of the draws, and, for few draws, in draws.
_LONGEST_STAY, _FEWEST_STAYS = 0.05, 50
_STAYED = (
    "A part of the path stayed the same in more than 5 % of the draws of a chain, because few "
    "paths have large weights. The mean and its error may miss such paths. Use more `num_draws`, "
    "more steps, or a shorter `block_length`."
)
_APART = "Chains disagree (R̂ above 1.1 at some points). Use more `num_draws` and `num_warmup`."


class Smoothed(AbstractResult):
    """Draws of the path given all observations, from `smooth`.

    - `times`: times of the points, shape (K,). It is a NumPy array of double precision if the
        precision of paths cannot resolve the times.
    - `accepted`: acceptance rate of each block in both partitions into blocks, shape (2, B).
        Entries of blocks beyond the end of a record have no meaning. With a `proposal` it is the
        rate of each state, shape (ends,), and 0 for a first state that is a known point.
    - `stuck`: whether a block, or with a `proposal` a state or a bridge, never moved, shape
        (chains,). If so in any chain, `standard_error` is infinite, because the draws do not show
        their error.
    - `num_truncated`: number of weights of a `proposal` that were truncated at a bound on the work.
        If there are any, draws are not exact.
    - `guide`: diagnostics of the guide. A poor guide is a fault only if chains mix poorly, too.
    """

    times: Float[Array | np.ndarray, " K"]
    _paths: Float[Array, "chains n points d"]  # of several records as long as the longest
    accepted: Float[Array, "..."]
    stuck: Bool[Array, " chains"]
    num_truncated: Int[Array, ""]
    _problem: RecordProblem
    _knots: Float[Array, "chains n knots d"] | None = None
    guide: GuideCheck | None = None

    @property
    def paths(self) -> Float[Array, "chains n K d"]:
        """Return the draws, shape (chains, n, K, d)."""
        return self._paths[..., : self.times.shape[-1], :]

    def mean(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the mean of `fn(path)` over all draws.

        `fn` is a function of one path of shape (K, d), by default the path itself.
        """
        return jax.tree.map(lambda leaf: jnp.mean(leaf, axis=(0, 1)), self._values(fn))

    def standard_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the Monte Carlo error of `mean(fn)`, entry by entry."""

        def error(leaf):
            of_leaf = jnp.std(leaf, axis=(0, 1)) / jnp.sqrt(effective_size_of_chains(leaf))
            return jnp.where(jnp.any(self.stuck), jnp.inf, of_leaf)

        return jax.tree.map(error, self._values(fn))

    def step_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Estimate the discretisation bias of `mean(fn)` to leading order, entry by entry.

        If all steps are normal, each path is e^D times as likely with half as many steps
        (`schemes.halving`). If steps are quadratic in the noise, half as many steps with the same
        noise give another path, with e^D times the weight. With a `proposal` the estimate is for
        the least accurate of `density` and the steps of the bridges. It is zero if steps are
        exact, and NaN in these cases:

        - one step per interval, unless it is quadratic in the noise and therefore split;
        - Euler steps of a σ with fewer columns than rows;
        - steps so long that the variance of D exceeds 1 in some interval (for quadratic steps: on
            average), or that more than half of the coarse paths are lost;
        - steps longer than the relaxation time of the drift, or than a cycle of time-dependent
            coefficients, on over 2 % of the intervals. In this case `step_uncertainty` is
            infinite.
        """
        return self._step_errors(fn)[0]

    def step_uncertainty(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Estimate the standard error of `step_error(fn)`, entry by entry.

        It is at least |`step_error(fn)`| if the noise of a step depends on the state: through σ,
        or, if σ has fewer columns than rows, through ∇α σ with the drift α. In this case only the
        order of magnitude of the error is known.
        """
        return self._step_errors(fn)[1]

    def step_error_dominates(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return whether the discretisation error exceeds the Monte Carlo error, or may do so.

        The result is for `mean(fn)`, entry by entry. If true, use more steps; if only the estimate
        of the error is uncertain, more draws help, too (`why()`). If the error is unknown (see
        `step_error`), the value is true, too: for Euler steps of a σ with fewer columns than rows,
        pass another `density`.
        """
        step_errors = map(StepError, *map(jax.tree.leaves, self._step_errors(fn)))
        errors, treedef = jax.tree.flatten(self.standard_error(fn))
        return jax.tree.unflatten(treedef, list(map(dominates, step_errors, errors)))

    def effective_sample_size(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the effective sample size of `fn(path)`, entry by entry.

        It is small if chains disagree, for instance in different wells.
        """
        return jax.tree.map(effective_size_of_chains, self._values(fn))

    def r_hat(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return R̂ of `fn(path)`, from the halves of all chains: near 1 if they agree.

        It is NaN for values that do not vary, such as coordinates that are observed exactly, and
        for fewer than four draws of each chain.
        """
        return jax.tree.map(r_hat_of_chains, self._values(fn))

    @property
    def verdict(self) -> Verdict:
        """Return the faults of the draws, each with a remedy.

        - a block that never moved, or a part of the path that stayed the same for long;
        - truncated weights;
        - chains that disagree at some points;
        - a poor guide, together with the first or the third of these;
        - a discretisation error of the mean path that is unknown or too uncertain, or that
            dominates and exceeds 0.05 standard deviations (root mean square);
        - a mean or standard error that is not finite.
        """
        error, standard_error = self._errors_in_sds
        stuck, apart = jnp.any(self.stuck), ~self._chains_agree
        guide = () if self.guide is None else (self.guide.fault(stuck | apart),)
        return Verdict(
            (
                Fault(stuck, _STUCK),
                Fault(~stuck & self._stayed, _STAYED),
                Fault(self.num_truncated > 0, _CUT_OFF),
                Fault(apart, _APART),
                *guide,
                *step_faults(error, standard_error),
            )
        ).with_finite(self.mean(), standard_error)

    @property
    def _chains_agree(self) -> Bool[Array, ""]:
        """Return whether R̂ is small at all points that are not constant."""
        return jnp.all((self.r_hat() < _MOST_R_HAT) | ~self._varies)

    @property
    def _stayed(self) -> Bool[Array, ""]:
        """Return whether a point stayed the same for more than 5 % of the draws of a chain."""
        n = self.paths.shape[1]
        moved = jnp.any(self.paths[:, 1:] != self.paths[:, :-1], axis=-1)
        draw = jnp.arange(1, n, dtype=jnp.int32)[:, None]
        since_move = draw - lax.cummax(jnp.where(moved, draw, 0), axis=1)
        longest = jnp.max(since_move, axis=(0, 1), initial=0)
        varies = jnp.any(self._varies, axis=-1)
        return jnp.any(varies & (longest > max(int(_LONGEST_STAY * n), _FEWEST_STAYS)))

    @property
    def _varies(self) -> Bool[Array, "K d"]:
        """Return the mask of the entries of the path that vary by more than rounding errors.

        Entries with exact observations do not vary.
        """
        return vary(self.paths, (0, 1))

    @property
    def _errors_in_sds(self) -> tuple[StepError, Float[Array, ""]]:
        """Return the discretisation error of the mean path, and its standard error.

        Both are in standard deviations of the points, as root mean squares.
        """
        variance = jnp.where(self._varies, jnp.var(self.paths, axis=(0, 1)), 0)
        in_sds = lambda value: root_mean_square_in_sds(value, variance)
        error = StepError(*map(in_sds, self._step_errors(lambda path: path)))
        return error, in_sds(self.standard_error())

    def _step_errors(self, fn: PathFunction) -> tuple[PyTree, PyTree]:
        """Estimate the discretisation bias of `mean(fn)` and its uncertainty."""
        values, problem = self._values(fn), self._problem
        if problem.density.is_exact:
            zeros = jax.tree.map(lambda leaf: jnp.zeros_like(leaf[0, 0]), values)
            return zeros, zeros
        leaves, treedef = jax.tree.flatten(values)
        if self._knots is None:
            D, coarse_leaves = _log_halving(problem, self._paths), leaves
            is_reliable = jnp.max(jnp.var(D, axis=(0, 1))) <= _MOST_VARIANCE
            D -= jnp.mean(D, axis=(0, 1))
            # e^D - 1 to second order, without products of different segments: these have a small
            # mean and a large variance.
            change = jnp.sum(D + D**2 / 2, axis=-1)
            share = share_of_order(problem.density.order)
        else:
            coarse = _coarse_paths(_on_both_grids(problem), self._knots)
            change, has_coarse, coarse_paths = coarse
            coarse_leaves = jax.tree.leaves(self._values(fn, coarse_paths))
            # The change is a sum, so this is the mean variance of its terms.
            num_segments = jnp.sum(has_length(problem)).astype(change.dtype)
            is_reliable = jnp.var(change) <= _MOST_VARIANCE * num_segments
            is_reliable &= jnp.mean(has_coarse) >= _LEAST_COARSE
            share = share_of_grid(problem.density.order, problem.record.lengths)
        change = jnp.where(is_reliable, change, jnp.nan)
        varies = _noise_varies(problem, self._paths[0, 0])
        step_errors = [
            _step_error_of_mean(*both, change, share, varies)
            for both in zip(leaves, coarse_leaves, strict=True)
        ]
        mean = jnp.mean(self._paths if self._knots is None else self._knots, axis=(0, 1))
        too_long = steps_are_too_long(problem, problem.model, mean)
        step_errors = [unknown_where(too_long, error) for error in step_errors]
        values, doubts = zip(*step_errors, strict=True)
        return jax.tree.unflatten(treedef, values), jax.tree.unflatten(treedef, doubts)

    def _values(self, fn: PathFunction, paths: Float[Array, "..."] | None = None) -> PyTree:
        """Evaluate `fn` on all draws, or on these paths, in the precision of the paths."""
        paths = self._paths if paths is None else paths
        paths = paths[..., : self.times.shape[-1], :]
        like = jax.ShapeDtypeStruct(paths.shape[-2:], paths.dtype)
        values = jax.vmap(jax.vmap(as_path_function("fn", fn, like)))(paths)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, paths.dtype), values)


@public_entry
def smooth(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    observation: AbstractObservation,
    initial: Initial = None,
    num_draws: int = 1000,
    num_warmup: int = 200,
    num_chains: int = 4,
    block_length: int | None = None,
    proposal: ProposalLike = None,
    num_proposals: int | None = None,
    num_steps: int | None = None,
    step_size: float | None = None,
    initial_time: Numbers | None = None,
    jumps: JumpsLike = None,
    density: AbstractStepDensity | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = False,
) -> Any:  # the return type depends on the shape of `times`
    """Sample paths given a whole record, by Markov chains.

    The law of the draws converges to the law of the path given all observations, up to the
    discretisation error.

    **Arguments:**

    - `key`: typed key.
    - `model`, `times`, `observations`, `observation`, `initial`, `num_steps`, `step_size`,
        `initial_time`, `jumps`, `density`: as in `innovations`. Several records run one after the
        other, by one compiled program unless there is a `proposal`.
    - `num_draws`: number of draws per chain.
    - `num_warmup`: number of iterations before the draws, which adapt the size of moves.
    - `num_chains`: number of chains, which start from independent guided paths.
    - `block_length`: number of intervals between observations that move at once, at least 2, by
        default 10. With `step_size` a long interval counts as several. Use more if observations
        are so close that neighbouring states are strongly correlated, and fewer if blocks are
        rarely accepted. Not with a `proposal`.
    - `proposal`: by default paths are guided by all observations through a linear process. Pass a
        proposal of bridges, as for `sample_exact_bridges`, if several ways are possible across a
        gap (wells, many relaxation times). "auto" tries several proposals on each gap. Then the
        states at observation times move, with new bridges on both sides. This needs:
        - coefficients that do not depend on time, an invertible σ and a stationary law;
        - noise in all observed components;
        - an `initial` that is a point or has a density.

        The default `density` then has normal steps: `EulerDensity()` for a state-dependent σ.
    - `num_proposals`: number of bridges of the `proposal` for each move of each gap, by default 10.
    - `progress_meter`: a progress meter of diffrax, for instance `diffrax.TextProgressMeter()`.
    - `throw`: raise an error at run time if the result is not `trustworthy`.

    **Returns:** `Smoothed`; for a list of records a list of them. Not differentiable; use
    `innovations` for derivatives.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    gaussian = jb.LinearGaussian(covariance=0.01)
    smoothed = jb.smooth(key, model, times, observations, observation=gaussian, num_draws=500)
    smoothed.mean(), smoothed.standard_error()
    ```
    """
    check_key(key)
    counts = (check_count("num_draws", num_draws), check_count("num_warmup", num_warmup, 0))
    num_chains = check_count("num_chains", num_chains)
    if proposal is None and num_proposals is not None:
        raise ValueError("`num_proposals` is for a `proposal`: pass one, or omit `num_proposals`.")
    if proposal is not None and jumps is not None:
        raise ValueError(
            "bridges of a `proposal` have no jumps: leave out `proposal`, so that paths are guided "
            "by the whole record, or leave out `jumps`."
        )
    if proposal is not None and block_length is not None:
        raise ValueError("`block_length` is for paths without a `proposal`: omit one of the two.")
    block_length = check_count("block_length", 10 if block_length is None else block_length, 2)
    arguments = (model, times, observations, observation, initial)
    options = {
        "step_size": step_size,
        "initial_time": initial_time,
        "density": density,
        "jumps": jumps,
    }
    records = as_record_problems(
        *arguments,
        num_steps=num_steps,
        any_constant=True,
        normal_steps=proposal is not None,  # step errors of bridges need densities of the steps
        **options,
    )
    num_proposals = check_count("num_proposals", 10 if num_proposals is None else num_proposals)

    def of_record(key: Key[Array, ""], number: int) -> Smoothed:
        # Paths of one shape need one program. The pilots of a `proposal` need real gaps.
        problem, bridges = records.problem(number, padded=proposal is None), None
        if proposal is not None:  # checked before the search for a guide, which takes time
            bridges = as_proposal(proposal, model, problem.like)
            check_states(bridges, problem)
        linearisation, density = linearised(problem, model), problem.density
        if bridges is None:
            sizes = counts, num_chains, block_length
            draws = _run_block_chains(key, problem, linearisation, *sizes, progress_meter)
            num_points = records.num_points(number)
        else:
            start_key, key = jax.random.split(key)
            firsts = guided_paths(start_key, problem, linearisation, num_chains)
            sizes = (*counts, num_proposals)
            draws = sample_states(key, problem, bridges, firsts, sizes, progress_meter)
            density = _least_accurate(problem, bridges)
            num_points = len(draws.since)
        by_chain = lambda draws: jnp.moveaxis(draws, 1, 0)
        paths, knots = by_chain(draws.paths), None if draws.knots is None else by_chain(draws.knots)
        diagnostics = (draws.accepted, draws.stuck, draws.num_truncated)
        times = problem.record.clock.exactly(draws.since[:num_points])
        # Discretisation errors need the grid of the paths, which a `proposal` may choose.
        problem = dataclasses.replace(problem, record=draws.record, density=density)
        smoothed = Smoothed(times, paths, *diagnostics, problem, knots, linearisation.check)
        return throw_where_untrustworthy(smoothed, "_paths", model) if throw else smoothed

    if not records.are_listed:
        return of_record(key, 0)
    return list(map(of_record, jax.random.split(key, records.number), range(records.number)))


def _least_accurate(problem: RecordProblem, proposal: AbstractProposal) -> AbstractStepDensity:
    """Return the step density of the lowest order, which step errors of these paths need.

    The candidates are that of the problem and those of all bridges that may be used.
    """

    def of_single(single):
        coupling = single.by_coupling
        if coupling is None:
            return single.target
        return step_law_of(coupling, problem.model, problem.like)[0]

    densities = (*map(of_single, proposal.singles), problem.density)
    return min(filter(None, densities), key=lambda density: density.order)


@compiled_sooner
def guided_paths(
    key: Key[Array, ""], problem: RecordProblem, linearisation: Linearised, num_chains: int
) -> Float[Array, "chains points d"]:
    """Sample the knots of independent guided paths.

    The path of the linearisation replaces a path without a finite log weight.
    """
    points, guide, _ = linearisation

    def first(key):
        noise = jax.random.normal(key, points.shape, points.dtype)
        knots, log_weight = knots_and_log_weight(problem, problem.model, guide, noise)
        return jnp.where(jnp.isfinite(log_weight), knots, points)

    return jax.vmap(first)(jax.random.split(key, num_chains))


@compiled_sooner
def _run_block_chains(
    key: Key[Array, ""],
    problem: RecordProblem,
    linearisation: Linearised,
    counts: tuple[int, int],
    num_chains: int,
    block_length: int,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> Draws:
    """Run the chains that move blocks of paths."""
    model, (num_draws, num_warmup) = problem.model, counts
    points, guide, _ = linearisation
    start_key, key = jax.random.split(key)

    firsts = jnp.moveaxis(guided_paths(start_key, problem, linearisation, num_chains), 0, -1)
    (K, N), d = problem.record.dt.shape, problem.dim
    paths = Paths(firsts[0], firsts[1:].reshape(K, N, d, num_chains))
    both = blocks_of_both_cuts(problem, points, guide, block_length)

    def step(state, i):
        paths, log_scales = state
        sweep_key = jax.random.fold_in(key, i)
        paths, accepted = sweep(sweep_key, problem, model, both, log_scales, paths)
        new_scales = tuned(log_scales, accepted, (i + 1).astype(points.dtype))
        knots = jnp.concatenate([paths.start[None], paths.points.reshape(K * N, d, num_chains)])
        # β is constant after the warm-up, so that the chain is homogeneous.
        log_scales = jnp.where(i < num_warmup, new_scales, log_scales)
        return (paths, log_scales), (jnp.moveaxis(knots, -1, 0), accepted)

    init = paths, jnp.zeros((2, both.segment.shape[-1]), points.dtype)
    _, draws = metered_scan(step, init, jnp.arange(num_warmup + num_draws), progress_meter)
    knots, accepted = jax.tree.map(lambda leaf: leaf[num_warmup:], draws)
    # Blocks beyond the record do not count as stuck.
    real = has_segments(problem, block_length)[..., None]
    stuck = jnp.any(real & ~jnp.any(accepted, axis=0), axis=(0, 1))
    share = jnp.mean(accepted.astype(points.dtype), axis=(0, -1))
    record = problem.record
    if problem.density.is_normal:
        return Draws(record.grid(), knots, share, stuck, jnp.int32(0), record)
    of_chains = jax.vmap(lambda knots: path_of_knots(problem, model, knots)[record.stored])
    draws = lax.map(of_chains, knots)
    return Draws(record.grid()[record.stored], draws, share, stuck, jnp.int32(0), record, knots)


class _OnGrid(NamedTuple):
    """Problem of a record on one grid, and the guide of its paths."""

    problem: RecordProblem
    guide: Guidance


def _on_both_grids(problem: RecordProblem) -> tuple[_OnGrid, _OnGrid]:
    """Return the problem on its grid and on the grid of half as many steps, with their guides."""
    coarse = dataclasses.replace(problem, record=problem.record.coarsened())
    fine, coarse = (_OnGrid(one, linearised(one, one.model).guide) for one in (problem, coarse))
    return fine, coarse


@compiled_sooner
def _coarse_paths(
    grids: tuple[_OnGrid, _OnGrid], knots: Float[Array, "chains n points d"]
) -> tuple[Float[Array, "chains n"], Bool[Array, "chains n"], Float[Array, "chains n points d"]]:
    """Return paths of half as many steps, from the noise of the paths with these knots.

    Between two points of the coarse grid, the difference between coarse and fine path is constant.
    It is zero where the coarse path would leave the state space.

    **Returns:** the relative change of the likelihood (`change_by_coarse_steps`), whether the
    coarse path has a weight, and the coarse path, or the path itself if it has none.
    """
    fine, coarse = grids
    problem, record = fine.problem, fine.problem.record
    model, inside = problem.model, problem.model.state_space()
    ends = jnp.append(True, coarse.problem.record.dt.ravel() > 0)
    last_end = lax.cummax(jnp.where(ends, jnp.arange(len(ends)), 0))
    # Components of noise that do not move the path are independent of it, so any key will do.
    key = jax.random.key(0)

    def of_draw(knots):
        noise, _ = noise_and_log_weight(key, problem, model, fine.guide, knots)
        path, log_weights = path_and_log_weights(problem, model, fine.guide, noise)
        coarse_noise = pair_noise(noise, record.lengths)
        coarse_path, log_coarse = path_and_log_weights(
            coarse.problem, model, coarse.guide, coarse_noise
        )
        has_weight = jnp.all(jnp.isfinite(log_coarse))
        is_possible = has_weight
        distance = (coarse_path - path)[last_end]
        if inside is not None:
            is_possible &= jax.vmap(inside)(path + distance)
        shifted = path + jnp.where(is_possible[..., None], distance, 0)
        change = change_by_coarse_steps(log_weights, log_coarse)
        return change, has_weight, shifted[record.stored]

    # One draw of all chains at a time, to save memory.
    results = lax.map(jax.vmap(of_draw), jnp.moveaxis(knots, 1, 0))
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), results)


@compiled_sooner
def _noise_varies(problem: RecordProblem, path: Float[Array, "K d"]) -> Bool[Array, ""]:
    """Return whether the noise of a step depends on the state to leading order, along this path.

    It does if σ does. In a hypoelliptic model it also does if ∇α σ does, the term by which the
    drift spreads the noise.
    """
    model, like = problem.model, problem.like
    if model.sigma_varies(like) or model.sigma_is_invertible(like):
        return jnp.asarray(model.sigma_varies(like))
    dynamics = model.forward_at(like)(problem.record.first_time)

    def spread_by_drift(x):
        columns = columns_of(dynamics.sigma(x), x)
        return jnp.stack([jax.jvp(dynamics.drift, (x,), (column,))[1] for column in columns])

    derivatives = jax.vmap(spread_by_drift)(path)
    return jnp.max(jnp.ptp(derivatives, axis=0)) > _CONSTANT * jnp.max(jnp.abs(derivatives))


@compiled_sooner
def _log_halving(
    problem: RecordProblem, paths: Float[Array, "chains n points d"]
) -> Float[Array, "chains n K"]:
    """Return D of each segment of each path; NaN for a single step.

    Pairs of steps lie within one segment.
    """
    (K, N), d, chains = problem.record.dt.shape, problem.dim, paths.shape[0]
    dynamics = problem.model.forward_at(problem.like)
    grids = problem.record.dt, problem.record.middles()
    dt, time = (jnp.tile(leaf, (chains, 1)).T for leaf in grids)
    if not problem.model.depends_on_time:
        dynamics, time = dynamics(None), None
    place = jnp.arange(K)[:, None] * N + jnp.arange(N + 1)

    def of_draw(path):
        segments = path[:, place]
        if problem.jump_map is not None:  # the diffusion begins after the jump
            begins = jax.vmap(lambda begins: problem.after_jumps(problem.model, begins))
            segments = segments.at[:, :, 0].set(begins(segments[:, :, 0]))
        segments = segments.reshape(chains * K, N + 1, d)
        of_segments = log_halving_of_paths(problem.density, dynamics, dt, segments, time)
        return of_segments.reshape(chains, K)

    # One draw of all chains at a time, to save memory.
    D = jnp.moveaxis(lax.map(of_draw, jnp.moveaxis(paths, 1, 0)), 0, 1)
    return jnp.where(has_length(problem), D, 0)


@compiled_sooner
def _step_error_of_mean(
    values: Float[Array, "chains n ..."],
    coarse_values: Float[Array, "chains n ..."],
    change: Float[Array, "chains n"],
    share: float,
    varies: Bool[Array, ""],
) -> StepError:
    """Estimate the discretisation error of the mean of f, as a share of E[e^D f̃] / E[e^D] - E[f].

    f̃ are the values of the coarse paths, and `change` is e^D - 1 up to a constant. This difference
    is the mean of f̃ - f plus the covariance of f̃ with e^D, to second order in D.
    """
    change = (change - jnp.mean(change)).reshape(*change.shape, *[1] * (values.ndim - 2))
    products = (coarse_values - jnp.mean(coarse_values, axis=(0, 1))) * change
    products += coarse_values - values
    error = jnp.std(products, axis=(0, 1)) / jnp.sqrt(effective_size_of_chains(products))
    estimate = share * jnp.mean(products, axis=(0, 1))
    return StepError(estimate, jnp.hypot(share * error, jnp.where(varies, estimate, 0)))
