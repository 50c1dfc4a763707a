"""The default scheme: selection of `GaussianTransition`, `Heun` or `Euler` by the model."""

from typing import ClassVar

from jaxtyping import Array, Float

from ..models import decisions
from ..models.dynamics import Dynamics, is_linear
from .base import AbstractScheme
from .euler import Euler
from .gaussian_transition import GaussianTransition
from .heun import Heun

# In three dimensions exact steps take 1.2 times as long as Heun's, and longer to compile.
_MOST_EXACT = 2


class HeunOrEuler(AbstractScheme):
    """Default scheme: `Heun` for constant σ, `Euler` for a state-dependent σ, and the exact
    `GaussianTransition` for constant σ and linear drift in one or two dimensions.

    For constant σ the corrector raises the weak order from 1 to 2, at the cost of one more
    evaluation of the drift. For a state-dependent σ both schemes have weak order 1, but Heun also
    needs the derivatives of σ. In more dimensions the matrix exponentials of `GaussianTransition`,
    one for each path, cost more than the steps of Heun's scheme; it can be selected there.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, scheme=jb.HeunOrEuler())  # the default
    ```
    """

    stratonovich: ClassVar[bool] = False

    def fitted(self, dynamics, like, dt):
        return scheme_for(self, dynamics, like).fitted(dynamics, like, dt)

    def step(self, dynamics, x, dt, dw):
        return scheme_for(self, dynamics, x).step(dynamics, x, dt, dw)

    def noise(self, dynamics, x, x_next, dt):
        return scheme_for(self, dynamics, x).noise(dynamics, x, x_next, dt)

    def frame(self, dynamics, x, driven, dt):
        return scheme_for(self, dynamics, x).frame(dynamics, x, driven, dt)


def scheme_for(
    scheme: AbstractScheme, dynamics: Dynamics, like: Float[Array, " d"]
) -> AbstractScheme:
    """Return the scheme, or the one that `HeunOrEuler` selects for this equation."""
    if not isinstance(scheme, HeunOrEuler):
        return scheme
    if like.shape[0] <= _MOST_EXACT and is_linear(dynamics, like):
        return GaussianTransition()
    return Heun() if decisions.corrector(dynamics.sigma_varies, False).simulated else Euler()
