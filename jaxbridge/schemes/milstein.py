"""The scheme of Milstein, for diagonal noise."""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..models.dynamics import Dynamics
from ..models.sigma import Diagonal
from .base import AbstractScheme
from .relative_frame import frame_after_drift


class Milstein(AbstractScheme):
    """Milstein scheme for diagonal noise, in which σ_i depends on x_i alone (for instance d = 1):

        x_i + α_i δ + σ_i ΔW_i + ½ σ_i ∂_iσ_i (ΔW_i² - δ).

    It has strong order 1. For constant σ it is the Euler scheme.

    The inverse solves the quadratic equation for the root that tends to the Euler noise as ∂σ → 0.
    It is exact if `1 + ∂_iσ_i ΔW_i > 0`. The probability that this fails vanishes faster than any
    power of δ. For a step without a solution, the inverse returns ΔW_i = -1/∂_iσ_i, which gives the
    nearest step.

    **Raises:** `ValueError`, at the first use, if σ is a full, state-dependent matrix, or if σ_i
    depends on other coordinates at an end point.

    **Example:**

    ```python
    model = jb.Diffusion(  # its stationary law is a Student's t
        lambda x, p: -x, lambda x, p: jnp.sqrt(1 + x**2), lambda x, p: -2 * jnp.log1p(x @ x)
    )
    coupling = jb.Coupling(0.5, scheme=jb.Milstein())
    bridges = jb.sample_bridges(key, model, [0.0], [1.0], 2.0, num_bridges=100, coupling=coupling)
    ```
    """

    stratonovich: ClassVar[bool] = False

    def fitted(self, dynamics, like, dt):
        return self

    def step(self, dynamics, x, dt, dw):
        sigma = dynamics.sigma(x)
        step = x + dynamics.drift(x) * dt + sigma.mv(dw)
        if not dynamics.sigma_varies:
            return step
        return step + sigma.mv(self._slope(dynamics, x)) * (dw**2 - dt) / 2

    def noise(self, dynamics, x, x_next, dt):
        euler = dynamics.sigma(x).solve(x_next - x - dynamics.drift(x) * dt)
        if not dynamics.sigma_varies:
            return euler
        slope = self._slope(dynamics, x)
        increment = euler + slope * dt / 2  # = ΔW + ½ ∂σ ΔW²
        discriminant = 1 + 2 * slope * increment
        # The step has its extremum at ΔW = -1/∂σ; steps beyond it have no solution.
        past = discriminant <= 0
        increment = jnp.where(past, -0.5 / jnp.where(past, slope, 1), increment)
        # This form of the solution has no division by ∂σ, which may be zero.
        return 2 * increment / (1 + _root(discriminant))

    def frame(self, dynamics, x, driven, dt):
        return frame_after_drift(dynamics, x, driven, dt)

    @staticmethod
    def _slope(dynamics: Dynamics, x: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return ∂_iσ_i(x), shape (d,)."""

        def diagonal(y):
            sigma = dynamics.sigma(y)
            if isinstance(sigma, Diagonal):
                return sigma.diagonal
            if y.shape[0] == 1:
                return sigma.as_matrix(1, y.dtype)[0]
            raise ValueError(
                "`Milstein` needs scalar or diagonal noise, but `diffusion` returns a matrix: if σ "
                "is diagonal, return its diagonal, shape (d,); otherwise use `Heun` or `Euler`."
            )

        # σ_i depends on x_i alone, so one derivative along (1, ..., 1) gives all ∂_iσ_i.
        return jax.jvp(diagonal, (x,), (jnp.ones_like(x),))[1]


def _root(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return √x, zero for negative x.

    Near zero (within rounding) a straight line replaces it, so that the derivative is finite.
    """
    eps = jnp.finfo(x.dtype).eps
    return jnp.where(x > eps, jnp.sqrt(jnp.maximum(x, eps)), jnp.maximum(x, 0) / eps**0.5)
