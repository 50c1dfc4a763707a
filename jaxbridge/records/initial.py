"""Law of the state at the beginning of a record: a normal law and an importance ratio.

If the law is ν, and ν is not normal, a normal law with the mean and covariance of ν replaces it.
This law is wide enough to reach all wells of ν.

Mean and covariance are weighted means over a ladder of normal laws around a mode; each law is twice
as wide as the previous one. The noise is fixed, so both are smooth functions of the parameters. If
the effective number of points is too small for a covariance, for instance in many dimensions, the
covariance at the mode is added.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float, PyTree

from ..coupling import Stationary
from ..engine.arguments import as_returned, check_function, evaluated
from ..engine.averages import effective_size, nan_to_neg_inf, normalise_weights
from ..engine.captured import Captured
from ..engine.checks import as_floating, is_traced
from ..engine.linalg import (
    cholesky,
    dot,
    inverse,
    matmul,
    matvec,
    semidefinite_cholesky,
    solve_lower,
)
from ..models.diffusion import Diffusion
from ..models.gaussian_law import GaussianLaw
from ..models.tracing import uses_argument
from .observations import Scalars, log_density_of
from .tilted_step import NormalStep

# Number of iterations of Newton's method for the mode of ν, from the origin or a point up to
# 2^±`_MOST_DOUBLINGS`.
_NEWTON_STEPS, _MOST_DOUBLINGS = 50, 40
# Widths of the laws of the ladder relative to the law at the mode, and number of points of each.
# About `_ENOUGH` effective points determine a covariance.
_WIDTHS, _NUM_POINTS, _ENOUGH = 2.0 ** np.arange(8), 128, 10

# A normal law falls by ½ at one standard deviation. If log ν falls by more than `_FALL` there, the
# width is replaced. If it is unknown, it starts from `_WIDEST`.
_FALL, _WIDEST, _NUM_HALVINGS = 4.0, 2.0**40, 80

Initial = Any  # a point, a `GaussianLaw`, `Stationary()`, or a function of params to one of these


def initial_law(initial: Initial, model: Diffusion, like: Float[Array, " d"]) -> NormalStep:
    """Return the law of X(t_0), or the normal law in place of ν.

    `like` shows shape and dtype of a state. `log_ratio` is the importance ratio of the two laws.

    **Raises:** `TypeError` and `ValueError` for an invalid law.
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


def check_initial(initial: Initial, model: Diffusion, like: Float[Array, " d"]) -> None:
    """Raise `TypeError` and `ValueError` for an invalid law of a state with the shape of `like`."""
    if isinstance(bound(initial, model), Stationary):
        jax.eval_shape(lambda model, x: model.log_stationary(x), model, like)
        return
    # This runs all checks of types and shapes without computing the law.
    jax.eval_shape(lambda model: initial_law(initial, model, like), model)
    point = bound(initial, model)
    if isinstance(point, GaussianLaw) or is_traced(point, model):
        return
    inside = model.state_space()
    if inside is not None and not inside(jnp.asarray(point, like.dtype)):
        raise ValueError(f"`initial` must be inside the model's `domain`; got {point}.")


def log_ratio(
    initial: Initial, model: Diffusion, normal: NormalStep, x: Float[Array, " d"]
) -> Float[Array, ""]:
    """Return the log density of X(t_0) minus that of the normal law in its place.

    It is zero unless X(t_0) has the law ν.
    """
    if not isinstance(bound(initial, model), Stationary):
        return jnp.zeros((), x.dtype)
    return model.log_stationary(x) - log_normal(normal, x)


def log_normal(law: NormalStep, x: Float[Array, " d"]) -> Float[Array, ""]:
    """Return the log density of a normal law with an invertible root."""
    white = solve_lower(law.root, x - law.mean)
    log_scale = jnp.sum(jnp.log(math.sqrt(2 * math.pi) * jnp.diagonal(law.root)))
    return -dot(white, white) / 2 - log_scale


class _LawOfParams(eqx.Module):
    """Function of `params` that returns the law, as a pytree."""

    function: Callable[[PyTree], Any] = eqx.field(static=True)
    captured: Captured

    def __init__(self, function: Callable[[PyTree], Any]):
        self.function, self.captured = function, Captured(function)

    def __call__(self, params: PyTree) -> Any:
        law = evaluated("initial", self.captured.call, self.function, params)
        if isinstance(law, GaussianLaw | Stationary):
            return law
        return as_returned("initial", law)


