"""Exits from a region, however rare, by adaptive multilevel splitting (Cérou & Guyader 2007).

The progress of a path is the largest value of -g that it attained, for a region g > 0. All paths of
a run are simulated. Then the half with the least progress is replaced: each of these paths becomes
a copy of one of the others until that exceeded the level, the largest progress among the replaced,
and is simulated again from there. This is repeated until most paths have left the region. If K_i
of n paths were replaced at level i, the estimate of the probability is

    p̂ = Π_i (1 - K_i / n) · (share of the last paths that have left the region).

Its mean is the probability for these steps (Bréhier, Gazeau, Goudenège, Lelièvre & Rousset 2016).
Within a step, g is a Brownian bridge, and its minimum is drawn from its law. Independent runs give
the error.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.arguments import check_function, named
from ..engine.averages import PathFunction, as_path_function
from ..engine.checks import (
    Numbers,
    as_floating,
    as_numbers,
    check_count,
    check_key,
    check_num_steps,
    is_traced,
    nondifferentiable,
)
from ..engine.compiled import compiled_for
from ..engine.entry import public_entry
from ..engine.lanes import over_lanes
from ..engine.verdict import AbstractResult, Fault, Verdict, throw_where_untrustworthy
from ..models.diffusion import Diffusion, check_diffusion
from ..models.sigma import columns_of
from ..schemes.heun import Heun
from ..schemes.survival import distances
from .log_means import log_mean_of_runs

# Each level at least halves the probability, so that this many reach 1e-30.
_MOST_LEVELS = 100
# Largest relative error of a probability that its standard error describes.
_MOST_SPREAD = 0.5

_UNFINISHED = (
    "Some run ended before most of its paths had left the region: no path of it goes on, or the "
    "probability is below 1e-30. Use more `num_paths`, a longer `duration`, or a function `inside` "
    "that decreases on the way out."
)
_APART = (
    "The estimates of the runs differ by more than their mean, so that it may be far off. Use more "
    "`num_paths`, more `num_runs`, or a function `inside` that measures progress better."
)
_LOST = "Some paths are not finite. Use more `num_steps`, or check the model."


class Exits(AbstractResult):
    """Result of `sample_exits`: the probability of an exit from a region, and paths that leave it.

    - `log_probability`: log of the estimated probability. The mean of the estimated probability is
        the probability itself, up to the discretisation error.
    - `standard_error`: standard error of `log_probability`, from the spread of the runs.
    - `log_estimates`: log estimates of all runs, shape (R,).
    - `times`: times of the points of paths, shape (N+1,).
    - `paths`: paths of all runs, shape (R, n, N+1, d).
    - `exited`: whether each path leaves the region, shape (R, n). At least half of them do, unless
        the verdict says otherwise.
    - `exit_index`: index of the first point after the exit, shape (R, n); N+1 without an exit.
    - `num_levels`: number of levels of each run, shape (R,).
    - `num_nonfinite`: number of simulated paths that were not finite, replaced ones included. From
        there on they have no exit.
    """

    log_probability: Float[Array, ""]
    standard_error: Float[Array, ""]
    log_estimates: Float[Array, " R"]
    times: Float[Array, " points"]
    paths: Float[Array, "R n points d"]
    exited: Bool[Array, "R n"]
    exit_index: Int[Array, "R n"]
    num_levels: Int[Array, " R"]
    num_nonfinite: Int[Array, ""]

    def mean(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the mean of `fn(path)` given an exit.

        `fn` is a function of one path of shape (N+1, d), by default the path itself.
        """
        return jax.tree.map(lambda leaf: self._mean_and_error(leaf)[0], self._values(fn))

    def standard_error_of(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the standard error of `mean(fn)`, from the spread of the runs."""
        return jax.tree.map(lambda leaf: self._mean_and_error(leaf)[1], self._values(fn))

    def rate(self, after: Numbers) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the probability of an exit per unit of time from `after` on, and its error.

        It is the rate of a rare transition under two conditions. `after` must be longer than the
        relaxation time inside the region and the time that a transition itself takes; if a later
        `after` gives a larger rate, it was too early. The duration must be shorter than the mean
        time until an exit.

        **Raises:** `ValueError` unless `after` is at least zero and below the duration. A traced
        number is not checked.
        """
        after, duration = as_numbers({"after": after})["after"], self.times[-1]
        if not is_traced(after, duration) and not 0 <= after < duration:
            raise ValueError(f"`after` must be in [0, {duration:g}); got {after:g}.")
        after = after.astype(duration.dtype)
        exit_times = self.times[1] * self.exit_index.astype(duration.dtype)
        is_late = (self.exited & (exit_times > after)).astype(duration.dtype)
        number = jnp.maximum(jnp.sum(self.exited, axis=1), 1).astype(duration.dtype)
        log_late = self.log_estimates + jnp.log(jnp.sum(is_late, axis=1) / number)
        log_mean, error = log_mean_of_runs(log_late[None])
        rate = jnp.exp(log_mean) / (duration - after)
        return rate, rate * error

    @property
    def verdict(self) -> Verdict:
        """Return the faults of the estimate, each with a remedy.

        - a run without an exit of most of its paths;
        - runs that differ by more than their mean;
        - paths that are not finite;
        - a value that is not finite.
        """
        unfinished = jnp.any(2 * jnp.sum(self.exited, axis=1) <= self.exited.shape[1])
        return Verdict(
            (
                Fault(unfinished, _UNFINISHED),
                Fault(~(self.standard_error < _MOST_SPREAD), _APART),
                Fault(self.num_nonfinite > 0, _LOST),
            )
        ).with_finite(self.log_probability)

    def _values(self, fn: PathFunction) -> PyTree:
        """Evaluate `fn` on all paths."""
        like = jax.ShapeDtypeStruct(self.paths.shape[2:], self.paths.dtype)
        return jax.vmap(jax.vmap(as_path_function("fn", fn, like)))(self.paths)

    def _mean_and_error(
        self, values: Float[Array, "R n ..."]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the mean of values given an exit, and its error."""
        R = len(values)
        exited = self.exited.reshape(*self.exited.shape, *[1] * (values.ndim - 2))
        number = jnp.maximum(jnp.sum(exited, axis=1), 1).astype(values.dtype)
        of_runs = jnp.sum(jnp.where(exited, values, 0), axis=1) / number
        share = jax.nn.softmax(self.log_estimates).reshape(R, *[1] * (values.ndim - 2))
        mean = jnp.sum(share * of_runs, axis=0)
        squares = jnp.sum((share * (of_runs - mean)) ** 2, axis=0)
        if R == 1:
            return mean, jnp.full_like(mean, jnp.inf)
        return mean, jnp.sqrt(squares * R / (R - 1))


@public_entry
def sample_exits(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    duration: Numbers,
    inside: Callable,
    *,
    num_paths: int = 1000,
    num_runs: int = 16,
    num_steps: int = 100,
    throw: bool = False,
) -> Exits:
    """Estimate the probability of an exit from a region, and sample paths that leave it.

    **Arguments:**

    - `key`: typed key.
    - `model`: the diffusion. Its coefficients must not depend on time.
    - `start`: where all paths begin, shape (d,).
    - `duration`: time until which an exit counts, in units of time.
    - `inside`: as in `log_survival`. Paths that come nearer to its zero are continued, so it should
        decrease on the likely ways out.
    - `num_paths`: number n of paths of a run.
    - `num_runs`: number R of independent runs. Their spread gives the error.
    - `num_steps`: number N of Heun steps.
    - `throw`: raise an error at run time if the result is not `trustworthy`.

    **Returns:** `Exits`. The cost grows with the log of the probability, not with its inverse. The
    discretisation error is that of `log_survival` and of Heun's scheme.

    **Raises:** `ValueError` and `TypeError` for invalid arguments, and for coefficients that depend
    on time.

    **Example:**

    ```python
    exits = jb.sample_exits(key, model, start, 1.0, lambda x: 2.0 - x[0], num_runs=4)
    exits.log_probability, exits.standard_error
    ```
    """
    check_key(key)
    check_diffusion(model)
    check_function("inside", inside, "(x)")
    num_paths = check_count("num_paths", num_paths, minimum=2)
    num_runs = check_count("num_runs", num_runs)
    num_steps = check_num_steps(num_steps, 1)
    start = as_floating("start", start)
    if start.ndim != 1:
        raise ValueError(f"`start` must have shape (d,), a single point; got {start.shape}.")
    duration = as_numbers({"duration": duration})["duration"].astype(start.dtype)
    model.forward(start)  # raises if coefficients depend on time
    exits = _sample_exits(key, model, start, duration, inside, (num_runs, num_paths, num_steps))
    return throw_where_untrustworthy(exits, "log_probability", model) if throw else exits


class _Population(NamedTuple):
    """Paths of all runs, with lanes last: run after run.

    - `points`: states, and `progress`: the largest -g within each step.
    - `log_p`, `num_levels`, `over`: log of the product so far, number of levels, and whether the
        run has ended.
    - `num_nonfinite`: number of replaced paths that were not finite.
    """

    points: Float[Array, "points d lanes"]
    progress: Float[Array, "N lanes"]
    log_p: Float[Array, " R"]
    num_levels: Int[Array, " R"]
    over: Bool[Array, " R"]
    num_nonfinite: Int[Array, ""]


# A handful of levels, each of which simulates all paths.
@compiled_for(lambda key, model, start, duration, inside, size: size[0] * size[1] * size[2] * 4)
def _sample_exits(
    key: Key[Array, ""],
    model: Diffusion,
    start: Float[Array, " d"],
    duration: Float[Array, ""],
    inside: Callable,
    size: tuple[int, int, int],
) -> Exits:
    R, n, N = size
    model, start, duration = nondifferentiable((model, start, duration))
    dynamics, dt = model.prepared().forward(start), duration / N
    num_noises = len(columns_of(dynamics.sigma(start), start))
    of_point = lambda x: distances(dynamics, named("inside", inside), x)
    num_bounds = len(of_point(start)[0])

    @over_lanes(-1, -1, -1)
    def step(x, normal, uniform):
        """Return the next point, and the largest -g on the way."""
        x_next = Heun().step(dynamics, x, dt, jnp.sqrt(dt) * normal)
        (g, s), (g_next, s_next) = of_point(x), of_point(x_next)
        spread = -2 * jnp.sqrt(s * s_next) * dt * jnp.log(uniform)
        lowest = (g + g_next - jnp.sqrt((g_next - g) ** 2 + spread)) / 2
        return x_next, -jnp.min(lowest)

    def simulated(key, points, progress, kept):
        """Return the paths, simulated anew after the first `kept` steps of each."""

        def one(x, inputs):
            i, old, old_next, old_progress = inputs
            noise_key, uniform_key = jax.random.split(jax.random.fold_in(key, i))
            normal = jax.random.normal(noise_key, (num_noises, R * n), x.dtype)
            tiny = jnp.finfo(x.dtype).tiny
            uniform = jax.random.uniform(uniform_key, (num_bounds, R * n), x.dtype, minval=tiny)
            x_next, largest = step(jnp.where(i <= kept, old, x), normal, uniform)
            x_next = jnp.where(i < kept, old_next, x_next)
            largest = jnp.where(i < kept, old_progress, largest)
            # A path that is lost never leaves.
            largest = jnp.where(jnp.isfinite(largest), largest, -jnp.inf)
            return x_next, (x_next, largest)

        inputs = np.arange(N, dtype=np.int32), points[:-1], points[1:], progress
        _, (later, progress) = lax.scan(one, points[0], inputs)
        return jnp.concatenate([points[:1], later]), progress

    lost = lambda points: ~jnp.all(jnp.isfinite(points), axis=(0, 1))

    def level(i, old):
        """Replace the paths of least progress in all runs that go on."""
        parent_key, path_key = jax.random.split(jax.random.fold_in(key, i + 1))
        so_far = lax.cummax(old.progress)
        reached = so_far[-1].reshape(R, n)
        order = jnp.argsort(reached, axis=1).astype(jnp.int32)
        bound = jnp.take_along_axis(reached, order[:, (n - 1) // 2, None], axis=1)
        is_last = bound[:, 0] > 0
        replaced = (reached <= bound) & ~(old.over | is_last)[:, None]
        number = jnp.sum(reached <= bound, axis=1, dtype=jnp.int32)
        is_lost = (number == n) & ~is_last
        # A path of the same run that goes beyond the bound, at random.
        uniform = jax.random.uniform(parent_key, (R, n), old.points.dtype)
        beyond = (n - number).astype(uniform.dtype)[:, None]
        rank = number[:, None] + jnp.floor(uniform * beyond).astype(jnp.int32)
        parent = jnp.take_along_axis(order, jnp.clip(rank, 0, n - 1), axis=1)
        parent = jnp.where(replaced, parent, np.arange(n, dtype=np.int32))
        parent = parent + n * np.arange(R, dtype=np.int32)[:, None]
        points, progress, so_far = (
            jnp.take(leaf, parent.ravel(), axis=-1) for leaf in (old.points, old.progress, so_far)
        )
        exceeds = so_far > jnp.repeat(bound[:, 0], n)
        kept = jnp.where(replaced.ravel(), jnp.argmax(exceeds, axis=0).astype(jnp.int32) + 1, N)
        points, progress = simulated(path_key, points, progress, kept)
        number_left = jnp.where(is_last, jnp.sum(reached > 0, axis=1, dtype=jnp.int32), n - number)
        share = number_left.astype(old.log_p.dtype) / n
        log_p = old.log_p + jnp.where(old.over, 0, jnp.log(share))
        goes_on = ~(old.over | is_last)
        return _Population(
            points,
            progress,
            log_p,
            old.num_levels + goes_on.astype(jnp.int32),
            old.over | is_last | is_lost,
            old.num_nonfinite + jnp.sum(lost(old.points) & replaced.ravel(), dtype=jnp.int32),
        )

    points = jnp.broadcast_to(start[:, None], (N + 1, len(start), R * n))
    progress = jnp.full((N, R * n), -jnp.inf, start.dtype)
    points, progress = simulated(
        jax.random.fold_in(key, 0), points, progress, jnp.zeros(R * n, jnp.int32)
    )
    zeros = jnp.zeros(R, start.dtype)
    numbers = jnp.zeros(R, jnp.int32), jnp.zeros(R, bool), jnp.int32(0)
    init = _Population(points, progress, zeros, *numbers)
    goes_on = lambda state: (state[0] < _MOST_LEVELS) & ~jnp.all(state[1].over)
    _, last = lax.while_loop(
        goes_on, lambda state: (state[0] + 1, level(*state)), (jnp.int32(0), init)
    )
    exceeds = lax.cummax(last.progress) > 0
    exited = exceeds[-1].reshape(R, n)
    index = jnp.where(exceeds[-1], jnp.argmax(exceeds, axis=0) + 1, N + 1)
    paths = jnp.moveaxis(last.points.reshape(N + 1, len(start), R, n), (2, 3), (0, 1))
    log_estimates = jnp.where(last.over, last.log_p, -jnp.inf)
    log_mean, error = log_mean_of_runs(log_estimates[None])
    return Exits(
        log_mean,
        error,
        log_estimates,
        dt * jnp.arange(N + 1, dtype=dt.dtype),
        paths,
        exited,
        index.reshape(R, n).astype(jnp.int32),
        last.num_levels,
        last.num_nonfinite + jnp.sum(lost(last.points), dtype=jnp.int32),
    )
