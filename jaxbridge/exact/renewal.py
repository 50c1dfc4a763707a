"""The renewal chain, the paper's alternative algorithm (section 2.3).

Each step runs one diffusion associated with the current bridge. If it hits, a new proposal replaces
the bridge. The path is the whole state of the chain.

A start law μ other than ν needs an acceptance step. Let x_0 be the initial state of the trial that
hit, and x_0' that of the proposal. The proposal is accepted with probability min(1, r), where r =
(μ/ν)(x_0')/(μ/ν)(x_0). Let f be the density of the exact bridge, and h(z|x_0) the probability of a
hit of z from x_0. Then

    f(z) μ(x_0) h(z|x_0) · ν(x_0') h(z'|x_0') f(z') · min(1, μ(x_0')ν(x_0) / ν(x_0')μ(x_0))

is symmetric in (z, x_0) and (z', x_0'), so the chain is reversible.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ..coupling import (
    AbstractCoupling,
    Inputs,
    Joined,
    find_bridges,
    log_ratio,
    run_associated,
    run_is_cut,
)
from ..engine.batch_size import default_num_lanes, most_lanes
from ..engine.checks import Numbers, check_key, nondifferentiable
from ..engine.compiled import compiled_for, compiled_sooner
from ..engine.entry import public_entry
from ..engine.keys import split_each
from ..engine.lanes import over_lanes, over_points
from ..engine.progress import metered_while_loop
from ..engine.rejection import Accepted, Search
from ..models.bridge_problem import BridgeProblem, Intervals
from ..models.diffusion import Diffusion
from ..proposals import Budget, CoupledPairs, as_pairs, as_proposal
from .kernels import Chain, Kernel, chain_keys, check_position, one_interval


class RenewalState(NamedTuple):
    """State of the chain: `position`, the path, shape (N+1, d); NaN if there is none."""

    position: Float[Array, "points d"]


class RenewalInfo(NamedTuple):
    """Report of one step of the chain.

    - `is_hit`: whether the associated diffusion hit.
    - `is_accepted`: whether a new path replaced the old one.
    - `is_missing`: whether a new path was needed but not found within `max_proposals`.
    - `num_simulated`: number of simulated paths.
    - `num_nonfinite`: number of these that became non-finite.
    """

    is_hit: Bool[Array, ""]
    is_accepted: Bool[Array, ""]
    is_missing: Bool[Array, ""]
    num_simulated: Int[Array, ""]
    num_nonfinite: Int[Array, ""]


@public_entry
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
    """Return the renewal kernel on (start, end, duration)-bridges, for couplings.

    `init(position, rng_key)` takes a path of shape (N+1, d). With `None` it proposes a first path.
    `step(rng_key, state)` returns a `RenewalState` and a `RenewalInfo`.

    **Arguments:** as in `sample_exact_bridges`. `proposal` is a `Coupling`. A kernel measures no
    burn-in: for a model without sampler pass `Stationary(burn_in=...)` or a start law with a
    density.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    kernel = jb.renewal(model, start, end, 1.0, proposal=jb.Coupling(0.5))
    state, info = kernel.step(jax.random.key(1), kernel.init(None, jax.random.key(0)))
    ```
    """
    problem = one_interval(model, start, end, duration, num_steps)
    budget = Budget(max_proposals=max_proposals)
    pairs = as_pairs(as_proposal(proposal, model, problem.like, budget))
    pairs.check(model, problem.intervals)
    pairs.check_prepared(model)
    setting = (model, pairs, problem.intervals)

    @public_entry
    def init(position, rng_key):
        check_key(rng_key)
        paths = check_position(position, problem)
        if paths is None:
            paths, *_ = first_paths(rng_key[None], *setting, num_steps)
        return RenewalState(paths[0])

    @public_entry
    def step(rng_key, state):
        check_key(rng_key)
        return _renewal_step(rng_key, state, *setting)

    return Kernel(init, step)


@compiled_sooner
def _renewal_step(rng_key, state, model, pairs, intervals):
    all_active = jnp.ones(1, bool)
    arguments = (model.prepared(), pairs, intervals, state.position)
    model, pairs, intervals, path = nondifferentiable(arguments)
    paths, info = renew(rng_key[None], model, pairs, intervals, path[None], all_active)
    return RenewalState(paths[0]), jax.tree.map(lambda leaf: leaf[0], info)


# The renewal chain runs in segments side by side. Each has at least this length, and they all
# fit into the lanes.
_SHORTEST_SEGMENT = 64
# Few segments must run again: this many at a time.
_REPAIR_WIDTH = 128


class _Segments(NamedTuple):
    """Trajectories of S segments of L steps.

    - `paths`: the path after each step, at the K stored times.
    - `is_new`: whether the step accepted a new path.
    - `ends`: the path after the last step.
    - `stale`: whether the segment must run again: it did not start from the end of the one before
        it.
    - `num_simulated`, `num_nonfinite`: numbers of simulated paths, and of non-finite ones.
    """

    paths: Float[Array, "L S K d"]
    is_new: Bool[Array, "L S"]
    ends: Float[Array, "S points d"]
    stale: Bool[Array, " S"]
    num_simulated: Int[Array, " S"]
    num_nonfinite: Int[Array, " S"]


class _SegmentRunner(NamedTuple):
    """Data of the segments of all chains, and methods that run them.

    All segments have the same length, and all intervals the same number of segments. The last steps
    of the last segment of an interval may be surplus. They repeat a key, and are dropped.

    - `first`: the paths from which the chains start.
    - `keys`: the keys of the steps of each segment.
    - `intervals`: the interval of each segment.
    """

    model: Diffusion
    pairs: CoupledPairs
    problem: BridgeProblem
    first: Float[Array, "I points d"]
    keys: Key[Array, "S L"]
    intervals: Intervals

    @property
    def head(self) -> Bool[Array, " S"]:
        """Return which segments are the first of their interval."""
        # Segments of an interval lie side by side, in the order of time.
        num_segments = len(self.keys) // self.problem.num_intervals
        return jnp.arange(len(self.keys)) % num_segments == 0

    def begin(self) -> _Segments:
        """Return segments without steps, which are all stale.

        The start of the chain is the guess for the end of each segment.
        """
        num, length = self.keys.shape
        points, d = self.first.shape[1:]
        num_kept = points if self.problem.stored is None else len(self.problem.stored)
        return _Segments(
            jnp.zeros((length, num, num_kept, d), self.first.dtype),
            jnp.zeros((length, num), bool),
            jnp.repeat(self.first, num // self.problem.num_intervals, axis=0),
            jnp.ones(num, bool),
            jnp.zeros(num, jnp.int32),
            jnp.zeros(num, jnp.int32),
        )

    def run(
        self,
        segments: _Segments,
        chosen: Int[Array, " W"],
        progress_meter: diffrax.AbstractProgressMeter | None = None,
    ) -> _Segments:
        """Run the chosen segments, from the ends of the segments before them.

        The run of a segment stops where it rejoins the recorded trajectory. Indices beyond the last
        segment have no effect: they pad `chosen` to the length W.
        """
        num, length = self.keys.shape
        index = jnp.minimum(chosen, num - 1)
        intervals = jax.tree.map(lambda leaf: leaf[index], self.intervals)

        def is_unfinished(state):
            i, _, active, _ = state
            return (i < length) & jnp.any(active)

        def one_step(state):
            i, positions, active, segments = state
            positions, info = renew(
                self.keys[index, i], self.model, self.pairs, intervals, positions, active
            )
            # Both accepted in this step, with the same key, so both have the same new path.
            rejoined = info.is_accepted & segments.is_new[i, index]
            # Index `num` is out of range: mode="drop" then leaves the record as it is.
            row = jnp.where(active, chosen, num)
            stored = self.problem.kept(positions)
            segments = segments._replace(
                paths=segments.paths.at[i, row].set(stored, mode="drop"),
                is_new=segments.is_new.at[i, row].set(info.is_accepted, mode="drop"),
                num_simulated=segments.num_simulated.at[row].add(info.num_simulated, mode="drop"),
                num_nonfinite=segments.num_nonfinite.at[row].add(info.num_nonfinite, mode="drop"),
            )
            return i + 1, positions, active & ~rejoined, segments

        def progress(state):
            return state[0].astype(jnp.float32) / length

        state = (jnp.int32(0), self._starts(segments)[index], chosen < num, segments)
        state = metered_while_loop(is_unfinished, one_step, state, progress, progress_meter)
        _, positions, changed, segments = state
        # A run that rejoined leaves the recorded end as it is: the end is the same.
        ends = segments.ends.at[jnp.where(changed, chosen, num)].set(positions, mode="drop")
        stale = segments.stale.at[chosen].set(False, mode="drop")
        # A run that did not rejoin has another end, and the next segment must run again.
        after = jnp.where(changed, chosen + 1, num)
        # The first segment of an interval starts from the given path, so it is never stale again.
        stale = stale.at[after].set(True, mode="drop") & ~self.head
        return segments._replace(ends=ends, stale=stale)

    def repair(self, segments: _Segments) -> _Segments:
        """Run the first stale segments again, at most `_REPAIR_WIDTH` of them."""
        num = len(self.keys)
        # `jnp.nonzero` needs a static size; the fill value is an index out of range.
        chosen = jnp.nonzero(segments.stale, size=min(_REPAIR_WIDTH, num), fill_value=num)[0]
        return self.run(segments, chosen)

    def _starts(self, segments: _Segments) -> Float[Array, "S points d"]:
        """Return the path from which each segment starts."""
        previous = jnp.maximum(jnp.arange(len(self.keys)) - 1, 0)
        first = jnp.repeat(self.first, len(self.keys) // len(self.first), axis=0)
        return jnp.where(self.head[:, None, None], first, segments.ends[previous])


@compiled_for(lambda key, model, proposal, problem, num, *_: problem.num_path_steps(num))
def run_renewal(
    key: Key[Array, ""],
    model: Diffusion,
    pairs: CoupledPairs,
    problem: BridgeProblem,
    num_bridges: int,
    first: Float[Array, "I points d"] | None,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> Chain:
    """Run the renewal chain of each interval, in segments side by side.

    Segments start from guesses. Then segments run again, each from the end of the segment before
    it, until every segment starts where the one before it ends. The result is that of one long run.

    Such a repeated run is short, because a proposal depends only on the key of its step. If two
    trajectories accept a new path in the same step, it is the same path. From there on the
    trajectories agree, and the recorded steps that follow remain valid.
    """
    arguments = (model.prepared(), pairs, problem, first)
    model, pairs, problem, first = nondifferentiable(arguments)
    intervals, num_steps, num_intervals = (
        problem.intervals,
        problem.num_steps,
        problem.num_intervals,
    )
    pairs = pairs.prepared(key, model, intervals, num_steps)
    step_keys, init_keys = chain_keys(key, problem, num_bridges)
    if first is None:
        initial_paths, num_proposals, num_failed = first_paths(
            init_keys, model, pairs, intervals, num_steps
        )
    else:
        initial_paths, num_proposals = first, jnp.zeros(num_intervals, jnp.int32)
        num_failed = num_proposals
    max_segments = most_lanes(intervals.start.shape[1]) // 2 // num_intervals
    num_segments = max(1, min(num_bridges // _SHORTEST_SEGMENT, max_segments))
    length = -(-num_bridges // num_segments)
    # Surplus steps repeat the last key.
    steps = jnp.minimum(jnp.arange(num_segments * length), num_bridges - 1)
    keys = step_keys[:, steps].reshape(num_intervals * num_segments, length)
    segment_intervals = jax.tree.map(lambda leaf: jnp.repeat(leaf, num_segments, axis=0), intervals)
    runner = _SegmentRunner(model, pairs, problem, initial_paths, keys, segment_intervals)
    segments = runner.begin()
    if len(keys) > _REPAIR_WIDTH or progress_meter is not None:
        segments = runner.run(segments, jnp.arange(len(keys)), progress_meter)
    # Few segments all run in the first repair, so the step is compiled once. The first
    # stale segment starts from a final state, so each pass makes at least that segment final.
    segments = lax.while_loop(lambda s: jnp.any(s.stale), runner.repair, segments)

    def join_segments(leaf):
        leaf = jnp.moveaxis(leaf, 0, 1).reshape(num_intervals, -1, *leaf.shape[2:])
        return problem.result(leaf[:, :num_bridges])

    paths = join_segments(segments.paths)
    # Whole paths exist only at the ends of segments, so `log_halving` (D) is NaN elsewhere. The
    # last segment may be too long; its end is then no state of the chain.
    is_segment_end = (steps == jnp.arange(len(steps))) & (
        jnp.arange(len(steps)) % length == length - 1
    )
    ends = pairs.log_halving(model, segment_intervals, segments.ends, 1).reshape(
        num_intervals, -1, 1
    )
    log_halving = jnp.where(is_segment_end.reshape(num_segments, -1), ends, jnp.nan)
    log_halving = log_halving.reshape(num_intervals, -1)[:, :num_bridges]
    # The chain has no counts to truncate, but hits have a wrong law if trials do not start from μ.
    is_cut = run_is_cut(pairs.coupling.start_law, model, intervals.duration / num_steps, num_steps)
    return Chain(
        times=problem.times(pairs.fractions(num_steps)),
        paths=paths,
        accepted=join_segments(segments.is_new),
        log_weights=None,
        met=jnp.all(jnp.isfinite(paths), axis=(-2, -1)),
        truncated=None,
        num_simulated=problem.total(segments.num_simulated) + problem.total(num_proposals),
        num_nonfinite=problem.total(segments.num_nonfinite) + problem.total(num_failed),
        num_truncated=problem.total(jnp.where(is_cut, num_bridges, 0)),
        proposal=pairs,
        pareto_k=None,
        log_halving=problem.result(log_halving),
        coarse_paths=None,
        step_share=problem.result(pairs.share_in_regime(model, intervals, num_steps)),
        num_steps=num_steps,
    )


def renew(
    keys: Key[Array, " S"],
    model: Diffusion,
    pairs: CoupledPairs,
    intervals: Intervals,
    paths: Float[Array, "S points d"],
    active: Bool[Array, " S"],
) -> tuple[Float[Array, "S points d"], RenewalInfo]:
    """Make one renewal step of each active chain of S.

    Only chains whose associated diffusion hit, and chains without a path, propose a new path.
    """
    num_steps = paths.shape[1] - 1
    trial_keys, propose_keys, accept_keys = split_each(keys, 3)
    dt = intervals.duration / num_steps
    lanes = jnp.moveaxis(paths, 0, -1)
    # Only a hit requires a proposal, which costs much more than a trial.
    associated = run_associated(model, pairs.coupling, trial_keys, lanes, dt)
    # A chain without a path takes any proposal.
    missing = ~jnp.all(jnp.isfinite(paths), axis=(1, 2))
    needs_path = active & (associated.hit | missing)
    proposed = propose_paths(propose_keys, model, pairs, intervals, needs_path, num_steps)
    is_found = proposed.num_found > 0
    new_paths, new_start, _ = proposed.outputs

    def ratio(x):
        return log_ratio(pairs.coupling.start_law, model, x)

    log_rate = over_points(ratio)(new_start) - over_lanes(-1)(ratio)(associated.start)
    uniform = jax.vmap(lambda key: jax.random.uniform(key, dtype=paths.dtype))(accept_keys)
    accepted = is_found & (missing | (uniform < jnp.exp(jnp.minimum(log_rate, 0))))
    info = RenewalInfo(
        associated.hit & active,
        accepted,
        needs_path & ~is_found,
        active.astype(jnp.int32) + proposed.num_trials,
        (active & ~missing & ~associated.finite).astype(jnp.int32) + proposed.num_nonfinite,
    )
    return jnp.where(accepted[:, None, None], new_paths, paths), info


def propose_paths(
    keys: Key[Array, " I"],
    model: Diffusion,
    pairs: CoupledPairs,
    intervals: Intervals,
    active: Bool[Array, " I"] | None,
    num_steps: int,
) -> Accepted:
    """Propose a bridge for each active interval; `None` makes all of them active.

    With a mask, few intervals are expected to be active, so fewer lanes are used.
    """
    # Few chains need a path in the same step: a quarter of them sets the number of lanes.
    num_wanted = len(keys) if active is None else len(keys) // 4
    active = jnp.ones(len(keys), bool) if active is None else active
    num_lanes = default_num_lanes(num_wanted, num_steps, intervals.start)
    inputs = Inputs(model, pairs.coupling, intervals)
    search = Search(1, pairs.max_proposals, num_lanes)
    return find_bridges(keys, inputs, active, num_steps, None, search)


@compiled_sooner
def first_paths(
    keys: Key[Array, " I"],
    model: Diffusion,
    pairs: CoupledPairs,
    intervals: Intervals,
    num_steps: int,
) -> tuple[Float[Array, "I points d"], Int[Array, " I"], Int[Array, " I"]]:
    """Propose a first bridge for each interval.

    Return the paths (NaN for a missing one), the numbers of proposals, and the numbers of
    non-finite ones.
    """
    proposed = propose_paths(keys, model.prepared(), pairs, intervals, None, num_steps)
    joined: Joined = proposed.outputs
    paths = jnp.where((proposed.num_found > 0)[:, None, None], joined.paths, jnp.nan)
    return paths, proposed.num_trials, proposed.num_nonfinite
