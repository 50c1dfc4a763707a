"""The diffusion associated with a bridge: does it hit? (sections 2.2 and 2.3)

Given a bridge Z, its associated diffusion Y is driven by the noise of Z through the same
coupling read in the other direction, equation (stjerne-dif),

    dY = α(Y) dt + σ(Y) Oᵀ [{I - (1-γ)Π} dW̃ + √(1-γ²) u dU'],    Z in the place of X',

where W̃ drives Z, and u, Π and O are those of the pair (Y, Z). It hits Z where the two would
have met as a proposed pair: index 0 counts, and the rule is the coupling's own.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from ..engine.keys import split_each
from ..engine.lanes import over_lanes
from ..engine.linalg import is_finite
from ..engine.noise import noisy_scan_until
from ..models.diffusion import Diffusion
from .base import AbstractCoupling
from .pair import drive_back, have_met, in_lanes, pair_noise
from .rotation import driven_through_root
from .start_laws import draw_starts


class Associated(NamedTuple):
    """One path of the associated diffusion in each lane.

    `hit` says whether it hit the bridge, `start` is where it started, and `finite` is false
    where it left the finite numbers before it hit.
    """

    hit: Bool[Array, " lanes"]
    start: Float[Array, "d lanes"]
    finite: Bool[Array, " lanes"]


def run_associated(
    model: Diffusion,
    coupling: AbstractCoupling,
    keys: Key[Array, " lanes"],
    path: Float[Array, "points d lanes"],
    dt: Float[Array, " lanes"],
) -> Associated:
    """One path associated with the bridge in each lane, whose random numbers depend on the
    lane's key alone. Simulation ends when all lanes have hit."""
    num_steps, like = len(path) - 1, path[0, :, 0]
    forward = driven_through_root(coupling, model.forward(like), like)
    start_keys, path_keys, coupling_keys = split_each(keys, 3)
    lanes, axes = in_lanes(coupling, forward, like, coupling_keys, dt)
    law, scheme = lanes.coupling.start_law, lanes.coupling.scheme
    start = draw_starts(law, model, scheme, start_keys, path[-1], dt, num_steps)

    @over_lanes(-1, -1, -1, -1, -1, axes)
    def step_associated(y, hit, z, z_next, noise, lane):
        dw = lane.scheme.noise(forward, z, z_next, lane.dt)
        pair = drive_back(forward, lane, y, z, z_next, dw, noise)
        return pair.x_next, hit | have_met(forward, lane.coupling, pair, noise)

    def step(carry, inputs):
        noise, (z, z_next) = inputs
        return step_associated(*carry, z, z_next, noise, lanes), None

    y_end, hit = noisy_scan_until(
        lambda carry: carry[1],
        step,
        (start, jnp.zeros(dt.shape, bool)),
        path_keys,
        pair_noise(coupling, path.dtype),
        (path[:-1], path[1:]),
        num_steps,
    )
    finite = jnp.all(is_finite(y_end), axis=0) | hit
    return Associated(hit, start, finite)
