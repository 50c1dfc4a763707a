"""Forecasts of a record: the law of each reading given the earlier ones, and of later states.

Particles take the model's own steps, without a guide, to the next reading. There they are a sample
of the predictive law of the state, and readings drawn from them one of the predictive law of the
reading. Then each repeats its last step, conditioned on what was read. Its weight is the density of
the reading at the beginning of that step: exact readings have positive weights, too. Systematic
resampling gives particles with equal weights.

If the model is right, the rank of a reading among draws of its predictive law is uniform, and
independent of the others (Rosenblatt 1952; Diebold, Gunther & Tay 1998).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import gammaincc, logsumexp, ndtri
from jaxtyping import Array, Float, Int, Key

from ..engine.arguments import check_instance
from ..engine.averages import effective_size, nan_to_neg_inf, normalise_weights
from ..engine.checks import Numbers, as_floating, check_count, check_key, is_traced
from ..engine.compiled import compiled, compiled_sooner
from ..engine.diagnostics import p_uniform
from ..engine.entry import public_entry
from ..engine.lanes import over_lanes
from ..engine.resampling import systematic
from ..engine.times import Times
from ..engine.verdict import AbstractResult, Fault, Verdict, throw_where_untrustworthy
from ..models.diffusion import Diffusion
from ..models.jumps import Jumps, JumpsLike
from ..schemes import AbstractStepDensity, StepError, share_of_grid, step_faults, unknown_where
from .cover import cover, covered_start
from .guided_record import correction
from .guided_steps import Guide, end_of_step, guided_law, guided_start
from .initial import Initial, calls_for_cover, initial_law
from .observations import AbstractObservation, Scalars, missing_like
from .problem import RecordProblem
from .record import as_times_and_rows, check_is_one
from .segments import split_first, split_last
from .several import as_record_problems
from .step_regime import steps_are_too_long
from .tilted_step import Information

# Draws from fewer effective particles are too much alike.
_FEWEST_PARTICLES = 20
_MOST_LAGS = 10
_MOST_LOST = 0.01
_LOST = (
    "More than 1 % of the particles left the state space or the finite numbers before some time. "
    "Their draws are NaN, and ranks and scores leave them out. Use shorter steps (`num_steps`, "
    "`step_size`), or coordinates without a boundary (`transform`)."
)
_POOR = (
    "Few particles explain some reading: `effective_sample_size` is below 20. Later draws, scores "
    "and ranks depend on few paths. Use more `num_particles`; a reading that the model hardly "
    "allows may be an outlier, or the model may be wrong."
)


class Forecast(AbstractResult):
    """Predictive laws of a record of n readings and at F later times, from `forecast`.

    All draws have equal weights. P is the number of particles. Draws of a particle that left the
    state space are NaN; more than 1 % of them are a fault.

    - `times`: those of the readings and the later ones, shape (n + F,).
    - `states`: draws of the state at each time, given the readings *before* it, shape
        (P, n + F, d).
    - `readings`: draws of the reading at each time, given those before it, shape (P, n + F, m).
    - `filtered`: draws of the state at each time, given the readings up to this time, shape
        (P, n + F, d).
    - `uniforms`: rank of each component of a reading among its predictive draws, in (0, 1), shape
        (n, m). Ties are broken at random. NaN where nothing was read. A reading beyond all draws
        has a rank of about 1/P, so residuals of outliers are at most about 3.3 for P = 1,000.
    - `log_scores`: log of the predictive density of each reading, shape (n,). Their sum estimates
        the log-likelihood.
    - `crps`: continuous ranked probability score of each component, in its unit; smaller is better.
        Shape (n, m).
    - `effective_sample_size`: effective number of particles at each reading, shape (n,).
    - `step_error`: estimated discretisation error of `states`, the largest of all times: the root
        of the sum of the squared errors of the mean, in standard deviations, and of the log of the
        standard deviation; shape (). NaN for a single step. `step_uncertainty` is its standard
        error.
    """

    times: Float[np.ndarray, " times"] | Float[Array, " times"]
    states: Float[Array, "P times d"]
    readings: Float[Array, "P times m"]
    filtered: Float[Array, "P times d"]
    uniforms: Float[Array, "readings m"]
    log_scores: Float[Array, " readings"]
    crps: Float[Array, "readings m"]
    effective_sample_size: Float[Array, " readings"]
    step_error: Float[Array, ""]
    step_uncertainty: Float[Array, ""]

    @property
    def residuals(self) -> Float[Array, "readings m"]:
        """Return the quantiles of N(0, 1) at `uniforms`.

        They are independent and normal if the model is right.
        """
        return ndtri(self.uniforms)

    @property
    def p_uniform(self) -> Float[Array, " m"]:
        """Return the p-value of Neyman's smooth test (1937) that `uniforms` are uniform.

        Shape (m,). It compares four moments, those of the first Legendre polynomials. A wrong
        level, σ or law of the noise usually makes it small.
        """
        return p_uniform(self.uniforms)

    @property
    def p_independent(self) -> Float[Array, " m"]:
        """Return the p-value of Ljung and Box's test that `residuals` are not correlated.

        Shape (m,). It has 10 lags, or a fifth of the readings. A wrong drift usually makes it
        small.
        """
        return _p_independent(self.residuals)

    @property
    def verdict(self) -> Verdict:
        """Return the possible faults: few effective particles, lost ones, a discretisation error
        that is unknown or exceeds 0.05 standard deviations, or a score that is not finite.

        The tests of the model, `p_uniform` and `p_independent`, are no part of it.
        """
        poor = jnp.any(self.effective_sample_size < _FEWEST_PARTICLES)
        lost = jnp.mean(~jnp.all(jnp.isfinite(self.states), axis=-1), axis=0)
        faults = Fault(poor, _POOR), Fault(jnp.any(lost > _MOST_LOST), _LOST)
        of_mean = jnp.asarray(len(self.states) ** -0.5, self.step_error.dtype)
        steps = step_faults(StepError(self.step_error, self.step_uncertainty), of_mean)
        return Verdict((*faults, *steps)).with_finite(jnp.nansum(self.log_scores))


@compiled_sooner
def _p_independent(residuals: Float[Array, "n m"]) -> Float[Array, " m"]:
    """Return the p-value of the test of Ljung & Box (1978) that the columns are not correlated."""
    # Missing readings are left out: the others follow each other.
    order = jnp.argsort(jnp.isnan(residuals), axis=0, stable=True)
    z = jnp.take_along_axis(residuals, order, axis=0)
    n = jnp.sum(~jnp.isnan(z), axis=0).astype(z.dtype)
    lags = jnp.clip(n // 5, 1, _MOST_LAGS)
    centred = jnp.nan_to_num(z - jnp.nanmean(z, axis=0))
    variance = jnp.sum(centred**2, axis=0)

    def term(lag):
        product = jnp.sum(centred[lag:] * centred[: len(z) - lag], axis=0)
        counts = (lag <= lags) & (lag < n)
        return jnp.where(counts, (product / variance) ** 2 / jnp.maximum(n - lag, 1), 0)

    most = min(_MOST_LAGS, len(z) - 1)
    statistic = n * (n + 2) * sum(term(lag) for lag in range(1, most + 1))
    return gammaincc(lags / 2, statistic / 2)


@public_entry
def forecast(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    observation: AbstractObservation,
    initial: Initial = None,
    at: Numbers | None = None,
    num_particles: int | None = None,
    num_steps: int | None = None,
    step_size: float | None = None,
    initial_time: Numbers | None = None,
    jumps: JumpsLike = None,
    density: AbstractStepDensity | None = None,
    after: Forecast | None = None,
    throw: bool = False,
) -> Forecast:
    """Forecast each reading of a record from the earlier ones, and states and readings after it.

    The ranks of the readings among their forecasts check the model: see `Forecast`. If the model
    was fitted to the same record, the tests are somewhat too kind.

    **Arguments:**

    - `key`: a typed key.
    - `model`: the diffusion at fixed parameters. For forecasts with uncertain parameters, call this
        function under `jax.vmap` over draws of a posterior.
    - `times`, `observations`, `observation`, `initial`, `num_steps`, `step_size`, `initial_time`,
        `jumps`, `density`: as in `innovations`, for one record. Jumps may be later, too. The
        observation model must have `sample`; for exact readings pass
        `LinearGaussian(covariance=0.0)`.
    - `at`: later times, increasing, shape (F,); by default none.
    - `num_particles`: P, by default 1,000.
    - `after`: an earlier result, to continue its record. `times` and `observations` are then the
        later ones only, so the cost does not grow with the record. The particles go on from the
        last reading of `after`: omit `initial` and `num_particles`. Earlier `jumps` do not count.
        Inside `jit` and `vmap` pass the time of this reading as `initial_time`.
    - `throw`: raise an error at run time if the result is not `trustworthy`, or if a parameter is
        not finite.

    **Returns:** `Forecast`.

    **Raises:** `ValueError` and `TypeError` for invalid arguments, for several records, and for an
    `ObservationDensity` without `sample`.

    **Example:**

    ```python
    model, observation = jb.ornstein_uhlenbeck([[1.0]]), jb.LinearGaussian(covariance=0.1)
    past = [0.0, 1.0, 2.0], [0.3, 0.1, 0.6]
    made = jb.forecast(key, model, *past, observation=observation, at=[3.0, 4.0])
    jnp.quantile(made.readings[:, -2:, 0], jnp.array([0.05, 0.95]), axis=0)  # bands, shape (2, 2)
    ```

    **Source:** bootstrap filter of Gordon, Salmond & Smith (1993), with a conditioned last step.
    """
    check_key(key)
    check_is_one("forecast", times, observations, "call it")
    particles = None
    if after is not None:
        if initial is not None or num_particles is not None:
            raise ValueError(
                "with `after` the start is its last particles: omit `initial` and `num_particles`."
            )
        particles, initial_time = _last_particles(after, initial_time)
        initial, num_particles = jnp.nanmean(particles, axis=0), len(particles)
        if isinstance(jumps, Jumps):
            jumps = jumps.since(float(np.asarray(initial_time)))
    num_particles = 1000 if num_particles is None else num_particles
    num_particles = check_count("num_particles", num_particles, 2)
    checked_times, rows = as_times_and_rows(times, observations)
    at = () if at is None else at
    later = as_floating("at", at)
    _check_order(checked_times, at, later, None if after is None else initial_time)
    num_times = len(rows) + len(later)
    if later.size:
        times, observations = _with_later(times, rows, at, len(later))
    records = as_record_problems(
        model,
        times,
        observations,
        observation,
        initial,
        num_steps=num_steps,
        step_size=step_size,
        initial_time=initial_time,
        jumps=jumps,
        density=density,
        any_constant=True,
    )
    observation.check_sample()
    problem = records.problem(0)
    since, which = problem.record.since, problem.record.which
    states, readings, filtered, scores = _run(key, problem, num_particles, particles)
    step_error = jnp.zeros((2,), states.dtype)
    if num_times > 1 and not problem.density.is_exact:
        coarse, *_ = _run(key, records.coarsened().problem(0), num_particles, particles)
        share = share_of_grid(problem.density.order, problem.record.lengths)
        step_error = _step_error(problem, states, coarse, which[1:], share)
    num_read = num_times - len(later)
    of_times = lambda draws: jnp.swapaxes(draws[which], 0, 1)
    all_times = problem.record.clock.exactly(since[which])
    if not is_traced(times, at):  # `after` needs them without rounding errors
        all_times = np.append(np.asarray(checked_times.values), np.asarray(at, float))
    made = Forecast(
        all_times,
        of_times(states),
        of_times(readings),
        of_times(filtered),
        *(score[which[:num_read]] for score in scores),
        *step_error,
    )
    return throw_where_untrustworthy(made, "states", model) if throw else made


@compiled_sooner
def _step_error(
    problem: RecordProblem,
    states: Float[Array, "ends P d"],
    coarse: Float[Array, "ends P d"],
    which: Int[Array, " times"],
    share: float,
) -> StepError:
    """Return the largest step error of the laws of `states`, from those by twice the step size."""
    laws = [(jnp.nanmean(x, axis=1), jnp.nanstd(x, axis=1)) for x in (states, coarse)]
    path = jnp.append(jnp.repeat(laws[0][0][:-1], problem.num_steps, axis=0), laws[0][0][-1:], 0)
    too_long = steps_are_too_long(problem, problem.model, path)
    (mean, sd), (its_mean, its_sd) = jax.tree.map(lambda leaf: leaf[which], laws)
    is_lost = jnp.mean(~jnp.isfinite(coarse[which]), axis=1) > _MOST_LOST
    is_known = jnp.isfinite(mean + sd + its_mean + its_sd) & ~is_lost
    varies = is_known & (sd > 1e-6 * jnp.max(sd, initial=0, where=is_known)) & (its_sd > 0)
    shift = jnp.where(varies, its_mean - mean, 0) / jnp.where(varies, sd, 1)
    spread = jnp.log(jnp.where(varies, its_sd, 1) / jnp.where(varies, sd, 1))
    squares = jnp.max(jnp.mean(shift**2 + spread**2, axis=-1), initial=0)
    # Of normal draws a square has the mean 2/P + 1/P. The largest of n is greater by 4 log(n) / P.
    by_chance = (3 + 4 * math.log(max(len(which), 1))) / states.shape[1]
    value = share * jnp.sqrt(jnp.maximum(squares - by_chance, 0))
    error = StepError(value, jnp.full_like(value, share * by_chance**0.5))
    return unknown_where(too_long | ~jnp.all(is_known), error)


def _last_particles(
    after: Forecast, initial_time: Numbers | None
) -> tuple[Float[Array, "P d"], Numbers]:
    """Return the particles at the last reading of `after`, and the time of this reading.

    **Raises:** `TypeError` for another object; `ValueError` if the time is unknown.
    """
    check_instance("after", after, Forecast, "a result of `forecast`")
    last = len(after.log_scores) - 1
    particles = after.filtered[:, last]
    if initial_time is not None:
        return particles, initial_time
    if is_traced(after.times):
        raise ValueError(
            "inside `jit` and `vmap` the times of `after` are unknown: pass the time of its last "
            "reading as `initial_time`."
        )
    return particles, float(after.times[last])


def _check_order(
    times: Times, at: Numbers, later: Float[Array, "..."], begin: Numbers | None
) -> None:
    """Raise `ValueError` unless `times` follow `begin` and `at` follows `times`.

    Traced times are not checked.
    """
    if later.ndim != 1:
        raise ValueError(f"`at` must have shape (F,); got shape {later.shape}.")
    if begin is not None and not is_traced(times, begin):
        first, last = float(times.values[0]), float(np.asarray(begin))
        if first <= last:
            raise ValueError(
                f"`times` must begin after the last reading of `after`, at {last:g}; they begin at "
                f"{first:g}."
            )
    if later.size and not is_traced(times, at):
        all_times = np.append(np.asarray(times.values)[-1:], np.asarray(at, float))
        if not np.all(np.diff(all_times) > 0):
            raise ValueError(
                f"`at` must increase, and begin after the last of `times`, {all_times[0]:g}; got "
                f"{all_times[1:]}."
            )


class _Scores(NamedTuple):
    """Scores of one reading by its predictive draws, with the names of `Forecast`."""

    uniforms: Float[Array, " m"]
    log_scores: Float[Array, ""]
    crps: Float[Array, " m"]
    effective_sample_size: Float[Array, ""]


@compiled
def _run(
    key: Key[Array, ""], problem: RecordProblem, P: int, particles: Float[Array, "P d"] | None
):
    """Return predicted states, readings, filtered states and scores at all ends of segments.

    The first states are `particles`, or draws of the initial law.
    """
    model, d, dtype = problem.model, problem.dim, problem.like.dtype
    motion, observation = problem.motion(model), problem.observation
    corrected = over_lanes(None, -1)(correction(problem, model))
    zeros = jnp.zeros(d, dtype)
    nothing = Information(zeros, jnp.zeros((d, d), dtype))

    def take(x, zeta, step, scalars):
        """Take the model's own step, conditioned on `scalars` at its end if they are given."""

        def of_particle(x, zeta):
            law = motion.law(x, step)
            guide = Guide(zeros, nothing, zeros, nothing, step)
            knot, log_weight = guided_law(law, guide, scalars).point_and_log_weight(zeta)
            return end_of_step(law, knot, is_last=scalars is not None), log_weight

        return over_lanes(-1, -1)(of_particle)(x, zeta)

    def read(key, x, after, log_weight, row):
        """Predict and score a reading; return the particles after it with equal weights."""
        sample_key, tie_key, resampling_key = jax.random.split(key, 3)
        keys, is_read = jax.random.split(sample_key, P), jnp.any(jnp.isfinite(row.y))
        draw = lambda key, x: observation.sample(key, x, model.params, row.time)
        readings = jax.vmap(draw)(keys, x.T)
        log_weight = log_weight + corrected(row, after)
        log_weight = nan_to_neg_inf(log_weight)
        weights = normalise_weights(log_weight)
        order = systematic(jax.random.uniform(resampling_key, (), dtype), weights)
        filtered = after[:, jnp.where(is_read, order, jnp.arange(P))]
        log_score = logsumexp(log_weight) - jnp.log(jnp.asarray(P, dtype))
        scores = _Scores(
            _rank(tie_key, row.y, readings),
            jnp.where(is_read, log_score, jnp.nan),
            _crps(row.y, readings),
            jnp.where(is_read, effective_size(weights), P),
        )
        return filtered, (x.T, readings, filtered.T, scores)

    def segment(x, inputs):
        number, steps, scalars, row = inputs
        noise_key, read_key = jax.random.split(jax.random.fold_in(key, number))
        noise = jax.random.normal(noise_key, (problem.num_steps + 1, d, P), dtype)
        before, last = split_last(steps)

        def one(x, inputs):
            zeta, step = inputs
            return take(x, zeta, step, None)[0], None

        x, _ = lax.scan(one, x, (noise[:-2], before))
        # Without a reading both are the same step, so that later draws are paths.
        repeated = jnp.where(jnp.any(scalars.seen), noise[-1], noise[-2])
        predicted, _ = take(x, noise[-2], last, missing_like(scalars))
        after, log_weight = take(x, repeated, last, scalars)
        return read(read_key, predicted, after, log_weight, row)

    (first_row, rows) = split_first(problem.rows)
    first, scalars = split_first(problem.scalars(model))
    start_key, read_key = jax.random.split(jax.random.fold_in(key, 0))
    if particles is None:
        predicted, after, log_weight = _starts(start_key, problem, first, nothing, P)
    else:
        predicted = after = particles.astype(dtype).T
        log_weight = jnp.zeros(P, dtype)  # their last reading is already in them
    x, made_first = read(read_key, predicted, after, log_weight, first_row)
    inputs = (1 + jnp.arange(problem.num_segments), problem.steps(model), scalars, rows)
    _, later = lax.scan(segment, x, inputs)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), made_first, later)


