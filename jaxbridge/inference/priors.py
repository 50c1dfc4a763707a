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
from ..engine.checks import as_floating, is_traced
from ..engine.compiled import compiled_sooner
from ..engine.linalg import any_inverse, dot, matvec
from .parameters import Parameters


class NormalPrior(eqx.Module):
    """Normal prior of the unknown parameters.

    **Arguments:**

    - `mean`: a number for all parameters, a vector of shape (p,), or a pytree like the parameters.
    - `variance`: the same forms, or a covariance matrix of shape (p, p).

    Vectors and matrices have the order of `jax.flatten_util.ravel_pytree`.

    **Raises:** `ValueError` if shapes do not fit the parameters; the function that takes the prior
    raises it.

    **Example:**

    ```python
    jb.NormalPrior(1.0, 1.0)
    jb.NormalPrior(jnp.zeros(4), 0.5 * jnp.eye(4))
    ```
    """

    mean: PyTree
    variance: PyTree


class NormalDensity(eqx.Module):
    """N(mean, precision⁻¹), up to the constant."""

    mean: Float[Array, " p"]
    precision: Float[Array, "p p"]

    def __call__(self, theta: Float[Array, " p"]) -> Float[Array, ""]:
        deviation = theta - self.mean
        return -dot(deviation, matvec(self.precision, deviation)) / 2


class GivenDensity(eqx.Module):
    """The user's log density of the unknown parameters, as a function of θ."""

    parameters: Parameters
    function: Callable[[PyTree], Any] = eqx.field(static=True)
    captured: Captured

    def __init__(self, parameters: Parameters, function: Callable[[PyTree], Any]):
        self.parameters, self.function = parameters, function
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
    """The prior of θ, with its shapes checked."""
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
        values = np.asarray(variance)
        least = np.linalg.eigvalsh(values).min() if values.ndim == 2 else np.min(values)
        if not (np.all(np.isfinite(np.asarray(mean))) and np.isfinite(least) and least > 0):
            raise ValueError(
                "`prior` must have a finite mean and a positive (definite) variance; got "
                f"{prior.mean} and {prior.variance}."
            )
    return _normal(mean, variance, p)


@compiled_sooner
def _normal(mean: Float[Array, "..."], variance: Float[Array, "..."], p: int) -> NormalDensity:
    if variance.ndim == 2:
        precision = any_inverse(variance)
        precision = (precision + precision.T) / 2
    else:
        precision = jnp.diag(jnp.broadcast_to(1 / variance, (p,)))
    return NormalDensity(jnp.broadcast_to(mean, (p,)), precision)


def _as_array(
    name: str, value: PyTree, parameters: Parameters, theta: Float[Array, " p"]
) -> Float[Array, "..."]:
    """What the user gave as an array, pytrees like the parameters as a vector."""
    everything, structure = jax.tree.flatten(parameters.params)
    like = list(filter(eqx.is_inexact_array, everything))  # what else there is, θ leaves out
    if hasattr(value, "ndim"):
        is_matrix = name == "variance" and value.shape == (len(theta), len(theta))
        if len(like) == 1 and value.shape == like[0].shape and not is_matrix:
            value = jnp.ravel(value)
    elif jax.tree.structure(value) == structure:
        full = []
        for leaf, known in zip(jax.tree.leaves(value), everything, strict=True):
            if not eqx.is_inexact_array(known):
                continue
            leaf = as_floating(f"prior.{name}", leaf)
            if leaf.shape not in ((), known.shape):
                raise ValueError(
                    f"`prior.{name}` must have leaves of the shapes of the parameters; got shape "
                    f"{leaf.shape} for parameters of shape {known.shape}."
                )
            full.append(jnp.broadcast_to(leaf, known.shape).ravel())
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
    """The prior's log density, a function of θ."""
    if isinstance(prior, NormalPrior):
        return as_normal(prior, parameters, theta)
    if not callable(prior):
        raise TypeError(
            "`prior` must be a `NormalPrior`, or a function from the unknown parameters to a log "
            f"density; got {prior!r}."
        )
    check_function("prior", prior, "(unknown)")
    return GivenDensity(parameters, prior)