def as_initial(initial: Initial) -> Initial:
    """Return the user's law as a pytree of arrays."""
    is_function = callable(initial) and jax.tree_util.all_leaves([initial])
    if not is_function:
        return initial
    check_function("initial", initial, "(params)")
    return _LawOfParams(initial)


def bound(initial: Initial, model: Diffusion) -> Initial:
    """Return the law at the model's parameters, if it is a function of them."""
    if isinstance(initial, GaussianLaw | Stationary) or not callable(initial):
        return initial
    return initial(model.params)


def _check_shape(mean: Array, like: Float[Array, " d"]) -> None:
    """Raise `ValueError` if the mean of the law has another shape than a state."""
    if mean.shape != like.shape:
        raise ValueError(
            f"`initial` must be a point of shape {like.shape}, a `GaussianLaw` of such points or "
            f"`Stationary()`; got shape {mean.shape}."
        )


def calls_for_cover(initial: Initial, model: Diffusion, like: Float[Array, " d"]) -> bool:
    """Return whether X(t_0) has the law ν and ν is not normal."""
    return isinstance(bound(initial, model), Stationary) and not is_normal(model, like)


def is_normal(model: Diffusion, like: Float[Array, " d"]) -> bool:
    """Return whether ν is a normal law.

    It is if the second derivatives of log ν do not depend on the point.
    """
    return not uses_argument(jax.hessian(model.log_stationary), like)


def _stationary(model: Diffusion, like: Float[Array, " d"]) -> NormalStep:
    """Return ν if it is normal, otherwise the normal law with its mean and covariance."""
    model = model.prepared()
    if is_normal(model, like):  # then log ν is smooth at the origin
        return _law_at_mode(model, jnp.zeros_like(like))
    mode = _law_at_mode(model, _begin(model.log_stationary, like))
    mode = _of_finite_width(model, mode)
    points, log_weights = ladder(model, mode)
    weights = normalise_weights(log_weights)
    mean = weights @ points
    centred = points - mean
    # The weight of the covariance at the mode falls with the effective number of points.
    lack = 1 / (1 + effective_size(weights) / _ENOUGH) ** 2
    covariance = centred.T @ (weights[:, None] * centred) + lack * matmul(mode.root, mode.root.T)
    root = cholesky(covariance)
    # If the moments are not finite, the law at the mode is used.
    usable = jnp.all(jnp.isfinite(mean)) & jnp.all(jnp.isfinite(root))
    return jax.tree.map(lambda a, b: jnp.where(usable, a, b), NormalStep(mean, root), mode)


def _of_finite_width(model: Diffusion, mode: NormalStep) -> NormalStep:
    """Return the law at the mode with narrower columns of its root where log ν falls too far.

    The curvature may vanish at the mode, as for ν ∝ exp(-x⁴), and then says nothing about the
    width. A column is halved until log ν falls by at most 1 on one of its sides.
    """
    d, dtype = mode.mean.shape[0], mode.mean.dtype
    is_flat = ~jnp.all(jnp.isfinite(mode.root)) & jnp.isfinite(model.log_stationary(mode.mean))
    root = jnp.where(is_flat, _WIDEST * jnp.eye(d, dtype=dtype), mode.root)
    factors = jnp.asarray(0.5 ** np.arange(_NUM_HALVINGS), dtype)
    log_nu = jax.vmap(lambda x: nan_to_neg_inf(model.log_stationary(x)))

    def factor(column):
        steps = factors[:, None] * column
        nearer = jnp.maximum(log_nu(mode.mean + steps), log_nu(mode.mean - steps))
        fall = log_nu(mode.mean[None]) - nearer
        # Of a normal law it is ½. The first factor stays unless the fall is much larger.
        enough = fall <= jnp.where(factors == 1, _FALL, 1)
        return jnp.where(jnp.any(enough), factors[jnp.argmax(enough)], 1)

    return mode._replace(root=root * lax.stop_gradient(jax.vmap(factor)(root.T)))


def ladder(model: Diffusion, mode: NormalStep) -> tuple[Float[Array, "n d"], Float[Array, " n"]]:
    """Return points of normal laws around a mode, and their log weights as draws of ν.

    The noise is fixed, so both are smooth functions of the parameters.
    """
    (d,), dtype = mode.mean.shape, mode.mean.dtype
    widths = jnp.asarray(_WIDTHS, dtype)
    zeta = jax.random.normal(jax.random.key(0), (len(widths), _NUM_POINTS, d), dtype)
    white = (widths[:, None, None] * zeta).reshape(-1, d)
    points = mode.mean + jax.vmap(lambda white: matvec(mode.root, white))(white)
    square = jnp.sum(white**2, axis=1)
    # Log densities of the laws, without the common constant.
    log_laws = -square[:, None] / (2 * widths**2) - d * jnp.log(widths)
    log_nu = jax.vmap(lambda x: model.log_stationary(x))(points)
    return points, nan_to_neg_inf(log_nu - logsumexp(log_laws, axis=1))


