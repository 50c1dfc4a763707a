"""The exact transition of a linear diffusion, as a scheme without discretisation error."""

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
    """Exact transition of a linear diffusion, α(x) = α(0) + A x with constant σ:

        x + M_δ α(x) + R ΔW,    M_δ = ∫_0^δ e^{sA} ds,   R Rᵀ δ = Γ_δ.

    Γ_δ is the covariance of a step. R = σ L, with L lower triangular, tends to σ as δ → 0.

    Paths of the diffusion and of its time reversal have no discretisation error. With the meeting
    rule `BrownianCrossing` the same holds for bridges and transition densities made from them: at
    the grid points one step is as accurate as many. This holds for given parameters only. Functions
    that infer parameters from paths (`gibbs`, `score`, `maximum_likelihood`) use a path likelihood
    with a discretisation error of its own, so there `num_steps` still matters.

    **Raises:** `ValueError`, at the first use, for a drift that is not linear or a σ that depends
    on the state.

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
                "`GaussianTransition` needs linear drift and constant σ; this model has "
                f"{'a state-dependent σ' if dynamics.sigma_varies else 'a nonlinear drift'}. "
                "Omit `scheme=` to use the default scheme."
            )
        sigma = dynamics.sigma(like).as_matrix(like.shape[0], like.dtype)
        moments = linear_transition(jax.jacfwd(dynamics.drift)(like), matmul(sigma, sigma.T), dt)
        # Γ_δ / δ in noise coordinates, whose Cholesky factor L tends to I as δ → 0.
        whitened = solve(sigma, solve(sigma, moments.covariance / dt).T)
        root = matmul(sigma, cholesky(whitened))
        return _FittedTransition(moments.integral, Constant(root, inverse(root)))

    # Without `fitted`, each call computes the matrices again.
    def step(self, dynamics, x, dt, dw):
        return self.fitted(dynamics, x, dt).step(dynamics, x, dt, dw)

    def noise(self, dynamics, x, x_next, dt):
        return self.fitted(dynamics, x, dt).noise(dynamics, x, x_next, dt)

    def frame(self, dynamics, x, driven, dt):
        return self.fitted(dynamics, x, dt).frame(dynamics, x, driven, dt)


class _FittedTransition(AbstractScheme):
    """`GaussianTransition` of one equation with one step size.

    - `integral`: M_δ, shape (d, d).
    - `root`: R.
    """

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
