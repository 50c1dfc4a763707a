"""Adaptive multilevel splitting (Cérou & Guyader 2007): common parts of exits and events.

A score measures how far a path has come, and the event is that it is positive. A run starts with n
simulated paths. Then the half with the lowest scores is replaced: each of these paths becomes a
copy of one of the others, which is renewed such that its score stays above the level, the highest
score among the replaced. This is repeated until the event occurs on most paths. If K_i of n paths
were replaced at level i, the estimate of the probability is

    p̂ = Π_i (1 - K_i / n) · (share of the last paths on which the event occurs).

Independent runs give the error. As many more runs take steps of twice the size, and tell the
discretisation error.
"""

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.averages import PathFunction, as_path_function
from ..engine.checks import (
    Numbers,
    as_floating,
    as_numbers,
    check_count,
    check_key,
    check_num_steps,
)
from ..engine.verdict import AbstractResult, Fault, Verdict
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion, check_diffusion
from ..models.dynamics import Dynamics
from ..schemes import (
    MOST_TOO_LONG,
    UNKNOWN_SHARE,
    AbstractStepDensity,
    StepError,
    StepLaw,
    check_step_density,
    known_transition,
    most_accurate_density,
    share_in_regime,
    share_of_order,
    share_of_pairs,
    step_faults,
    unknown_where,
    with_transition,
)
from .log_means import log_mean_of_runs

# Each level at least halves the probability, so that this many reach 1e-30.
_MOST_LEVELS = 100
# Largest quadratic part of a step relative to its linear part (`schemes.step_law`).
_MOST_BENT = 0.5
# Largest relative error of a probability that its standard error describes.
_MOST_SPREAD = 0.5

_APART = (
    "The estimates of the runs differ by more than their mean, so that it may be far off. Use more "
    "`num_paths`, more `num_runs`, or a function that measures progress better."
)
_LOST = (
    "Some paths are not finite. Use more `num_steps`, or check the model. Where σ vanishes, or its "
    "derivatives are not finite, pass `density=jb.EulerDensity()`."
)


