"""Maximum likelihood: by stochastic approximation over bridges, or of a simulated likelihood.

Where σ is known, the search is by `stochastic_approximation` over bridges: with an optimiser it
ends in the average of the second half of the iterates, by EM in the last. From there Newton's
method (`newton`) goes on by scores and information of independent bridges, new ones in each pass.

Where σ depends on the unknown parameters paths are of no use, and the maximum is that of the
likelihood by simulation (`simulated_likelihood`).

Of records that were seen with noise or in part see `record_maximum`.
"""

from collections.abc import Callable
from typing import Any, Literal

import diffrax
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.arguments import check_choice
from ..engine.checks import Numbers, check_count, check_key, nondifferentiable
from ..engine.compiled import compiled_sooner
from ..engine.doors import door
from ..engine.verdict import AbstractResult, Fault, Verdict
from ..models.diffusion import Diffusion
from ..proposals import Budget
from ..records import Initial, Observation, as_record_problems
from ..schemes import StepError, dominates, step_fault
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
    as_pulled,
    newton_ascent,
    pulled_blocks,
    step_error_of_score,
    stochastic_ascent,
)
from .stochastic_approximation import EM, Gradient, Search, SearchInfo, approximate

# Made once, for optimisers are compared by identity.
_ADAM = optax.adam(1e-2)


class MaximumLikelihood(AbstractResult):
    """The maximum likelihood estimate, from `maximum_likelihood`.

    - `params`: all parameters of the model, the unknown ones estimated.
    - `standard_errors`: a pytree like the unknown parameters, from the observed information.
    - `monte_carlo_errors`: likewise, of the search for the maximum; more `num_bridges` make them
        smaller.
    - `theta`, `covariance`: the unknown parameters as a vector, shape (p,), and the inverse of
        the observed information, shape (p, p).
    - `step_error`: what `theta` is too large by for the length of the steps, an estimate, shape
        (p,), with a standard error of it, `step_uncertainty`. NaN where it is not known.
    - `iterates`: of the stochastic approximation, shape (n, p).
    - `score`: where the last pass of Newton's method was, before its step; where σ is unknown, at
        the estimate, so that its gradient is about zero, and the covariance of that by the noise of
        the bridges is what matters. Errors can be trusted where its `effective_sample_size` is
        large in all intervals.
    - `num_missing`: iterations' bridges that were not found, in all.
    - `num_truncated`: weights that `max_trials` cut off.
    - `num_refused`: iterations whose step led out of the constraint, or to what is not finite, and
        was not made.
    - `newton`: whether Newton's method converged to a maximum: the next step is short beside the
        standard errors or the Monte Carlo errors, the information is positive definite, and no
        Monte Carlo error, in any direction, is more than half a standard error. If not, `params`
        are no estimate: more iterations are needed, longer steps or more bridges, unless the
        maximum lies out of the constraint.
    - `fall`: by how much the log-likelihood falls where a parameter is one standard error below and
        above the estimate, and the others follow, shape (2, p). It is 0.5 if the log-likelihood is
        quadratic, and near zero or below where it levels off, so that no maximum is inside;
        infinite out of the constraint.
    """

    params: PyTree
    standard_errors: PyTree
    monte_carlo_errors: PyTree
    theta: Float[Array, " p"]
    covariance: Float[Array, "p p"]
    step_error: Float[Array, " p"]
    step_uncertainty: Float[Array, " p"]
    iterates: Float[Array, "n p"]
    score: Score
    num_missing: Int[Array, ""]
    num_truncated: Int[Array, ""]
    num_refused: Int[Array, ""]
    newton: Bool[Array, ""]
    fall: Float[Array, "2 p"]

    @property
    def verdict(self) -> Verdict:
        """Return the faults: no maximum, or none inside, the faults of the weights of `score`, a
        step error that dominates and is beyond 0.05 standard errors."""
        sd = jnp.sqrt(jnp.diagonal(self.covariance))
        steps = step_fault(StepError(self.step_error, self.step_uncertainty), sd, sd)
        return Verdict(
            (
                *maximum_faults(self.newton, self.fall),
                *self.score._weight_faults,
                Fault(jnp.any(steps.present), steps.sentence),
            )
        ).with_finite(self.theta, self.covariance)

    @property
    def step_error_dominates(self) -> Bool[Array, " p"]:
        """Whether the step error is beyond the standard error of the estimate, or not known well
        enough to say: then more steps are needed."""
        error = StepError(self.step_error, self.step_uncertainty)
        return dominates(error, jnp.sqrt(jnp.diagonal(self.covariance)))


