"""Particle-marginal Metropolis–Hastings over any parameters, including those of σ.

The likelihood of exact observations is a product of transition densities, and weighted proposals
estimate it without bias (`exact.density`). The chain accepts with the ratio of estimates and stores
the estimate of its state. Its law is the exact posterior up to the discretisation error (Andrieu &
Roberts 2009).

Proposals of θ are normal random walks. The warm-up adapts their covariance S Sᵀ to the acceptance
rates (`parameter_walk`). After the warm-up it is fixed.
"""

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.checks import (
    Numbers,
    check_count,
    check_key,
    nondifferentiable,
)
from ..engine.compiled import compiled_sooner
from ..engine.entry import public_entry
from ..engine.keys import key_for
from ..engine.linalg import matvec
from ..engine.progress import metered_stages
from ..engine.verdict import Fault, lost_share
from ..exact import acceptance_rate
from ..models.diffusion import Diffusion
from ..models.jumps import JumpsLike
from ..proposals import AbstractWeightedProposal, Budget, ProposalLike
from ..records import AbstractObservation, GuideCheck, Initial, as_record_problems
from .blocks import Block, block_of, make_blocks
from .checkpoint import resumable
from .data import Problem, as_problem
from .likelihood_estimates import (
    AbstractLikelihood,
    Estimate,
    Guide,
    RecordLikelihood,
    TransitionLikelihood,
)
from .parameter_walk import adapt_covariance, first_root
from .parameters import Constraint, Parameters, as_parameters, theta_of_model
from .posterior import (
    AbstractPosterior,
    Combination,
    average,
    check_covariance_is_used,
    check_likelihood_was_found,
    first_chain,
    last,
    over_chains,
    posterior_fields,
    refused_moves,
    starting_points,
    thinned_step_errors,
    total,
)
from .priors import GivenDensity, NormalDensity, Prior, as_log_prior
from .record_paths import check_no_bridges, check_no_record, unguided
from .warm_up import stages

# Limits of the variance of the log-likelihood estimates, and of the truncated weights per draw.
_MOST_VARIANCE, _MOST_TRUNCATED = 5.0, 0.01
_NOISY = (
    "The variance of the log-likelihood estimates (`log_likelihood_variance`) is above 5, so the "
    "chain stays long at large estimates. Use more `num_proposals`, or a better `proposal`."
)
_TRUNCATED = (
    "`max_trials` truncated more than one weight in 100 draws, so the law is not exact. Increase "
    "`max_trials`, or use another `proposal`."
)
_NOISY_IN_PART = (
    "For 10 % of the draws the variance of the log-likelihood estimates is above 5. A chain rarely "
    "enters such regions and then stays long, so it may have missed a tail, and errors are too "
    "small. Use more `num_proposals`."
)
# Number of likely θ at which pilot runs tune the estimator of the likelihood.
_NUM_LIKELY = 8


class _Chain(NamedTuple):
    """State of a chain inside the loop: θ, the estimate at θ with its variance, and S."""

    theta: Float[Array, "*chains p"]
    log_likelihood: Float[Array, "*chains"]
    variance: Float[Array, "*chains"]
    log_step_error: Float[Array, "*chains"]
    root: Float[Array, "*chains p p"]


class PMMHState(NamedTuple):
    """State of a chain of `pmmh`. Several chains have a leading axis.

    - `theta`: θ, shape (p,).
    - `log_likelihood`: estimate at this state, shape ().
    - `variance`, `log_step_error`: its variance and its discretisation error, shape ().
    - `root`: S of the covariance S Sᵀ of proposals, shape (p, p).
    - `num_done`: number of iterations so far, with the warm-up. A continued chain with the same key
        uses the subsequent random numbers.
    - `proposals`: chosen proposals of the paths, one per group of intervals with the same number of
        steps; empty with an `observation`.
    - `guide`: guide of the particle filters, from the warm-up; `None` without an `observation`.
    """

    theta: Float[Array, "*chains p"]
    log_likelihood: Float[Array, "*chains"]
    variance: Float[Array, "*chains"]
    log_step_error: Float[Array, "*chains"]
    root: Float[Array, "*chains p p"]
    num_done: Int[Array, ""]
    proposals: tuple[AbstractWeightedProposal, ...]
    guide: Guide | None