def _starts(key, problem: RecordProblem, first: Scalars, nothing: Information, P: int):
    """Return first states, the same given their reading, and the log weights of the latter."""
    model, d, dtype = problem.model, problem.dim, problem.like.dtype
    noise_key, position_key, resampling_key = jax.random.split(key, 3)
    zeta, repeated = jax.random.normal(noise_key, (2, d, P), dtype)
    repeated = jnp.where(jnp.any(first.seen), repeated, zeta)
    normal = initial_law(problem.initial, model, problem.like)
    zeros = jnp.zeros(d, dtype)
    if not calls_for_cover(problem.initial, model, problem.like):
        law = lambda scalars: guided_start(normal, scalars, zeros, nothing)
        x, _ = over_lanes(-1)(law(missing_like(first)).point_and_log_weight)(zeta)
        after, log_weight = over_lanes(-1)(law(first).point_and_log_weight)(repeated)
        return x, after, log_weight
    law = cover(model, normal)
    positions = (jax.random.uniform(position_key, (), dtype) + jnp.arange(P, dtype=dtype)) / P
    x = law.points(positions, zeta.T).T
    weights = normalise_weights(nan_to_neg_inf(law.log_ratio(model, x)))
    predicted = x[:, systematic(jax.random.uniform(resampling_key, (), dtype), weights)]
    given = covered_start(law, first, zeros, nothing)
    x = given.points(positions, repeated)
    log_weight = given.log_integral + law.log_ratio(model, x)
    is_read = jnp.any(first.seen)
    return predicted, jnp.where(is_read, x, predicted), jnp.where(is_read, log_weight, 0)


