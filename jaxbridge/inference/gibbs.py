"""Bayesian inference by Gibbs sampling (section 4 of the paper, for any model).

The path between the observations is part of the state: bridges of all intervals given θ and the
data (`augmentation`), and θ given the whole path (`parameter_kernels`), in turn. With exact bridges
the posterior is exact up to the step error; with approximate ones, as in the paper, it is
shifted by the error of the bridges.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.checks import Numbers, check_count, check_key, nondifferentiable
from ..engine.compiled import compiled_sooner
from ..engine.doors import door
from ..engine.progress import metered_scan
from ..engine.verdict import Fault, lost_paths
from ..models.diffusion import Diffusion
from ..proposals import Budget
from ..records import Initial, Observation, as_record_problems
from .augmentation import Augmentation, augment
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
from .posterior import (
    AbstractPosterior,
    check_covariance_is_used,
    drawn,
    first_chain,
    first_states,
    over_chains,
    starting_points,
    step_errors_of_some,
    summed,
)
from .priors import GivenDensity, NormalDensity, Prior, as_log_prior
from .record_gibbs import RecordPosterior, RecordState, sample_records
from .record_paths import check_no_bridges, check_no_record

# Weights that are cut off in a larger share of iterations spoil the law.
_MOST_TRUNCATED = 0.01
_MISSING = (
    "Some intervals have no bridge of the proposal (`num_missing` does not go to zero), and the "
    "posterior is given stand-ins. Choose another `proposal`, or allow more `max_proposals`."
)
_CUT_OFF = (
    "Weights were cut off by `max_trials` in more than 1 % of the iterations, so that the law is "
    "not exact. Allow more trials, or choose another `proposal`."
)


class GibbsState(NamedTuple):
    """Where a chain of `gibbs` is, with chains in a leading axis if there are several.

    - `theta`: θ, shape (p,).
    - `paths`: those of all intervals, in blocks of one number of steps.
    - `found`: which of them the proposal has found, shape (I,), in the same order. The others are
        stand-ins, for a chain must start somewhere.
    - `num_done`: draws so far. Going on with the same key draws the random numbers of those that
        come after.
    """

    theta: Float[Array, "*chains p"]
    paths: tuple[Float[Array, "..."], ...]
    found: Bool[Array, "*chains I"]
    num_done: Int[Array, "*chains"]


class GibbsPosterior(AbstractPosterior):
    """What `gibbs` returns: draws of the unknown parameters. Arrays have a leading axis of chains
    if there are several.

    - `params`: all parameters of the model, each with leading axes (*chains, n).
    - `theta`: the unknown ones as vectors, shape (*chains, n, p).
    - `names`: those of θ's entries, for instance "alpha" or "B[0,1]": of parameters in a dictionary
        the keys are in alphabetical order.
    - `parameters_moved`: whether θ moved, shape (*chains, n).
    - `bridges_moved`: the share of bridges that were replaced, shape (*chains, n).
    - `num_simulated`: paths simulated or weighed, shape (*chains, n).
    - `num_missing`: bridges that were not found, though called for, within `max_proposals`, shape
        (*chains, n). They stayed as they were: the law is right, but the chain moves less. Also,
        in every iteration, those whose first path is a stand-in that nothing has replaced yet: a
        stand-in that is hardly ever hit calls for no proposal, and the posterior is then given
        that path. Where this does not go to zero choose another proposal for such intervals.
    - `num_truncated`: weights that `max_trials` cut off, shape (*chains, n): where there are many
        the law is not exact.
    - `num_nonfinite`: paths that left the state space or the finite numbers, shape (*chains, n).
    - `log_step_error`: an estimate of the step error of the log density of the completed data at
        each draw, up to a constant, NaN where none was worked out, shape (*chains, n): what
        `step_error`, that of the posterior mean, is made of.
    - `sigma_varies`: whether σ depends on the state.
    - `state`: where it ended; pass it as `init` to go on.
    - `exact_parameters`: whether θ is drawn from its normal law given the path.
    - `completion`: how the observations were completed, with the proposals that were chosen.
    """

    params: PyTree
    theta: Float[Array, "*chains n p"]
    names: tuple[str, ...] = eqx.field(static=True)
    parameters_moved: Bool[Array, "*chains n"]
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

    @property
    def _stuck(self):
        return False

    @property
    def _faults(self):
        # Counted in every iteration: a stand-in that no proposal has replaced.
        late = self.num_missing[..., self.num_missing.shape[-1] // 2 :]
        often = jnp.mean(self.num_truncated > 0, axis=-1) > _MOST_TRUNCATED
        return (
            Fault(jnp.any(jnp.min(late, axis=-1) > 0), _MISSING),
            Fault(jnp.any(often), _CUT_OFF),
            lost_paths(jnp.sum(self.num_nonfinite), jnp.sum(self.num_simulated)),
        )


@door
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
    proposal: Any = None,
    bridges: Literal["exact", "approximate"] = "exact",
    method: Literal["pseudo_marginal", "renewal"] | None = None,
    where: Callable[[PyTree], PyTree] | None = None,
    constraint: Constraint | None = None,
    parameter_kernel: Callable[[Callable], Any] | None = None,
    num_chains: int | None = None,
    thin: int = 1,
    init: PyTree | GibbsState | RecordState = None,
    observation: Observation | None = None,
    initial: Initial = None,
    initial_time: Numbers | None = None,
    num_warmup: int | None = None,
    covariance: Numbers | None = None,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> GibbsPosterior | RecordPosterior:
    """Draws from the posterior of a model's parameters, given discrete observations.

    **Arguments:**

    - `key`: a typed key.
    - `model`: its `params` are where chains start. σ must not depend on those that are unknown,
        unless there is an `observation`.
    - `times`: increasing, shape (n + 1,), in the model's units of time.
    - `observations`: of the diffusion at these times, shape (n + 1, d), or (n + 1,) in one
        dimension. Several records, which are independent given the parameters, are lists of both,
        or have a leading axis.
    - `prior`: a `NormalPrior`, or a function that maps the unknown parameters to the log of a
        density. It is restricted to `constraint`.
    - `num_iterations`: draws that are kept; between two of them are `thin` iterations.
    - `num_steps`: N for each interval, by default 50, or 10 with an `observation`; or
        `step_size`, the longest step, from which each interval gets its own number of steps.
    - `proposal`: a `Coupling`, `ModifiedDiffusionBridge()`, `ResidualBridge()`, `Guided()`, or
        "auto", the default, which finds the best for each interval by a pilot run; or, for
        approximate bridges or where a `method` is given, a `Coupling`, by default
        `Coupling(gamma=0.0)`.
    - `bridges`: "exact", or "approximate" as in the paper.
    - `method`: of exact bridges by a coupling, "renewal" (the default if `proposal` is one) or
        "pseudo_marginal".
    - `where`: a function that picks the unknown ones from `model.params`, by default all, for
        instance `lambda params: params.B`. Prior and constraint are about these.
    - `constraint`: a function that maps the unknown parameters to whether they are allowed, for
        instance `lambda alpha: alpha > 0`, without which the model is not ergodic.
    - `parameter_kernel`: makes a kernel `(init, step)` from a log density of the unknown
        parameters, as BlackJAX does. By default θ is drawn from its normal law given the path
        where the log likelihood is quadratic and the prior normal; otherwise moved by
        Metropolis–Hastings with Newton steps.
    - `num_chains`: several chains at once, which then have a leading axis in all results.
    - `init`: unknown parameters to start from, with a leading axis of chains if there are
        several and they differ; or the `state` of earlier draws, to go on from there.
    - `observation`, `initial`, `initial_time`: for a record that was seen with noise or in part, as
        in `innovations`. Then parameters of σ and of the noise may be unknown too, and `num_warmup`
        iterations before, by default 500, learn the size of moves and what guides paths;
        `covariance` as in `pmmh`.
    - `num_counts`, `max_proposals`, `max_trials`: as in `sample_exact_bridges`.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.

    The functions among these are compared by identity: define them once to compile once.

    **Returns:** `GibbsPosterior`; with an `observation`, `RecordPosterior`. Not differentiable.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

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
    if observation is not None:
        check_key(key)
        check_no_bridges(
            proposal=proposal,
            bridges=bridges,
            method=method,
            parameter_kernel=parameter_kernel,
            num_counts=num_counts,
            max_proposals=max_proposals,
            max_trials=max_trials,
        )
        options = {"num_steps": num_steps, "step_size": step_size, "initial_time": initial_time}
        records = as_record_problems(model, times, observations, observation, initial, **options)
        unknown = theta_of_model(parameters, records.stacked.like.dtype)
        log_prior = as_log_prior(prior, parameters, unknown)
        theta, state = starting_points(
            parameters, unknown, init, num_chains, log_prior, RecordState
        )
        check_covariance_is_used(covariance, state)
        start = (theta, first_root(covariance, log_prior, unknown)) if state is None else state
        num_warmup = check_count("num_warmup", 500 if num_warmup is None else num_warmup, 0)
        size = (num_warmup, num_iterations, thin)
        how = size, covariance is None, progress_meter
        return sample_records(key, parameters, records, log_prior, start, *how)
    for_records = {"initial": initial, "initial_time": initial_time}
    check_no_record(num_warmup=num_warmup, covariance=covariance, **for_records)
    problem = as_problem(key, parameters, times, observations, num_steps, step_size)
    problem.check_sigma_known("use `pmmh`, which needs no path, or pick the others with `where=`.")
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


