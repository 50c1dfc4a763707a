"""Approximate bridges by rejection (section 2.2): propose until the pair meets.

Thousands of proposals run side by side, in lanes. Each round gives every lane to an interval
that still lacks bridges, more lanes to those that lack more or succeed less often. The
proposals of an interval are numbered, the random numbers of a proposal depend on its interval
and number only, and its j-th success is the interval's j-th bridge. So the result does not
depend on the number of lanes.
"""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from .arrays import Numbers, as_floating, is_traced
from .coupling import AbstractCoupling, Coupling
from .diffusion import Diffusion, check_diffusion
from .intervals import Intervals, as_intervals, check_count, check_model
from .proposals import Proposals, propose


class Bridges(NamedTuple):
    """What `sample_bridges` returns. With I intervals all but `times` have a leading axis I.

    - `times`: the K stored times, shape (K,), from 0 to the duration; (I, K) for I durations.
    - `paths`: the bridges, shape (n, K, d). A bridge that was not found is NaN throughout.
    - `met`: whether the bridge was found, shape (n,).
    - `meeting_step`: ρ, the first step at which the path follows the reversed path, between 1
        and N; -1 where no bridge was found. Shape (n,).
    - `num_proposals`: proposals made until the last bridge was found, or until the bound.
        `n / num_proposals` estimates the acceptance probability.
    - `num_nonfinite`: how many of them left the finite numbers and were rejected for it.
    """

    times: Float[Array, "*I K"]
    paths: Float[Array, "*I n K d"]
    met: Bool[Array, "*I n"]
    meeting_step: Int[Array, "*I n"]
    num_proposals: Int[Array, "*I"]
    num_nonfinite: Int[Array, "*I"]


def sample_bridges(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_bridges: int = 1,
    num_steps: int = 50,
    coupling: AbstractCoupling | None = None,
    max_proposals: Numbers | None = None,
    save_at: Numbers | None = None,
    batch_size: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = False,
) -> Bridges:
    """Independent approximate (start, end, duration)-bridges: section 2.2 of the paper.

    Their law is that of the diffusion bridge conditioned on being hit by its associated
    diffusion (Theorem 1), close to the bridge's own law for end points that are likely, and
    closer the longer the duration. The step size adds its own error.

    **Arguments:**

    - `key`: a typed key, `jax.random.key(...)`.
    - `model`: the diffusion; its time reversal must be known.
    - `start`, `end`: points, shape (d,), or (I, d) for I intervals at once. The widest
        floating point type of these and the duration is that of the paths.
    - `duration`: the length of the interval, in units of time, shape () or (I,).
    - `num_bridges`: n, how many bridges of each interval.
    - `num_steps`: N, so δ = duration / N. Compile time does not grow with it.
    - `coupling`: by default `Coupling(gamma=0.0)`.
    - `max_proposals`: bounds the proposals of each interval; by default 1,000 for each bridge
        and at least 100,000.
    - `save_at`: times in [0, duration] on the grid, increasing, shape (K,), at which paths are
        kept; with several durations, fractions of them. By default the whole grid.
    - `batch_size`: proposals simulated side by side; bounds memory, and changes results by
        rounding only. By default as many as fit in 64 MiB, and no more than are useful.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.
    - `throw`: raise an error at run time where a bridge was not found.

    **Returns:** `Bridges`.

    **Gradients** of the paths with respect to `params`, `start`, `end` and `duration`, forward
    and reverse, are those at fixed noise and fixed meeting step: accepted paths are replayed
    from their keys, all side by side, only when a derivative is asked for. They are *not*
    derivatives of expectations over bridges, for whether a pair meets depends on the parameters
    too.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit, as far as their
    values are visible before tracing.

    !!! example

        ```python
        model = jb.ornstein_uhlenbeck(jnp.array([[1.5, 1.0], [1.0, 1.5]]))
        bridges = jb.sample_bridges(
            jax.random.key(0), model, [0.0, 0.0], [1.0, 0.0], 1.0, num_bridges=1000
        )
        ```
    """
    coupling = Coupling() if coupling is None else coupling
    if not isinstance(coupling, AbstractCoupling):
        raise TypeError(f"`coupling` must be a `Coupling`; got {coupling!r}.")
    check_key(key)
    check_diffusion(model)
    num_bridges = check_count("num_bridges", num_bridges)
    num_steps = check_count("num_steps", num_steps)
    intervals, batched, several_durations = as_intervals(start, end, duration)
    check_model(model, intervals, coupling.scheme)
    model.check_reversal()
    stored = _stored_steps(save_at, 1.0 if several_durations else duration, num_steps)
    if max_proposals is None:
        max_proposals = min(max(1_000 * num_bridges, 100_000), _MOST_PROPOSALS)
    elif not is_traced(max_proposals):
        max_proposals = check_count("max_proposals", max_proposals)
        if max_proposals > _MOST_PROPOSALS:
            raise ValueError(f"`max_proposals` must be at most 2³⁰; got {max_proposals}.")
    if batch_size is None:
        batch_size = _default_batch_size(intervals, num_bridges, num_steps)
    batch_size = check_count("batch_size", batch_size)
    progress_meter = diffrax.NoProgressMeter() if progress_meter is None else progress_meter
    bridges = _sample_bridges(
        key,
        model,
        coupling,
        intervals,
        jnp.asarray(max_proposals, jnp.int32),
        stored,
        num_bridges,
        num_steps,
        batch_size,
        progress_meter,
    )
    if throw:
        message = (
            "some bridges were not found within `max_proposals` proposals: allow more, lengthen "
            "the duration or choose a smaller `gamma`."
        )
        paths = eqx.error_if(bridges.paths, ~bridges.met, message)
        bridges = bridges._replace(paths=paths)
    if not several_durations:
        bridges = bridges._replace(times=bridges.times[0])
    if batched:
        return bridges
    return Bridges(bridges.times, *(leaf[0] for leaf in bridges[1:]))


