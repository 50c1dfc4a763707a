"""Guided proposals: chains with normal noise that end in b.

On a grid 0 = t_0 < ... < t_N = T with steps δ_i, the target is a chain (`step_density`) with steps

    x_{i+1} ~ N(μ_i, δ_i σ(x_i) S_i σ(x_i)ᵀ).

The Euler scheme has μ_i = x_i + α(x_i) δ_i and S = I. Let p_i(x_{i+1}| x_i) be the densities of
these steps. A proposal has steps of another normal law q_i(x_{i+1}| x_i) with the same σ, and
x_N = b. Its weight is the density of the path under the target over its density under the proposal,

    w = p_{N-1}(b| x_{N-1}) Π_{i<N-1} p_i(x_{i+1}| x_i) / q_i(x_{i+1}| x_i).

Hence E[w h(x)] = p̂_T(a, b) E[h(x) | x_N = b], exactly for the target chain. For the diffusion the
discretisation error of the target remains: O(δ), or O(δ²) with `ItoTaylorDensity` and
`QuadraticDensity`; for linear models there is none. Guided proposals need no stationary law.

*Steps that are not normal.* The target of a state-dependent σ has steps of weak order 2, which are
maps of normal noise (`QuadraticDensity`). Then p_i and q_i are the laws of the normal part of a
step, and x_{i+1} is a function of that part (`StepLaw.bent`). The weight is a ratio of densities of
the noise, so this function needs no inverse. If the noise of a given path is needed, the target is
the Euler scheme instead. The end b requires a density of x_N itself. So the last step is split, and
its last part is an Euler step of about T/N². Points within the last step are not part of a path.

*Discretisation error.* A path is a function of the noise ξ_i of its steps. Half as many steps with
other noise give another path. For a state-dependent σ the error is estimated from pairs of such
paths with strongly correlated noise. A coarse step replaces two fine steps and has the noise

    ξ = c ξ_i + s ξ_{i+1},   c² = δ_i (T - t_{i+2}) / [(δ_i + δ_{i+1}) (T - t_{i+1})] = 1 - s².

With this choice a coarse Brownian bridge equals the fine one at every other point. The coarse
weight is unbiased for half as many steps, and its ratio to the fine weight varies much less than
e^D of `halving`. For means of functions of paths, the coarse path has all points of the fine grid:
between two of its own points, its distance to the fine path is constant.
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
from ..models.linear import LinearTransition
from ..schemes import (
    AbstractStepDensity,
    Euler,
    EulerDensity,
    StepLaw,
    check_model,
    known_transition,
    log_halving_of_all_steps,
    log_halving_of_pair,
    most_accurate_density,
    num_looked,
    num_splits,
    remaining_after_splits,
    share_of_order,
    with_transition,
)
from .base import AbstractProposal, AbstractSingleProposal, WeightedPaths
from .memory_blocks import block_over_devices, in_blocks, masked

# Share of the duration. Shorter steps change points by less than their rounding errors.
_SHORTEST_STEP = 1e-10
# Path steps of a block if a progress meter is given: about a second.
_STEPS_BETWEEN_REPORTS = 20_000_000


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
        assert self.density is not None  # set by `for_model`
        return self.density

    @property
    def target_cost(self) -> float:
        """Return the seconds of a step of the target relative to an Euler step."""
        return self.target.cost

    @property
    def efficiency_bound(self):
        return 1.0

    def ingredients(self):
        return type(self.target).__name__, "", np.nan

    def for_model(self, model, like, normal_steps=True):
        model.check_invertible_sigma(like)
        if self.density is not None and (self.density.is_normal or not normal_steps):
            return self
        return self._with_density(most_accurate_density(model, like, normal_steps))

    def most_accurate(self, model, like):
        density = most_accurate_density(model, like, normal_steps=False)
        if self.density is not None and self.density.order >= density.order:
            return self
        return self._with_density(density)

    def _with_density(self, density: AbstractStepDensity):
        is_density = lambda leaf: leaf is None or isinstance(leaf, AbstractStepDensity)
        return eqx.tree_at(lambda p: p.density, self, density, is_leaf=is_density)

    def for_pilot(self):
        return self  # the work per path is fixed, so it needs no tighter bound

    def check_size(self, model):
        pass

    def must_measure(self, model):
        return False  # `guide` needs no simulation

    @abstractmethod
    def guide(
        self,
        dynamics: Dynamics,
        start: Float[Array, " d"],
        end: Float[Array, " d"],
        dt: Float[Array, " N"],
    ) -> PyTree:
        """Return quantities for the first N - 1 steps, with leading axis N - 1, or `None`.

        `step_law` receives one entry per step as `step.guide`. `dt` are the lengths of all N steps.
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
        return jnp.full_like(intervals.duration, share_of_order(self.target.usual_order))

    def remaining(self, num_steps: int) -> Float[np.ndarray, " points"]:
        """Return (T - t_i) / T for i = 0, ..., N = `num_steps`, from 1 to 0, shape (N+1,).

        **Raises:** `ValueError` if the last step is shorter than rounding errors of time.
        """
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
        if progress_meter is not None:
            # Progress is reported, and Ctrl-C looked for, between blocks.
            rows = min(rows, max(_STEPS_BETWEEN_REPORTS // num_steps, 1))
        return in_blocks(block, keys, intervals, rows, active, progress_meter)

    def reweigh(self, keys, model, intervals, paths, active=None):
        dynamics = model.forward(intervals.start[0])
        _, log_weights, log_halving = noise_of(self, dynamics, intervals, paths)
        unknown = jnp.full_like(log_halving, jnp.nan)
        logs = (leaf[:, None] for leaf in (log_weights, log_halving, unknown))
        weighted = _as_weighted_paths(paths[:, None], *logs)
        return weighted if active is None else masked(weighted, active)


class _CoarseSteps(NamedTuple):
    """Coarse steps: for each fine step, the coarse step that contains it.

    - `guide`, `dt`, `remaining`: the fields of `Step` for the coarse step.
    - `share`: c, the coefficient of the earlier noise ξ_i (module docstring).
    - `ends`: whether the coarse step ends with this fine step.
    """

    guide: PyTree
    dt: Float[Array, "*steps I"]
    remaining: Float[Array, "*steps I"]
    share: Float[Array, "*steps"]
    ends: Bool[Array, "*steps"]


class _Steps(NamedTuple):
    """Inputs of a scan over steps.

    - `guide`, `dt`, `remaining`: the fields of `Step`.
    - `transition`: the known transition of the target's step; `None` if it is unknown.
    - `before`: the length of the previous step.
    - `ends_pair`: whether the previous step and this one are a pair of `halving`.
    - `coarse`: the coarse steps; `None` if none are simulated.
    """

    guide: PyTree
    dt: Float[Array, "*steps I"]
    remaining: Float[Array, "*steps I"]
    transition: LinearTransition | None
    before: Float[Array, "*steps I"]
    ends_pair: Bool[Array, "*steps"]
    coarse: _CoarseSteps | None


class _PathWeights(NamedTuple):
    """Current points of paths, with their log densities so far under target and proposal.

    The two densities have separate sums for speed. XLA's CPU compiler (JAX 0.10.2) does not
    vectorise an in-place sum that reads a slice of the loop's inputs. The density of the proposal
    reads the noise, which is such a slice. The density of the target takes most of the work.
    """

    x: Float[Array, "d *lanes"]
    log_target: Float[Array, "*lanes"]
    log_proposal: Float[Array, "*lanes"]

    @property
    def log_weight(self) -> Float[Array, "*lanes"]:
        return self.log_target - self.log_proposal


class _LaneState(NamedTuple):
    """State of all lanes.

    The fields after `path` are for the estimate of discretisation errors. They have lanes for the
    first few paths of each interval only.

    - `path`: the paths.
    - `before`: the previous point, or the previous noise if there are coarse paths.
    - `log_halving`: D of `halving` so far.
    - `coarse`: coarse paths so far; `None` if none are simulated.
    - `gap`: distance from the paths to the coarse paths, at their last common point; `None` if
        coarse paths are not stored.
    """

    path: _PathWeights
    before: Float[Array, "d *looked"]
    log_halving: Float[Array, "*evaluated"]
    coarse: _PathWeights | None
    gap: Float[Array, "d *evaluated"] | None

    @property
    def x(self) -> Float[Array, "d *lanes"]:
        return self.path.x


class _GuidedLanes:
    """Steps of a proposal in I n lanes, for n paths of each of I intervals.

    Quantities of an interval are computed once and shared by its paths.
    """

    def __init__(
        self,
        proposal: AbstractGuidedProposal,
        dynamics: Dynamics,
        intervals: Intervals,
        num_steps: int,
        num_draws: int = 1,
        with_coarse: bool = False,
        stores_coarse: bool = False,
    ):
        start, end, _ = intervals
        fractions, coarse_points = _fractions(proposal, num_steps)
        guide, dt, remaining = _grid(proposal, dynamics, intervals, fractions)
        coarse, self._coarse_dt = None, None
        if with_coarse:
            arguments = (proposal, dynamics, intervals, fractions, coarse_points)
            coarse, self._coarse_dt = _coarse_grid(*arguments)
        # Only stored coarse paths need all points of the fine grid.
        self._stores_coarse = stores_coarse
        num_steps = self.num_steps = len(fractions) - 1
        self._num_draws, self._num_steps = num_draws, num_steps
        self._num_evaluated = num_looked(num_draws, dynamics.sigma_varies)
        # A single interval needs no axis of lanes, because all lanes share its values.
        self._lane_axis = None if start.shape[0] == 1 else -1
        self.start, self.end = start.T, end.T
        self._proposal, self._dynamics, self._density = proposal, dynamics, proposal.target
        # Pairs of `halving` are the steps (0, 1), (2, 3), ...
        before, ends = jnp.roll(dt, 1, axis=0), jnp.arange(num_steps) % 2 == 1
        # The end is observed exactly, so the last step needs a density of x'.
        self._closing = proposal.target if proposal.target.is_normal else EulerDensity()
        transition = self._transitions(dt)
        inner = dt[:-1], remaining[:-1], jax.tree.map(lambda leaf: leaf[:-1], transition)
        last = dt[-1], remaining[-1], jax.tree.map(lambda leaf: leaf[-1], transition)
        self.steps = _Steps(guide, *inner, before[:-1], ends[:-1], coarse)
        self._last = _Steps(None, *last, before[-1], ends[-1], None)
        # Traced once, for the loop and for the last step.
        self._jitted_log_halving = jax.jit(self._log_halving)

    def _transitions(self, dt: Float[Array, "N I"]) -> LinearTransition | None:
        """Return the transitions of all steps if they are known, shapes (N, ..., I)."""
        like = self.start[:, 0]
        of_step = lambda dt: known_transition(self._density, self._dynamics, like, dt)
        return jax.vmap(jax.vmap(of_step, out_axes=-1))(dt)

    def spread(self, leaf: Float[Array, "*shape I"]) -> Float[Array, "*shape lanes"]:
        """Repeat the values of each interval for all its lanes."""
        return jnp.repeat(leaf, self._num_draws, axis=-1)

    def begin(self) -> _LaneState:
        """Return the state at the start of the paths, with weight one."""
        start = self.spread(self.start)
        evaluated, zero = self._select_evaluated(start), jnp.zeros_like(start[0])
        zeros = jnp.zeros_like(evaluated[0])
        coarse = None if self._coarse_dt is None else _PathWeights(evaluated, zeros, zeros)
        gap = jnp.zeros_like(evaluated) if self._stores_coarse else None
        return _LaneState(_PathWeights(start, zero, zero), evaluated, zeros, coarse, gap)

    def end_points(self) -> Float[Array, "d points"]:
        """Return the end points of all paths, followed by those of stored coarse paths."""
        ends = [self.spread(self.end)]
        if self._stores_coarse:
            ends.append(self._select_evaluated(ends[0]))
        return jnp.concatenate(ends, axis=-1)

    def points(self, state: _LaneState) -> Float[Array, "d points"]:
        """Return the current points of all paths, followed by those of stored coarse paths.

        Between two points of the coarse grid, a coarse path keeps its distance to the fine path.
        The distance is zero where it would lead out of the state space.
        """
        if state.gap is None:
            return state.x
        here = self._select_evaluated(state.x)
        coarse = here + state.gap
        inside = over_lanes(-1)(self._is_inside)(coarse)
        return jnp.concatenate([state.x, jnp.where(inside, coarse, here)], axis=-1)

    def _is_inside(self, x: Float[Array, " d"]) -> Bool[Array, ""]:
        """Return whether x is in the state space."""
        has_sigma = jnp.isfinite(self._dynamics.sigma(x).log_abs_det())
        return all_finite(self._dynamics.drift(x)) & has_sigma

    def advance(self, state: _LaneState, xi: Float[Array, "d lanes"], steps: _Steps) -> _LaneState:
        """Return the state after a step with the noise ξ."""
        step = self._per_lane((steps.transition, self._as_step(steps)), self._num_draws)
        path = self._take_step(state.path, xi, step)
        if state.coarse is None:
            return self._update_halving(state, path, steps)
        here = self._select_evaluated(xi)
        coarse, coarse_steps = state.coarse, steps.coarse
        if coarse_steps is None:  # the coarse path has one step only, which `finish` takes
            return state._replace(path=path)

        def take_coarse_step():
            # The noise of both fine steps is available at the end of the pair.
            stepped = self._take_coarse_step(coarse, state.before, here, coarse_steps)
            if state.gap is None:
                return stepped, None
            return stepped, lax.stop_gradient(stepped.x - self._select_evaluated(path.x))

        coarse, gap = lax.cond(coarse_steps.ends, take_coarse_step, lambda: (coarse, state.gap))
        return _LaneState(path, here, state.log_halving, coarse, gap)

    def _take_step(
        self,
        path: _PathWeights,
        xi: Float[Array, "d lanes"],
        known_and_step: tuple[LinearTransition | None, Step],
    ) -> _PathWeights:
        """Return the paths after a step with this noise."""

        def step_at_point(x, xi, known_and_step):
            known, step = known_and_step
            target = self._step_law(self._density, known, x, step.dt)
            law = self._proposal.step_law(step, x, target)
            point = law.point(xi)
            return target.bent(point), self._log_densities(target, law, point, xi)

        results = over_lanes(-1, -1, self._lane_axis)(step_at_point)(path.x, xi, known_and_step)
        return self._add_factors(path, *results)

    def _step_law(self, density, known: LinearTransition | None, x, dt) -> StepLaw:
        """Return the law of a step of this density from x, with its transition if it is known."""
        return with_transition(density, known).steps_from(self._dynamics, x).law(dt)

    def _take_coarse_step(
        self,
        coarse: _PathWeights,
        before: Float[Array, "d evaluated"],
        xi: Float[Array, "d evaluated"],
        steps: _CoarseSteps,
    ) -> _PathWeights:
        """Return the coarse paths after a step with the noise of two fine steps.

        It has no derivatives, because only the estimated discretisation error depends on it.
        """
        xi = steps.share * before + jnp.sqrt(1 - steps.share**2) * xi
        step = Step(steps.guide, steps.dt, steps.remaining, self.end)
        step = None, self._per_lane(step, self._num_evaluated)
        stepped = self._take_step(coarse, xi, step)
        return lax.stop_gradient(stepped)

    @staticmethod
    def _add_factors(path: _PathWeights, x_next, log_densities) -> _PathWeights:
        """Move the paths to the next points; add the log densities of the step."""
        target, proposal = log_densities
        return _PathWeights(x_next, path.log_target + target, path.log_proposal + proposal)

    def retrace(
        self, state: _LaneState, x_next: Float[Array, "d lanes"], steps: _Steps
    ) -> tuple[_LaneState, Float[Array, "d lanes"]]:
        """Return the state after a step to these points, and the noise ξ of the step."""

        def noise_at_point(x, x_next, known_and_step):
            known, step = known_and_step
            target = self._step_law(self._density, known, x, step.dt)
            law = self._proposal.step_law(step, x, target)
            xi = law.noise(x_next)
            return xi, self._log_densities(target, law, x_next, xi)

        step = self._per_lane((steps.transition, self._as_step(steps)), self._num_draws)
        xi, log_densities = over_lanes(-1, -1, self._lane_axis)(noise_at_point)(
            state.x, x_next, step
        )
        return self._update_halving(
            state, self._add_factors(state.path, x_next, log_densities), steps
        ), xi

    def finish(self, state: _LaneState) -> tuple[Float[Array, " lanes"], Float[Array, "I m"]]:
        """Take the last step, which ends in b. Return log weights, and values for step errors.

        These values are D, or the log weights of the coarse paths, for the first m paths of each
        interval.
        """
        path = self._take_last_step(state.path, self._last.dt, self._num_draws)
        if state.coarse is None or self._coarse_dt is None:
            state = self._update_halving(state, path, self._last)
            half = log_halving_of_all_steps(state.log_halving, self._num_steps)
        else:
            coarse = self._take_last_step(
                state.coarse, self._coarse_dt, self._num_evaluated
            ).log_weight
            half = lax.stop_gradient(jnp.where(jnp.isfinite(coarse), coarse, -jnp.inf))
        return path.log_weight, half.reshape(-1, self._num_evaluated)

    def _take_last_step(
        self, path: _PathWeights, dt: Float[Array, " I"], num_draws: int
    ) -> _PathWeights:
        """Return the paths, `num_draws` per interval, after their last step, which ends in b."""

        def log_density_at_point(x, last):
            # An end point outside of the state space makes the weight NaN, so no path is found.
            known, end, dt = last
            log_density = self._step_law(self._closing, known, x, dt).log_density(end)
            return jnp.where(self._is_inside(end), log_density, jnp.nan)

        last = self._per_lane((self._last.transition, self.end, dt), num_draws)
        log_density = over_lanes(-1, self._lane_axis)(log_density_at_point)(path.x, last)
        end = jnp.repeat(self.end, num_draws, axis=-1)
        return self._add_factors(path, end, (log_density, jnp.zeros_like(log_density)))

    def _as_step(self, steps: _Steps) -> Step:
        return Step(steps.guide, steps.dt, steps.remaining, self.end)

    def _per_lane(self, of_intervals: PyTree, num_draws: int) -> PyTree:
        """Repeat values of intervals for `num_draws` lanes each.

        For a single interval, return values without an axis of lanes.
        """
        if self._lane_axis is None:
            return jax.tree.map(lambda leaf: leaf[..., 0], of_intervals)
        return jax.tree.map(lambda leaf: jnp.repeat(leaf, num_draws, axis=-1), of_intervals)

    def _select_evaluated(
        self, leaf: Float[Array, "*shape lanes"]
    ) -> Float[Array, "*shape evaluated"]:
        """Return the first paths of each interval, for which D is computed."""
        leaf = leaf.reshape(*leaf.shape[:-1], -1, self._num_draws)[..., : self._num_evaluated]
        return leaf.reshape(*leaf.shape[:-2], -1)

    @staticmethod
    def _log_densities(target: StepLaw, law: StepLaw, point, xi):
        return target.log_relative(point), law.log_relative_of_noise(xi)

    def _update_halving(self, state: _LaneState, path: _PathWeights, steps: _Steps) -> _LaneState:
        """Return the state with these paths, one step further, and with D updated."""
        if self._density.is_exact:  # D is zero
            return state._replace(path=path)
        from_x, to_x = self._select_evaluated(state.x), self._select_evaluated(path.x)
        change = lax.cond(
            steps.ends_pair,
            lambda: self._jitted_log_halving(state.before, from_x, to_x, steps.before, steps.dt),
            lambda: jnp.zeros_like(state.log_halving),
        )
        return _LaneState(path, from_x, state.log_halving + lax.stop_gradient(change), None, None)

    def _log_halving(self, before, x, x_next, *both):
        """Return the summand of D of one pair of steps, for the first paths of each interval."""

        def at_points(before, x, x_next, *both):
            points = (before, x, x_next)
            return log_halving_of_pair(self._density, self._dynamics, points, both)

        both = self._per_lane(both, self._num_evaluated)
        axes = (-1, -1, -1, self._lane_axis, self._lane_axis)
        return over_lanes(*axes)(at_points)(before, x, x_next, *both)


def noise_of(
    proposal: AbstractGuidedProposal,
    dynamics: Dynamics,
    intervals: Intervals,
    paths: Float[Array, "I points d"],
) -> tuple[Float[Array, "I steps d"], Float[Array, " I"], Float[Array, " I"]]:
    """Return the noise of given paths, one per interval, with their log weights and D.

    The steps of the proposal with the noise ξ_0, ..., ξ_{N-2} give these paths. The target must
    have normal steps.
    """
    lanes = _GuidedLanes(proposal, dynamics, intervals, paths.shape[1] - 1)

    def step(state, inputs):
        x_next, steps = join_rows(inputs)
        state, xi = lanes.retrace(join_rows(state), x_next, steps)
        return split_rows(state), split_rows(xi)

    inputs = split_rows((jnp.moveaxis(paths, 0, -1)[1:-1], lanes.steps), axis=1)
    state, xi = lax.scan(step, split_rows(lanes.begin()), inputs)
    return jnp.moveaxis(join_rows(xi, axis=1), -1, 0), *_drop_draw_axis(
        lanes.finish(join_rows(state))
    )


class PathsOfNoise(NamedTuple):
    """Paths that given noise generates, one per interval.

    - `log_change`: log of the factor by which half as many steps change the weight.
    - `coarse_paths`: the paths of half as many steps from the same noise; `None` if they are the
        paths themselves.
    """

    paths: Float[Array, "I points d"]
    log_weights: Float[Array, " I"]
    log_change: Float[Array, " I"]
    coarse_paths: Float[Array, "I points d"] | None


def num_noises(proposal: AbstractGuidedProposal, num_steps: int) -> int:
    """Return the number of steps with noise; the last step ends in b and may be split."""
    return len(_fractions(proposal, num_steps)[0]) - 2


def path_of(
    proposal: AbstractGuidedProposal,
    dynamics: Dynamics,
    intervals: Intervals,
    xi: Float[Array, "I steps d"],
    num_steps: int,
) -> PathsOfNoise:
    """Return the paths of `num_steps` steps that this noise generates.

    For normal steps it is the inverse of `noise_of`.
    """
    with_coarse = not proposal.target.is_normal and num_steps > 1
    lanes = _GuidedLanes(proposal, dynamics, intervals, num_steps, 1, with_coarse, with_coarse)

    def step(state, inputs):
        state = lanes.advance(join_rows(state), *join_rows(inputs))
        return split_rows(state), split_rows(lanes.points(state))

    inputs = split_rows((jnp.moveaxis(xi, 0, -1), lanes.steps), axis=1)
    first = lanes.begin()
    state, points = lax.scan(step, split_rows(first), inputs)
    log_weights, half = _drop_draw_axis(lanes.finish(join_rows(state)))
    ends = lanes.points(first)[None], lanes.end_points()[None]
    points = jnp.concatenate([ends[0], join_rows(points, axis=1)[: num_steps - 1], ends[1]])
    paths = jnp.moveaxis(points, -1, 0)
    if not with_coarse:
        return PathsOfNoise(paths, log_weights, half, None)
    paths, coarse_paths = jnp.split(paths, 2)
    is_found = jnp.isfinite(half)[:, None, None]
    coarse_paths = jnp.where(is_found, coarse_paths, paths)
    return PathsOfNoise(paths, log_weights, half - log_weights, coarse_paths)


def _drop_draw_axis(finished: tuple[Array, Array]) -> tuple[Float[Array, " I"], Float[Array, " I"]]:
    """Return the log weights and D of one path per interval, without the axis of draws."""
    log_weights, log_halving = finished
    return log_weights, log_halving[:, 0]


def _as_weighted_paths(
    paths: Float[Array, "I n K d"],
    log_weights: Float[Array, "I n"],
    log_halving: Float[Array, "I n"],
    log_coarse: Float[Array, "I n"],
    coarse_paths: Float[Array, "I n K d"] | None = None,
) -> WeightedPaths:
    """Return guided paths as `WeightedPaths`; paths with a non-finite weight are not found."""
    is_finite = jnp.isfinite(log_weights)
    if coarse_paths is not None:
        is_coarse_found = jnp.isfinite(log_coarse)[..., None, None]
        coarse_paths = jnp.where(is_coarse_found, coarse_paths, paths)
    return WeightedPaths(
        jnp.where(is_finite[..., None, None], paths, jnp.nan),
        jnp.where(is_finite, log_weights, -jnp.inf),
        is_finite,
        jnp.zeros_like(is_finite),
        jnp.ones(is_finite.shape, jnp.int32),
        (~is_finite).astype(jnp.int32),
        log_halving,
        log_coarse,
        coarse_paths,
    )


class _Draws(NamedTuple):
    """Paths with log weights.

    The other fields are those of `WeightedPaths`; they have no derivatives.
    """

    paths: Float[Array, "I n K d"]
    log_weights: Float[Array, "I n"]
    log_halving: Float[Array, "I n"]
    log_coarse: Float[Array, "I n"]
    coarse_paths: Float[Array, "I n K d"] | None


class _Inputs(NamedTuple):
    """Inputs in which paths and weights have derivatives."""

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
    """Draw one weighted path per key, on all intervals; `in_blocks` masks inactive ones."""
    return _as_weighted_paths(*_draw(_Inputs(proposal, model, intervals), keys, stored, num_steps))


@eqx.filter_custom_jvp
def _draw(
    inputs: _Inputs, keys: Key[Array, "I n"], stored: Int[Array, " K"] | None, num_steps: int
) -> _Draws:
    """Draw one path per key, with its log weight."""
    return _simulate(inputs, keys, stored, num_steps, None)


@_draw.def_jvp
def _draw_tangents(primals, tangents):
    """Return the draws with their tangents; paths with non-finite weights have tangent zero."""
    inputs, keys, stored, num_steps = primals
    draws = _draw(inputs, keys, stored, num_steps)
    is_finite = jnp.isfinite(draws.log_weights)

    def redraw(inputs):
        # Non-finite paths are simulated without noise, because in reverse mode a masked 0 · ∞ would
        # be NaN.
        paths, log_weights, *_ = _simulate(inputs, keys, stored, num_steps, is_finite)
        return jnp.where(is_finite[..., None, None], paths, 0), jnp.where(is_finite, log_weights, 0)

    _, tangents_out = eqx.filter_jvp(redraw, (inputs,), (tangents[0],))
    return draws, _Draws(*tangents_out, *jax.tree.map(jnp.zeros_like, tuple(draws[2:])))


def _simulate(
    inputs: _Inputs,
    keys: Key[Array, "I n"],
    stored: Int[Array, " K"] | None,
    num_steps: int,
    noisy: Bool[Array, "I n"] | None,
) -> _Draws:
    """Simulate one path per key, with its log weight; without noise where `noisy` is false.

    `noisy` is `None` if all paths have noise.
    """
    proposal, model, intervals = inputs
    dynamics = model.forward(intervals.start[0])
    (num_intervals, num_draws), (_, d) = keys.shape, intervals.start.shape
    dtype = intervals.start.dtype
    # With stored points and normal steps D is available, which needs no other paths.
    only_weights = stored is not None and stored.shape[0] == 0
    is_coupled = only_weights or not proposal.target.is_normal
    with_coarse = is_coupled and dynamics.sigma_varies and num_steps > 1
    stores_coarse = with_coarse and not only_weights
    which = with_coarse, stores_coarse
    lanes = _GuidedLanes(proposal, dynamics, intervals, num_steps, num_draws, *which)
    # The last step may be split. The points within it are not part of the path.
    last, num_steps = num_steps, lanes.num_steps
    state = lanes.begin()
    start, end = lanes.points(state), lanes.end_points()
    path = start[None][:0]  # no points between the ends if N = 1
    store = slots = None
    if stored is not None:
        # Row K receives all points that are not stored. The rows of the first and the last point
        # are filled separately, because the scan covers the points between.
        rows = jnp.broadcast_to(start, (stored.shape[0] + 1, *start.shape))
        points = jnp.where(stored == last, num_steps, stored)
        slots = jnp.full(num_steps + 1, stored.shape[0]).at[points].set(jnp.arange(len(stored)))
        store = Store(slots[1:-1], rows)
    if num_steps > 1:

        def step(state, inputs):
            xi, steps = inputs
            xi = xi if noisy is None else jnp.where(noisy.reshape(-1), xi, 0)
            state = lanes.advance(state, xi, steps)
            return state, lanes.points(state)

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
    log_weights, evaluated = lanes.finish(state)
    log_weights = log_weights.reshape(keys.shape)
    unknown = jnp.full(keys.shape, jnp.nan, dtype)
    half = unknown.at[:, : evaluated.shape[1]].set(evaluated)
    halves = (unknown, half) if with_coarse else (half, unknown)
    if slots is None:
        path = jnp.concatenate([start[None], path[: last - 1], end[None]])
    else:
        path = path.at[slots[-1]].set(end)[:-1]
    num_lanes = num_intervals * num_draws

    def of_intervals(path):
        path = path.reshape(*path.shape[:2], num_intervals, path.shape[2] // num_intervals)
        return jnp.moveaxis(path, (2, 3), (0, 1))

    paths, coarse_paths = of_intervals(path[:, :, :num_lanes]), None
    if stores_coarse:
        coarse = of_intervals(path[:, :, num_lanes:])
        coarse_paths = paths.at[:, : coarse.shape[1]].set(coarse)
    return _Draws(paths, log_weights, *halves, coarse_paths)


def _grid(
    proposal: AbstractGuidedProposal,
    dynamics: Dynamics,
    intervals: Intervals,
    fractions: Float[np.ndarray, " points"],
) -> tuple[PyTree, Float[Array, "N I"], Float[Array, "N I"]]:
    """Return the guide, δ_i and T - t_i on a grid, which is given by (T - t_i) / T."""
    start, end, duration = intervals
    dt = jnp.asarray(-np.diff(fractions), start.dtype)[:, None] * duration
    remaining = jnp.asarray(fractions[:-1], start.dtype)[:, None] * duration
    guide = jax.vmap(proposal.guide, in_axes=(None, 0, 0, 1), out_axes=-1)
    return guide(dynamics, start, end, dt), dt, remaining


def _fractions(
    proposal: AbstractGuidedProposal, num_steps: int
) -> tuple[Float[np.ndarray, " points"], list[int]]:
    """Return (T - t_i) / T of the grid, and the indices of the points of the coarse grid.

    The coarse grid has half as many steps. The last step needs a normal law. If other steps are not
    normal, it is an Euler step, which adds an error of the square of its length. Hence it is split
    into parts of ½, ¼, ..., 2^-k and again 2^-k of its length. Only the last part, of a length of
    about T / N², is an Euler step.
    """
    fractions = proposal.remaining(num_steps)
    coarse = [*range(0, num_steps, 2)]
    if proposal.target.is_normal:
        return fractions, [*coarse, num_steps]
    splits = fractions[-2] * remaining_after_splits(num_splits(num_steps))
    # The last step of the coarse grid is about T / (N/2)², four times as long.
    shared = range(num_steps - 1, num_steps - 1 + max(len(splits) - 1, 0))
    coarse = sorted({*coarse, *shared})
    return np.concatenate([fractions[:-1], splits, [0.0]]), [*coarse, num_steps + len(splits)]


def _coarse_grid(
    proposal: AbstractGuidedProposal,
    dynamics: Dynamics,
    intervals: Intervals,
    fractions: Float[np.ndarray, " points"],
    points: list[int],
) -> tuple[_CoarseSteps | None, Float[Array, " I"]]:
    """Return the coarse steps, one entry per fine step, and the length of the last coarse step.

    The coarse steps are `None` if there is only the last one.
    """
    guide, dt, remaining = _grid(proposal, dynamics, intervals, fractions[points])
    num_inner = len(points) - 2
    if num_inner == 0:
        return None, dt[-1]
    first, last = np.array(points[:-2]), np.array(points[1:-1])
    before, middle, after = fractions[first], fractions[first + 1], fractions[last]
    is_pair = last - first == 2
    # A coarse step that equals one fine step has the same noise: c = 0.
    share = np.sqrt((before - middle) * after / ((before - after) * middle)) * is_pair
    numbers = np.arange(len(fractions) - 2)
    owner = np.minimum(np.searchsorted(last, numbers + 1), num_inner - 1)
    ends = np.isin(numbers + 1, last)
    coarse_steps = (guide, dt[:-1], remaining[:-1], jnp.asarray(share, dt.dtype))
    guide, dt_inner, remaining, share = jax.tree.map(lambda leaf: leaf[owner], coarse_steps)
    return _CoarseSteps(guide, dt_inner, remaining, share, jnp.asarray(ends)), dt[-1]


def deterministic_path(
    density: AbstractStepDensity,
    dynamics: Dynamics,
    start: Float[Array, " d"],
    dt: Float[Array, " N"],
) -> tuple[Float[Array, "N d"], Float[Array, " d"]]:
    """Return the path ξ of the target without noise: ξ_0, ..., ξ_{N-1}, shape (N, d), and ξ_N."""

    def step(xi, dt):
        return density.steps_from(dynamics, xi).law(dt).mean, xi

    end, path = lax.scan(step, start, dt)
    return path, end


def bridge_law(step: Step, target: StepLaw, mean: Float[Array, " d"]) -> StepLaw:
    """Return the normal law with this mean and the covariance V δ (T - t_{i+1}) / (T - t_i)."""
    shrunk = (step.remaining - step.dt) / step.remaining
    return target._replace(mean=mean, covariance=shrunk)


def check_refinement(refinement: float) -> float:
    """Return `refinement` as a float.

    **Raises:** `TypeError` unless it is a Python number, `ValueError` unless it is in [1, 4].
    """
    if isinstance(refinement, bool) or not isinstance(refinement, int | float):
        raise TypeError(
            f"`refinement` must be a Python number, because it is static under `jit`; got "
            f"{refinement!r}."
        )
    if not 1 <= refinement <= 4:
        raise ValueError(f"`refinement` must be between 1 (equal steps) and 4; got {refinement}.")
    return float(refinement)


def as_guided(proposal: AbstractProposal) -> AbstractGuidedProposal:
    """Return the proposal, or raise `TypeError` if it is not a guided proposal."""
    if not isinstance(proposal, AbstractGuidedProposal):
        raise TypeError(
            "Crank–Nicolson moves need a guided proposal: pass `ModifiedDiffusionBridge()`, "
            f"`ResidualBridge()` or `Guided()` as `proposal`; got {proposal.describe()}."
        )
    return proposal
