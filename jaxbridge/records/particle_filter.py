"""Guided particle filter: an unbiased estimate of the likelihood of a record.

P particles make guided steps. At the end of each segment their weights are those of paths that end
there, times h, the linear process's density of later observations. If the effective sample size is
small, systematic resampling gives particles with equal weights. The product p̂(y) of the means of
the weights is unbiased up to the discretisation error (Del Moral 2004, theorem 7.4.2).

Within a segment the weights are those of paths without h (`guided_steps`). At its end a weight is
multiplied by h there and divided by h at the beginning.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.averages import effective_size, normalise_weights
from ..engine.lanes import over_lanes
from ..engine.pareto import pareto_k
from ..engine.resampling import systematic
from ..models.diffusion import Diffusion
from .cover import cover, covered_start
from .guided_record import Guidance, correction
from .guided_steps import end_of_step, guided_law
from .initial import calls_for_cover, log_ratio
from .problem import RecordProblem
from .segments import split_first, split_last

# Particles are resampled if the effective share of them is below this bound.
_FEWEST_EFFECTIVE = 0.5


class Filtered(NamedTuple):
    """Estimates of R filters.

    - `log_estimate`: log p̂ of each filter.
    - `size`: effective number of particles at the ends of segments.
    - `pareto_k`: k̂ of the weights of all filters at the ends of segments.
    - `num_nonfinite`: number of lost particles of each filter.
    """

    log_estimate: Float[Array, " R"]
    size: Float[Array, "R ends"]
    pareto_k: Float[Array, " ends"]
    num_nonfinite: Int[Array, " R"]

    def variance(self, num_particles: int) -> Float[Array, " R"]:
        """Return the variance of log p̂ to first order, as a single filter estimates it.

        It is the sum over the means of weights that enter p̂: those before resampling, and the
        last. It is infinite if no particle is left.
        """
        share = self.size / num_particles
        counts = _is_poor(self.size, num_particles).at[:, -1].set(True)
        terms = jnp.where(share > 0, 1 / share - 1, jnp.inf)
        return jnp.sum(jnp.where(counts, terms, 0), axis=1) / num_particles


def _is_poor(size: Float[Array, "..."], num_particles: int) -> Bool[Array, "..."]:
    """Return whether the effective sample size is so small that particles are resampled."""
    return size < _FEWEST_EFFECTIVE * num_particles


class _Particles(NamedTuple):
    """Particles of all filters as lanes, and the state of each filter."""

    x: Float[Array, "d lanes"]
    log_weight: Float[Array, "R P"]
    log_estimate: Float[Array, " R"]
    num_nonfinite: Int[Array, " R"]


class _Weights(NamedTuple):
    """Weights of the particles of all filters at the end of a segment.

    - `size`: effective number of particles of each filter.
    - `relative`: log weights relative to their sum within each filter.
    """

    size: Float[Array, " R"]
    relative: Float[Array, " lanes"]


def run_filters(
    key: Key[Array, ""],
    problem: RecordProblem,
    model: Diffusion,
    guide: Guidance,
    size: tuple[int, int],
    moving: Bool[Array, " N"] | None = None,
) -> Filtered:
    """Run R filters with P particles each; `size` is (R, P).

    Steps that are not `moving` have length zero in every record and are skipped.
    """
    R, P = size
    d, dtype = problem.dim, problem.like.dtype
    (first_row, rows), motion = split_first(problem.rows), problem.motion(model)
    corrected = over_lanes(None, -1)(correction(problem, model))
    most = 0.01 / jnp.finfo(dtype).eps

    def reweigh(state: _Particles, key, change) -> tuple[_Particles, _Weights]:
        """Update the weights by `change`, and resample the filters that need it."""
        change = change.reshape(R, P)
        log_weight = state.log_weight + change
        # h of an exploded path is so small that dividing by it leaves only rounding errors.
        finite = jnp.all(jnp.isfinite(state.x), axis=0).reshape(R, P) & (change < most)
        log_weight = jnp.where(finite, log_weight, -jnp.inf)
        lost = jnp.sum(~finite & (state.log_weight > -jnp.inf), axis=1, dtype=jnp.int32)
        weights = normalise_weights(log_weight)
        size, relative = effective_size(weights), jnp.log(weights).ravel()
        state = state._replace(log_weight=log_weight, num_nonfinite=state.num_nonfinite + lost)
        poor = _is_poor(size, P)
        resample = lambda: _resampled(key, state, poor)
        return lax.cond(jnp.any(poor), resample, lambda: state), _Weights(size, relative)

    def step_particles(x, zeta, step, scalars):
        def of_particle(x, zeta):
            law = motion.law(x, step.step)
            knot, log_weight = guided_law(law, step, scalars).point_and_log_weight(zeta)
            return end_of_step(law, knot, is_last=scalars is not None), log_weight

        return over_lanes(-1, -1)(of_particle)(x, zeta)

    def log_h(h, point, x):
        return over_lanes(-1)(lambda x: h.log(x - point))(x)

    def one(state, inputs):
        zeta, step, moves = inputs

        def take_step(x, log_weight):
            x, change = step_particles(x, zeta, step, None)
            return x, log_weight + change

        if moves is None:
            return take_step(*state), None
        # Steps of length zero in all records take no time.
        return lax.cond(moves, take_step, lambda *state: state, *state), None

    def segment(state: _Particles, inputs):
        number, steps, scalars, row = inputs
        noise_key, resampling_key = jax.random.split(jax.random.fold_in(key, number))
        noise = jax.random.normal(noise_key, (problem.num_steps, d, R * P), dtype)
        before, (zeta, last, _) = split_last((noise, steps, moving))
        here, first = state.x, jax.tree.map(lambda leaf: leaf[0], steps)
        (x, change), _ = lax.scan(one, (here, jnp.zeros(R * P, dtype)), before)
        x, final = step_particles(x, zeta, last, scalars)
        # h cancels between the steps of a segment, so only its two ends count.
        tilt = log_h(last.next_h, last.next_point, x) - log_h(first.h, first.point, here)
        change = change + final + tilt + corrected(row, x)
        return reweigh(state._replace(x=x), resampling_key, change)

    start_key, resampling_key = jax.random.split(jax.random.fold_in(key, 0))
    x, change = _starts(start_key, problem, model, guide, R, P)
    alike, zero = jnp.zeros((R, P), dtype), jnp.zeros(R, dtype)
    state = _Particles(x, alike, zero, jnp.zeros(R, jnp.int32))
    state, first = reweigh(state, resampling_key, change + corrected(first_row, x))
    inputs = (1 + jnp.arange(problem.num_segments), guide.steps, guide.scalars, rows)
    state, later = lax.scan(segment, state, inputs)
    log_mean = logsumexp(state.log_weight, axis=1) - jnp.log(jnp.asarray(P, dtype))
    all_ends = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, later)
    k, log_estimate = pareto_k(all_ends.relative), state.log_estimate + log_mean
    return Filtered(log_estimate, all_ends.size.T, k, state.num_nonfinite)


def _starts(
    key: Key[Array, ""], problem: RecordProblem, model: Diffusion, guide: Guidance, R: int, P: int
) -> tuple[Float[Array, "d lanes"], Float[Array, " lanes"]]:
    """Sample the first states of all particles; return them with their log weights under the guess.

    A mixture covers a law that is not normal. Each filter samples the parts of the mixture in
    proportion to their shares.
    """
    dtype = problem.like.dtype
    noise_key, position_key = jax.random.split(key)
    zeta = jax.random.normal(noise_key, (problem.dim, R * P), dtype)
    if not calls_for_cover(problem.initial, model, problem.like):
        x, _ = over_lanes(-1)(guide.start.point_and_log_weight)(zeta)
        ratio = lambda x: log_ratio(problem.initial, model, guide.initial, x)
        return x, guide.start.log_integral + over_lanes(-1)(ratio)(x)
    law = cover(model, guide.initial)
    h = jax.tree.map(lambda leaf: leaf[0, 0], guide.steps.h)
    start = covered_start(law, guide.first, guide.start.origin, h)
    uniform = jax.random.uniform(position_key, (R, 1), dtype)
    # Stratified positions, as in systematic resampling.
    positions = (uniform + jnp.arange(P, dtype=dtype)) / P
    x = start.points(positions.ravel(), zeta)
    return x, start.log_integral + law.log_ratio(model, x)


def _resampled(key: Key[Array, ""], state: _Particles, poor: Bool[Array, " R"]) -> _Particles:
    """Resample the filters whose effective sample size is `poor`; the new weights are equal."""
    R, P = state.log_weight.shape
    dtype = state.log_weight.dtype
    uniform = jax.random.uniform(key, (R, 1), dtype)
    chosen = jax.vmap(systematic)(uniform[:, 0], normalise_weights(state.log_weight))
    chosen = jnp.where(poor[:, None], chosen, jnp.arange(P, dtype=chosen.dtype))
    lanes = (jnp.arange(R, dtype=chosen.dtype)[:, None] * P + chosen).ravel()
    log_mean = logsumexp(state.log_weight, axis=1) - jnp.log(jnp.asarray(P, dtype))
    # If no particle is left, the estimate is zero and all weights stay zero.
    level = jnp.where(poor, log_mean, 0)
    fresh = jnp.where(log_mean > -jnp.inf, 0.0, -jnp.inf)[:, None].astype(dtype)
    log_weight = jnp.where(poor[:, None], fresh, state.log_weight)
    return state._replace(
        x=state.x[:, lanes], log_weight=log_weight, log_estimate=state.log_estimate + level
    )
