"""The diffusion associated with a bridge: does it hit? (sections 2.2 and 2.3)

Given a bridge Z, its associated diffusion Y is driven by the noise of Z through the same
coupling read in the other direction, equation (stjerne-dif),

    dY = α(Y) dt + σ(Y) Oᵀ [{I - (1-γ)Π} dW̃ + √(1-γ²) u dU'],    Z in the place of X',

where W̃ drives Z, and u, Π and O are those of the pair (Y, Z). It hits Z where the two would
have met as a proposed pair: index 0 counts, and the rule is the coupling's own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from ..engine.lanes import over_lanes
from ..engine.linalg import all_finite, is_finite
from ..engine.noise import noisy_scan
from ..models.diffusion import Diffusion
from ..schemes.base import fitted_in_lanes
from .base import AbstractCoupling, see
from .meeting import PairStep
from .pair import pair_noise, realise
from .rotation import rotate_back, rotation_between
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
    num_steps, dtype = path.shape[0] - 1, path.dtype
    forward = model.forward(path[0, :, 0])
    rule = coupling.meeting
    split_keys = jax.vmap(lambda key: jax.random.split(key, 3), out_axes=1)(keys)
    start_keys, path_keys, coupling_keys = split_keys
    coupling, coupling_axes = realise(coupling, coupling_keys, dtype)
    start = draw_starts(
        coupling.start_law, model, coupling.scheme, start_keys, path[-1], dt, num_steps
    )
    scheme = fitted_in_lanes(coupling.scheme, forward, path[0, :, 0], dt)
    root_dt = jnp.sqrt(dt)

    @over_lanes(-1, -1, -1, -1, -1, -1, coupling_axes)
    def step_associated(y, hit, z, z_next, noise, lane, coupling):
        dt, root_dt, scheme = lane
        normal, uniform = noise
        sigma, driven_sigma = forward.sigma(y), forward.sigma(z)
        seen = see(coupling, scheme, forward, y, z, dt)
        du = None if normal is None else root_dt * normal
        dw = coupling.driving_noise(seen, scheme.noise(forward, z, z_next, dt), du)
        dw = rotate_back(rotation_between(coupling, sigma, driven_sigma), dw)
        y_next = scheme.step(forward, y, dt, dw)
        pair = PairStep(seen, y, y_next, z, z_next, dt, coupling.gap_variance(seen))
        return y_next, hit | (rule.met(pair, forward, uniform) & all_finite(y_next))

    def step(carry, inputs):
        y, hit = carry
        noise, (z, z_next) = inputs
        return step_associated(y, hit, z, z_next, noise, (dt, root_dt, scheme), coupling), None

    (y_end, hit), _ = noisy_scan(
        step,
        (start, jnp.zeros(dt.shape, bool)),
        path_keys,
        pair_noise(coupling, dtype),
        (path[:-1], path[1:]),
        num_steps,
        over=lambda carry: carry[1],
    )
    finite = jnp.all(is_finite(y_end), axis=0) | hit
    return Associated(hit, start, finite)
