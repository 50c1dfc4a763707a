"""Markov chains whose law is that of the exact bridge (section 2.3 of the paper).

* **Pseudo-marginal** Metropolis–Hastings: propose a weighted path, accept with the ratio of the
  weights. Weights are random but unbiased, and a state keeps its own.
* **Renewal**, the paper's alternative algorithm: run one diffusion associated with the current
  bridge; if it hits, take a new proposal. It keeps nothing but the path. Where μ is not ν, and
  the trial that hit had started in x_0, the proposal with x_0' is taken with probability
  `min(1, (μ/ν)(x_0') / (μ/ν)(x_0))`, for then

      f(z) μ(x_0) h(z|x_0) · ν(x_0') h(z'|x_0') f(z') · min(1, μ(x_0')ν(x_0) / ν(x_0')μ(x_0))

  is symmetric in (z, x_0) and (z', x_0'), h being the probability of a hit from x_0.

Both come as kernels of two functions, `init` and `step`, and as `sample_exact_bridges`, which
does the work of very many steps at once and returns the same chain.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from .arrays import Numbers, as_floating, is_traced, nondifferentiable
from .associated import run_associated
from .bridges import (
    Inputs,
    Joined,
    check_key,
    find_bridges,
    stored_steps,
    stored_times,
    unflatten_rows,
)
from .coupling import AbstractCoupling
from .diffusion import Diffusion, check_diffusion
from .intervals import Intervals, as_intervals, check_count, check_model
from .search import default_num_lanes, most_lanes
from .start_laws import log_ratio
from .weighted import (
    AbstractWeightedProposal,
    CoupledPairs,
    WeightedPaths,
    as_proposal,
    check_burn_in,
    check_density,
)


class Kernel(NamedTuple):
    """A Markov kernel: `init(position, rng_key) -> state` and `step(rng_key, state) -> (state,
    info)`. Runners that look for these two functions, such as BlackJAX's, take it as it is."""

    init: Callable
    step: Callable


class PseudoMarginalState(NamedTuple):
    """`position`, the path, shape (N+1, d); its `log_weight`; whether that was `truncated`.

    A state without a path, where none was found, has weight -inf.
    """

    position: Float[Array, "points d"]
    log_weight: Float[Array, ""]
    truncated: Bool[Array, ""]


class PseudoMarginalInfo(NamedTuple):
    """Of one step: the `acceptance_rate` and whether the proposal was accepted, its log weight
    (-inf if none was found), and the number of paths simulated for it."""

    acceptance_rate: Float[Array, ""]
    is_accepted: Bool[Array, ""]
    log_weight: Float[Array, ""]
    num_simulated: Int[Array, ""]


class RenewalState(NamedTuple):
    """`position`, the path, shape (N+1, d); NaN where none was found."""

    position: Float[Array, "points d"]


class RenewalInfo(NamedTuple):
    """Of one step: whether the associated diffusion hit, whether the path was replaced, the
    number of paths simulated, and of those that left the finite numbers."""

    is_hit: Bool[Array, ""]
    is_accepted: Bool[Array, ""]
    num_simulated: Int[Array, ""]
    num_nonfinite: Int[Array, ""]


def pseudo_marginal(
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_steps: int = 50,
    proposal: Any = None,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
) -> Kernel:
    """The pseudo-marginal Metropolis–Hastings kernel on (start, end, duration)-bridges.

    `init(position, rng_key)` takes a path of shape (N+1, d), draws its weight from the law that
    it has in the chain, and so may enter a chain, as a block of a Gibbs sampler; or `None`, for
    a first path by proposal. `step(rng_key, state)` gives a `PseudoMarginalState` and a
    `PseudoMarginalInfo`. Arguments are those of `sample_exact_bridges`.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    !!! example

        ```python
        kernel = jb.pseudo_marginal(model, a, b, 1.0, num_steps=50, proposal=jb.Coupling(0.5))
        state, info = kernel.step(jax.random.key(1), kernel.init(None, jax.random.key(0)))
        ```
    """
    check_diffusion(model)
    proposal = as_proposal(proposal, num_counts, max_proposals, max_trials)
    intervals = _one_interval(start, end, duration)
    num_steps = check_count("num_steps", num_steps)
    check_proposal(proposal, model, intervals)
    check_burn_in(proposal, model)
    setting = (model, proposal, intervals, num_steps)

    def init(position, rng_key):
        check_key(rng_key)
        if position is None:
            return _draw_state(rng_key, *setting)[0]
        path = _check_path(position, intervals, num_steps)
        return _reweigh_state(rng_key, path, *setting)

    def step(rng_key, state):
        return _pseudo_marginal_step(rng_key, state, *setting)

    return Kernel(init, step)


