"""The function `effects`: the effects that the compiled program of a model contains, with reasons.

It calls all the decisions that couplings, schemes and models make.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..engine.checks import Numbers, as_floating, check_num_steps
from ..engine.entry import public_entry
from ..engine.noise import chunk_shape
from ..models import decisions
from ..models.decisions import Effects
from ..models.diffusion import Diffusion, check_diffusion
from ..schemes import GaussianTransition, Heun, HeunOrEuler, scheme_for
from .base import AbstractCoupling, check_coupling
from .gamma import Coupling
from .rotation import driven_through_root, root_effect, rotation_effect

# Dimensions to try for a model that does not state its own, most likely ones first. Most models
# that accept two accept them all.
_DIMENSIONS = (2, 1, *range(3, 65))


@public_entry
def effects(
    model: Diffusion,
    coupling: AbstractCoupling | None = None,
    *,
    at: Numbers | None = None,
    num_steps: int = 50,
    save_at: Numbers | None = None,
) -> Effects:
    """Return a table of the effects that the program of a model simulates or omits, with reasons.

    The program itself makes the same decisions.

    **Arguments:**

    - `model`, `coupling`: as in `sample_bridges`.
    - `at`: any point of the state space, shape (d,). The default is zero, in the first of the
        dimensions 2, 1, 3, ..., 64 that the functions of the model accept.
    - `num_steps`, `save_at`: as in `sample_bridges`.

    **Returns:** `Effects`, which prints as a table. The last four rows are for guided paths, the
    others for couplings. Couplings do not apply if σ has fewer columns than rows, or if
    coefficients depend on time. Then all rows for couplings are left out.

    **Raises:** `ValueError` if `at` is not a point, if no dimension fits, or if the time reversal
    is unknown; `TypeError` if `model` is not a `Diffusion` or `coupling` is not a `Coupling`.

    **Example:**

    ```python
    print(jb.effects(jb.hyperbolic(0.8, 2), jb.Coupling(-1.0)))
    jb.effects(model).reverse_drift.why
    ```
    """
    check_diffusion(model)
    coupling = Coupling() if coupling is None else coupling
    check_coupling(coupling)
    num_steps = check_num_steps(num_steps, 1)
    like = _find_point(model) if at is None else as_floating("at", at)
    if like.ndim != 1 or not like.size:
        raise ValueError(
            f"`at` must be one point, shape (d,); got shape {like.shape}. Pass any point of the "
            "state space."
        )
    # Couplings need an invertible σ and a stationary law, so time-independent coefficients.
    invertible, depends_on_time = model.sigma_is_invertible(like), model.depends_on_time
    of_guided_paths = {
        "noise_by_drift": decisions.noise_by_drift(invertible),
        "quadratic_noise": decisions.quadratic_noise(
            invertible, model.sigma_varies(like), like.shape[0]
        ),
        "exact_steps": decisions.exact_steps(model.is_linear(like)),
        "time": decisions.time(depends_on_time),
    }
    if not invertible:
        return decisions.without_pairs(of_guided_paths, "σ has fewer columns than rows")
    if depends_on_time:
        return decisions.without_pairs(of_guided_paths, "coefficients depend on time")
    model.check_reversal()
    forward, backward = model.forward(like), model.backward(like)
    # The types of σ before and after the change to the triangular root; nothing is computed.
    own_sigma, sigma = (
        type(eqx.filter_eval_shape(dynamics.sigma, like))
        for dynamics in (forward, driven_through_root(coupling, forward, like))
    )
    # `HeunOrEuler` becomes one of its schemes for each equation. The steps of a pair are exact only
    # if the drifts of both directions are recognised as linear.
    both = [scheme_for(coupling.scheme, equation, like) for equation in (forward, backward)]
    scheme = min(both, key=lambda scheme: isinstance(scheme, GaussianTransition))
    reverse_drift = model.reverse_drift_effect
    return Effects(
        reverse_drift,
        decisions.divergence(reverse_drift, forward.sigma_varies),
        decisions.solves(sigma),
        root_effect(coupling, own_sigma),
        rotation_effect(coupling, sigma),
        decisions.independent_noise(coupling.independent_noise),
        decisions.crossing_uniforms(coupling.meeting.draws_uniform),
        _corrector(coupling.scheme, scheme, forward),
        decisions.stratonovich(scheme.stratonovich, forward.sigma_varies),
        decisions.stored_times(None if save_at is None else as_floating("save_at", save_at).size),
        decisions.early_stop(chunk_shape(num_steps)[0]),
        **of_guided_paths,
    )


def _find_point(model: Diffusion) -> Float[Array, " d"]:
    """Return zero, in the first dimension that the functions of the model accept."""
    for d in _DIMENSIONS:
        like = jnp.zeros(d)
        try:
            # Tracing raises an error for a wrong dimension, at no numerical cost.
            jax.eval_shape(functools.partial(_coefficients, model), like)
        except (IndexError, TypeError, ValueError):  # a point of a wrong shape
            continue
        return like
    raise ValueError(
        "the dimension of the model is unknown: its functions accept no point of 1 to 64 "
        "dimensions. Pass a point of the state space as `at`, shape (d,)."
    )


def _coefficients(model: Diffusion, x: Float[Array, " d"]) -> tuple[Array, Array]:
    time = jnp.zeros((), x.dtype) if model.depends_on_time else None
    return model.drift(x, time), model.diffusion(x, time)


def _corrector(asked_for, scheme, forward) -> decisions.Effect:
    """Return the effect of the corrector step; `scheme` is that of this equation."""
    if isinstance(asked_for, HeunOrEuler):
        return decisions.corrector(forward.sigma_varies, isinstance(scheme, GaussianTransition))
    return decisions.Effect(
        isinstance(scheme, Heun), f"the coupling's choice, `{type(scheme).__name__}`"
    )
