"""Lamperti's transform: in one dimension, coordinates in which σ is one.

    Y = F(X),    F(x) = ∫_a^x du/σ(u),    dY = (α/σ - σ'/2)(F⁻¹(Y)) dt + dW,

with stationary density ν(g(y)) σ(g(y)), g = F⁻¹. Then nothing is left of what a σ(x) asks for:
meetings, transitions and weights are those of a constant σ, of second order in the step. The
inverse solves g' = σ(g), g(0) = a; it is tabulated, with cubic interpolation between the nodes,
once a call for the parameters of that call. F itself is found by quadrature from the node before.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Float, PyTree

from ..engine.checks import Numbers, as_floating, check_count, is_traced
from .diffusion import Diffusion, check_diffusion
from .transform import Transformed, of_points

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)


def lamperti(model: Diffusion, at: Numbers, reach: Numbers, *, num_nodes: int = 400) -> Transformed:
    """The one-dimensional model of Y = ∫_a^X du/σ(u), whose σ is one.

    **Arguments:**

    - `model`: a one-dimensional model with a σ(x) > 0.
    - `at`: a, a number in the state space, which becomes Y = 0.
    - `reach`: how far Y may go in either direction, in square roots of a unit of time. A path that
        goes further, or leaves the state space, is a miss, and counted among `num_nonfinite`.
    - `num_nodes`: of the table of X, in either direction; errors are O((`reach`/`num_nodes`)⁴).

    **Returns:** `Transformed`. Its `model` takes other parameters, also those of σ, by
    `with_params`, and compiles once; `forward`, `inverse` and `back` are for the parameters that
    `model` has. So parameters of σ cannot be inferred from observations in these coordinates,
    which would move with them: `gibbs`, `pmmh`, `score` and `maximum_likelihood` refuse it.

    **Raises:** `ValueError` for numbers that are out of range and for a σ(a) that is not a
    positive number; `TypeError` for what is no model, or no number.

    **Example:**

    ```python
    cir = jb.Diffusion(
        lambda x, p: 0.5 - x,
        lambda x, p: 0.6 * jnp.sqrt(x),
        lambda x, p: jnp.sum((1 / 0.6**2 - 1) * jnp.log(x) - 2 * x / 0.6**2),
    )
    root = jb.lamperti(cir, at=0.5, reach=8.0)
    root.forward(jnp.array([0.6]))  # 2 (√0.6 - √0.5) / 0.6
    ```
    """
    check_diffusion(model)
    origin, reach = _number("at", at), _number("reach", reach)
    if not reach > 0:
        raise ValueError(f"`reach` must be positive; got {reach}.")
    check_count("num_nodes", num_nodes)
    functions = _functions(model.unbound(), model.preparation, origin, reach, num_nodes)
    table = functions.prepare(model.params)
    slope = table.sigma[num_nodes]
    if not is_traced(slope) and not 0 < slope < math.inf:
        raise ValueError(
            f"`at` must be a point inside the state space, where σ is positive; σ({origin:g}) is "
            f"{float(slope):g}."
        )
    moved = Diffusion(
        functions.drift,
        None,
        functions.log_stationary if model.has_density else None,
        model.params,
        sample_stationary=functions.sample_stationary if model.has_sampler else None,
        # In one dimension every stationary diffusion is reversible.
        reversible=model.has_reversal,
        normalised=model.normalised,
        prepare=functions.prepare,
        _coordinates=functions.coordinates,
    )
    forward, inverse = (
        of_points(Partial(function, table)) for function in (functions.forward, functions.inverse)
    )
    return Transformed(moved, forward, inverse)


def _number(name: str, value: Numbers) -> float:
    """A number that is known: coordinates are chosen before anything is compiled."""
    array = as_floating(name, value)
    if array.shape != ():
        raise ValueError(f"`{name}` must be a number; got shape {array.shape}.")
    if is_traced(array):
        raise TypeError(f"`{name}` must be a known number, not a value that is traced.")
    if not math.isfinite(float(array)):
        raise ValueError(f"`{name}` must be finite; got {float(array)}.")
    return float(array)


class _Table(NamedTuple):
    """X and σ(X) at Y = -reach, ..., 0, ..., reach, and the parameters as the functions of the
    given model want them."""

    x: Float[Array, " n"]
    sigma: Float[Array, " n"]
    params: PyTree


class _Functions(NamedTuple):
    """Those of the model of Y, given the table in the place of parameters, and the two maps."""

    prepare: Callable
    drift: Callable
    log_stationary: Callable
    sample_stationary: Callable
    forward: Callable
    inverse: Callable
    coordinates: Callable


@functools.lru_cache(maxsize=256)
def _functions(
    unbound: Diffusion, preparation: Callable | None, origin: float, reach: float, num_nodes: int
) -> _Functions:
    """The same functions for the same arguments, so that they compile once."""
    spacing, last = reach / num_nodes, 2 * num_nodes

    def sigma(x, params):
        """σ at one number: NaN, with derivative zero, outside the state space."""
        model = unbound.with_params(params)
        inside = jax.lax.stop_gradient(model.diffusion(x[None])[0, 0]) > 0
        safe = jnp.where(inside, x, jnp.asarray(origin, x.dtype))
        return jnp.where(inside, model.diffusion(safe[None])[0, 0], jnp.nan)

    @jax.jit
    def prepare(params):
        params = params if preparation is None else preparation(params)
        field = diffrax.ODETerm(lambda y, x, args: sigma(x, args))

        def solve(direction):
            """g' = σ(g) away from a."""
            ys = np.linspace(0, direction * reach, num_nodes + 1)
            solution = diffrax.diffeqsolve(
                field,
                diffrax.Tsit5(),
                ys[0],
                ys[-1],
                None,
                jnp.asarray(origin, float),
                params,
                saveat=diffrax.SaveAt(steps=True),
                stepsize_controller=diffrax.StepTo(ys),
                # Differentiable in both modes with respect to the parameters of σ.
                adjoint=diffrax.DirectAdjoint(),
                max_steps=num_nodes,
            )
            return jnp.asarray(solution.ys)

        x = jnp.concatenate([solve(-1)[::-1], jnp.asarray([origin], float), solve(1)])
        return _Table(x, jax.vmap(lambda x: sigma(x, params))(x), params)

    def inverse(table, y):
        """g(y) = x, by cubic Hermite interpolation: NaN beyond the table."""
        place = (y + reach) / spacing
        cell = jnp.clip(jnp.floor(place), 0, last - 1).astype(int)
        s = place - cell.astype(y.dtype)
        left, right = (table.x[i].astype(y.dtype) for i in (cell, cell + 1))
        before, after = (spacing * table.sigma[i].astype(y.dtype) for i in (cell, cell + 1))
        rise = right - left
        x = left + s * (
            before + s * (3 * rise - 2 * before - after + s * (before + after - 2 * rise))
        )
        return jnp.where((s >= 0) & (s <= 1), x, jnp.nan)

    def forward(table, x):
        """F(x) = F(x_i) + ∫ du/σ(u) from the node x_i before x: NaN beyond the table."""
        nodes = table.x.astype(x.dtype)
        middle = jnp.arange(last + 1) < num_nodes
        ordered = jnp.where(jnp.isnan(nodes), jnp.where(middle, -jnp.inf, jnp.inf), nodes)
        cell = jnp.clip(jnp.searchsorted(ordered, x, side="right") - 1, 0, last - 1)
        half = (x - nodes[cell]) / 2
        points = nodes[cell] + half * (1 + jnp.asarray(_NODES, x.dtype)[:, None])
        slopes = jax.vmap(lambda u: sigma(u, table.params))(points.ravel()).reshape(points.shape)
        y = (cell.astype(x.dtype) - num_nodes) * spacing
        y += half * jnp.sum(jnp.asarray(_WEIGHTS, x.dtype)[:, None] / slopes, axis=0)
        return jnp.where((x >= nodes[cell]) & (x <= nodes[cell + 1]), y, jnp.nan)

    def drift(y, table):
        if y.shape != (1,):
            raise ValueError(
                f"Lamperti's transform is for a one-dimensional model; points have shape {y.shape}."
            )
        x = inverse(table, y)
        slope, bend = jax.jvp(lambda x: sigma(x[0], table.params), (x,), (jnp.ones_like(x),))
        return unbound.with_params(table.params).drift(x) / slope - bend / 2

    def log_stationary(y, table):
        x, model = inverse(table, y), unbound.with_params(table.params)
        return model.log_stationary(x) + jnp.log(sigma(x[0], table.params))

    def sample_stationary(key, table):
        return forward(table, unbound.with_params(table.params).sample_stationary(key))

    def coordinates(table):
        """Y depends on the parameters that σ depends on, at any point, and on those of the
        coordinates that it is made from."""
        within = () if unbound.coordinates is None else unbound.coordinates(table.params)
        return sigma(jnp.asarray(origin, float), table.params), within

    moments = (log_stationary, sample_stationary)
    return _Functions(prepare, drift, *moments, forward, inverse, coordinates)