@eqx.filter_jit
def _draw_state(rng_key, model, proposal, intervals, num_steps):
    model, intervals = nondifferentiable((model.prepared(), intervals))
    drawn = proposal.draw(rng_key[None], model, intervals, num_steps, None, False)
    return _first(drawn), drawn.num_simulated[0]


@eqx.filter_jit
def _reweigh_state(rng_key, path, model, proposal, intervals, num_steps):
    model, intervals, path = nondifferentiable((model.prepared(), intervals, path))
    return _first(proposal.reweigh(rng_key[None], model, intervals, path[None]))


def _first(drawn: WeightedPaths) -> PseudoMarginalState:
    return PseudoMarginalState(drawn.paths[0], drawn.log_weights[0], drawn.truncated[0])


@eqx.filter_jit
def _pseudo_marginal_step(rng_key, state, *setting):
    draw_key, accept_key = jax.random.split(rng_key)
    candidate, num_simulated = _draw_state(draw_key, *setting)
    uniform = jax.random.uniform(accept_key, dtype=candidate.position.dtype)
    rate = _acceptance_rate(state.log_weight, candidate.log_weight)
    accepted = uniform < rate
    kept = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), candidate, state)
    return kept, PseudoMarginalInfo(rate, accepted, candidate.log_weight, num_simulated)


def renewal(
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_steps: int = 50,
    proposal: AbstractCoupling | None = None,
    max_proposals: int | None = None,
) -> Kernel:
    """The renewal kernel on (start, end, duration)-bridges, for couplings.

    `init(position, rng_key)` takes a path of shape (N+1, d), or `None` for a first path by
    proposal. `step(rng_key, state)` gives a `RenewalState` and a `RenewalInfo`. Arguments are
    those of `sample_exact_bridges`.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    !!! example

        ```python
        kernel = jb.renewal(model, a, b, 1.0, num_steps=50, proposal=jb.Coupling(0.5))
        state, info = kernel.step(jax.random.key(1), kernel.init(None, jax.random.key(0)))
        ```
    """
    check_diffusion(model)
    pairs = _as_pairs(as_proposal(proposal, 1, max_proposals))
    intervals = _one_interval(start, end, duration)
    num_steps = check_count("num_steps", num_steps)
    check_proposal(pairs, model, intervals)
    check_burn_in(pairs, model)
    setting = (model, pairs, intervals)

    def init(position, rng_key):
        check_key(rng_key)
        if position is None:
            return RenewalState(_first_paths(rng_key[None], *setting, num_steps)[0])
        return RenewalState(_check_path(position, intervals, num_steps))

    def step(rng_key, state):
        return _renewal_step(rng_key, state, *setting)

    return Kernel(init, step)


@eqx.filter_jit
def _renewal_step(rng_key, state, model, pairs, intervals):
    everything = jnp.ones(1, bool)
    model, intervals, path = nondifferentiable((model.prepared(), intervals, state.position))
    paths, info = _renew(rng_key[None], model, pairs, intervals, path[None], everything)
    return RenewalState(paths[0]), jax.tree.map(lambda leaf: leaf[0], info)


class Chain(eqx.Module):
    """States of a chain; with I intervals arrays have a leading axis I.

    - `times`: the K stored times, shape (K,); (I, K) for I durations.
    - `paths`: the states of the chain after each step, shape (n, K, d); NaN until a first path
        was found.
    - `accepted`: whether the step took a new path, shape (n,).
    - `log_weights`: those of the states, shape (n,), for the pseudo-marginal chain, else `None`.
    - `met`: whether there is a path, shape (n,).
    - `truncated`: whether the state's counts were cut off by `max_trials`: then it has too
        little weight, and the chain's law is not exact. Shape (n,), or `None` as `log_weights`.
    - `num_simulated`: paths simulated in all, shape ().
    - `num_nonfinite`: how many of them left the finite numbers.
    - `num_truncated`: how many proposals, accepted or not, had counts cut off.
    - `proposal`: what proposed; a `Stationary` that had to be run has its `burn_in` in it.
    - `num_steps`: N.
    """

    times: Float[Array, "*durations K"]
    paths: Float[Array, "*I n K d"]
    accepted: Bool[Array, "*I n"]
    log_weights: Float[Array, "*I n"] | None
    met: Bool[Array, "*I n"]
    truncated: Bool[Array, "*I n"] | None
    num_simulated: Int[Array, "*I"]
    num_nonfinite: Int[Array, "*I"]
    num_truncated: Int[Array, "*I"]
    proposal: AbstractWeightedProposal
    num_steps: int = eqx.field(static=True)

    @property
    def coupling(self) -> AbstractCoupling | None:
        """That of the proposal, if it has one."""
        return self.proposal.coupling if isinstance(self.proposal, CoupledPairs) else None

    @property
    def acceptance_rate(self) -> Float[Array, "*I"]:
        """The share of steps that took a new path."""
        return jnp.mean(self.accepted, axis=-1)