class AbstractRareEvent(AbstractResult):
    """Probability of a rare event, and paths on which it occurs, from R runs of n paths."""

    log_probability: eqx.AbstractVar[Float[Array, ""]]
    standard_error: eqx.AbstractVar[Float[Array, ""]]
    log_estimates: eqx.AbstractVar[Float[Array, " R"]]
    times: eqx.AbstractVar[Float[Array, " points"]]
    paths: eqx.AbstractVar[Float[Array, "R n points d"]]
    num_levels: eqx.AbstractVar[Int[Array, " R"]]
    num_nonfinite: eqx.AbstractVar[Int[Array, ""]]
    step_error: eqx.AbstractVar[Float[Array, ""]]
    step_uncertainty: eqx.AbstractVar[Float[Array, ""]]
    _unfinished: ClassVar[str]

    @property
    @abstractmethod
    def _occurred(self) -> Bool[Array, "R n"]:
        """Return whether the event occurs on each path."""

    def mean(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the mean of `fn(path)` given the event.

        `fn` is a function of one path of shape (N+1, d), by default the path itself.
        """
        return jax.tree.map(lambda leaf: self._mean_and_error(leaf)[0], self._values(fn))

    def standard_error_of(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the standard error of `mean(fn)`, from the spread of the runs."""
        return jax.tree.map(lambda leaf: self._mean_and_error(leaf)[1], self._values(fn))

    @property
    def verdict(self) -> Verdict:
        """Return the faults of the estimate, each with a remedy.

        - a run in which the event does not occur on most of the last paths;
        - runs that differ by more than their mean;
        - paths that are not finite;
        - a discretisation error that is unknown or too uncertain, or that dominates and exceeds
            0.05;
        - a value that is not finite.
        """
        step_error = StepError(self.step_error, self.step_uncertainty)
        unfinished = jnp.any(2 * jnp.sum(self._occurred, axis=1) <= self._occurred.shape[1])
        return Verdict(
            (
                Fault(unfinished, self._unfinished),
                Fault(~(self.standard_error < _MOST_SPREAD), _APART),
                Fault(self.num_nonfinite > 0, _LOST),
                *step_faults(step_error, self.standard_error),
            )
        ).with_finite(self.log_probability)

    def _values(self, fn: PathFunction) -> PyTree:
        """Evaluate `fn` on all paths."""
        like = jax.ShapeDtypeStruct(self.paths.shape[2:], self.paths.dtype)
        return jax.vmap(jax.vmap(as_path_function("fn", fn, like)))(self.paths)

    def _mean_and_error(
        self, values: Float[Array, "R n ..."]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the mean of values given the event, and its error."""
        R = len(values)
        occurred = self._occurred.reshape(*self._occurred.shape, *[1] * (values.ndim - 2))
        number = jnp.maximum(jnp.sum(occurred, axis=1), 1).astype(values.dtype)
        of_runs = jnp.sum(jnp.where(occurred, values, 0), axis=1) / number
        share = jax.nn.softmax(self.log_estimates).reshape(R, *[1] * (values.ndim - 2))
        mean = jnp.sum(share * of_runs, axis=0)
        squares = jnp.sum((share * (of_runs - mean)) ** 2, axis=0)
        if R == 1:
            return mean, jnp.full_like(mean, jnp.inf)
        return mean, jnp.sqrt(squares * R / (R - 1))


class Size(NamedTuple):
    """Sizes of a splitting.

    - `num_runs`, `num_paths`, `num_steps`: R, n and N of the runs that give the result.
    - `num_coarse`: number of further runs, with steps of twice the size.
    """

    num_runs: int
    num_paths: int
    num_steps: int
    num_coarse: int

    @property
    def all_runs(self) -> int:
        return self.num_runs + self.num_coarse

    @property
    def num_lanes(self) -> int:
        return self.all_runs * self.num_paths

    def is_doubled(self, i: Int[Array, ""]) -> Bool[Array, " lanes"]:
        """Return whether step i of each path is the second of a pair that one step replaces."""
        is_coarse = np.arange(self.num_lanes) >= self.num_runs * self.num_paths
        return jnp.asarray(is_coarse) & (i % 2 == 1)


def check_splitting(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    duration: Numbers,
    num_runs: int,
    num_paths: int,
    num_steps: int,
    density: AbstractStepDensity | None,
) -> tuple[Float[Array, " d"], Float[Array, ""], Size, AbstractStepDensity]:
    """Validate the common arguments; return the start, the duration, the size and the density.

    **Raises:** `ValueError` and `TypeError` for invalid arguments, and for coefficients that depend
    on time.
    """
    check_key(key)
    check_diffusion(model)
    num_paths = check_count("num_paths", num_paths, minimum=2)
    num_runs = check_count("num_runs", num_runs)
    num_steps = check_num_steps(num_steps, 1)
    density = check_step_density(density)
    start = as_floating("start", start)
    if start.ndim != 1:
        raise ValueError(f"`start` must have shape (d,), a single point; got {start.shape}.")
    duration = as_numbers({"duration": duration})["duration"].astype(start.dtype)
    model.forward(start)  # raises if coefficients depend on time
    if density is None:
        density = most_accurate_density(model, start, normal_steps=False)
    num_coarse = num_runs if num_steps > 1 else 0
    return start, duration, Size(num_runs, num_paths, num_steps, num_coarse), density


def make_step(
    density: AbstractStepDensity,
    dynamics: Dynamics,
    start: Float[Array, " d"],
    dt: Float[Array, ""],
) -> Callable[..., Float[Array, " d"]]:
    """Return `step(x, ξ, doubled)`, the end of a step of length δ, or 2δ if `doubled`."""
    single, double = (known_transition(density, dynamics, start, length) for length in (dt, 2 * dt))

    def step(x, xi, doubled):
        transition = jax.tree.map(lambda one, two: jnp.where(doubled, two, one), single, double)
        steps = with_transition(density, transition).steps_from(dynamics, x)
        return steps.law(jnp.where(doubled, 2 * dt, dt)).end(xi)

    return step


class Estimate(NamedTuple):
    """Log of the probability, its standard error, and its discretisation error."""

    log_probability: Float[Array, ""]
    standard_error: Float[Array, ""]
    step_error: StepError


def estimate(
    log_estimates: Float[Array, " runs"],
    size: Size,
    order: float,
    model: Diffusion,
    density: AbstractStepDensity,
    paths: Float[Array, "R points d"],
    dt: Float[Array, ""],
) -> Estimate:
    """Return the estimate from those of all runs.

    `paths` are some paths given the event. The discretisation error of order δ^p is unknown if
    their steps are too long for the drift or for σ.
    """
    fine, coarse = log_estimates[: size.num_runs], log_estimates[size.num_runs :]
    value, error = log_mean_of_runs(fine[None])
    if math.isinf(order):
        return Estimate(value, error, StepError(jnp.zeros_like(value), jnp.zeros_like(value)))
    if size.num_coarse == 0:
        unknown = jnp.full_like(value, jnp.nan)
        return Estimate(value, error, StepError(unknown, unknown))
    of_coarse, its_error = log_mean_of_runs(coarse[None])
    share = share_of_pairs(jnp.full_like(value, share_of_order(order)), size.num_steps)
    is_known = jnp.isfinite(value) & jnp.isfinite(of_coarse)
    change = jnp.where(is_known, of_coarse, 0) - jnp.where(is_known, value, 0)
    step_error = StepError(share * change, share * jnp.hypot(error, its_error))
    too_long = _steps_are_too_long(model, density, paths, dt)
    return Estimate(value, error, unknown_where(too_long | ~is_known, step_error))


def _steps_are_too_long(
    model: Diffusion,
    density: AbstractStepDensity,
    paths: Float[Array, "R points d"],
    dt: Float[Array, ""],
) -> Bool[Array, ""]:
    """Return whether over 2 % of these steps exceed the relaxation time of the drift, or lead to
    points where σ differs much from that at their beginning."""
    begins, ends = (part.reshape(-1, paths.shape[-1]) for part in (paths[:, :-1], paths[:, 1:]))
    lengths = jnp.broadcast_to(dt, len(begins))
    share = share_in_regime(jnp.ones_like(lengths), model, Intervals(begins, ends, lengths), 1)
    dynamics = model.forward(begins[0])

    def bends(x):
        law = density.steps_from(dynamics, x).law(dt)
        if not isinstance(law, StepLaw) or law.curvature is None:
            return jnp.zeros((), bool)
        return jnp.sqrt(dt) * jnp.max(jnp.abs(law.curvature)) > _MOST_BENT

    too_long = (share == UNKNOWN_SHARE) | jax.vmap(bends)(begins)
    return jnp.mean(too_long.astype(dt.dtype)) > MOST_TOO_LONG


class Level(NamedTuple):
    """Selection of the paths of all runs at one level.

    - `bound`: the level of each run.
    - `replaced`: whether each path is replaced.
    - `parent`: index of the path that replaces each, or its own, among all paths.
    - `log_share`: log of the factor of p̂; zero for runs that are over.
    - `goes_on`: whether each run replaces paths.
    - `over`: whether each run has ended.
    """

    bound: Float[Array, " R"]
    replaced: Bool[Array, "R n"]
    parent: Int[Array, " lanes"]
    log_share: Float[Array, " R"]
    goes_on: Bool[Array, " R"]
    over: Bool[Array, " R"]


def next_level(key: Key[Array, ""], scores: Float[Array, "R n"], over: Bool[Array, " R"]) -> Level:
    """Select the paths that are replaced, and those that replace them, in all runs."""
    R, n = scores.shape
    order = jnp.argsort(scores, axis=1).astype(jnp.int32)
    bound = jnp.take_along_axis(scores, order[:, (n - 1) // 2, None], axis=1)
    is_last = bound[:, 0] > 0
    replaced = (scores <= bound) & ~(over | is_last)[:, None]
    number = jnp.sum(scores <= bound, axis=1, dtype=jnp.int32)
    is_lost = (number == n) & ~is_last
    # A path of the same run that is above the bound, at random.
    uniform = jax.random.uniform(key, (R, n), scores.dtype)
    above = (n - number).astype(uniform.dtype)[:, None]
    rank = number[:, None] + jnp.floor(uniform * above).astype(jnp.int32)
    parent = jnp.take_along_axis(order, jnp.clip(rank, 0, n - 1), axis=1)
    parent = jnp.where(replaced, parent, np.arange(n, dtype=np.int32))
    parent = parent + n * np.arange(R, dtype=np.int32)[:, None]
    number_left = jnp.where(is_last, jnp.sum(scores > 0, axis=1, dtype=jnp.int32), n - number)
    share = number_left.astype(scores.dtype) / n
    return Level(
        bound[:, 0],
        replaced,
        parent.ravel(),
        jnp.where(over, 0, jnp.log(share)),
        ~(over | is_last),
        over | is_last | is_lost,
    )


class Runs(NamedTuple):
    """Bookkeeping of all runs.

    - `log_p`: log of the product of the factors of p̂ so far.
    - `num_levels`: number of levels.
    - `over`: whether the run has ended.
    - `num_nonfinite`: number of paths that were not finite, of all runs.
    """

    log_p: Float[Array, " R"]
    num_levels: Int[Array, " R"]
    over: Bool[Array, " R"]
    num_nonfinite: Int[Array, ""]

    def after(self, level: Level, num_lost: Int[Array, ""]) -> "Runs":
        """Return the runs after a level, at which `num_lost` paths were not finite."""
        return Runs(
            self.log_p + level.log_share,
            self.num_levels + level.goes_on.astype(jnp.int32),
            level.over,
            self.num_nonfinite + num_lost,
        )

    @property
    def log_estimates(self) -> Float[Array, " R"]:
        """Return log p̂ of each run, -inf for a run without an end."""
        return jnp.where(self.over, self.log_p, -jnp.inf)


def new_runs(number: int, dtype: np.dtype, num_lost: int | Int[Array, ""] = 0) -> Runs:
    """Return the runs before their first level."""
    zeros = jnp.zeros(number, jnp.int32)
    return Runs(jnp.zeros(number, dtype), zeros, zeros > 0, jnp.asarray(num_lost, jnp.int32))


def run_levels(renewed: Callable[[Int[Array, ""], Any], Any], init: Any) -> Any:
    """Apply `renewed(i, state)` at level i = 0, 1, ... until all of `state.runs` are over."""
    goes_on = lambda state: (state[0] < _MOST_LEVELS) & ~jnp.all(state[1].runs.over)
    step = lambda state: (state[0] + 1, renewed(*state))
    return lax.while_loop(goes_on, step, (jnp.int32(0), init))[1]


def is_lost(points: Float[Array, "points d lanes"]) -> Bool[Array, " lanes"]:
    """Return whether each path is not finite."""
    return ~jnp.all(jnp.isfinite(points), axis=(0, 1))
