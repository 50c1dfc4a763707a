"""Maximum likelihood by stochastic approximation over bridges, or by a simulated likelihood.

For a known, constant σ `stochastic_approximation` searches with random bridges. With an optimiser
its result is the average of the second half of the iterates; with EM it is the last iterate. From
there Newton's method (`newton`) continues with scores and information from new, independent bridges
in each pass.

If σ depends on the unknown parameters, a complete path determines them, so bridges cannot be used.
Then the simulated likelihood is maximised (`simulated_likelihood`). By default this also holds for
a known σ(x), where the simulated likelihood has the smaller discretisation error.

`record_maximum` is the method for noisy or partial records.
"""

from collections.abc import Callable
from typing import Literal

import diffrax
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.arguments import check_choice
from ..engine.checks import Numbers, check_count, check_key, nondifferentiable
from ..engine.compiled import compiled_sooner
from ..engine.entry import public_entry
from ..engine.verdict import AbstractResult, Fault, Verdict
from ..models.diffusion import Diffusion
from ..models.jumps import JumpsLike
from ..proposals import Budget, ProposalLike
from ..records import AbstractObservation, Initial, as_record_problems
from ..schemes import StepError, dominates, step_faults
from .augmentation import augment
from .data import Problem, as_problem
from .newton import Passes, Slope, falls, is_maximum, maximum_faults, newton_passes
from .parameters import (
    Constraint,
    Parameters,
    as_parameters,
    theta_of_model,
)
from .record_maximum import RecordMaximumLikelihood, maximum_of_records
from .record_paths import check_no_bridges, check_no_record
from .score import Score, Scorer, as_score, scorer_at
from .simulated_likelihood import (
    as_differentiable,
    differentiable_blocks,
    newton_ascent,
    prefers_simulation,
    step_error_of_score,
    stochastic_ascent,
)
from .stochastic_approximation import EM, Gradient, Search, SearchInfo, approximate

# Created once, because optimisers are compared by identity.
_ADAM = optax.adam(1e-2)
# With more unknown parameters, such as those of a neural network, there is no Newton's method: the
# information of each bridge is a p × p matrix.
_MOST_FOR_NEWTON = 300
_UNCHECKED = (
    f"More than {_MOST_FOR_NEWTON} unknown parameters: the estimate is the mean of the later "
    "iterates, and neither its errors nor its convergence are known. Repeat the fit with twice the "
    "`num_iterations` and with another key, and compare the quantities that you need."
)


class MaximumLikelihood(AbstractResult):
    """Maximum likelihood estimate, from `maximum_likelihood`.

    - `params`: all parameters of the model, with estimates of the unknown ones.
    - `standard_errors`: pytree like the unknown parameters, from the observed information.
    - `monte_carlo_errors`: Monte Carlo errors of the search, in the same form. More `num_bridges`
        reduce them. In addition the search may stop 0.03 standard errors from the maximum.
    - `theta`, `covariance`: the estimate as a vector, shape (p,), and the inverse of the observed
        information, shape (p, p).
    - `step_error`, `step_uncertainty`: estimated discretisation bias of `theta` (estimate minus
        limit), shape (p,), and its standard error. NaN if it cannot be estimated.
    - `iterates`: iterates of the stochastic approximation, shape (n, p).
    - `score`: score at the last pass of Newton's method, before its step. For a simulated
        likelihood it is at the estimate; then its gradient is about zero, and its covariance shows
        the Monte Carlo error. Errors are reliable if its `effective_sample_size` is large in all
        intervals.
    - `num_missing`: total number of bridges that were not found in the iterations.
    - `num_truncated`: number of weights that `max_trials` truncated.
    - `num_refused`: number of iterations without a step, because it would have left the constraint
        or led to values that are not finite.
    - `newton`: whether Newton's method converged to a maximum. Then the next step is short compared
        with the standard errors or the Monte Carlo errors, and the information is positive
        definite. Moreover the Monte Carlo error in every direction is at most half a standard
        error. If false, a maximum is not established: use more iterations, a larger learning rate
        or more bridges, unless the maximum is outside the constraint.
    - `fall`: decrease of the log-likelihood one standard error below and above the estimate in each
        parameter, shape (2, p), less its linear part. The other parameters move to their maximum
        given this one, to second order. Values are scaled so that a quadratic log-likelihood gives
        0.5. Values near or below zero show that there is no maximum inside. Points with likelihood
        zero or outside the constraint give infinity.

    With more than 300 unknown parameters, such as those of a neural network, Newton's method does
    not run. The estimate is the mean of the second half of `iterates`, `newton` is false,
    `covariance`, `score` and `fall` are `None`, and errors are NaN.
    """

    params: PyTree
    standard_errors: PyTree
    monte_carlo_errors: PyTree
    theta: Float[Array, " p"]
    covariance: Float[Array, "p p"] | None
    step_error: Float[Array, " p"]
    step_uncertainty: Float[Array, " p"]
    iterates: Float[Array, "iterations p"]
    score: Score | None
    num_missing: Int[Array, ""]
    num_truncated: Int[Array, ""]
    num_refused: Int[Array, ""]
    newton: Bool[Array, ""]
    fall: Float[Array, "2 p"] | None

    @property
    def verdict(self) -> Verdict:
        """Return the faults of the estimate, each with a remedy.

        - no maximum was established (`newton`), or the log-likelihood hardly falls around the
          estimate (`fall`);
        - faults of the weights of `score`;
        - a discretisation error that is unknown, too uncertain, or larger than a standard error;
        - an estimate or covariance that is not finite;
        - more than 300 unknown parameters: then there are no errors to examine.
        """
        if self.covariance is None or self.score is None or self.fall is None:
            return Verdict((Fault(jnp.asarray(True), _UNCHECKED),)).with_finite(self.theta)
        sd = jnp.sqrt(jnp.diagonal(self.covariance))
        steps = step_faults(StepError(self.step_error, self.step_uncertainty), sd, sd)
        return Verdict(
            (
                *maximum_faults(self.newton, self.fall),
                *self.score._weight_faults,
                *(fault.in_any() for fault in steps),
            )
        ).with_finite(self.theta, self.covariance)

    @property
    def step_error_dominates(self) -> Bool[Array, " p"]:
        """Return whether the discretisation error exceeds the standard error, or may do so.

        Shape (p,). If true, use more steps.
        """
        if self.covariance is None:
            return jnp.ones(self.theta.shape, bool)
        error = StepError(self.step_error, self.step_uncertainty)
        return dominates(error, jnp.sqrt(jnp.diagonal(self.covariance)))


