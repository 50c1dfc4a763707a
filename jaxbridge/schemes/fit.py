"""Checks that the model, the end points and the scheme fit together.

They evaluate the model at the end points before any simulation, so errors appear early.
"""

import jax
import numpy as np
from jaxtyping import Array, Float

from ..engine.checks import all_finite_leaves, index_without_compiling, is_traced
from ..engine.compiled import compiled_sooner
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion, check_invertible
from .base import AbstractScheme
from .milstein import Milstein


def check_model(model: Diffusion, intervals: Intervals, scheme: AbstractScheme) -> None:
    """Raise `ValueError` if the end points or the scheme do not fit the model.

    Only values are checked, and traced values are skipped. Shapes are checked when the model's
    functions are traced.
    """
    model.check_invertible_sigma(index_without_compiling(intervals.start, 0))
    if is_traced(model, intervals.start, intervals.end):
        return
    for name, points in [("start", intervals.start), ("end", intervals.end)]:
        coefficients = _coefficients(model, points, isinstance(scheme, Milstein))
        if is_traced(coefficients):  # the model's functions close over traced values
            return
        drift, sigma, slopes = jax.device_get(coefficients)
        for value in (drift, sigma):
            # The reason is either the parameters, or a point outside of the state space.
            bad = ~np.all(np.isfinite(value).reshape(len(value), -1), axis=1)
            if bad.any() and not all_finite_leaves(model.params):
                raise ValueError(f"the `params` of the model must be finite; got {model.params}.")
            if bad.any():
                raise ValueError(
                    f"drift or σ of the model is not finite at `{name}` = {points[bad.argmax()]}: "
                    "pass a point inside the state space."
                )
        # The point where σ is closest to singular.
        worst = np.linalg.cond(sigma).argmax()
        check_invertible(f"diffusion` at `{name}", sigma[worst])
        if slopes is None:
            continue
        other_coordinates = 1 - np.eye(points.shape[1])[:, None, :]
        if np.any(slopes * other_coordinates != 0):
            raise ValueError(
                "`Milstein` needs diagonal noise in which σ_i depends on x_i alone; this σ_i "
                "depends on other coordinates: use `Heun` or `Euler`."
            )


@compiled_sooner
def _coefficients(model: Diffusion, points: Float[Array, "n d"], with_slopes: bool):
    """Return α, σ and ∂σ at the points.

    A constant σ has one row only. ∂σ is `None` for a constant σ, or without `with_slopes`.
    """
    varies = model.sigma_varies(points[0])
    sigma = jax.vmap(model.diffusion)(points if varies else points[:1])
    slopes = jax.vmap(jax.jacfwd(model.diffusion))(points) if varies and with_slopes else None
    return jax.vmap(model.drift)(points), sigma, slopes
