"""One step of a coupled pair, in either direction (equations (simW') and (stjerne-dif)).

    X drives X':  ΔW' = driven_noise(O ΔW);    X' drives X:  ΔW = Oᵀ driving_noise(ΔW').

Both maps belong to the coupling. They use the frame of the pair at the moment when the noise of the
step begins to act. After the step the meeting rule decides whether the pair met.

Proposed bridges use the first direction (`join`), associated diffusions the second (`associated`).
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
    """Settings for the steps of one pair: its own coupling, and the scheme fitted to its step
    size."""

    coupling: AbstractCoupling
    scheme: AbstractScheme
    dt: Float[Array, ""]
    root_dt: Float[Array, ""]


class PairNoise(NamedTuple):
    """Random numbers of a step besides the noise of the driving path.

    - `normal`: N(0, 1) for dU, or `None` if the coupling needs none.
    - `uniform`: U(0, 1) for the meeting rule, or `None` if the rule needs none.
    """

    normal: Float[Array, "*steps"] | None
    uniform: Float[Array, "*steps"] | None


def in_lanes(
    coupling: AbstractCoupling,
    dynamics: Dynamics,
    like: Float[Array, " d"],
    keys: Key[Array, " lanes"],
    dt: Float[Array, " lanes"],
) -> tuple[Lane, Lane]:
    """Return the settings of all lanes, and their `vmap` axes.

    Floating point arrays of the coupling get the dtype of `like`.
    """
    coupling = cast_floats(coupling, like.dtype)
    realised = coupling.realise(keys)
    # Only arrays that `realise` replaced have an axis of lanes.
    axes = jax.tree.map(lambda old, new: None if old is new else -1, coupling, realised)
    scheme = fitted_in_lanes(coupling.scheme, dynamics, like, dt)
    return Lane(realised, scheme, dt, jnp.sqrt(dt)), Lane._make((axes, -1, -1, -1))


def pair_noise(coupling: AbstractCoupling, dtype) -> Callable[[Key[Array, ""], int], PairNoise]:
    """Return a function that samples the `PairNoise` of k steps of a lane from a key."""
    needs_normals = decisions.independent_noise(coupling.independent_noise).simulated
    needs_uniforms = decisions.crossing_uniforms(coupling.meeting.draws_uniform).simulated

    def draw(key, k):
        normals, uniforms = normals_and_uniforms(key, needs_normals, needs_uniforms, k, dtype)
        return PairNoise(
            normals[0] if needs_normals else None, uniforms[0] if needs_uniforms else None
        )

    return draw


def relative_frame(
    coupling: AbstractCoupling,
    scheme: AbstractScheme,
    dynamics: Dynamics,
    x: Float[Array, " d"],
    driven: Float[Array, " d"],
    dt: Float[Array, ""],
) -> Frame:
    """Return the relative position of `x` and `driven`, the states of X and X', as a `Frame`.

    If the meeting rule `looks_ahead`, this is the position after the drift of the step, otherwise
    that at the beginning of the step. `scheme` is the coupling's scheme, fitted to the step size.
    """
    # The rule decides: the gap after the drift of the step, or the gap before it as in the paper.
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
    """Return the step in which X drives X'. X moves to `x_next` by the noise `dw`."""
    pair_frame, rotation, du = _geometry(dynamics, lane, x, driven, noise)
    # O rotates the noise of X before the coupling, and Oᵀ after it in the other direction.
    driven_dw = lane.coupling.driven_noise(pair_frame, rotate(rotation, dw), du)
    driven_next = lane.scheme.step(dynamics, driven, lane.dt, driven_dw)
    return _pair_step(lane, pair_frame, x, x_next, driven, driven_next)


def drive_back(
    dynamics: Dynamics,
    lane: Lane,
    x: Float[Array, " d"],
    driven: Float[Array, " d"],
    driven_next: Float[Array, " d"],
    driven_dw: Float[Array, " d"],
    noise: PairNoise,
) -> PairStep:
    """Return the step in which X' drives X. X' moves to `driven_next` by the noise `driven_dw`."""
    pair_frame, rotation, du = _geometry(dynamics, lane, x, driven, noise)
    dw = rotate_back(rotation, lane.coupling.driving_noise(pair_frame, driven_dw, du))
    x_next = lane.scheme.step(dynamics, x, lane.dt, dw)
    return _pair_step(lane, pair_frame, x, x_next, driven, driven_next)


def have_met(
    dynamics: Dynamics, coupling: AbstractCoupling, step: PairStep, noise: PairNoise
) -> Bool[Array, ""]:
    """Return whether the pair met in this step by the coupling's rule, with finite states."""
    # NaN compares as false, but an infinite state could pass as a meeting.
    met = coupling.meeting.met(step, dynamics, noise.uniform)
    return met & all_finite(step.x_next) & all_finite(step.driven_next)


def _geometry(dynamics, lane, x, driven, noise):
    """Return the frame of the pair, its rotation (or `None`), and the increment dU (or `None`)."""
    pair_frame = relative_frame(lane.coupling, lane.scheme, dynamics, x, driven, lane.dt)
    # Both directions call this function, so they share O and u.
    rotation = rotation_between(lane.coupling, dynamics.sigma(x), dynamics.sigma(driven))
    return pair_frame, rotation, None if noise.normal is None else lane.root_dt * noise.normal


def _pair_step(lane, pair_frame, x, x_next, driven, driven_next) -> PairStep:
    variance = lane.coupling.gap_variance(pair_frame)
    return PairStep(pair_frame, x, x_next, driven, driven_next, lane.dt, variance)
