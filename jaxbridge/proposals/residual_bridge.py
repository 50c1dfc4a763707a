"""The residual bridge, a guided proposal along a deterministic path."""

import equinox as eqx
import jax.numpy as jnp

from ..schemes import AbstractStepDensity, check_step_density
from .guided import (
    AbstractGuidedProposal,
    bridge_law,
    check_refinement,
    deterministic_path,
)


class ResidualBridge(AbstractGuidedProposal):
    """Residual bridge of Whitaker, Golightly, Boys & Sherlock (2017), a guided proposal.

    It is the modified diffusion bridge of x - ξ, where ξ solves dξ = α(ξ) dt from the start:

        x_{i+1} = x_i + Δξ_i + (b - ξ_N - (x_i - ξ_i)) δ_i/(T - t_i) + noise.

    The noise is that of `ModifiedDiffusionBridge`. The residual bridge is better if the drift moves
    all paths in the same direction. The interval must be short compared with the relaxation time of
    the drift.

    **Arguments:**

    - `density`, `refinement`: as in `ModifiedDiffusionBridge`.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    proposal = jb.ResidualBridge()
    chain = jb.sample_exact_bridges(key, model, start, end, 0.5, num_bridges=100, proposal=proposal)
    ```
    """

    density: AbstractStepDensity | None
    refinement: float = eqx.field(static=True)

    def __init__(self, density: AbstractStepDensity | None = None, refinement: float = 1.0):
        self.density = check_step_density(density)
        self.refinement = check_refinement(refinement)

    def describe(self):
        return "ResidualBridge"

    def relative_seconds(self, model, intervals):
        return jnp.full_like(intervals.duration, 1.3 * self.target_cost)

    def guide(self, dynamics, start, end, dt):
        xi, xi_end = deterministic_path(self.target, dynamics, start, dt)
        displacement = jnp.concatenate([xi[1:], xi_end[None]]) - xi
        return displacement[:-1], (xi + end - xi_end)[:-1]

    def step_law(self, step, x, target):
        displacement, aim = step.guide
        # The residual x - ξ is pulled to its end b - ξ_N; `aim` is ξ_i + b - ξ_N.
        return bridge_law(step, target, x + displacement + (aim - x) * (step.dt / step.remaining))
