"""Maximum likelihood from noisy or partial records.

Let ξ ~ N(0, I), and let w(θ, ξ) be the weight of its path at θ (`record_paths`). The likelihood is
L(θ) = E[w(θ, ξ)]. The law of ξ does not depend on θ. The identities of Fisher and of Louis
(1982) give:

    ∇ log L(θ) = E[∇ log w | y],    -∇² log L(θ) = -E[∇² log w | y] - Cov(∇ log w | y).

Means are over ξ given θ and the data, derivatives in θ. The identities hold for every step size.
They hold for parameters of the drift, of σ, of the noise and of the initial law.

*Search.* In each iteration chains of paths move given the current θ. The paths are converted to ξ,
and an optimiser moves θ along the mean of ∇ log w (Gu & Kong 1998). The paths change with θ.
Newton's method continues from the average of the second half of the iterates (`newton`). In its
passes the chains run with fixed θ.

*Differences of log L.* log L(θ + d) - log L(θ) is the log of the mean of w(θ + d) / w(θ) given the
data. It is estimated by the mean of the log ratio plus half its variance.

*Second derivatives.* ∇² log w is approximated by differences of ∇ log w at θ ± h e_j. Exact second
derivatives take three times as long to compile. The step h is a fraction of 1 / √D_j, where D_j is
the mean of -∂²_j log w. If ξ were observed, 1 / √D_j would be the standard error of θ_j.

*Discretisation error.* The error of the log-likelihood, e = log L_N - log L, is about a fixed
fraction of log L_{N/2} - log L_N. The error moves the maximum by I⁻¹ ∇e. Let w̃ be the weight with
half as many steps, and D_k the part of log w̃ / w that belongs to segment k. Then

    ∇ log L_{N/2} = E[(w̃ / w) ∇ log w̃ | y] / E[w̃ / w | y]
                  ≈ E[∇ log w̃ | y] + Cov(Σ_k (e^{D_k} - 1), ∇ log w̃ | y).
"""

from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.checks import all_finite_leaves, nondifferentiable
from ..engine.compiled import compiled_sooner
from ..engine.diagnostics import effective_size_of_chains, r_hat_of_chains
from ..engine.progress import metered_scan
from ..engine.verdict import AbstractResult, Fault, Verdict
from ..records import GuideCheck, Records, tuned
from ..schemes import StepError, dominates, step_faults, unknown_where
from .newton import (
    Passes,
    Slope,
    falls,
    is_maximum,
    maximum_faults,
    newton_passes,
)
from .parameters import Parameters
from .record_paths import GuidedTheta, RecordPaths, as_record_paths, movable, share_of_step_error
from .stochastic_approximation import Gradient, Search, SearchInfo, iterate

_CHAINS = 8
# Burn-in of the chains, in sweeps, before θ moves.
_SWEEPS = 50
# The step h of differences, as a fraction of 1 / √D_j; and the number of draws at a new θ that
# adapt h. They are discarded, because the chains are not yet in equilibrium.
_DIFFERENCE, _LEARNING = 0.05, 20

# With fewer draws than this share whose change by coarse steps is known, there is no step error.
_LEAST_KNOWN = 0.9
_MOST_R_HAT = 1.1
# R̂ is ignored if the Monte Carlo error is smaller than this fraction of a standard error: then
# rounding errors alone can make R̂ large.
_MATTERS = 0.01
_STUCK = "A block of a path never moved. Use more `num_bridges` or more steps."
_APART = "Chains of paths disagree (R̂ of the gradient above 1.1). Use more `num_bridges`."