def sample_exact_bridges(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_bridges: int = 1,
    num_steps: int = 50,
    proposal: Any = None,
    method: Literal["pseudo_marginal", "renewal"] = "pseudo_marginal",
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    save_at: Numbers | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> Chain:
    """A Markov chain of bridges with the exact law: section 2.3 of the paper.

    The law is exact up to the step error, which `num_steps` controls. Proposals do not depend
    on the chain, so they and their counts are made ahead, thousands at a time; the renewal
    chain runs in segments that are joined where they agree. The chain is, up to rounding, that
    of the kernel: with `run_key, init_key = jax.random.split(key)`, the one that starts from
    `init(None, init_key)` and steps with `jax.random.split(run_key, num_bridges)`.

    **Arguments:**

    - `key`: a typed key. With I intervals the i-th chain has the key
        `jax.random.fold_in(key, i)`.
    - `model`, `start`, `end`, `duration`, `num_steps`, `save_at`: as in `sample_bridges`.
    - `num_bridges`: n, the number of iterations.
    - `proposal`: a `Coupling`, with its start law; by default `Coupling(gamma=0.0)`.
    - `method`: "pseudo_marginal", or "renewal", which needs many more iterations for bridges
        as good, each of which costs less.
    - `num_counts`: N, hitting counts for each proposal of the pseudo-marginal chain; by default
        one.
    - `max_proposals`: bounds the tries for each new path; by default 10,000.
    - `max_trials`: bounds the trials for the counts of each path; by default 10,000 for each
        count. See `Chain.truncated`.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.

    **Returns:** `Chain`. Not differentiable.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    !!! example

        ```python
        chain = jb.sample_exact_bridges(
            jax.random.key(0), model, [0.0, 0.0], [1.0, 0.0], 1.0, num_bridges=10_000
        )
        chain.paths, chain.acceptance_rate
        ```
    """
    check_key(key)
    check_diffusion(model)
    num_bridges = check_count("num_bridges", num_bridges)
    num_steps = check_count("num_steps", num_steps)
    intervals, batched, several_durations = as_intervals(start, end, duration)
    proposal = as_proposal(proposal, num_counts, max_proposals, max_trials)
    check_proposal(proposal, model, intervals)
    stored = stored_steps(save_at, 1.0 if several_durations else duration, num_steps)
    if method == "renewal":
        proposal = _as_pairs(proposal)
    elif method != "pseudo_marginal":
        raise ValueError(f'`method` must be "pseudo_marginal" or "renewal"; got {method!r}.')
    arguments = (key, model, proposal, intervals, stored, num_bridges, num_steps, batched)
    chain = _run_pseudo_marginal if method == "pseudo_marginal" else _run_renewal
    return chain(*arguments, several_durations, progress_meter)


@eqx.filter_jit
def _run_pseudo_marginal(
    key: Key[Array, ""],
    model: Diffusion,
    proposal: AbstractWeightedProposal,
    intervals: Intervals,
    stored: Int[Array, " K"] | None,
    num_bridges: int,
    num_steps: int,
    batched: bool,
    several_durations: bool,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> Chain:
    model, intervals = nondifferentiable((model.prepared(), intervals))
    num_intervals = intervals.start.shape[0]
    proposal = proposal.prepared(key, model, intervals, num_steps)
    step_keys, init_keys = _chain_keys(key, num_intervals, num_bridges, batched)
    draw_keys, accept_keys = jax.vmap(jax.random.split, out_axes=1)(step_keys.reshape(-1))
    # Row 0 of each interval is its first state, and row i the candidate of step i.
    draw_keys = jnp.concatenate([init_keys[:, None], draw_keys.reshape(step_keys.shape)], axis=1)
    each = jax.tree.map(lambda leaf: jnp.repeat(leaf, num_bridges + 1, axis=0), intervals)
    drawn = proposal.draw(
        draw_keys.reshape(-1), model, each, num_steps, stored, False, progress_meter
    )
    log_weights = drawn.log_weights.reshape(num_intervals, -1)
    uniform = jax.vmap(lambda k: jax.random.uniform(k, dtype=log_weights.dtype))(accept_keys)

    def step(state, inputs):
        row, log_weight = state
        i, candidate, uniform = inputs
        accepted = uniform < _acceptance_rate(log_weight, candidate)
        state = jnp.where(accepted, i, row), jnp.where(accepted, candidate, log_weight)
        return state, (*state, accepted)

    init = (jnp.zeros(num_intervals, jnp.int32), log_weights[:, 0])
    candidates = jnp.arange(1, num_bridges + 1, dtype=jnp.int32), log_weights[:, 1:].T
    inputs = (*candidates, uniform.reshape(step_keys.shape).T)
    _, (row, log_weights, accepted) = lax.scan(step, init, inputs)
    first_row = jnp.arange(num_intervals, dtype=jnp.int32) * (num_bridges + 1)
    row = (row + first_row).T.reshape(-1)

    def of_states(leaf):
        return unflatten_rows(leaf[row], num_intervals, batched)

    def total(leaf):
        leaf = jnp.sum(leaf.reshape(num_intervals, -1), axis=1, dtype=jnp.int32)
        return leaf if batched else leaf[0]

    return Chain(
        stored_times(intervals, stored, num_steps, several_durations),
        of_states(drawn.paths),
        accepted.T if batched else accepted[:, 0],
        log_weights.T if batched else log_weights[:, 0],
        of_states(drawn.found),
        of_states(drawn.truncated),
        total(drawn.num_simulated),
        total(drawn.num_nonfinite),
        total(drawn.truncated),
        proposal,
        num_steps,
    )


def _acceptance_rate(
    log_weight: Float[Array, "*I"], candidate: Float[Array, "*I"]
) -> Float[Array, "*I"]:
    """min(1, ratio of the weights); a missing candidate is refused, a missing state left."""
    ratio = jnp.where(candidate > -jnp.inf, candidate - log_weight, -jnp.inf)
    return jnp.exp(jnp.minimum(ratio, 0))


# Segments of the renewal chain run side by side: as many as keep each this long, and no more
# than fill the lanes. Those that must be run again are few, and run this many at a time.
_SHORTEST_SEGMENT = 64
_REPAIR_WIDTH = 128


class _Segments(NamedTuple):
    """The trajectories of S segments of L steps, and the path in which each ends.

    `stale` marks segments whose recorded trajectory did not begin with the path in which the
    segment before it ends.
    """

    paths: Float[Array, "L S K d"]
    moved: Bool[Array, "L S"]
    ends: Float[Array, "S points d"]
    stale: Bool[Array, " S"]
    num_simulated: Int[Array, " S"]
    num_nonfinite: Int[Array, " S"]


@eqx.filter_jit
def _run_renewal(
    key: Key[Array, ""],
    model: Diffusion,
    pairs: CoupledPairs,
    intervals: Intervals,
    stored: Int[Array, " K"] | None,
    num_bridges: int,
    num_steps: int,
    batched: bool,
    several_durations: bool,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> Chain:
    """Segments of the chain start from guesses, and are run again from where the segment before
    them ends until all fit. Two trajectories that take new paths in the same step take the same
    one, since a proposal depends on the key of its step only: from there on they are one, and
    the rest of the record holds. So a repair is short, and the result that of one long run.
    """
    model, intervals = nondifferentiable((model.prepared(), intervals))
    num_intervals = intervals.start.shape[0]
    pairs = pairs.prepared(key, model, intervals, num_steps)
    step_keys, init_keys = _chain_keys(key, num_intervals, num_bridges, batched)
    first = _first_paths(init_keys, model, pairs, intervals, num_steps)
    most_segments = most_lanes(intervals.start.shape[1]) // 2 // num_intervals
    num_segments = max(1, min(num_bridges // _SHORTEST_SEGMENT, most_segments))
    length = -(-num_bridges // num_segments)
    # The last steps of the last segment may be too many: they repeat a key, and are dropped.
    steps = jnp.minimum(jnp.arange(num_segments * length), num_bridges - 1)
    keys = step_keys[:, steps].reshape(num_intervals * num_segments, length)
    each = jax.tree.map(lambda leaf: jnp.repeat(leaf, num_segments, axis=0), intervals)
    num = num_intervals * num_segments
    head = jnp.tile(jnp.arange(num_segments) == 0, num_intervals)
    before = jnp.maximum(jnp.arange(num) - 1, 0)

    def run_again(segments: _Segments, chosen: Int[Array, " W"], progress_meter) -> _Segments:
        """Run these segments from where the ones before them end, until they rejoin."""
        place = jnp.minimum(chosen, num - 1)  # those beyond the last only fill the width
        chosen_keys, chosen_intervals = keys[place], jax.tree.map(lambda x: x[place], each)
        entry = jnp.where(
            head[place, None, None], first[place // num_segments], segments.ends[before[place]]
        )

        def one_step(state):
            i, positions, active, segments, meter = state
            positions, info = _renew(
                chosen_keys[:, i], model, pairs, chosen_intervals, positions, active
            )
            rejoined = info.is_accepted & segments.moved[i, place]
            row = jnp.where(active, chosen, num)
            kept = positions if stored is None else positions[:, stored]
            segments = segments._replace(
                paths=segments.paths.at[i, row].set(kept, mode="drop"),
                moved=segments.moved.at[i, row].set(info.is_accepted, mode="drop"),
                num_simulated=segments.num_simulated.at[row].add(info.num_simulated, mode="drop"),
                num_nonfinite=segments.num_nonfinite.at[row].add(info.num_nonfinite, mode="drop"),
            )
            meter = progress_meter.step(meter, (i + 1).astype(jnp.float32) / length)
            return i + 1, positions, active & ~rejoined, segments, meter

        state = (jnp.int32(0), entry, chosen < num, segments, progress_meter.init())
        state = lax.while_loop(lambda s: (s[0] < length) & jnp.any(s[2]), one_step, state)
        _, positions, changed, segments, meter = state
        progress_meter.close(meter)
        ends = segments.ends.at[jnp.where(changed, chosen, num)].set(positions, mode="drop")
        stale = segments.stale.at[chosen].set(False, mode="drop")
        after = jnp.where(changed, chosen + 1, num)
        stale = stale.at[after].set(True, mode="drop") & ~head
        return segments._replace(ends=ends, stale=stale)

    def repair(segments):
        chosen = jnp.nonzero(segments.stale, size=min(_REPAIR_WIDTH, num), fill_value=num)[0]
        return run_again(segments, chosen, diffrax.NoProgressMeter())

    num_stored = num_steps + 1 if stored is None else stored.shape[0]
    d, dtype = intervals.start.shape[1], intervals.start.dtype
    segments = _Segments(
        jnp.zeros((length, num, num_stored, d), dtype),
        jnp.zeros((length, num), bool),
        jnp.repeat(first, num_segments, axis=0),
        jnp.zeros(num, bool),
        jnp.zeros(num, jnp.int32),
        jnp.zeros(num, jnp.int32),
    )
    progress_meter = diffrax.NoProgressMeter() if progress_meter is None else progress_meter
    segments = run_again(segments, jnp.arange(num), progress_meter)
    # The first stale segment starts from where the chain is, so each pass settles it at least.
    segments = lax.while_loop(lambda s: jnp.any(s.stale), repair, segments)

    def of_steps(leaf):
        leaf = jnp.moveaxis(leaf, 0, 1).reshape(num_intervals, -1, *leaf.shape[2:])
        leaf = leaf[:, :num_bridges]
        return leaf if batched else leaf[0]

    paths = of_steps(segments.paths)

    def total(leaf):
        leaf = jnp.sum(leaf.reshape(num_intervals, -1), axis=1, dtype=jnp.int32)
        return leaf if batched else leaf[0]

    return Chain(
        stored_times(intervals, stored, num_steps, several_durations),
        paths,
        of_steps(segments.moved),
        None,
        jnp.all(jnp.isfinite(paths), axis=(-2, -1)),
        None,
        total(segments.num_simulated),
        total(segments.num_nonfinite),
        total(jnp.zeros(num, jnp.int32)),
        pairs,
        num_steps,
    )


def _renew(
    keys: Key[Array, " S"],
    model: Diffusion,
    pairs: CoupledPairs,
    intervals: Intervals,
    paths: Float[Array, "S points d"],
    active: Bool[Array, " S"],
) -> tuple[Float[Array, "S points d"], RenewalInfo]:
    """One renewal step of each of S chains that is active: hit first, propose only then."""
    num_steps = paths.shape[1] - 1
    trial_keys, propose_keys, accept_keys = jax.vmap(
        lambda key: jax.random.split(key, 3), out_axes=1
    )(keys)
    dt = intervals.duration / num_steps
    lanes = jnp.moveaxis(paths, 0, -1)
    associated = run_associated(model, pairs.coupling, trial_keys, lanes, dt)
    missing = ~jnp.all(jnp.isfinite(paths), axis=(1, 2))
    called_for = active & (associated.hit | missing)
    proposed = _propose(propose_keys, model, pairs, intervals, called_for, num_steps)
    found = proposed.num_found > 0
    new_paths, new_start, _ = proposed.outputs

    def ratio(x):
        return log_ratio(pairs.coupling.start_law, model, x)

    log_rate = jax.vmap(ratio)(new_start) - jax.vmap(ratio)(associated.start.T)
    uniform = jax.vmap(lambda key: jax.random.uniform(key, dtype=paths.dtype))(accept_keys)
    accepted = found & (missing | (uniform < jnp.exp(jnp.minimum(log_rate, 0))))
    info = RenewalInfo(
        associated.hit & active,
        accepted,
        active.astype(jnp.int32) + proposed.num_trials,
        (active & ~missing & ~associated.finite).astype(jnp.int32) + proposed.num_nonfinite,
    )
    return jnp.where(accepted[:, None, None], new_paths, paths), info


def _propose(keys, model, pairs, intervals, active, num_steps):
    """A bridge by proposal for each of those that are active, which often are few."""
    num_lanes = default_num_lanes(len(keys) // 4, num_steps, intervals.start)
    inputs = Inputs(model, pairs.coupling, intervals)
    return find_bridges(keys, inputs, active, 1, pairs.max_proposals, num_steps, None, num_lanes)


@eqx.filter_jit
def _first_paths(keys, model, pairs, intervals, num_steps) -> Float[Array, "I points d"]:
    """A bridge by proposal for each interval, NaN where none was found."""
    everything = jnp.ones(len(keys), bool)
    proposed = _propose(keys, model.prepared(), pairs, intervals, everything, num_steps)
    joined: Joined = proposed.outputs
    return jnp.where((proposed.num_found > 0)[:, None, None], joined.paths, jnp.nan)


def _chain_keys(
    key: Key[Array, ""], num_intervals: int, num_bridges: int, batched: bool
) -> tuple[Key[Array, "I n"], Key[Array, " I"]]:
    """The keys of the steps and of the first state of each interval's chain."""
    keys = key[None]
    if batched:
        keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(num_intervals))
    run_keys, init_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
    return jax.vmap(lambda key: jax.random.split(key, num_bridges))(run_keys), init_keys


def _one_interval(start: Numbers, end: Numbers, duration: Numbers) -> Intervals:
    intervals, batched, _ = as_intervals(start, end, duration)
    if batched:
        raise ValueError(
            "a kernel is for one interval: `start` and `end` of shape (d,), `duration` (); use "
            "`jax.vmap`, or `sample_exact_bridges`, for several."
        )
    return intervals


def _check_path(position: Numbers, intervals: Intervals, num_steps: int) -> Array:
    path = as_floating("position", position)
    shape = (num_steps + 1, intervals.start.shape[1])
    if path.shape != shape:
        raise ValueError(f"`position` must be a path, shape {shape}, or `None`; got {path.shape}.")
    if not is_traced(path, intervals):
        ends = np.stack([intervals.start[0], intervals.end[0]])
        if not (
            np.all(np.isfinite(path)) and np.allclose(path[np.array([0, -1])], ends, atol=1e-3)
        ):
            raise ValueError(f"`position` must be a finite path from and to {ends}.")
    return path.astype(intervals.start.dtype)


def check_proposal(
    proposal: AbstractWeightedProposal, model: Diffusion, intervals: Intervals
) -> None:
    if isinstance(proposal, CoupledPairs):
        check_model(model, intervals, proposal.coupling.scheme)
        model.check_reversal()
        check_density(proposal.coupling.start_law, model)


def _as_pairs(proposal: AbstractWeightedProposal) -> CoupledPairs:
    if not isinstance(proposal, CoupledPairs):
        raise TypeError(
            'renewal is for couplings: pass a `Coupling`, or choose method="pseudo_marginal".'
        )
    return proposal
