"""The Langevin equation with inertia, in which noise enters the velocities only."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..engine.arguments import check_function
from ..engine.checks import Numbers, as_numbers, check_range
from .diffusion import Diffusion, halves, value_at


class UnderdampedLangevinParams(NamedTuple):
    """Parameters of `underdamped_langevin`, the `params` of the model.

    - `friction`: per unit of time, shape ().
    - `temperature`: in units of the potential, shape ().
    - `potential`: the parameters that the potential receives, any pytree.

    **Example:**

    ```python
    model = jb.underdamped_langevin(lambda q, p: q @ q / 2)
    hotter = model.with_params(model.params._replace(temperature=jnp.asarray(2.0)))
    ```
    """

    friction: Float[Array, ""]
    temperature: Float[Array, ""]
    potential: PyTree


def underdamped_langevin(
    potential: Callable, friction: Numbers = 1.0, temperature: Numbers = 1.0, params: PyTree = None
) -> Diffusion:
    """Return the model of a particle of mass 1 in a potential U and a heat bath (Langevin 1908;
    Pavliotis 2014, chapter 6).

    The state is (Q, P), positions and velocities, shape (2n,):

        dQ = P dt,    dP = (-∇U(Q) - γP) dt + √(2γτ) dW,    log ν = -(U(q) + ½|p|²) / τ + constant.

    The model is hypoelliptic: noise enters P only. Functions for bridges and transition densities
    do not apply; use `simulate`, or records with an `observation`, such as two exact states.
    `params` of the model is an `UnderdampedLangevinParams`.

    **Arguments:**

    - `potential`: U, a function `(q, params) -> ()` of positions, shape (n,).
    - `friction`: γ ≥ 0, per unit of time, shape ().
    - `temperature`: τ > 0, in units of the potential, shape ().
    - `params`: any pytree; the potential receives it.

    **Raises:** `TypeError` for a potential that is not a function. `ValueError` for other shapes or
    values.

    **Example:**

    ```python
    well = jb.underdamped_langevin(lambda q, p: (q @ q - 1) ** 2, friction=0.5)
    well.drift(jnp.array([0.0, 1.0]))  # Array([ 1. , -0.5], dtype=float32)
    ```
    """
    check_function("potential", potential, "(q, params)")
    numbers = as_numbers({"friction": friction, "temperature": temperature})
    check_range("friction", numbers["friction"], nonnegative=True)
    check_range("temperature", numbers["temperature"], positive=True)
    functions = _UnderdampedFunctions(potential)
    model_params = UnderdampedLangevinParams(**numbers, potential=params)
    return Diffusion(functions.drift, _sigma, functions.log_stationary, model_params)


@dataclasses.dataclass(frozen=True)
class _UnderdampedFunctions:
    """Functions of one state and the parameters. Equal potentials give equal objects, which compile
    once."""

    potential: Callable

    def drift(self, x, p):
        q, v = _halves(x)
        return jnp.concatenate([v, -jax.grad(self._energy)(q, p) - p.friction * v])

    def log_stationary(self, x, p):
        q, v = _halves(x)
        # Boltzmann's law: potential and kinetic energy, with mass 1.
        return -(self._energy(q, p) + v @ v / 2) / p.temperature

    def _energy(self, q, p):
        """Return the potential U(q)."""
        return value_at("potential", self.potential, (), q, p.potential)


def _sigma(x, p):
    """Return σ, shape (2n, n): zero for the positions, √(2γτ) I for the velocities."""
    n = len(_halves(x)[0])
    # Fluctuation and dissipation balance at this strength, so the law is stationary.
    noise = jnp.sqrt(2 * p.friction * p.temperature) * jnp.eye(n, dtype=x.dtype)
    return jnp.concatenate([jnp.zeros((n, n), x.dtype), noise])


def _halves(x: Float[Array, " d"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return positions and velocities."""
    return halves(x, "n positions and n velocities, an even number of coordinates")