class RecordMaximumLikelihood(AbstractResult):
    """Maximum likelihood estimate from noisy or partial records, from `maximum_likelihood`.

    - `params`: all parameters of the model, with estimates of the unknown ones.
    - `standard_errors`: pytree like the unknown parameters, from the observed information.
    - `monte_carlo_errors`: Monte Carlo errors of the search, in the same form. More `num_bridges`
        reduce them. In addition the search may stop 0.03 standard errors from the maximum.
    - `theta`, `covariance`: the estimate as a vector, shape (p,), and the inverse of the observed
        information, shape (p, p).
    - `step_error`, `step_uncertainty`: estimated discretisation bias of `theta` (estimate minus
        limit), shape (p,), and its standard error. NaN with one step, and if steps are too long.
    - `iterates`: iterates of the stochastic approximation, shape (n, p).
    - `gradient`: gradient of the log-likelihood at the last pass of Newton's method, before its
        step, shape (p,).
    - `effective_sample_size`, `r_hat`: those of the draws of the gradient, over the chains.
    - `stuck`: whether a block of a path never moved in the last pass, shape (chains,).
    - `num_refused`: number of iterations without a step, because it would have left the constraint
        or led to values that are not finite.
    - `newton`: whether Newton's method converged to a maximum. Then the next step is short compared
        with the standard errors or the Monte Carlo errors. Moreover the information is positive
        definite by a wide margin.
    - `fall`: decrease of the log-likelihood one standard error below and above the estimate in each
        parameter, with the others optimised to second order, shape (2, p). It is 0.5 for a
        quadratic log-likelihood. Values near or below zero show that there is no maximum inside;
        outside the constraint it is infinite.
    - `guide`: diagnostics of the guide of each record. A poor guide is a fault only if chains mix
        poorly, too.
    """

    params: PyTree
    standard_errors: PyTree
    monte_carlo_errors: PyTree
    theta: Float[Array, " p"]
    covariance: Float[Array, "p p"]
    step_error: Float[Array, " p"]
    step_uncertainty: Float[Array, " p"]
    iterates: Float[Array, "iterations p"]
    gradient: Float[Array, " p"]
    effective_sample_size: Float[Array, " p"]
    r_hat: Float[Array, " p"]
    stuck: Bool[Array, " chains"]
    num_refused: Int[Array, ""]
    newton: Bool[Array, ""]
    fall: Float[Array, "2 p"]
    guide: GuideCheck

    @property
    def verdict(self) -> Verdict:
        """Return the faults of the estimate, each with a remedy.

        - no maximum, or one at infinity;
        - a block of a path that never moved;
        - chains that disagree;
        - a poor guide, if also no maximum was found, a block never moved or chains disagree;
        - a discretisation error that is unknown, too uncertain, or larger than a standard error;
        - an estimate or covariance that is not finite.
        """
        sd = jnp.sqrt(jnp.diagonal(self.covariance))
        steps = step_faults(StepError(self.step_error, self.step_uncertainty), sd, sd)
        stuck, apart = jnp.any(self.stuck), self._chains_disagree
        return Verdict(
            (
                *maximum_faults(self.newton, self.fall),
                Fault(stuck, _STUCK),
                Fault(apart, _APART),
                self.guide.fault(stuck | apart | ~self.newton),
                *(fault.in_any() for fault in steps),
            )
        ).with_finite(self.theta, self.covariance)

    @property
    def _chains_disagree(self) -> Bool[Array, ""]:
        errors = ravel_pytree(self.monte_carlo_errors)[0]
        rounded = errors <= _MATTERS * jnp.sqrt(jnp.diagonal(self.covariance))
        return ~(jnp.all(self.r_hat < _MOST_R_HAT) | jnp.all(rounded))

    @property
    def step_error_dominates(self) -> Bool[Array, " p"]:
        """Return whether the discretisation error exceeds the standard error, or may do so.

        Shape (p,). If true, use more steps.
        """
        error = StepError(self.step_error, self.step_uncertainty)
        return dominates(error, jnp.sqrt(jnp.diagonal(self.covariance)))


class _Chains(NamedTuple):
    """Paths of all chains, and log β of the moves of the blocks of these paths."""

    paths: Float[Array, "chains R points d"]
    log_scales: Float[Array, "chains R 2 B"]


class _Draw(NamedTuple):
    """Values for one ξ.

    - `gradient`, `hessian`: ∇ log w and ∇² log w.
    - `change`, `coarse`: relative change of the likelihood by steps of twice the size, and ∇ log w̃.
    - `rises`: increases of log w from θ to 2p points around it.
    - `taken`: whether each block moved.
    """

    gradient: Float[Array, "*n p"]
    hessian: Float[Array, "*n p p"]
    change: Float[Array, "*n"]
    coarse: Float[Array, "*n p"]
    rises: Float[Array, "*n 2 p"]
    taken: Bool[Array, "*n R 2 B"]