def likeliest(
    initial: Initial, model: Diffusion, normal: NormalStep, scalars: Scalars
) -> Float[Array, " d"]:
    """Return a likely X(t_0), given the observation at t_0.

    For a normal law it is the mean, for ν the best point of the ladder. This point is inside a
    well. The mean may be between two wells.
    """
    if not calls_for_cover(initial, model, normal.mean):
        return normal.mean
    noisy = scalars._replace(seen=scalars.seen & (scalars.variances > 0))
    points, _ = ladder(model, normal)
    log_nu = model.prepared().log_stationary
    logs = jax.vmap(lambda x: log_nu(x) + log_density_of(noisy, x))(points)
    best, any_positive = jnp.argmax(nan_to_neg_inf(logs)), jnp.any(logs > -jnp.inf)
    return jnp.where(any_positive, points[best], normal.mean)


def _law_at_mode(model: Diffusion, begin: Float[Array, " d"]) -> NormalStep:
    """Return the normal law at the mode of ν, with the curvature of log ν there.

    Newton's method finds no maximum of a density that grows without bound towards an edge. If it
    starts away from the origin, the law is then around this beginning. Its width is the distance
    from the origin.
    """
    log_nu, dtype = model.log_stationary, begin.dtype
    eye = jnp.eye(begin.shape[0], dtype=dtype)

    def precision(x):
        hessian = -jax.hessian(log_nu)(x)
        # If log ν is not concave here, Gershgorin's bound shifts the eigenvalues above zero.
        off = jnp.sum(jnp.abs(hessian), axis=1) - jnp.abs(jnp.diagonal(hessian))
        least = jnp.min(jnp.diagonal(hessian) - off)
        size = jnp.max(jnp.abs(hessian)) + jnp.finfo(dtype).tiny
        is_concave = jnp.all(jnp.isfinite(cholesky(hessian)))
        shifted = hessian + (0.1 * size - jnp.minimum(least, 0)) * eye
        return jnp.where(is_concave, hessian, shifted), is_concave

    def newton(_, state):
        x, share = state
        new_x = x + share * matvec(inverse(precision(x)[0]), jax.grad(log_nu)(x))
        # Shorter steps if this one leaves the support of ν.
        is_inside = jnp.all(jnp.isfinite(new_x)) & jnp.isfinite(log_nu(new_x))
        new_share = jnp.where(is_inside, jnp.minimum(2 * share, 1), share / 2)
        return jnp.where(is_inside, new_x, x), new_share

    state = begin, jnp.ones((), dtype)
    # The last step gives the mode's derivative by the parameters (implicit function theorem).
    state = lax.fori_loop(0, _NEWTON_STEPS, newton, state)
    mode, _ = newton(0, lax.stop_gradient(state))
    its_precision, is_maximum = precision(mode)
    at_mode = NormalStep(mode, cholesky(inverse(its_precision)))
    around = NormalStep(begin, jnp.diag(jnp.abs(begin)))
    return jax.tree.map(
        lambda a, b: jnp.where(is_maximum | jnp.all(begin == 0), a, b), at_mode, around
    )


def _begin(log_nu: Callable[[Array], Array], like: Float[Array, " d"]) -> Float[Array, " d"]:
    """Return the origin, or if log ν is not smooth there a point where ν has much of its mass.

    This is the best of the points ±2^k (1, ..., 1), for positive states in any unit.
    """
    origin = jnp.zeros_like(like)
    sizes = jnp.asarray(2.0 ** np.arange(-_MOST_DOUBLINGS, _MOST_DOUBLINGS + 1), like.dtype)
    sizes = jnp.concatenate([sizes, -sizes])
    points = jnp.broadcast_to(sizes[:, None], (len(sizes), like.shape[0]))
    # Mass of a ball as wide as its distance from the origin.
    log_mass = jax.vmap(log_nu)(points) + like.shape[0] * jnp.log(jnp.abs(sizes))
    best = points[jnp.argmax(nan_to_neg_inf(log_mass))]
    is_smooth = jnp.isfinite(log_nu(origin)) & jnp.all(jnp.isfinite(jax.grad(log_nu)(origin)))
    return jnp.where(is_smooth, origin, lax.stop_gradient(best))