# Proposals are numbered in 32 bits.
_MOST_PROPOSALS = 2**30


class _Search(NamedTuple):
    """The state of the rejection loop; an interval's bridges fill its n rows in order."""

    paths: Float[Array, "rows K d"]
    rho: Int[Array, " rows"]
    number: Int[Array, " rows"]  # of the proposal that became this bridge
    found: Int[Array, " I"]
    tried: Int[Array, " I"]
    num_proposals: Int[Array, " I"]
    num_nonfinite: Int[Array, " I"]
    meter: Any


class _Inputs(NamedTuple):
    """Everything a path may be differentiated with respect to."""

    model: Diffusion
    coupling: AbstractCoupling
    intervals: Intervals


@eqx.filter_jit
def _sample_bridges(
    key: Key[Array, ""],
    model: Diffusion,
    coupling: AbstractCoupling,
    intervals: Intervals,
    max_proposals: Int[Array, ""],
    stored: Int[Array, " K"] | None,
    num_bridges: int,
    num_steps: int,
    num_lanes: int,
    progress_meter: diffrax.AbstractProgressMeter,
) -> Bridges:
    inputs = _Inputs(model.prepared(), coupling, intervals)
    search = _search(
        key,
        jax.tree.map(lambda leaf: lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, inputs),
        max_proposals,
        stored,
        num_bridges,
        num_steps,
        num_lanes,
        progress_meter,
    )
    num_intervals, d = intervals.start.shape
    met = search.rho <= num_steps
    interval = jnp.repeat(jnp.arange(num_intervals), num_bridges)
    accepted = (key, interval, search.number, stored, search.rho)
    paths = _with_replayed_tangents(inputs, accepted, search.paths, num_steps)
    paths = jnp.where(met[:, None, None], paths, jnp.nan)
    steps = jnp.arange(num_steps + 1) if stored is None else stored
    times = steps.astype(paths.dtype) / num_steps * intervals.duration[:, None]
    shape = (num_intervals, num_bridges)
    return Bridges(
        times,
        paths.reshape(*shape, -1, d),
        met.reshape(shape),
        jnp.where(met, search.rho, -1).reshape(shape),
        search.num_proposals,
        search.num_nonfinite,
    )


