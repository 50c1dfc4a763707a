"""Maximum likelihood by stochastic approximation over bridges.

Bridges are moved by their exact kernel at the current θ, once an iteration (Gu & Kong 1998), and
θ by what the completed path says:

* "gradient": a step of an optimiser along ∇ log f_θ(Z), whose mean over bridges is the score;
  the estimate is the average of the second half of the iterates.
* "em": with c and P of the expansion of log f at θ, cᵀθ - ½ θᵀPθ, averaged over iterations, θ
  becomes P⁻¹c. For a drift that is linear in θ this is the EM algorithm with averaged
  statistics (Delyon, Lavielle & Moulines 1999); in any case a fixed point has score zero.

Then, at the estimate, `score` with independent bridges gives the observed information I, one step
of Newton's method, θ + I⁻¹ ∇ log L(θ), and the Monte Carlo error that is left.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, Shaped

from .arrays import Numbers, all_finite_leaves, nondifferentiable
from .completion import Completion, Paths, complete
from .diffusion import Diffusion
from .intervals import check_count
from .likelihood import Form
from .linalg import any_solve
from .parameter_steps import CompleteData, quadratic_form
from .parts import target_forms
from .problem import as_problem
from .score import Score, score
from .unknowns import (
    Constraint,
    Unknowns,
    allowed,
    check_allowed,
)

# Made once, for optimisers are compared by identity.
_ADAM = optax.adam(1e-2)


class MaximumLikelihood(eqx.Module):
    """The maximum likelihood estimate, from `maximum_likelihood`.

    - `params`: all parameters of the model, the unknown ones estimated.
    - `standard_errors`: a pytree like the unknown parameters, from the observed information.
    - `monte_carlo_errors`: likewise, of the search for the maximum; more `num_bridges` make them
        smaller.
    - `theta`, `covariance`: the unknown parameters as a vector, shape (p,), and the inverse of
        the observed information, shape (p, p).
    - `iterates`: of the stochastic approximation, shape (n, p).
    - `score`: at the average of the iterates, before the last step.
    - `num_missing`: iterations' bridges that were not found, in all.
    - `num_truncated`: weights that `max_trials` cut off.
    - `num_refused`: iterations whose step led out of the constraint, or to what is not finite, and
        was not made.
    - `newton`: whether the last step was made. Not so if the information was not positive definite,
        or the step longer than about a standard error, or out of the constraint: then the average
        of the iterates is returned, which is not the maximum, and more iterations are needed, or
        longer steps.
    """

    params: PyTree
    standard_errors: PyTree
    monte_carlo_errors: PyTree
    theta: Float[Array, " p"]
    covariance: Float[Array, "p p"]
    iterates: Float[Array, "n p"]
    score: Score
    num_missing: Int[Array, ""]
    num_truncated: Int[Array, ""]
    num_refused: Int[Array, ""]
    newton: Bool[Array, ""]


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
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> MaximumLikelihood:
    """The maximum likelihood estimate of a model's parameters, given discrete observations.

    **Arguments:**

    - `key`: a typed key.
    - `model`: its `params` are where the search starts.
    - `times`, `observations`, `num_steps`, `step_size`, `proposal`, `where`, `constraint`: as in
        `gibbs`. A step that would leave the constraint is not made.
    - `optimizer`: any of optax's, by default `optax.adam(0.01)`; it is given the gradient of minus
        the mean log likelihood per interval, in the unknown parameters as a vector. Optimisers are
        compared by identity: make one once to compile once.
    - `method`: "gradient", or "em", which takes no optimiser and needs fewer iterations.
    - `num_iterations`: of the stochastic approximation.
    - `num_bridges`: weighted bridges of each interval for the last step and the errors.
    - `num_counts`, `max_proposals`, `max_trials`: as in `sample_exact_bridges`.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.

    **Returns:** `MaximumLikelihood`. Not differentiable.

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
    if method not in ("gradient", "em"):
        raise ValueError(f'`method` must be "gradient" or "em"; got {method!r}.')
    if not (optimizer is None or isinstance(optimizer, optax.GradientTransformation)):
        raise TypeError(
            f"`optimizer` must be one of optax's, such as `optax.adam(1e-2)`; got {optimizer!r}."
        )
    if method == "em" and optimizer is not None:
        raise ValueError('`method="em"` takes no `optimizer`.')
    problem = as_problem(
        key,
        model,
        times,
        observations,
        where,
        num_steps,
        step_size,
        "differentiate `transition_log_density` with a proposal that is pulled to the end point, "
        "use `pmmh`, or pick the others with `where=`.",
    )
    unknowns, theta = problem.unknowns, problem.theta
    check_allowed(constraint, unknowns, theta)
    complete_key, run_key, score_key = jax.random.split(key, 3)
    proposal = "auto" if proposal is None else proposal
    bounds = (num_counts, max_proposals, max_trials)
    arguments = (problem.intervals, problem.groups, proposal, "exact", None, bounds)
    completion = complete(complete_key, model, *arguments)
    forms = target_forms(completion.parts, model)
    form = quadratic_form(unknowns, theta, problem.like, forms) or forms[0]
    rule = _EM() if method == "em" else _Gradient(_ADAM if optimizer is None else optimizer)
    meter = diffrax.NoProgressMeter() if progress_meter is None else progress_meter
    setting = _Setting(unknowns, completion, constraint, rule, form)
    iterates, lost = _approximate(run_key, setting, theta, num_iterations, meter)
    rough = iterates[-1] if method == "em" else jnp.mean(iterates[num_iterations // 2 :], axis=0)
    at_rough = score(
        score_key,
        unknowns.at(rough),
        times,
        observations,
        num_bridges=num_bridges,
        num_steps=num_steps,
        step_size=step_size,
        proposal=proposal,
        where=where,
        num_counts=num_counts,
        max_proposals=max_proposals,
        max_trials=max_trials,
    )
    covariance = jnp.linalg.inv(at_rough.information)
    step = covariance @ at_rough.gradient
    definite = jnp.all(jnp.linalg.eigvalsh(at_rough.information) > 0)
    # Further off the likelihood need not be near its quadratic approximation.
    near = at_rough.gradient @ step < theta.shape[0]
    newton = rough + step
    ok = definite & near & allowed(constraint, unknowns, newton)
    estimate = jnp.where(ok, newton, rough)
    left = covariance @ at_rough.covariance @ covariance
    standard, monte_carlo = (
        unknowns.pick(jnp.sqrt(jnp.diagonal(matrix))) for matrix in (covariance, left)
    )
    return MaximumLikelihood(
        unknowns.all(estimate),
        standard,
        monte_carlo,
        estimate,
        covariance,
        iterates,
        at_rough,
        lost.missing,
        lost.truncated + at_rough.num_truncated,
        lost.refused,
        ok,
    )


class _Gradient(eqx.Module):
    """Steps of an optimiser."""

    optimizer: optax.GradientTransformation = eqx.field(static=True)

    def init(self, theta):
        return self.optimizer.init(theta)

    def update(self, i, theta, state, data: CompleteData, num_intervals):
        gradient = jax.grad(data.log_likelihood)(theta) / num_intervals
        updates, state = self.optimizer.update(-gradient, state, theta)
        return theta + jnp.asarray(updates), state


class _EM(eqx.Module):
    """The maximum of the averaged expansions of the log likelihood; they are averaged over the
    later half of the iterations so far, about."""

    def init(self, theta):
        return theta, jnp.zeros((*theta.shape, *theta.shape), theta.dtype)

    def update(self, i, theta, state, data: CompleteData, num_intervals):
        gradient = jax.grad(data.log_likelihood)(theta)
        P = data.information(theta)
        made = gradient + P @ theta, P
        gain = jnp.minimum(1.0, 2.0 / (i + 1).astype(theta.dtype))
        state = jax.tree.map(lambda old, new: old + gain * (new - old), state, made)
        c, P = state
        return any_solve(P, c), state


class _Setting(eqx.Module):
    """What does not change from iteration to iteration."""

    unknowns: Unknowns
    completion: Completion
    constraint: Constraint | None = eqx.field(static=True)
    rule: _Gradient | _EM
    form: Form = eqx.field(static=True)


class _Lost(NamedTuple):
    """Bridges that were not found, weights that were cut off, and steps that were not made."""

    missing: Shaped[Array, "..."]
    truncated: Shaped[Array, "..."]
    refused: Shaped[Array, "..."]


class _State(NamedTuple):
    theta: Float[Array, " p"]
    paths: Paths
    rule: PyTree
    meter: Any


@eqx.filter_jit
def _approximate(
    key: Key[Array, ""],
    setting: _Setting,
    theta: Float[Array, " p"],
    num_iterations: int,
    meter: diffrax.AbstractProgressMeter,
) -> tuple[Float[Array, "n p"], _Lost]:
    """The iterates, and what was lost on the way."""
    setting = nondifferentiable(setting)
    unknowns, completion = setting.unknowns, setting.completion
    first_key, run_key = jax.random.split(key)
    num_intervals = completion.num_intervals

    def iterate(state, i):
        paths, renewed = completion.renew(
            jax.random.fold_in(run_key, i), unknowns.at(state.theta), state.paths
        )
        data = CompleteData(
            unknowns, completion, paths, jnp.zeros_like, setting.constraint, setting.form
        )
        moved, rule = setting.rule.update(i, state.theta, state.rule, data, num_intervals)
        finite = all_finite_leaves(rule)
        ok = allowed(setting.constraint, unknowns, moved) & finite
        theta = jnp.where(ok, moved, state.theta)
        # What an optimiser remembers must not be spoilt for all steps to come.
        rule = jax.tree.map(lambda new, old: jnp.where(finite, new, old), rule, state.rule)
        progress = meter.step(state.meter, (i + 1).astype(jnp.float32) / num_iterations)
        lost = _Lost(renewed.missing, renewed.truncated, ~ok)
        lost = jax.tree.map(lambda leaf: jnp.sum(leaf, dtype=jnp.int32), lost)
        return _State(theta, paths, rule, progress), (theta, lost)

    first = completion.first(first_key, unknowns.at(theta))
    state = _State(theta, first, setting.rule.init(theta), meter.init())
    state, (iterates, lost) = lax.scan(iterate, state, jnp.arange(num_iterations))
    meter.close(state.meter)
    return iterates, jax.tree.map(lambda leaf: jnp.sum(leaf, dtype=jnp.int32), lost)
