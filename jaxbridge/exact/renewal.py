"""The renewal chain, the paper's alternative algorithm (section 2.3).

Run one diffusion associated with the current bridge; if it hits, take a new proposal. The chain
keeps nothing but the path. Where μ is not ν, and the trial that hit had started in x_0, the
proposal with x_0' is taken with probability `min(1, (μ/ν)(x_0') / (μ/ν)(x_0))`, for then

    f(z) μ(x_0) h(z|x_0) · ν(x_0') h(z'|x_0') f(z') · min(1, μ(x_0')ν(x_0) / ν(x_0')μ(x_0))

is symmetric in (z, x_0) and (z', x_0'), h being the probability of a hit from x_0.
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
from ..engine.doors import door
from ..engine.keys import split_each
from ..engine.lanes import over_lanes, over_points
from ..engine.progress import metered_while_loop
from ..engine.rejection import Accepted, Search
from ..models.bridge_problem import BridgeProblem, Intervals
from ..models.diffusion import Diffusion
from ..proposals import Budget, CoupledPairs, as_pairs, as_proposal
from .kernels import Chain, Kernel, chain_keys, check_position, one_interval


class RenewalState(NamedTuple):
    """`position`, the path, shape (N+1, d); NaN where none was found."""

    position: Float[Array, "points d"]


class RenewalInfo(NamedTuple):
    """Of one step: whether the associated diffusion hit, whether the path was replaced, whether
    none was found to replace it, the number of paths simulated, and of those that left the
    finite numbers."""

    is_hit: Bool[Array, ""]
    is_accepted: Bool[Array, ""]
    is_missing: Bool[Array, ""]
    num_simulated: Int[Array, ""]
    num_nonfinite: Int[Array, ""]


@door
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

    @door
    def init(position, rng_key):
        check_key(rng_key)
        paths = check_position(position, problem)
        if paths is None:
            paths, *_ = first_paths(rng_key[None], *setting, num_steps)
        return RenewalState(paths[0])

    @door
    def step(rng_key, state):
        check_key(rng_key)
        return _renewal_step(rng_key, state, *setting)

    return Kernel(init, step)


@compiled_sooner
def _renewal_step(rng_key, state, model, pairs, intervals):
    everything = jnp.ones(1, bool)
    fixed = (model.prepared(), pairs, intervals, state.position)
    model, pairs, intervals, path = nondifferentiable(fixed)
    paths, info = renew(rng_key[None], model, pairs, intervals, path[None], everything)
    return RenewalState(paths[0]), jax.tree.map(lambda leaf: leaf[0], info)


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


class _Runner(NamedTuple):
    """What runs segments of the chains of a problem: all have one length, and as many are those of
    one interval. `first` are the paths from which the chains start, and `keys` those of the steps
    of each segment. The last steps of an interval's last segment may be too many: they repeat a
    key, and are dropped."""

    model: Diffusion
    pairs: CoupledPairs
    problem: BridgeProblem
    first: Float[Array, "I points d"]
    keys: Key[Array, "S L"]
    intervals: Intervals

    @property
    def head(self) -> Bool[Array, " S"]:
        """Which segments are the first of their interval."""
        num_segments = len(self.keys) // self.problem.num_intervals
        return jnp.arange(len(self.keys)) % num_segments == 0

    def begin(self) -> _Segments:
        """No steps, so that all are stale, and for each segment a guess of where the one before it
        ends."""
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
        """These segments, from where the ones before them end, until they rejoin what is recorded.
        Numbers beyond the last only fill the width."""
        num, length = self.keys.shape
        place = jnp.minimum(chosen, num - 1)
        intervals = jax.tree.map(lambda leaf: leaf[place], self.intervals)

        def going_on(state):
            i, _, active, _ = state
            return (i < length) & jnp.any(active)

        def one_step(state):
            i, positions, active, segments = state
            positions, info = renew(
                self.keys[place, i], self.model, self.pairs, intervals, positions, active
            )
            rejoined = info.is_accepted & segments.moved[i, place]
            row = jnp.where(active, chosen, num)
            kept = self.problem.kept(positions)
            segments = segments._replace(
                paths=segments.paths.at[i, row].set(kept, mode="drop"),
                moved=segments.moved.at[i, row].set(info.is_accepted, mode="drop"),
                num_simulated=segments.num_simulated.at[row].add(info.num_simulated, mode="drop"),
                num_nonfinite=segments.num_nonfinite.at[row].add(info.num_nonfinite, mode="drop"),
            )
            return i + 1, positions, active & ~rejoined, segments

        def progress(state):
            return state[0].astype(jnp.float32) / length

        state = (jnp.int32(0), self._entries(segments)[place], chosen < num, segments)
        state = metered_while_loop(going_on, one_step, state, progress, progress_meter)
        _, positions, changed, segments = state
        ends = segments.ends.at[jnp.where(changed, chosen, num)].set(positions, mode="drop")
        stale = segments.stale.at[chosen].set(False, mode="drop")
        after = jnp.where(changed, chosen + 1, num)
        stale = stale.at[after].set(True, mode="drop") & ~self.head
        return segments._replace(ends=ends, stale=stale)

    def repair(self, segments: _Segments) -> _Segments:
        """Some of the stale segments, run again."""
        num = len(self.keys)
        chosen = jnp.nonzero(segments.stale, size=min(_REPAIR_WIDTH, num), fill_value=num)[0]
        return self.run(segments, chosen)

    def _entries(self, segments: _Segments) -> Float[Array, "S points d"]:
        """Where each segment starts."""
        before = jnp.maximum(jnp.arange(len(self.keys)) - 1, 0)
        first = jnp.repeat(self.first, len(self.keys) // len(self.first), axis=0)
        return jnp.where(self.head[:, None, None], first, segments.ends[before])


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
    """Segments of the chain start from guesses, and are run again from where the segment before
    them ends until all fit. Two trajectories that take new paths in the same step take the same
    one, since a proposal depends on the key of its step only: from there on they are one, and
    the rest of the record holds. So a repair is short, and the result that of one long run.
    """
    fixed = (model.prepared(), pairs, problem, first)
    model, pairs, problem, first = nondifferentiable(fixed)
    intervals, num_steps, num_intervals = (
        problem.intervals,
        problem.num_steps,
        problem.num_intervals,
    )
    pairs = pairs.prepared(key, model, intervals, num_steps)
    step_keys, init_keys = chain_keys(key, problem, num_bridges)
    if first is None:
        begin, num_tried, num_failed = first_paths(init_keys, model, pairs, intervals, num_steps)
    else:
        begin, num_tried = first, jnp.zeros(num_intervals, jnp.int32)
        num_failed = num_tried
    most_segments = most_lanes(intervals.start.shape[1]) // 2 // num_intervals
    num_segments = max(1, min(num_bridges // _SHORTEST_SEGMENT, most_segments))
    length = -(-num_bridges // num_segments)
    steps = jnp.minimum(jnp.arange(num_segments * length), num_bridges - 1)
    keys = step_keys[:, steps].reshape(num_intervals * num_segments, length)
    each = jax.tree.map(lambda leaf: jnp.repeat(leaf, num_segments, axis=0), intervals)
    runner = _Runner(model, pairs, problem, begin, keys, each)
    segments = runner.begin()
    if len(keys) > _REPAIR_WIDTH or progress_meter is not None:
        segments = runner.run(segments, jnp.arange(len(keys)), progress_meter)
    # Few segments are all run by the first repair, so that a step is compiled once. The first that
    # is stale starts from where the chain is, so each pass settles it at least.
    segments = lax.while_loop(lambda s: jnp.any(s.stale), runner.repair, segments)

    def of_steps(leaf):
        leaf = jnp.moveaxis(leaf, 0, 1).reshape(num_intervals, -1, *leaf.shape[2:])
        return problem.result(leaf[:, :num_bridges])

    paths = of_steps(segments.paths)
    # D of the states in which segments end, all but the last, which may be too long.
    last = (steps == jnp.arange(len(steps))) & (jnp.arange(len(steps)) % length == length - 1)
    ends = pairs.log_halving(model, each, segments.ends, 1).reshape(num_intervals, -1, 1)
    log_halving = jnp.where(last.reshape(num_segments, -1), ends, jnp.nan)
    log_halving = log_halving.reshape(num_intervals, -1)[:, :num_bridges]
    # Nothing is counted, but no hit is what it should be if its trial did not start from μ.
    cut = run_is_cut(pairs.coupling.start_law, model, intervals.duration / num_steps, num_steps)
    return Chain(
        times=problem.times(pairs.fractions(num_steps)),
        paths=paths,
        accepted=of_steps(segments.moved),
        log_weights=None,
        met=jnp.all(jnp.isfinite(paths), axis=(-2, -1)),
        truncated=None,
        num_simulated=problem.total(segments.num_simulated) + problem.total(num_tried),
        num_nonfinite=problem.total(segments.num_nonfinite) + problem.total(num_failed),
        num_truncated=problem.total(jnp.where(cut, num_bridges, 0)),
        proposal=pairs,
        pareto_k=None,
        log_halving=problem.result(log_halving),
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
    """One renewal step of each of S chains that is active: hit first, propose only then."""
    num_steps = paths.shape[1] - 1
    trial_keys, propose_keys, accept_keys = split_each(keys, 3)
    dt = intervals.duration / num_steps
    lanes = jnp.moveaxis(paths, 0, -1)
    associated = run_associated(model, pairs.coupling, trial_keys, lanes, dt)
    missing = ~jnp.all(jnp.isfinite(paths), axis=(1, 2))
    called_for = active & (associated.hit | missing)
    proposed = propose_paths(propose_keys, model, pairs, intervals, called_for, num_steps)
    found = proposed.num_found > 0
    new_paths, new_start, _ = proposed.outputs

    def ratio(x):
        return log_ratio(pairs.coupling.start_law, model, x)

    log_rate = over_points(ratio)(new_start) - over_lanes(-1)(ratio)(associated.start)
    uniform = jax.vmap(lambda key: jax.random.uniform(key, dtype=paths.dtype))(accept_keys)
    accepted = found & (missing | (uniform < jnp.exp(jnp.minimum(log_rate, 0))))
    info = RenewalInfo(
        associated.hit & active,
        accepted,
        called_for & ~found,
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
    """A bridge by proposal for each interval; or for those that are active, which often are few."""
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
    """A bridge by proposal for each interval, NaN where none was found; how many proposals that
    took, and how many of them left the finite numbers."""
    proposed = propose_paths(keys, model.prepared(), pairs, intervals, None, num_steps)
    joined: Joined = proposed.outputs
    paths = jnp.where((proposed.num_found > 0)[:, None, None], joined.paths, jnp.nan)
    return paths, proposed.num_trials, proposed.num_nonfinite
