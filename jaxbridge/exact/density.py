"""Transition densities by Monte Carlo: p_T(a, b) = E[w], a mean over weighted proposals.

The estimate of p_T is unbiased up to the discretisation error. So it suits pseudo-marginal
Metropolis–Hastings over the parameters of a model.
"""

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.checks import Numbers, check_count, check_key
from ..engine.compiled import compiled_for
from ..engine.entry import public_entry
from ..engine.linalg import safe_norm
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
from ..proposals import (
    AbstractProposal,
    AbstractWeightedProposal,
    Budget,
    ProposalLike,
    as_proposal,
    resolve,
)
from ..schemes import StepError, dominates, step_faults, with_rounding
from .log_means import log_mean_and_error

# Smallest share of a sum of densities that counts in its diagnostics.
_NO_SHARE = 1e-3


class TransitionLogDensity(AbstractResult):
    """Result of `transition_log_density`: estimates for one pair of points, shape (), or for I
    pairs.

    - `value`: log p̂_T(a, b); `exp(value)` is unbiased up to the discretisation error. It is -inf if
        no proposal became a bridge.
    - `standard_error`: standard error of `value`, by the delta method. It is infinite if the
        weights do not determine it, or if weights were truncated (`num_truncated`), because it does
        not include the bias of the truncation. It is reliable only for a large
        `effective_sample_size`.
    - `effective_sample_size`: (Σw)²/Σw² over the proposals.
    - `num_met`: number of proposals that became bridges.
    - `num_truncated`: number of truncated weights (see `WeightedBridges.truncated`). They bias the
        estimate; with one count for each proposal it is too small on average. More `max_trials`, or
        a start law that hits sooner, avoid this.
    - `num_simulated`: number of simulated paths, proposals and trials.
    - `num_nonfinite`: number of these that left the state space or became non-finite. Their mass is
        missing from `value`: about `-log(1-s)` for a share s of lost paths, and more if weights are
        unequal. The result is not `trustworthy` if the missing mass may exceed 5 % and the standard
        error.
    - `proposal`: the proposal of the paths, with the start law of the weights. If this law is
        `Stationary` and needs runs, it contains their `burn_in`.
    - `pareto_k`: k̂ of the weights. Above 0.7 neither `value` nor `standard_error` is reliable
        (above 0.6 for very unequal weights, above 1 for nearly equal ones).
    - `step_error`: estimated discretisation bias of `value` (estimate minus limit). It is NaN if
        unknown: for one step, for steps longer than the relaxation time of the drift, and for
        couplings with a state-dependent σ(x) (use two grids and `extrapolate`) or with another
        meeting rule than `BrownianCrossing()`.
    - `step_uncertainty`: standard error of `step_error`. For guided proposals with very many steps
        (N d above about 17,000 in single precision) it includes the rounding error, N d ε/2.
    - `step_share`: the discretisation error divided by the change of the estimate under half as
        many steps. It is infinite if this change has no information about the error, as in the
        last three cases above.
    - `num_steps`: N.
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
        """Return whether the discretisation error is, or may be, larger than the standard error.

        If true, use more steps. If only the estimate of the error is uncertain, more proposals
        help, too; `why()` reports the reason. The result is also true if the error is unknown
        (`step_error` is NaN): for a coupling with a state-dependent σ(x) use two grids and
        `extrapolate`.
        """
        return dominates(self._step_error, self.standard_error)

    def total(self) -> "TransitionLogDensity":
        """Return log Σ p̂ over the I pairs of points, with its errors, as a result of shape ().

        On a circle this is the log density, if the end points are all `windings` of one point.
        Diagnostics and counts leave out pairs with less than a thousandth of the sum. The standard
        error is infinite if no proposal became a bridge for some pair.

        **Example:**

        ```python
        ends = jnp.array([[1.0, 0.0], [0.0, 1.0]])
        either = jb.transition_log_density(key, model, start, ends, 1.0, proposal=jb.Guided())
        either.total().value
        ```
        """
        value = logsumexp(self.value)
        some = value > -jnp.inf
        shares = jnp.where(some, jnp.exp(self.value - jnp.where(some, value, 0)), 0)
        counts = shares > _NO_SHARE

        def weighted(values):
            return jnp.where(counts, shares * values, 0)

        def number(counted):
            return jnp.sum(jnp.where(counts, counted, 0))

        inverse_size = jnp.sum(weighted(shares / jnp.where(counts, self.effective_sample_size, 1)))
        return TransitionLogDensity(
            value,
            # The share of a pair without a bridge is unknown.
            jnp.where(jnp.all(self.num_met > 0), safe_norm(weighted(self.standard_error)), jnp.inf),
            jnp.where(some, 1 / jnp.where(some, inverse_size, 1), 0),
            number(self.num_met),
            number(self.num_truncated),
            number(self.num_simulated),
            number(self.num_nonfinite),
            self.proposal,
            jnp.max(self.pareto_k, initial=-jnp.inf, where=counts),
            jnp.sum(weighted(self.step_error)),
            jnp.sum(weighted(self.step_uncertainty)),
            jnp.max(self.step_share, initial=0.0, where=counts),
            self.num_steps,
        )

    @property
    def verdict(self) -> Verdict:
        """Return the possible faults, as a `Verdict`:

        - no bridge;
        - truncated weights, weights with heavy tails, or an effective sample size below 20;
        - too many lost paths;
        - a discretisation error that is unknown or too uncertain, or that dominates and exceeds
            0.05;
        - a value or standard error that is not finite.
        """
        steps = step_faults(self._step_error, self.standard_error, coupled=self.proposal.coupled)
        verdict = Verdict((*self._weight_faults, *steps))
        return verdict.with_finite(self.value, self.standard_error)

    @property
    def _weight_faults(self) -> tuple[Fault, ...]:
        sizes = self.effective_sample_size, self.num_met
        return (
            missing_bridges(self.num_met == 0, self.proposal.coupled, "num_proposals"),
            truncated_weights(self.num_truncated > 0),
            lost_paths(self.num_nonfinite, self.num_simulated, *sizes),
            *heavy_tails(self.pareto_k, *sizes),
        )

    @property
    def _step_error(self) -> StepError:
        return StepError(self.step_error, self.step_uncertainty)


@public_entry
def transition_log_density(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_proposals: int = 1000,
    num_steps: int = 50,
    proposal: ProposalLike = None,
    num_counts: int | None = None,
    max_trials: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = False,
) -> TransitionLogDensity:
    """Estimate log p_T(a, b), with its standard error, for one pair of points or thousands.

    **Arguments:**

    - `key`, `model`, `start`, `end`, `duration`, `num_steps`: as in `sample_bridges`. The density
        is with respect to `end`, in units of space to the power -d.
    - `num_proposals`: number of proposals for each interval. A proposal that does not meet counts
        as zero.
    - `proposal`: a `Coupling`, with its start law; a guided proposal (`ModifiedDiffusionBridge()`,
        `ResidualBridge()` or `Guided()`), which needs no stationary law; "auto", which tries
        couplings only if the model has a time reversal and is declared `normalised`; or a result of
        `choose_proposal`. The default is `Coupling(gamma=0.0)`; see **Start laws** below.
    - `num_counts`: number of hitting counts for each proposal; by default one. Only for couplings.
    - `max_trials`: bound on the trials of each proposal; by default 10,000 for each count. Only for
        couplings.
    - `progress_meter`: a progress meter of diffrax, for instance `diffrax.TextProgressMeter()`.
    - `throw`: raise an error at run time if the result is not `trustworthy`, or if a parameter is
        not finite.

    **Start laws.** A coupling with `Stationary()` or `Reversed()` needs a model that is declared
    `normalised`, as `ornstein_uhlenbeck` and `hyperbolic` are. In two cases any `log_stationary`
    will do, because its constant cancels:

    - a start law with a density, such as one from `fit_start_law(..., for_density=True)`;
    - `Stationary()` without `burn_in` for a model without sampler, where a start law with a density
        replaces it.

    **Returns:** `TransitionLogDensity`. `value` is differentiable, in forward and reverse mode, for
    guided proposals; the derivative estimates the score. The same holds for a choice between such
    proposals, by `choose_proposal`, or by "auto" where it tries no couplings. For couplings, and
    for a choice that may select them, a derivative raises `TypeError`.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

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
    # A density needs the constant of ν, bridges do not.
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
    """Estimate log densities, for arguments that are already checked.

    `held` states that the estimate is the state of a pseudo-marginal chain. Such a chain prefers
    large estimates, so the weights have another law.
    """
    model, intervals, num_steps = model.prepared(), problem.intervals, problem.num_steps
    proposal = proposal.prepared(key, model, intervals, num_steps)
    no_steps = jnp.zeros(0, jnp.int32)  # no path is stored
    weighted_paths = proposal.draw(
        problem.keys(key, num_proposals),
        model,
        intervals,
        num_steps,
        no_steps,
        True,
        progress_meter=progress_meter,
    )
    log_mean, error, size = log_mean_and_error(weighted_paths.log_weights)
    # One truncated weight biases the whole mean, so the standard error becomes infinite.
    is_truncated = jnp.any(weighted_paths.truncated, axis=1)
    share = proposal.share_in_regime(model, intervals, num_steps)
    varies = model.sigma_varies(problem.like)
    step_error = weighted_paths.step_error(share, num_steps, varies, held)
    # Log weights of guided proposals are sums over steps, whose rounding errors add up. Weights of
    # couplings are counts.
    if proposal.by_coupling is None:
        step_error = with_rounding(step_error, num_steps, problem.like.shape[0])
    value, error, size, k_hat, step_error, share = problem.result(
        (
            log_mean,
            jnp.where(is_truncated, jnp.inf, error),
            size,
            pareto_k(weighted_paths.log_weights),
            # An error estimate is a diagnostic: it has no derivative.
            lax.stop_gradient(step_error),
            share,
        )
    )
    return TransitionLogDensity(
        value,
        error,
        size,
        problem.total(weighted_paths.found),
        problem.total(weighted_paths.truncated),
        problem.total(weighted_paths.num_simulated),
        problem.total(weighted_paths.num_nonfinite),
        proposal,
        k_hat,
        step_error.value,
        step_error.uncertainty,
        share,
        num_steps,
    )
