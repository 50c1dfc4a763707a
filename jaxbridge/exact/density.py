"""Transition densities by Monte Carlo: p_T(a, b) = E[w] over weighted proposals.

Unbiased on the natural scale, up to the step error, and so fit for pseudo-marginal
Metropolis–Hastings over the parameters of a model.
"""

import math
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int, Key

from ..coupling.start_laws import Reversed, Stationary
from ..engine.checks import Numbers, check_count, check_key
from ..engine.pareto import is_reliable, pareto_k
from ..engine.throwing import throw_where_incomplete
from ..models.diffusion import Diffusion, check_diffusion
from ..models.intervals import Intervals, as_intervals
from ..proposals.base import AbstractWeightedProposal
from ..proposals.choice import as_proposal, settled, singles, uses_couplings
from ..proposals.coupled import CoupledPairs
from ..schemes.step_error import StepError, dominates, is_gross, of_log_mean
from .kernels import sum_by_interval


class TransitionLogDensity(eqx.Module):
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
    - `num_nonfinite`: how many of them left the finite numbers.
    - `proposal`: what proposed; a `Stationary` that had to be run has its `burn_in` in it.
    - `pareto_k`: k̂ of the weights. Above 0.7 neither `value` nor `standard_error` can be trusted.
    - `step_error`: an estimate of what `value` is too large by for the length of the steps, with
        a standard error of it, `step_uncertainty`. NaN where it is not known, as of one step.
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

    @property
    def step_error_dominates(self) -> Bool[Array, "*I"]:
        """Whether the step error is beyond the standard error, or not known well enough to say:
        then more steps help, and more proposals do not."""
        error = StepError(self.step_error, self.step_uncertainty)
        return dominates(error, self.standard_error)

    @property
    def trustworthy(self) -> Bool[Array, "*I"]:
        """Whether `value` and `standard_error` are to be trusted: a mean that few large weights do
        not decide, no weight cut off, and a step error that does not dominate."""
        trusted = is_reliable(self.pareto_k, self.effective_sample_size) & (self.num_truncated == 0)
        return trusted & ~self.step_error_dominates & (self.num_met > 0)


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
        `ornstein_uhlenbeck` and `hyperbolic` are); with a start law that has a density, such as
        `fit_start_law(..., for_density=True)` finds, it need not be, for the constant of
        `log_stationary` cancels. Or `ModifiedDiffusionBridge()`,
        `ResidualBridge()` or `Guided()`, which need no stationary law; or "auto", which tries
        couplings only if the model is declared `normalised`; or what `choose_proposal` returns.
    - `num_counts`: N hitting counts for each proposal, by default one.
    - `max_trials`: bounds the trials of each proposal; by default 10,000 for each count.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.
    - `throw`: raise an error at run time where no proposal became a bridge, a weight was cut off,
        k̂ is above 0.7, the step error is above the standard error and 0.1, or parameters are not
        finite.

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
    check_diffusion(model)
    num_proposals = check_count("num_proposals", num_proposals)
    num_steps = check_count("num_steps", num_steps)
    intervals, batched, _ = as_intervals(start, end, duration)
    like = intervals.start[0]
    proposal = as_proposal(proposal, model, like, num_counts, None, max_trials, for_density=True)
    proposal.check(model, intervals)
    check_for_density(proposal, model)
    proposal = settled(proposal, key, model, intervals, num_steps)
    size = (num_proposals, num_steps, batched, progress_meter)
    estimate = estimate_log_density(key, model, proposal, intervals, *size)
    if not throw:
        return estimate
    error = StepError(estimate.step_error, estimate.step_uncertainty)
    return throw_where_incomplete(
        estimate,
        "value",
        model,
        estimate.num_met == 0,
        estimate.num_truncated > 0,
        coupled=uses_couplings(proposal),
        heavy=~is_reliable(estimate.pareto_k, estimate.effective_sample_size),
        gross=estimate.step_error_dominates & is_gross(error),
    )


