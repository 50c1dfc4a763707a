"""Proposals that are pulled to the end point: a chain of normal steps with bent noise.

On a grid 0 = t_0 < ... < t_N = T with steps δ_i the target is a chain (`step_density`) of steps

    x_{i+1} ~ N(μ_i, δ_i σ(x_i) S_i σ(x_i)ᵀ);

the Euler scheme has μ_i = x_i + α(x_i) δ_i and S = I. A proposal goes steps of another normal law
q_i(x_{i+1}| x_i) with the same σ, and x_N = b. Its weight is the density of the path under the
target over that under the proposal,

    w = p_{N-1}(b| x_{N-1}) Π_{i<N-1} p_i(x_{i+1}| x_i) / q_i(x_{i+1}| x_i),

so E[w h(x)] = p̂_T(a, b) E[h(x) | x_N = b] for the target without any further error, and for the
diffusion up to the target's step error, O(δ), or O(δ²) by `ItoTaylorDensity`. No stationary law is
called for.
"""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.batch_size import most_lanes
from ..engine.devices import num_devices
from ..engine.lanes import join_rows, over_lanes, split_rows
from ..engine.linalg import all_finite
from ..engine.noise import Store, noisy_scan
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from ..models.dynamics import Dynamics
from ..schemes import (
    AbstractStepDensity,
    Euler,
    StepLaw,
    check_model,
    log_halving_of_all_steps,
    log_halving_of_pair,
    most_accurate_density,
    num_looked,
    share_of_order,
)
from .base import AbstractProposal, AbstractSingleProposal, WeightedPaths
from .memory_blocks import block_over_devices, in_blocks, masked

# Of the duration: shorter steps are lost in the rounding of points.
_SHORTEST_STEP = 1e-10


class Step(NamedTuple):
    """One step of one interval, as `step_law` of an `AbstractGuidedProposal` sees it.

    - `guide`: what the proposal worked out for the step.
    - `dt`: its length δ_i, in units of time.
    - `remaining`: T - t_i, the time from its beginning to the end.
    - `end`: b, shape (d,).
    """

    guide: PyTree
    dt: Float[Array, "*lanes"]
    remaining: Float[Array, "*lanes"]
    end: Float[Array, "d *lanes"]


class AbstractGuidedProposal(AbstractSingleProposal):
    """Paths in steps as the target's, but pulled so that they end in b.

    A proposal is another law of each step, `step_law`, and what can be worked out for it before
    any path is simulated, `guide`. `density` is that of the target's steps, `None` until the model
    is known (`for_model`) if the most accurate is wanted, and `refinement` is ρ in
    t_i = T [1 - (1 - i/N)^ρ].
    """

    density: eqx.AbstractVar[AbstractStepDensity | None]
    refinement: eqx.AbstractVar[float]

    @property
    def by_coupling(self):
        return None

    @property
    def target(self) -> AbstractStepDensity:
        assert self.density is not None  # decided by `for_model`
        return self.density

    @property
    def efficiency_bound(self):
        return 1.0

    def ingredients(self):
        return type(self.target).__name__, "", np.nan

    def for_model(self, model, like):
        model.check_invertible_sigma(like)
        return self if self.density is not None else self.most_accurate(model, like)

    def most_accurate(self, model, like):
        density = most_accurate_density(model.sigma_varies(like))
        if self.density is not None and self.density.order >= density.order:
            return self
        is_density = lambda leaf: leaf is None or isinstance(leaf, AbstractStepDensity)
        return eqx.tree_at(lambda p: p.density, self, density, is_leaf=is_density)

    def for_pilot(self):
        return self

    def check_size(self, model):
        pass

    def must_measure(self, model):
        return False

    @abstractmethod
    def guide(
        self,
        dynamics: Dynamics,
        start: Float[Array, " d"],
        end: Float[Array, " d"],
        dt: Float[Array, " N"],
    ) -> PyTree:
        """Anything with leading axis N - 1, of which `step_law` sees one entry per step."""

    @abstractmethod
    def step_law(self, step: Step, x: Float[Array, " d"], target: StepLaw) -> StepLaw:
        """The law of the proposal's step from x_i = x, with the same σ, given the target's."""

    def check(self, model, intervals):
        check_model(model, intervals, Euler())

    def check_prepared(self, model):
        pass

    def prepared(self, key, model, intervals, num_steps):
        return self

    def fractions(self, num_steps):
        return 1 - self.remaining(num_steps)

    def step_share(self, model, intervals):
        return jnp.full_like(intervals.duration, share_of_order(self.target.order))

    def remaining(self, num_steps: int) -> Float[np.ndarray, " points"]:
        """(T - t_i) / T, down to zero."""
        if num_steps**-self.refinement < _SHORTEST_STEP:
            raise ValueError(
                f"`refinement` = {self.refinement:g} makes the last of {num_steps} steps too short "
                "to be told from none: choose a smaller one."
            )
        return (1 - np.arange(num_steps + 1) / num_steps) ** self.refinement

    def draw(
        self,
        keys,
        model,
        intervals,
        num_steps,
        stored,
        misses_count,
        active=None,
        progress_meter=None,
    ):
        block = block_over_devices(eqx.Partial(_draw_block, self, model, stored, num_steps))
        rows = num_devices() * most_lanes(intervals.start.shape[1])
        return in_blocks(block, keys, intervals, rows, active, progress_meter)

    def reweigh(self, keys, model, intervals, paths, active=None):
        dynamics = model.forward(intervals.start[0])
        _, log_weights, log_halving = noise_of(self, dynamics, intervals, paths)
        made = _weighted(paths[:, None], log_weights[:, None], log_halving[:, None])
        return made if active is None else masked(made, active)


