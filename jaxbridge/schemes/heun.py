"""The scheme of Heun, a predictor–corrector for the Stratonovich form."""

from typing import ClassVar

from jaxtyping import Array, Float

from ..engine.lanes import compute_once
from ..models import decisions
from ..models.dynamics import Dynamics, ito_correction
from .base import AbstractScheme
from .relative_frame import frame, frame_after_drift


class Heun(AbstractScheme):
    """Predictor–corrector scheme of Heun, for the Stratonovich form of the equation:

        x + ½ [α_S(x) + α_S(x̃)] δ + ½ [σ(x) + σ(x̃)] ΔW,    α_S = α - ½ Σ_jk ∂_kσ_·j σ_kj.

    The predictor x̃ is the Euler step of the same form. The weak order is 2 for constant σ, and 1
    otherwise.

    The inverse ξ solves the trapezoid rule along the path,
    `½ [σ(x) + σ(x⁺)] ξ = x⁺ - x - ½ [α_S(x) + α_S(x⁺)] δ`. After a predictor–corrector step it
    returns the noise up to O(δ^{3/2}), and up to O(δ^{5/2}) for constant σ.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, scheme=jb.Heun())
    ```
    """

    stratonovich: ClassVar[bool] = True

    def fitted(self, dynamics, like, dt):
        return self

    def step(self, dynamics, x, dt, dw):
        drift, sigma = self._stratonovich_drift(dynamics, x), dynamics.sigma(x)
        # Otherwise XLA may compute the predictor again for each component of the drift at it.
        predicted = compute_once(x + drift * dt + sigma.mv(dw))
        drift = (drift + self._stratonovich_drift(dynamics, predicted)) / 2
        return x + drift * dt + sigma.average(dynamics.sigma(predicted)).mv(dw)

    def noise(self, dynamics, x, x_next, dt):
        drift = self._stratonovich_drift(dynamics, x) + self._stratonovich_drift(dynamics, x_next)
        sigma = dynamics.sigma(x).average(dynamics.sigma(x_next))
        return sigma.solve(x_next - x - drift * dt / 2)

    def frame(self, dynamics, x, driven, dt):
        """Return the frame with u after half of the drift (constant σ only), and the gap before it.

        For constant σ the noise of the step is σ (I + ½ ∇α δ) ΔW. With u after half of the drift
        the gap at the end lies along (I + ½ ∇α δ) u. The length is that at the beginning, because
        meeting rules use its product with the length at the end, D_{i+1}.
        """
        now = frame(dynamics.sigma(driven), x, driven)
        if dynamics.sigma_varies:
            return now
        half = frame_after_drift(dynamics, x, driven, dt / 2)
        return now._replace(u=half.u)

    def _stratonovich_drift(self, dynamics: Dynamics, x: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return α_S at x; it equals α for constant σ."""
        drift = dynamics.drift(x)
        corrected = decisions.stratonovich(self.stratonovich, dynamics.sigma_varies).simulated
        return drift - ito_correction(dynamics, x) if corrected else drift
