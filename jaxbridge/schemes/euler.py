"""The Euler–Maruyama scheme."""

from typing import ClassVar

from .base import AbstractScheme
from .relative_frame import frame_after_drift


class Euler(AbstractScheme):
    """Euler–Maruyama scheme, `x + α(x)δ + σ(x)ΔW`, as in the paper.

    It has strong order ½ (1 for constant σ) and weak order 1. Its inverse is exact.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, scheme=jb.Euler())
    ```
    """

    stratonovich: ClassVar[bool] = False

    def fitted(self, dynamics, like, dt):
        return self

    def step(self, dynamics, x, dt, dw):
        return x + dynamics.drift(x) * dt + dynamics.sigma(x).mv(dw)

    def noise(self, dynamics, x, x_next, dt):
        return dynamics.sigma(x).solve(x_next - x - dynamics.drift(x) * dt)

    def frame(self, dynamics, x, driven, dt):
        return frame_after_drift(dynamics, x, driven, dt)