class _Steps(NamedTuple):
    """What changes from step to step, for a scan: the fields of `Step`; and for `halving` the
    length of the step before, and whether the two are a pair."""

    guide: PyTree
    dt: Float[Array, "*steps I"]
    remaining: Float[Array, "*steps I"]
    before: Float[Array, "*steps I"]
    ends_pair: Bool[Array, "*steps"]


class _State(NamedTuple):
    """The point where a path is, and its log densities so far under the target and under the
    proposal; for some of the paths the point before, and D of `halving` so far.

    The two are summed apart because XLA's CPU compiler (JAX 0.10.2) does not vectorise a sum in
    place that reads a slice of the loop's inputs, as the noise is, and the target's takes most of
    the work.
    """

    x: Float[Array, "d *lanes"]
    log_target: Float[Array, "*lanes"]
    log_proposal: Float[Array, "*lanes"]
    before: Float[Array, "d *looked"]
    log_halving: Float[Array, "*looked"]


class _Lanes:
    """The steps of a proposal for n paths of each of I intervals, side by side: I n lanes. What
    belongs to a single interval is worked out once and shared by its paths."""

    def __init__(
        self,
        proposal: AbstractGuidedProposal,
        dynamics: Dynamics,
        intervals: Intervals,
        num_steps: int,
        num_draws: int = 1,
    ):
        start, end, duration = intervals
        fractions = proposal.remaining(num_steps)
        dt = jnp.asarray(-np.diff(fractions), start.dtype)[:, None] * duration
        remaining = jnp.asarray(fractions[:-1], start.dtype)[:, None] * duration
        guide = jax.vmap(proposal.guide, in_axes=(None, 0, 0, 1), out_axes=-1)(
            dynamics, start, end, dt
        )
        self._num_draws, self._num_steps = num_draws, num_steps
        self._num_looked = num_looked(num_draws, dynamics.sigma_varies)
        self._of_lane = None if start.shape[0] == 1 else -1
        self.start, self.end = start.T, end.T
        each = (dt, remaining, jnp.roll(dt, 1, axis=0), jnp.arange(num_steps) % 2 == 1)
        self.steps = _Steps(guide, *jax.tree.map(lambda leaf: leaf[:-1], each))
        self._last = _Steps(None, *jax.tree.map(lambda leaf: leaf[-1], each))
        self._proposal, self._dynamics, self._density = proposal, dynamics, proposal.target
        self._of_pairs = jax.jit(self._log_halving)  # traced once, for the loop and for its end

    def spread(self, leaf: Float[Array, "*shape I"]) -> Float[Array, "*shape lanes"]:
        """What belongs to an interval, for each of its lanes."""
        return jnp.repeat(leaf, self._num_draws, axis=-1)

    def begin(self) -> _State:
        """Paths at their start, with weight one."""
        start = self.spread(self.start)
        some, zero = self._looked(start), jnp.zeros_like(start[0])
        return _State(start, zero, zero, some, jnp.zeros_like(some[0]))

    def advance(self, state: _State, xi: Float[Array, "d lanes"], steps: _Steps) -> _State:
        """One step with the noise ξ, and the densities with their factors."""

        def one(state, xi, step):
            steps = self._density.steps_from(self._dynamics, state.x)
            target = steps.law(step.dt)
            law = self._proposal.step_law(step, state.x, target)
            x_next = law.point(xi)
            return x_next, self._log_densities(target, law, x_next, xi)

        each = (-1, -1, self._of_lane)
        x_next, log_densities = over_lanes(*each)(one)(state, xi, self._of_each(self._step(steps)))
        return self._moved(state, x_next, log_densities, steps)

    def retrace(
        self, state: _State, x_next: Float[Array, "d lanes"], steps: _Steps
    ) -> tuple[_State, Float[Array, "d lanes"]]:
        """The step to these points, and the noise ξ that it takes."""

        def one(state, x_next, step):
            steps = self._density.steps_from(self._dynamics, state.x)
            target = steps.law(step.dt)
            law = self._proposal.step_law(step, state.x, target)
            xi = law.noise(x_next)
            return xi, self._log_densities(target, law, x_next, xi)

        each = (-1, -1, self._of_lane)
        xi, log_densities = over_lanes(*each)(one)(state, x_next, self._of_each(self._step(steps)))
        return self._moved(state, x_next, log_densities, steps), xi

    def finish(self, state: _State) -> tuple[Float[Array, " lanes"], Float[Array, "I m"]]:
        """The log weights with that of the last step, to b, and D of the paths that are looked
        at."""

        def one(x, last):
            # Steps may lead out of the state space, where no bridge ends.
            end, dt = last
            inside = all_finite(self._dynamics.drift(end))
            inside &= jnp.isfinite(self._dynamics.sigma(end).log_abs_det())
            log_density = self._density.steps_from(self._dynamics, x).law(dt).log_density(end)
            return jnp.where(inside, log_density, jnp.nan)

        last = self._of_each((self.end, self._last.dt))
        log_density = over_lanes(-1, self._of_lane)(one)(state.x, last)
        end = self.spread(self.end)
        state = self._moved(state, end, (log_density, jnp.zeros_like(log_density)), self._last)
        log_halving = log_halving_of_all_steps(state.log_halving, self._num_steps)
        log_weights = state.log_target - state.log_proposal
        return log_weights, log_halving.reshape(-1, self._num_looked)

    def _step(self, steps: _Steps) -> Step:
        return Step(steps.guide, steps.dt, steps.remaining, self.end)

    def _of_each(self, of_intervals: PyTree) -> PyTree:
        """For each lane; without an axis for a single interval, which all lanes share."""
        if self._of_lane is None:
            return jax.tree.map(lambda leaf: leaf[..., 0], of_intervals)
        return jax.tree.map(self.spread, of_intervals)

    def _looked(self, leaf: Float[Array, "*shape lanes"]) -> Float[Array, "*shape looked"]:
        """The first paths of each interval, of which D is worked out."""
        leaf = leaf.reshape(*leaf.shape[:-1], -1, self._num_draws)[..., : self._num_looked]
        return leaf.reshape(*leaf.shape[:-2], -1)

    @staticmethod
    def _log_densities(target: StepLaw, law: StepLaw, point, xi):
        return target.log_relative(point), law.log_relative_of_noise(xi)

    def _moved(self, state: _State, x_next, log_densities, steps: _Steps) -> _State:
        """The state at x_next, given the log densities of the step."""
        here, there = self._looked(state.x), self._looked(x_next)
        change = lax.cond(
            steps.ends_pair,
            lambda: self._of_pairs(state.before, here, there, steps.before, steps.dt),
            lambda: jnp.zeros_like(state.log_halving),
        )
        log_halving = state.log_halving + lax.stop_gradient(change)
        target, proposal = log_densities
        sums = state.log_target + target, state.log_proposal + proposal
        return _State(x_next, *sums, here, log_halving)

    def _log_halving(self, before, x, x_next, *both):
        """The part of D of pairs of steps, of the paths that are looked at."""

        def one(before, x, x_next, *both):
            points = (before, x, x_next)
            return log_halving_of_pair(self._density, self._dynamics, points, both)

        if self._of_lane is None:
            both = self._of_each(both)
        else:
            both = [jnp.repeat(dt, self._num_looked) for dt in both]
        each = (-1, -1, -1, self._of_lane, self._of_lane)
        return over_lanes(*each)(one)(before, x, x_next, *both)