class PMMHPosterior(AbstractPosterior):
    """Posterior draws of the unknown parameters, from `pmmh`.

    Arrays have a leading axis of chains if there are several.

    - `params`: all parameters of the model, each with leading axes (*chains, n).
    - `theta`: the unknown parameters as vectors, shape (*chains, n, p).
    - `names`: names of the entries of θ, for instance "alpha" or "B[0,1]". The keys of a dictionary
        are in alphabetical order.
    - `log_likelihood`: the likelihood estimates of the chain's states, shape (*chains, n).
    - `log_likelihood_variance`: variance of these estimates given θ, median over the draws, shape
        (*chains,). It is the sum over intervals (or records) of the estimated variances of log p̂,
        and too small if weights have heavy tails. It should be about 1.
        - Above 3 the chain stays long at large estimates: increase `num_proposals` in proportion,
          or use a better `proposal`.
        - Far below 1 fewer proposals make iterations cheaper.
        - It is infinite with a single proposal, or if weights were truncated in most draws.
    - `variance_in_part`: 90 % quantile of this variance over the draws, shape (*chains,).
    - `log_step_error`: estimated discretisation error of each estimate, shape (*chains, n). NaN at
        draws where it was not computed. `step_error`, that of the posterior mean, is computed from
        it.
    - `sigma_varies`: whether σ depends on the state.
    - `accepted`: whether the proposed parameters were accepted, shape (*chains, n).
    - `num_without_estimate`: number of iterations, with the warm-up, that rejected the proposed
        parameters for lack of an estimate, shape (*chains,). Couplings count iterations in which no
        pair met, too; this is an estimate of zero, and the law remains exact.
    - `num_truncated`: number of weights that `max_trials` truncated in all iterations, shape
        (*chains,), with those of the warm-up. With many of them the law is not exact.
    - `state`: last state; pass it as `init`, with `num_warmup=0`, to continue.
    - `guide`: diagnostics of the last guide of each record, from the warm-up; `None` without an
        `observation`. A poor guide is a fault only if the chain mixes poorly, too.
    - `share_lost`: fraction of the paths that diverged or left the state space, shape (*chains,):
        the mean over intervals and over the estimates after the warm-up, weighted by their
        acceptance probabilities. With an `observation` it is the total number of lost particles
        divided by `num_proposals`. Above 2 % it is a fault, because 5 % of the probability mass may
        then be missing.
    """

    params: PyTree
    theta: Float[Array, "*chains n p"]
    names: tuple[str, ...] = eqx.field(static=True)
    log_likelihood: Float[Array, "*chains n"]
    log_likelihood_variance: Float[Array, "*chains"]
    variance_in_part: Float[Array, "*chains"]
    log_step_error: Float[Array, "*chains n"]
    sigma_varies: bool = eqx.field(static=True)
    accepted: Bool[Array, "*chains n"]
    num_without_estimate: Int[Array, "*chains"]
    num_truncated: Int[Array, "*chains"]
    state: PMMHState
    guide: GuideCheck | None = None
    share_lost: Float[Array, "*chains"] | None = None

    _combinations: ClassVar[dict[str, Combination]] = {
        "log_likelihood_variance": average,
        "variance_in_part": average,
        "num_without_estimate": total,
        "num_truncated": total,
        "share_lost": average,
        "state": last,
        "guide": last,
    }
    _continued_with: ClassVar[dict[str, Any]] = {"num_warmup": 0, "covariance": None}

    @property
    def stuck(self) -> Bool[Array, "*chains"]:
        """Return whether a chain never moved, shape (*chains,).

        Then its draws do not represent the posterior, `effective_sample_size` is zero, and
        `standard_error` is infinite.
        """
        return ~jnp.any(self.accepted, axis=-1)

    @property
    def _stuck(self):
        return self.stuck

    @property
    def _faults(self):
        noisy = ~jnp.all(self.log_likelihood_variance < _MOST_VARIANCE)
        share = self.num_truncated.astype(self.theta.dtype) / self.accepted.shape[-1]
        often = jnp.any(share > _MOST_TRUNCATED)
        in_part = ~noisy & ~jnp.all(self.variance_in_part < _MOST_VARIANCE)
        refused, lost = refused_moves(self.accepted), self.share_lost
        mixes_poorly = noisy | in_part | refused.present | jnp.any(self.stuck)
        return (
            refused,
            *(() if self.guide is None else (self.guide.fault(mixes_poorly),)),
            Fault(noisy, _NOISY),
            Fault(in_part, _NOISY_IN_PART),
            Fault(often, _TRUNCATED),
            *(() if lost is None else (lost_share(jnp.max(lost)),)),
        )


