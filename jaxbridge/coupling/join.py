"""Proposed bridges: a pair of coupled paths, joined where they meet (section 2.2).

For each lane: simulate the time-reversed diffusion from the end point, which read forwards is
X with X_T = b; recover the noise that drives it forwards, equation (Wrev); drive X' from the
start point with the coupled noise, equations (simY') and (simW'); and join,

    Z_i = X'_i for i < ρ,   Z_i = X_i for i ≥ ρ,

equation (bridgesim), where ρ - 1 is the first step in which the two meet.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.keys import split_each
from ..engine.lanes import over_lanes
from ..engine.linalg import is_finite
from ..engine.noise import Store, noisy_scan
from ..models import decisions
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from ..models.dynamics import Dynamics
from ..schemes import AbstractScheme, steps_in_lanes
from .base import AbstractCoupling
from .pair import Lane, drive, have_met, in_lanes, pair_noise
from .rotation import driven_through_root


class Inputs(NamedTuple):
    """Everything a path may be differentiated with respect to."""

    model: Diffusion
    coupling: AbstractCoupling
    intervals: Intervals


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
    inputs: Inputs,
    keys: Key[Array, " lanes"],
    num_steps: int,
    stored: Int[Array, " K"] | None = None,
    meeting_step: Int[Array, " lanes"] | None = None,
) -> Proposals:
    """One proposal in each lane, whose random numbers depend on the lane's key alone.

    The intervals of `inputs` have lanes in the last axis. `stored` are the steps among 0, ..., N
    at which the joined path is kept, by default all.
    With `meeting_step` the pair is joined there, not where the coupling's rule says: a replay.
    """
    model, coupling, (start, end, duration) = inputs
    like, dt = start[:, 0], duration / num_steps
    reverse_keys, driven_keys, coupling_keys = split_each(keys, 3)
    backward = model.backward(like)
    forward = driven_through_root(coupling, model.forward(like), like)
    x_start, x_path = reverse_path(backward, coupling.scheme, reverse_keys, end, dt, num_steps)
    pairs = in_lanes(coupling, forward, like, coupling_keys, dt)
    # A whole path is written next to its start; but not by a replay, which is there to be
    # differentiated, and a store is slow in reverse mode.
    replayed, num_stored = meeting_step is not None, None if stored is None else len(stored)
    if decisions.stored_times(num_stored).simulated and not replayed:
        stored = jnp.arange(num_steps + 1)
    store = None if stored is None else _store(stored, start, num_steps)
    z_end, rho, z_path = _driven_path(
        forward, pairs, driven_keys, start, x_start, x_path, store, meeting_step
    )
    z_path = jnp.concatenate([start[None], z_path]) if store is None else z_path[:-1]
    # What has exploded does not come back, so the last states tell.
    finite = jnp.all(is_finite(x_start) & is_finite(z_end), axis=0) | (rho <= num_steps)
    return Proposals(z_path, x_start, rho, finite)


def reverse_path(
    backward: Dynamics,
    scheme: AbstractScheme,
    keys: Key[Array, " lanes"],
    end: Float[Array, "d lanes"],
    dt: Float[Array, " lanes"],
    num_steps: int,
) -> tuple[Float[Array, "d lanes"], Float[Array, "N d lanes"]]:
    """The reversed path X_N = b, ..., X_0: the last, and the others as X_1, ..., X_N."""
    step = steps_in_lanes(scheme, backward, end[:, 0], dt)
    return noisy_scan(
        lambda x, inputs: (step(x, inputs[0]), x),
        end,
        keys,
        lambda key, k: jax.random.normal(key, (k, end.shape[0]), end.dtype),
        None,
        num_steps,
        reverse=True,
    )


def _driven_path(
    forward: Dynamics,
    pairs: tuple[Lane, Lane],
    keys: Key[Array, " lanes"],
    start: Float[Array, "d lanes"],
    x_start: Float[Array, "d lanes"],
    x_path: Float[Array, "N d lanes"],
    store: Store | None,
    meeting_step: Int[Array, " lanes"] | None,
) -> tuple[Float[Array, "d lanes"], Int[Array, " lanes"], Float[Array, "rows d lanes"]]:
    """X' until the pair meets and X from then on: its end, ρ, and the path after the start."""
    lanes, axes = pairs
    num_steps, replayed = len(x_path), meeting_step is not None

    @over_lanes(-1, -1, -1, -1, -1, None, axes)
    def step_joined(x, z, rho, x_next, noise, i, lane):
        dw = lane.scheme.noise(forward, x, x_next, lane.dt)
        pair = drive(forward, lane, x, x_next, dw, z, noise)
        if not replayed:
            # The first meeting: a minimum over the steps, masked by whether they saw one.
            met = have_met(forward, lane.coupling, pair, noise)
            rho = jnp.where(met, jnp.minimum(rho, i + 1), rho)
        return jnp.where(i + 1 >= rho, x_next, pair.driven_next), rho

    def step(carry, inputs):
        x, z, rho = carry
        noise, (i, x_next) = inputs
        z, rho = step_joined(x, z, rho, x_next, noise, i, lanes)
        return (x_next, z, rho), z

    never = jnp.full(lanes.dt.shape, num_steps + 1, jnp.int32)
    (_, z_end, rho), z_path = noisy_scan(
        step,
        (x_start, start, meeting_step if replayed else never),
        keys,
        pair_noise(lanes.coupling, start.dtype),
        (jnp.arange(num_steps, dtype=jnp.int32), x_path),
        num_steps,
        store=store,
    )
    return z_end, rho, z_path


def _store(stored: Int[Array, " K"], start: Float[Array, "d lanes"], num_steps: int) -> Store:
    """Rows for the stored steps; all begin as the start, which is what step 0 keeps."""
    rows = jnp.broadcast_to(start, (stored.shape[0] + 1, *start.shape))
    slots = jnp.full(num_steps + 1, stored.shape[0]).at[stored].set(jnp.arange(stored.shape[0]))
    return Store(slots[1:], rows)