def noise_of(
    proposal: AbstractGuidedProposal,
    dynamics: Dynamics,
    intervals: Intervals,
    paths: Float[Array, "I points d"],
) -> tuple[Float[Array, "I steps d"], Float[Array, " I"], Float[Array, " I"]]:
    """The noise ξ_0, ..., ξ_{N-2} from which the proposal makes these paths, one for each
    interval, their log weights, and D."""
    lanes = _Lanes(proposal, dynamics, intervals, paths.shape[1] - 1)

    def each(state, inputs):
        x_next, steps = join_rows(inputs)
        state, xi = lanes.retrace(join_rows(state), x_next, steps)
        return split_rows(state), split_rows(xi)

    inputs = split_rows((jnp.moveaxis(paths, 0, -1)[1:-1], lanes.steps), axis=1)
    state, xi = lax.scan(each, split_rows(lanes.begin()), inputs)
    return jnp.moveaxis(join_rows(xi, axis=1), -1, 0), *_flat(lanes.finish(join_rows(state)))


def path_of(
    proposal: AbstractGuidedProposal,
    dynamics: Dynamics,
    intervals: Intervals,
    xi: Float[Array, "I steps d"],
) -> tuple[Float[Array, "I points d"], Float[Array, " I"], Float[Array, " I"]]:
    """The paths that the proposal makes from this noise, their log weights, and D: the inverse of
    `noise_of`."""
    lanes = _Lanes(proposal, dynamics, intervals, xi.shape[1] + 1)

    def each(state, inputs):
        state = lanes.advance(join_rows(state), *join_rows(inputs))
        return split_rows(state), split_rows(state.x)

    inputs = split_rows((jnp.moveaxis(xi, 0, -1), lanes.steps), axis=1)
    state, path = lax.scan(each, split_rows(lanes.begin()), inputs)
    path = jnp.concatenate([lanes.start[None], join_rows(path, axis=1), lanes.end[None]])
    return jnp.moveaxis(path, -1, 0), *_flat(lanes.finish(join_rows(state)))


