"""A diffusion in other coordinates, by Itô's formula.

Let f be a smooth bijection with inverse g. Then Y = f(X) has, at x = g(y), the coefficients

    α_Y(y) = ∇f α + ½ Σ_k ∂²f[σ_k, σ_k],    σ_Y(y) = ∇f σ.

Here σ_k are the columns of σ. The stationary density of Y is ν(g(y)) |det ∇g(y)|.

For a state space with a boundary, f maps it onto all of R^d, which no step leaves. Bridges are
sampled and weighted there, and their paths are mapped back.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Float

from ..engine.arguments import check_function
from ..engine.checks import Numbers, as_floating
from ..engine.linalg import log_abs_det
from .diffusion import Diffusion, check_diffusion, value_at
from .sigma import columns_of

Map = Callable[[Array], Any]
_Result = TypeVar("_Result")


class Transformed(eqx.Module):
    """A model in other coordinates, with the maps in both directions.

    - `model`: the model of Y = f(X), with the same parameters as the model of X.
    - `forward`, `inverse`: f and its inverse, functions of points of shape (d,) or (..., d), such
        as observations.

    **Example:**

    ```python
    stretched = jb.transform(model, jnp.sinh, jnp.arcsinh)
    a, b = stretched.forward(start), stretched.forward(end)
    bridges = stretched.back(
        jb.sample_bridges(key, stretched.model, a, b, 1.0, num_bridges=100)
    )
    ```
    """

    model: Diffusion
    forward: Partial
    inverse: Partial

    def back(self, bridges: _Result) -> _Result:
        """Return `bridges` with paths in the coordinates of X.

        `bridges` is a result of `sample_bridges`, `sample_weighted_bridges`, `weigh_bridges` or
        `sample_exact_bridges`. Compute weights before: the returned bridges no longer belong to
        `model`.

        **Raises:** `TypeError` for an object without `paths`.
        """
        paths = getattr(bridges, "paths", None)
        if paths is None:
            raise TypeError(
                "`bridges` must be a result of `sample_bridges`, `sample_weighted_bridges`, "
                f"`weigh_bridges` or `sample_exact_bridges`; got {type(bridges).__name__}."
            )
        inverse = jax.vmap(lambda y: value_at("inverse", self.inverse, y.shape, y))
        # The paths of half as many steps give the discretisation error.
        has_coarse = getattr(bridges, "coarse_paths", None) is not None
        names = ("paths", "coarse_paths") if has_coarse else ("paths",)
        fields = lambda result: [getattr(result, name) for name in names]
        mapped = [inverse(_rows(leaf)).reshape(leaf.shape) for leaf in fields(bridges)]
        return eqx.tree_at(fields, bridges, mapped)

    def log_jacobian(self, x: Numbers) -> Float[Array, "*batch"]:
        """Return log |det ∇f(x)| at points of shape (d,) or (..., d).

        Add it to the log transition density of Y at f(x) to obtain that of X at x.
        """
        x = as_floating("x", x)
        values = jax.vmap(lambda x: log_abs_det(jax.jacfwd(self.forward)(x)))(_rows(x))
        return values.reshape(x.shape[:-1])


def _rows(points: Float[Array, "... d"]) -> Float[Array, "n d"]:
    """Return points of shape (..., d) as rows, shape (n, d)."""
    return points.reshape(-1, points.shape[-1])


def of_points(function: Map) -> Partial:
    """Return a function of one point as a function of points of shape (d,) or (..., d)."""
    return Partial(_of_points, Partial(function))


def _of_points(function: Map, points: Numbers) -> Array:
    points = as_floating("points", points)
    if points.ndim < 2:
        return function(points)
    values = jax.vmap(function)(_rows(points))
    return values.reshape(*points.shape[:-1], *values.shape[1:])


def transform(model: Diffusion, forward: Map, inverse: Map) -> Transformed:
    """Return the model of Y = f(X): drift, σ, stationary density and sampler, by automatic
    differentiation.

    **Arguments:**

    - `model`: the model of X, with coefficients that do not depend on time. If its σ is a constant
        array, that must not be traced.
    - `forward`: f, a smooth bijection of the state space onto R^d, a function of one point (d,),
        such as `jnp.log` or `jax.scipy.special.logit`.
    - `inverse`: the inverse of f, such as `jnp.exp` or `jax.nn.sigmoid`.

    **Returns:** `Transformed`. Calls with the same functions compile once.

    **Raises:** `TypeError` unless `model` is a `Diffusion`, and for arguments that are not
    functions. `ValueError` for a model that depends on time, and for a traced constant σ.

    **Example:**

    ```python
    rate, mean, noise = 1.0, 0.5, 0.3  # Cox, Ingersoll & Ross (1985)
    cir = jb.Diffusion(
        lambda x, p: p[0] * (p[1] - x),
        lambda x, p: p[2] * jnp.sqrt(x),
        lambda x, p: jnp.sum((2 * p[0] * p[1] / p[2]**2 - 1) * jnp.log(x)
                             - 2 * p[0] * x / p[2]**2),
        (rate, mean, noise),
    )
    logarithm = jb.transform(cir, jnp.log, jnp.exp)
    ```
    """
    check_diffusion(model)
    for name, function in [("forward", forward), ("inverse", inverse)]:
        check_function(name, function, "(x)")
    if model.depends_on_time:
        raise ValueError(
            "the coefficients of this `model` depend on time, which `transform` does not support: "
            "write the model in its new coordinates."
        )
    functions = _cached_functions(model.unbound(), forward, inverse)
    transformed = Diffusion(
        functions.drift,
        functions.diffusion,
        functions.log_stationary if model.has_density else None,
        model.params,
        # Without one, α* is derived from the transformed density.
        reverse_drift=functions.reverse_drift if model.has_reverse_drift else None,
        sample_stationary=functions.sample_stationary if model.has_sampler else None,
        reversible=model.reversible,
        normalised=model.normalised,
        prepare=model.preparation,
        _coordinates=model.coordinates,
    )
    return Transformed(transformed, of_points(forward), of_points(inverse))


@dataclasses.dataclass(frozen=True)
class _TransformedFunctions:
    """Functions of the model of Y, of one point y and the parameters."""

    unbound: Diffusion
    forward: Map
    inverse: Map

    def drift(self, y, params):
        x, model = self._original(y, params)
        return self._ito(x, model.forward(x))

    def reverse_drift(self, y, params):
        x, model = self._original(y, params)
        return self._ito(x, model.backward(x))

    def diffusion(self, y, params):
        x, model = self._original(y, params)
        columns = columns_of(model.forward(x).sigma(x), x)
        mapped_columns = [self._derivative(x, column) for column in columns]
        # In one dimension return a diagonal, for which all operations are cheaper.
        return mapped_columns[0] if x.shape[0] == 1 else jnp.stack(mapped_columns, axis=1)

    def log_stationary(self, y, params):
        x, model = self._original(y, params)
        return model.log_stationary(x) + log_abs_det(jax.jacfwd(self.inverse)(y))

    def sample_stationary(self, key, params):
        return self._forward(self.unbound.with_params(params).sample_stationary(key))

    def _original(self, y, params) -> tuple[Array, Diffusion]:
        """Return x = g(y) and the model of X with these parameters."""
        x = value_at("inverse", self.inverse, y.shape, y)
        return x, self.unbound.with_params(params)

    def _forward(self, x):
        return value_at("forward", self.forward, x.shape, x)

    def _derivative(self, x, direction):
        """Return ∇f v, the derivative of f at x in this direction."""
        return jax.jvp(self._forward, (x,), (direction,))[1]

    def _ito(self, x, dynamics):
        """Return ∇f α + ½ Σ_k ∂²f(σ_k, σ_k), where σ_k are the columns of σ."""
        mapped_drift = self._derivative(x, dynamics.drift(x))
        # The second derivative of f in the direction σ_k, from two nested `jvp`.
        for column in columns_of(dynamics.sigma(x), x):
            mapped_drift += (
                jax.jvp(lambda x, v=column: self._derivative(x, v), (x,), (column,))[1] / 2
            )
        return mapped_drift


# Equal arguments share one object, so that its functions compile once.
_cached_functions = functools.lru_cache(maxsize=256)(_TransformedFunctions)