@public_entry
@resumable
def pmmh(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    prior: Prior,
    num_iterations: int = 1000,
    num_warmup: int = 500,
    num_proposals: int = 50,
    num_steps: int | None = None,
    step_size: float | None = None,
    proposal: ProposalLike = "auto",
    where: Callable[[PyTree], PyTree] | None = None,
    constraint: Constraint | None = None,
    covariance: Numbers | None = None,
    num_chains: int | None = None,
    thin: int = 1,
    init: PyTree | PMMHState = None,
    observation: AbstractObservation | None = None,
    initial: Initial = None,
    initial_time: Numbers | None = None,
    jumps: JumpsLike = None,
    num_counts: int | None = None,
    max_trials: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    checkpoint: str | os.PathLike | None = None,
) -> PMMHPosterior:
    """Sample from the posterior of any parameters of a model, including those of σ.

    **Arguments:**

    - `key`: typed key.
    - `model`: the diffusion. Chains start from its `params`.
    - `times`, `observations`, `prior`, `num_iterations`, `num_steps`, `step_size`, `where`,
        `constraint`, `num_chains`, `thin`: as in `gibbs`. Parameters of σ may be unknown, too. Use
        `constraint` to exclude parameters for which σ is not invertible.
    - `num_warmup`: number of iterations of the warm-up, which adapts the covariance of the
        proposals of θ.
    - `num_proposals`: weighted paths per interval in each estimate. Choose it such that
        `log_likelihood_variance` of the result is about 1; it must grow in proportion to the number
        of intervals.
    - `proposal`: as in `transition_log_density`, but "auto" by default. Couplings that start from
        the stationary law need a normalised `log_stationary`, because its constant depends on the
        parameters.
    - `covariance`: covariance of the first proposals of θ, shape (p,) for a diagonal or (p, p), in
        the order of the result's `names`, which is that of `jax.tree.leaves(params)`. By default
        their standard deviations are a tenth of those of the prior, or a tenth of |θ| (at least
        0.01) if the prior is not normal. With an `observation` the default follows the width of the
        likelihood.
    - `init`: unknown parameters to start from, or the `state` of earlier draws. A continued chain
        uses the proposals of paths and the guide that the state stores. The proposals keep their
        bounds, so omit `num_counts` and `max_trials`. A `proposal` other than "auto" replaces the
        stored proposals, except in the stored estimate.
    - `observation`, `initial`, `initial_time`, `jumps`: observation model, initial law and jumps of
        a noisy or partial record, as in `innovations`. By default observations are exact and
        complete. `num_proposals` is then the number of particles, and a small number suffices. The
        warm-up finds the guide, and its discount rate by pilot runs. If parameters of the noise are
        unknown, make them parameters of the model, and `covariance` of `LinearGaussian` a function
        of them.
    - `num_counts`, `max_trials`: as in `transition_log_density`; not with an `observation`.
    - `progress_meter`, `checkpoint`: as in `gibbs`.

    **Returns:** `PMMHPosterior`. Not differentiable.

    **Raises:** `ValueError` and `TypeError` for invalid arguments; `ValueError` if a chain never
    reaches parameters with a finite log-likelihood.

    **Example:**

    ```python
    posterior = jb.pmmh(
        key, jb.ornstein_uhlenbeck([[1.0]], sigma=[[0.5]]), times, observations[:, :1],
        where=lambda params: (params.B, params.sigma), prior=jb.NormalPrior(1.0, 1.0),
        constraint=lambda unknown: (unknown[0][0, 0] > 0) & (unknown[1][0, 0] > 0),
        num_iterations=200, num_warmup=100,
    )
    posterior.theta.mean(0), posterior.accepted.mean()
    ```
    """
    num_iterations, thin = check_count("num_iterations", num_iterations), check_count("thin", thin)
    num_warmup = check_count("num_warmup", num_warmup, 0)
    num_proposals = check_count("num_proposals", num_proposals)
    parameters = as_parameters(model, where, constraint, prior)
    check_key(key)
    pilot_key, run_key = jax.random.split(key)
    if observation is None:
        check_no_record(initial=initial, initial_time=initial_time, jumps=jumps)
        problem = as_problem(key, parameters, times, observations, num_steps, step_size)
        unknown = problem.theta

        def first_likelihood(model: Diffusion, state: PMMHState | None) -> AbstractLikelihood:
            budget = Budget(num_counts, None, max_trials)
            if state is not None and isinstance(proposal, str) and proposal == "auto":
                budget.refuse(
                    "for a new start, because the proposals of a state as `init` have their own"
                )
                blocks = _blocks_of_state(state, problem, model)
            else:
                blocks = make_blocks(pilot_key, model, problem, proposal, budget, "density")
            return TransitionLikelihood(blocks, num_proposals)

    else:
        check_no_bridges(proposal=proposal, num_counts=num_counts, max_trials=max_trials)
        records = as_record_problems(
            model,
            times,
            observations,
            observation,
            initial,
            num_steps=num_steps,
            step_size=step_size,
            initial_time=initial_time,
            jumps=jumps,
        )
        unknown = theta_of_model(parameters, records.stacked.like.dtype)

        def first_likelihood(model: Diffusion, state: PMMHState | None) -> AbstractLikelihood:
            grids = unguided(records), unguided(records.coarsened())
            no_rate = jnp.zeros((), unknown.dtype)  # a placeholder until the pilot runs
            likelihood = RecordLikelihood(*grids, no_rate, num_proposals)
            return likelihood if state is None else _guided_by_state(likelihood, state)

    log_prior = as_log_prior(prior, parameters, unknown)
    root = first_root(covariance, log_prior, unknown)
    theta, state = starting_points(parameters, unknown, init, num_chains, log_prior, PMMHState)
    check_covariance_is_used(covariance, state)
    likelihood = first_likelihood(parameters.bind(first_chain(theta)), state)
    sampler = _Sampler(parameters, likelihood, log_prior)
    start = (theta, root) if state is None else state
    size = (num_warmup, num_iterations, thin)
    posterior = _run(run_key, sampler, start, size, covariance is None, progress_meter)
    check_likelihood_was_found(jnp.all(posterior.log_likelihood == -jnp.inf, axis=-1))
    return replace(posterior, state=posterior.state._replace(proposals=likelihood.proposals))


