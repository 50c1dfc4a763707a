"""Guided proposals by the transition density of a linear process.

The law q_i of a step (`guided`) follows from an h-function: h_{i+1}(x) approximates the transition
density from x at t_{i+1} to b. Let log h be quadratic, with r̃ = ∇log h(μ_i) and H̃ = -∇²log h. The
step of the target, tilted by h, has the law

    q_i = N(μ_i + δ L C Lᵀ r̃, δ L C Lᵀ).

Here C = S (I + δ Lᵀ H̃ L S)⁻¹ and L Lᵀ = V(x_i).
The definitions of r̃ and H̃ are those of Schauer, van der Meulen & van Zanten (2017). The discrete
form is that of Whitaker, Golightly, Boys & Sherlock (2017). If h is the true density, this is
Doob's h-transform, and w is constant.

The linear process has its own Ṽ = L̃ L̃ᵀ. If V(x) is larger than Ṽ, the h-function guides too
strongly; if V(x) is smaller, too weakly. Both give weights with heavy tails. The mean V̄ = L̄ L̄ᵀ of
V(x) and Ṽ is closer to V on the way to b. Hence the deviations from b are scaled to V̄:

    H̃ := L̄⁻ᵀ L̃ᵀ H L̃ L̄⁻¹,    r̃ := L̄⁻ᵀ [(L̄⁻¹ L̃)ᵀ L̃ᵀ ρ - L̃ᵀ H L̃ L̄⁻¹ (μ_i - b)].

For V(x) = Ṽ this is the h-function without scaling.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..engine.checks import Numbers, as_floating, is_traced
from ..engine.lanes import over_points
from ..engine.linalg import inverse, matmul, matvec
from ..models.dynamics import Dynamics
from ..models.sigma import covariance_of, root_of
from ..schemes import AbstractStepDensity, StepLaw, check_step_density
from .guided import AbstractGuidedProposal, check_refinement, deterministic_path

# Above this δ |F| a step is unlike the diffusion: long steps have made the path ξ diverge.
_DIVERGED = 10.0


class _StateGuide(NamedTuple):
    """Quadratic log h(x) = ρᵀ(x - b) - ½ (x - b)ᵀ H (x - b) + constant, in state coordinates.

    - `shift`: ρ.
    - `precision`: H.
    """

    shift: Float[Array, " d"]
    precision: Float[Array, "d d"]


class _NoiseGuide(NamedTuple):
    """Quadratic log h in noise coordinates.

    - `shift`: L̃ᵀρ.
    - `precision`: L̃ᵀH L̃.
    - `root`: L̃ with Ṽ = L̃ L̃ᵀ; `None` for constant σ, where all points have the same root.
    """

    shift: Float[Array, "d *lanes"]
    precision: Float[Array, "d d *lanes"]
    root: Float[Array, "d d *lanes"] | None


class Guided(AbstractGuidedProposal):
    """Guided proposal of Schauer, van der Meulen & van Zanten (2017).

    Its h-function is the transition density of a linear process

        dX̃ = [α̃ + F (X̃ - b)] dt + σ̃ dW

    in the steps of the target. For an Ornstein–Uhlenbeck process all weights are equal. For a
    state-dependent σ the deviations from b are scaled to the mean of V(x) = σσᵀ and Ṽ = σ̃σ̃ᵀ. The
    scaling is not in that paper. Without it the weights have heavy tails, and the effective sample
    size is overestimated.

    **Arguments:**

    - `linearisation`: one of
        - "end": linearised at b, F = ∇α(b), α̃ = α(b), σ̃ = σ(b);
        - "path": linearised along the deterministic path dξ = α(ξ) dt from the start, plus a linear
            function of time such that the path ends in b. Where long steps make this path diverge,
            its points are replaced by those of a straight line;
        - a matrix F of shape (d, d), with α̃ = α(b) and σ̃ = σ(b).
    - `density`, `refinement`: as in `ModifiedDiffusionBridge`.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    proposal = jb.Guided()
    chain = jb.sample_exact_bridges(key, model, start, end, 2.0, num_bridges=100, proposal=proposal)
    ```
    """

    density: AbstractStepDensity | None
    refinement: float = eqx.field(static=True)
    _along: str = eqx.field(static=True)
    _matrix: Float[Array, "d d"] | None

    def __init__(
        self,
        linearisation: Literal["end", "path"] | Numbers = "end",
        density: AbstractStepDensity | None = None,
        refinement: float = 1.0,
    ):
        self.density = check_step_density(density)
        self.refinement = check_refinement(refinement)
        if isinstance(linearisation, str):
            if linearisation not in ("end", "path"):
                raise ValueError(
                    f'`linearisation` must be "end", "path" or a matrix; got {linearisation!r}.'
                )
            self._along, self._matrix = linearisation, None
            return
        self._along, self._matrix = "end", as_floating("linearisation", linearisation)
        if self._matrix.ndim != 2 or self._matrix.shape[0] != self._matrix.shape[1]:
            raise ValueError(
                f"`linearisation` must be a matrix of shape (d, d); got shape {self._matrix.shape}."
            )
        if not is_traced(self._matrix) and not np.all(np.isfinite(self._matrix)):
            raise ValueError(f"`linearisation` must be finite; got {self._matrix}.")

    @property
    def linearisation(self) -> str:
        """Return the kind of linearisation: '"end"', '"path"' or 'matrix'."""
        return f'"{self._along}"' if self._matrix is None else "matrix"

    def describe(self):
        return f"Guided({self.linearisation})"

    def relative_seconds(self, model, intervals):
        return jnp.full_like(intervals.duration, 1.3 * self.target_cost)

    def guide(self, dynamics, start, end, dt):
        d = end.shape[0]
        if self._matrix is not None and self._matrix.shape != (d, d):
            raise ValueError(
                f"`linearisation` of `Guided` must have shape ({d}, {d}) for points of {d} "
                f"dimensions; got shape {self._matrix.shape}."
            )
        points = end[None]
        if self._along == "path":
            xi, xi_end = deterministic_path(self.target, dynamics, start, dt)
            elapsed = jnp.concatenate([jnp.zeros_like(dt[:1]), jnp.cumsum(dt)[:-1]]) / jnp.sum(dt)
            points = xi + elapsed[:, None] * (end - xi_end)
            # If the deterministic path diverges, a straight line replaces it.
            straight = start + elapsed[:, None] * (end - start)
            rates = over_points(jax.jacfwd(dynamics.drift))(lax.stop_gradient(points))
            is_near = dt * jnp.max(jnp.abs(rates), axis=(1, 2)) < _DIVERGED
            points = jnp.where(is_near[:, None], points, straight)
        coefficients = over_points(lambda x: self._linear(dynamics, x, end))(points)

        def step_back(h: _StateGuide, inputs) -> tuple[_StateGuide, _StateGuide]:
            """Return h_i and h_{i+1} from h_{i+1}, by one step of the linear process."""
            (F, drift, V), dt = inputs
            shift, H = h
            step = self.target.linear_step(F, V, dt)
            # `gain` H = (H⁻¹ + covariance)⁻¹, in a form that allows a singular H.
            gain = inverse(jnp.eye(d, dtype=end.dtype) + matmul(H, step.covariance))
            shift = shift - matvec(H, matvec(step.integral, drift))
            shift = matvec(step.decay.T, matvec(gain, shift))
            H = matmul(step.decay.T, matmul(matmul(gain, H), step.decay))
            return _StateGuide(shift, (H + H.T) / 2), h  # H stays symmetric under rounding

        F, drift, V = jax.tree.map(lambda leaf: leaf[-1], coefficients)
        step = self.target.linear_step(F, V, dt[-1])
        pull = matmul(step.decay.T, inverse(step.covariance))  # from t_{N-1} to b
        last = _StateGuide(-matvec(pull, matvec(step.integral, drift)), matmul(pull, step.decay))
        num_steps = dt.shape[0]
        per_step = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (num_steps, *leaf.shape[1:]))[:-1], coefficients
        )
        _, (shift, H) = lax.scan(step_back, last, (per_step, dt[:-1]), reverse=True)
        roots = over_points(lambda x: dynamics.sigma(x).root().as_matrix(d, x.dtype))(points)
        roots = jnp.broadcast_to(roots, (num_steps, d, d))[:-1]
        pull_back = jnp.swapaxes(roots, 1, 2)
        shift = jax.vmap(matvec)(pull_back, shift)
        H = jax.vmap(matmul)(jax.vmap(matmul)(pull_back, H), roots)
        return _NoiseGuide(shift, H, roots if dynamics.sigma_varies else None)

    def step_law(self, step, x, target):
        shift, H, L_guide = step.guide
        L, S, gap = target.sigma.root(), target.matrix, target.mean - step.end
        if L_guide is None:  # L̃ = L: no scaling
            K, r = H, shift - matvec(H, L.solve(gap))  # Lᵀ H̃ L and Lᵀ r̃
        else:
            root_here = L.as_matrix(len(x), x.dtype)
            scale = root_of((matmul(root_here, root_here.T) + matmul(L_guide, L_guide.T)) / 2)  # L̄
            from_guide, from_here = (
                jnp.stack([scale.solve(root[:, j]) for j in range(len(x))], axis=1)
                for root in (L_guide, root_here)
            )
            K = matmul(from_here.T, matmul(H, from_here))
            r = matvec(from_guide.T, shift) - matvec(H, scale.solve(gap))
            r = matvec(from_here.T, r)
        C = matmul(S, inverse(jnp.eye(len(x), dtype=x.dtype) + step.dt * matmul(K, S)))
        mean = target.mean + step.dt * L.mv(matvec(C, r))
        return StepLaw(mean, L, (C + C.T) / 2, step.dt)

    def _linear(self, dynamics: Dynamics, x: Float[Array, " d"], end: Float[Array, " d"]):
        """Return F, the linear drift at b, and Ṽ, for the diffusion linearised at x."""
        F = jax.jacfwd(dynamics.drift)(x) if self._matrix is None else self._matrix.astype(x.dtype)
        V = covariance_of(dynamics.sigma(x), x)
        return F, dynamics.drift(x) + matvec(F, end - x), V
