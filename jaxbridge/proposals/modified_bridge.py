"""The modified diffusion bridge."""

import equinox as eqx
import jax.numpy as jnp

from ..schemes import AbstractStepDensity, check_step_density
from .guided import AbstractGuidedProposal, bridge_law, check_refinement


class ModifiedDiffusionBridge(AbstractGuidedProposal):
    """The modified diffusion bridge of Durham & Gallant (2002): as if α and V stayed as they are
    at the current point,

        x_{i+1} ~ N(x_i + (b - x_i) δ_i/(T - t_i), V(x_i) δ_i (T - t_{i+1})/(T - t_i)).

    The best and cheapest proposal on intervals so short that the drift matters little. For
    σ = I it is the Brownian bridge.

    **Arguments:**

    - `density`: of the target's steps, by default the most accurate: `ItoTaylorDensity()` for
        constant σ, `EulerDensity()` where σ depends on the state.
    - `refinement`: ρ in t_i = T [1 - (1 - i/N)^ρ]: above one, steps shrink towards the end,
        which pays where σ varies much on the way.

    **Example:**

    ```python
    proposal = jb.ModifiedDiffusionBridge()
    chain = jb.sample_exact_bridges(key, model, start, end, 0.1, num_bridges=100, proposal=proposal)
    ```
    """

    density: AbstractStepDensity | None
    refinement: float = eqx.field(static=True)

    def __init__(self, density: AbstractStepDensity | None = None, refinement: float = 1.0):
        self.density = check_step_density(density)
        self.refinement = check_refinement(refinement)

    def describe(self):
        return "ModifiedDiffusionBridge"

    def relative_seconds(self, model, intervals):
        return jnp.full_like(intervals.duration, 1.0)

    def guide(self, dynamics, start, end, dt):
        return None

    def step_law(self, step, x, target):
        return bridge_law(step, target, x + (step.end - x) * (step.dt / step.remaining))
