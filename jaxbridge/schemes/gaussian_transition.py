"""The exact transition of a linear diffusion."""

from typing import ClassVar

import jax
from jaxtyping import Array, Float

from ..engine.linalg import cholesky, inverse, matmul, matvec, solve
from ..models.dynamics import is_linear
from ..models.linear import linear_transition
from ..models.sigma import Constant
from .base import AbstractScheme
from .relative_frame import frame_of


class GaussianTransition(AbstractScheme):
    """The exact transition of a linear diffusion, α(x) = α(0) + A x with constant σ,

        x + M_δ α(x) + R ΔW,    M_δ = ∫_0^δ e^{sA} ds,   R Rᵀ δ = Γ_δ,

    with the root R = σ L, L lower triangular, that tends to σ as δ → 0. Paths of the diffusion
    and of its time reversal have no step error at all, nor have bridges made of them, and
    transition densities by these, if the meeting rule is `BrownianCrossing`: at its grid points
    one step is as good as many. That is so for given parameters only. Where parameters are
    inferred from the paths (`gibbs`, `score`, `maximum_likelihood`) the likelihood of a path has a
    step error of its own, whatever the scheme, so there `num_steps` still counts.

    **Raises:** `ValueError`, when it is used, for a drift that is not linear, or σ that depends on
    the state.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, scheme=jb.GaussianTransition())
    bridges = jb.sample_bridges(key, model, start, end, 1.0, num_bridges=100, coupling=coupling)
    ```
    """

    stratonovich: ClassVar[bool] = False

    def fitted(self, dynamics, like, dt):
        if not is_linear(dynamics, like):
            raise ValueError(
                "`GaussianTransition` is for linear drift and constant σ; this model has "
                f"{'a σ that depends on the state' if dynamics.sigma_varies else 'another drift'}. "
                "Leave `scheme=` out."
            )
        sigma = dynamics.sigma(like).as_matrix(like.shape[0], like.dtype)
        moments = linear_transition(jax.jacfwd(dynamics.drift)(like), matmul(sigma, sigma.T), dt)
        whitened = solve(sigma, solve(sigma, moments.covariance / dt).T)
        root = matmul(sigma, cholesky(whitened))
        return _FittedTransition(moments.integral, Constant(root, inverse(root)))

    def step(self, dynamics, x, dt, dw):
        return self.fitted(dynamics, x, dt).step(dynamics, x, dt, dw)

    def noise(self, dynamics, x, x_next, dt):
        return self.fitted(dynamics, x, dt).noise(dynamics, x, x_next, dt)

    def frame(self, dynamics, x, driven, dt):
        return self.fitted(dynamics, x, dt).frame(dynamics, x, driven, dt)


class _FittedTransition(AbstractScheme):
    """The same for one equation and one step size."""

    integral: Float[Array, "d d"]
    root: Constant
    stratonovich: ClassVar[bool] = False

    def fitted(self, dynamics, like, dt):
        return self

    def step(self, dynamics, x, dt, dw):
        return x + matvec(self.integral, dynamics.drift(x)) + self.root.mv(dw)

    def noise(self, dynamics, x, x_next, dt):
        return self.root.solve(x_next - x - matvec(self.integral, dynamics.drift(x)))

    def frame(self, dynamics, x, driven, dt):
        drift = dynamics.drift(x) - dynamics.drift(driven)
        return frame_of(self.root, x - driven + matvec(self.integral, drift))
