"""The interface of couplings: maps between the noises of two copies of a diffusion.

The direction u of the gap is proportional to σ(x')⁻¹(x - x'), where x' is the state of X'. It uses
σ(x') in both directions, whichever copy drives the other. In discrete time the gap is taken at the
moment when the noise of the step begins to act (`meeting`, `pair`).

The rotation O(x, x') belongs to the pair (`rotation`), not to the coupling. A coupling receives the
noise of X after its rotation by O, so one O serves both directions.
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
    """Base class of couplings: two maps of noise increments, and rules for steps and meetings.

    A subclass has the fields `meeting`, `scheme`, `start_law` and `rotation`, as in `Coupling`. The
    maps are the methods `driven_noise` and `driving_noise`. Both act on the noise of one step of
    size δ at one point:

    - `dw`, shape (d,), is the noise of X after its rotation by O.
    - `driven_dw`, shape (d,), is the noise of X'.
    - `du`, shape (), is an independent N(0, δ) increment. It is `None` if `independent_noise` is
        false, and then none is sampled.

    Each map must turn N(0, δ I) noise into N(0, δ I) noise. One joint law of both noises must have
    the two maps as its conditional laws: of ΔW' given ΔW, and of ΔW given ΔW'.

    Fields must be arrays, modules of arrays, or static: results that leave `jit` contain their
    coupling.

    Example of another coupling: X and X' share their noise while the gap is large, and the noise is
    reflected when the gap is small.

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
        """Return ΔW', the noise of X', for the noise ΔW of X after its rotation by O."""

    @abstractmethod
    def driving_noise(
        self, frame: Frame, driven_dw: Float[Array, " d"], du: Float[Array, ""] | None
    ) -> Float[Array, " d"]:
        """Return ΔW, the noise of X after its rotation by O, for the noise ΔW' of X'.

        The map is the conditional law of ΔW given ΔW', under the joint law of `driven_noise`.
        """

    @abstractmethod
    def gap_variance(self, frame: Frame) -> Float[Array, ""]:
        """Return the variance of `uᵀ(dW - dW')` per unit of time, with dW after its rotation."""

    @abstractmethod
    def realise(self, keys: Key[Array, " lanes"]) -> "AbstractCoupling":
        """Return the coupling of each lane: random arrays get a trailing axis of lanes.

        A coupling without random parameters returns itself.
        """


def check_coupling(coupling) -> None:
    """Raise `TypeError` if `coupling` is not an `AbstractCoupling`."""
    if not isinstance(coupling, AbstractCoupling):
        raise TypeError(
            f"`coupling` must be a `Coupling`; got {coupling!r}. Pass `Coupling(gamma)`, or an "
            "instance of a subclass of `AbstractCoupling`."
        )
