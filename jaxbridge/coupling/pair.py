"""Proposed bridges: a pair of coupled paths, joined where they meet (section 2.2).

For each lane: simulate the time-reversed diffusion from the end point, which read forwards is
X with X_T = b; recover the noise that drives it forwards, equation (Wrev); drive X' from the
start point with the coupled noise, equations (simY') and (simW'); and join,

    Z_i = X'_i for i < ρ,   Z_i = X_i for i ≥ ρ,

equation (bridgesim), where ρ - 1 is the first step in which the two meet.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.checks import cast_floats
from ..engine.lanes import over_lanes
from ..engine.linalg import all_finite, is_finite
from ..engine.noise import Store, noisy_scan
from ..models import decisions
from ..models.diffusion import Diffusion
from ..schemes.base import fitted_in_lanes
from .base import AbstractCoupling, see
from .meeting import PairStep
from .rotation import rotate, rotation_between


class Proposals(NamedTuple):
    """Joined paths, lanes in the last axis.

    `paths` are kept at the K stored steps. `reverse_start` is X_0, the value of the reversed
    path at time 0. `meeting_step` is ρ, between 1 and N, or N + 1 where the pair did not meet;
    `finite` is false where one of the two paths left the finite numbers before the pair met.
    """

    paths: Float[Array, "K d lanes"]
    reverse_start: Float[Array, "d lanes"]
    meeting_step: Int[Array, " lanes"]
    finite: Bool[Array, " lanes"]


def propose(
    model: Diffusion,
    coupling: AbstractCoupling,
    keys: Key[Array, " lanes"],
    start: Float[Array, "d lanes"],
    end: Float[Array, "d lanes"],
    dt: Float[Array, " lanes"],
    num_steps: int,
    stored: Int[Array, " K"] | None = None,
    meeting_step: Int[Array, " lanes"] | None = None,
) -> Proposals:
    """One proposal in each lane, whose random numbers depend on the lane's key alone.

    `stored` are the steps among 0, ..., N at which the joined path is kept, by default all.
    With `meeting_step` the pair is joined there, not where the coupling's rule says: a replay.
    """
    forward, backward = model.forward(start[:, 0]), model.backward(start[:, 0])
    rule, replayed = coupling.meeting, meeting_step is not None
    forward_scheme = fitted_in_lanes(coupling.scheme, forward, start[:, 0], dt)
    backward_scheme = fitted_in_lanes(coupling.scheme, backward, start[:, 0], dt)
    (d, _), dtype = start.shape, start.dtype
    split_keys = jax.vmap(lambda key: jax.random.split(key, 3), out_axes=1)(keys)
    reverse_keys, driven_keys, coupling_keys = split_keys
    coupling, coupling_axes = realise(coupling, coupling_keys, dtype)
    root_dt = jnp.sqrt(dt)

    # The reversed path: X_N = b, ..., X_0, kept in forward order as X_1, ..., X_N.
    @over_lanes(-1, -1, -1, -1, -1)
    def step_back(x, dw, dt, root_dt, scheme):
        return scheme.step(backward, x, dt, root_dt * dw)

    x_start, x_path = noisy_scan(
        lambda x, inputs: (step_back(x, inputs[0], dt, root_dt, backward_scheme), x),
        end,
        reverse_keys,
        lambda key, k: jax.random.normal(key, (k, d), dtype),
        None,
        num_steps,
        reverse=True,
    )

    # The joined path Z: X' until the pair meets, X from then on.
    @over_lanes(-1, -1, -1, -1, -1, -1, None, coupling_axes)
    def step_joined(x, z, rho, x_next, noise, lane, i, coupling):
        dt, root_dt, fixed_rho, scheme = lane
        normal, uniform = noise
        sigma, driven_sigma = forward.sigma(x), forward.sigma(z)
        seen = see(coupling, scheme, forward, x, z, dt)
        du = None if normal is None else root_dt * normal
        dw = scheme.noise(forward, x, x_next, dt)
        dw = rotate(rotation_between(coupling, sigma, driven_sigma), dw)
        driven_next = scheme.step(forward, z, dt, coupling.driven_noise(seen, dw, du))
        if fixed_rho is None:
            variance = coupling.gap_variance(seen)
            pair = PairStep(seen, x, x_next, z, driven_next, dt, variance)
            met = rule.met(pair, forward, uniform)
            met &= all_finite(driven_next) & all_finite(x_next)
            # The first meeting: a minimum over the steps, masked by whether they saw one.
            rho = jnp.where(met, jnp.minimum(rho, i + 1), rho)
        return jnp.where(i + 1 >= rho, x_next, driven_next), rho

    def step(carry, inputs):
        x, z, rho = carry
        noise, (i, x_next) = inputs
        lane = (dt, root_dt, meeting_step, forward_scheme)
        z, rho = step_joined(x, z, rho, x_next, noise, lane, i, coupling)
        return (x_next, z, rho), z

    # A whole path is written next to its start; but not by a replay, which is there to be
    # differentiated, and a store is slow in reverse mode.
    num_stored = None if stored is None else stored.shape[0]
    if decisions.stored_times(num_stored).simulated and not replayed:
        stored = jnp.arange(num_steps + 1)
    never = jnp.full(dt.shape, num_steps + 1, jnp.int32)
    rho = never if meeting_step is None else meeting_step
    (_, z_end, rho), z_path = noisy_scan(
        step,
        (x_start, start, rho),
        driven_keys,
        pair_noise(coupling, dtype, replayed),
        (jnp.arange(num_steps, dtype=jnp.int32), x_path),
        num_steps,
        store=None if stored is None else _store(stored, start, num_steps),
    )
    if stored is None:
        z_path = jnp.concatenate([start[None], z_path])
    else:
        z_path = z_path[:-1]
    # What has exploded does not come back, so the last states tell.
    finite = jnp.all(is_finite(x_start) & is_finite(z_end), axis=0) | (rho <= num_steps)
    return Proposals(z_path, x_start, rho, finite)


def pair_noise(coupling: AbstractCoupling, dtype, replayed: bool = False) -> Callable:
    """A lane's random numbers of k steps beyond the noise of the path that drives: N(0, 1)
    for dU and U(0, 1) for the meeting rule, each only where it is called for."""
    own = decisions.independent_noise(coupling.independent_noise)
    crossing = decisions.crossing_uniforms(coupling.meeting.draws_uniform, replayed)

    def draw(key, k):
        normal_key, uniform_key = jax.random.split(key)
        normal = uniform = None
        if own.simulated:
            normal = jax.random.normal(normal_key, (k,), dtype)
        if crossing.simulated:
            uniform = jax.random.uniform(uniform_key, (k,), dtype)
        return normal, uniform

    return draw


def realise(coupling: AbstractCoupling, keys: Key[Array, " lanes"], dtype):
    """Each lane's coupling, and the axes of lanes in its leaves."""
    coupling = cast_floats(coupling, dtype)
    realised = coupling.realise(keys)
    axes = jax.tree.map(lambda old, new: None if old is new else -1, coupling, realised)
    return realised, axes


def _store(stored: Int[Array, " K"], start: Float[Array, "d lanes"], num_steps: int) -> Store:
    """Rows for the stored steps; all begin as the start, which is what step 0 keeps."""
    rows = jnp.broadcast_to(start, (stored.shape[0] + 1, *start.shape))
    slots = jnp.full(num_steps + 1, stored.shape[0]).at[stored].set(jnp.arange(stored.shape[0]))
    return Store(slots[1:], rows)
