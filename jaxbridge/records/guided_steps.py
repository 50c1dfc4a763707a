"""The steps of a path that is guided through a record, and their inverse.

From x at the beginning of a step, where h is h_i, the target's step N(μ(x), Λ Λᵀ) is made that of
the path given what is seen at its end and h_{i+1} (`tilted_step`), and its weight is

    ∫ p(x'| x) g(y| x') h_{i+1}(x') dx' / h_i(x),

which does not depend on where the step goes: where the model is linear it is constant.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..engine.linalg import dot
from ..models.dynamics import DynamicsAt
from ..schemes import AbstractStepDensity, DegenerateLaw, StepLaw
from .observation import Scalars
from .record import Steps
from .tilted_step import Information, NormalStep, Seen, Tilted, coordinates, given, tilted


class Guide(NamedTuple):
    """What a step is guided by: ξ_i and h_i at its beginning, ξ_{i+1} and h_{i+1} at its end, and
    its length and time."""

    point: Float[Array, "d *lanes"]
    h: Information
    next_point: Float[Array, "d *lanes"]
    next_h: Information
    step: Steps


class GuidedLaw(NamedTuple):
    """The law of a guided step, its log weight, and what was seen on the way."""

    origin: Float[Array, " d"]
    tilted: Tilted
    log_weight: Float[Array, ""]
    seen: list[Seen]

    def point(self, zeta: Float[Array, " m"]) -> Float[Array, " d"]:
        """Where the noise ζ ~ N(0, I) leads."""
        return self.origin + self.tilted.point(zeta)

    def noise(
        self,
        point: Float[Array, " d"],
        solve: Callable[[Float[Array, " d"]], Float[Array, " m"]],
        hidden: Float[Array, " n"],
    ) -> Float[Array, " m"]:
        """Noise that leads to this point, where `solve` is Λ⁻¹ of the step before anything is
        seen; `hidden` as in `coordinates`."""
        displacement = solve(point - self.origin - self.tilted.step.mean)
        return self.tilted.noise(coordinates(displacement, self.seen, hidden[: len(self.seen)]))


def relative(scalars: Scalars, point: Float[Array, " d"]) -> Scalars:
    """What is seen, counted from ξ."""
    at_point = jnp.stack([dot(row, point) for row in scalars.rows])
    return scalars._replace(values=jnp.where(scalars.seen, scalars.values - at_point, 0))


def guided_start(
    initial: NormalStep, scalars: Scalars, point: Float[Array, " d"], h: Information
) -> GuidedLaw:
    """The law of x_0, given what is seen at t_0 and h_0."""
    step = NormalStep(initial.mean - point, initial.root)
    eps, size = jnp.finfo(point.dtype).eps, jnp.abs(initial.mean) + jnp.abs(point)
    of_rows = jnp.stack([dot(jnp.abs(row), size) for row in scalars.rows])
    step, log_seen, seen = given(step, scalars, 100 * eps * (of_rows + jnp.abs(scalars.values)))
    bent = tilted(step, h)
    return GuidedLaw(point, bent, log_seen + bent.log_integral, seen)


def guided_step(
    density: AbstractStepDensity,
    dynamics_at: DynamicsAt,
    x: Float[Array, " d"],
    guide: Guide,
    scalars: Scalars | None,
) -> GuidedLaw:
    """The law of the step from x; `scalars` are seen at its end, counted from ξ_{i+1}."""
    return guided_law(target_law(density, dynamics_at, x, guide.step), x, guide, scalars)


def target_law(
    density: AbstractStepDensity, dynamics_at: DynamicsAt, x: Float[Array, " d"], step: Steps
) -> StepLaw | DegenerateLaw:
    """The law of the target's step from x."""
    return density.steps_from(dynamics_at(step.time), x).law(step.dt)


def guided_law(
    law: StepLaw | DegenerateLaw, x: Float[Array, " d"], guide: Guide, scalars: Scalars | None
) -> GuidedLaw:
    """The same, given the law of the target's step."""
    step = NormalStep(law.mean - guide.next_point, law.root)
    log_seen, seen = jnp.zeros((), x.dtype), []
    if scalars is not None:
        step, log_seen, seen = given(step, scalars)
    bent = tilted(step, guide.next_h)
    log_weight = log_seen + bent.log_integral - guide.h.log(x - guide.point)
    return GuidedLaw(guide.next_point, bent, log_weight, seen)