def _blocks_of_state(
    state: PMMHState, problem: Problem, pilot_model: Diffusion
) -> tuple[Block, ...]:
    """Return blocks of the intervals with the proposals of earlier draws.

    **Raises:** `ValueError` if the proposals are for other intervals.
    """
    groups = problem.groups
    if len(state.proposals) != len(groups):
        raise ValueError(
            f"`init` is a state of other data: that run had {len(state.proposals)} groups of "
            f"intervals (0: it had an `observation`), and these data have {len(groups)}. Pass the "
            "data, `observation`, `num_steps` and `step_size` of that run, or start values of the "
            "unknown parameters as `init`."
        )
    for group, proposal in zip(groups, state.proposals, strict=True):
        proposal.check(pilot_model, group.intervals)
        proposal.check_for_density(pilot_model)
    return tuple(map(block_of, groups, state.proposals))


def _guided_by_state(likelihood: RecordLikelihood, state: PMMHState) -> RecordLikelihood:
    """Return the likelihood with the guide of earlier draws.

    **Raises:** `ValueError` if the guide is for other records.
    """
    shapes = [jax.tree.map(jnp.shape, guide) for guide in (state.guide, likelihood.guide)]
    if state.guide is None or shapes[0] != shapes[1]:
        raise ValueError(
            "`init` is a state of other records: pass the data, `observation`, `initial_time`, "
            "`jumps`, `num_steps` and `step_size` of that run, or start values of the unknown "
            "parameters as `init`."
        )
    return likelihood.guided_by(state.guide)


