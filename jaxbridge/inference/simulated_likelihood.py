"""Score and maximum of a simulated likelihood, for an unknown or state-dependent σ.

A complete path determines σ, so for unknown σ methods with completed paths (Fisher's identity, EM)
do not apply. For σ(x) the likelihood of a path has Euler steps, with an error of first order. But
guided paths are smooth functions of θ and of their noise, and so are their weights. The weights
have steps of second order. With fixed noise of n paths per interval,

    ℓ̂(θ) = Σ_k log p̂_k(θ),    p̂_k = (1/n) Σ_j w_kj(θ),

is a smooth function of θ. Its maximum is the simulated maximum likelihood estimate (Pedersen 1995;
Durham & Gallant 2002).

*Bias.* E[p̂] = p, so the mean of log p̂ is below log p, to leading order by half the relative
variance of p̂. This depends on θ. Hence the maximum has a bias of O(1/n), with the same sign in all
intervals. Adding half of the estimated variance, [Σ w²/(Σ w)² - 1/n] n/(n - 1), to each log p̂_k
leaves O(1/n²). For very unequal weights the correction is limited to one half.

*Search.* First an optimiser makes steps along noisy gradients, each with a few new paths. Newton
steps with fixed noise follow. All derivatives are in forward mode, so memory does not grow with the
number of steps. This takes p² derivatives for p unknown parameters.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.averages import effective_size, normalise_weights
from ..engine.checks import all_finite_leaves, is_traced, nondifferentiable
from ..engine.compiled import compiled_sooner
from ..engine.pareto import pareto_k
from ..models.diffusion import Diffusion
from ..proposals import (
    AbstractProposal,
    Budget,
    Guided,
    ProposalLike,
    as_proposal,
    choice_between,
    guided_candidates,
)
from ..schemes import StepError
from .blocks import Block, make_blocks, over_intervals, with_keys
from .data import Problem
from .newton import (
    Slope,
    allowed_offsets,
    ascent_direction,
    falls,
    is_maximum,
    longest_fraction,
)
from .parameters import Parameters
from .stochastic_approximation import Gradient, Search, SearchInfo, iterate

# Number of paths per interval for a noisy gradient.
_FEW = 8
# Log of a relative weight that is below the rounding error of a sum.
_NO_WEIGHT = -60.0
# Newton's method has converged if the squared next step, in standard errors, is smaller.
_GAIN = 1e-5
# Maximum number of trial points, and the smallest fraction of a bounded step.
_MOST_POINTS = 60
_SHORTEST = 1e-4


class Simulated(NamedTuple):
    """Simulated log-likelihood ℓ̂ and its derivatives at one θ, over the intervals with paths.

    - `value`, `gradient`, `information`: ℓ̂, ∇ℓ̂ and -∇²ℓ̂.
    - `covariance`: covariance of ∇ℓ̂ due to the noise of the paths.
    - `effective_sample_size`, `pareto_k`: those of the weights of each interval.
    - `num_missing`: number of intervals without a path.
    - `rounding`: rounding error of `value`.
    - `num_found`, `num_simulated`, `num_nonfinite`: numbers of paths of each interval that have a
      weight, were simulated, and diverged or left the state space.
    """

    value: Float[Array, ""]
    gradient: Float[Array, " p"]
    covariance: Float[Array, "p p"]
    information: Float[Array, "p p"]
    effective_sample_size: Float[Array, " I"]
    pareto_k: Float[Array, " I"]
    num_missing: Int[Array, ""]
    rounding: Float[Array, ""]
    num_found: Int[Array, " I"]
    num_simulated: Int[Array, " I"]
    num_nonfinite: Int[Array, " I"]


class Maximum(NamedTuple):
    """Result of Newton's method: the last θ, ℓ̂ at it, and checks of the maximum.

    `found` states whether θ is a maximum, and `fall` is the decrease of ℓ̂ around it.
    """

    theta: Float[Array, " p"]
    simulated: Simulated
    found: Bool[Array, ""]
    fall: Float[Array, "2 p"]


_NO_DERIVATIVE = (
    "σ depends on the unknown parameters or on the state, so the likelihood itself is "
    "differentiated, but with couplings its estimates have no derivative"
)


def prefers_simulation(problem: Problem, proposal: ProposalLike, budget: Budget) -> bool:
    """Return whether to differentiate estimated densities, not the likelihood of paths.

    Only estimated densities allow an unknown σ, and for a state-dependent σ they have the smaller
    discretisation error. Weights of couplings have no derivatives, so couplings with a known σ use
    the likelihood of paths.
    """
    if problem.sigma_is_unknown:
        return True
    model, like = problem.parameters.model, problem.like
    if not model.sigma_varies(like):
        return False
    return proposal == "auto" or not as_proposal(proposal, model, like, budget).coupled


def as_differentiable(
    key: Key[Array, ""], proposal: ProposalLike, problem: Problem, budget: Budget
) -> AbstractProposal:
    """Return the proposal of the user, where "auto" excludes couplings.

    Inside `jit`, where no pilot runs can select a proposal, "auto" is `Guided()`.

    **Raises:** `ValueError` and `TypeError` for a proposal whose weights have no derivatives.
    """
    if isinstance(proposal, str) and proposal == "auto":
        proposal = choice_between(guided_candidates(), budget, left_out=_NO_DERIVATIVE)
        if is_traced(key, problem):
            proposal = Guided()
    model, like = problem.parameters.model, problem.like
    pulled = as_proposal(proposal, model, like, budget, for_density=True)
    if pulled.coupled:
        raise ValueError(
            f"{_NO_DERIVATIVE}. Use a guided proposal, such as `Guided()` or "
            '`ModifiedDiffusionBridge()`, or "auto", or the function `pmmh`.'
        )
    return pulled


def differentiable_blocks(
    key: Key[Array, ""], model: Diffusion, problem: Problem, proposal: AbstractProposal
) -> tuple[Block, ...]:
    """Return blocks with a single proposal each, if the choice is known before compilation.

    The derivatives of a choice between proposals would run all of them for all intervals. Hence
    "auto" selects the proposal with the smallest total variance at `model`. A choice of the user
    for each interval gives a block for each proposal.
    """
    blocks = make_blocks(key, model, problem, proposal, Budget(), "density")
    if proposal.is_open:
        return tuple(_with_best_candidate(block) for block in blocks)
    if is_traced(*(block.proposal for block in blocks)):
        return blocks  # the intervals of a candidate are unknown: all candidates run
    return tuple(single for block in blocks for single in _split(block))


def _with_best_candidate(block: Block) -> Block:
    """Return the block with the best candidate for all its intervals.

    The squared error of ℓ̂ is the sum of 1 / (effective sample size) over the intervals.
    """
    return replace(block, proposal=block.proposal.for_all())


def _split(block: Block) -> list[Block]:
    """Return one block for each selected candidate."""
    blocks = []
    for which, single in block.proposal.split():
        intervals = jax.tree.map(lambda leaf, which=which: leaf[which], block.intervals)
        blocks.append(Block(intervals, block.index[which], block.fractions, single))
    return blocks


def _log_weights(
    key: Key[Array, ""],
    parameters: Parameters,
    block: Block,
    num_paths: int,
    theta: Float[Array, " p"],
) -> tuple[Float[Array, "I n"], Bool[Array, "I n"], Int[Array, "I n"]]:
    """Return log w at θ of paths with fixed noise, masks of active paths, and counts of lost ones.

    A path is inactive if it diverged, left the state space, or has a negligible weight. A path with
    negligible weight is left out because it may be close to overflow, and its derivatives then
    overflow. The log w of an inactive path is replaced by zero.
    """
    keys = jax.random.split(key, (block.intervals.start.shape[0], num_paths))
    no_points = jnp.zeros(0, jnp.int32)  # return no point of the paths
    model = parameters.bind(theta).prepared()
    draws = block.proposal.draw(keys, model, block.intervals, block.num_steps, no_points, True)
    largest = jnp.max(draws.log_weights, axis=1, keepdims=True)
    active = draws.found & (draws.log_weights > largest + _NO_WEIGHT)
    return jnp.where(active, draws.log_weights, 0), active, draws.num_nonfinite


def _log_densities(
    log_weights: Float[Array, "I n"], active: Bool[Array, "I n"]
) -> Float[Array, " I"]:
    """Return log p̂ of each interval plus half the relative variance of p̂.

    It is zero for intervals without an active path.
    """
    n, has_paths = log_weights.shape[1], jnp.any(active, axis=1)
    largest = jnp.max(log_weights, axis=1, initial=-jnp.inf, where=active)
    largest = lax.stop_gradient(jnp.where(has_paths, largest, 0))
    # Mask before `exp`, too: in reverse mode 0 · ∞ of a masked entry would be NaN.
    weights = jnp.exp(jnp.where(active, log_weights - largest[:, None], 0))
    weights = jnp.where(active, weights, 0)
    sums, squares = jnp.sum(weights, axis=1), jnp.sum(weights**2, axis=1)
    sums = jnp.where(has_paths, sums, 1)
    variance = (squares / sums**2 - 1 / n) * (n / (n - 1))
    return jnp.where(has_paths, jnp.log(sums) + largest - np.log(n) + variance / 2, 0)


def simulated_value(
    key: Key[Array, ""],
    parameters: Parameters,
    blocks: tuple[Block, ...],
    theta: Float[Array, " p"],
    num_paths: int,
) -> Float[Array, ""]:
    """Return ℓ̂ at θ, with the noise of this key."""
    value = jnp.zeros((), theta.dtype)
    for block_key, block in with_keys(key, blocks):
        value += jnp.sum(
            _log_densities(*_log_weights(block_key, parameters, block, num_paths, theta)[:2])
        )
    return value


def simulated(
    key: Key[Array, ""],
    parameters: Parameters,
    blocks: tuple[Block, ...],
    theta: Float[Array, " p"],
    num_paths: int,
) -> Simulated:
    """Return ℓ̂ at θ, with the noise of this key, its derivatives and its diagnostics."""
    parts = [
        _of_block(block_key, parameters, block, theta, num_paths)
        for block_key, block in with_keys(key, blocks)
    ]
    return over_intervals(blocks, parts)


@compiled_sooner
def step_error_of_score(
    key: Key[Array, ""],
    parameters: Parameters,
    blocks: tuple[Block, ...],
    theta: Float[Array, " p"],
    covariance: Float[Array, "p p"],
    num_paths: int,
) -> StepError:
    """Estimate the discretisation error of ∇ℓ̂ at θ, whose noise has this covariance.

    The estimate uses as many further paths, each with half as many steps. It is NaN for one step.
    """
    parameters, blocks = nondifferentiable((parameters, blocks))
    model = parameters.bind(theta)
    error, variance = jnp.zeros_like(theta), jnp.zeros_like(theta)
    for block_key, block in with_keys(key, blocks):
        # The block has a single proposal, so all intervals have the same order of error.
        target = block.proposal.singles[0].target
        if target is not None and target.is_exact:
            continue
        if block.num_steps < 2:
            unknown = jnp.full_like(error, jnp.nan)
            return StepError(unknown, unknown)
        fractions = jnp.asarray(
            np.diff(block.proposal.fractions(block.num_steps // 2)), error.dtype
        )
        half = replace(block, fractions=fractions)
        share = block.proposal.step_share(model, block.intervals)[0]

        def difference(theta, key=block_key, block=block, half=half):
            log_weights = [
                _log_weights(key, parameters, grid, num_paths, theta)[:2] for grid in (block, half)
            ]
            fine, coarse = (_log_densities(*of_grid) for of_grid in log_weights)
            in_fine, in_half = (jnp.any(active, axis=1) for _, active in log_weights)
            both = jnp.where(in_fine & in_half, coarse - fine, 0)
            return jnp.sum(both), jnp.any(in_fine & ~in_half)

        of_block, is_unknown = jax.jacfwd(difference, has_aux=True)(theta)
        error += share * of_block
        # Half as many steps have no path in some interval.
        variance = jnp.maximum(variance, jnp.where(is_unknown, jnp.inf, share**2))
    # The variances of both grids are added, as for independent noise.
    noise = 2 * jnp.diagonal(covariance)
    return StepError(error, jnp.sqrt(variance * noise))


def _of_block(
    key, parameters, block: Block, theta: Float[Array, " p"], num_paths: int
) -> Simulated:
    def log_weights(theta):
        log_w, *counts = _log_weights(key, parameters, block, num_paths, theta)
        return log_w, (log_w, *counts)

    def first(theta):
        g, values = jax.jacfwd(log_weights, has_aux=True)(theta)
        return g, (*values, g)

    H, (log_w, active, num_nonfinite, g) = jax.jacfwd(first, has_aux=True)(theta)

    def total(t):
        """Return ℓ̂ at θ + t, with the log weights expanded to second order."""
        return jnp.sum(_log_densities(log_w + g @ t + ((H @ t) @ t) / 2, active))

    at_theta = jnp.zeros_like(theta)
    information = -jax.jacfwd(jax.grad(total))(at_theta)
    weights = normalise_weights(jnp.where(active, log_w, -jnp.inf))
    mean = jnp.sum(weights[..., None] * g, axis=1, keepdims=True)
    deviation = weights[..., None] * (g - mean)
    has_paths = jnp.any(active, axis=1)
    densities = _log_densities(log_w, active)
    return Simulated(
        jnp.sum(densities),
        jax.grad(total)(at_theta),
        jnp.einsum("kji,kjl->il", deviation, deviation),
        (information + information.T) / 2,
        effective_size(weights),
        pareto_k(jnp.where(active, log_w, -jnp.inf)),
        jnp.sum(~has_paths, dtype=jnp.int32),
        4 * jnp.finfo(theta.dtype).eps * jnp.sum(jnp.abs(densities)),
        jnp.sum(active, axis=1, dtype=jnp.int32),
        jnp.full(len(active), num_paths, jnp.int32),
        jnp.sum(num_nonfinite, axis=1, dtype=jnp.int32),
    )


class _Ascent(NamedTuple):
    """State of the ascent: the best point so far, the step from it, and the next trial fraction."""

    i: Int[Array, ""]
    theta: Float[Array, " p"]
    simulated: Simulated
    step: Float[Array, " p"]
    fraction: Float[Array, ""]
    done: Bool[Array, ""]


@compiled_sooner
def newton_ascent(
    key: Key[Array, ""],
    parameters: Parameters,
    blocks: tuple[Block, ...],
    starts: Float[Array, "starts p"],
    num_paths: int,
) -> Maximum:
    """Maximise ℓ̂ with fixed noise by Newton's method, from the best of several starting points.

    The first starting point must satisfy the constraint. A step is shortened if it decreases ℓ̂,
    leaves the constraint, or leads to more intervals without a path.
    """
    parameters, blocks, starts = nondifferentiable((parameters, blocks, starts))
    at_start = len(starts)

    @jax.jit  # traced once for both its shapes and the loop
    def at(theta):
        return simulated(key, parameters, blocks, theta, num_paths)

    def next_point(state):
        start = starts[jnp.minimum(state.i, at_start - 1)]
        starting = state.i < at_start
        tried = jnp.where(starting, start, state.theta + state.fraction * state.step)
        inside = parameters.allowed(tried)
        # The simulation of the model may fail outside the constraint.
        new, old = at(jnp.where(inside, tried, starts[0])), state.simulated
        expected = jnp.where(starting, 0, 1e-4 * state.fraction * (old.gradient @ state.step))
        higher = new.value >= old.value + expected - jnp.where(starting, 0, old.rounding)
        fewer, as_many = new.num_missing < old.num_missing, new.num_missing == old.num_missing
        finite = all_finite_leaves(new._replace(pareto_k=new.rounding))  # k̂ need not be
        better = inside & finite & (fewer | (as_many & higher))
        theta, new = jax.tree.map(
            lambda new, old: jnp.where(better, new, old), (tried, new), (state.theta, old)
        )
        step = ascent_direction(new.gradient, new.information)
        gain = new.gradient @ step
        # A long step could end at a spurious maximum of ℓ̂, where weights are very uneven.
        longest = longest_fraction(gain)
        fraction = jnp.where(better | starting, longest, state.fraction / 3).astype(theta.dtype)
        # Stop if the next step is negligible, or if shorter steps brought no increase.
        done = (state.i + 1 >= at_start) & ((gain < _GAIN) | (fraction < _SHORTEST * longest))
        return _Ascent(state.i + 1, theta, new, step, fraction, done)

    nowhere = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(at, starts[0])
    )
    num_intervals = jnp.int32(nowhere.effective_sample_size.shape[0])
    nowhere = nowhere._replace(
        value=jnp.full_like(nowhere.value, -jnp.inf), num_missing=num_intervals
    )
    one, no = jnp.ones_like(starts[0, 0]), jnp.array(False)
    first = _Ascent(jnp.int32(0), starts[0], nowhere, jnp.zeros_like(starts[0]), one, no)
    last = lax.while_loop(lambda state: ~state.done & (state.i < _MOST_POINTS), next_point, first)
    at_last = last.simulated
    offsets = allowed_offsets(parameters, last.theta, at_last.information)
    values = lax.map(
        lambda point: simulated_value(key, parameters, blocks, point, num_paths),
        (last.theta + offsets).reshape(-1, len(last.theta)),
    )
    rises = values.reshape(offsets.shape[:-1]) - at_last.value
    slope = Slope(at_last.gradient, at_last.covariance, at_last.information, rises)
    # ℓ̂ has spurious maxima where weights are very uneven. The tolerance on the gain is wider than
    # `_GAIN` because rounding errors may reject an ascending step.
    converged = is_maximum(slope) & (at_last.gradient @ last.step < 100 * _GAIN)
    return Maximum(last.theta, at_last, converged, falls(slope, offsets))


@compiled_sooner
def stochastic_ascent(
    key: Key[Array, ""],
    parameters: Parameters,
    blocks: tuple[Block, ...],
    search: Search,
    theta: Float[Array, " p"],
) -> tuple[Float[Array, "n p"], SearchInfo]:
    """Return the iterates of the optimiser, which follows ∇ℓ̂ with new noise in each iteration.

    Also return the numbers of intervals without a path and of skipped steps.
    """
    rule = search.rule
    assert isinstance(rule, Gradient)
    parameters, blocks, theta = nondifferentiable((parameters, blocks, theta))
    num_intervals = sum(len(block.index) for block in blocks)

    def mean_log_likelihood(theta, key):
        value, missing = jnp.zeros((), theta.dtype), jnp.int32(0)
        for block_key, block in with_keys(key, blocks):
            log_weights, active, _ = _log_weights(block_key, parameters, block, _FEW, theta)
            value += jnp.sum(_log_densities(log_weights, active))
            missing += jnp.sum(~jnp.any(active, axis=1), dtype=jnp.int32)
        return value / num_intervals, missing

    def propose(i, theta, memory, _):
        gradient, missing = jax.jacfwd(mean_log_likelihood, has_aux=True)(
            theta, jax.random.fold_in(key, i)
        )
        return rule.ascend(theta, memory, gradient), None, (missing, jnp.int32(0))

    iterates, _, info = iterate(propose, parameters, search, theta, None)
    return iterates, info
