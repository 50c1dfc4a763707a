"""Expectations over exact bridges with correct derivatives in the parameters.

Let bridges Z with weights w be sampled with the parameters θ. Let f_θ be the density of a path with
respect to the law of σW. With the paths fixed, the estimate is a function of θ':

    E_θ'[h_θ'] ≈ Σ w (f_θ'/f_θ)(Z) h_θ'(Z) / Σ w (f_θ'/f_θ)(Z).

At θ' = θ it is the weighted mean. Its derivative is that of the expectation,

    Cov(h, ∇ log f_θ(Z)) + E[∂_θ h_θ].

The derivative of the paths alone is not the derivative of the expectation: θ also decides which
proposal meets and is accepted. Higher derivatives of the estimate are correct too.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import PyTree

from ..engine.averages import PathFunction, evaluate_on_paths, fill_missing_paths, weighted_mean
from ..engine.entry import public_entry
from ..models.diffusion import Diffusion, check_diffusion
from ..schemes import forms_of_targets, log_likelihood_of_steps
from .exact_bridges import AbstractExactBridges
from .importance import WeightedBridges
from .kernels import Chain


@public_entry
def expectation(fn: PathFunction, bridges: WeightedBridges | Chain, model: Diffusion) -> PyTree:
    """Estimate the mean of `fn(path)` over exact bridges, differentiable in the parameters of
    `model`.

    **Arguments:**

    - `fn`: a function of one path, shape (N+1, d). It may depend on parameters itself.
    - `bridges`: weighted bridges or a chain, sampled with the same parameter values, with whole
        paths (no `save_at`). Derivatives are taken at fixed paths. A path determines σ, so σ must
        not depend on the parameters of the derivative.
    - `model`: the model, with the parameters of the derivative.

    **Returns:** the mean of the values of `fn`, with a leading axis I for I intervals. Missing
    bridges have no weight. The mean is NaN if all bridges of an interval are missing. For guided
    proposals with a state-dependent σ the derivative has a discretisation error of first order,
    also where that of the mean is of second order.

    **Raises:** `TypeError` for arguments of other types; `ValueError` if the paths are not whole.

    **Example:**

    ```python
    weighted = jb.weigh_bridges(key, model, bridges)

    def middle(params):
        return jb.expectation(lambda path: path[25], weighted, model.with_params(params))

    jax.jacfwd(middle)(model.params).mean  # shape (2, 2)
    ```
    """
    check_diffusion(model)
    if not isinstance(bridges, AbstractExactBridges):
        raise TypeError(
            f"`bridges` must have the exact law; got {type(bridges).__name__}. Pass a result of "
            "`sample_weighted_bridges`, `weigh_bridges` or `sample_exact_bridges`."
        )
    if bridges.paths.shape[-2] != bridges.num_steps + 1:
        raise ValueError(
            "`bridges` must be whole paths, because the path density needs all steps; got "
            f"{bridges.paths.shape[-2]} of {bridges.num_steps + 1} grid points. Sample them "
            "without `save_at`."
        )
    # Missing paths become finite, so that their zero weight gives zero and not NaN.
    paths = lax.stop_gradient(fill_missing_paths(bridges.paths, bridges.met))
    log_weights = lax.stop_gradient(bridges.log_mean_weights)
    # Step sizes come from the grid: differences of rounded times are inaccurate for unequal steps.
    fractions = np.diff(bridges.proposal.fractions(bridges.num_steps))
    duration = lax.stop_gradient(bridges.times)[..., -1:]
    steps = jnp.asarray(fractions, duration.dtype) * duration
    like = paths.reshape(-1, paths.shape[-1])[0]
    # Bridges of the Euler scheme need its own path density; others take the most accurate one.
    targets = [single.target for single in bridges.proposal.singles]
    form = forms_of_targets(targets, model, like)[0]
    log_f = log_likelihood_of_steps(model, steps, paths, form)
    # Relative to the largest weight, the exponentials cannot overflow.
    largest = jnp.max(log_weights, axis=-1, keepdims=True)
    # The ratio f_θ'/f_θ is one in value; only its derivatives matter.
    ratios = jnp.exp(log_weights - largest + log_f - lax.stop_gradient(log_f))
    weights = ratios / jnp.sum(ratios, axis=-1, keepdims=True)
    return jax.tree.map(lambda value: weighted_mean(weights, value), evaluate_on_paths(fn, paths))
