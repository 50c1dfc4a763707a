"""Expectations over exact bridges whose derivatives in the parameters are right.

With bridges Z of weights w, made at θ, and f_θ the density of a path relative to that of σW,

    E_θ'[h_θ'] ≈ Σ w (f_θ'/f_θ)(Z) h_θ'(Z) / Σ w (f_θ'/f_θ)(Z),

as a function of θ' at fixed paths. At θ' = θ it is the weighted mean, and its derivative is

    Cov(h, ∇ log f_θ(Z)) + E[∂_θ h_θ],

that of the expectation: which bridge is proposed, met and accepted depends on θ as well, so the
derivative of the paths themselves is not. Higher derivatives are right, too.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import PyTree

from ..engine.averages import PathFunction, filled, values_of, weighted_mean
from ..engine.doors import door
from ..models.diffusion import Diffusion, check_diffusion
from ..schemes import forms_of_targets, log_likelihood_of_steps
from .exact_bridges import AbstractExactBridges
from .importance import WeightedBridges
from .kernels import Chain


@door
def expectation(fn: PathFunction, bridges: WeightedBridges | Chain, model: Diffusion) -> PyTree:
    """The mean of `fn(path)` over exact bridges, differentiable in the parameters of `model`.

    **Arguments:**

    - `fn`: a function of one path, shape (N+1, d). It may depend on parameters itself.
    - `bridges`: weighted ones, or a chain, at all steps of their grid (no `save_at`), made with
        the same parameters. They are held fixed; so is σ, which must not depend on parameters
        that derivatives are taken in.
    - `model`: the model, at the parameters in which derivatives are taken.

    **Returns:** what `fn` returns, averaged; with a leading axis I for I intervals. Bridges that
    are missing have no weight; NaN where all of an interval are.

    **Raises:** `TypeError` for other bridges; `ValueError` where they were not kept whole.

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
            "`bridges` must have the exact law: pass what `sample_weighted_bridges`, "
            f"`weigh_bridges` or `sample_exact_bridges` returned; got {type(bridges).__name__}."
        )
    if bridges.paths.shape[-2] != bridges.num_steps + 1:
        raise ValueError(
            "the likelihood of a bridge is that of its whole path, but these were kept at "
            f"{bridges.paths.shape[-2]} of {bridges.num_steps + 1} grid points: make them without "
            "`save_at`."
        )
    paths = lax.stop_gradient(filled(bridges.paths, bridges.met))
    log_weights = lax.stop_gradient(bridges.log_mean_weights)
    # Of the grid, for differences of rounded times would not do where its steps are unequal.
    fractions = np.diff(bridges.proposal.fractions(bridges.num_steps))
    duration = lax.stop_gradient(bridges.times)[..., -1:]
    steps = jnp.asarray(fractions, duration.dtype) * duration
    like = paths.reshape(-1, paths.shape[-1])[0]
    targets = [single.target for single in bridges.proposal.singles]
    form = forms_of_targets(targets, model, like)[0]
    log_f = log_likelihood_of_steps(model, steps, paths, form)
    largest = jnp.max(log_weights, axis=-1, keepdims=True)
    ratios = jnp.exp(log_weights - largest + log_f - lax.stop_gradient(log_f))
    weights = ratios / jnp.sum(ratios, axis=-1, keepdims=True)
    return jax.tree.map(lambda value: weighted_mean(weights, value), values_of(fn, paths))
