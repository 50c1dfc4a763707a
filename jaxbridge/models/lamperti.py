"""Lamperti's transform: in one dimension, coordinates in which σ is one.

    Y = F(X),    F(x) = ∫_a^x du/σ(u),    dY = (α/σ - σ'/2)(F⁻¹(Y)) dt + dW,

with stationary density ν(g(y)) σ(g(y)), g = F⁻¹. Then nothing is left of what a σ(x) asks for:
meetings, transitions and weights are those of a constant σ, of second order in the step. The
inverse solves g' = σ(g), g(0) = a; it is tabulated, with cubic interpolation between the nodes,
once a call for the parameters of that call. F itself is found by quadrature from the node before.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Float, Key, PyTree

from ..engine.checks import Numbers, as_floating, check_count, is_traced
from ..engine.compiled import compiled_sooner
from ..engine.doors import guards_off
from .diffusion import Diffusion, check_diffusion
from .transform import Transformed, of_points

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)


@guards_off
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
    functions = _coordinates_of(model.unbound(), model.preparation, origin, reach, num_nodes)
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


@dataclasses.dataclass(frozen=True)
class _Lamperti:
    """The functions of the model of Y, given the table in the place of parameters, and the two
    maps."""

    unbound: Diffusion
    preparation: Callable | None
    origin: float
    reach: float
    num_nodes: int

    @property
    def spacing(self) -> float:
        return self.reach / self.num_nodes

    def prepare(self, params: PyTree) -> _Table:
        return _tabulated(self, params)

    def inverse(self, table: _Table, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """g(y) = x, by cubic Hermite interpolation: NaN beyond the table."""
        place = (y + self.reach) / self.spacing
        cell = jnp.clip(jnp.floor(place), 0, 2 * self.num_nodes - 1).astype(int)
        s = place - cell.astype(y.dtype)
        left, right = (table.x[i].astype(y.dtype) for i in (cell, cell + 1))
        before, after = (self.spacing * table.sigma[i].astype(y.dtype) for i in (cell, cell + 1))
        rise = right - left
        x = left + s * (
            before + s * (3 * rise - 2 * before - after + s * (before + after - 2 * rise))
        )
        return jnp.where((s >= 0) & (s <= 1), x, jnp.nan)

    def forward(self, table: _Table, x: Float[Array, " one"]) -> Float[Array, " one"]:
        """F(x) = F(x_i) + ∫ du/σ(u) from the node x_i before x: NaN beyond the table."""
        nodes, last = table.x.astype(x.dtype), 2 * self.num_nodes
        lower = jnp.arange(last + 1) < self.num_nodes
        ordered = jnp.where(jnp.isnan(nodes), jnp.where(lower, -jnp.inf, jnp.inf), nodes)
        cell = jnp.clip(jnp.searchsorted(ordered, x, side="right") - 1, 0, last - 1)
        half = (x - nodes[cell]) / 2
        points = nodes[cell] + half * (1 + jnp.asarray(_NODES, x.dtype)[:, None])
        slopes = jax.vmap(lambda u: self.sigma_at(u, table.params))(points.ravel())
        weighted = jnp.asarray(_WEIGHTS, x.dtype)[:, None] / slopes.reshape(points.shape)
        y = (cell.astype(x.dtype) - self.num_nodes) * self.spacing
        y += half * jnp.sum(weighted, axis=0)
        return jnp.where((x >= nodes[cell]) & (x <= nodes[cell + 1]), y, jnp.nan)

    def drift(self, y: Float[Array, " one"], table: _Table) -> Float[Array, " one"]:
        if y.shape != (1,):
            raise ValueError(
                f"`lamperti` is for a one-dimensional `model`; points have shape {y.shape}."
            )
        x = self.inverse(table, y)
        sigma = lambda x: self.sigma_at(x[0], table.params)
        slope, bend = jax.jvp(sigma, (x,), (jnp.ones_like(x),))
        return self._model(table).drift(x) / slope - bend / 2

    def log_stationary(self, y: Float[Array, " one"], table: _Table) -> Float[Array, ""]:
        x = self.inverse(table, y)
        return self._model(table).log_stationary(x) + jnp.log(self.sigma_at(x[0], table.params))

    def sample_stationary(self, key: Key[Array, ""], table: _Table) -> Float[Array, " one"]:
        return self.forward(table, self._model(table).sample_stationary(key))

    def coordinates(self, table: _Table) -> PyTree:
        """Y depends on the parameters that σ depends on, at any point, and on those of the
        coordinates that it is made from."""
        within = self.unbound.coordinates
        slope = self.sigma_at(jnp.asarray(self.origin, float), table.params)
        return slope, () if within is None else within(table.params)

    def _model(self, table: _Table) -> Diffusion:
        return self.unbound.with_params(table.params)

    def sigma_at(self, x: Float[Array, ""], params: PyTree) -> Float[Array, ""]:
        """σ at one number: NaN, with derivative zero, outside the state space."""
        model = self.unbound.with_params(params)
        inside = jax.lax.stop_gradient(model.diffusion(x[None])[0, 0]) > 0
        safe = jnp.where(inside, x, jnp.asarray(self.origin, x.dtype))
        return jnp.where(inside, model.diffusion(safe[None])[0, 0], jnp.nan)

    def solve(self, direction: int, params: PyTree) -> Float[Array, " nodes"]:
        """g' = σ(g) away from a."""
        ys = np.linspace(0, direction * self.reach, self.num_nodes + 1)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda y, x, params: self.sigma_at(x, params)),
            diffrax.Tsit5(),
            ys[0],
            ys[-1],
            None,
            jnp.asarray(self.origin, float),
            params,
            saveat=diffrax.SaveAt(steps=True),
            stepsize_controller=diffrax.StepTo(ys),
            # Differentiable in both modes with respect to the parameters of σ.
            adjoint=diffrax.DirectAdjoint(),
            max_steps=self.num_nodes,
        )
        return jnp.asarray(solution.ys)


@compiled_sooner
def _tabulated(functions: _Lamperti, params: PyTree) -> _Table:
    params = params if functions.preparation is None else functions.preparation(params)
    below, above = (functions.solve(side, params) for side in (-1, 1))
    x = jnp.concatenate([below[::-1], jnp.asarray([functions.origin], float), above])
    return _Table(x, jax.vmap(lambda x: functions.sigma_at(x, params))(x), params)


# The same object for the same arguments, so that its functions compile once.
_coordinates_of = functools.lru_cache(maxsize=256)(_Lamperti)
