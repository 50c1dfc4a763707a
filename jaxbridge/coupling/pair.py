"""One step of a coupled pair, in either direction (equations (simW') and (stjerne-dif)),

    X drives X',  ΔW' = driven_noise(O ΔW);    X' drives X,  ΔW = Oᵀ driving_noise(ΔW'),

both maps the coupling's, in the frame in which the pair lies when the noise of the step sets in.
Then the meeting rule is asked. A proposed bridge is made in the one direction (`join`), its
associated diffusion in the other (`associated`).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from ..engine.checks import cast_floats
from ..engine.linalg import all_finite
from ..engine.noise import normals_and_uniforms
from ..models import decisions
from ..models.dynamics import Dynamics
from ..schemes import AbstractScheme, Frame, fitted_in_lanes, frame
from .base import AbstractCoupling
from .meeting import PairStep
from .rotation import rotate, rotate_back, rotation_between


class Lane(NamedTuple):
    """What a pair is stepped with: its own coupling, and the scheme fitted to its steps."""

    coupling: AbstractCoupling
    scheme: AbstractScheme
    dt: Float[Array, ""]
    root_dt: Float[Array, ""]


class PairNoise(NamedTuple):
    """Random numbers of a step beyond the noise of the path that drives: N(0, 1) for dU and U(0, 1)
    for the meeting rule, each only where it is called for."""

    normal: Float[Array, "*steps"] | None
    uniform: Float[Array, "*steps"] | None


def in_lanes(
    coupling: AbstractCoupling,
    dynamics: Dynamics,
    like: Float[Array, " d"],
    keys: Key[Array, " lanes"],
    dt: Float[Array, " lanes"],
) -> tuple[Lane, Lane]:
    """All lanes, in the precision of the point, and the axes of lanes in them."""
    coupling = cast_floats(coupling, like.dtype)
    realised = coupling.realise(keys)
    axes = jax.tree.map(lambda old, new: None if old is new else -1, coupling, realised)
    scheme = fitted_in_lanes(coupling.scheme, dynamics, like, dt)
    return Lane(realised, scheme, dt, jnp.sqrt(dt)), Lane._make((axes, -1, -1, -1))


def pair_noise(coupling: AbstractCoupling, dtype) -> Callable[[Key[Array, ""], int], PairNoise]:
    """`PairNoise` of k steps of a lane."""
    own = decisions.independent_noise(coupling.independent_noise).simulated
    crossing = decisions.crossing_uniforms(coupling.meeting.draws_uniform).simulated

    def draw(key, k):
        normals, uniforms = normals_and_uniforms(key, own, crossing, k, dtype)
        return PairNoise(normals[0] if own else None, uniforms[0] if crossing else None)

    return draw


def relative_frame(
    coupling: AbstractCoupling,
    scheme: AbstractScheme,
    dynamics: Dynamics,
    x: Float[Array, " d"],
    driven: Float[Array, " d"],
    dt: Float[Array, ""],
) -> Frame:
    """How the pair lies at the beginning of a step, as the meeting rule wants it; `scheme` is the
    coupling's, fitted to the step."""
    if coupling.meeting.looks_ahead:
        return scheme.frame(dynamics, x, driven, dt)
    return frame(dynamics.sigma(driven), x, driven)


def drive(
    dynamics: Dynamics,
    lane: Lane,
    x: Float[Array, " d"],
    x_next: Float[Array, " d"],
    dw: Float[Array, " d"],
    driven: Float[Array, " d"],
    noise: PairNoise,
) -> PairStep:
    """The step in which X, going to `x_next` by the noise `dw`, drives X'."""
    seen, turn, du = _geometry(dynamics, lane, x, driven, noise)
    driven_dw = lane.coupling.driven_noise(seen, rotate(turn, dw), du)
    driven_next = lane.scheme.step(dynamics, driven, lane.dt, driven_dw)
    return _pair_step(lane, seen, x, x_next, driven, driven_next)


def drive_back(
    dynamics: Dynamics,
    lane: Lane,
    x: Float[Array, " d"],
    driven: Float[Array, " d"],
    driven_next: Float[Array, " d"],
    driven_dw: Float[Array, " d"],
    noise: PairNoise,
) -> PairStep:
    """The step in which X', going to `driven_next` by the noise `driven_dw`, drives X."""
    seen, turn, du = _geometry(dynamics, lane, x, driven, noise)
    dw = rotate_back(turn, lane.coupling.driving_noise(seen, driven_dw, du))
    x_next = lane.scheme.step(dynamics, x, lane.dt, dw)
    return _pair_step(lane, seen, x, x_next, driven, driven_next)


def have_met(
    dynamics: Dynamics, coupling: AbstractCoupling, step: PairStep, noise: PairNoise
) -> Bool[Array, ""]:
    """Whether the pair met in this step, by the coupling's rule, in finite numbers."""
    met = coupling.meeting.met(step, dynamics, noise.uniform)
    return met & all_finite(step.x_next) & all_finite(step.driven_next)


def _geometry(dynamics, lane, x, driven, noise):
    """The frame of the pair, its rotation, and the increment dU."""
    seen = relative_frame(lane.coupling, lane.scheme, dynamics, x, driven, lane.dt)
    turn = rotation_between(lane.coupling, dynamics.sigma(x), dynamics.sigma(driven))
    return seen, turn, None if noise.normal is None else lane.root_dt * noise.normal


def _pair_step(lane, seen, x, x_next, driven, driven_next) -> PairStep:
    variance = lane.coupling.gap_variance(seen)
    return PairStep(seen, x, x_next, driven, driven_next, lane.dt, variance)