def _rank(key, y: Float[Array, " m"], draws: Float[Array, "P m"]) -> Float[Array, " m"]:
    """Return the rank of y among the draws, in (0, 1); uniform if y has the law of the draws."""
    counts = (jnp.sum(which, axis=0) for which in (draws < y, draws == y, jnp.isfinite(draws)))
    below, ties, number = (count.astype(y.dtype) for count in counts)
    position = jax.random.uniform(key, y.shape, y.dtype)
    # Inside of (0, 1), so that residuals are finite.
    least = float(jnp.finfo(y.dtype).eps)
    rank = jnp.clip((below + position * (1 + ties)) / (number + 1), least, 1 - least)
    return jnp.where(jnp.isnan(y), jnp.nan, rank)


def _crps(y: Float[Array, " m"], draws: Float[Array, "P m"]) -> Float[Array, " m"]:
    """Return E|Y - y| - E|Y - Y'|/2 for independent draws Y, Y' (Gneiting & Raftery 2007)."""
    draws = jnp.sort(jnp.where(jnp.isfinite(draws), draws, jnp.nan), axis=0)  # NaN last
    exists = ~jnp.isnan(draws)
    P, i = jnp.sum(exists, axis=0).astype(y.dtype), jnp.arange(len(draws), dtype=y.dtype)[:, None]
    terms = jnp.abs(draws - y) - (2 * i - P + 1) * draws / P
    return jnp.sum(jnp.where(exists, terms, 0), axis=0) / P


def _with_later(times: Numbers, rows: Float[Array, "n m"], at: Numbers, num_later: int):
    """Return the record with missing readings at `num_later` later times.

    Times are joined in double precision, unless they are traced.
    """
    xp = jnp if is_traced(times, at) else np
    joined = xp.concatenate([xp.asarray(part, float) for part in (times, at)])
    missing = jnp.full((num_later, rows.shape[1]), jnp.nan, rows.dtype)
    return joined, jnp.concatenate([rows, missing])
