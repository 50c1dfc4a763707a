"""Checks that the model, the end points and the scheme fit together."""

import jax
import numpy as np
from jaxtyping import Array, Float

from ..engine.checks import all_finite_leaves, is_traced, taken
from ..engine.compiled import compiled_sooner
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion, check_invertible
from .base import AbstractScheme
from .milstein import Milstein


def check_model(model: Diffusion, intervals: Intervals, scheme: AbstractScheme) -> None:
    """Raise `ValueError` where the model does not fit the end points, or the scheme the model.

    Shapes are checked wherever the model's functions are traced, so here only values are.
    """
    model.check_invertible_sigma(taken(intervals.start, 0))
    if is_traced(model, intervals.start, intervals.end):
        return
    for name, points in [("start", intervals.start), ("end", intervals.end)]:
        coefficients = _coefficients(model, points, isinstance(scheme, Milstein))
        if is_traced(coefficients):  # the model's functions close over traced values
            return
        drift, sigma, slopes = jax.device_get(coefficients)
        for value in (drift, sigma):
            bad = ~np.all(np.isfinite(value).reshape(len(value), -1), axis=1)
            if bad.any() and not all_finite_leaves(model.params):
                raise ValueError(f"the `params` of the model must be finite; got {model.params}.")
            if bad.any():
                raise ValueError(
                    f"drift or σ of the model is not finite at `{name}` = {points[bad.argmax()]}: "
                    "pass a point inside the state space."
                )
        worst = np.linalg.cond(sigma).argmax()
        check_invertible(f"diffusion` at `{name}", sigma[worst])
        if slopes is None:
            continue
        other_coordinates = 1 - np.eye(points.shape[1])[:, None, :]
        if np.any(slopes * other_coordinates != 0):
            raise ValueError(
                "`Milstein` needs diagonal noise in which σ_i depends on x_i alone; here σ_i "
                "depends on other coordinates, too. Use `Heun` or `Euler`."
            )


@compiled_sooner
def _coefficients(model: Diffusion, points: Float[Array, "n d"], with_slopes: bool):
    """α and σ at the points, a constant σ only once; ∂σ where it is asked for and varies."""
    varies = model.sigma_varies(points[0])
    sigma = jax.vmap(model.diffusion)(points if varies else points[:1])
    slopes = jax.vmap(jax.jacfwd(model.diffusion))(points) if varies and with_slopes else None
    return jax.vmap(model.drift)(points), sigma, slopes
