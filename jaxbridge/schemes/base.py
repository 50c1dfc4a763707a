"""One step of a path: made, inverted, and seen by a pair. Steps have length δ, in units of time;
noise increments are N(0, δ I).

A bridge is built from a path that was simulated backwards, so each scheme must also answer:
which noise drives the forward equation along a given path? (equation (Wrev) of the paper for
Euler). The inverse must use the forward drift. To take the negative of the noise that generated the
reversed path would be wrong by O(δ) per step, which adds up to the drift itself.
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
    """A one-step scheme. All methods act on one point of shape (d,); `dt` is a scalar.

    `stratonovich` says whether it works with Stratonovich's form of the equation.
    """

    stratonovich: ClassVar[bool]

    @abstractmethod
    def fitted(
        self, dynamics: Dynamics, like: Float[Array, " d"], dt: Float[Array, ""]
    ) -> "AbstractScheme":
        """The scheme with all that depends on the equation and the step size but not on the
        point, such as matrix functions, worked out. One without such things returns itself."""

    @abstractmethod
    def step(
        self,
        dynamics: Dynamics,
        x: Float[Array, " d"],
        dt: Float[Array, ""],
        dw: Float[Array, " d"],
    ) -> Float[Array, " d"]:
        """The point reached from `x` after `dt` with noise increment `dw`."""

    @abstractmethod
    def noise(
        self,
        dynamics: Dynamics,
        x: Float[Array, " d"],
        x_next: Float[Array, " d"],
        dt: Float[Array, ""],
    ) -> Float[Array, " d"]:
        """The noise increment that takes `x` to `x_next` in `dt`: the inverse of `step`."""

    @abstractmethod
    def frame(
        self,
        dynamics: Dynamics,
        x: Float[Array, " d"],
        driven: Float[Array, " d"],
        dt: Float[Array, ""],
    ) -> Frame:
        """How a pair lies for the noise of the step, once the drift of it is done (`meeting`)."""


def fitted_in_lanes(
    scheme: AbstractScheme,
    dynamics: Dynamics,
    like: Float[Array, " d"],
    dt: Float[Array, " lanes"],
) -> AbstractScheme:
    """The scheme of each lane: arrays get a trailing axis."""
    return jax.vmap(lambda dt: scheme.fitted(dynamics, like, dt), out_axes=-1)(dt)


def steps_in_lanes(
    scheme: AbstractScheme, dynamics: Dynamics, like: Float[Array, " d"], dt: Float[Array, " lanes"]
) -> Callable[[Float[Array, "d lanes"], Float[Array, "d lanes"]], Float[Array, "d lanes"]]:
    """The step of all lanes, a function of their points and N(0, I) noise."""
    fitted, root_dt = fitted_in_lanes(scheme, dynamics, like, dt), jnp.sqrt(dt)

    @over_lanes(-1, -1, -1, -1, -1)
    def step(x, normal, dt, root_dt, scheme):
        return scheme.step(dynamics, x, dt, root_dt * normal)

    return lambda x, normal: step(x, normal, dt, root_dt, fitted)