def _search(
    key: Key[Array, ""],
    inputs: _Inputs,
    max_proposals: Int[Array, ""],
    stored: Int[Array, " K"] | None,
    num_bridges: int,
    num_steps: int,
    num_lanes: int,
    progress_meter: diffrax.AbstractProgressMeter,
) -> _Search:
    """Propose, round by round, until every interval has its bridges or has run out of tries."""
    num_intervals, d = inputs.intervals.start.shape
    num_rows = num_intervals * num_bridges
    num_stored = num_steps + 1 if stored is None else stored.shape[0]

    def pending(search: _Search):
        return (search.found < num_bridges) & (search.tried < max_proposals)

    def one_round(search: _Search) -> _Search:
        first, interval, place = _assign_lanes(search, pending(search), num_bridges, num_lanes)
        number = search.tried[interval] + place
        made = _propose_numbered(inputs, key, interval, number, num_steps, stored)
        tried = number < max_proposals
        success = tried & (made.meeting_step <= num_steps)
        # The lanes of one interval lie side by side, in the order of their numbers.
        successes = jnp.cumsum(success, dtype=jnp.int32)
        successes_before = successes - success.astype(jnp.int32)
        rank = search.found[interval] + successes_before - successes_before[first[interval]]
        needed = tried & (rank < num_bridges)
        row = jnp.where(success & needed, interval * num_bridges + rank, num_rows)

        def keep(rows, values):
            return rows.at[row].set(values, mode="drop")

        def count(lanes):
            return jax.ops.segment_sum(
                lanes.astype(jnp.int32), interval, num_intervals, indices_are_sorted=True
            )

        found = search.found + count(success & needed)
        progress = jnp.sum(found).astype(jnp.float32) / num_rows
        return _Search(
            keep(search.paths, jnp.moveaxis(made.paths, -1, 0)),
            keep(search.rho, made.meeting_step),
            keep(search.number, number),
            found,
            search.tried + count(jnp.ones_like(tried)),
            search.num_proposals + count(needed),
            search.num_nonfinite + count(needed & ~made.finite),
            progress_meter.step(search.meter, progress),
        )

    nothing = jnp.zeros(num_intervals, jnp.int32)
    search = _Search(
        jnp.zeros((num_rows, num_stored, d), inputs.intervals.start.dtype),
        jnp.full(num_rows, num_steps + 1, jnp.int32),
        jnp.zeros(num_rows, jnp.int32),
        nothing,
        nothing,
        nothing,
        nothing,
        progress_meter.init(),
    )
    search = lax.while_loop(lambda search: jnp.any(pending(search)), one_round, search)
    progress_meter.close(search.meter)
    return search


def _assign_lanes(
    search: _Search, pending: Bool[Array, " I"], num_bridges: int, num_lanes: int
) -> tuple[Int[Array, " I"], Int[Array, " lanes"], Int[Array, " lanes"]]:
    """The first lane of each interval; each lane's interval, and its place among that
    interval's lanes. Lanes go in proportion to the proposals still expected to be needed."""
    found, tried = search.found.astype(jnp.float32), search.tried.astype(jnp.float32)
    rate = (found + 1) / (tried + 2)
    need = jnp.where(pending, (num_bridges - found) / rate, 0)
    share = jnp.cumsum(need) / jnp.maximum(jnp.sum(need), 1)
    # Rounded sums of floats need not increase, and an interval's lanes must not overlap the next's.
    last = lax.cummax(jnp.round(share * num_lanes).astype(jnp.int32)).at[-1].set(num_lanes)
    first = jnp.concatenate([jnp.zeros(1, jnp.int32), last[:-1]])
    lanes = jnp.arange(num_lanes, dtype=jnp.int32)
    interval = jnp.searchsorted(last, lanes, side="right").astype(jnp.int32)
    return first, interval, lanes - first[interval]