class PMMHInfo(NamedTuple):
    """Counts of one iteration, or their sums over iterations.

    - `accepted`: 1 if the proposed θ was accepted.
    - `num_without_estimate`: 1 if it was rejected for lack of an estimate.
    - `num_truncated`: number of truncated weights.
    - `acceptance`: acceptance probability; zero in the warm-up.
    - `share_lost`: share of lost paths times `acceptance`; zero in the warm-up.
    """

    accepted: Int[Array, "*chains"]
    num_without_estimate: Int[Array, "*chains"]
    num_truncated: Int[Array, "*chains"]
    acceptance: Float[Array, "*chains"]
    share_lost: Float[Array, "*chains"]


class _Run(NamedTuple):
    """State of the loop.

    - `chain`, `guide`: state of the chains, and the guide of their likelihood.
    - `num_done`: number of iterations so far, with those of earlier calls.
    - `counted`: counts of the iterations of this call.
    """

    chain: _Chain
    guide: Guide | None
    num_done: Int[Array, ""]
    counted: PMMHInfo


class _Sampler(eqx.Module):
    """Constants of the sampler, and the steps of one chain."""

    parameters: Parameters
    likelihood: AbstractLikelihood
    log_prior: NormalDensity | GivenDensity

    def near(self, key: Key[Array, ""], chain: _Chain) -> "_Sampler":
        """Return the sampler with a likelihood that is tuned at the current θ of the chains.

        The likelihood is linearised at θ of the first chain, and pilot runs at likely θ tune it.
        """
        walk_key, pilot_key = jax.random.split(key)
        around = self._likely(walk_key, chain)
        theta = first_chain(chain.theta)
        likelihood = self.likelihood.near(pilot_key, self.parameters.bind, theta, around)
        return _Sampler(self.parameters, likelihood, self.log_prior)

    def _likely(self, key: Key[Array, ""], chain: _Chain) -> Float[Array, "n p"]:
        """Sample θ that are about as likely as those of the chains.

        Proposals have the width of the posterior times 2.4 / √p (Roberts & Rosenthal 2001).
        """
        p = chain.theta.shape[-1]
        theta, root = chain.theta.reshape(-1, p), chain.root.reshape(-1, p, p)
        which = jnp.arange(_NUM_LIKELY) % len(theta)
        noise = jax.random.normal(key, (_NUM_LIKELY, p), theta.dtype)
        # √p / 2 is about √p / 2.4, so the moves are about as wide as the posterior.
        wide = (np.sqrt(p) / 2).astype(theta.dtype) * jax.vmap(matvec)(root[which], noise)
        likely = theta[which] + wide
        allowed = jax.vmap(self.parameters.allowed)(likely)
        return jnp.where(allowed[:, None], likely, theta[which])

    def likely_root(self, chain: _Chain) -> Float[Array, "*chains p p"]:
        """Return S of all chains, with the width of the likelihood at θ of the first chain."""
        theta, root = first_chain(chain.theta), chain.root
        one = root.reshape(-1, *root.shape[-2:])[0]
        likely = self.likelihood.likely_root(self.parameters, self.log_prior, theta, one)
        return jnp.broadcast_to(likely, root.shape)

    def estimate(self, key: Key[Array, ""], theta: Float[Array, " p"]) -> Estimate:
        return self.likelihood.estimate(key, self.parameters.bind(theta))

    def log_step_error(self, key: Key[Array, ""], theta: Float[Array, " p"]) -> Float[Array, ""]:
        return self.likelihood.log_step_error(key, self.parameters.bind(theta))

    def start(
        self, key: Key[Array, ""], start: tuple[Float[Array, " p"], Float[Array, "p p"]]
    ) -> _Chain:
        theta, root = start
        return _Chain(theta, *self.estimate(key, theta)[:3], root)

    def step(
        self,
        key: Key[Array, ""],
        state: _Chain,
        number: Int[Array, ""],
        learning: Bool[Array, ""],
    ) -> tuple[_Chain, PMMHInfo]:
        """Make the step with this number, counted from one; S is adapted if `learning`."""
        walk_key, estimate_key, accept_key = jax.random.split(key, 3)
        noise = jax.random.normal(walk_key, state.theta.shape, state.theta.dtype)
        proposed = state.theta + state.root @ noise
        inside = self.parameters.allowed(proposed)
        # Outside the constraint the simulation may fail: simulate at the old θ, and reject.
        proposed = jnp.where(inside, proposed, state.theta)
        estimate = self.estimate(estimate_key, proposed)
        new = jnp.where(inside, estimate.log_likelihood + self.log_prior(proposed), -jnp.inf)
        rate = acceptance_rate(state.log_likelihood + self.log_prior(state.theta), new)
        # A comparison with NaN is false, so a NaN rate rejects.
        accepted = jax.random.uniform(accept_key, dtype=rate.dtype) < rate
        root = adapt_covariance(state.root, noise, rate, number, learning)
        candidate = _Chain(proposed, *estimate[:3], root)
        # Outside the constraint no estimate was needed.
        without = inside & (estimate.log_likelihood == -jnp.inf)
        chain = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), candidate, state)
        count = lambda which: which.astype(jnp.int32)
        # Weighted by acceptance: explosions at improbable θ do not affect the posterior.
        weight = jnp.where(learning, 0, rate)
        lost = jnp.where(weight > 0, weight * estimate.share_lost, 0)
        info = PMMHInfo(count(accepted), count(without), estimate.num_truncated, weight, lost)
        return chain._replace(root=root), info


