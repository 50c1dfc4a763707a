"""Rare events of whole paths, by splitting with moves of their noise (`splitting`).

The event is any condition on a path: where it ends, its mean, its maximum. A path is a function of
its noise z ~ N(0, I). A copy of a path is renewed by moves z' = √(1 - β²) z + β ζ with ζ ~ N(0, I),
which are accepted if the score stays above the level. They leave the law of z given that level
invariant (subset simulation: Au & Beck 2001; Cotter, Roberts, Stuart & White 2013). β is adapted.
"""

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.arguments import check_function
from ..engine.averages import as_path_function
from ..engine.checks import Numbers, check_count, nondifferentiable
from ..engine.compiled import compiled_for
from ..engine.entry import public_entry
from ..engine.lanes import over_lanes
from ..engine.verdict import throw_where_untrustworthy
from ..models.diffusion import Diffusion
from ..schemes import AbstractStepDensity
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

# Acceptance rate of the moves that β is adapted to.
_ACCEPTANCE = 0.4


class Events(AbstractRareEvent):
    """Result of `sample_events`: the probability of an event, and paths on which it occurs.

    - `log_probability`: log of the estimated probability.
    - `standard_error`: standard error of `log_probability`, from the spread of the runs.
    - `log_estimates`: log estimates of all runs, shape (R,).
    - `times`: times of the points of paths, shape (N+1,).
    - `paths`: paths of all runs, shape (R, n, N+1, d).
    - `occurred`: whether the event occurs on each path, shape (R, n). It does on at least half of
        them, unless the verdict says otherwise.
    - `num_levels`: number of levels of each run, shape (R,).
    - `num_nonfinite`: number of simulated paths that were not finite. On them the event does not
        occur.
    - `step_error`: estimated discretisation error of `log_probability`, from R further runs with
        half as many steps; `step_uncertainty`: its standard error.
    """

    log_probability: Float[Array, ""]
    standard_error: Float[Array, ""]
    log_estimates: Float[Array, " R"]
    times: Float[Array, " points"]
    paths: Float[Array, "R n points d"]
    occurred: Bool[Array, "R n"]
    num_levels: Int[Array, " R"]
    num_nonfinite: Int[Array, ""]
    step_error: Float[Array, ""]
    step_uncertainty: Float[Array, ""]

    _unfinished: ClassVar[str] = (
        "Some run ended before the event occurred on most of its paths: no path of it goes on, or "
        "the probability is below 1e-30. Use more `num_paths`, or a function `event` that varies "
        "with the path also far from the event, and increases towards it."
    )

    @property
    def _occurred(self):
        return self.occurred


@public_entry
def sample_events(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    duration: Numbers,
    event: Callable,
    *,
    num_paths: int = 1000,
    num_runs: int = 16,
    num_steps: int = 100,
    num_moves: int = 10,
    density: AbstractStepDensity | None = None,
    throw: bool = False,
) -> Events:
    """Estimate the probability of an event of a path, and sample paths on which it occurs.

    Events may be that X(T) is in a set, or that a mean or a maximum exceeds a bound. For the exit
    from a region `sample_exits` is better: it also sees what happens between the points.

    **Arguments:**

    - `key`: typed key.
    - `model`: the diffusion. Its coefficients must not depend on time.
    - `start`: where all paths begin, shape (d,).
    - `duration`: length of the paths, in units of time.
    - `event`: function of a path of shape (N+1, d), positive where the event occurs. Paths with
        larger values are continued, so it should increase towards the event: for a ball
        `lambda path: radius - jnp.linalg.norm(path[-1] - centre)`, and not only its sign.
    - `num_paths`: number n of paths of a run.
    - `num_runs`: number R of independent runs. Their spread gives the error.
    - `num_steps`: number N of steps.
    - `num_moves`: number of moves of each path after each level. Too few leave copies alike.
    - `density`: density of a step, by default the most accurate one, as in `innovations`. For stiff
        drift and constant σ pass `LocalLinearDensity()`.
    - `throw`: raise an error at run time if the result is not `trustworthy`.

    **Returns:** `Events`. The cost grows with the log of the probability, not with its inverse. The
    discretisation error is that of the probability of the event at the N+1 points. Its estimate
    takes as much time again. Linear models have no such error.

    **Raises:** `ValueError` and `TypeError` for invalid arguments, and for coefficients that depend
    on time.

    **Example:**

    ```python
    high = jb.sample_events(key, model, start, 1.0, lambda path: path[-1, 0] - 2.0, num_runs=4)
    high.log_probability, high.standard_error
    ```
    """
    check_function("event", event, "(path)")
    num_moves = check_count("num_moves", num_moves)
    sizes = num_runs, num_paths, num_steps
    checked = check_splitting(key, model, start, duration, *sizes, density)
    start, duration, size, density = checked
    if density.is_exact:
        size = size._replace(num_coarse=0)
    _check_event(event, jax.ShapeDtypeStruct((size.num_steps + 1, len(start)), start.dtype))
    events = _sample_events(key, model, start, duration, event, size, num_moves, density)
    return throw_where_untrustworthy(events, "log_probability", model) if throw else events


