"""The guided particle filter: the likelihood of a record, however long it is.

P particles take guided steps. At the end of each segment their weights are those of paths that end
here, tilted by h: of what is seen later they know as much as the linear process does. Where few of
them count they are resampled, systematically, and go on with equal weights. The product of the
means of the weights, p̂(y), is unbiased (Del Moral 2004, theorem 7.4.2), up to the step error.

Several filters that know nothing of each other make a mean, and its error is told by their spread:
what one filter knows of its own error it has from the particles that it did not lose. And what none
of them knows, as where rare particles far from the guide would weigh more than all others, the
shape k̂ of the largest weights tells at each observation.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.averages import effective_size, normalised
from ..engine.checks import Numbers, as_floating, check_count, check_key, time_steps
from ..engine.compiled import compiled
from ..engine.doors import door
from ..engine.lanes import over_lanes
from ..engine.pareto import pareto_k
from ..engine.throwing import throw_where
from ..exact import log_mean_and_error, transition_log_density
from ..models.diffusion import Diffusion
from ..schemes import AbstractStepDensity, StepError, dominates, error_of_grids, num_coarse_grids
from .cover import cover, covered_start
from .guided_record import Guidance, correction, linearised
from .guided_steps import guided_step
from .initial import Initial, calls_for_cover, log_ratio
from .observation import Observation
from .problem import RecordProblem
from .record import of_each, split_records
from .segments import split_first, split_last
from .several import Records, as_record_problems

# Particles are resampled where fewer than this share of them count.
_FEWEST_EFFECTIVE = 0.5
# Fewer particles that count, or a larger standard error of a log, tell nothing; nor do heavier
# tails: 0.7, and what the largest of many estimates of k exceeds it by.
_FEWEST_TRUSTED, _MOST_SPREAD, _HEAVIEST = 5, 0.5, 0.8

_UNEXPLAINED = (
    "no particle explains some observation (`unexplained` is its number): look whether it is an "
    "outlier that the noise of `observation` has no room for, or take more steps or particles."
)
_DISAGREE = (
    "so few particles count somewhere, or filters disagree so much, that the likelihood and its "
    "error cannot be trusted: take more `num_particles`; across gaps in which the diffusion could "
    "have gone several ways more observations are needed, or `smooth` with a `proposal`."
)
_HEAVY = (
    "at some observation the largest weights are so much larger than the others (`pareto_k` above "
    "0.8; infinite of fewer than 25 particles) that particles which weigh more yet may never have "
    "been drawn: take more `num_particles`, and see whether `value` stays."
)
_STEPS = "the step error is beyond the standard error, or not known: take more `num_steps`."


class LogLikelihood(eqx.Module):
    """What `log_likelihood` returns.

    - `value`: log p̂(y); `exp(value)` is unbiased up to the step error. -inf where no particle
        explains what was seen.
    - `standard_error`: that of `value`, from the spread of the filters by the delta method;
        infinite of a single one.
    - `log_estimates`: log p̂ of each filter, shape (num_filters,).
    - `effective_sample_size`: how many particles count before each observation is followed by
        resampling, the mean over the filters, shape (n,).
    - `pareto_k`: k̂ of the weights of the particles of all filters at each observation, shape (n,),
        or, without an `observation`, of each transition. Above 0.7 `value` is mostly too small, by
        more than `standard_error` tells; rough where there are few particles, and inf of fewer than
        25, unless all weigh the same.
    - `num_nonfinite`: how many particles left the finite numbers or the state space.
    - `step_error`: an estimate of what `value` is too large by for the length of the steps, from
        half as many; `step_uncertainty` is its Monte Carlo error and what it leaves out, by a
        quarter as many, infinite where what steps change does not shrink with them. NaN of one
        step.
    """

    value: Float[Array, ""]
    standard_error: Float[Array, ""]
    log_estimates: Float[Array, " num_filters"]
    effective_sample_size: Float[Array, " n"]
    pareto_k: Float[Array, " n"]
    num_nonfinite: Int[Array, ""]
    step_error: Float[Array, ""]
    step_uncertainty: Float[Array, ""]

    @property
    def unexplained(self) -> Int[Array, ""]:
        """The number of the first observation that no particle explains; -1 where there is none."""
        lost = self.effective_sample_size == 0
        return jnp.where(jnp.any(lost), jnp.argmax(lost), -1)

    @property
    def step_error_dominates(self) -> Bool[Array, ""]:
        """Whether the step error is beyond the standard error, or not known well enough to say:
        then more steps help, and more particles do not."""
        return dominates(StepError(self.step_error, self.step_uncertainty), self.standard_error)

    @property
    def trustworthy(self) -> Bool[Array, ""]:
        """Whether `value` and `standard_error` are to be trusted: particles that count at all
        observations, filters that agree, so that the delta method holds, tails of the weights that
        are not heavy, and a step error that does not dominate."""
        return self._filters_agree & ~self._is_heavy & ~self.step_error_dominates

    @property
    def _is_heavy(self) -> Bool[Array, ""]:
        return jnp.any(self.pareto_k > _HEAVIEST)

    @property
    def _filters_agree(self) -> Bool[Array, ""]:
        counted = jnp.all(self.effective_sample_size >= _FEWEST_TRUSTED)
        return counted & jnp.isfinite(self.value) & (self.standard_error < _MOST_SPREAD)


@door
def log_likelihood(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    observation: Observation | None = None,
    initial: Initial = None,
    num_particles: int = 100,
    num_filters: int = 8,
    num_steps: int | None = None,
    step_size: float | None = None,
    initial_time: Numbers | None = None,
    density: AbstractStepDensity | None = None,
    throw: bool = False,
) -> LogLikelihood:
    """log p(y) of a record that was seen with noise or in part, unbiased on the natural scale.

    **Arguments:**

    - `key`: a typed key.
    - `model`, `times`, `observations`, `observation`, `initial`, `num_steps`, `step_size`,
        `initial_time`, `density`: as in `innovations`. Lists of `times` and of `observations`, or
        a leading axis, are several records, independent given the parameters.
        Without an `observation` the state was seen whole and exactly: the sum of the log transition
        densities by `transition_log_density(proposal="auto")`, given the first.
    - `num_particles`: of each filter.
    - `num_filters`: filters that know nothing of each other, whose spread tells the error.
    - `throw`: raise an error at run time where the result is not `trustworthy`.

    **Returns:** `LogLikelihood`. For a linear model all weights are equal, and `value` is that of
    the Kalman filter of the steps. A stationary law that is not normal is covered by a mixture of
    normal laws at draws of it, and wider ones beyond: `effective_sample_size` says how well in its
    first number. Not differentiable where particles are resampled:
    `innovations` is.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    **Example:**

    ```python
    seen = jb.LinearGaussian(covariance=0.01)
    made = jb.log_likelihood(key, model, times, observations, observation=seen)
    made.value, made.standard_error
    ```
    """
    check_key(key)
    num_particles = check_count("num_particles", num_particles)
    num_filters = check_count("num_filters", num_filters)
    if observation is None:
        if initial is not None or initial_time is not None or density is not None:
            raise ValueError(
                "without an `observation` the first state is given, and steps are those of "
                "`transition_log_density`: leave out `initial`, `initial_time` and `density`."
            )
        made = _exact(key, model, times, observations, num_particles, num_steps, step_size)
        return or_throw(made, model) if throw else made
    arguments = (model, times, observations, observation, initial)
    options = {"step_size": step_size, "initial_time": initial_time, "density": density}
    records = as_record_problems(*arguments, num_steps=num_steps, **options)
    size = num_filters, num_particles
    levels = range(1, 1 + num_coarse_grids(records.stacked.num_steps))
    grids = [records, *map(records.coarsened, levels)]
    made = _told(records, [_estimates(key, grid, _guides(grid), *size) for grid in grids])
    return or_throw(made, model) if throw else made


def or_throw(made: LogLikelihood, model: Diffusion) -> LogLikelihood:
    """The same, whose value raises `RuntimeError` where it is not to be trusted."""
    faults = [
        (made.unexplained >= 0, _UNEXPLAINED),
        (~made._filters_agree, _DISAGREE),
        (made._is_heavy, _HEAVY),
        (made.step_error_dominates, _STEPS),
    ]
    return throw_where(made, "value", model, faults)


@compiled
def _told(records: Records, grids: list["Filtered"]) -> LogLikelihood:
    """What filters on the grid, and on coarser ones, say of all records together."""
    means = [log_mean_and_error(each.log_estimate) for each in grids]
    values = jnp.stack([jnp.sum(log_mean) for log_mean, _, _ in means])
    errors = jnp.stack([jnp.sqrt(jnp.sum(error**2)) for _, error, _ in means])
    (value, *_), (error, *_), fine = values, errors, grids[0]
    # What rounding leaves of the sum over all steps is no change, either.
    rounding = np.sqrt(records.stacked.record.dt.size) * jnp.finfo(value.dtype).eps
    rounding = rounding.astype(value.dtype) * jnp.maximum(1, jnp.abs(value))
    order, num_steps = records.stacked.density.order, records.stacked.num_steps
    step_error = error_of_grids(values, jnp.hypot(errors, rounding), order, num_steps)
    return LogLikelihood(
        value,
        error,
        jnp.sum(fine.log_estimate, axis=0),
        records.at_observations(jnp.mean(fine.size, axis=1)),
        records.at_observations(fine.pareto_k),
        jnp.sum(fine.num_nonfinite),
        *step_error,
    )


def _guides(records: Records) -> Guidance:
    """Of each record, at the parameters of the model."""
    return records.each(lambda problem: linearised(problem, problem.model).guide)


def _exact(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    num_proposals: int,
    num_steps: int | None,
    step_size: float | None,
) -> LogLikelihood:
    """Of observations of the whole state without noise."""
    if step_size is not None:
        raise ValueError("`step_size` is for records with an `observation`: pass `num_steps`.")
    intervals = of_each(_intervals, split_records(times, observations))
    start, end, duration = (jnp.concatenate(each) for each in zip(*intervals, strict=True))
    made = transition_log_density(
        key,
        model,
        start,
        end,
        duration,
        num_proposals=num_proposals,
        num_steps=50 if num_steps is None else num_steps,
        proposal="auto",
    )
    value = jnp.sum(made.value)
    return LogLikelihood(
        value,
        jnp.sqrt(jnp.sum(made.standard_error**2)),
        value[None],
        made.effective_sample_size,
        made.pareto_k,
        jnp.sum(made.num_nonfinite),
        jnp.sum(made.step_error),
        jnp.sqrt(jnp.sum(made.step_uncertainty**2)),
    )


def _intervals(times: Numbers, observations: Numbers) -> tuple[Array, Array, Array]:
    """Start, end and duration of each."""
    times, gaps = time_steps("times", times)
    points = as_floating("observations", observations)
    if points.ndim != 2 or points.shape[0] != times.shape[0]:
        raise ValueError(
            f"`observations` must have shape ({times.shape[0]}, d), a row for each of `times`; got "
            f"{points.shape}."
        )
    return points[:-1], points[1:], gaps


class Filtered(NamedTuple):
    """What filters estimate: log p̂; the effective number of particles at the ends of segments, and
    k̂ of the weights of all; and how many were lost."""

    log_estimate: Float[Array, " R"]
    size: Float[Array, "R ends"]
    pareto_k: Float[Array, " ends"]
    num_nonfinite: Int[Array, " R"]

    def variance(self, num_particles: int) -> Float[Array, " R"]:
        """That of log p̂ to first order, as one filter knows it: of each mean of weights that went
        into p̂, those before resampling and the last. Infinite where no particle is left."""
        share = self.size / num_particles
        counts = _is_poor(self.size, num_particles).at[:, -1].set(True)
        each = jnp.where(share > 0, 1 / share - 1, jnp.inf)
        return jnp.sum(jnp.where(counts, each, 0), axis=1) / num_particles


def _is_poor(size: Float[Array, "..."], num_particles: int) -> Bool[Array, "..."]:
    """Whether so few particles count that they are resampled."""
    return size < _FEWEST_EFFECTIVE * num_particles


@compiled
def _estimates(key: Key[Array, ""], records: Records, guides: Guidance, R: int, P: int) -> Filtered:
    """Of each record."""
    moving = records.moving

    def filters(problem, key, guide):
        return run_filters(key, problem, problem.model, guide, (R, P), moving)

    return records.each(filters, jax.random.split(key, records.number), guides)


class _Particles(NamedTuple):
    """Particles of all filters as lanes, and what is known of the filters."""

    x: Float[Array, "d lanes"]
    log_weight: Float[Array, "R P"]
    log_estimate: Float[Array, " R"]
    num_nonfinite: Int[Array, " R"]


class _Weights(NamedTuple):
    """Of the particles of all filters at the end of a segment: how many are effective in each, and
    log weights, those of each relative to their sum."""

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
    """R filters of P particles. Steps that are known not to be `moving`, whatever the record, take
    no time."""
    R, P = size
    d, dtype = problem.dim, problem.like.dtype
    first_row, rows = split_first(problem.rows)
    density, dynamics_at = problem.density, model.forward_at(problem.like)
    corrected = over_lanes(None, -1)(correction(problem, model))
    most = 0.01 / jnp.finfo(dtype).eps

    def weighed(state: _Particles, key, change) -> tuple[_Particles, _Weights]:
        """With what came to the weights, resampled where that is called for."""
        change = change.reshape(R, P)
        log_weight = state.log_weight + change
        # Of a path that has exploded h is so small that what it is divided by is lost to rounding.
        finite = jnp.all(jnp.isfinite(state.x), axis=0).reshape(R, P) & (change < most)
        log_weight = jnp.where(finite, log_weight, -jnp.inf)
        lost = jnp.sum(~finite & (state.log_weight > -jnp.inf), axis=1, dtype=jnp.int32)
        weights = normalised(log_weight)
        size, relative = effective_size(weights), jnp.log(weights).ravel()
        state = state._replace(log_weight=log_weight, num_nonfinite=state.num_nonfinite + lost)
        poor = _is_poor(size, P)
        resample = lambda: _resampled(key, state, poor)
        return lax.cond(jnp.any(poor), resample, lambda: state), _Weights(size, relative)

    def moved(x, zeta, step, scalars):
        def of_particle(x, zeta):
            law = guided_step(density, dynamics_at, x, step, scalars)
            return law.point(zeta), law.log_weight

        return over_lanes(-1, -1)(of_particle)(x, zeta)

    def one(state, inputs):
        zeta, step, moves = inputs

        def taken(x, log_weight):
            x, change = moved(x, zeta, step, None)
            return x, log_weight + change

        if moves is None:
            return taken(*state), None
        return lax.cond(moves, taken, lambda *state: state, *state), None

    def segment(state: _Particles, inputs):
        number, steps, scalars, row = inputs
        noise_key, resampling_key = jax.random.split(jax.random.fold_in(key, number))
        noise = jax.random.normal(noise_key, (problem.num_steps, d, R * P), dtype)
        before, (zeta, last, _) = split_last((noise, steps, moving))
        (x, change), _ = lax.scan(one, (state.x, jnp.zeros(R * P, dtype)), before)
        x, final = moved(x, zeta, last, scalars)
        change = change + final + corrected(row, x)
        return weighed(state._replace(x=x), resampling_key, change)

    start_key, resampling_key = jax.random.split(jax.random.fold_in(key, 0))
    x, change = _starts(start_key, problem, model, guide, R, P)
    alike, zero = jnp.zeros((R, P), dtype), jnp.zeros(R, dtype)
    state = _Particles(x, alike, zero, jnp.zeros(R, jnp.int32))
    state, first = weighed(state, resampling_key, change + corrected(first_row, x))
    inputs = (1 + jnp.arange(problem.num_segments), guide.steps, guide.scalars, rows)
    state, later = lax.scan(segment, state, inputs)
    log_mean = logsumexp(state.log_weight, axis=1) - jnp.log(jnp.asarray(P, dtype))
    all_ends = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, later)
    k, log_estimate = pareto_k(all_ends.relative), state.log_estimate + log_mean
    return Filtered(log_estimate, all_ends.size.T, k, state.num_nonfinite)


def _starts(
    key: Key[Array, ""], problem: RecordProblem, model: Diffusion, guide: Guidance, R: int, P: int
) -> tuple[Float[Array, "d lanes"], Float[Array, " lanes"]]:
    """The first states of all particles, and their log weights, where observations are of their
    guess. A law that is not normal is covered by a mixture, whose parts each filter takes in
    proportion to their shares."""
    dtype = problem.like.dtype
    noise_key, position_key = jax.random.split(key)
    zeta = jax.random.normal(noise_key, (problem.dim, R * P), dtype)
    if not calls_for_cover(problem.initial, model, problem.like):
        x = over_lanes(-1)(guide.start.point)(zeta)
        ratio = lambda x: log_ratio(problem.initial, model, guide.initial, x)
        return x, guide.start.log_weight + over_lanes(-1)(ratio)(x)
    law = cover(model, guide.initial)
    h = jax.tree.map(lambda leaf: leaf[0, 0], guide.steps.h)
    start = covered_start(law, guide.first, guide.start.origin, h)
    uniform = jax.random.uniform(position_key, (R, 1), dtype)
    positions = (uniform + jnp.arange(P, dtype=dtype)) / P
    x = start.points(positions.ravel(), zeta)
    log_nu = model.prepared().log_stationary
    ratio = lambda x: log_nu(x) - law.log_density(x)
    return x, start.log_weight + over_lanes(-1)(ratio)(x)


def _resampled(key: Key[Array, ""], state: _Particles, poor: Bool[Array, " R"]) -> _Particles:
    """Those filters whose particles are poor with particles that are alike."""
    R, P = state.log_weight.shape
    dtype = state.log_weight.dtype
    weights = normalised(state.log_weight)
    uniform = jax.random.uniform(key, (R, 1), dtype)
    positions = (uniform + jnp.arange(P, dtype=dtype)) / P
    bounds = jnp.cumsum(weights, axis=1)
    bounds = bounds / jnp.maximum(bounds[:, -1:], jnp.finfo(dtype).tiny)
    chosen = jax.vmap(jnp.searchsorted)(bounds, positions)
    chosen = jnp.where(poor[:, None], jnp.minimum(chosen, P - 1), jnp.arange(P, dtype=chosen.dtype))
    lanes = (jnp.arange(R, dtype=chosen.dtype)[:, None] * P + chosen).ravel()
    log_mean = logsumexp(state.log_weight, axis=1) - jnp.log(jnp.asarray(P, dtype))
    # Where no particle is left there is nothing to go on with: the estimate is zero.
    level = jnp.where(poor, log_mean, 0)
    fresh = jnp.where(log_mean > -jnp.inf, 0.0, -jnp.inf)[:, None].astype(dtype)
    log_weight = jnp.where(poor[:, None], fresh, state.log_weight)
    return state._replace(
        x=state.x[:, lanes], log_weight=log_weight, log_estimate=state.log_estimate + level
    )