@door
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
    proposal: Any = "auto",
    where: Callable[[PyTree], PyTree] | None = None,
    constraint: Constraint | None = None,
    observation: Observation | None = None,
    initial: Initial = None,
    initial_time: Numbers | None = None,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> MaximumLikelihood | RecordMaximumLikelihood:
    """The maximum likelihood estimate of a model's parameters, given discrete observations.

    **Arguments:**

    - `key`: a typed key.
    - `model`: its `params` are where the search starts. σ may depend on the unknown parameters:
        then the maximum is that of the likelihood by simulation, as below.
    - `times`, `observations`, `num_steps`, `step_size`, `proposal`, `where`, `constraint`: as in
        `gibbs`. A step that would leave the constraint is not made.
    - `optimizer`: any of optax's, by default `optax.adam(0.01)`; it is given the gradient of minus
        the mean log likelihood per interval, in the unknown parameters as a vector. Optimisers are
        compared by identity: make one once to compile once.
    - `method`: "gradient", or "em", which takes no optimiser and needs fewer iterations, and a
        known σ.
    - `num_iterations`: of the stochastic approximation.
    - `num_bridges`: weighted bridges of each interval in each pass of Newton's method, which follow
        the iterations, and for the errors; where σ is unknown, for the likelihood whose maximum is
        the estimate.
    - `observation`, `initial`, `initial_time`: for records that were seen with noise or in part, as
        in `innovations`. Any parameters may be unknown there, and `num_bridges` are draws of each
        of eight chains of paths.
    - `num_counts`, `max_proposals`, `max_trials`: as in `sample_exact_bridges`.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.

    **Where σ is unknown** a path of its own tells nothing: given the whole of it σ is known. There
    the transition densities of `transition_log_density` are differentiated, which takes proposals
    that are pulled to the end point, by default the best of them. After the optimiser's steps, each
    with a few new paths, Newton's method goes to the maximum of the likelihood by `num_bridges`
    paths of each interval with fixed noise, a smooth function of θ. Half the estimated relative
    variance of each density is added to its logarithm, whose mean is too small by that; what is
    left of the bias falls with the square of `num_bridges`, and is small beside a standard error
    where the root of the number of intervals is small beside the square of
    `effective_sample_size`. For a σ that varies with the state the density's step error is of first
    order: `num_steps` matters. Only σ σᵀ is in the law of the data: of a matrix, leave unknown
    what that determines.

    **Returns:** `MaximumLikelihood`; with an `observation`, `RecordMaximumLikelihood`. Not
    differentiable.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

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
            f"`optimizer` must be one of optax's, such as `optax.adam(1e-2)`; got {optimizer!r}."
        )
    if method == "em" and optimizer is not None:
        raise ValueError('`method="em"` takes no `optimizer`.')
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
        options = {"num_steps": num_steps, "step_size": step_size, "initial_time": initial_time}
        records = as_record_problems(model, times, observations, observation, initial, **options)
        unknown = theta_of_model(parameters, records.stacked.like.dtype)
        search = Search(Gradient(optimizer), num_iterations, progress_meter)
        return maximum_of_records(key, parameters, records, unknown, search, num_bridges)
    check_no_record(initial=initial, initial_time=initial_time)
    problem = as_problem(key, parameters, times, observations, num_steps, step_size)
    parameters.check_allowed(problem.theta)
    rule = EM() if method == "em" else Gradient(optimizer)
    proposal = "auto" if proposal is None else proposal
    budget = Budget(num_counts, max_proposals, max_trials)
    search = Search(rule, num_iterations, progress_meter)
    if not problem.sigma_is_unknown:
        return _by_bridges(key, problem, proposal, budget, search, num_bridges)
    if method == "em":
        raise ValueError(
            "σ depends on the unknown parameters, and given a whole path σ is known, so that "
            'EM would never leave it: use `method="gradient"`, or pick the other parameters '
            "with `where=`."
        )
    return _by_simulation(key, problem, proposal, budget, search, num_bridges)


def _by_bridges(
    key: Key[Array, ""],
    problem: Problem,
    proposal: Any,
    budget: Budget,
    search: Search,
    num_bridges: int,
) -> MaximumLikelihood:
    """Stochastic approximation, and Newton's method."""
    parameters, theta = problem.parameters, problem.theta
    augment_key, run_key, score_key = jax.random.split(key, 3)
    augmentation = augment(augment_key, problem, theta, proposal, "exact", None, budget)
    iterates, info = approximate(run_key, parameters, augmentation, search, theta)
    rough = iterates[-1] if isinstance(search.rule, EM) else _mean_of_later(iterates)
    scorer = scorer_at(score_key, problem, rough, proposal, budget, num_bridges)
    passes = _refined(score_key, parameters, scorer, rough)
    found = passes.converged & is_maximum(passes.slope)
    fall = falls(passes.slope, passes.offsets)
    return _summary(parameters, passes.theta, iterates, passes.details, info, found, fall)


