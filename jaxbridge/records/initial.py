"""The law of the state at the beginning of a record: a normal law, and what is left to weigh."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from ..coupling import Stationary
from ..engine.checks import as_floating, is_traced
from ..engine.linalg import cholesky, dot, inverse, matvec, semidefinite_cholesky, solve_lower
from ..models.diffusion import Diffusion
from ..models.gaussian_law import GaussianLaw
from .tilted_step import NormalStep

# Of Newton's method for the mode of ν, from the origin.
_NEWTON_STEPS = 50

Initial = Any  # a point, a `GaussianLaw`, `Stationary()`, or a function of params to one of these


def initial_law(initial: Initial, model: Diffusion, like: Float[Array, " d"]) -> NormalStep:
    """The law of X(t_0), a point like this one, or a normal law near it (`log_ratio`).

    **Raises:** `TypeError` and `ValueError` for what is none.
    """
    dtype = like.dtype
    initial = bound(initial, model)
    if isinstance(initial, GaussianLaw):
        _check_shape(initial.mean, like)
        root = semidefinite_cholesky(initial.covariance.astype(dtype))
        return NormalStep(initial.mean.astype(dtype), root)
    if isinstance(initial, Stationary):
        return _stationary(model, like)
    point = as_floating("initial", initial).astype(dtype)
    _check_shape(point, like)
    if not is_traced(point) and not np.all(np.isfinite(point)):
        raise ValueError(f"`initial` must be finite; got {point}.")
    return NormalStep(point, jnp.zeros((len(point), len(point)), dtype))


def log_ratio(
    initial: Initial, model: Diffusion, normal: NormalStep, x: Float[Array, " d"]
) -> Float[Array, ""]:
    """log of the density of X(t_0) over that of the normal law in its place: nothing, but for ν."""
    if not isinstance(bound(initial, model), Stationary):
        return jnp.zeros((), x.dtype)
    white = solve_lower(normal.root, x - normal.mean)
    log_scale = jnp.sum(jnp.log(np.sqrt(2 * np.pi) * jnp.diagonal(normal.root)))
    return model.log_stationary(x) + dot(white, white) / 2 + log_scale


class _OfParams(eqx.Module):
    """A function of params that gives the law, as a pytree without arrays."""

    function: Callable[[PyTree], Any] = eqx.field(static=True)

    def __call__(self, params: PyTree) -> Any:
        return self.function(params)


def as_initial(initial: Initial) -> Initial:
    """What the user gave, as a pytree of arrays."""
    is_function = callable(initial) and jax.tree_util.all_leaves([initial])
    return _OfParams(initial) if is_function else initial


def bound(initial: Initial, model: Diffusion) -> Initial:
    """The law at the model's parameters, where it is a function of them."""
    if isinstance(initial, GaussianLaw | Stationary) or not callable(initial):
        return initial
    return initial(model.params)


def _check_shape(mean: Array, like: Float[Array, " d"]) -> None:
    if mean.shape != like.shape:
        raise ValueError(
            f"`initial` must be a point of shape {like.shape}, a `GaussianLaw` of such points or "
            f"`Stationary()`; got shape {mean.shape}."
        )


def _stationary(model: Diffusion, like: Float[Array, " d"]) -> NormalStep:
    """The normal law with the mode of ν and the curvature of log ν there."""
    log_nu = model.log_stationary
    eye = jnp.eye(like.shape[0], dtype=like.dtype)

    def precision(x):
        hessian = -jax.hessian(log_nu)(x)
        # Gershgorin's bound: where log ν is not concave, steps are those of a steeper one.
        off = jnp.sum(jnp.abs(hessian), axis=1) - jnp.abs(jnp.diagonal(hessian))
        least = jnp.min(jnp.diagonal(hessian) - off)
        size = jnp.max(jnp.abs(hessian)) + jnp.finfo(like.dtype).tiny
        concave = cholesky(hessian)
        good = jnp.all(jnp.isfinite(concave))
        return jnp.where(good, hessian, hessian + (0.1 * size - jnp.minimum(least, 0)) * eye)

    def newton(_, x):
        moved = x + matvec(inverse(precision(x)), jax.grad(log_nu)(x))
        return jnp.where(jnp.all(jnp.isfinite(moved)), moved, x)

    # A last step from the mode moves it as the parameters do, and no further.
    mode = lax.fori_loop(0, _NEWTON_STEPS, newton, jnp.zeros_like(like))
    mode = newton(0, lax.stop_gradient(mode))
    return NormalStep(mode, cholesky(inverse(precision(mode))))