def _propose_numbered(
    inputs: _Inputs,
    key: Key[Array, ""],
    interval: Int[Array, " lanes"],
    number: Int[Array, " lanes"],
    num_steps: int,
    stored: Int[Array, " K"] | None,
    meeting_step: Int[Array, " lanes"] | None = None,
    time_scale: Float[Array, " lanes"] | float = 1.0,
) -> Proposals:
    """The proposals with these numbers, of these intervals: a function of nothing else."""
    fold_in = jax.vmap(jax.random.fold_in)
    keys = fold_in(jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, interval), number)
    start, end, duration = inputs.intervals
    return propose(
        inputs.model,
        inputs.coupling,
        keys,
        start[interval].T,
        end[interval].T,
        duration[interval] * time_scale / num_steps,
        num_steps,
        stored,
        meeting_step,
    )


@eqx.filter_custom_jvp
def _with_replayed_tangents(inputs, accepted, paths, num_steps):
    """`paths`, whose tangents come from a replay of the accepted proposals.

    The search is a `while_loop`, which has no reverse mode, and most of its work was rejected.
    """
    return paths


@_with_replayed_tangents.def_jvp
def _replay_tangents(primals, tangents):
    inputs, (key, interval, number, stored, rho), paths, num_steps = primals

    def replay(inputs):
        # A row without a bridge replays a proposal of no duration, which cannot overflow: its
        # tangent is masked by the caller, and in reverse mode 0 · ∞ would be NaN.
        brief = jnp.where(rho <= num_steps, 1, 1e-12).astype(paths.dtype)
        made = _propose_numbered(inputs, key, interval, number, num_steps, stored, rho, brief)
        return jnp.moveaxis(made.paths, -1, 0)

    return paths, eqx.filter_jvp(replay, (inputs,), (tangents[0],))[1]


def check_key(key) -> None:
    """Raise `TypeError` for anything but one typed key."""
    if not (isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
        raise TypeError(f"`key` must be a typed key, `jax.random.key(seed)`; got {key!r}.")
    if key.shape != ():
        raise ValueError(f"`key` must be a single key; got an array of keys, {key.shape}.")


def _stored_steps(
    save_at: Numbers | None, duration: Numbers, num_steps: int
) -> Int[Array, " K"] | None:
    if save_at is None:
        return None
    save_at = as_floating("save_at", save_at)
    if save_at.ndim != 1 or save_at.shape[0] == 0:
        raise ValueError(f"`save_at` must be times in an array of shape (K,); got {save_at.shape}.")
    if is_traced(save_at, duration):
        steps = jnp.round(save_at / jnp.asarray(duration) * num_steps)
        return jnp.clip(steps, 0, num_steps).astype(jnp.int32)
    steps = np.asarray(save_at, float) / np.asarray(duration, float) * num_steps
    nearest = np.round(steps)
    tolerance = 1e-3 + num_steps * float(jnp.finfo(save_at.dtype).eps)
    if np.any(steps < -tolerance) or np.any(steps > num_steps + tolerance):
        raise ValueError(f"`save_at` must lie in [0, {duration}]; got {save_at}.")
    if np.any(np.abs(steps - nearest) > tolerance):
        raise ValueError(
            "`save_at` must lie on the grid of `num_steps` steps: the times nearest to "
            f"those given are {nearest / num_steps * np.asarray(duration)}."
        )
    if np.any(np.diff(nearest) <= 0):
        raise ValueError(f"`save_at` must increase from one grid point on; got {save_at}.")
    return jnp.asarray(nearest, jnp.int32)


def _default_batch_size(intervals: Intervals, num_bridges: int, num_steps: int) -> int:
    """Lanes: as many as bridges are asked for, within a bound on the memory of their paths.

    A lane holds the reversed path, the joined one and their noise.
    """
    num_intervals, d = intervals.start.shape
    bytes_per_lane = 3 * d * (num_steps + 1) * intervals.start.dtype.itemsize
    fitting = 2**26 // bytes_per_lane
    return max(1, min(fitting, 8_192, max(num_intervals * num_bridges, 64)))
