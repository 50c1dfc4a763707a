"""The diffusion associated with a bridge, and whether it hits the bridge (sections 2.2 and 2.3).

The noise of a given bridge Z drives its associated diffusion Y. The coupling is the same, read in
the other direction: Z takes the place of X' in equation (stjerne-dif),

    dY = α(Y) dt + σ(Y) Oᵀ [{I - (1-γ)Π} dW̃ + √(1-γ²) u dU'].

Here W̃ is the noise of Z, and u, Π and O are those of the pair (Y, Z). The meeting rule of proposed
pairs also decides whether Y hits Z. A hit may occur in any step, also in the first.
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
    """Result of one associated diffusion in each lane.

    - `hit`: whether it hit the bridge.
    - `start`: its initial state.
    - `finite`: false if it became non-finite (NaN, infinite or beyond 1e18) before a hit.
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
    """Simulate one associated diffusion for the bridge in each lane.

    The random numbers of a lane depend on the key of that lane only. The simulation ends early once
    all lanes have hit.
    """
    num_steps, like = len(path) - 1, path[0, :, 0]
    forward = driven_through_root(coupling, model.forward(like), like)
    start_keys, path_keys, coupling_keys = split_each(keys, 3)
    lanes, axes = in_lanes(coupling, forward, like, coupling_keys, dt)
    law, scheme = lanes.coupling.start_law, lanes.coupling.scheme
    # Without a sampler of ν the start is the end of a run, which begins at the end point b.
    start = draw_starts(law, model, scheme, start_keys, path[-1], dt, num_steps)

    @over_lanes(-1, -1, -1, -1, -1, axes)
    def step_associated(y, hit, z, z_next, noise, lane):
        # The noise of Z, recovered from its step: only paths are stored, not their noise.
        dw = lane.scheme.noise(forward, z, z_next, lane.dt)
        pair = drive_back(forward, lane, y, z, z_next, dw, noise)
        # A hit stays a hit. The path continues, because other lanes may need more steps.
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
    # A non-finite path stays so, hence the last state shows it. After a hit the path is irrelevant.
    finite = jnp.all(is_finite(y_end), axis=0) | hit
    return Associated(hit, start, finite)
