"""The scheme that a scene calls for."""

from typing import ClassVar

from ..models import decisions
from ..models.dynamics import Dynamics
from .base import AbstractScheme
from .euler import Euler
from .heun import Heun


class HeunOrEuler(AbstractScheme):
    """`Heun` where σ is constant, `Euler` where it depends on the state.

    For constant σ the corrector takes the weak order from 1 to 2 for one more drift. Where σ
    depends on the state both are of weak order 1, and Stratonovich's correction, which calls for
    the derivatives of σ, is an effect that nothing asks for.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, scheme=jb.HeunOrEuler())  # the default
    ```
    """

    stratonovich: ClassVar[bool] = False

    def fitted(self, dynamics, like, dt):
        return scheme_for(self, dynamics)

    def step(self, dynamics, x, dt, dw):
        return scheme_for(self, dynamics).step(dynamics, x, dt, dw)

    def noise(self, dynamics, x, x_next, dt):
        return scheme_for(self, dynamics).noise(dynamics, x, x_next, dt)

    def frame(self, dynamics, x, driven, dt):
        return scheme_for(self, dynamics).frame(dynamics, x, driven, dt)


def scheme_for(scheme: AbstractScheme, dynamics: Dynamics) -> AbstractScheme:
    """The scheme itself, or the one that `HeunOrEuler` is for this equation."""
    if not isinstance(scheme, HeunOrEuler):
        return scheme
    return Heun() if decisions.corrector(dynamics.sigma_varies).simulated else Euler()
