"""The modified diffusion bridge, a guided proposal for short intervals."""

import equinox as eqx
import jax.numpy as jnp

from ..schemes import AbstractStepDensity, check_step_density
from .guided import AbstractGuidedProposal, bridge_law, check_refinement


class ModifiedDiffusionBridge(AbstractGuidedProposal):
    """Modified diffusion bridge of Durham & Gallant (2002), a guided proposal with the steps

        x_{i+1} ~ N(x_i + (b - x_i) δ_i/(T - t_i), V(x_i) δ_i (T - t_{i+1})/(T - t_i)).

    Each step is that of a bridge whose drift and V stay constant from the current point on. For
    σ = I it is the Brownian bridge. It is the best and cheapest proposal for intervals on which the
    drift matters little.

    **Arguments:**

    - `density`: step density of the target. The default is the most accurate one: exact steps for
        linear drift and constant σ, `ItoTaylorDensity()` for other constant σ, and steps of weak
        order 2 that are not normal for a state-dependent σ. For a state-dependent σ it is
        `EulerDensity()` above ten dimensions, and where a given path must determine its noise: in
        `gibbs`, `smooth`, kernels, chains that start from a `position`, and `maximum_likelihood`
        with `method="em"` or more than 300 unknown parameters.
    - `refinement`: ρ in t_i = T [1 - (1 - i/N)^ρ], between 1 (equal steps) and 4. Above 1 the steps
        shrink towards the end, which helps if σ varies much along the path.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

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
        return jnp.full_like(intervals.duration, self.target_cost)

    def guide(self, dynamics, start, end, dt):
        return None  # a step depends on its own point only

    def step_law(self, step, x, target):
        return bridge_law(step, target, x + (step.end - x) * (step.dt / step.remaining))
