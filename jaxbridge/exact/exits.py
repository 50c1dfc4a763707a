"""Exits from a region, however rare, by adaptive multilevel splitting (`splitting`).

The score of a path is the largest value of -g that it attained, for a region g > 0. A path that is
replaced becomes a copy of another one until that exceeded the level, and is simulated again from
there. The mean of p̂ is then the probability for these steps (Bréhier, Gazeau, Goudenège, Lelièvre
& Rousset 2016). Within a step, g is a Brownian bridge, and its minimum is drawn from its law.
"""

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.arguments import check_function, named
from ..engine.checks import Numbers, as_numbers, is_traced, nondifferentiable
from ..engine.compiled import compiled_for
from ..engine.entry import public_entry
from ..engine.lanes import over_lanes
from ..engine.verdict import throw_where_untrustworthy
from ..models.diffusion import Diffusion
from ..schemes import AbstractStepDensity
from ..schemes.survival import distances
from .log_means import log_mean_of_runs
from .splitting import (
    AbstractRareEvent,
    Runs,
    Size,
    check_splitting,
    estimate,
    is_lost,
    make_step,
    new_runs,
    next_level,
    run_levels,
)

# Order of the discretisation error. With twice the number of steps errors were 2.1 to 3.5 times
# smaller, in an Ornstein-Uhlenbeck process, a double well and a Cox-Ingersoll-Ross process.
_ORDER = 1.5