@compiled_sooner
def _run(
    key: Key[Array, ""],
    sampler: _Sampler,
    start: tuple[Float[Array, "*chains p"], Float[Array, "p p"]] | PMMHState,
    size: tuple[int, int, int],
    finds_root: bool,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> PMMHPosterior:
    """Run the warm-up and the draws of all chains.

    - `start`: initial θ and the root S of its first moves, or the state of earlier draws.
    - `size`: (number of warm-up iterations, number of draws, iterations per draw).
    - `finds_root`: whether S is replaced by one with the width of the likelihood.
    """
    sampler, start = nondifferentiable((sampler, start))
    fresh = not isinstance(start, PMMHState)
    num_warmup, num_iterations, thin = size
    # The warm-up is measured in draws, too, so that one loop serves both.
    skipped = -(-num_warmup // thin)
    guide = sampler.likelihood.guide
    state = _initial_state(guide, *start) if fresh else _continued_state(start)

    def begin(run, i):
        if not fresh:
            return run, sampler
        near = sampler
        if guide is not None:
            # Named keys do not collide with the numbered keys of the iterations.
            pilot_key = jax.random.fold_in(key_for("pilots", key), run.num_done)
            near = sampler.near(pilot_key, run.chain)
            if finds_root:
                likely_root = lambda chain: near.likely_root(chain)  # `cond` hashes it
                root = lax.cond(i == 0, likely_root, lambda chain: chain.root, run.chain)
                run = run._replace(chain=run.chain._replace(root=root))
        # Estimate anew: a high estimate with the old, poorer guide could block the chain.
        first_key = jax.random.fold_in(key, -run.num_done)  # iterations have positive numbers
        chain = over_chains(near.start, first_key, (run.chain.theta, run.chain.root))
        return run._replace(chain=chain, guide=near.likelihood.guide), near

    def log_step_error(near, i, run):
        """Return the discretisation error of the stored estimates.

        If the estimates do not contain it, it is estimated for some of the draws.
        """
        if near.likelihood.tells_step_error:
            return run.chain.log_step_error
        own_key = jax.random.fold_in(key_for("step error", key), run.num_done)
        function = lambda theta: over_chains(near.log_step_error, own_key, theta)
        return thinned_step_errors(function, run.chain.theta, i - skipped, num_iterations)

    def draw(near, run, i):
        def iterate(run, i):
            step = lambda key, chain: near.step(key, chain, i + 1, i < num_warmup)
            number = run.num_done + 1
            # Numbered keys, so that a continued chain uses the subsequent random numbers.
            chain, info = over_chains(step, jax.random.fold_in(key, number), run.chain)
            counted = jax.tree.map(lambda so_far, one: so_far + one, run.counted, info)
            return _Run(chain, run.guide, number, counted), info.accepted

        run, accepted = lax.scan(iterate, run, i * thin + jnp.arange(thin, dtype=i.dtype))
        held = run.chain._replace(root=None, log_step_error=log_step_error(near, i, run))
        return run, (held, jnp.any(accepted > 0, axis=0))

    # Only the warm-up of new chains with guides has stages.
    to_guide = skipped if fresh and guide is not None else 0
    bounds = stages(to_guide, skipped + num_iterations)
    run, draws = metered_stages(begin, draw, state, bounds, num_iterations, progress_meter)
    held, accepted = draws
    values = (held.log_likelihood, held.log_step_error, accepted)
    fields, values = posterior_fields(sampler.parameters, held.theta, *values)
    log_likelihood, log_step_errors, accepted = values
    return PMMHPosterior(
        **fields,
        log_likelihood=log_likelihood,
        log_likelihood_variance=jnp.median(held.variance, axis=0),
        # No interpolation: between infinite variances it gives NaN.
        variance_in_part=jnp.quantile(held.variance, 0.9, axis=0, method="lower"),
        log_step_error=log_step_errors,
        sigma_varies=sampler.parameters.model.sigma_varies(sampler.likelihood.like),
        accepted=accepted,
        num_without_estimate=run.counted.num_without_estimate,
        num_truncated=run.counted.num_truncated,
        state=PMMHState(
            **run.chain._asdict(), num_done=run.num_done, proposals=(), guide=run.guide
        ),
        guide=None if run.guide is None else run.guide.check,
        share_lost=_mean_share_lost(run.counted),
    )


def _mean_share_lost(counted: PMMHInfo) -> Float[Array, "*chains"]:
    """Return the mean share of lost paths, weighted by acceptance probabilities, or zero."""
    weight = counted.acceptance
    return jnp.where(weight > 0, counted.share_lost / jnp.where(weight > 0, weight, 1), 0)


def _initial_state(
    guide: Guide | None, theta: Float[Array, "*chains p"], root: Float[Array, "p p"]
) -> _Run:
    """Return the state of the loop before the first estimate, with zeros as placeholders."""
    chains = theta.shape[:-1]
    zeros, no_counts = jnp.zeros(chains, theta.dtype), jnp.zeros(chains, jnp.int32)
    root = jnp.broadcast_to(root, (*chains, *root.shape))
    chain = _Chain(theta, zeros, zeros, zeros, root)
    return _Run(chain, guide, jnp.int32(0), PMMHInfo(no_counts, no_counts, no_counts, zeros, zeros))


def _continued_state(state: PMMHState) -> _Run:
    """Return the state of the loop that continues earlier draws, with new counts."""
    chain = _Chain(
        state.theta, state.log_likelihood, state.variance, state.log_step_error, state.root
    )
    no_counts = jnp.zeros(chain.log_likelihood.shape, jnp.int32)
    zeros = jnp.zeros_like(chain.log_likelihood)
    return _Run(
        chain, state.guide, state.num_done, PMMHInfo(no_counts, no_counts, no_counts, zeros, zeros)
    )
