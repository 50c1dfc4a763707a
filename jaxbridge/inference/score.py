"""Score and observed information of discrete observations, by the identities of Fisher and Louis.

The identities are used for a known, constant σ, and with couplings also for a known σ(x). Otherwise
a simulated likelihood is differentiated (`simulated_likelihood`).

With Z the exact bridge of an interval and f_θ the density of its path,

    ∇ log p_T(a, b) = E[∇ log f_θ(Z)],
    -∇² log p_T(a, b) = E[-∇² log f_θ(Z)] - Cov(∇ log f_θ(Z)).

The second identity is due to Louis (1982). Both are summed over the intervals. The means are over
weighted bridges.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.averages import align_axes, effective_size, normalise_weights
from ..engine.checks import Numbers, check_count, nondifferentiable
from ..engine.compiled import compiled_sooner
from ..engine.entry import public_entry
from ..engine.pareto import pareto_k
from ..engine.progress import metered_scan
from ..engine.verdict import (
    AbstractResult,
    Fault,
    Verdict,
    heavy_tails_in_sum,
    lost_paths,
    missing_bridges,
    truncated_weights,
)
from ..models.diffusion import Diffusion
from ..proposals import Budget, ProposalLike
from ..schemes import Form, StepError, error_of_mean, log_likelihoods, num_looked, step_faults
from .blocks import Block, make_blocks, over_intervals, target_forms, with_keys
from .data import Problem, as_problem
from .parameters import Parameters, as_parameters
from .simulated_likelihood import (
    as_differentiable,
    differentiable_blocks,
    prefers_simulation,
    simulated,
    step_error_of_score,
)

# Maximum number of bridges in one batch, over all intervals of a block.
_PATHS = 8_192


class PathCounts(NamedTuple):
    """Numbers of paths of each interval.

    - `found`: bridges with a positive weight.
    - `simulated`: simulated paths.
    - `nonfinite`: paths that diverged or left the state space.
    """

    found: Int[Array, " I"]
    simulated: Int[Array, " I"]
    nonfinite: Int[Array, " I"]


class Score(AbstractResult):
    """Score, the gradient of the log-likelihood at the model's parameters, from `score`.

    - `value`, `standard_error`: score and its Monte Carlo error, pytrees like the unknown
        parameters.
    - `gradient`, `covariance`: score as a vector, shape (p,), and the covariance of its Monte Carlo
        error, shape (p, p).
    - `information`: observed information, minus the Hessian of the log-likelihood, shape (p, p).
    - `effective_sample_size`: that of the bridges of each interval, shape (I,). Errors are reliable
        if it is large.
    - `pareto_k`: k̂ of the weights of each interval, shape (I,). Above 0.7 neither the contribution
        of the interval nor its error is reliable (above 0.6 for very unequal weights, above 1 for
        nearly equal ones).
    - `step_error`, `step_uncertainty`: estimated discretisation bias of `gradient` (estimate minus
        limit), shape (p,), and its standard error. NaN if it cannot be estimated.
    - `num_missing`: number of intervals without a bridge. They are left out. If all are missing,
        the score is NaN and its error infinite.
    - `num_truncated`: number of weights that `max_trials` truncated.
    - `counts`: numbers of bridges, of simulated paths, and of paths that diverged or left the state
        space, for each interval.
    - `coupled`: whether bridges may be from couplings.
    """

    value: PyTree
    standard_error: PyTree
    gradient: Float[Array, " p"]
    covariance: Float[Array, "p p"]
    information: Float[Array, "p p"]
    effective_sample_size: Float[Array, " I"]
    pareto_k: Float[Array, " I"]
    step_error: Float[Array, " p"]
    step_uncertainty: Float[Array, " p"]
    num_missing: Int[Array, ""]
    num_truncated: Int[Array, ""]
    counts: PathCounts
    coupled: bool = eqx.field(static=True)

    @property
    def verdict(self) -> Verdict:
        """Return the faults of the score, each with a remedy.

        - intervals without a bridge;
        - weights that are truncated or have heavy tails;
        - too many lost paths in an interval;
        - a discretisation error that is unknown or too uncertain, or that dominates and exceeds
            0.05 standard deviations of the score;
        - a score or covariance that is not finite.
        """
        error = jnp.sqrt(jnp.maximum(jnp.diagonal(self.covariance), 0))
        sd = jnp.sqrt(jnp.maximum(jnp.diagonal(self.information), 0))
        steps = step_faults(StepError(self.step_error, self.step_uncertainty), error, sd)
        verdict = Verdict((*self._weight_faults, *(fault.in_any() for fault in steps)))
        return verdict.with_finite(self.gradient, self.covariance)

    @property
    def _weight_faults(self) -> tuple[Fault, ...]:
        return (
            missing_bridges(self.num_missing > 0, self.coupled),
            truncated_weights(self.num_truncated > 0),
            heavy_tails_in_sum(self.pareto_k, self.effective_sample_size, self.counts.found),
            self._lost,
        )

    @property
    def _lost(self) -> Fault:
        """Return the fault of lost paths in any interval."""
        num_found, num_simulated, num_nonfinite = self.counts
        return lost_paths(
            num_nonfinite, num_simulated, self.effective_sample_size, num_found
        ).in_any()


@public_entry
def score(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    num_bridges: int = 100,
    num_steps: int | None = None,
    step_size: float | None = None,
    proposal: ProposalLike = "auto",
    where: Callable[[PyTree], PyTree] | None = None,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> Score:
    """Estimate the score and the observed information of discrete observations at `model.params`.

    **Arguments:**

    - `key`: typed key.
    - `model`, `times`, `observations`, `num_steps`, `step_size`, `where`: as in `gibbs`.
    - `num_bridges`: weighted bridges per interval. Apart from the Monte Carlo error, means over
        weighted bridges have a bias of the order of 1 / (effective sample size).
    - `proposal`: as in `sample_weighted_bridges`, but "auto" by default. If σ depends on the state
        or on unknown parameters, estimated transition densities are differentiated, as in
        `maximum_likelihood`: the discretisation error is then of second order, and "auto" selects
        one of the guided proposals. A coupling is possible only for a known σ; with σ(x) its steps
        are Euler's.
    - `num_counts`, `max_proposals`, `max_trials`: as in `sample_weighted_bridges`.
    - `progress_meter`: a progress meter of diffrax, for instance `diffrax.TextProgressMeter()`. Not
        used where estimated densities are differentiated.

    **Returns:** `Score`. Not differentiable.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    estimate = jb.score(key, jb.hyperbolic(0.8, 2), times, observations, num_steps=20)
    estimate.value, estimate.standard_error
    ```
    """
    num_bridges = check_count("num_bridges", num_bridges, 2)
    parameters = as_parameters(model, where)
    problem = as_problem(key, parameters, times, observations, num_steps, step_size)
    parameters.model.check_invertible_sigma(problem.like)
    budget = Budget(num_counts, max_proposals, max_trials)
    theta = problem.theta
    proposal = "auto" if proposal is None else proposal
    if prefers_simulation(problem, proposal, budget):
        pilot_key, key = jax.random.split(key)
        proposal = as_differentiable(pilot_key, proposal, problem, budget)
        blocks = differentiable_blocks(pilot_key, parameters.bind(theta), problem, proposal)
        return _by_simulation(key, parameters, blocks, theta, num_bridges)
    scorer = scorer_at(key, problem, theta, proposal, budget, num_bridges, progress_meter)
    return scorer.at(key, theta, jnp.zeros((0, len(theta)), theta.dtype))[0]


@compiled_sooner
def _by_simulation(
    key: Key[Array, ""],
    parameters: Parameters,
    blocks: tuple[Block, ...],
    theta: Float[Array, " p"],
    num_bridges: int,
) -> Score:
    """Return the derivatives of the simulated likelihood at θ."""
    parameters, blocks, theta = nondifferentiable((parameters, blocks, theta))
    made = simulated(key, parameters, blocks, theta, num_bridges)
    at = theta, made.covariance
    step_error = step_error_of_score(key, parameters, blocks, *at, num_bridges)
    return as_score(parameters, made, step_error, made.num_missing, jnp.int32(0))


class Scorer(eqx.Module):
    """Estimator of the score at any θ, with `num_bridges` bridges per interval.

    The proposals are selected beforehand, and are the same for all θ.
    """

    parameters: Parameters
    blocks: tuple[Block, ...]
    form: Form = eqx.field(static=True)
    num_bridges: int = eqx.field(static=True)
    progress_meter: diffrax.AbstractProgressMeter | None = eqx.field(static=True)

    def at(
        self, key: Key[Array, ""], theta: Float[Array, " p"], offsets: Float[Array, "*shape p"]
    ) -> tuple[Score, Float[Array, "*shape"]]:
        """Return the score at θ, and the log-likelihood at θ + offsets minus that at θ."""
        sums = [
            _of_block(block_key, self, theta, offsets, block)
            for block_key, block in with_keys(key, self.blocks)
        ]
        return _over_all(self.parameters, self.blocks, sums)


def scorer_at(
    key: Key[Array, ""],
    problem: Problem,
    theta: Float[Array, " p"],
    proposal: ProposalLike,
    budget: Budget,
    num_bridges: int,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> Scorer:
    """Return the estimator with proposals that are selected at θ."""
    model = problem.parameters.bind(theta)
    blocks = make_blocks(key, model, problem, proposal, budget, "means")
    # The weights belong to the target of this form, so the score must use it, too.
    form = target_forms(blocks, model)[0]
    return Scorer(problem.parameters, blocks, form, num_bridges, progress_meter)


def as_score(
    parameters: Parameters,
    sums: Any,
    step_error: StepError,
    num_missing: Int[Array, ""],
    num_truncated: Int[Array, ""],
    coupled: bool = False,
) -> Score:
    """Return the `Score` of sums over the intervals."""
    # An empty sum is 0 ± 0, which would look like an exact score.
    no_bridges = jnp.all(sums.effective_sample_size == 0)
    blank = lambda leaf, value: jnp.where(no_bridges, jnp.asarray(value, leaf.dtype), leaf)
    sums = sums._replace(
        gradient=blank(sums.gradient, jnp.nan),
        covariance=blank(sums.covariance, jnp.inf),
        information=blank(sums.information, jnp.nan),
    )
    step_error = StepError(*(blank(leaf, jnp.nan) for leaf in step_error))
    error = jnp.sqrt(jnp.maximum(jnp.diagonal(sums.covariance), 0))
    return Score(
        parameters.each(sums.gradient),
        parameters.each(error),
        sums.gradient,
        sums.covariance,
        sums.information,
        sums.effective_sample_size,
        sums.pareto_k,
        *step_error,
        num_missing,
        num_truncated,
        PathCounts(sums.num_found, sums.num_simulated, sums.num_nonfinite),
        coupled,
    )


class _Sums(NamedTuple):
    """Results of the intervals of a block, or of all intervals.

    - Sums over the intervals: `gradient`, `covariance` (that of the Monte Carlo error of the
      gradient), `information`, `step_error` of the gradient, `step_variance` (square of its
      uncertainty), `num_truncated`, and `rises` (log-likelihood at points around θ minus that at
      θ).
    - For each interval: `effective_sample_size`, `pareto_k`, and the numbers of paths.
    """

    gradient: Float[Array, " p"]
    covariance: Float[Array, "p p"]
    information: Float[Array, "p p"]
    effective_sample_size: Float[Array, " I"]
    pareto_k: Float[Array, " I"]
    step_error: Float[Array, " p"]
    step_variance: Float[Array, " p"]
    num_truncated: Int[Array, ""]
    num_found: Int[Array, " I"]
    num_simulated: Int[Array, " I"]
    num_nonfinite: Int[Array, " I"]
    rises: Float[Array, "*shape"]


@compiled_sooner
def _over_all(
    parameters: Parameters, blocks: tuple[Block, ...], of_blocks: Sequence[_Sums]
) -> tuple[Score, Float[Array, "*shape"]]:
    """Return the score of all intervals, and the log-likelihoods around θ minus that at θ."""
    sums = over_intervals(blocks, of_blocks)
    step_error = StepError(sums.step_error, jnp.sqrt(sums.step_variance))
    num_missing = jnp.sum(sums.effective_sample_size == 0, dtype=jnp.int32)
    coupled = any(block.proposal.coupled for block in blocks)
    score = as_score(parameters, sums, step_error, num_missing, sums.num_truncated, coupled)
    return score, sums.rises


class _Bridges(NamedTuple):
    """Weighted bridges, n for each interval.

    - `log_weights`, `truncated`: log weights, and whether `max_trials` truncated them.
    - `num_simulated`, `num_nonfinite`: numbers of simulated paths for each bridge, and of those
      that diverged or left the state space.
    - `gradient`, `hessian`: derivatives in θ of the log density of the path.
    - `log_halving`, `slope`: D of `halving` for the first m bridges, and its gradient.
    - `rises`: log density of the path at points around θ minus that at θ.
    """

    log_weights: Float[Array, "I n"]
    truncated: Bool[Array, "I n"]
    num_simulated: Int[Array, "I n"]
    num_nonfinite: Int[Array, "I n"]
    gradient: Float[Array, "I n p"]
    hessian: Float[Array, "I n p p"]
    log_halving: Float[Array, "I m"]
    slope: Float[Array, "I m p"]
    rises: Float[Array, "I n *shape"]


def _draw(
    key: Key[Array, ""],
    scorer: "Scorer",
    theta: Float[Array, " p"],
    offsets: Float[Array, "*shape p"],
    model: Diffusion,
    block: Block,
    n: int,
) -> _Bridges:
    """Sample n bridges of each interval of a block; `model` is prepared at θ."""
    parameters, form = scorer.parameters, scorer.form
    intervals, num_steps = block.intervals, block.num_steps
    # D is hardly random for constant σ, so few paths suffice there.
    m = num_looked(n, model.sigma_varies(intervals.start[0]))
    keys = jax.random.split(key, (len(block.index), n))
    draws = block.proposal.draw(keys, model, intervals, num_steps, None, False)
    # A constant path replaces a missing bridge, so that all derivatives are finite.
    start = intervals.start[:, None, None]
    paths = jnp.where(draws.found[..., None, None], draws.paths, start)
    steps = jnp.repeat(block.steps, n, axis=1)

    def log_f(theta):
        flat = paths.reshape(-1, *paths.shape[2:])
        return log_likelihoods(parameters.bind(theta), steps, flat, form).reshape(-1, n)

    def log_halving(theta):
        flat = paths[:, :m].reshape(-1, *paths.shape[2:])
        return block.log_halvings(parameters.bind(theta).prepared(), flat, form).reshape(-1, m)

    # Forward mode: there are few parameters and many paths.
    gradient = jax.jacfwd(log_f)
    derivatives = (gradient(theta), jax.jacfwd(gradient)(theta))
    halvings = (log_halving(theta), jax.jacfwd(log_halving)(theta))
    points = (theta + offsets).reshape(-1, len(theta))
    none = jnp.zeros((0, len(keys), n), theta.dtype)
    around = lax.map(log_f, points) - log_f(theta) if len(points) else none
    rises = jnp.moveaxis(around, 0, -1).reshape(len(keys), n, *offsets.shape[:-1])
    counts = draws.truncated, draws.num_simulated, draws.num_nonfinite
    return _Bridges(draws.log_weights, *counts, *derivatives, *halvings, rises)


@compiled_sooner
def _of_block(
    key: Key[Array, ""],
    scorer: Scorer,
    theta: Float[Array, " p"],
    offsets: Float[Array, "*shape p"],
    block: Block,
) -> _Sums:
    scorer, block = nondifferentiable((scorer, block))
    model, num_bridges = scorer.parameters.bind(theta).prepared(), scorer.num_bridges
    form = scorer.form
    num_intervals = len(block.index)
    at_once = min(num_bridges, max(1, _PATHS // num_intervals))
    # Batches bound the memory for paths.
    num_batches = -(-num_bridges // at_once)

    def batch(_, i):
        batch_key = jax.random.fold_in(key, i)
        return None, _draw(batch_key, scorer, theta, offsets, model, block, at_once)

    _, batches = metered_scan(batch, None, jnp.arange(num_batches), scorer.progress_meter)

    def join(leaf, number: int):
        """Return the first `number` bridges of each batch, joined over the batches."""
        leaf = jnp.moveaxis(leaf[:, :, :number], 0, 1)
        return leaf.reshape(num_intervals, num_batches * leaf.shape[2], *leaf.shape[3:])

    m = batches.log_halving.shape[2]
    halved = _Bridges(*(join(leaf, m) for leaf in batches))
    share = block.step_shares(model, form)
    halves = (halved.gradient, halved.gradient + halved.slope)
    error = error_of_mean(halved.log_weights, halved.log_halving, share, *halves)
    all_bridges = (*batches[:6], batches.rises)
    all_bridges = (join(leaf, at_once)[:, :num_bridges] for leaf in all_bridges)
    log_weights, truncated, num_simulated, num_nonfinite, g, H, rises = all_bridges
    weights = normalise_weights(log_weights)
    mean = jnp.sum(weights[..., None] * g, axis=1)
    deviation = g - mean[:, None]
    products = deviation[..., :, None] * deviation[..., None, :]
    squares = jnp.sum(weights**2, axis=1)
    # A weighted variance of n independent bridges is too small by the factor 1 - Σ w².
    factor = jnp.where(squares < 1, 1 - squares, 1)[:, None, None]
    spread = jnp.sum(weights[..., None, None] * products, axis=1) / factor
    covariance = jnp.sum(weights[..., None, None] ** 2 * products, axis=1)
    # Louis: mean of the negative Hessian minus the variance of the gradient.
    information = -jnp.sum(weights[..., None, None] * H, axis=1) - spread
    return _Sums(
        jnp.sum(mean, axis=0),
        jnp.sum(covariance, axis=0),
        jnp.sum(information, axis=0),
        effective_size(weights),
        pareto_k(log_weights),
        jnp.sum(error.value, axis=0),
        jnp.sum(error.uncertainty**2, axis=0),
        jnp.sum(truncated, dtype=jnp.int32),
        jnp.sum(log_weights > -jnp.inf, axis=1, dtype=jnp.int32),
        jnp.sum(num_simulated, axis=1, dtype=jnp.int32),
        jnp.sum(num_nonfinite, axis=1, dtype=jnp.int32),
        _rises(weights, rises),
    )


def _rises(
    weights: Float[Array, "I n"], exponents: Float[Array, "I n *shape"]
) -> Float[Array, "*shape"]:
    """Return Σ log(weighted mean of exponentials) over the intervals with bridges.

    The largest exponent of each interval is factored out, against overflow.
    """
    # One weight serves all points around θ.
    weights = align_axes(weights, exponents)
    used = (weights > 0) & (exponents < jnp.inf)
    largest = jnp.max(jnp.where(used, exponents, -jnp.inf), axis=1, keepdims=True)
    largest = jnp.where(jnp.isfinite(largest), largest, 0)
    ratios = jnp.where(used, weights * jnp.exp(jnp.where(used, exponents - largest, 0)), 0)
    logs = jnp.log(jnp.sum(ratios, axis=1)) + largest[:, 0]
    has_bridges = jnp.any(weights > 0, axis=1)
    return jnp.sum(jnp.where(has_bridges, logs, 0), axis=0)