class Exits(AbstractRareEvent):
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
    - `step_error`: estimated discretisation error of `log_probability`, from R further runs with
        half as many steps; `step_uncertainty`: its standard error.
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
    step_error: Float[Array, ""]
    step_uncertainty: Float[Array, ""]

    _unfinished: ClassVar[str] = (
        "Some run ended before most of its paths had left the region: no path of it goes on, or "
        "the probability is below 1e-30. Use more `num_paths`, a longer `duration`, or a function "
        "`inside` that decreases on the way out."
    )

    @property
    def _occurred(self):
        return self.exited

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
    density: AbstractStepDensity | None = None,
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
    - `num_steps`: number N of steps.
    - `density`: as in `sample_events`.
    - `throw`: raise an error at run time if the result is not `trustworthy`.

    **Returns:** `Exits`. The cost grows with the log of the probability, not with its inverse. The
    discretisation error is that of the steps and of `log_survival`. Its estimate takes as much time
    again.

    **Raises:** `ValueError` and `TypeError` for invalid arguments, and for coefficients that depend
    on time.

    **Example:**

    ```python
    exits = jb.sample_exits(key, model, start, 1.0, lambda x: 2.0 - x[0], num_runs=4)
    exits.log_probability, exits.standard_error
    ```
    """
    check_function("inside", inside, "(x)")
    sizes = num_runs, num_paths, num_steps
    checked = check_splitting(key, model, start, duration, *sizes, density)
    start, duration, size, density = checked
    exits = _sample_exits(key, model, start, duration, inside, size, density)
    return throw_where_untrustworthy(exits, "log_probability", model) if throw else exits


class _Population(NamedTuple):
    """Paths of all runs, with lanes last: run after run.

    - `points`: states, and `progress`: the largest -g within each step.
    - `runs`: bookkeeping of the runs; replaced paths that were not finite are counted.
    """

    points: Float[Array, "points d lanes"]
    progress: Float[Array, "N lanes"]
    runs: Runs


# A handful of levels, each of which simulates all paths.
@compiled_for(
    lambda key, model, start, duration, inside, size, density: size.num_lanes * size.num_steps * 4
)
def _sample_exits(
    key: Key[Array, ""],
    model: Diffusion,
    start: Float[Array, " d"],
    duration: Float[Array, ""],
    inside: Callable,
    size: Size,
    density: AbstractStepDensity,
) -> Exits:
    R, n, N = size.all_runs, size.num_paths, size.num_steps
    model, start, duration = nondifferentiable((model, start, duration))
    model = model.prepared()
    dynamics, dt, d = model.forward(start), duration / N, len(start)
    step_to = make_step(density, dynamics, start, dt)
    of_point = lambda x: distances(dynamics, named("inside", inside), x)
    num_bounds = len(of_point(start)[0])

    @over_lanes(-1, -1, -1, -1)
    def step(x, normal, uniform, doubled):
        """Return the next point, and the largest -g on the way."""
        x_next = step_to(x, normal, doubled)
        (g, root), (g_next, next_root) = of_point(x), of_point(x_next)
        spread = -2 * root * next_root * dt * jnp.log(uniform)
        spread = jnp.where(doubled, 2 * spread, spread)
        lowest = (g + g_next - jnp.hypot(g_next - g, jnp.sqrt(spread))) / 2
        return x_next, -jnp.min(lowest)

    def simulated(key, points, progress, kept):
        """Return the paths, simulated anew after the first `kept` steps of each."""

        def one(x, inputs):
            i, old, old_next, old_progress = inputs
            noise_key, uniform_key = jax.random.split(jax.random.fold_in(key, i))
            normal = jax.random.normal(noise_key, x.shape, x.dtype)
            tiny = jnp.finfo(x.dtype).tiny
            uniform = jax.random.uniform(uniform_key, (num_bounds, R * n), x.dtype, minval=tiny)
            x = jnp.where(i <= kept, old, x)
            x_next, largest = step(x, normal, uniform, size.is_doubled(i))
            # The doubled step that follows begins here.
            waits = size.is_doubled(i + 1) & (i + 1 < N)
            x_next, largest = jnp.where(waits, x, x_next), jnp.where(waits, -jnp.inf, largest)
            x_next = jnp.where(i < kept, old_next, x_next)
            largest = jnp.where(i < kept, old_progress, largest)
            # A path that is lost never leaves.
            largest = jnp.where(jnp.isfinite(largest), largest, -jnp.inf)
            return x_next, (x_next, largest)

        inputs = np.arange(N, dtype=np.int32), points[:-1], points[1:], progress
        _, (later, progress) = lax.scan(one, points[0], inputs)
        return jnp.concatenate([points[:1], later]), progress

    def renewed(i, old):
        """Replace the paths of least progress in all runs that go on."""
        parent_key, path_key = jax.random.split(jax.random.fold_in(key, i + 1))
        so_far = lax.cummax(old.progress)
        level = next_level(parent_key, so_far[-1].reshape(R, n), old.runs.over)
        points, progress, so_far = (
            jnp.take(leaf, level.parent, axis=-1) for leaf in (old.points, old.progress, so_far)
        )
        exceeds = so_far > jnp.repeat(level.bound, n)
        replaced = level.replaced.ravel()
        kept = jnp.where(replaced, jnp.argmax(exceeds, axis=0).astype(jnp.int32) + 1, N)
        points, progress = simulated(path_key, points, progress, kept)
        num_lost = jnp.sum(is_lost(old.points) & replaced, dtype=jnp.int32)
        return _Population(points, progress, old.runs.after(level, num_lost))

    points = jnp.broadcast_to(start[:, None], (N + 1, len(start), R * n))
    progress = jnp.full((N, R * n), -jnp.inf, start.dtype)
    points, progress = simulated(
        jax.random.fold_in(key, 0), points, progress, jnp.zeros(R * n, jnp.int32)
    )
    last = run_levels(renewed, _Population(points, progress, new_runs(R, start.dtype)))
    exceeds = lax.cummax(last.progress) > 0
    exited = exceeds[-1].reshape(R, n)
    index = jnp.where(exceeds[-1], jnp.argmax(exceeds, axis=0) + 1, N + 1)
    paths = jnp.moveaxis(last.points.reshape(N + 1, d, R, n), (2, 3), (0, 1))
    fine = slice(size.num_runs)
    found = estimate(last.runs.log_estimates, size, _ORDER, model, density, paths[fine, 0], dt)
    return Exits(
        found.log_probability,
        found.standard_error,
        last.runs.log_estimates[fine],
        dt * jnp.arange(N + 1, dtype=dt.dtype),
        paths[fine],
        exited[fine],
        index.reshape(R, n)[fine].astype(jnp.int32),
        last.runs.num_levels[fine],
        last.runs.num_nonfinite + jnp.sum(is_lost(last.points), dtype=jnp.int32),
        *found.step_error,
    )
