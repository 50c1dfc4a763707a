"""Guided proposals: chains of normal steps that end in b.

On a grid 0 = t_0 < ... < t_N = T with steps δ_i, the target is a chain (`step_density`) with steps

    x_{i+1} ~ N(μ_i, δ_i σ(x_i) S_i σ(x_i)ᵀ).

The Euler scheme has μ_i = x_i + α(x_i) δ_i and S = I. A proposal has steps of another normal law
q_i(x_{i+1}| x_i) with the same σ, and x_N = b. Its weight is the density of the path under the
target over its density under the proposal,

    w = p_{N-1}(b| x_{N-1}) Π_{i<N-1} p_i(x_{i+1}| x_i) / q_i(x_{i+1}| x_i).

Hence E[w h(x)] = p̂_T(a, b) E[h(x) | x_N = b], exactly for the target chain. For the diffusion the
discretisation error of the target remains: O(δ), or O(δ²) with `ItoTaylorDensity` and
`QuadraticDensity`. Guided proposals need no stationary law.

*Steps that are not normal.* If only weights are needed, the target of a state-dependent σ has steps
of weak order 2, which are maps of normal noise (`QuadraticDensity`). Then p_i and q_i are the laws
of the normal part of a step, and x_{i+1} is a function of that part (`StepLaw.bent`). The weight is
a ratio of densities of the noise, so this function needs no inverse. The end b needs a density of
x_N itself. There the last step is split, and its last part is an Euler step of about T/N².

*Discretisation error.* A path is a function of the noise ξ_i of its steps. Half as many steps with
other noise give another path. For a state-dependent σ, and if only weights are needed, the error is
estimated from pairs of such paths with strongly correlated noise. A coarse step replaces two fine
steps and has the noise

    ξ = c ξ_i + s ξ_{i+1},   c² = δ_i (T - t_{i+2}) / [(δ_i + δ_{i+1}) (T - t_{i+1})] = 1 - s².

With this choice a coarse Brownian bridge equals the fine one at every other point. The coarse
weight is unbiased for half as many steps, and its ratio to the fine weight varies much less than
e^D of `halving`.
"""

import math
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
    EulerDensity,
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
    """One step of one interval: argument of `step_law` of an `AbstractGuidedProposal`.

    - `guide`: the entry of `guide` for this step.
    - `dt`: δ_i, in units of time.
    - `remaining`: T - t_i, the time from the beginning of the step to the end of the interval.
    - `end`: b, shape (d,).
    """

    guide: PyTree
    dt: Float[Array, "*lanes"]
    remaining: Float[Array, "*lanes"]
    end: Float[Array, "d *lanes"]


