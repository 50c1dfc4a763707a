"""Maximum of a simulated likelihood, for unknown parameters of σ.

A complete path determines σ, so methods with completed paths (Fisher's identity, EM) do not apply.
But guided paths are smooth functions of θ and of their noise, and so are their weights. With fixed
noise of n paths per interval,

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
from typing import Any, NamedTuple

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
from ..proposals import AbstractProposal, Budget, as_proposal, choice_between, guided_candidates
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

# Paths of each interval for a noisy gradient.
_FEW = 8
# Less than rounding leaves of a sum, in logarithms.
_NO_WEIGHT = -60.0
# Newton's method has arrived where the square of the next step, in standard errors, is less.
_GAIN = 1e-5
# Points that are tried, and the shortest fraction of a step so bounded.
_MOST_POINTS = 60
_SHORTEST = 1e-4


class Simulated(NamedTuple):
    """ℓ̂ and its derivatives at one θ, over the intervals that have any path: its value, ∇ℓ̂, the
    covariance of that by the noise of the paths, and -∇²ℓ̂; the effective number of paths of each
    interval, and k̂ of their weights; how many intervals have none; the rounding error of the
    value; and how many paths of each interval have a weight, were simulated, and were lost."""

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
    """Where Newton's method ended, what ℓ̂ is there, whether that is a maximum, and by how much ℓ̂
    falls around it."""

    theta: Float[Array, " p"]
    simulated: Simulated
    found: Bool[Array, ""]
    fall: Float[Array, "2 p"]


_NO_DERIVATIVE = (
    "σ depends on the unknown parameters, so the likelihood itself is differentiated, "
    "but with couplings its estimates have no derivative"
)


def as_pulled(
    proposal: Any, model: Diffusion, like: Float[Array, " d"], budget: Budget
) -> AbstractProposal:
    """The proposal that the user gave, "auto" without couplings.

    **Raises:** `ValueError` and `TypeError` for one whose weights have no derivatives.
    """
    if isinstance(proposal, str) and proposal == "auto":
        proposal = choice_between(guided_candidates(), budget, left_out=_NO_DERIVATIVE)
    given = as_proposal(proposal, model, like, budget, for_density=True)
    if given.coupled:
        raise ValueError(
            f"{_NO_DERIVATIVE}. Use a guided proposal, such as `Guided()` or "
            '`ModifiedDiffusionBridge()`, or "auto", or the function `pmmh`.'
        )
    return given


def pulled_blocks(
    key: Key[Array, ""], model: Diffusion, problem: Problem, proposal: AbstractProposal
) -> tuple[Block, ...]:
    """The blocks with one proposal each, for derivatives of a choice between several run each for
    all intervals: that which leaves the least variance in all at this model, or, where the user has
    chosen interval by interval, a block for each."""
    blocks = make_blocks(key, model, problem, proposal, Budget(), "density")
    if proposal.is_open:
        return tuple(_decided(block) for block in blocks)
    return tuple(single for block in blocks for single in _split(block))


def _decided(block: Block) -> Block:
    """One candidate for all intervals. The error of ℓ̂ is Σ 1/(effective paths) over them."""
    if is_traced(block.proposal):
        raise ValueError(
            '`proposal="auto"` needs pilot runs, which cannot run inside `jit`: pass a guided '
            "proposal, such as `Guided()`."
        )
    return replace(block, proposal=block.proposal.for_all())


def _split(block: Block) -> list[Block]:
    """A block for each candidate that was chosen."""
    made = []
    for which, single in block.proposal.split():
        mine = jax.tree.map(lambda leaf, which=which: leaf[which], block.intervals)
        made.append(Block(mine, block.index[which], block.fractions, single))
    return made


def _log_weights(
    key: Key[Array, ""],
    parameters: Parameters,
    block: Block,
    num_paths: int,
    theta: Float[Array, " p"],
) -> tuple[Float[Array, "I n"], Bool[Array, "I n"], Int[Array, "I n"]]:
    """log w at θ of the paths with this noise, zero for those that were lost, or have no weight
    beside others, for where a path nearly overflows its derivatives do; which are not; and how many
    left the state space or the finite numbers."""
    keys = jax.random.split(key, (block.intervals.start.shape[0], num_paths))
    nothing = jnp.zeros(0, jnp.int32)  # no path is kept
    model = parameters.bind(theta).prepared()
    drawn = block.proposal.draw(keys, model, block.intervals, block.num_steps, nothing, True)
    largest = jnp.max(drawn.log_weights, axis=1, keepdims=True)
    found = drawn.found & (drawn.log_weights > largest + _NO_WEIGHT)
    return jnp.where(found, drawn.log_weights, 0), found, drawn.num_nonfinite


def _log_densities(
    log_weights: Float[Array, "I n"], found: Bool[Array, "I n"]
) -> Float[Array, " I"]:
    """log p̂ of each interval with half the relative variance of p̂ added; zero where no path was
    found."""
    n, some = log_weights.shape[1], jnp.any(found, axis=1)
    largest = jnp.max(log_weights, axis=1, initial=-jnp.inf, where=found)
    largest = lax.stop_gradient(jnp.where(some, largest, 0))
    # What is lost has no weight, and is not raised to a power: in reverse mode a masked 0 · ∞
    # would be NaN.
    weights = jnp.exp(jnp.where(found, log_weights - largest[:, None], 0))
    weights = jnp.where(found, weights, 0)
    sums, squares = jnp.sum(weights, axis=1), jnp.sum(weights**2, axis=1)
    sums = jnp.where(some, sums, 1)
    variance = (squares / sums**2 - 1 / n) * (n / (n - 1))
    return jnp.where(some, jnp.log(sums) + largest - np.log(n) + variance / 2, 0)


def simulated_value(
    key: Key[Array, ""],
    parameters: Parameters,
    blocks: tuple[Block, ...],
    theta: Float[Array, " p"],
    num_paths: int,
) -> Float[Array, ""]:
    """ℓ̂ at θ with the noise of this key."""
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
    """ℓ̂ at θ with the noise of this key, and all that is to be known of it."""
    made = [
        _of_block(block_key, parameters, block, theta, num_paths)
        for block_key, block in with_keys(key, blocks)
    ]
    return over_intervals(blocks, made)


@compiled_sooner
def step_error_of_score(
    key: Key[Array, ""],
    parameters: Parameters,
    blocks: tuple[Block, ...],
    maximum: Maximum,
    num_paths: int,
) -> StepError:
    """That of ∇ℓ̂ at the maximum, by as many paths of half as many steps; NaN where a path has one
    step only."""
    parameters, blocks = nondifferentiable((parameters, blocks))
    model = parameters.bind(maximum.theta)
    error, variance = jnp.zeros_like(maximum.theta), jnp.zeros_like(maximum.theta)
    for block_key, block in with_keys(key, blocks):
        if block.num_steps < 2:
            unknown = jnp.full_like(error, jnp.nan)
            return StepError(unknown, unknown)
        fractions = jnp.asarray(
            np.diff(block.proposal.fractions(block.num_steps // 2)), error.dtype
        )
        half = replace(block, fractions=fractions)
        # Of all that are pulled each has one order for all intervals.
        share = block.proposal.step_share(model, block.intervals)[0]

        def difference(theta, key=block_key, block=block, half=half):
            values = (
                jnp.sum(_log_densities(*_log_weights(key, parameters, each, num_paths, theta)[:2]))
                for each in (block, half)
            )
            fine, coarse = values
            return coarse - fine

        error += share * jax.jacfwd(difference)(maximum.theta)
        variance = jnp.maximum(variance, share**2)
    noise = 2 * jnp.diagonal(maximum.simulated.covariance)
    return StepError(error, jnp.sqrt(variance * noise))


def _of_block(
    key, parameters, block: Block, theta: Float[Array, " p"], num_paths: int
) -> Simulated:
    def log_weights(theta):
        made, *counts = _log_weights(key, parameters, block, num_paths, theta)
        return made, (made, *counts)

    def first(theta):
        g, made = jax.jacfwd(log_weights, has_aux=True)(theta)
        return g, (*made, g)

    H, (made, found, num_nonfinite, g) = jax.jacfwd(first, has_aux=True)(theta)

    def total(t):
        """ℓ̂ at θ + t, with the log weights expanded to second order."""
        return jnp.sum(_log_densities(made + g @ t + ((H @ t) @ t) / 2, found))

    at_theta = jnp.zeros_like(theta)
    information = -jax.jacfwd(jax.grad(total))(at_theta)
    weights = normalise_weights(jnp.where(found, made, -jnp.inf))
    mean = jnp.sum(weights[..., None] * g, axis=1, keepdims=True)
    deviation = weights[..., None] * (g - mean)
    some = jnp.any(found, axis=1)
    densities = _log_densities(made, found)
    return Simulated(
        jnp.sum(densities),
        jax.grad(total)(at_theta),
        jnp.einsum("kji,kjl->il", deviation, deviation),
        (information + information.T) / 2,
        effective_size(weights),
        pareto_k(jnp.where(found, made, -jnp.inf)),
        jnp.sum(~some, dtype=jnp.int32),
        4 * jnp.finfo(theta.dtype).eps * jnp.sum(jnp.abs(densities)),
        jnp.sum(found, axis=1, dtype=jnp.int32),
        jnp.full(len(found), num_paths, jnp.int32),
        jnp.sum(num_nonfinite, axis=1, dtype=jnp.int32),
    )


class _Ascent(NamedTuple):
    """The best point so far, the step from there, and the fraction of it to be tried next."""

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
    """The maximum of ℓ̂ at fixed noise by Newton's method, from the best of several points, the
    first of which must be allowed.

    A step that leads down, out of the constraint, or to where more intervals have no path, is
    shortened.
    """
    parameters, blocks, starts = nondifferentiable((parameters, blocks, starts))
    at_start = len(starts)

    @jax.jit  # for its shapes and in the loop traced once
    def at(theta):
        return simulated(key, parameters, blocks, theta, num_paths)

    def next_point(state):
        start = starts[jnp.minimum(state.i, at_start - 1)]
        starting = state.i < at_start
        tried = jnp.where(starting, start, state.theta + state.fraction * state.step)
        inside = parameters.allowed(tried)
        # Outside the constraint the model may not be simulated.
        made, old = at(jnp.where(inside, tried, starts[0])), state.simulated
        expected = jnp.where(starting, 0, 1e-4 * state.fraction * (old.gradient @ state.step))
        higher = made.value >= old.value + expected - jnp.where(starting, 0, old.rounding)
        fewer, as_many = made.num_missing < old.num_missing, made.num_missing == old.num_missing
        finite = all_finite_leaves(made._replace(pareto_k=made.rounding))  # k̂ need not be
        better = inside & finite & (fewer | (as_many & higher))
        theta, made = jax.tree.map(
            lambda new, old: jnp.where(better, new, old), (tried, made), (state.theta, old)
        )
        step = ascent_direction(made.gradient, made.information)
        gain = made.gradient @ step
        # A leap could end where weights are so uneven that ℓ̂ has maxima of its own.
        longest = longest_fraction(gain)
        fraction = jnp.where(better | starting, longest, state.fraction / 3).astype(theta.dtype)
        # The last point that was tried is better, or no shorter step would do.
        done = (state.i + 1 >= at_start) & ((gain < _GAIN) | (fraction < _SHORTEST * longest))
        return _Ascent(state.i + 1, theta, made, step, fraction, done)

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
    made = last.simulated
    offsets = allowed_offsets(parameters, last.theta, made.information)
    values = lax.map(
        lambda point: simulated_value(key, parameters, blocks, point, num_paths),
        (last.theta + offsets).reshape(-1, len(last.theta)),
    )
    rises = values.reshape(offsets.shape[:-1]) - made.value
    slope = Slope(made.gradient, made.covariance, made.information, rises)
    # Where weights are very uneven ℓ̂ has maxima of its own. By rounding a step may seem to lead
    # down that does not.
    found = is_maximum(slope) & (made.gradient @ last.step < 100 * _GAIN)
    return Maximum(last.theta, made, found, falls(slope, offsets))


@compiled_sooner
def stochastic_ascent(
    key: Key[Array, ""],
    parameters: Parameters,
    blocks: tuple[Block, ...],
    search: Search,
    theta: Float[Array, " p"],
) -> tuple[Float[Array, "n p"], SearchInfo]:
    """The optimiser's iterates along ∇ℓ̂ with new noise in each, and what was lost on the way."""
    rule = search.rule
    assert isinstance(rule, Gradient)
    parameters, blocks, theta = nondifferentiable((parameters, blocks, theta))
    num_intervals = sum(len(block.index) for block in blocks)

    def mean_log_likelihood(theta, key):
        value, missing = jnp.zeros((), theta.dtype), jnp.int32(0)
        for block_key, block in with_keys(key, blocks):
            made, found, _ = _log_weights(block_key, parameters, block, _FEW, theta)
            value += jnp.sum(_log_densities(made, found))
            missing += jnp.sum(~jnp.any(found, axis=1), dtype=jnp.int32)
        return value / num_intervals, missing

    def propose(i, theta, memory, _):
        gradient, missing = jax.jacfwd(mean_log_likelihood, has_aux=True)(
            theta, jax.random.fold_in(key, i)
        )
        return rule.ascend(theta, memory, gradient), None, (missing, jnp.int32(0))

    iterates, _, info = iterate(propose, parameters, search, theta, None)
    return iterates, info
