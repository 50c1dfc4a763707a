"""A diffusion in other coordinates, by Itô's formula.

For a smooth bijection f with inverse g, Y = f(X) solves an equation with

    α_Y(y) = ∇f α + ½ Σ_k ∂²f[σ_k, σ_k],    σ_Y(y) = ∇f σ,    at x = g(y),

σ_k the columns of σ, and has the stationary density ν(g(y)) |det ∇g(y)|. A state space with a
boundary becomes all of R^d, in which no step leads out of it; bridges are simulated and weighted
there, and their paths mapped back.
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
    """A model in other coordinates, and the way there and back.

    - `model`: of Y = f(X), with the parameters of the given model.
    - `forward`, `inverse`: f and its inverse, of points of shape (d,) or (..., d), such as
        observations.

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
        """What `sample_bridges`, `sample_weighted_bridges`, `weigh_bridges` or
        `sample_exact_bridges` returned, with paths in the coordinates of X. Weigh before: the
        result is no longer of this model."""
        paths = getattr(bridges, "paths", None)
        if paths is None:
            raise TypeError(
                "`bridges` must be what `sample_bridges`, `sample_weighted_bridges` or "
                f"`sample_exact_bridges` returned; got {type(bridges).__name__}."
            )
        inverse = lambda y: value_at("inverse", self.inverse, y.shape, y)
        mapped = jax.vmap(inverse)(_rows(paths))
        return eqx.tree_at(lambda result: result.paths, bridges, mapped.reshape(paths.shape))

    def log_jacobian(self, x: Numbers) -> Float[Array, "*batch"]:
        """log |det ∇f(x)| at points of shape (d,) or (..., d): add it to a transition density of Y
        at f(x), and it is that of X."""
        x = as_floating("x", x)
        values = jax.vmap(lambda x: log_abs_det(jax.jacfwd(self.forward)(x)))(_rows(x))
        return values.reshape(x.shape[:-1])


def _rows(points: Float[Array, "... d"]) -> Float[Array, "n d"]:
    return points.reshape(-1, points.shape[-1])


def of_points(function: Map) -> Partial:
    """A function of one point as one of points of shape (d,) or (..., d)."""
    return Partial(_of_points, Partial(function))


def _of_points(function: Map, points: Numbers) -> Array:
    points = as_floating("points", points)
    if points.ndim < 2:
        return function(points)
    values = jax.vmap(function)(_rows(points))
    return values.reshape(*points.shape[:-1], *values.shape[1:])


def transform(model: Diffusion, forward: Map, inverse: Map) -> Transformed:
    """The model of Y = f(X): drift, σ, stationary density and sampler, by automatic
    differentiation.

    **Arguments:**

    - `model`: the model of X. A constant σ that it was given as an array must be known.
    - `forward`: f, a smooth bijection of the state space onto R^d, a function of one point (d,);
        for instance `jnp.log`, or `jax.scipy.special.logit`.
    - `inverse`: its inverse, for instance `jnp.exp` or `jax.nn.sigmoid`.

    **Returns:** `Transformed`. Calls with the same functions compile once.

    **Raises:** `TypeError` for what is no model or no function.

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
            "the coefficients of this `model` depend on time, and `transform` is for those that do "
            "not: write the model in its new coordinates."
        )
    functions = _moved(model.unbound(), forward, inverse)
    moved = Diffusion(
        functions.drift,
        functions.diffusion,
        functions.log_stationary if model.has_density else None,
        model.params,
        reverse_drift=functions.reverse_drift if model.has_reverse_drift else None,
        sample_stationary=functions.sample_stationary if model.has_sampler else None,
        reversible=model.reversible,
        normalised=model.normalised,
        prepare=model.preparation,
        _coordinates=model.coordinates,
    )
    return Transformed(moved, of_points(forward), of_points(inverse))


@dataclasses.dataclass(frozen=True)
class _Moved:
    """The functions of the model of Y, of one point and the parameters."""

    unbound: Diffusion
    forward: Map
    inverse: Map

    def drift(self, y, params):
        x, model = self._at(y, params)
        return self._ito(x, model.forward(x))

    def reverse_drift(self, y, params):
        x, model = self._at(y, params)
        return self._ito(x, model.backward(x))

    def diffusion(self, y, params):
        x, model = self._at(y, params)
        columns = columns_of(model.forward(x).sigma(x), x)
        moved = [self._along(x, column) for column in columns]
        # In one dimension a matrix is its diagonal.
        return moved[0] if x.shape[0] == 1 else jnp.stack(moved, axis=1)

    def log_stationary(self, y, params):
        x, model = self._at(y, params)
        return model.log_stationary(x) + log_abs_det(jax.jacfwd(self.inverse)(y))

    def sample_stationary(self, key, params):
        return self._f(self.unbound.with_params(params).sample_stationary(key))

    def _at(self, y, params) -> tuple[Array, Diffusion]:
        x = value_at("inverse", self.inverse, y.shape, y)
        return x, self.unbound.with_params(params)

    def _f(self, x):
        return value_at("forward", self.forward, x.shape, x)

    def _along(self, x, direction):
        """∇f v."""
        return jax.jvp(self._f, (x,), (direction,))[1]

    def _ito(self, x, dynamics):
        """∇f α + ½ Σ_k ∂²f(σ_k, σ_k), with the columns σ_k of σ."""
        moved = self._along(x, dynamics.drift(x))
        for column in columns_of(dynamics.sigma(x), x):
            moved += jax.jvp(lambda x, v=column: self._along(x, v), (x,), (column,))[1] / 2
        return moved


# The same object for the same arguments, so that its functions compile once.
_moved = functools.lru_cache(maxsize=256)(_Moved)
