"""Log-likelihood of a record of any length, by guided particle filters.

The estimate is the mean of several independent filters, and their spread gives its error. A single
filter underestimates its error because it sees only the surviving particles. All filters may share
an error, for instance if rare particles far from the guide would have the largest weights. The
shape k̂ of the largest weights at each observation shows such errors. Coarser grids give the
discretisation error.

*Standard error.* The log of a filter's estimate is nearly normal, with a variance s² (Bérard, Del
Moral & Doucet 2014). A small sample of such estimates often lacks large ones, and with them most of
the variance. Hence the relative variance of the mean of n estimates is (e^{s²} - 1) / n, with s²
from the logs, unless that of the estimates themselves is larger. It has about n - 1 degrees of
freedom. The standard error is enlarged so that two of them contain 95 % of Student's law.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.checks import Numbers, check_count, check_key
from ..engine.compiled import compiled_sooner
from ..engine.entry import public_entry
from ..engine.keys import key_for
from ..engine.pareto import NEARLY_EQUAL, largest_reliable_k
from ..engine.verdict import (
    AbstractResult,
    Fault,
    Verdict,
    is_too_much_missing,
    throw_where_untrustworthy,
)
from ..exact import log_mean_of_runs, transition_log_density
from ..models.diffusion import Diffusion
from ..models.jumps import JumpsLike
from ..schemes import (
    AbstractStepDensity,
    StepError,
    dominates,
    error_of_grids,
    num_coarse_grids,
    step_faults,
)
from .exact_observations import as_observations
from .forgetting import chosen_of, confirmed, half_will_do, rates_for, undecided
from .guide_search import GuideCheck, linearised
from .guided_record import Guidance, forgetful
from .initial import Initial
from .observations import AbstractObservation
from .particle_filter import Filtered, run_filters
from .several import Records, as_record_problems, on_each_grid, stacked

# An estimate is unreliable with fewer effective particles, or with a larger standard error. The
# largest of many k̂ may exceed its bound by `_LARGEST_OF_MANY` through estimation error alone.
_FEWEST_TRUSTED, _MOST_SPREAD, _LARGEST_OF_MANY = 5, 0.6, 0.1

_UNEXPLAINED = (
    "No particle explains some observation (`unexplained` is its index). Check whether it is an "
    "outlier for the noise of `observation`, or use more steps or particles."
)
_DISAGREE = (
    "The effective sample size is too small at some observation, or filters disagree, so the "
    "likelihood and its error are unreliable. Use more `num_particles`. If several ways are "
    "possible across a gap, add observations, or use `smooth` with a `proposal`."
)
_HEAVY = (
    "At some observation the weights have heavy tails: `pareto_k` is above its bound. The bound is "
    "0.8, less for few particles, and 1 for nearly equal weights; for fewer than 25 particles of "
    "all filters `pareto_k` is infinite. Particles of larger weight may be missing. "
    "Use more `num_particles`, and check that `value` does not change."
)
_LARGEST_K = "k̂ is {:.2f} at observation {}, and its bound {:.2f}"
_LOST = (
    "Many particles left the state space or diverged (`num_nonfinite`). The log-likelihood may be "
    "too small by more than its standard error and 0.05. Use more steps, or coordinates without a "
    "boundary. If the diffusion attains its boundary (for dX = κ(θ - X) dt + σ√X dW if 2κθ < σ²), "
    "no particle represents these paths."
)
# Pilot runs have at most so many filters, or more of few particles. More filters run in batches of
# this size, so that all stages are one program.
_BATCH, _PARTICLES = 8, 1000


class LogLikelihood(AbstractResult):
    """Estimated log-likelihood of a record, from `log_likelihood`.

    Below, n is the number of observations. Several records are joined one after the other. An
    earlier `initial_time` counts with the first observation.

    - `value`: log p̂(y). `exp(value)` is unbiased up to the discretisation error. It is -inf if no
        particle explains the observations.
    - `standard_error`: standard error of `value`, from the spread of the filters, enlarged by
        Student's law for few filters. Infinite for a single filter. Without an `observation` it is
        that of the sum of the log densities.
    - `log_estimates`: log p̂ of each filter, shape (num_filters,).
    - `effective_sample_size`: effective number of particles at each observation, before resampling,
        mean over the filters, shape (n,); without an `observation` that of each transition.
    - `pareto_k`: k̂ of the weights of all filters at each observation, shape (n,): the mean over
        batches of filters. Without an `observation` that of each transition. Above
        0.7 `value` is usually too small by more than `standard_error`. For W < 2,155 weights in a
        batch the limit is 1 - 1 / log10(W). The verdict allows 0.1 more, and 1 for nearly equal
        weights. k̂ is infinite for fewer than 25 weights, unless all are equal.
    - `num_weights`: number of weights at an observation, those of all filters.
    - `num_nonfinite`: number of particles that diverged or left the state space.
    - `step_error`: estimated discretisation bias of `value` (estimate minus limit), from a grid
        with half as many steps. Zero if steps are exact. NaN with one step, unless it is quadratic
        in the noise and therefore split (`density` of `innovations`).
    - `step_uncertainty`: uncertainty of `step_error`: Monte Carlo error, and omitted higher-order
        terms, from a grid with a quarter as many steps. Infinite if changes do not shrink with the
        step size.
    - `forgetting`: discount rate γ of the guide, in units of 1 / time. It is zero if all later
        observations help, as for a linear model.
    - `guide`: diagnostics of the guide of each record; `None` without an `observation`. A poor
        guide is a fault only if weights are poor, too.
    """

    value: Float[Array, ""]
    standard_error: Float[Array, ""]
    log_estimates: Float[Array, " num_filters"]
    effective_sample_size: Float[Array, " readings"]
    pareto_k: Float[Array, " readings"]
    num_weights: int = eqx.field(static=True)
    num_nonfinite: Int[Array, ""]
    step_error: Float[Array, ""]
    step_uncertainty: Float[Array, ""]
    forgetting: Float[Array, ""]
    guide: GuideCheck | None = None

    @property
    def unexplained(self) -> Int[Array, ""]:
        """Return the first index at which `effective_sample_size` is 0, or -1.

        No particle explains the observation there. Without an `observation`, index k is the
        transition to observation k + 1.
        """
        lost = self.effective_sample_size == 0
        return jnp.where(jnp.any(lost), jnp.argmax(lost), -1)

    @property
    def step_error_dominates(self) -> Bool[Array, ""]:
        """Return whether the discretisation error exceeds the standard error, or may do so.

        If true, use more steps; if only the estimate of the error is uncertain, more particles
        help, too (`why()`).
        """
        return dominates(StepError(self.step_error, self.step_uncertainty), self.standard_error)

    @property
    def verdict(self) -> Verdict:
        """Return the faults of the estimate, each with a remedy.

        - an observation that no particle explains;
        - few effective particles, filters that disagree, or a single filter;
        - heavy tails of the weights;
        - a poor guide, together with one of the faults above;
        - lost particles, if they may change `value` by more than 0.05 and the standard error;
        - a discretisation error that is unknown or too uncertain, or that dominates and exceeds
            0.05;
        - a value that is not finite.
        """
        error = StepError(self.step_error, self.step_uncertainty)
        lost, apart, heavy = self.unexplained >= 0, ~self._filters_agree, self._is_heavy
        guide = () if self.guide is None else (self.guide.fault(lost | apart | heavy),)
        return Verdict(
            (
                Fault(lost, _UNEXPLAINED),
                Fault(apart, _DISAGREE),
                Fault(heavy, _HEAVY, _LARGEST_K, self._largest_k),
                *guide,
                Fault(is_too_much_missing(self._missing, self.standard_error), _LOST),
                *step_faults(error, self.standard_error),
            )
        ).with_finite(self.value)

    @property
    def _is_heavy(self) -> Bool[Array, ""]:
        """Return whether some k̂ exceeds the bound for so many weights."""
        return jnp.any(self.pareto_k > self._most_k)

    @property
    def _most_k(self) -> Float[Array, " readings"]:
        """Return the bounds on k̂ for so many weights, larger ones for nearly equal weights."""
        num_filters = max(self.log_estimates.shape[0], 1)
        num_particles = self.num_weights // num_filters
        in_batch = -(-num_filters // _num_batches(num_filters, num_particles))
        most = largest_reliable_k(in_batch * num_particles) + _LARGEST_OF_MANY
        share, most_of_equal = NEARLY_EQUAL
        is_equal = self.effective_sample_size > share * num_particles
        return jnp.where(is_equal, most_of_equal, most).astype(self.pareto_k.dtype)

    @property
    def _largest_k(self) -> tuple[Array, ...]:
        """Return the k̂ farthest above its bound, the index of its observation, and the bound."""
        where = jnp.argmax(self.pareto_k / self._most_k)
        return self.pareto_k[where], where, self._most_k[where]

    @property
    def _missing(self) -> Float[Array, ""]:
        """Return the bias of `value` if lost particles had weights like the others.

        It is the sum over segments of -log(1 - share lost) ≈ share lost.
        """
        return self.num_nonfinite.astype(self.value.dtype) / self.num_weights

    @property
    def _filters_agree(self) -> Bool[Array, ""]:
        """Return whether enough particles are effective and the filters agree."""
        counted = jnp.all(self.effective_sample_size >= _FEWEST_TRUSTED)
        return counted & jnp.isfinite(self.value) & (self.standard_error < _MOST_SPREAD)


@public_entry
def log_likelihood(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    observation: AbstractObservation | None = None,
    initial: Initial = None,
    num_particles: int = 100,
    num_filters: int | None = None,
    num_steps: int | None = None,
    step_size: float | None = None,
    initial_time: Numbers | None = None,
    jumps: JumpsLike = None,
    density: AbstractStepDensity | None = None,
    throw: bool = False,
) -> LogLikelihood:
    """Estimate the log-likelihood of a record by guided particle filters.

    The likelihood estimate `exp(value)` is unbiased up to the discretisation error.

    **Arguments:**

    - `key`: typed key.
    - `model`, `times`, `observations`, `observation`, `initial`, `num_steps`, `step_size`,
        `initial_time`, `jumps`, `density`: as in `innovations`. Pass several independent records as
        lists of `times` and `observations`, or with a leading axis.
    - Without an `observation` the state is observed exactly. Then the result is the sum of the log
        transition densities by `transition_log_density(proposal="auto")`, given the first state.
        Values must not be missing, and coefficients must not depend on time. `num_steps` is 50 by
        default. Do not pass `step_size`, `initial`, `initial_time`, `jumps`, `density` or
        `num_filters`.
    - `num_particles`: particles per filter, by default 100; without an `observation` weighted paths
        per interval.
    - `num_filters`: number of independent filters, by default 8. Their spread gives the error.
    - `throw`: raise an error at run time if the result is not `trustworthy`.

    **Returns:** `LogLikelihood`. For a linear model all weights are equal, and `value` is that of
    the Kalman filter for the same steps. A stationary initial law that is not normal is covered by
    a mixture of normal laws; the first entry of `effective_sample_size` shows how well. The result
    is not differentiable where particles are resampled; use `innovations` for derivatives.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    gaussian = jb.LinearGaussian(covariance=0.01)
    estimate = jb.log_likelihood(key, model, times, observations, observation=gaussian)
    estimate.value, estimate.standard_error
    ```
    """
    check_key(key)
    num_particles = check_count("num_particles", num_particles)
    if observation is None:
        for_records = (initial, initial_time, jumps, density, num_filters)
        if any(value is not None for value in for_records):
            raise ValueError(
                "without an `observation` the state is observed exactly, and "
                "`transition_log_density` computes the result: leave out `initial`, "
                "`initial_time`, `jumps`, `density` and `num_filters`, or pass an `observation`."
            )
        result = _exact_log_likelihood(
            key, model, times, observations, num_particles, num_steps, step_size
        )
        return throw_where_untrustworthy(result, "value", model) if throw else result
    num_filters = check_count("num_filters", 8 if num_filters is None else num_filters)
    arguments = (model, times, observations, observation, initial)
    options = {
        "step_size": step_size,
        "initial_time": initial_time,
        "density": density,
        "jumps": jumps,
    }
    records = as_record_problems(*arguments, num_steps=num_steps, **options)
    size = num_filters, num_particles
    problem = records.stacked
    num_coarse = 0 if problem.density.is_exact else num_coarse_grids(problem.num_steps)
    grids = [records, *map(records.coarsened, range(1, 1 + num_coarse))]
    guides, check = _guides_and_check(grids)
    filtered, rate = _run_stages(key, grids, guides, *size)
    result = _combine_filters(records, filtered, rate, num_filters * num_particles)
    result = dataclasses.replace(result, guide=check)
    return throw_where_untrustworthy(result, "value", model) if throw else result


@compiled_sooner
def _combine_filters(
    records: Records, grids: Filtered, rate: Float[Array, ""], num_weights: int
) -> LogLikelihood:
    """Combine the filters of all records on the grid and on coarser grids into a result."""
    values, errors = jax.vmap(log_mean_of_runs)(grids.log_estimate)
    fine = jax.tree.map(lambda leaf: leaf[0], grids)
    value, error = values[0], errors[0]
    # Differences between grids below the rounding error of the sum over all steps do not count.
    rounding = np.sqrt(records.stacked.record.dt.size) * jnp.finfo(value.dtype).eps
    rounding = rounding.astype(value.dtype) * jnp.maximum(1, jnp.abs(value))
    order, lengths = records.stacked.density.order, records.stacked.record.lengths
    step_error = error_of_grids(values, jnp.hypot(errors, rounding), order, lengths)
    return LogLikelihood(
        value,
        error,
        jnp.sum(fine.log_estimate, axis=0),
        records.at_observations(jnp.mean(fine.size, axis=1), jnp.minimum),
        records.at_observations(fine.pareto_k, jnp.maximum),
        num_weights,
        jnp.sum(fine.num_nonfinite),
        *step_error,
        rate,
    )


def _guides_and_check(grids: list[Records]) -> tuple[list[Guidance], GuideCheck]:
    """Return the guides of all records on each grid, and the diagnostics of those on the first."""
    search = lambda records: records.each(lambda one: linearised(one, one.model)[1:])
    guides, checks = zip(*on_each_grid(search, *grids), strict=True)
    return list(guides), checks[0]


def _exact_log_likelihood(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    num_proposals: int,
    num_steps: int | None,
    step_size: float | None,
) -> LogLikelihood:
    """Estimate the log-likelihood of exact observations of the whole state."""
    if step_size is not None:
        raise ValueError("`step_size` is for records with an `observation`: pass `num_steps`.")
    density = transition_log_density(
        key,
        model,
        *as_observations(model, times, observations),
        num_proposals=num_proposals,
        num_steps=50 if num_steps is None else num_steps,
        proposal="auto",
    )
    value = jnp.sum(density.value)
    return LogLikelihood(
        value,
        jnp.sqrt(jnp.sum(density.standard_error**2)),
        value[None],
        density.effective_sample_size,
        density.pareto_k,
        num_proposals,
        jnp.sum(density.num_nonfinite),
        jnp.sum(density.step_error),
        jnp.sqrt(jnp.sum(density.step_uncertainty**2)),
        jnp.zeros_like(value),
    )


# Kinds of stages, in this order: a pilot run per rate, a confirmation of the best, and final runs.
_PILOT, _CONFIRMATION, _RUN = range(3)


def _num_batches(num_filters: int, num_particles: int) -> int:
    """Return the number of batches of filters."""
    return -(-num_filters // max(_BATCH, _PARTICLES // max(num_particles, 1)))


@compiled_sooner
def _run_stages(
    key: Key[Array, ""], grids: list[Records], guides: list[Guidance], R: int, P: int
) -> tuple[Filtered, Float[Array, ""]]:
    """Run R filters of P particles for all records on each grid, with the chosen discount rate.

    Pilot runs choose the rate in the same loop, so that the filter is compiled once.

    **Returns:** the filters, with a leading axis of grids, and the rate.
    """
    (arrays, other_leaves), number = stacked(*zip(grids, guides, strict=True)), grids[0].number
    rates, num_batches = rates_for(grids[0]), _num_batches(R, P)
    batch = -(-R // num_batches)
    pilot_key = key_for("forgetting", key)
    # Indexed by the kind of stage plus the number of the batch.
    keys = jnp.stack([pilot_key, key_for("confirmed", pilot_key), key])
    later_batches = jnp.arange(1, num_batches)
    keys = jnp.concatenate([keys, jax.vmap(jax.random.fold_in, (None, 0))(key, later_batches)])

    @jax.jit  # traced once, for `eval_shape` and for the loop
    def run(grid, rate, key):
        records, guides = eqx.combine(jax.tree.map(lambda leaf: leaf[grid], arrays), other_leaves)
        moving = records.moving

        def filters(problem, key, guide):
            guide = forgetful(guide, rate)
            return run_filters(key, problem, problem.model, guide, (batch, P), moving)

        return records.each(filters, jax.random.split(key, number), guides)

    def stage(best, inputs):
        grid, rate, kind, which_batch = inputs

        def make(best):
            its_rate = jnp.where(kind == _PILOT, rate, best.rate)
            filtered = run(grid, its_rate, keys[kind + which_batch])
            choices = chosen_of(best, rate, filtered, P), confirmed(best, filtered, P), best
            return jax.tree.map(lambda *leaves: jnp.stack(leaves)[kind], *choices), filtered

        def left_out(best):
            shapes = jax.eval_shape(make, best)[1]
            return best, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

        # Equal weights need no other rate, and rate zero needs no confirmation.
        is_needless = (kind == _PILOT) & best.settled | (kind == _CONFIRMATION) & (best.rate == 0)
        return lax.cond(is_needless, left_out, make, best)

    kinds = np.array([*len(rates) * [_PILOT], _CONFIRMATION, *len(grids) * num_batches * [_RUN]])
    # Pilot runs use the grid with half as many steps, if that is enough.
    on_grid = np.where(kinds == _RUN, 0, int(len(grids) > 1 and half_will_do(grids[0])))
    on_grid[kinds == _RUN] = np.repeat(np.arange(len(grids)), num_batches)
    which_batch = np.zeros_like(kinds)
    which_batch[kinds == _RUN] = np.tile(np.arange(num_batches), len(grids))
    rates = jnp.pad(rates, (0, len(kinds) - len(rates)))
    best, filtered = lax.scan(stage, undecided(rates.dtype), (on_grid, rates, kinds, which_batch))

    by_batch = lambda leaf: leaf[kinds == _RUN].reshape(len(grids), num_batches, *leaf.shape[1:])

    def joined(leaf):
        """Join the filters of all batches. `leaf` has axes of grids, batches, records, filters."""
        leaf = jnp.moveaxis(leaf, 1, 2)
        return leaf.reshape(*leaf.shape[:2], -1, *leaf.shape[4:])[:, :, :R]

    log_estimate, size, pareto_k, num_nonfinite = jax.tree.map(by_batch, filtered)
    of_all = joined(log_estimate), joined(size), jnp.mean(pareto_k, axis=1), joined(num_nonfinite)
    return Filtered(*of_all), best.rate