@public_entry
def maximum_likelihood(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    optimizer: optax.GradientTransformation | None = None,
    *,
    method: Literal["gradient", "em"] = "gradient",
    num_iterations: int = 500,
    num_bridges: int = 100,
    num_steps: int | None = None,
    step_size: float | None = None,
    proposal: ProposalLike = "auto",
    where: Callable[[PyTree], PyTree] | None = None,
    constraint: Constraint | None = None,
    observation: AbstractObservation | None = None,
    initial: Initial = None,
    initial_time: Numbers | None = None,
    jumps: JumpsLike = None,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> MaximumLikelihood | RecordMaximumLikelihood:
    """Estimate a model's parameters by maximum likelihood, given discrete observations.

    **Arguments:**

    - `key`: typed key.
    - `model`: the diffusion. The search starts from its `params`. If σ depends on the unknown
        parameters or on the state, a simulated likelihood is maximised (see below).
    - `times`, `observations`, `num_steps`, `step_size`, `proposal`, `where`, `constraint`: as in
        `gibbs`. Steps that would leave the constraint are skipped.
    - `optimizer`: an optimiser of optax, by default `optax.adam(0.01)`. Its objective is minus the
        mean log-likelihood per interval (for records, per observation), as a function of the vector
        of unknown parameters. Optimisers are compared by identity: create one once to compile once.
    - `method`: "gradient", or "em", which uses no optimiser and needs fewer iterations. "em" needs
        exact observations, a known σ and at most 300 unknown parameters.
    - `num_iterations`: iterations of the stochastic approximation.
    - `num_bridges`: weighted bridges per interval in each pass of Newton's method after these
        iterations, and for the errors; or paths per interval in the simulated likelihood.
    - `observation`, `initial`, `initial_time`, `jumps`: observation model, initial law and jumps of
        noisy or partial records, as in `innovations`. Then any parameters may be unknown, and
        `num_bridges` is the number of draws from each of eight chains of paths.
    - `num_counts`, `max_proposals`, `max_trials`: as in `sample_exact_bridges`. If `proposal` is a
        coupling, only `max_proposals` is available.
    - `progress_meter`: a progress meter of diffrax, for instance `diffrax.TextProgressMeter()`.

    **Unknown or state-dependent σ.** A complete path determines σ, so paths cannot be fixed while σ
    changes. Instead the estimated transition densities are differentiated, which requires guided
    proposals; by default the best ones are selected (inside `jit`: `Guided()`). For a known σ(x)
    this has the smaller discretisation error; `method="em"`, a coupling, or more than 300 unknown
    parameters use Euler steps.

    - First the optimiser makes steps, each with a few new paths. Then Newton's method finds the
      maximum of the likelihood from `num_bridges` paths per interval with fixed noise. This
      likelihood is a smooth function of θ.
    - The mean of a log density estimate is too small by half its relative variance. An estimate of
      this bias is added. The remaining bias falls with the square of `num_bridges`. Compared with a
      standard error it is small if the square root of the number of intervals is small compared
      with the square of `score.effective_sample_size`.
    - The law of the data depends on σ σᵀ only. If σ is a matrix, choose unknown entries that σ σᵀ
      determines.

    **Returns:** `MaximumLikelihood`; with an `observation`, `RecordMaximumLikelihood`. Not
    differentiable.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    estimate = jb.maximum_likelihood(
        key, jb.hyperbolic(1.0, 2), times, observations, num_iterations=200, num_steps=20
    )
    estimate.params, estimate.standard_errors
    ```
    """
    num_iterations = check_count("num_iterations", num_iterations, 2)
    num_bridges = check_count("num_bridges", num_bridges, 2)
    check_choice("method", method, ("gradient", "em"))
    if not (optimizer is None or isinstance(optimizer, optax.GradientTransformation)):
        raise TypeError(
            f"`optimizer` must be an optimiser of optax, such as `optax.adam(1e-2)`; got "
            f"{optimizer!r}."
        )
    if method == "em" and optimizer is not None:
        raise ValueError('`method="em"` takes no `optimizer`: omit it, or use `method="gradient"`.')
    parameters = as_parameters(model, where, constraint)
    optimizer = _ADAM if optimizer is None else optimizer
    if observation is not None:
        check_key(key)
        check_no_bridges(
            method=method,
            proposal=proposal,
            num_counts=num_counts,
            max_proposals=max_proposals,
            max_trials=max_trials,
        )
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
        if len(unknown) > _MOST_FOR_NEWTON:
            raise ValueError(
                f"{len(unknown)} unknown parameters are too many for the maximum of a record, "
                f"whose limit is {_MOST_FOR_NEWTON}: select some by `where=`, or sample parameters "
                "and noise by `log_density` of `innovations`."
            )
        search = Search(Gradient(optimizer), num_iterations, progress_meter)
        return maximum_of_records(key, parameters, records, unknown, search, num_bridges)
    check_no_record(initial=initial, initial_time=initial_time, jumps=jumps)
    problem = as_problem(key, parameters, times, observations, num_steps, step_size)
    parameters.check_allowed(problem.theta)
    rule = EM() if method == "em" else Gradient(optimizer)
    proposal = "auto" if proposal is None else proposal
    budget = Budget(num_counts, max_proposals, max_trials)
    search = Search(rule, num_iterations, progress_meter)
    if method == "em" and len(problem.theta) > _MOST_FOR_NEWTON:
        raise ValueError(
            f'`method="em"` needs a matrix of {len(problem.theta)} × {len(problem.theta)} numbers '
            'in each iteration: use `method="gradient"`.'
        )
    if method == "em" and problem.sigma_is_unknown:
        raise ValueError(
            "σ depends on the unknown parameters, but a complete path determines σ, so EM would "
            'never change it: use `method="gradient"`, or select other parameters by `where=`.'
        )
    # For so many parameters only the likelihood of paths is differentiated in reverse mode.
    few = problem.sigma_is_unknown or len(problem.theta) <= _MOST_FOR_NEWTON
    if few and method != "em" and prefers_simulation(problem, proposal, budget):
        return _by_simulation(key, problem, proposal, budget, search, num_bridges)
    return _by_bridges(key, problem, proposal, budget, search, num_bridges)


def _by_bridges(
    key: Key[Array, ""],
    problem: Problem,
    proposal: ProposalLike,
    budget: Budget,
    search: Search,
    num_bridges: int,
) -> MaximumLikelihood:
    """Estimate θ by stochastic approximation over bridges, then by Newton's method."""
    parameters, theta = problem.parameters, problem.theta
    augment_key, run_key, score_key = jax.random.split(key, 3)
    augmentation = augment(augment_key, problem, theta, proposal, "exact", None, budget)
    iterates, info = approximate(run_key, parameters, augmentation, search, theta)
    # EM averages its statistics already. Iterates of an optimiser fluctuate around the maximum.
    rough = iterates[-1] if isinstance(search.rule, EM) else _mean_of_later(iterates)
    if len(theta) > _MOST_FOR_NEWTON:
        return _without_errors(parameters, rough, iterates, info)
    scorer = scorer_at(score_key, problem, rough, proposal, budget, num_bridges)
    # New bridges: those of the search depend on the iterates.
    passes = _newton_from(score_key, parameters, scorer, rough)
    is_found = passes.converged & is_maximum(passes.slope)
    fall = falls(passes.slope, passes.offsets)
    return _summary(parameters, passes.theta, iterates, passes.details, info, is_found, fall)


@compiled_sooner
def _newton_from(
    key: Key[Array, ""], parameters: Parameters, scorer: Scorer, theta: Float[Array, " p"]
) -> Passes:
    """Run Newton's method from θ, with new bridges in each pass."""
    scorer, theta = nondifferentiable((scorer, theta))

    def evaluate(i, theta, offsets, memory):
        score, rises = scorer.at(jax.random.fold_in(key, i), theta, offsets)
        return Slope(score.gradient, score.covariance, score.information, rises), score, memory

    return newton_passes(evaluate, parameters, theta, None)


def _by_simulation(
    key: Key[Array, ""],
    problem: Problem,
    proposal: ProposalLike,
    budget: Budget,
    search: Search,
    num_bridges: int,
) -> MaximumLikelihood:
    """Estimate θ by the maximum of the simulated likelihood."""
    parameters, theta = problem.parameters, problem.theta
    proposal = as_differentiable(key, proposal, problem, budget)
    pilot_key, run_key, last_pilot_key, last_key = jax.random.split(key, 4)
    blocks = differentiable_blocks(pilot_key, parameters.bind(theta), problem, proposal)
    iterates, info = stochastic_ascent(run_key, parameters, blocks, search, theta)
    if len(theta) > _MOST_FOR_NEWTON:
        return _without_errors(parameters, _mean_of_later(iterates), iterates, info)
    last = iterates[-1]
    # A good proposal at the first θ may be poor at the last one.
    blocks = differentiable_blocks(last_pilot_key, parameters.bind(last), problem, proposal)
    # The first start satisfies the constraint; the mean of allowed iterates may not.
    starts = jnp.stack([theta, last, _mean_of_later(iterates)])
    maximum = newton_ascent(last_key, parameters, blocks, starts, num_bridges)
    result = maximum.simulated
    at = maximum.theta, result.covariance
    step_error = step_error_of_score(last_key, parameters, blocks, *at, num_bridges)
    at_maximum = as_score(parameters, result, step_error, result.num_missing, jnp.int32(0))
    is_found, fall = maximum.found, maximum.fall
    return _summary(parameters, maximum.theta, iterates, at_maximum, info, is_found, fall)


@compiled_sooner
def _mean_of_later(iterates: Float[Array, "n p"]) -> Float[Array, " p"]:
    """Return the mean of the second half of the iterates."""
    return jnp.mean(iterates[len(iterates) // 2 :], axis=0)


@compiled_sooner
def _without_errors(
    parameters: Parameters,
    estimate: Float[Array, " p"],
    iterates: Float[Array, "n p"],
    info: SearchInfo,
) -> MaximumLikelihood:
    """Return an estimate of so many parameters that its information is not computed."""
    # The set of allowed parameters may not be convex.
    estimate = jnp.where(parameters.allowed(estimate), estimate, iterates[-1])
    unknown = jnp.full_like(estimate, jnp.nan)
    errors = parameters.each(unknown)
    return MaximumLikelihood(
        parameters.full(estimate),
        errors,
        errors,
        estimate,
        None,
        unknown,
        unknown,
        iterates,
        None,
        *info,
        jnp.asarray(False),
        None,
    )


@compiled_sooner
def _summary(
    parameters: Parameters,
    estimate: Float[Array, " p"],
    iterates: Float[Array, "n p"],
    score: Score,
    info: SearchInfo,
    is_found: Bool[Array, ""],
    fall: Float[Array, "2 p"],
) -> MaximumLikelihood:
    """Return the estimate with its errors: those of the score times the inverse information."""
    covariance = jnp.linalg.inv(score.information)
    # Delta method, with the inverse information as the derivative of the zero.
    noise = covariance @ score.covariance @ covariance
    # An error of the score moves its zero by the inverse information times that error.
    step_doubt = jnp.sqrt(covariance**2 @ score.step_uncertainty**2)
    standard, monte_carlo = (
        parameters.each(jnp.sqrt(jnp.diagonal(matrix))) for matrix in (covariance, noise)
    )
    return MaximumLikelihood(
        parameters.full(estimate),
        standard,
        monte_carlo,
        estimate,
        covariance,
        covariance @ score.step_error,
        step_doubt,
        iterates,
        score,
        info.missing,
        info.truncated + score.num_truncated,
        info.refused,
        is_found,
        fall,
    )
