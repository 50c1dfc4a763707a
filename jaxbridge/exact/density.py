"""Transition densities by Monte Carlo: p_T(a, b) = E[w] over weighted proposals.

Unbiased on the natural scale, up to the step error, and so fit for pseudo-marginal
Metropolis–Hastings over the parameters of a model.
"""

import math
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.checks import Numbers, check_count, check_key
from ..engine.compiled import compiled_for
from ..engine.doors import door
from ..engine.pareto import pareto_k
from ..engine.verdict import (
    AbstractResult,
    Fault,
    Verdict,
    heavy_tails,
    lost_paths,
    missing_bridges,
    throw_where_untrustworthy,
    truncated_weights,
)
from ..models.bridge_problem import BridgeProblem, bridge_problem
from ..models.diffusion import Diffusion
from ..proposals import AbstractProposal, AbstractWeightedProposal, Budget, as_proposal, resolve
from ..schemes import StepError, dominates, step_fault, with_rounding


class TransitionLogDensity(AbstractResult):
    """What `transition_log_density` returns: estimates for one pair of points, shape (), or for I
    of them.

    - `value`: log p̂_T(a, b); `exp(value)` is unbiased. -inf where no proposal became a bridge.
    - `standard_error`: that of `value`, by the delta method; infinite where nothing is known, and
        where weights were cut off (`num_truncated`), for it would not tell by how much that shifts
        the estimate. Only to be trusted where `effective_sample_size` is large.
    - `effective_sample_size`: (Σw)²/Σw² over the proposals.
    - `num_met`: how many proposals became bridges.
    - `num_truncated`: how many of their weights were cut off by `max_trials`. Each makes the
        estimate too small on average; more trials, or a start law that hits sooner, avoid it.
    - `num_simulated`: paths simulated in all.
    - `num_nonfinite`: how many of them left the state space or the finite numbers. Their mass is
        missing, about -log(1 - share lost) of `value`, and more where weights are unequal. Where
        that may be beyond 5 % and beyond the standard error `value` is not `trustworthy`.
    - `proposal`: what proposed; a `Stationary` that had to be run has its `burn_in` in it.
    - `pareto_k`: k̂ of the weights. Above 0.7 neither `value` nor `standard_error` can be trusted.
    - `step_error`: an estimate of what `value` is too large by for the length of the steps, with
        a standard error of it, `step_uncertainty`; with it is what rounding may add where steps
        are very many, N d ε/2, ten thousand in single precision. NaN where it is not known, as of
        one step, or of couplings whose σ(x) varies: run two grids and `extrapolate`.
    - `step_share`: the step error as a share of what half as many steps change, infinite where that
        says little of it (couplings with a σ(x) that varies); `num_steps`: N.
    """

    value: Float[Array, "*I"]
    standard_error: Float[Array, "*I"]
    effective_sample_size: Float[Array, "*I"]
    num_met: Int[Array, "*I"]
    num_truncated: Int[Array, "*I"]
    num_simulated: Int[Array, "*I"]
    num_nonfinite: Int[Array, "*I"]
    proposal: AbstractWeightedProposal
    pareto_k: Float[Array, "*I"]
    step_error: Float[Array, "*I"]
    step_uncertainty: Float[Array, "*I"]
    step_share: Float[Array, "*I"]
    num_steps: int = eqx.field(static=True)

    @property
    def step_error_dominates(self) -> Bool[Array, "*I"]:
        """Whether the step error is beyond the standard error, or not known well enough to say:
        then more steps help, and more proposals do not."""
        return dominates(self._step_error, self.standard_error)

    @property
    def verdict(self) -> Verdict:
        """Return the faults: no bridge, weights cut off or with heavy tails, too many paths
        lost, a step error that dominates and is beyond 0.05."""
        verdict = Verdict((*self._weight_faults, step_fault(self._step_error, self.standard_error)))
        return verdict.with_finite(self.value, self.standard_error)

    @property
    def _weight_faults(self) -> tuple[Fault, ...]:
        sizes = self.effective_sample_size, self.num_met
        return (
            missing_bridges(self.num_met == 0, self.proposal.coupled),
            truncated_weights(self.num_truncated > 0),
            lost_paths(self.num_nonfinite, self.num_simulated, *sizes),
            heavy_tails(self.pareto_k, *sizes),
        )

    @property
    def _step_error(self) -> StepError:
        return StepError(self.step_error, self.step_uncertainty)