def _flat(finished: tuple[Array, Array]) -> tuple[Float[Array, " I"], Float[Array, " I"]]:
    """Of one path for each interval."""
    log_weights, log_halving = finished
    return log_weights, log_halving[:, 0]


def _weighted(
    paths: Float[Array, "I n K d"],
    log_weights: Float[Array, "I n"],
    log_halving: Float[Array, "I n"],
) -> WeightedPaths:
    """One simulated path each; those that left the finite numbers are not found."""
    found = jnp.isfinite(log_weights)
    return WeightedPaths(
        jnp.where(found[..., None, None], paths, jnp.nan),
        jnp.where(found, log_weights, -jnp.inf),
        found,
        jnp.zeros_like(found),
        jnp.ones(found.shape, jnp.int32),
        (~found).astype(jnp.int32),
        log_halving,
    )


class _Inputs(NamedTuple):
    """Everything that paths and weights may be differentiated with respect to."""

    proposal: AbstractGuidedProposal
    model: Diffusion
    intervals: Intervals


def _draw_block(
    proposal: AbstractGuidedProposal,
    model: Diffusion,
    stored: Int[Array, " K"] | None,
    num_steps: int,
    keys: Key[Array, "I n"],
    intervals: Intervals,
    active: Bool[Array, " I"] | None,
) -> WeightedPaths:
    return _weighted(*_draw(_Inputs(proposal, model, intervals), keys, stored, num_steps))


@eqx.filter_custom_jvp
def _draw(
    inputs: _Inputs, keys: Key[Array, "I n"], stored: Int[Array, " K"] | None, num_steps: int
) -> tuple[Float[Array, "I n K d"], Float[Array, "I n"], Float[Array, "I n"]]:
    """One path for each key, its log weight, and D, which has no derivatives."""
    return _simulate(inputs, keys, stored, num_steps, None)