class GibbsInfo(NamedTuple):
    """Counted in one iteration: θ's moves, bridges that were replaced, and as in the posterior."""

    parameters_moved: Int[Array, "*chains"]
    bridges_moved: Int[Array, "*chains"]
    num_simulated: Int[Array, "*chains"]
    num_missing: Int[Array, "*chains"]
    num_truncated: Int[Array, "*chains"]
    num_nonfinite: Int[Array, "*chains"]


class _Sampler(eqx.Module):
    """What does not change from iteration to iteration, and the steps of one chain."""

    parameters: Parameters
    augmentation: Augmentation
    log_prior: NormalDensity | GivenDensity
    kernel: AbstractParameterKernel

    def start(self, key: Key[Array, ""], theta: Float[Array, " p"]) -> GibbsState:
        model = nondifferentiable(self.parameters.bind(theta))
        return GibbsState(theta, *self.augmentation.first(key, model), jnp.int32(0))

    def step(self, key: Key[Array, ""], state: GibbsState) -> tuple[GibbsState, GibbsInfo]:
        """Bridges given θ, then θ given bridges."""
        bridge_key, parameter_key = jax.random.split(key)
        model = self.parameters.bind(state.theta)
        paths, bridges = self.augmentation.renew(bridge_key, model, state.paths)
        found = state.found | bridges.moved
        data = CompleteData(self.parameters, self.augmentation, paths, self.log_prior)
        theta, accepted = self.kernel.step(parameter_key, state.theta, data)
        counted = bridges._replace(missing=bridges.missing | ~found)
        return GibbsState(theta, paths, found, state.num_done), GibbsInfo(
            accepted, *summed(counted)
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
        number = state.num_done.reshape(-1)[0] + 1  # 0 made the first paths
        keys = jax.random.split(jax.random.fold_in(key, number), thin)
        step = lambda state, key: over_chains(sampler.step, key, state)
        state, infos = lax.scan(step, state, keys)
        state = state._replace(num_done=state.num_done + 1)
        errors = step_errors_of_some(of_chains, state, i, num_iterations)
        return state, (state.theta, summed(infos), errors)

    state, draws = metered_scan(draw, state, jnp.arange(num_iterations), progress_meter)
    fields, (info, log_step_error) = drawn(sampler.parameters, *draws)
    num_bridges = thin * sampler.augmentation.num_intervals
    info = info._replace(
        parameters_moved=info.parameters_moved > 0,
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