class AbstractGuidedProposal(AbstractSingleProposal):
    """Base class of guided proposals, whose normal steps lead to the end point b.

    A subclass defines two methods: `guide` computes quantities before any path is simulated, and
    `step_law` returns the law of one step.

    - `density`: step density of the target. `None` stands for the most accurate one, which
        `for_model` selects.
    - `refinement`: ρ in t_i = T [1 - (1 - i/N)^ρ].
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
    def target_cost(self) -> float:
        """Seconds of a step of the target relative to a normal one, measured for d ≤ 3."""
        return 1.0 if self.target.is_normal else 2.5

    @property
    def efficiency_bound(self):
        return 1.0

    def ingredients(self):
        return type(self.target).__name__, "", np.nan

    def for_model(self, model, like, for_density=False):
        model.check_invertible_sigma(like)
        # One that is not normal was selected for a density, and serves nothing else.
        if self.density is not None and (for_density or self.density.is_normal):
            return self
        return self._with_density(
            most_accurate_density(model.sigma_varies(like), True, for_density)
        )

    def most_accurate(self, model, like, for_density=False):
        density = most_accurate_density(model.sigma_varies(like), True, for_density)
        if self.density is not None and self.density.order >= density.order:
            return self
        return self._with_density(density)

    def _with_density(self, density: AbstractStepDensity):
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
        """Return quantities for the steps, with leading axis N - 1, or `None`.

        `step_law` receives one entry per step as `step.guide`. `dt` has shape (N,).
        """

    @abstractmethod
    def step_law(self, step: Step, x: Float[Array, " d"], target: StepLaw) -> StepLaw:
        """Return the law of the proposal's step from x_i = `x`.

        `target` is the law of the target's step from `x`; the result has the same σ.
        """

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
        """Return (T - t_i) / T for all i, from 1 to 0, shape (N+1,)."""
        if num_steps**-self.refinement < _SHORTEST_STEP:
            raise ValueError(
                f"`refinement` = {self.refinement:g} makes the last of {num_steps} steps shorter "
                "than rounding errors of time: use a smaller `refinement` or fewer `num_steps`."
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
        unknown = jnp.full_like(log_halving, jnp.nan)
        logs = (leaf[:, None] for leaf in (log_weights, log_halving, unknown))
        made = _weighted(paths[:, None], *logs)
        return made if active is None else masked(made, active)


class _CoarseSteps(NamedTuple):
    """The step of half as many in which each step lies, whether it ends with it, and the share c of
    the earlier noise."""

    guide: PyTree
    dt: Float[Array, "*steps I"]
    remaining: Float[Array, "*steps I"]
    share: Float[Array, "*steps"]
    ends: Bool[Array, "*steps"]


class _Steps(NamedTuple):
    """What changes from step to step, for a scan: the fields of `Step`; the length of the step
    before, and whether the two are a pair; and the coarse step of both, if there are any."""

    guide: PyTree
    dt: Float[Array, "*steps I"]
    remaining: Float[Array, "*steps I"]
    before: Float[Array, "*steps I"]
    ends_pair: Bool[Array, "*steps"]
    coarse: _CoarseSteps | None


class _Weighted(NamedTuple):
    """The point where a path is, and its log densities so far under the target and under the
    proposal.

    The two are summed apart because XLA's CPU compiler (JAX 0.10.2) does not vectorise a sum in
    place that reads a slice of the loop's inputs, as the noise is, and the target's takes most of
    the work.
    """

    x: Float[Array, "d *lanes"]
    log_target: Float[Array, "*lanes"]
    log_proposal: Float[Array, "*lanes"]

    @property
    def log_weight(self) -> Float[Array, "*lanes"]:
        return self.log_target - self.log_proposal


class _State(NamedTuple):
    """Paths, and for some of them what their step error is estimated from: the point before and D
    of `halving` so far; or the noise before and the coarse path so far."""

    path: _Weighted
    before: Float[Array, "d *looked"]
    log_halving: Float[Array, "*looked"]
    coarse: _Weighted | None

    @property
    def x(self) -> Float[Array, "d *lanes"]:
        return self.path.x


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
        with_coarse: bool = False,
    ):
        start, end, _ = intervals
        fractions, coarse_points = _points(proposal, num_steps)
        guide, dt, remaining = _grid(proposal, dynamics, intervals, fractions)
        coarse, self._coarse_dt = None, None
        if with_coarse:
            arguments = (proposal, dynamics, intervals, fractions, coarse_points)
            coarse, self._coarse_dt = _coarse_grid(*arguments)
        num_steps = self.num_steps = len(fractions) - 1
        self._num_draws, self._num_steps = num_draws, num_steps
        self._num_looked = num_looked(num_draws, dynamics.sigma_varies)
        self._of_lane = None if start.shape[0] == 1 else -1
        self.start, self.end = start.T, end.T
        before, ends = jnp.roll(dt, 1, axis=0), jnp.arange(num_steps) % 2 == 1
        self.steps = _Steps(guide, dt[:-1], remaining[:-1], before[:-1], ends[:-1], coarse)
        self._last = _Steps(None, dt[-1], remaining[-1], before[-1], ends[-1], None)
        self._proposal, self._dynamics, self._density = proposal, dynamics, proposal.target
        # The end is observed exactly, so the last step needs a density of x'.
        self._closing = self._density if self._density.is_normal else EulerDensity()
        self._of_pairs = jax.jit(self._log_halving)  # traced once, for the loop and for its end

    def spread(self, leaf: Float[Array, "*shape I"]) -> Float[Array, "*shape lanes"]:
        """What belongs to an interval, for each of its lanes."""
        return jnp.repeat(leaf, self._num_draws, axis=-1)

    def begin(self) -> _State:
        """Paths at their start, with weight one."""
        start = self.spread(self.start)
        some, zero = self._looked(start), jnp.zeros_like(start[0])
        none = jnp.zeros_like(some[0])
        coarse = None if self._coarse_dt is None else _Weighted(some, none, none)
        return _State(_Weighted(start, zero, zero), some, none, coarse)

    def advance(self, state: _State, xi: Float[Array, "d lanes"], steps: _Steps) -> _State:
        """One step with the noise ξ, and the densities with their factors."""
        step = self._of_each(self._step(steps), self._num_draws)
        path = self._stepped(state.path, xi, step)
        if state.coarse is None:
            return self._moved(state, path, steps)
        here = self._looked(xi)
        coarse, coarse_steps = state.coarse, steps.coarse
        if coarse_steps is None:  # the coarse path is of one step, its last
            return state._replace(path=path)
        coarse = lax.cond(
            coarse_steps.ends,
            lambda: self._coarse_stepped(coarse, state.before, here, coarse_steps),
            lambda: coarse,
        )
        return _State(path, here, state.log_halving, coarse)

    def _stepped(self, path: _Weighted, xi: Float[Array, "d lanes"], step: Step) -> _Weighted:
        """Return paths after a step with this noise."""

        def one(x, xi, step):
            target = self._density.steps_from(self._dynamics, x).law(step.dt)
            law = self._proposal.step_law(step, x, target)
            point = law.point(xi)
            return target.bent(point), self._log_densities(target, law, point, xi)

        made = over_lanes(-1, -1, self._of_lane)(one)(path.x, xi, step)
        return self._weighted(path, *made)

    def _coarse_stepped(
        self,
        coarse: _Weighted,
        before: Float[Array, "d looked"],
        xi: Float[Array, "d looked"],
        steps: _CoarseSteps,
    ) -> _Weighted:
        """Return the coarse paths after a step with the noise of two fine ones."""
        xi = steps.share * before + jnp.sqrt(1 - steps.share**2) * xi
        step = Step(steps.guide, steps.dt, steps.remaining, self.end)
        stepped = self._stepped(coarse, xi, self._of_each(step, self._num_looked))
        return lax.stop_gradient(stepped)

    @staticmethod
    def _weighted(path: _Weighted, x_next, log_densities) -> _Weighted:
        target, proposal = log_densities
        return _Weighted(x_next, path.log_target + target, path.log_proposal + proposal)

    def retrace(
        self, state: _State, x_next: Float[Array, "d lanes"], steps: _Steps
    ) -> tuple[_State, Float[Array, "d lanes"]]:
        """The step to these points, and the noise ξ that it takes."""

        def one(x, x_next, step):
            target = self._density.steps_from(self._dynamics, x).law(step.dt)
            law = self._proposal.step_law(step, x, target)
            xi = law.noise(x_next)
            return xi, self._log_densities(target, law, x_next, xi)

        step = self._of_each(self._step(steps), self._num_draws)
        xi, log_densities = over_lanes(-1, -1, self._of_lane)(one)(state.x, x_next, step)
        return self._moved(state, self._weighted(state.path, x_next, log_densities), steps), xi

    def finish(self, state: _State) -> tuple[Float[Array, " lanes"], Float[Array, "I m"]]:
        """The log weights with that of the last step, to b; and of the paths that are looked at
        D, or the log weights of their coarse paths."""
        path = self._finished(state.path, self._last.dt, self._num_draws)
        if state.coarse is None or self._coarse_dt is None:
            state = self._moved(state, path, self._last)
            half = log_halving_of_all_steps(state.log_halving, self._num_steps)
        else:
            coarse = self._finished(state.coarse, self._coarse_dt, self._num_looked).log_weight
            half = lax.stop_gradient(jnp.where(jnp.isfinite(coarse), coarse, -jnp.inf))
        return path.log_weight, half.reshape(-1, self._num_looked)

    def _finished(self, path: _Weighted, dt: Float[Array, " I"], num_draws: int) -> _Weighted:
        """Return paths of so many lanes an interval after their last step, to b."""

        def one(x, last):
            # Steps may lead out of the state space, where no bridge ends.
            end, dt = last
            inside = all_finite(self._dynamics.drift(end))
            inside &= jnp.isfinite(self._dynamics.sigma(end).log_abs_det())
            log_density = self._closing.steps_from(self._dynamics, x).law(dt).log_density(end)
            return jnp.where(inside, log_density, jnp.nan)

        last = self._of_each((self.end, dt), num_draws)
        log_density = over_lanes(-1, self._of_lane)(one)(path.x, last)
        end = jnp.repeat(self.end, num_draws, axis=-1)
        return self._weighted(path, end, (log_density, jnp.zeros_like(log_density)))

    def _step(self, steps: _Steps) -> Step:
        return Step(steps.guide, steps.dt, steps.remaining, self.end)

    def _of_each(self, of_intervals: PyTree, num_draws: int) -> PyTree:
        """For each of so many lanes an interval; without an axis for a single interval, which all
        lanes share."""
        if self._of_lane is None:
            return jax.tree.map(lambda leaf: leaf[..., 0], of_intervals)
        return jax.tree.map(lambda leaf: jnp.repeat(leaf, num_draws, axis=-1), of_intervals)

    def _looked(self, leaf: Float[Array, "*shape lanes"]) -> Float[Array, "*shape looked"]:
        """The first paths of each interval, of which D is worked out."""
        leaf = leaf.reshape(*leaf.shape[:-1], -1, self._num_draws)[..., : self._num_looked]
        return leaf.reshape(*leaf.shape[:-2], -1)

    @staticmethod
    def _log_densities(target: StepLaw, law: StepLaw, point, xi):
        return target.log_relative(point), law.log_relative_of_noise(xi)

    def _moved(self, state: _State, path: _Weighted, steps: _Steps) -> _State:
        """The state with these paths, which are one step on, and their D."""
        here, there = self._looked(state.x), self._looked(path.x)
        change = lax.cond(
            steps.ends_pair,
            lambda: self._of_pairs(state.before, here, there, steps.before, steps.dt),
            lambda: jnp.zeros_like(state.log_halving),
        )
        return _State(path, here, state.log_halving + lax.stop_gradient(change), None)

    def _log_halving(self, before, x, x_next, *both):
        """The part of D of pairs of steps, of the paths that are looked at."""

        def one(before, x, x_next, *both):
            points = (before, x, x_next)
            return log_halving_of_pair(self._density, self._dynamics, points, both)

        both = self._of_each(both, self._num_looked)
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
    log_coarse: Float[Array, "I n"],
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
        log_coarse,
    )


class _Drawn(NamedTuple):
    """Paths, their log weights, and what their step error is estimated from (`WeightedPaths`),
    which has no derivatives."""

    paths: Float[Array, "I n K d"]
    log_weights: Float[Array, "I n"]
    log_halving: Float[Array, "I n"]
    log_coarse: Float[Array, "I n"]


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
) -> _Drawn:
    """One path for each key, and its log weights."""
    return _simulate(inputs, keys, stored, num_steps, None)


@_draw.def_jvp
def _draw_tangents(primals, tangents):
    """Paths that left the finite numbers have no derivatives. They are run without noise here, for
    in reverse mode a masked 0 · ∞ would be NaN."""
    inputs, keys, stored, num_steps = primals
    drawn = _draw(inputs, keys, stored, num_steps)
    found = jnp.isfinite(drawn.log_weights)

    def again(inputs):
        paths, log_weights, *_ = _simulate(inputs, keys, stored, num_steps, found)
        return jnp.where(found[..., None, None], paths, 0), jnp.where(found, log_weights, 0)

    _, along = eqx.filter_jvp(again, (inputs,), (tangents[0],))
    return drawn, _Drawn(*along, *map(jnp.zeros_like, drawn[2:]))


def _simulate(
    inputs: _Inputs,
    keys: Key[Array, "I n"],
    stored: Int[Array, " K"] | None,
    num_steps: int,
    noisy: Bool[Array, "I n"] | None,
) -> _Drawn:
    """Paths and their log weights; without noise where `noisy` is given and false."""
    proposal, model, intervals = inputs
    dynamics = model.forward(intervals.start[0])
    (num_intervals, num_draws), (_, d) = keys.shape, intervals.start.shape
    dtype = intervals.start.dtype
    # Half as many steps from the same noise are other paths, of no use where paths are wanted.
    only_weights = stored is not None and stored.shape[0] == 0
    with_coarse = only_weights and dynamics.sigma_varies and num_steps > 1
    lanes = _Lanes(proposal, dynamics, intervals, num_steps, num_draws, with_coarse)
    num_steps = lanes.num_steps
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
    unknown = jnp.full(keys.shape, jnp.nan, dtype)
    half = unknown.at[:, : some.shape[1]].set(some)
    halves = (unknown, half) if with_coarse else (half, unknown)
    if slots is None:
        path = jnp.concatenate([start[None], path, end[None]])
    else:
        path = path.at[slots[-1]].set(end)[:-1]
    path = path.reshape(-1, d, num_intervals, num_draws)
    return _Drawn(jnp.moveaxis(path, (2, 3), (0, 1)), log_weights, *halves)


def _grid(
    proposal: AbstractGuidedProposal,
    dynamics: Dynamics,
    intervals: Intervals,
    fractions: Float[np.ndarray, " points"],
) -> tuple[PyTree, Float[Array, "N I"], Float[Array, "N I"]]:
    """Return the guide, the lengths of steps, and the time that remains at each, on the grid of
    these fractions of the time that remains."""
    start, end, duration = intervals
    dt = jnp.asarray(-np.diff(fractions), start.dtype)[:, None] * duration
    remaining = jnp.asarray(fractions[:-1], start.dtype)[:, None] * duration
    guide = jax.vmap(proposal.guide, in_axes=(None, 0, 0, 1), out_axes=-1)
    return guide(dynamics, start, end, dt), dt, remaining


def _points(
    proposal: AbstractGuidedProposal, num_steps: int
) -> tuple[Float[np.ndarray, " points"], list[int]]:
    """Return the fractions of the time that remains, and which of them are points of the grid of
    half as many steps.

    The last step needs a normal law. If the others are not normal, it is of lower order, and is
    split into steps of ½, ¼, ..., 2^-k of its length, the last of which is about T / N².
    """
    fractions = proposal.remaining(num_steps)
    coarse = [*range(0, num_steps, 2)]
    if proposal.target.is_normal:
        return fractions, [*coarse, num_steps]
    num_splits = math.ceil(math.log2(num_steps)) if num_steps > 1 else 0
    splits = fractions[-2] * 0.5 ** np.arange(1, num_splits + 1)
    # The coarse grid splits its last step down to four times the length.
    shared = range(num_steps - 1, num_steps - 1 + max(num_splits - 1, 0))
    coarse = sorted({*coarse, *shared})
    return np.concatenate([fractions[:-1], splits, [0.0]]), [*coarse, num_steps + num_splits]


def _coarse_grid(
    proposal: AbstractGuidedProposal,
    dynamics: Dynamics,
    intervals: Intervals,
    fractions: Float[np.ndarray, " points"],
    points: list[int],
) -> tuple[_CoarseSteps | None, Float[Array, " I"]]:
    """Return the steps of half as many, each once for the two that it replaces (`None` if there is
    only the last), and the length of the last."""
    guide, dt, remaining = _grid(proposal, dynamics, intervals, fractions[points])
    num_inner = len(points) - 2
    if num_inner == 0:
        return None, dt[-1]
    first, last = np.array(points[:-2]), np.array(points[1:-1])
    before, middle, after = fractions[first], fractions[first + 1], fractions[last]
    is_pair = last - first == 2
    share = np.sqrt((before - middle) * after / ((before - after) * middle)) * is_pair
    number = np.arange(len(fractions) - 2)
    which = np.minimum(np.searchsorted(last, number + 1), num_inner - 1)
    ends = np.isin(number + 1, last)
    each = (guide, dt[:-1], remaining[:-1], jnp.asarray(share, dt.dtype))
    guide, dt_inner, remaining, share = jax.tree.map(lambda leaf: leaf[which], each)
    return _CoarseSteps(guide, dt_inner, remaining, share, jnp.asarray(ends)), dt[-1]


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
            f"`refinement` must be a Python number, because it is static under `jit`; got "
            f"{refinement!r}."
        )
    if not 1 <= refinement <= 4:
        raise ValueError(f"`refinement` must be between 1 (equal steps) and 4; got {refinement}.")
    return float(refinement)


def as_guided(proposal: AbstractProposal) -> AbstractGuidedProposal:
    """The proposal itself, if it makes paths from normal noise."""
    if not isinstance(proposal, AbstractGuidedProposal):
        raise TypeError(
            "Crank–Nicolson moves need a `proposal` that makes paths from normal noise: pass "
            "`ModifiedDiffusionBridge()`, `ResidualBridge()` or `Guided()`; got "
            f"{proposal.describe()}."
        )
    return proposal
