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

from ..engine.checks import Numbers, check_count, nondifferentiable
from ..models.diffusion import Diffusion
from ..schemes.path_likelihood import Form
from .augmentation import Augmentation, Paths, augment
from .blocks import target_forms
from .data import as_problem, first_chain
from .parameter_kernels import (
    AbstractParameterKernel,
    CompleteData,
    NormalDraw,
    check_kernel,
    choose_kernel,
    quadratic_form,
)
from .parameters import Constraint, Parameters
from .posterior import AbstractPosterior, starting_points
from .priors import GivenDensity, NormalDensity, Prior, as_log_prior

# Of about so many of the draws the step error is worked out.
_STEP_ERRORS = 256


class GibbsState(NamedTuple):
    """Where a chain of `gibbs` is, with chains in a leading axis if there are several.

    - `theta`: θ, shape (p,).
    - `paths`: those of all intervals, in blocks of one number of steps.
    - `found`: which of them the proposal has found, shape (I,), in the same order. The others are
        stand-ins, for a chain must start somewhere.
    """

    theta: Float[Array, "*chains p"]
    paths: tuple[Float[Array, "..."], ...]
    found: Bool[Array, "*chains I"]


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
    - `log_step_error`: an estimate of the step error of the log density of the completed data at
        each draw, up to a constant, NaN where none was worked out, shape (*chains, n): what
        `step_error`, that of the posterior mean, is made of.
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
    log_step_error: Float[Array, "*chains n"]
    state: GibbsState
    completion: Augmentation
    exact_parameters: bool = eqx.field(static=True)


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
    init: PyTree | GibbsState = None,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> GibbsPosterior:
    """Draws from the posterior of a model's parameters, given discrete observations.

    **Arguments:**

    - `key`: a typed key.
    - `model`: its `params` are where chains start. σ must not depend on those that are unknown.
    - `times`: increasing, shape (n + 1,), in the model's units of time.
    - `observations`: of the diffusion at these times, shape (n + 1, d).
    - `prior`: a `NormalPrior`, or a function that maps the unknown parameters to the log of a
        density. It is restricted to `constraint`.
    - `num_iterations`: draws that are kept; between two of them are `thin` iterations.
    - `num_steps`: N for each interval, by default 50; or `step_size`, the longest step, from
        which each interval gets its own number of steps.
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
    - `num_counts`, `max_proposals`, `max_trials`: as in `sample_exact_bridges`.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.

    The functions among these are compared by identity: define them once to compile once.

    **Returns:** `GibbsPosterior`. Not differentiable.

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
    problem = as_problem(
        key,
        model,
        times,
        observations,
        where,
        num_steps,
        step_size,
        "use `pmmh`, which needs no path, or pick the others with `where=`.",
    )
    parameters, like = problem.parameters, problem.like
    check_kernel(parameter_kernel)
    log_prior = as_log_prior(prior, parameters, problem.theta)
    theta, state = starting_points(problem, init, num_chains, constraint, log_prior, GibbsState)
    augment_key, run_key = jax.random.split(key)
    bounds = (num_counts, max_proposals, max_trials)
    arguments = (problem.intervals, problem.groups, proposal, bridges, method, bounds)
    augmentation = augment(augment_key, problem.pilot_model(theta), *arguments)
    forms = target_forms(augmentation.blocks, model)
    form = quadratic_form(parameters, first_chain(theta), like, forms)
    kernel = choose_kernel(parameter_kernel, form is not None, log_prior)
    form = forms[0] if form is None else form
    setting = _Setting(parameters, augmentation, log_prior, constraint, kernel, form)
    meter = diffrax.NoProgressMeter() if progress_meter is None else progress_meter
    if state is None:
        state = _start(run_key, setting, theta)
    else:
        augmentation.check_paths(state.paths, theta.shape[:-1])
    return _run(run_key, setting, state, num_iterations, thin, meter)


class _Setting(eqx.Module):
    """What does not change from iteration to iteration."""

    parameters: Parameters
    augmentation: Augmentation
    log_prior: NormalDensity | GivenDensity
    constraint: Constraint | None = eqx.field(static=True)
    kernel: AbstractParameterKernel
    form: Form = eqx.field(static=True)

    def data(self, paths: Paths) -> CompleteData:
        return CompleteData(
            self.parameters, self.augmentation, paths, self.log_prior, self.constraint, self.form
        )


class GibbsInfo(NamedTuple):
    """What is told of one iteration."""

    parameters_moved: Bool[Array, "*chains"]
    bridges_moved: Float[Array, "*chains"]
    num_simulated: Int[Array, "*chains"]
    num_missing: Int[Array, "*chains"]
    num_truncated: Int[Array, "*chains"]


@eqx.filter_jit
def _start(key: Key[Array, ""], setting: _Setting, theta: Float[Array, "*chains p"]) -> GibbsState:
    def first(key, theta):
        model = nondifferentiable(setting.parameters.bind(theta))
        return setting.augmentation.first_and_found(key, model)

    key = jax.random.fold_in(key, 0)
    if theta.ndim == 1:
        return GibbsState(theta, *first(key, theta))
    return GibbsState(theta, *jax.vmap(first)(jax.random.split(key, len(theta)), theta))


def _iterate(
    key: Key[Array, ""], setting: _Setting, state: GibbsState
) -> tuple[GibbsState, GibbsInfo]:
    """Bridges given θ, then θ given bridges."""
    bridge_key, parameter_key = jax.random.split(key)
    model = setting.parameters.bind(state.theta)
    paths, bridges = setting.augmentation.renew(bridge_key, model, state.paths)
    found = state.found | bridges.moved
    step = setting.kernel.step(parameter_key, state.theta, setting.data(paths))
    info = GibbsInfo(
        step.accepted,
        jnp.mean(bridges.moved.astype(state.theta.dtype)),
        jnp.sum(bridges.num_simulated, dtype=jnp.int32),
        jnp.sum(bridges.missing | ~found, dtype=jnp.int32),
        jnp.sum(bridges.truncated, dtype=jnp.int32),
    )
    return GibbsState(step.theta, paths, found), info


@eqx.filter_jit
def _run(
    key: Key[Array, ""],
    setting: _Setting,
    state: GibbsState,
    num_iterations: int,
    thin: int,
    progress_meter: diffrax.AbstractProgressMeter,
) -> GibbsPosterior:
    setting, state = nondifferentiable((setting, state))

    def iterate(state, key):
        if state.theta.ndim == 1:
            return _iterate(key, setting, state)
        keys = jax.random.split(key, len(state.theta))
        return jax.vmap(lambda key, state: _iterate(key, setting, state))(keys, state)

    # As many draws as tell a covariance, for D takes a good part of the time of an iteration.
    every = max(1, num_iterations // _STEP_ERRORS)

    def step_error(state):
        model = setting.parameters.bind(state.theta)
        return setting.augmentation.log_step_error(model, state.paths, setting.form)

    def step_errors(i, state):
        each = step_error if state.theta.ndim == 1 else jax.vmap(step_error)
        unknown = jnp.full(state.theta.shape[:-1], jnp.nan, state.theta.dtype)
        return lax.cond(i % every == every - 1, each, lambda _: unknown, state)

    def kept(carry, i):
        state, meter = carry
        # Number 0 made the first paths.
        keys = jax.random.split(jax.random.fold_in(key, i + 1), thin)
        state, infos = lax.scan(iterate, state, keys)
        meter = progress_meter.step(meter, (i + 1).astype(jnp.float32) / num_iterations)
        error = step_errors(i, state)
        info = GibbsInfo(
            jnp.any(infos.parameters_moved, axis=0),
            jnp.mean(infos.bridges_moved, axis=0),
            jnp.sum(infos.num_simulated, axis=0, dtype=jnp.int32),
            jnp.sum(infos.num_missing, axis=0, dtype=jnp.int32),
            jnp.sum(infos.num_truncated, axis=0, dtype=jnp.int32),
        )
        return (state, meter), (state.theta, info, error)

    carry = (state, progress_meter.init())
    (state, meter), (theta, info, error) = lax.scan(kept, carry, jnp.arange(num_iterations))
    progress_meter.close(meter)
    if theta.ndim == 3:
        theta, info, error = jax.tree.map(
            lambda leaf: jnp.moveaxis(leaf, 0, 1), (theta, info, error)
        )
    as_params = jax.vmap(setting.parameters.full)
    params = (as_params if theta.ndim == 2 else jax.vmap(as_params))(theta)
    exact = isinstance(setting.kernel, NormalDraw)
    return GibbsPosterior(
        params,
        theta,
        setting.parameters.names,
        info.parameters_moved,
        info.bridges_moved,
        info.num_simulated,
        info.num_missing,
        info.num_truncated,
        error,
        state,
        setting.augmentation,
        exact,
    )
