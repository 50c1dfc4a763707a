"""Couplings: how the noise of one copy of the diffusion is made from that of the other.

The direction u of the gap, u ∝ σ(x')⁻¹(x - x'), is built with σ(x') whichever copy drives the
other, x' being the state of X', and in discrete time from the gap when the noise of the step sets
in (`meeting`, `pair`). The rotation O(x, x') belongs to the pair, not to the coupling's geometry
(`rotation`): a coupling sees the noise of X after O has turned it, so one O serves both directions.
"""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
from jaxtyping import Array, Float, Key

from ..schemes import AbstractScheme, Frame
from .meeting import AbstractMeeting
from .start_laws import AnyStartLaw

Rotation = Callable[[Float[Array, "d d"], Float[Array, "d d"]], Float[Array, "d d"] | None]


class AbstractCoupling(eqx.Module):
    """A coupling is two maps of noise increments, and how the pair is stepped and joined.

    Both maps act on one point: `dw`, shape (d,), is the noise of X, already turned by O;
    `driven_dw` that of X'; `du` an independent N(0, δ) increment, or `None` where
    `independent_noise` is false, in which case none is drawn. Each map must turn N(0, δ I)
    noise into N(0, δ I) noise, and the two must be the two conditional laws of one joint law.

    Fields are arrays, or static: bridges carry their coupling with them out of `jit`.

    Write another coupling by subclassing. Synchronous up to a distance, then reflection:

    ```python
    import equinox as eqx
    import jax.numpy as jnp
    import jaxbridge as jb

    class SynchronousThenReflection(jb.AbstractCoupling):
        distance: float = 1.0
        meeting: jb.AbstractMeeting = jb.BrownianCrossing()
        scheme: jb.AbstractScheme = jb.HeunOrEuler()
        start_law: jb.Stationary = jb.Stationary()
        rotation: object = eqx.field(default=None, static=True)
        independent_noise = False

        def driven_noise(self, frame, dw, du):
            mirrored = dw - 2 * frame.u * (frame.u @ dw)
            return jnp.where(frame.gap > self.distance, dw, mirrored)

        def driving_noise(self, frame, driven_dw, du):
            return self.driven_noise(frame, driven_dw, du)  # its own inverse

        def gap_variance(self, frame):
            return jnp.where(frame.gap > self.distance, 0.0, 4.0)

        def realise(self, keys):
            return self
    ```
    """

    meeting: eqx.AbstractVar[AbstractMeeting]
    scheme: eqx.AbstractVar[AbstractScheme]
    start_law: eqx.AbstractVar[AnyStartLaw]
    rotation: eqx.AbstractVar[Rotation | None]
    independent_noise: eqx.AbstractVar[bool]

    @abstractmethod
    def driven_noise(
        self, frame: Frame, dw: Float[Array, " d"], du: Float[Array, ""] | None
    ) -> Float[Array, " d"]:
        """ΔW' of the driven X', from ΔW."""

    @abstractmethod
    def driving_noise(
        self, frame: Frame, driven_dw: Float[Array, " d"], du: Float[Array, ""] | None
    ) -> Float[Array, " d"]:
        """ΔW of X, from ΔW': the same joint law read in the other direction."""

    @abstractmethod
    def gap_variance(self, frame: Frame) -> Float[Array, ""]:
        """The variance per unit of time of `uᵀ(dW - dW')`."""

    @abstractmethod
    def realise(self, keys: Key[Array, " lanes"]) -> "AbstractCoupling":
        """The coupling of each of many proposals: arrays drawn at random get a trailing axis
        of lanes. A coupling without randomness of its own returns itself."""


def check_coupling(coupling) -> None:
    """Raise `TypeError` for anything but a coupling."""
    if not isinstance(coupling, AbstractCoupling):
        raise TypeError(f"`coupling` must be a `Coupling`; got {coupling!r}.")
