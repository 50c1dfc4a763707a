"""The score of discrete observations, by Fisher's identity, and the observed information.

With Z the exact bridge of an interval and f_θ the density of its path,

    ∇ log p_T(a, b) = E[∇ log f_θ(Z)],
    -∇² log p_T(a, b) = E[-∇² log f_θ(Z)] - Cov(∇ log f_θ(Z)),

the latter by Louis (1982); both are sums over the intervals. Means are over weighted bridges.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Key, PyTree

from ..engine.averages import effective_size, normalised
from ..engine.checks import Numbers, check_count, nondifferentiable
from ..engine.pareto import pareto_k
from ..models.diffusion import Diffusion
from ..schemes.halving import num_looked
from ..schemes.path_likelihood import Form, log_likelihoods
from ..schemes.step_error import StepError, of_mean
from .blocks import Block, log_halvings, make_blocks, step_shares, target_forms
from .data import as_problem
from .parameters import Parameters

# Bridges of all intervals that are made at a time.
_PATHS = 8_192


class Score(eqx.Module):
    """What `score` returns: the gradient of the log likelihood at the model's parameters, with
    Monte Carlo errors.

    - `value`, `standard_error`: pytrees like the unknown parameters.
    - `gradient`, `covariance`: the same as a vector of shape (p,) with the covariance of its
        Monte Carlo error, shape (p, p).
    - `information`: the observed information, -∇² of the log likelihood, shape (p, p).
    - `effective_sample_size`: of the bridges of each interval, shape (I,). Errors can be trusted
        where it is large.
    - `pareto_k`: k̂ of the weights of each interval, shape (I,): where it is above 0.7 neither
        its part of the score nor the error of that can be trusted.
    - `step_error`: what `gradient` is too large by for the length of the steps, an estimate, shape
        (p,), with a standard error of it, `step_uncertainty`. NaN where it is not known.
    - `num_missing`: intervals without any bridge. They are left out.
    - `num_truncated`: weights that `max_trials` cut off.
    """

    value: PyTree
    standard_error: PyTree
    gradient: Float[Array, " p"]
    covariance: Float[Array, "p p"]
    information: Float[Array, "p p"]
    effective_sample_size: Float[Array, " I"]
    pareto_k: Float[Array, " I"]
    step_error: Float[Array, " p"]
    step_uncertainty: Float[Array, " p"]
    num_missing: Int[Array, ""]
    num_truncated: Int[Array, ""]


def score(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    num_bridges: int = 100,
    num_steps: int | None = None,
    step_size: float | None = None,
    proposal: Any = "auto",
    where: Callable[[PyTree], PyTree] | None = None,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> Score:
    """The score and the observed information of discrete observations, at `model.params`.

    **Arguments:**

    - `key`: a typed key.
    - `model`, `times`, `observations`, `num_steps`, `step_size`, `where`: as in `gibbs`.
    - `num_bridges`: weighted bridges for each interval. Means over them have a bias of the order
        of one over their effective number, beside the Monte Carlo error.
    - `proposal`: anything that `sample_weighted_bridges` takes; by default "auto".
    - `num_counts`, `max_proposals`, `max_trials`: as in `sample_weighted_bridges`.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.

    **Returns:** `Score`. Not differentiable.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    **Example:**

    ```python
    estimate = jb.score(key, jb.hyperbolic(0.8, 2), times, observations, num_steps=20)
    estimate.value, estimate.standard_error
    ```
    """
    num_bridges = check_count("num_bridges", num_bridges, 2)
    problem = as_problem(
        key,
        model,
        times,
        observations,
        where,
        num_steps,
        step_size,
        "differentiate `transition_log_density` with a proposal that is pulled to the end point, "
        "or pick the others with `where=`.",
    )
    parameters, theta = problem.parameters, problem.theta
    bounds = (num_counts, max_proposals, max_trials)
    arguments = (problem.intervals, problem.groups, proposal, bounds)
    blocks = make_blocks(key, model, *arguments, moving=False)
    form = target_forms(blocks, model)[0]
    keys = jax.random.split(key, len(blocks))
    made = [
        _interval_moments(block_key, parameters, theta, block, form, num_bridges, progress_meter)
        for block_key, block in zip(keys, blocks, strict=True)
    ]
    moments, sizes, shapes, step_errors, truncated = zip(*made, strict=True)
    gradient, covariance, information = jax.tree.map(lambda *blocks: sum(blocks), *moments)
    order = jnp.argsort(jnp.concatenate([block.index for block in blocks]))
    size, shape = jnp.concatenate(sizes)[order], jnp.concatenate(shapes)[order]
    step_error = sum(error.value for error in step_errors)
    step_variance = sum(error.uncertainty**2 for error in step_errors)
    error = jnp.sqrt(jnp.maximum(jnp.diagonal(covariance), 0))
    return Score(
        parameters.select(gradient),
        parameters.select(error),
        gradient,
        covariance,
        information,
        size,
        shape,
        jnp.asarray(step_error),
        jnp.sqrt(step_variance),
        jnp.sum(size == 0, dtype=jnp.int32),
        jnp.sum(jnp.stack(truncated), dtype=jnp.int32),
    )


@eqx.filter_jit
def _interval_moments(
    key: Key[Array, ""],
    parameters: Parameters,
    theta: Float[Array, " p"],
    block: Block,
    form: Form,
    num_bridges: int,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> tuple[
    tuple[Array, Array, Array], Float[Array, " I"], Float[Array, " I"], StepError, Int[Array, ""]
]:
    """Σ over intervals of the score, of the covariance of its error, and of the information; the
    effective number of bridges of each, and k̂; the step error of the score; and how many weights
    were cut off."""
    parameters, intervals = nondifferentiable((parameters, block.intervals))
    model = parameters.bind(theta).prepared()
    num_intervals, num_steps = intervals.start.shape[0], block.num_steps
    at_once = min(num_bridges, max(1, _PATHS // num_intervals))
    num_batches = -(-num_bridges // at_once)
    varies = model.forward(intervals.start[0]).sigma_varies
    num_some = num_looked(at_once, varies)
    meter = diffrax.NoProgressMeter() if progress_meter is None else progress_meter
    steps = jnp.repeat(block.steps, at_once, axis=1)

    def batch(state, i):
        keys = jax.random.split(jax.random.fold_in(key, i), (num_intervals, at_once))
        drawn = block.proposal.draw(keys, model, intervals, num_steps, None, False)
        start = intervals.start[:, None, None]
        paths = jnp.where(drawn.found[..., None, None], drawn.paths, start)
        paths = paths.reshape(-1, *paths.shape[2:])

        def log_f(theta):
            return log_likelihoods(parameters.bind(theta), steps, paths, form)

        gradient = jax.jacfwd(log_f)
        g, H = (
            derivative.reshape(num_intervals, at_once, *derivative.shape[1:])
            for derivative in (gradient(theta), jax.jacfwd(gradient)(theta))
        )
        some = paths.reshape(num_intervals, at_once, *paths.shape[1:])[:, :num_some]
        some = some.reshape(-1, *paths.shape[1:])

        def log_halving(theta):
            return log_halvings(block, parameters.bind(theta).prepared(), some, form, num_some)

        D, slope = (
            leaf.reshape(num_intervals, num_some, *leaf.shape[1:])
            for leaf in (log_halving(theta), jax.jacfwd(log_halving)(theta))
        )
        state = meter.step(state, (i + 1).astype(jnp.float32) / num_batches)
        return state, (drawn.log_weights, g, H, drawn.truncated, D, slope)

    state, made = lax.scan(batch, meter.init(), jnp.arange(num_batches))
    meter.close(state)

    def join(leaf):
        leaf = jnp.moveaxis(leaf, 0, 1)
        return leaf.reshape(num_intervals, -1, *leaf.shape[3:])

    *made, D, slope = made
    some_weights, some_g = (join(leaf[:, :, :num_some]) for leaf in made[:2])
    share = step_shares(block, model, form)
    halves = (some_g, some_g + join(slope))
    error = of_mean(some_weights, join(D), share, *halves)
    step_error = StepError(
        jnp.sum(error.value, axis=0), jnp.sqrt(jnp.sum(error.uncertainty**2, axis=0))
    )
    log_weights, g, H, truncated = (join(leaf)[:, :num_bridges] for leaf in made)
    weights = normalised(log_weights)
    mean = jnp.sum(weights[..., None] * g, axis=1)
    deviation = g - mean[:, None]
    products = deviation[..., :, None] * deviation[..., None, :]
    squares = jnp.sum(weights**2, axis=1)
    # Of n independent bridges; a weighted mean of squares is too small by 1 - Σ w².
    less = jnp.where(squares < 1, 1 - squares, 1)[:, None, None]
    spread = jnp.sum(weights[..., None, None] * products, axis=1) / less
    covariance = jnp.sum(weights[..., None, None] ** 2 * products, axis=1)
    information = -jnp.sum(weights[..., None, None] * H, axis=1) - spread
    num_truncated = jnp.sum(truncated, dtype=jnp.int32)
    moments = (mean.sum(axis=0), covariance.sum(axis=0), information.sum(axis=0))
    shape = pareto_k(log_weights)
    return moments, effective_size(weights), shape, step_error, num_truncated
