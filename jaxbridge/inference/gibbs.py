"""Bayesian inference by Gibbs sampling (section 4 of the paper, for any model).

The state of the chain contains the path between the observations. The sampler draws the bridges of
all intervals given θ (`augmentation`), and θ given the complete path (`parameter_kernels`), in
turn. With exact bridges the posterior is exact up to the discretisation error. With approximate
bridges, as in the paper, it has the bias of the bridges in addition.
"""

import os
from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.checks import Numbers, check_count, check_key, nondifferentiable
from ..engine.compiled import compiled_sooner
from ..engine.entry import public_entry
from ..engine.progress import metered_scan
from ..engine.verdict import Fault, lost_paths
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from ..models.gaussian_law import GaussianLaw
from ..models.jumps import JumpsLike
from ..proposals import Budget, ProposalLike
from ..records import AbstractObservation, Initial, LinearGaussian, as_record_problems
from .augmentation import Augmentation, augment
from .checkpoint import resumable
from .data import as_problem
from .parameter_kernels import (
    AbstractParameterKernel,
    CompleteData,
    NormalDraw,
    check_kernel,
    choose_kernel,
)
from .parameter_walk import first_root
from .parameters import Constraint, Parameters, as_parameters, theta_of_model
from .population import NormalPopulation, as_population
from .posterior import (
    AbstractPosterior,
    Combination,
    check_covariance_is_used,
    first_chain,
    first_states,
    last,
    over_chains,
    posterior_fields,
    starting_points,
    sum_counts,
    thinned_step_errors,
)
from .priors import GivenDensity, NormalDensity, Prior, as_log_prior
from .record_gibbs import RecordPosterior, RecordState, sample_records
from .record_paths import (
    OF_POPULATION,
    OF_UNKNOWN_SIGMA,
    check_no_bridges,
    check_no_record,
    not_default,
)

# Largest share of iterations with truncated weights.
_MOST_TRUNCATED = 0.01
_MISSING = (
    "The proposal found no bridge for some intervals (`num_missing` does not fall to zero), so the "
    "posterior is conditional on placeholder paths. Use another `proposal`, or increase "
    "`max_proposals`."
)
_CUT_OFF = (
    "In more than 1 % of the draws `max_trials` truncated weights, or a burn-in of the coupling "
    "was cut short, so the law is not exact. Use another `proposal`, or a larger `max_trials` (not "
    "for renewals)."
)


class GibbsState(NamedTuple):
    """State of a chain of `gibbs`. Several chains have a leading axis.

    - `theta`: θ, shape (p,).
    - `paths`: paths of all intervals, in blocks of intervals with the same number of steps.
    - `found`: whether the proposal found the path, shape (I,), in the same order. The other paths
        are placeholders from the start of the chain.
    - `num_done`: number of draws so far. A continued chain with the same key uses the subsequent
        random numbers.
    """

    theta: Float[Array, "*chains p"]
    paths: tuple[Float[Array, "..."], ...]
    found: Bool[Array, "*chains I"]
    num_done: Int[Array, "*chains"]