@compiled_sooner
def _refined(
    key: Key[Array, ""], parameters: Parameters, scorer: Scorer, theta: Float[Array, " p"]
) -> Passes:
    """Newton's method from θ, with new bridges in each pass."""
    scorer, theta = nondifferentiable((scorer, theta))

    def evaluate(i, theta, offsets, memory):
        score, rises = scorer.at(jax.random.fold_in(key, i), theta, offsets)
        return Slope(score.gradient, score.covariance, score.information, rises), score, memory

    return newton_passes(evaluate, parameters, theta, None)


def _by_simulation(
    key: Key[Array, ""],
    problem: Problem,
    proposal: Any,
    budget: Budget,
    search: Search,
    num_bridges: int,
) -> MaximumLikelihood:
    """The maximum of the simulated likelihood."""
    parameters, theta = problem.parameters, problem.theta
    proposal = as_pulled(proposal, parameters.model, problem.like, budget)
    pilot_key, run_key, last_pilot_key, last_key = jax.random.split(key, 4)
    blocks = pulled_blocks(pilot_key, parameters.bind(theta), problem, proposal)
    iterates, info = stochastic_ascent(run_key, parameters, blocks, search, theta)
    last = iterates[-1]
    # What suits the data at the first θ need not do so at the last.
    blocks = pulled_blocks(last_pilot_key, parameters.bind(last), problem, proposal)
    starts = jnp.stack([theta, last, _mean_of_later(iterates)])
    maximum = newton_ascent(last_key, parameters, blocks, starts, num_bridges)
    made = maximum.simulated
    step_error = step_error_of_score(last_key, parameters, blocks, maximum, num_bridges)
    at_maximum = as_score(parameters, made, step_error, made.num_missing, jnp.int32(0))
    found, fall = maximum.found, maximum.fall
    return _summary(parameters, maximum.theta, iterates, at_maximum, info, found, fall)


@compiled_sooner
def _mean_of_later(iterates: Float[Array, "n p"]) -> Float[Array, " p"]:
    return jnp.mean(iterates[len(iterates) // 2 :], axis=0)


@compiled_sooner
def _summary(
    parameters: Parameters,
    estimate: Float[Array, " p"],
    iterates: Float[Array, "n p"],
    score: Score,
    info: SearchInfo,
    found: Bool[Array, ""],
    fall: Float[Array, "2 p"],
) -> MaximumLikelihood:
    """The estimate with its errors, which are those of the score times the inverse information."""
    covariance = jnp.linalg.inv(score.information)
    left = covariance @ score.covariance @ covariance
    # Where the score is too large by this, so is its zero by that times the inverse information.
    step_doubt = jnp.sqrt(covariance**2 @ score.step_uncertainty**2)
    standard, monte_carlo = (
        parameters.each(jnp.sqrt(jnp.diagonal(matrix))) for matrix in (covariance, left)
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
        found,
        fall,
    )