def check_for_density(proposal: AbstractWeightedProposal, model: Diffusion) -> None:
    """Raise `ValueError` where the size of the weights of a proposal that may be used rests on
    what is not known.

    A coupling's weights have the factor ν(b)/ν(x_0) · μ(x_0), in which the constant of ν cancels if
    μ has a density of its own. From ν itself, and from the law that the paper prints, whose
    weights are taken to be those of ν, the factor is ν(b): in proportion to `log_stationary`.
    """
    pairs = [single for single in singles(proposal) if isinstance(single, CoupledPairs)]
    if pairs and not model.has_density:
        raise ValueError(
            "with couplings the transition density needs the stationary one: give `Diffusion` a "
            "`log_stationary`, normalised if the start law is `Stationary()`; or choose a "
            "proposal that does not need it, such as `ModifiedDiffusionBridge()` or `Guided()`."
        )
    stationary = [isinstance(pair.coupling.start_law, Stationary | Reversed) for pair in pairs]
    if any(stationary) and not model.normalised:
        raise ValueError(
            "a coupling from the stationary law gives densities in proportion to "
            "`log_stationary`, which is not declared to be normalised, so that they may be wrong "
            "by any factor: if it is normalised, for all parameters, say so by `Diffusion(..., "
            "normalised=True)`; otherwise give the coupling a start law with a density, "
            "`Coupling(..., start_law=fit_start_law(..., for_density=True))`, or choose "
            '`proposal="auto"` or one that is pulled to the end point, such as '
            "`ModifiedDiffusionBridge()` or `Guided()`."
        )


@eqx.filter_jit
def estimate_log_density(
    key: Key[Array, ""],
    model: Diffusion,
    proposal: AbstractWeightedProposal,
    intervals: Intervals,
    num_proposals: int,
    num_steps: int,
    batched: bool = True,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> TransitionLogDensity:
    """The estimates, for arguments that have been checked."""
    model, num_intervals = model.prepared(), intervals.start.shape[0]
    proposal = proposal.prepared(key, model, intervals, num_steps)
    fold_in = jax.vmap(jax.random.fold_in, in_axes=(None, 0))
    keys = fold_in(key, jnp.arange(num_intervals * num_proposals)).reshape(num_intervals, -1)
    nothing = jnp.zeros(0, jnp.int32)  # no path is kept
    drawn = proposal.draw(
        keys, model, intervals, num_steps, nothing, True, progress_meter=progress_meter
    )
    # Relative to the largest, so that sums of squares keep their digits.
    largest = lax.stop_gradient(jnp.max(drawn.log_weights, axis=1, keepdims=True))
    largest = jnp.where(largest > -jnp.inf, largest, 0)
    log_sum = logsumexp(drawn.log_weights - largest, axis=1)
    log_squares = logsumexp(2 * (drawn.log_weights - largest), axis=1)
    some = log_sum > -jnp.inf
    inverse_size = jnp.where(some, jnp.exp(log_squares - 2 * log_sum), jnp.inf)
    # The variance of the mean, in squares of the mean: (Σw²/(Σw)² - 1/n) n/(n-1).
    variance = jnp.maximum(inverse_size - 1 / num_proposals, 0)
    variance *= num_proposals / max(num_proposals - 1, 1)
    error = jnp.sqrt(variance) if num_proposals > 1 else jnp.full_like(variance, jnp.inf)
    known = some & ~jnp.any(drawn.truncated, axis=1)

    step_error = of_log_mean(
        drawn.log_weights, drawn.log_halving, proposal.step_share(model, intervals)
    )

    def of_interval(leaf):
        return leaf if batched else leaf[0]

    def total(leaf):
        return sum_by_interval(leaf, num_intervals, batched)

    return TransitionLogDensity(
        of_interval(log_sum + largest[:, 0] - math.log(num_proposals)),
        of_interval(jnp.where(known, error, jnp.inf)),
        of_interval(jnp.where(some, 1 / jnp.where(some, inverse_size, 1), 0)),
        total(drawn.found),
        total(drawn.truncated),
        total(drawn.num_simulated),
        total(drawn.num_nonfinite),
        proposal,
        of_interval(pareto_k(drawn.log_weights)),
        *map(of_interval, lax.stop_gradient(step_error)),
    )