@door
def transition_log_density(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_proposals: int = 1000,
    num_steps: int = 50,
    proposal: Any = None,
    num_counts: int | None = None,
    max_trials: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = False,
) -> TransitionLogDensity:
    """An estimate of log p_T(a, b) with its standard error, for one pair or thousands.

    **Arguments:**

    - `key`, `model`, `start`, `end`, `duration`, `num_steps`: as in `sample_bridges`. The
        density is with respect to `end`, in units of space to the power -d.
    - `num_proposals`: for each interval. One that does not meet counts as zero.
    - `proposal`: a `Coupling`, with its start law; by default `Coupling(gamma=0.0)` if the model
        is declared `normalised`. With `Stationary()` and `Reversed()` it must be (those of
        `ornstein_uhlenbeck` and `hyperbolic` are), unless the model has no sampler, in whose
        place `Stationary()` takes a law with a density; with a start law that has a density,
        such as
        `fit_start_law(..., for_density=True)` finds, it need not be, for the constant of
        `log_stationary` cancels. Or `ModifiedDiffusionBridge()`,
        `ResidualBridge()` or `Guided()`, which need no stationary law; or "auto", which tries
        couplings only if the model is declared `normalised`; or what `choose_proposal` returns.
    - `num_counts`: N hitting counts for each proposal, by default one.
    - `max_trials`: bounds the trials of each proposal; by default 10,000 for each count.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.
    - `throw`: raise an error at run time where the result is not `trustworthy`, or parameters are
        not finite.

    **Returns:** `TransitionLogDensity`. With proposals that are pulled to the end point `value` is
    differentiable, forward and reverse: an estimate of the score. So it is with a choice between
    such proposals, by `choose_proposal` or, where that tries no couplings, by "auto". With
    couplings, and a choice that may take them, a derivative raises `TypeError`.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    **Example:**

    ```python
    law = jb.GaussianLaw([0.0, 0.0], jnp.eye(2))
    coupling = jb.Coupling(0.5, start_law=law)
    estimate = jb.transition_log_density(key, model, start, end, 1.0, proposal=coupling)
    estimate.value, estimate.standard_error
    ```
    """
    check_key(key)
    problem = bridge_problem(model, start, end, duration, num_steps)
    num_proposals = check_count("num_proposals", num_proposals)
    budget = Budget(num_counts, None, max_trials)
    proposal = as_proposal(proposal, model, problem.like, budget, for_density=True)
    proposal.check(model, problem.intervals)
    proposal.check_for_density(model)
    proposal = resolve(proposal, key, model, problem.intervals, num_steps)
    estimate = estimate_log_density(key, model, proposal, problem, num_proposals, progress_meter)
    return throw_where_untrustworthy(estimate, "value", model) if throw else estimate


@compiled_for(lambda key, model, proposal, problem, num, *_: problem.num_path_steps(num))
def estimate_log_density(
    key: Key[Array, ""],
    model: Diffusion,
    proposal: AbstractProposal,
    problem: BridgeProblem,
    num_proposals: int,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    held: bool = False,
) -> TransitionLogDensity:
    """The estimates, for arguments that have been checked; `held` if a pseudo-marginal chain is to
    hold on to them."""
    model, intervals, num_steps = model.prepared(), problem.intervals, problem.num_steps
    proposal = proposal.prepared(key, model, intervals, num_steps)
    nothing = jnp.zeros(0, jnp.int32)  # no path is kept
    drawn = proposal.draw(
        problem.keys(key, num_proposals),
        model,
        intervals,
        num_steps,
        nothing,
        True,
        progress_meter=progress_meter,
    )
    log_mean, error, size = log_mean_and_error(drawn.log_weights)
    cut = jnp.any(drawn.truncated, axis=1)
    share = proposal.share_in_regime(model, intervals, num_steps)
    varies = model.sigma_varies(problem.like)
    step_error = drawn.step_error(share, num_steps, varies, held)
    if proposal.by_coupling is None:  # weights of coupled pairs are no sums over steps
        step_error = with_rounding(step_error, num_steps, problem.like.shape[0])
    value, error, size, shape, step_error, share = problem.result(
        (
            log_mean,
            jnp.where(cut, jnp.inf, error),
            size,
            pareto_k(drawn.log_weights),
            lax.stop_gradient(step_error),
            share,
        )
    )
    return TransitionLogDensity(
        value,
        error,
        size,
        problem.total(drawn.found),
        problem.total(drawn.truncated),
        problem.total(drawn.num_simulated),
        problem.total(drawn.num_nonfinite),
        proposal,
        shape,
        step_error.value,
        step_error.uncertainty,
        share,
        num_steps,
    )


def log_mean_and_error(
    log_weights: Float[Array, "I n"],
) -> tuple[Float[Array, " I"], Float[Array, " I"], Float[Array, " I"]]:
    """The log of the mean of n weights, its standard error by the delta method, infinite where
    nothing is known, and their effective number."""
    n = log_weights.shape[1]
    # Relative to the largest, so that sums of squares keep their digits.
    largest = lax.stop_gradient(jnp.max(log_weights, axis=1, keepdims=True))
    largest = jnp.where(largest > -jnp.inf, largest, 0)
    log_sum = logsumexp(log_weights - largest, axis=1)
    log_squares = logsumexp(2 * (log_weights - largest), axis=1)
    some = log_sum > -jnp.inf
    inverse_size = jnp.where(some, jnp.exp(log_squares - 2 * log_sum), jnp.inf)
    # The variance of the mean, in squares of the mean. Σw²/(Σw)² - 1/n would be lost to rounding
    # where weights are nearly equal.
    log_mean = jnp.where(some, log_sum - math.log(n), 0)
    deviation = jnp.expm1(log_weights - largest - log_mean[:, None])
    variance = jnp.sum(deviation**2, axis=1) / n / max(n - 1, 1)
    error = jnp.sqrt(variance) if n > 1 else jnp.full_like(variance, jnp.inf)
    size = jnp.where(some, 1 / jnp.where(some, inverse_size, 1), 0)
    return log_sum + largest[:, 0] - math.log(n), jnp.where(some, error, jnp.inf), size