@_draw.def_jvp
def _draw_tangents(primals, tangents):
    """Paths that left the finite numbers have no derivatives. They are run without noise here, for
    in reverse mode a masked 0 · ∞ would be NaN."""
    inputs, keys, stored, num_steps = primals
    drawn = _draw(inputs, keys, stored, num_steps)
    found = jnp.isfinite(drawn[1])

    def again(inputs):
        paths, log_weights, _ = _simulate(inputs, keys, stored, num_steps, found)
        return jnp.where(found[..., None, None], paths, 0), jnp.where(found, log_weights, 0)

    _, along = eqx.filter_jvp(again, (inputs,), (tangents[0],))
    return drawn, (*along, jnp.zeros_like(drawn[2]))


def _simulate(
    inputs: _Inputs,
    keys: Key[Array, "I n"],
    stored: Int[Array, " K"] | None,
    num_steps: int,
    noisy: Bool[Array, "I n"] | None,
) -> tuple[Float[Array, "I n K d"], Float[Array, "I n"], Float[Array, "I n"]]:
    """Paths, log weights and D; without noise where `noisy` is given and false."""
    proposal, model, intervals = inputs
    dynamics = model.forward(intervals.start[0])
    (num_intervals, num_draws), (_, d) = keys.shape, intervals.start.shape
    dtype = intervals.start.dtype
    lanes = _Lanes(proposal, dynamics, intervals, num_steps, num_draws)
    state, end = lanes.begin(), lanes.spread(lanes.end)
    path = state.x[None][:0]
    store = slots = None
    if stored is not None:
        # Row K is for waste; rows of the first and the last step are filled by hand.
        rows = jnp.broadcast_to(state.x, (stored.shape[0] + 1, *state.x.shape))
        slots = jnp.full(num_steps + 1, stored.shape[0]).at[stored].set(jnp.arange(len(stored)))
        store = Store(slots[1:-1], rows)
    start = state.x
    if num_steps > 1:

        def step(state, inputs):
            xi, steps = inputs
            xi = xi if noisy is None else jnp.where(noisy.reshape(-1), xi, 0)
            state = lanes.advance(state, xi, steps)
            return state, state.x

        state, path = noisy_scan(
            step,
            state,
            keys.reshape(-1),
            lambda key, k: jax.random.normal(key, (k, d), dtype),
            lanes.steps,
            num_steps - 1,
            store=store,
        )
    elif store is not None:
        path = store.rows
    log_weights, some = lanes.finish(state)
    log_weights = log_weights.reshape(keys.shape)
    unseen = jnp.full((num_intervals, num_draws - some.shape[1]), jnp.nan, dtype)
    log_halving = jnp.concatenate([some, unseen], axis=1)
    if slots is None:
        path = jnp.concatenate([start[None], path, end[None]])
    else:
        path = path.at[slots[-1]].set(end)[:-1]
    path = path.reshape(-1, d, num_intervals, num_draws)
    return jnp.moveaxis(path, (2, 3), (0, 1)), log_weights, log_halving


def deterministic_path(
    density: AbstractStepDensity,
    dynamics: Dynamics,
    start: Float[Array, " d"],
    dt: Float[Array, " N"],
) -> tuple[Float[Array, "N d"], Float[Array, " d"]]:
    """ξ_0, ..., ξ_{N-1} and ξ_N of the target's steps from the start, without noise."""

    def step(xi, dt):
        return density.steps_from(dynamics, xi).law(dt).mean, xi

    end, path = lax.scan(step, start, dt)
    return path, end


def bridge_law(step: Step, target: StepLaw, mean: Float[Array, " d"]) -> StepLaw:
    """With this mean and the covariance V δ (T - t_{i+1})/(T - t_i)."""
    shrunk = (step.remaining - step.dt) / step.remaining
    return target._replace(mean=mean, covariance=shrunk)


def check_refinement(refinement: float) -> float:
    if isinstance(refinement, bool) or not isinstance(refinement, int | float):
        raise TypeError(
            f"`refinement` must be a Python number, known when compiling; got {refinement!r}."
        )
    if not 1 <= refinement <= 4:
        raise ValueError(f"`refinement` must be between 1 (equal steps) and 4; got {refinement}.")
    return float(refinement)


def as_guided(proposal: AbstractProposal) -> AbstractGuidedProposal:
    """The proposal itself, if it makes paths from normal noise."""
    if not isinstance(proposal, AbstractGuidedProposal):
        raise TypeError(
            "Crank–Nicolson moves are for a `proposal` that makes paths from normal noise: "
            "`ModifiedDiffusionBridge()`, `ResidualBridge()` or `Guided()`."
        )
    return proposal
