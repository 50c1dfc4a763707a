"""Interface of the numerical schemes: a step, its inverse, and the frame of a coupled pair.

Steps have length δ in units of time; noise increments are N(0, δ I).

A coupled bridge contains a path that was simulated backwards. Hence each scheme must also compute
the noise that drives the forward equation along a given path (equation (Wrev) of the paper for
Euler). This inverse must use the forward drift. The negative of the noise that generated the
reversed path would be wrong by O(δ) per step; these errors add up to the drift itself.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..engine.lanes import over_lanes
from ..models.dynamics import Dynamics
from .relative_frame import Frame


class AbstractScheme(eqx.Module):
    """Base class of one-step schemes.

    All methods act on one point of shape (d,), with a scalar step size `dt`. `dynamics` has the
    functions `drift` and `sigma` of the equation. The class attribute `stratonovich` states whether
    the scheme uses the Stratonovich form of the equation.
    """

    stratonovich: ClassVar[bool]

    @abstractmethod
    def fitted(
        self, dynamics: Dynamics, like: Float[Array, " d"], dt: Float[Array, ""]
    ) -> "AbstractScheme":
        """Return a copy of the scheme that stores all quantities that do not depend on the point.

        Examples are matrix functions of the equation and of `dt`. `like` is a point of the right
        shape and dtype. Schemes without such quantities return `self`.
        """

    @abstractmethod
    def step(
        self,
        dynamics: Dynamics,
        x: Float[Array, " d"],
        dt: Float[Array, ""],
        dw: Float[Array, " d"],
    ) -> Float[Array, " d"]:
        """Return the point after one step from `x` with the noise increment `dw`."""

    @abstractmethod
    def noise(
        self,
        dynamics: Dynamics,
        x: Float[Array, " d"],
        x_next: Float[Array, " d"],
        dt: Float[Array, ""],
    ) -> Float[Array, " d"]:
        """Return the noise increment of the step from `x` to `x_next`: the inverse of `step`."""

    @abstractmethod
    def frame(
        self,
        dynamics: Dynamics,
        x: Float[Array, " d"],
        driven: Float[Array, " d"],
        dt: Float[Array, ""],
    ) -> Frame:
        """Return the frame of the pair (`x`, `driven`) after the drift of the step.

        Couplings and meeting rules use it.
        """


def fitted_in_lanes(
    scheme: AbstractScheme,
    dynamics: Dynamics,
    like: Float[Array, " d"],
    dt: Float[Array, " lanes"],
) -> AbstractScheme:
    """Return the fitted scheme of all lanes, whose arrays have lanes in the last axis."""
    return jax.vmap(lambda dt: scheme.fitted(dynamics, like, dt), out_axes=-1)(dt)


def steps_in_lanes(
    scheme: AbstractScheme, dynamics: Dynamics, like: Float[Array, " d"], dt: Float[Array, " lanes"]
) -> Callable[[Float[Array, "d lanes"], Float[Array, "d lanes"]], Float[Array, "d lanes"]]:
    """Return the step of all lanes, as a function of their points and N(0, I) noise."""
    # Values that depend on δ only are computed once, outside of the step.
    fitted, root_dt = fitted_in_lanes(scheme, dynamics, like, dt), jnp.sqrt(dt)

    @over_lanes(-1, -1, -1, -1, -1)
    def step(x, normal, dt, root_dt, scheme):
        return scheme.step(dynamics, x, dt, root_dt * normal)

    return lambda x, normal: step(x, normal, dt, root_dt, fitted)