def maximum_of_records(
    key: Key[Array, ""],
    parameters: Parameters,
    records: Records,
    theta: Float[Array, " p"],
    search: Search,
    num_draws: int,
) -> RecordMaximumLikelihood:
    """Return the estimate; Newton's method uses `num_draws` draws of each chain in each pass."""
    parameters.check_allowed(theta)
    run_key, last_key = jax.random.split(key)
    completion = as_record_paths(parameters, records, theta)
    iterates, chains, info = _approximate(run_key, completion, search, theta)
    rough = jnp.mean(iterates[len(iterates) // 2 :], axis=0)
    # A good guide at the first θ may be poor at the last one.
    completion = as_record_paths(parameters, records, rough)
    passes = _newton_from(last_key, completion, rough, chains, num_draws, search.progress_meter)
    return _summary(completion, iterates, info, passes)


def _of_chains(function: Callable, key: Key[Array, ""], *mapped: PyTree) -> PyTree:
    """Return `function(key, *arguments)` of each chain, with separate keys."""
    return jax.vmap(function)(jax.random.split(key, _CHAINS), *mapped)


def _sweep(
    key: Key[Array, ""],
    completion: RecordPaths,
    at: GuidedTheta,
    chains: _Chains,
    number: Int[Array, ""],
) -> tuple[_Chains, Bool[Array, "chains R 2 B"]]:
    """Return the chains after a sweep given θ, and whether each block moved.

    `number` counts the sweeps that adapt the scales of moves, from zero.
    """
    renewed = lambda key, *chain: completion.renewed(key, at, *chain)
    paths, accepted = _of_chains(renewed, key, *chains)
    log_scales = tuned(chains.log_scales, accepted, (number + 1).astype(at.theta.dtype))
    return _Chains(paths, log_scales), accepted[..., 0]


@compiled_sooner
def _approximate(
    key: Key[Array, ""], completion: RecordPaths, search: Search, theta: Float[Array, " p"]
) -> tuple[Float[Array, "n p"], _Chains, SearchInfo]:
    """Return the iterates of the stochastic approximation, and the last state of the chains."""
    completion = nondifferentiable(completion)
    first_key, run_key = jax.random.split(key)
    parameters, rule = completion.parameters, search.rule
    assert isinstance(rule, Gradient)
    num_observed = sum(completion.fine.records.num_times)

    def propose(i, theta, memory, chains):
        sweep_key, noise_key = jax.random.split(jax.random.fold_in(run_key, i))
        at = completion.at(theta)
        chains, _ = _sweep(sweep_key, completion, at, chains, i)
        read = lambda key, paths: completion.noise(key, at, paths)[0]
        noise = _of_chains(read, noise_key, chains.paths)
        # Per observation, so that one learning rate suits records of all lengths.
        gradient = jax.grad(_mean_log_weight)(theta, completion, noise) / num_observed
        new = rule.ascend(theta, memory, gradient)
        burnt_in = i >= _SWEEPS
        new_theta, new_memory = jax.tree.map(
            lambda new, old: jnp.where(burnt_in, new, old), new, (theta, memory)
        )
        # The same test as in `iterate`, so that paths change only if θ does.
        moves = parameters.allowed(new_theta) & all_finite_leaves(new_memory)
        goal = completion.at(jnp.where(moves, new_theta, theta))
        paths, log_weights = jax.vmap(lambda noise: completion.of_noise(goal, noise))(noise)
        # Keep the old paths where one of the new ones has no weight.
        good = jnp.all(jnp.isfinite(log_weights), axis=1)[:, None, None, None]
        chains = chains._replace(paths=jnp.where(good, paths, chains.paths))
        return (new_theta, new_memory), chains, (jnp.int32(0), jnp.int32(0))

    at_start = completion.at(theta)
    first = _Chains(*_of_chains(lambda key: completion.first(key, at_start), first_key))
    search = search._replace(num_iterations=_SWEEPS + search.num_iterations)
    iterates, chains, info = iterate(propose, parameters, search, theta, first)
    return iterates[_SWEEPS:], chains, info


def _mean_log_weight(
    theta: Float[Array, " p"], completion: RecordPaths, noise: Float[Array, "chains R points d"]
) -> Float[Array, ""]:
    """Return the mean of log w over the chains whose path has a finite log w."""
    at = completion.at(theta)
    values = jax.vmap(lambda noise: jnp.sum(completion.of_noise(at, noise)[1]))(noise)
    good = jnp.isfinite(values)
    return jnp.sum(jnp.where(good, values, 0)) / jnp.maximum(jnp.sum(good.astype(values.dtype)), 1)


@compiled_sooner
def _newton_from(
    key: Key[Array, ""],
    completion: RecordPaths,
    theta: Float[Array, " p"],
    chains: _Chains,
    num_draws: int,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> Passes:
    """Run Newton's method from θ, with `num_draws` draws of each chain in each pass."""
    completion, theta, chains = nondifferentiable((completion, theta, chains))

    def evaluate(i, theta, offsets, memory):
        where, key_of_pass = (theta, offsets, memory), jax.random.fold_in(key, i)
        result = _draws_at(key_of_pass, completion, *where, num_draws, progress_meter)
        draws, chains, h = result
        return _slope(draws, h), draws, (chains, h)

    h = jnp.where(theta == 0, 0.01, 0.01 * jnp.abs(theta))
    return newton_passes(evaluate, completion.parameters, theta, (chains, h))


def _draws_at(
    key: Key[Array, ""],
    completion: RecordPaths,
    theta: Float[Array, " p"],
    offsets: Float[Array, "2 p p"],
    start: tuple[_Chains, Float[Array, " p"]],
    num_draws: int,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> tuple[_Draw, _Chains, Float[Array, " p"]]:
    """Return draws of all chains at θ, with axes (chains, n), the last chains, and h."""
    p, here = len(theta), completion.at(theta)

    def derivatives(key, paths, accepted, h):
        noise, _ = completion.noise(key, here, paths)
        log_w = lambda theta, coarse: completion.either_log_weight(theta, noise, coarse)
        shifts = jnp.diag(h)
        zeros = jnp.zeros((2, p), h.dtype)
        around = theta + jnp.concatenate([zeros, shifts, -shifts, offsets.reshape(2 * p, p)])
        # Points: θ with fine steps, θ with coarse steps, θ ± h e_j, and θ + offsets.
        is_coarse = jnp.arange(4 * p + 2) == 1
        values, slopes = lax.map(lambda at: jax.value_and_grad(log_w)(*at), (around, is_coarse))
        hessian = (slopes[2 : 2 + p] - slopes[2 + p : 2 + 2 * p]) / (2 * h[:, None])
        hessian = (hessian + hessian.T) / 2
        rises = (values[2 + 2 * p :] - values[0]).reshape(2, p)
        change = completion.change_by_coarse_steps(theta, noise)
        return _Draw(slopes[0], hessian, change, slopes[1], rises, accepted)

    def draw(state, i):
        chains, h = state
        sweep_key, noise_key = jax.random.split(jax.random.fold_in(key, i))
        swept, accepted = _sweep(sweep_key, completion, here, chains, i)
        chains = chains._replace(paths=swept.paths)
        of_chain = lambda key, paths, taken: derivatives(key, paths, taken, h)
        draws = _of_chains(of_chain, noise_key, chains.paths, accepted)
        curvature = -jnp.diagonal(jnp.nanmean(draws.hessian, axis=0))
        return (chains, jnp.where(i < _LEARNING, _adapt_difference(h, curvature), h)), draws

    numbers = jnp.arange(_LEARNING + num_draws)
    (chains, h), draws = metered_scan(draw, start, numbers, progress_meter)
    # Discard the draws that adapt h; put chains before draws.
    draws = jax.tree.map(lambda leaf: jnp.moveaxis(leaf[_LEARNING:], 0, 1), draws)
    return draws, chains, h


def _adapt_difference(h: Float[Array, " p"], curvature: Float[Array, " p"]) -> Float[Array, " p"]:
    """Return the step h for this curvature. It changes by at most a factor of 8.

    If the curvature is zero or not finite, h is divided by 8.
    """
    target = _DIFFERENCE * lax.rsqrt(jnp.abs(curvature))
    return jnp.where(jnp.isfinite(target), jnp.clip(target, h / 8, h * 8), h / 8)


def _slope(draws: _Draw, h: Float[Array, " p"]) -> Slope:
    """Return log L near θ by the identities of Fisher and Louis.

    If h is off by more than a factor of 2, the information is NaN, and Newton's method does not use
    it.
    """
    p = len(h)
    gradients = draws.gradient.reshape(-1, p)
    gradient, spread = jnp.mean(gradients, axis=0), jnp.cov(gradients.T).reshape(p, p)
    curvature = -jnp.mean(draws.hessian, axis=(0, 1))
    is_adapted = jnp.all(
        jnp.abs(jnp.log(_adapt_difference(h, jnp.diagonal(curvature)) / h)) < jnp.log(2.0)
    )
    size = effective_size_of_chains(draws.gradient)
    # The geometric mean of both effective sample sizes stands in for that of a product.
    covariance = spread / jnp.sqrt(size[:, None] * size)
    information = jnp.where(is_adapted, curvature - spread, jnp.nan)
    return Slope(gradient, covariance, information, _rises(draws.rises))


def _rises(exponents: Float[Array, "chains n 2 p"]) -> Float[Array, "2 p"]:
    """Estimate the log of the mean of e^x by the mean of x plus half its variance.

    The result is at most the largest x. It is -inf if no x is finite.
    """
    finite = jnp.isfinite(exponents)
    number = jnp.sum(finite, axis=(0, 1)).astype(exponents.dtype)
    mean = jnp.sum(jnp.where(finite, exponents, 0), axis=(0, 1)) / jnp.maximum(number, 1)
    squares = jnp.where(finite, exponents - mean, 0) ** 2
    variance = jnp.sum(squares, axis=(0, 1)) / jnp.maximum(number, 1)
    largest = jnp.max(jnp.where(finite, exponents, -jnp.inf), axis=(0, 1))
    # The log of a mean of exponentials never exceeds the largest exponent.
    return jnp.minimum(mean + variance / 2, largest)


@compiled_sooner
def _summary(
    completion: RecordPaths, iterates: Float[Array, "n p"], info: SearchInfo, passes: Passes
) -> RecordMaximumLikelihood:
    """Return the estimate at the last θ of Newton's method, with its errors."""
    parameters, slope, draws = completion.parameters, passes.slope, passes.details
    covariance = jnp.linalg.inv(slope.information)
    # Delta method: an error of the score moves its zero by the inverse information times it.
    noise = covariance @ slope.covariance @ covariance
    stuck = jnp.any(
        movable(completion.fine.records) & ~jnp.any(draws.taken, axis=1), axis=(1, 2, 3)
    )
    monte_carlo = jnp.sqrt(jnp.diagonal(noise))
    # A block that never moved makes the draws, and so their spread, meaningless.
    monte_carlo = jnp.where(jnp.any(stuck), jnp.inf, monte_carlo)
    step_error = _step_error(completion, draws, covariance)
    return RecordMaximumLikelihood(
        parameters.full(passes.theta),
        parameters.each(jnp.sqrt(jnp.diagonal(covariance))),
        parameters.each(monte_carlo),
        passes.theta,
        covariance,
        *step_error,
        iterates,
        slope.gradient,
        effective_size_of_chains(draws.gradient),
        r_hat_of_chains(draws.gradient),
        stuck,
        info.refused,
        passes.converged & is_maximum(slope),
        falls(slope, passes.offsets),
        completion.fine.check,
    )


def _step_error(
    completion: RecordPaths, draws: _Draw, covariance: Float[Array, "p p"]
) -> StepError:
    """Estimate I⁻¹ ∇e, the discretisation error of the estimate, with its standard error."""
    if completion.fine.records.stacked.density.is_exact:
        return StepError(*2 * [jnp.zeros_like(draws.gradient[0, 0])])
    if completion.num_steps == 1:
        return StepError(*2 * [jnp.full_like(draws.gradient[0, 0], jnp.nan)])
    # A lost coarse path has no gradient.
    has_coarse = jnp.all(jnp.isfinite(draws.coarse), axis=-1)
    coarse = jnp.where(has_coarse[..., None], draws.coarse, draws.gradient)
    centred = coarse - jnp.mean(coarse, axis=(0, 1))
    is_known = jnp.isfinite(draws.change) & has_coarse
    change = jnp.where(is_known, draws.change - jnp.mean(draws.change, where=is_known), 0)
    errors = (coarse - draws.gradient + change[..., None] * centred) @ covariance
    errors = share_of_step_error(completion.fine.records) * errors
    size = effective_size_of_chains(errors)
    error = StepError(jnp.mean(errors, axis=(0, 1)), jnp.std(errors, axis=(0, 1)) / jnp.sqrt(size))
    return unknown_where(jnp.mean(is_known) < _LEAST_KNOWN, error)