def _check_event(event: Callable, like: jax.ShapeDtypeStruct) -> None:
    """Raise `ValueError` unless `event` returns one real number for each path."""
    value = jax.eval_shape(as_path_function("event", event, like), like)
    if getattr(value, "shape", None) != () or not jnp.issubdtype(value.dtype, jnp.floating):
        raise ValueError(
            f"`event` must return one real number for a path of shape {like.shape}, positive where "
            f"the event occurs; it returned {value}. For several conditions return their `jnp.min`."
        )


class _Population(NamedTuple):
    """Noise of the paths of all runs, with lanes last: run after run.

    - `noise`: the noise of all steps, and `scores`: the values of `event`.
    - `log_scales`: log β of the moves of each run.
    - `runs`: bookkeeping of the runs.
    """

    noise: Float[Array, "N d lanes"]
    scores: Float[Array, " lanes"]
    log_scales: Float[Array, " R"]
    runs: Runs


# About ten levels.
@compiled_for(
    lambda key, model, start, duration, event, size, moves, density: (
        size.num_lanes * size.num_steps * moves * 10
    )
)
def _sample_events(
    key: Key[Array, ""],
    model: Diffusion,
    start: Float[Array, " d"],
    duration: Float[Array, ""],
    event: Callable,
    size: Size,
    num_moves: int,
    density: AbstractStepDensity,
) -> Events:
    R, n, N = size.all_runs, size.num_paths, size.num_steps
    model, start, duration = nondifferentiable((model, start, duration))
    model = model.prepared()
    dynamics, dt, d = model.forward(start), duration / N, len(start)
    shape = N, d, R * n
    score = as_path_function("event", event, jax.ShapeDtypeStruct((N + 1, d), start.dtype))
    step = over_lanes(-1, -1, -1)(make_step(density, dynamics, start, dt))

    def path_of(noise):
        """Return the paths.

        On the coarse grid one step of length 2δ replaces each pair, with the sum of their noise.
        The first step of a pair only leads to the point between both ends.
        """

        def one(carry, inputs):
            before, x, earlier = carry
            i, normal = inputs
            doubled = size.is_doubled(i)
            xi = jnp.where(doubled, (earlier + normal) * np.sqrt(0.5), normal)
            x_next = step(jnp.where(doubled, before, x), xi.astype(x.dtype), doubled)
            return (x, x_next, normal), x_next

        first = jnp.broadcast_to(start[:, None], shape[1:])
        init = first, first, jnp.zeros_like(first)
        later = lax.scan(one, init, (np.arange(N, dtype=np.int32), noise))[1]
        return jnp.concatenate([first[None], later])

    def score_of(noise):
        """Return the score of each path, -inf for one that is not finite, and their number."""
        points = path_of(noise)
        lost = is_lost(points)
        scores = jax.vmap(score, -1)(points).astype(start.dtype)
        return jnp.where(lost | jnp.isnan(scores), -jnp.inf, scores), jnp.sum(lost, dtype=jnp.int32)

    of_lanes = lambda of_runs: jnp.repeat(of_runs, n)

    def renewed(i, old):
        """Replace the paths of the lowest scores in all runs that go on, and move all others."""
        parent_key, move_key = jax.random.split(jax.random.fold_in(key, i + 1))
        level = next_level(parent_key, old.scores.reshape(R, n), old.runs.over)
        noise, scores = (jnp.take(leaf, level.parent, axis=-1) for leaf in (old.noise, old.scores))
        bound, goes_on = of_lanes(level.bound), of_lanes(level.goes_on)

        def move(j, state):
            noise, scores, log_scales, number = state
            beta = of_lanes(jnp.exp(log_scales))
            fresh = jax.random.normal(jax.random.fold_in(move_key, j), shape, start.dtype)
            candidate = jnp.sqrt(1 - beta**2) * noise + beta * fresh
            new, num_lost = score_of(candidate)
            accepted = (new > bound) & goes_on
            rate = jnp.mean(accepted.reshape(R, n).astype(start.dtype), axis=1)
            adapted = jnp.minimum(log_scales + (rate - _ACCEPTANCE), 0)
            return (
                jnp.where(accepted, candidate, noise),
                jnp.where(accepted, new, scores),
                jnp.where(level.goes_on, adapted, log_scales),
                number + num_lost,
            )

        init = noise, scores, old.log_scales, jnp.int32(0)
        noise, scores, log_scales, num_lost = lax.fori_loop(0, num_moves, move, init)
        return _Population(noise, scores, log_scales, old.runs.after(level, num_lost))

    noise = jax.random.normal(jax.random.fold_in(key, 0), shape, start.dtype)
    scores, num_lost = score_of(noise)
    runs, zeros = new_runs(R, start.dtype, num_lost), jnp.zeros(R, start.dtype)
    last = run_levels(renewed, _Population(noise, scores, zeros, runs))
    paths = jnp.moveaxis(path_of(last.noise).reshape(N + 1, d, R, n), (2, 3), (0, 1))
    order, fine = density.usual_order, slice(size.num_runs)
    found = estimate(last.runs.log_estimates, size, order, model, density, paths[fine, 0], dt)
    return Events(
        found.log_probability,
        found.standard_error,
        last.runs.log_estimates[fine],
        dt * jnp.arange(N + 1, dtype=dt.dtype),
        paths[fine],
        last.scores.reshape(R, n)[fine] > 0,
        last.runs.num_levels[fine],
        last.runs.num_nonfinite,
        *found.step_error,
    )
