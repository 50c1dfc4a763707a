"""Priors of the unknown parameters, and their conversion to log densities of the vector θ."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..engine.arguments import as_returned, check_function, named
from ..engine.captured import Captured
from ..engine.checks import as_floating, is_positive_definite, is_traced
from ..engine.compiled import compiled_sooner
from ..engine.linalg import any_inverse, dot, matvec
from .parameters import Parameters


class NormalPrior(eqx.Module):
    """Normal prior of the unknown parameters.

    **Arguments:**

    - `mean`: a number for all parameters, a vector of shape (p,), or a pytree like the parameters.
    - `variance`: the same forms, or a covariance matrix of shape (p, p).

    Vectors and matrices have the order of `jax.flatten_util.ravel_pytree`.

    **Raises:** nothing itself. The function that takes the prior raises `ValueError` if shapes do
    not fit the parameters, the mean is not finite, or the variance is not positive (definite).

    **Example:**

    ```python
    jb.NormalPrior(1.0, 1.0)
    jb.NormalPrior(jnp.zeros(4), 0.5 * jnp.eye(4))
    ```
    """

    mean: PyTree
    variance: PyTree


class NormalDensity(eqx.Module):
    """Log density of N(mean, precision⁻¹) as a function of θ, up to a constant."""

    mean: Float[Array, " p"]
    precision: Float[Array, "p p"]

    def __call__(self, theta: Float[Array, " p"]) -> Float[Array, ""]:
        deviation = theta - self.mean
        return -dot(deviation, matvec(self.precision, deviation)) / 2


class GivenDensity(eqx.Module):
    """Log density of the user, as a function of θ instead of the unknown parameters."""

    parameters: Parameters
    function: Callable[[PyTree], Any] = eqx.field(static=True)
    captured: Captured

    def __init__(self, parameters: Parameters, function: Callable[[PyTree], Any]):
        self.parameters, self.function = parameters, function
        # Keeps derivatives in traced values that the function closes over.
        self.captured = Captured(function)

    def __call__(self, theta: Float[Array, " p"]) -> Float[Array, ""]:
        value = named("prior", self.captured.call)(self.function, self.parameters.select(theta))
        value = as_returned("prior", value)
        if value.shape != ():
            raise ValueError(
                f"`prior` must return a scalar, shape (); it returned shape {value.shape}."
            )
        return value.astype(theta.dtype)


Prior = NormalPrior | Callable[[PyTree], Any]


def as_normal(
    prior: NormalPrior, parameters: Parameters, theta: Float[Array, " p"]
) -> NormalDensity:
    """Return the log density of θ under a normal prior.

    **Raises:** `ValueError` if shapes do not fit, or mean and variance are invalid.
    """
    p = theta.shape[0]
    mean = _as_array("mean", prior.mean, parameters, theta)
    variance = _as_array("variance", prior.variance, parameters, theta)
    if mean.shape not in ((), (p,)):
        raise ValueError(
            f"`prior.mean` must be a number, a vector of shape ({p},) or a pytree like the unknown "
            f"parameters; got shape {mean.shape}."
        )
    if variance.shape not in ((), (p,), (p, p)):
        raise ValueError(
            f"`prior.variance` must be a number, a vector of shape ({p},), a matrix of shape "
            f"({p}, {p}) or a pytree like the unknown parameters; got shape {variance.shape}."
        )
    if not is_traced(mean, variance):
        values = np.asarray(variance, float)
        matrix = values if values.ndim == 2 else np.diag(np.atleast_1d(values))
        if not (np.all(np.isfinite(np.asarray(mean))) and is_positive_definite(matrix)):
            raise ValueError(
                "`prior` must have a finite mean and a positive (definite) variance; got "
                f"{prior.mean} and {prior.variance}."
            )
    return _normal(mean, variance, p)


@compiled_sooner
def _normal(mean: Float[Array, "..."], variance: Float[Array, "..."], p: int) -> NormalDensity:
    if variance.ndim == 2:
        precision = any_inverse(variance)
        precision = (precision + precision.T) / 2  # symmetric up to the last bit
    else:
        precision = jnp.diag(jnp.broadcast_to(1 / variance, (p,)))
    return NormalDensity(jnp.broadcast_to(mean, (p,)), precision)


def _as_array(
    name: str, value: PyTree, parameters: Parameters, theta: Float[Array, " p"]
) -> Float[Array, "..."]:
    """Return the mean or variance of the prior as an array; a pytree becomes a vector."""
    leaves, structure = jax.tree.flatten(parameters.params)
    like = list(filter(eqx.is_inexact_array, leaves))  # θ contains no other leaves
    if hasattr(value, "ndim"):
        # A (p, p) variance is a covariance matrix, also if the parameter has this shape.
        is_matrix = name == "variance" and value.shape == (len(theta), len(theta))
        if len(like) == 1 and value.shape == like[0].shape and not is_matrix:
            value = jnp.ravel(value)
    elif jax.tree.structure(value) == structure:
        full = []
        for leaf, parameter in zip(jax.tree.leaves(value), leaves, strict=True):
            if not eqx.is_inexact_array(parameter):
                continue
            leaf = as_floating(f"prior.{name}", leaf)
            if leaf.shape not in ((), parameter.shape):
                raise ValueError(
                    f"`prior.{name}` must have leaves of the shapes of the parameters; got shape "
                    f"{leaf.shape} for parameters of shape {parameter.shape}."
                )
            full.append(jnp.broadcast_to(leaf, parameter.shape).ravel())
        value = jnp.concatenate(full)
    elif isinstance(value, dict):
        raise ValueError(
            f"`prior.{name}` must have the structure of the parameters, {structure}; got "
            f"{jax.tree.structure(value)}. Pass an entry for each parameter, or one number for all."
        )
    return as_floating(f"prior.{name}", value).astype(theta.dtype)


def as_log_prior(
    prior: Prior, parameters: Parameters, theta: Float[Array, " p"]
) -> NormalDensity | GivenDensity:
    """Return the log density of the prior as a function of θ.

    **Raises:** `ValueError` and `TypeError` for an invalid prior.
    """
    if isinstance(prior, NormalPrior):
        return as_normal(prior, parameters, theta)
    if not callable(prior):
        raise TypeError(
            "`prior` must be a `NormalPrior`, or a function from the unknown parameters to a log "
            f"density; got {prior!r}."
        )
    check_function("prior", prior, "(unknown)")
    return GivenDensity(parameters, prior)
