"""Steps of a path that is guided through a record, and their inverse.

From x at the beginning of a step, the target's step N(μ(x), Λ Λᵀ) is conditioned on the observation
at its end and tilted by h_{i+1} (`tilted_step`). The weight is the density of the target's step
over that of the guided step. Let the noise ζ of the guided step and the noise z of the target's
step lead to the same point. Then

    w = p(y| x) N(z; 0, I) / (N(ζ; 0, I) det ℛ),    det ℛ ≥ 1,

with p(y| x) the density of the observation at the end of the step. Hence log w of a whole path is
at most ½|ζ|² plus the maximum log density of the observations. Rounding errors cannot exceed this
bound.

A target's step may be quadratic in its noise (`QuadraticDensity`). Its normal part leads to a knot
u, and the step to x' = u + O(δ). The noise is guided as above, and w is the same. The steps that
end at observations are their normal parts alone, x' = u. They are short (`Record.with_split_ends`),
so this adds only O(δ²) to the discretisation error.

For normal steps the weight also equals ∫ p(x'| x) g(y| x') h_{i+1}(x') dx' / h_i(x) times
h_i(x) / h_{i+1}(x'), whose product over a path telescopes. The code must not sum this form.
Explicit steps that are far too long for the drift (δ |∇drift| above 2) may lead to log h = -1e30.
Differences of such numbers have rounding errors of ±1e14, so a very unlikely path would get a
weight of e^{1e14}.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..engine.lanes import compute_once
from ..engine.linalg import dot
from ..schemes import DegenerateLaw, StepLaw
from .observations import Scalars
from .record import Steps
from .tilted_step import Information, NormalStep, Seen, Tilted, coordinates, given, tilted


class Guide(NamedTuple):
    """Guide of a step.

    - `point`, `h`: ξ_i and h_i, at the beginning.
    - `next_point`, `next_h`: ξ_{i+1} and h_{i+1}, at the end.
    - `step`: length and time of the step.
    """

    point: Float[Array, "d *lanes"]
    h: Information
    next_point: Float[Array, "d *lanes"]
    next_h: Information
    step: Steps


class GuidedLaw(NamedTuple):
    """Law of a guided step.

    - `origin`: ξ', from which points of `tilted` count.
    - `log_seen`: log density of the observation at its end, given its beginning.
    - `seen`: factors of the conditioning on that observation.
    """

    origin: Float[Array, " d"]
    tilted: Tilted
    log_seen: Float[Array, ""]
    seen: list[Seen]

    @property
    def log_integral(self) -> Float[Array, ""]:
        """Return log ∫ p(x'| x) g(y| x') h(x') dx', with h at the end of the step."""
        return self.log_seen + self.tilted.log_integral

    def point_and_log_weight(
        self, zeta: Float[Array, " m"]
    ) -> tuple[Float[Array, " d"], Float[Array, ""]]:
        """Return the knot to which the noise ζ ~ N(0, I) leads, and the log weight of the step."""
        # Without this, the compiler computes it twice, for the point and for the weight.
        pulled = compute_once(self.tilted.pulled(zeta))
        point = self.origin + self.tilted.point(pulled)
        return point, self.log_seen + self.tilted.log_ratio(zeta, pulled)

    def noise_and_log_weight(
        self,
        point: Float[Array, " d"],
        solve: Callable[[Float[Array, " d"]], Float[Array, " m"]],
        hidden: Float[Array, " n"],
    ) -> tuple[Float[Array, " m"], Float[Array, ""]]:
        """Return noise that leads to this knot, and the log weight of the step.

        `solve` is Λ⁻¹ of the step before conditioning; `hidden` is explained in `coordinates`.
        """
        displacement = solve(point - self.origin - self.tilted.step.mean)
        pulled = coordinates(displacement, self.seen, hidden[: len(self.seen)])
        zeta = self.tilted.noise(pulled)
        return zeta, self.log_seen + self.tilted.log_ratio(zeta, pulled)


def relative(scalars: Scalars, point: Float[Array, " d"]) -> Scalars:
    """Return the scalar observations relative to ξ."""
    at_point = jnp.stack([dot(row, point) for row in scalars.rows])
    return scalars._replace(values=jnp.where(scalars.seen, scalars.values - at_point, 0))


def guided_start(
    initial: NormalStep, scalars: Scalars, point: Float[Array, " d"], h: Information
) -> GuidedLaw:
    """Return the law of x_0, given the observation at t_0 and weighted by h_0.

    h_0 is the density of the later observations. States count from `point`.
    """
    step = NormalStep(initial.mean - point, initial.root)
    # An exact observation of a known x_0 must agree up to rounding.
    eps, size = jnp.finfo(point.dtype).eps, jnp.abs(initial.mean) + jnp.abs(point)
    of_rows = jnp.stack([dot(jnp.abs(row), size) for row in scalars.rows])
    step, log_seen, factors = given(step, scalars, 100 * eps * (of_rows + jnp.abs(scalars.values)))
    bent = tilted(step, h)
    return GuidedLaw(point, bent, log_seen, factors)


def guided_law(law: StepLaw | DegenerateLaw, guide: Guide, scalars: Scalars | None) -> GuidedLaw:
    """Return the law of the guided step, from the law of the target's step.

    `scalars` are the observations at its end, relative to ξ_{i+1}.
    """
    step = NormalStep(law.mean - guide.next_point, law.root)
    log_seen, factors = jnp.zeros((), law.mean.dtype), []
    if scalars is not None:
        step, log_seen, factors = given(step, scalars)
    return GuidedLaw(guide.next_point, tilted(step, guide.next_h), log_seen, factors)


def end_of_step(
    law: StepLaw | DegenerateLaw,
    knot: Float[Array, " d"],
    is_last: Bool[Array, ""] | bool = False,
) -> Float[Array, " d"]:
    """Return the end of the target's step whose normal part ends in the knot.

    It is the knot itself if the step is normal, as the last step of a segment is.
    """
    if isinstance(law, DegenerateLaw) or law.curvature is None or is_last is True:
        return knot
    return jnp.where(is_last, knot, law.bent(knot))