class GibbsPosterior(AbstractPosterior):
    """Posterior draws of the unknown parameters, from `gibbs`.

    Arrays have a leading axis of chains if there are several.

    - `params`: all parameters of the model, each with leading axes (*chains, n).
    - `theta`: the unknown parameters as vectors, shape (*chains, n, p).
    - `names`: names of the entries of θ, for instance "alpha" or "B[0,1]". The keys of a dictionary
        are in alphabetical order.
    - `parameters_moved`: fraction of accepted moves of θ, shape (*chains, n).
    - `bridges_moved`: fraction of the bridges that were replaced, shape (*chains, n).
    - `num_simulated`: number of simulated or reweighted paths, shape (*chains, n).
    - `num_missing`: number of bridges that were needed but not found within `max_proposals`, shape
        (*chains, n). They remain unchanged: the law is exact, but the chain moves less. The number
        includes placeholders from the start that no proposal has replaced. If it does not fall to
        zero, the posterior is conditional on these placeholders; then use another proposal.
    - `num_truncated`: number of weights that `max_trials` truncated, or, for the renewal chain, of
        burn-ins that were cut short, shape (*chains, n). With many of them the law is not exact.
    - `num_nonfinite`: number of paths that diverged or left the state space, shape (*chains, n).
    - `log_step_error`: estimated discretisation error of the log density of the completed data at
        each draw, up to a constant, shape (*chains, n). NaN at draws without an estimate.
        `step_error`, that of the posterior mean, is computed from it.
    - `sigma_varies`: whether σ depends on the state.
    - `state`: last state; pass it as `init` to continue.
    - `exact_parameters`: whether θ is drawn from its normal law given the path.
    - `completion`: the data augmentation, with the chosen proposals.
    """

    params: PyTree
    theta: Float[Array, "*chains n p"]
    names: tuple[str, ...] = eqx.field(static=True)
    parameters_moved: Float[Array, "*chains n"]
    bridges_moved: Float[Array, "*chains n"]
    num_simulated: Int[Array, "*chains n"]
    num_missing: Int[Array, "*chains n"]
    num_truncated: Int[Array, "*chains n"]
    num_nonfinite: Int[Array, "*chains n"]
    log_step_error: Float[Array, "*chains n"]
    sigma_varies: bool = eqx.field(static=True)
    state: GibbsState
    completion: Augmentation
    exact_parameters: bool = eqx.field(static=True)

    _combinations: ClassVar[dict[str, Combination]] = {
        "state": last,
        "completion": last,
        "exact_parameters": last,
    }
    _continued_with: ClassVar[dict[str, Any]] = {}

    @property
    def _stuck(self):
        return False

    @property
    def _faults(self):
        # A placeholder that no proposal has replaced is counted in every iteration, so bridges are
        # still missing if the minimum over the second half of the draws is positive.
        late = self.num_missing[..., self.num_missing.shape[-1] // 2 :]
        often = jnp.mean(self.num_truncated > 0, axis=-1) > _MOST_TRUNCATED
        return (
            Fault(jnp.any(jnp.min(late, axis=-1) > 0), _MISSING),
            Fault(jnp.any(often), _CUT_OFF),
            lost_paths(jnp.sum(self.num_nonfinite), jnp.sum(self.num_simulated)),
        )


@public_entry
@resumable
def gibbs(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    prior: Prior,
    num_iterations: int = 1000,
    num_steps: int | None = None,
    step_size: float | None = None,
    proposal: ProposalLike = None,
    bridges: Literal["exact", "approximate"] = "exact",
    method: Literal["pseudo_marginal", "renewal"] | None = None,
    where: Callable[[PyTree], PyTree] | None = None,
    constraint: Constraint | None = None,
    parameter_kernel: Callable[[Callable], Any] | None = None,
    num_chains: int | None = None,
    thin: int = 1,
    init: PyTree | GibbsState | RecordState = None,
    observation: AbstractObservation | None = None,
    initial: Initial = None,
    initial_time: Numbers | None = None,
    jumps: JumpsLike = None,
    population: NormalPopulation | None = None,
    num_warmup: int | None = None,
    covariance: Numbers | None = None,
    save_states: bool = False,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    checkpoint: str | os.PathLike | None = None,
) -> GibbsPosterior | RecordPosterior:
    """Sample from the posterior of a model's parameters, given discrete observations.

    **Arguments:**

    - `key`: typed key.
    - `model`: the diffusion. Chains start from its `params`. If σ depends on the unknown
        parameters, exact observations count as a record whose noise is zero. Then arguments about
        bridges do not apply. If σ depends on the state, they do so by default, too, because the
        steps of records are of second order; with arguments about bridges steps are of first order.
    - `times`: increasing, shape (n + 1,), in the model's unit of time.
    - `observations`: values of the diffusion at these times, shape (n + 1, d), or (n + 1,) in one
        dimension. Pass several independent records as lists of `times` and `observations`, or with
        a leading axis.
    - `prior`: a `NormalPrior`, or a function from the unknown parameters to a log density. It is
        restricted to `constraint`.
    - `num_iterations`: number of stored draws. Between two of them the chain makes `thin`
        iterations.
    - `num_steps`, `step_size`: pass one of the two. `num_steps` is N for each interval, by default
        50, or 10 for a record. `step_size` is the maximum step size, from which the number
        of steps of each interval follows.
    - `proposal`: a `Coupling`, `ModifiedDiffusionBridge()`, `ResidualBridge()`, `Guided()`, or
        "auto", the default, which selects the best one for each interval by pilot runs. With
        `bridges="approximate"` or a `method` the default is `Coupling(gamma=0.0)`. Approximate
        bridges and `method="renewal"` need a `Coupling`.
    - `bridges`: "exact", or "approximate" as in the paper.
    - `method`: Markov chain for exact bridges: "renewal" (the default if `proposal` is a coupling)
        or "pseudo_marginal" (used for all other proposals).
    - `where`: a function that selects the unknown parameters from `model.params`, for instance
        `lambda params: params.B`; by default all. `prior` and `constraint` take these parameters.
    - `constraint`: a function from the unknown parameters to whether they are allowed, for instance
        `lambda alpha: alpha > 0` if the model is ergodic only then.
    - `parameter_kernel`: a function from a log density of the unknown parameters to a kernel with
        functions `init` and `step`, as in BlackJAX. By default θ is drawn from its normal law given
        the path if the log-likelihood is quadratic in θ and the prior normal. Otherwise it moves by
        Metropolis–Hastings with Newton steps.
    - `num_chains`: number of parallel chains, which are a leading axis in all results.
    - `init`: unknown parameters to start from, with a leading axis if chains have different ones;
        or the `state` of earlier draws, to continue them.
    - `observation`, `initial`, `initial_time`, `jumps`: observation model, initial law and jumps of
        a noisy or partial record, as in `innovations`. Then parameters of σ and of the noise may
        be unknown, too.
    - `population`: a `NormalPopulation`, for parameters that vary between records. Exact
        observations then count as a record without noise, too. In `init` and `covariance`,
        parameters that vary are represented by their population means.
    - `num_warmup`, `covariance`: for records only. The warm-up, by default of 500 iterations,
        adapts the sizes of moves and the guide. `covariance` is as in `pmmh`.
    - `save_states`: for records only. Whether the result contains the states at the times of the
        observations and the log densities of these, for each draw: for smoothed states with all
        uncertainty, and for `arviz.loo`. By default it does not, because they take memory and time.
    - `num_counts`, `max_proposals`, `max_trials`: as in `sample_exact_bridges`. The renewal chain
        and approximate bridges take only `max_proposals`.
    - `progress_meter`: a progress meter of diffrax, for instance `diffrax.TextProgressMeter()`.
    - `checkpoint`: path of a file, for runs that may be interrupted. The run has at most ten parts,
        after each of which the file is replaced. The same call continues from the file, to the same
        draws. R̂ and the remaining time are logged (`logging.getLogger("jaxbridge")`).

    Arguments that are functions are compared by identity: define them once to compile once.

    **Returns:** `GibbsPosterior`; for a record `RecordPosterior`. Not differentiable.

    **Raises:** `ValueError` and `TypeError` for invalid arguments; `ValueError` if a chain for a
    record never reaches a positive likelihood.

    **Example:**

    ```python
    posterior = jb.gibbs(
        key, jb.hyperbolic(0.8, 2), times, observations, num_iterations=500, num_steps=20,
        prior=jb.NormalPrior(1.0, 1.0), constraint=lambda alpha: alpha > 0,
    )
    posterior.params.mean(), posterior.effective_sample_size
    ```
    """
    num_iterations, thin = check_count("num_iterations", num_iterations), check_count("thin", thin)
    parameters = as_parameters(model, where, constraint, prior)
    for_bridges = {
        "proposal": proposal,
        "bridges": bridges,
        "method": method,
        "parameter_kernel": parameter_kernel,
        "num_counts": num_counts,
        "max_proposals": max_proposals,
        "max_trials": max_trials,
    }
    problem = None
    if observation is not None:
        check_key(key)
        check_no_bridges(**for_bridges)
    else:
        check_no_record(initial=initial, initial_time=initial_time, jumps=jumps)
        problem = as_problem(key, parameters, times, observations, num_steps, step_size)
        parameters.model.check_invertible_sigma(problem.like)
        # Given its complete path σ cannot move, but given its noise it can.
        only_noise = problem.sigma_is_unknown or population is not None
        # Where σ varies, the likelihood of a path is of first order, and that of noise of second.
        is_free = not not_default(for_bridges) and not isinstance(init, GibbsState)
        if only_noise or (is_free and model.sigma_varies(problem.like)):
            check_no_bridges(OF_POPULATION if population else OF_UNKNOWN_SIGMA, **for_bridges)
            observation, initial = LinearGaussian(covariance=0.0), _wide_law(problem.intervals)
    if observation is not None:
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
        log_prior = as_log_prior(prior, parameters, unknown)
        units = as_population(population, parameters, log_prior, records.number)
        theta, state = starting_points(
            parameters, unknown, init, num_chains, log_prior, RecordState, len(units.varies)
        )
        check_covariance_is_used(covariance, state)
        units.check_state(state)
        root = units.first_root(first_root(covariance, log_prior, unknown))
        start = (units.first_point(theta), root) if state is None else state
        num_warmup = check_count("num_warmup", 500 if num_warmup is None else num_warmup, 0)
        size = (num_warmup, num_iterations, thin)
        how = size, covariance is None, bool(save_states), progress_meter
        return sample_records(key, units, records, start, *how)
    assert problem is not None
    check_no_record(num_warmup=num_warmup, covariance=covariance, save_states=save_states or None)
    check_kernel(parameter_kernel)
    log_prior = as_log_prior(prior, parameters, problem.theta)
    theta, state = starting_points(
        parameters, problem.theta, init, num_chains, log_prior, GibbsState
    )
    augment_key, run_key = jax.random.split(key)
    budget = Budget(num_counts, max_proposals, max_trials)
    how = (proposal, bridges, method, budget)
    augmentation = augment(augment_key, problem, first_chain(theta), *how)
    kernel = choose_kernel(parameter_kernel, augmentation.is_quadratic, log_prior)
    sampler = _Sampler(parameters, augmentation, log_prior, kernel)
    if state is None:
        state = first_states(sampler.start, run_key, theta)
    else:
        augmentation.check_paths(state.paths, theta.shape[:-1])
    return _run(run_key, sampler, state, num_iterations, thin, progress_meter)


def _wide_law(intervals: Intervals) -> GaussianLaw:
    """Return a wide normal law of the first state, with the spread of the observations.

    It serves as `initial` of records without noise. The first state is observed exactly, so the law
    only adds a constant to the log-likelihood.
    """
    points = intervals.start
    variance = jnp.var(points, axis=0)
    spread = jnp.where(variance > 0, variance, 1 + points[0] ** 2)
    return GaussianLaw(points[0], jnp.diag(spread))


class GibbsInfo(NamedTuple):
    """Counts of one iteration, or their sums; the names are those of `GibbsPosterior`."""

    parameters_moved: Int[Array, "*chains"]
    bridges_moved: Int[Array, "*chains"]
    num_simulated: Int[Array, "*chains"]
    num_missing: Int[Array, "*chains"]
    num_truncated: Int[Array, "*chains"]
    num_nonfinite: Int[Array, "*chains"]


class _Sampler(eqx.Module):
    """Constants of the sampler, and the steps of one chain."""

    parameters: Parameters
    augmentation: Augmentation
    log_prior: NormalDensity | GivenDensity
    kernel: AbstractParameterKernel

    def start(self, key: Key[Array, ""], theta: Float[Array, " p"]) -> GibbsState:
        model = nondifferentiable(self.parameters.bind(theta))
        return GibbsState(theta, *self.augmentation.first(key, model), jnp.int32(0))

    def step(self, key: Key[Array, ""], state: GibbsState) -> tuple[GibbsState, GibbsInfo]:
        """Draw the bridges given θ, then θ given the bridges."""
        bridge_key, parameter_key = jax.random.split(key)
        model = self.parameters.bind(state.theta)
        paths, bridges = self.augmentation.renew(bridge_key, model, state.paths)
        has_bridge = state.found | bridges.moved
        data = CompleteData(self.parameters, self.augmentation, paths, self.log_prior)
        theta, accepted = self.kernel.step(parameter_key, state.theta, data)
        counted = bridges._replace(missing=bridges.missing | ~has_bridge)
        return GibbsState(theta, paths, has_bridge, state.num_done), GibbsInfo(
            accepted, *sum_counts(counted)
        )

    def log_step_error(self, state: GibbsState) -> Float[Array, ""]:
        model = self.parameters.bind(state.theta)
        return self.augmentation.log_step_error(model, state.paths)


@compiled_sooner
def _run(
    key: Key[Array, ""],
    sampler: _Sampler,
    state: GibbsState,
    num_iterations: int,
    thin: int,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> GibbsPosterior:
    sampler, state = nondifferentiable((sampler, state))
    one = lambda state: sampler.log_step_error(state)  # `cond` hashes it
    of_chains = jax.vmap(one) if state.theta.ndim == 2 else one

    def draw(state, i):
        # All chains have made the same number of draws.
        number = state.num_done.reshape(-1)[0] + 1  # key 0 is for the first paths
        keys = jax.random.split(jax.random.fold_in(key, number), thin)
        step = lambda state, key: over_chains(sampler.step, key, state)
        # Iterations between draws are not stored.
        state, infos = lax.scan(step, state, keys)
        state = state._replace(num_done=state.num_done + 1)
        errors = thinned_step_errors(of_chains, state, i, num_iterations)
        return state, (state.theta, sum_counts(infos), errors)

    state, draws = metered_scan(draw, state, jnp.arange(num_iterations), progress_meter)
    fields, (info, log_step_error) = posterior_fields(sampler.parameters, *draws)
    # `bridges_moved` counts the moves of all iterations of a draw.
    num_bridges = thin * sampler.augmentation.num_intervals
    info = info._replace(
        parameters_moved=info.parameters_moved.astype(state.theta.dtype) / thin,
        bridges_moved=info.bridges_moved.astype(state.theta.dtype) / num_bridges,
    )
    return GibbsPosterior(
        **fields,
        **info._asdict(),
        log_step_error=log_step_error,
        sigma_varies=sampler.parameters.model.sigma_varies(sampler.augmentation.like),
        state=state,
        completion=sampler.augmentation,
        exact_parameters=isinstance(sampler.kernel, NormalDraw),
    )
