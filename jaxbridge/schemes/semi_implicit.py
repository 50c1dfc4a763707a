"""The linearly implicit trapezoid rule, for stiff or superlinear drift."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..engine.linalg import matvec, solve
from ..models.dynamics import Dynamics
from ..models.sigma import Constant
from .base import AbstractScheme
from .relative_frame import frame_of


class SemiImplicit(AbstractScheme):
    """Linearly implicit trapezoid rule, for stiff or superlinear drift:

        x + L⁻¹ [α(x) δ + σ(x) ΔW],    L = I - ½ δ ∇α(x),

    with ∇α by automatic differentiation. A step solves one linear system. Its inverse is explicit,
    `σ⁻¹ [L (x⁺ - x) - α δ]`.

    The scheme stays stable for step sizes at which explicit schemes overflow. For linear drift and
    constant σ it preserves the stationary law exactly, for every step size. For α = -x³ a step from
    a large x leads to x/3. The strong order is ½ (1 for constant σ). The weak order is 1 (2 for
    linear drift and constant σ).

    The step size must be much smaller than 1/λ for each positive eigenvalue λ of ½∇α, because L is
    singular at δ = 1/λ. Positive eigenvalues occur, for instance, at the barrier of a double well.

    **Example:**

    ```python
    quartic = jb.langevin(lambda x, p: -(x @ x) ** 2 / 2)
    coupling = jb.Coupling(0.5, scheme=jb.SemiImplicit())
    bridges = jb.sample_bridges(key, quartic, [0.0], [1.0], 2.0, num_bridges=100, coupling=coupling)
    ```
    """

    stratonovich: ClassVar[bool] = False

    def fitted(self, dynamics, like, dt):
        return self

    def step(self, dynamics, x, dt, dw):
        drift, implicit = self._linearised(dynamics, x, dt)
        return x + solve(implicit, drift * dt + dynamics.sigma(x).mv(dw))

    def noise(self, dynamics, x, x_next, dt):
        drift, implicit = self._linearised(dynamics, x, dt)
        return dynamics.sigma(x).solve(matvec(implicit, x_next - x) - drift * dt)

    def frame(self, dynamics, x, driven, dt):
        """Return the frame for the matrix L⁻¹σ of the noise, evaluated at x'."""
        drift, implicit = self._linearised(dynamics, x, dt)
        driven_drift, driven_implicit = self._linearised(dynamics, driven, dt)
        drift_difference = solve(implicit, drift * dt) - solve(driven_implicit, driven_drift * dt)
        d, sigma = x.shape[0], dynamics.sigma(driven)
        units = [jnp.asarray(unit, x.dtype) for unit in np.eye(d)]
        # The inverse of L⁻¹σ is σ⁻¹L, which needs no further linear system.
        whiten = jnp.stack([sigma.solve(matvec(driven_implicit, unit)) for unit in units], axis=1)
        root = solve(driven_implicit, sigma.as_matrix(d, x.dtype))
        return frame_of(Constant(root, whiten), x - driven + drift_difference)

    def _linearised(self, dynamics: Dynamics, x: Float[Array, " d"], dt: Float[Array, ""]):
        """Return α and L at x."""
        slope = jax.jacfwd(dynamics.drift)(x)
        return dynamics.drift(x), jnp.eye(x.shape[0], dtype=x.dtype) - slope * dt / 2
