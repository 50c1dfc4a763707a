"""The Lamperti transform: coordinates in which a one-dimensional diffusion has σ = 1.

    Y = F(X),    F(x) = ∫_a^x du/σ(u),    dY = (α/σ - σ'/2)(F⁻¹(Y)) dt + dW.

With g = F⁻¹ the stationary density is ν(g(y)) σ(g(y)). Meetings, transitions and weights are those
of a constant σ, of second order in the step size.

The inverse g solves g' = σ(g), g(0) = a. Each call tabulates g once, for its parameters, and
interpolates between the nodes by cubic polynomials. F is computed by quadrature from the nearest
node below.
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
from ..engine.entry import disable_guards
from .diffusion import Diffusion, check_diffusion
from .transform import Transformed, of_points

# Gauss–Legendre quadrature on [-1, 1], exact for polynomials of degree 9.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)


@disable_guards
def lamperti(model: Diffusion, at: Numbers, reach: Numbers, *, num_nodes: int = 400) -> Transformed:
    """Return the one-dimensional model of Y = ∫_a^X du/σ(u), which has σ = 1.

    **Arguments:**

    - `model`: a one-dimensional model with σ(x) > 0.
    - `at`: a, a number in the state space, which corresponds to Y = 0.
    - `reach`: the largest |Y|, in square roots of a unit of time. A path that goes beyond it, or
        leaves the state space, is lost, and counts in `num_nonfinite`.
    - `num_nodes`: the number of nodes, on each side of Y = 0, of the table that gives X as a
        function of Y. Interpolation errors are O((`reach`/`num_nodes`)⁴).

    **Returns:** `Transformed`. Its `model` accepts other parameters, including those of σ, by
    `with_params`, without a new compilation. Its `forward`, `inverse` and `back` keep the
    parameters of the argument `model`: for other parameters call `lamperti` again.

    The coordinates depend on the parameters of σ. So these parameters cannot be inferred from
    observations in these coordinates: `gibbs`, `pmmh`, `score` and `maximum_likelihood` raise an
    error if they are unknown.

    **Raises:** `ValueError` for numbers out of range, unless σ(a) is positive and finite, and for
    coefficients that depend on time. `TypeError` for traced numbers, and unless `model` is a
    `Diffusion`.

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
    origin, reach = _static_number("at", at), _static_number("reach", reach)
    if not reach > 0:
        raise ValueError(f"`reach` must be positive; got {reach}.")
    check_count("num_nodes", num_nodes)
    functions = _cached_functions(model.unbound(), model.preparation, origin, reach, num_nodes)
    table = functions.prepare(model.params)
    sigma_origin = table.sigma[num_nodes]
    if not is_traced(sigma_origin) and not 0 < sigma_origin < math.inf:
        raise ValueError(
            f"`at` must be a point inside the state space, where σ is positive; got σ({origin:g}) "
            f"= {float(sigma_origin):g}."
        )
    transformed = Diffusion(
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
    return Transformed(transformed, forward, inverse)


def _static_number(name: str, value: Numbers) -> float:
    """Return a number that is not traced: coordinates are chosen before compilation.

    **Raises:** `ValueError` unless it is one finite number, `TypeError` if it is traced.
    """
    array = as_floating(name, value)
    if array.shape != ():
        raise ValueError(f"`{name}` must be a number; got shape {array.shape}.")
    if is_traced(array):
        raise TypeError(f"`{name}` must be a known number, not a traced one: pass a Python number.")
    if not math.isfinite(float(array)):
        raise ValueError(f"`{name}` must be finite; got {float(array)}.")
    return float(array)


class _Table(NamedTuple):
    """Values of X and σ(X) at the nodes Y = -reach, ..., 0, ..., reach, and the prepared parameters
    of the original model."""

    x: Float[Array, " n"]
    sigma: Float[Array, " n"]
    params: PyTree


@dataclasses.dataclass(frozen=True)
class _LampertiFunctions:
    """Functions of Y, with the table in place of the parameters, and the maps between X and Y."""

    unbound: Diffusion
    preparation: Callable | None
    origin: float
    reach: float
    num_nodes: int

    @property
    def spacing(self) -> float:
        return self.reach / self.num_nodes

    def prepare(self, params: PyTree) -> _Table:
        """Return the table for these parameters."""
        return _tabulated(self, params)

    def inverse(self, table: _Table, y: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Return x = g(y), by cubic Hermite interpolation; NaN outside the table."""
        position = (y + self.reach) / self.spacing
        # Cell i lies between the nodes i and i + 1, and 0 ≤ s ≤ 1 inside.
        cell = jnp.clip(jnp.floor(position), 0, 2 * self.num_nodes - 1).astype(int)
        s = position - cell.astype(y.dtype)
        left, right = (table.x[i].astype(y.dtype) for i in (cell, cell + 1))
        left_slope, right_slope = (
            self.spacing * table.sigma[i].astype(y.dtype) for i in (cell, cell + 1)
        )
        # The slopes at the nodes are exact, as g' = σ(g).
        rise = right - left
        x = left + s * (
            left_slope
            + s
            * (3 * rise - 2 * left_slope - right_slope + s * (left_slope + right_slope - 2 * rise))
        )
        return jnp.where((s >= 0) & (s <= 1), x, jnp.nan)

    def forward(self, table: _Table, x: Float[Array, " one"]) -> Float[Array, " one"]:
        """Return F(x) = F(x_i) + ∫ du/σ(u), from the node x_i below x; NaN outside the table."""
        nodes, last = table.x.astype(x.dtype), 2 * self.num_nodes
        is_below = jnp.arange(last + 1) < self.num_nodes
        # Nodes outside the state space are NaN; as infinities they keep the table sorted.
        ordered = jnp.where(jnp.isnan(nodes), jnp.where(is_below, -jnp.inf, jnp.inf), nodes)
        cell = jnp.clip(jnp.searchsorted(ordered, x, side="right") - 1, 0, last - 1)
        # Quadrature points between the node below and x.
        half = (x - nodes[cell]) / 2
        points = nodes[cell] + half * (1 + jnp.asarray(_NODES, x.dtype)[:, None])
        sigma_values = jax.vmap(lambda u: self.sigma_at(u, table.params))(points.ravel())
        integrand = jnp.asarray(_WEIGHTS, x.dtype)[:, None] / sigma_values.reshape(points.shape)
        y = (cell.astype(x.dtype) - self.num_nodes) * self.spacing
        y += half * jnp.sum(integrand, axis=0)
        return jnp.where((x >= nodes[cell]) & (x <= nodes[cell + 1]), y, jnp.nan)

    def drift(self, y: Float[Array, " one"], table: _Table) -> Float[Array, " one"]:
        if y.shape != (1,):
            raise ValueError(
                f"`lamperti` needs a one-dimensional `model`; got points of shape {y.shape}."
            )
        x = self.inverse(table, y)
        sigma = lambda x: self.sigma_at(x[0], table.params)
        # One forward derivative gives σ(x) and σ'(x).
        sigma_x, sigma_derivative = jax.jvp(sigma, (x,), (jnp.ones_like(x),))
        return self._model(table).drift(x) / sigma_x - sigma_derivative / 2

    def log_stationary(self, y: Float[Array, " one"], table: _Table) -> Float[Array, ""]:
        x = self.inverse(table, y)
        # The Jacobian dx/dy is σ(x).
        return self._model(table).log_stationary(x) + jnp.log(self.sigma_at(x[0], table.params))

    def sample_stationary(self, key: Key[Array, ""], table: _Table) -> Float[Array, " one"]:
        return self.forward(table, self._model(table).sample_stationary(key))

    def coordinates(self, table: _Table) -> PyTree:
        """Return values that depend on the same parameters as Y: those of σ and of X itself."""
        # The value of σ at one point stands for all its parameters.
        inner_coordinates = self.unbound.coordinates
        sigma_origin = self.sigma_at(jnp.asarray(self.origin, float), table.params)
        return sigma_origin, () if inner_coordinates is None else inner_coordinates(table.params)

    def _model(self, table: _Table) -> Diffusion:
        return self.unbound.with_params(table.params)

    def sigma_at(self, x: Float[Array, ""], params: PyTree) -> Float[Array, ""]:
        """Return σ at one number; NaN, with derivative zero, outside the state space."""
        model = self.unbound.with_params(params)
        # Outside, σ is evaluated at the origin: `where` alone would pass on NaN derivatives.
        inside = jax.lax.stop_gradient(model.diffusion(x[None])[0, 0]) > 0
        point_inside = jnp.where(inside, x, jnp.asarray(self.origin, x.dtype))
        return jnp.where(inside, model.diffusion(point_inside[None])[0, 0], jnp.nan)

    def solve(self, direction: int, params: PyTree) -> Float[Array, " nodes"]:
        """Solve g' = σ(g), g(0) = a, in the `direction` 1 or -1.

        Return g at the nodes, without the origin.
        """
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
def _tabulated(functions: _LampertiFunctions, params: PyTree) -> _Table:
    """Return the table for these parameters, solved from the origin down and up.

    One program is compiled for each `functions` and each structure of the parameters.
    """
    params = params if functions.preparation is None else functions.preparation(params)
    below, above = (functions.solve(side, params) for side in (-1, 1))
    x = jnp.concatenate([below[::-1], jnp.asarray([functions.origin], float), above])
    return _Table(x, jax.vmap(lambda x: functions.sigma_at(x, params))(x), params)


# Equal arguments share one object, so that its functions compile once.
_cached_functions = functools.lru_cache(maxsize=256)(_LampertiFunctions)
