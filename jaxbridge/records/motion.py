"""Law of a step of the diffusion: a jump at its beginning, then a step of the step density."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..engine.linalg import matmul
from ..models.dynamics import DynamicsAt
from ..models.jumps import Jump, JumpMap
from ..schemes import AbstractStepDensity, DegenerateLaw, StepLaw, with_transition
from .record import Steps


class Motion(NamedTuple):
    """Step density, coefficients and jumps of a diffusion, with the parameters of the jumps."""

    density: AbstractStepDensity
    dynamics_at: DynamicsAt
    jump_map: JumpMap | None
    params: PyTree

    def law(self, x: Float[Array, " d"], step: Steps) -> StepLaw | DegenerateLaw:
        """Return the law of the step from x."""
        density = with_transition(self.density, step.transition)
        x = self.after_jump(x, step.jump)
        return density.steps_from(self.dynamics_at(step.time), x).law(step.dt)

    def decay(self, x: Float[Array, " d"], step: Steps) -> Float[Array, "d d"]:
        """Return the derivative of the mean of the step from x."""
        after = self.after_jump(x, step.jump)
        drift = self.dynamics_at(step.time).drift
        F = jax.jacfwd(drift)(after)
        density = with_transition(self.density, step.transition)
        decay = density.linear_step(F, jnp.zeros_like(F), step.dt).decay
        if self.jump_map is None or self.jump_map.adds:
            return decay
        return matmul(decay, jax.jacfwd(self.after_jump)(x, step.jump))

    def after_jump(self, x: Float[Array, " d"], jump: Jump | None) -> Float[Array, " d"]:
        """Return the state after the jump."""
        if self.jump_map is None or jump is None:
            return x
        return self.jump_map(x, jump, self.params)
