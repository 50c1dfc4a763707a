"""Proposed bridges: a pair of coupled paths, joined where they meet (section 2.2).

Each lane makes one proposal in four steps:

1. Simulate the time-reversed diffusion from the end point. Read forwards it is X with X_T = b.

2. Recover the noise that drives X forwards, equation (Wrev).

3. Drive X' from the start point by the coupled noise, equations (simY') and (simW').

4. Join the two paths, equation (bridgesim):

    Z_i = X'_i for i < ρ,   Z_i = X_i for i ≥ ρ,

where ρ - 1 is the index of the first step in which the two meet.
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
    """Arguments of proposals with respect to which a path has derivatives."""

    model: Diffusion
    coupling: AbstractCoupling
    intervals: Intervals


class Proposals(NamedTuple):
    """Proposed bridges, with lanes in the last axis.

    - `paths`: the joined paths at the K stored grid points.
    - `reverse_start`: X_0, the value of the reversed path at time 0.
    - `meeting_step`: ρ, between 1 and N, or N + 1 if the pair does not meet.
    - `finite`: false if one of the two paths became non-finite before the pair met.
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
    """Propose one bridge in each lane.

    The random numbers of a lane depend on the key of that lane only. The intervals of `inputs` have
    lanes in the last axis. `stored` are the indices, among 0, ..., N, of the grid points to store;
    by default all are stored. With `meeting_step` the function replays proposals: it joins each
    pair at that step, and ignores the meeting rule.
    """
    model, coupling, (start, end, duration) = inputs
    like, dt = start[:, 0], duration / num_steps
    # X, X' and a random γ have independent keys.
    reverse_keys, driven_keys, coupling_keys = split_each(keys, 3)
    backward = model.backward(like)
    # Only the pair uses the triangular root. Any root of V gives the reversed path its law.
    forward = driven_through_root(coupling, model.forward(like), like)
    x_start, x_path = reverse_path(backward, coupling.scheme, reverse_keys, end, dt, num_steps)
    pairs = in_lanes(coupling, forward, like, coupling_keys, dt)
    # A store with room for the start avoids a copy of the whole path. A replay serves derivatives
    # and does without: a store is slow in reverse mode.
    replayed, num_stored = meeting_step is not None, None if stored is None else len(stored)
    if decisions.stored_times(num_stored).simulated and not replayed:
        stored = jnp.arange(num_steps + 1)
    store = None if stored is None else _store(stored, start, num_steps)
    z_end, rho, z_path = _driven_path(
        forward, pairs, driven_keys, start, x_start, x_path, store, meeting_step
    )
    z_path = jnp.concatenate([start[None], z_path]) if store is None else z_path[:-1]
    # A non-finite path stays so, hence the last states show it.
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
    """Simulate X_N = b, ..., X_0 backwards in time. Return X_0, and X_1, ..., X_N as one array."""
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
    """Simulate the joined path: X' until the pair meets, and X from then on.

    Return its end, ρ, and the path after the start.
    """
    lanes, axes = pairs
    num_steps, replayed = len(x_path), meeting_step is not None

    @over_lanes(-1, -1, -1, -1, -1, None, axes)
    def step_joined(x, z, rho, x_next, noise, i, lane):
        # The forward noise of X, recovered from its path: equation (Wrev).
        dw = lane.scheme.noise(forward, x, x_next, lane.dt)
        pair = drive(forward, lane, x, x_next, dw, z, noise)
        if not replayed:
            # The minimum over all steps with a meeting is the first one.
            met = have_met(forward, lane.coupling, pair, noise)
            rho = jnp.where(met, jnp.minimum(rho, i + 1), rho)
        # After the meeting Z follows X.
        return jnp.where(i + 1 >= rho, x_next, pair.driven_next), rho

    def step(carry, inputs):
        x, z, rho = carry
        noise, (i, x_next) = inputs
        z, rho = step_joined(x, z, rho, x_next, noise, i, lanes)
        return (x_next, z, rho), z

    # N + 1 stands for no meeting.
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
    """Return the store for the stored steps. Its rows begin as the start, the state at step 0."""
    rows = jnp.broadcast_to(start, (stored.shape[0] + 1, *start.shape))
    # Steps that are not stored write to the last row, which is discarded.
    slots = jnp.full(num_steps + 1, stored.shape[0]).at[stored].set(jnp.arange(stored.shape[0]))
    return Store(slots[1:], rows)
