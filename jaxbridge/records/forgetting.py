"""Discount rate of a guide: how fast it reduces the influence of later observations.

A guide is linearised along one of many possible paths. Other paths may lead elsewhere (wells,
spikes, chaos). Then the linear process is too certain about observations far ahead, and guided
particles may miss the paths of largest weight. Hence h_i is computed from h_{i+1} to the power
exp(-γ δ), with a discount rate γ. Weights are exact for every h; only their variance depends on γ.

*Choice of the rate.* By Jensen's inequality E log p̂ is below log p, by about half the variance of
log p̂ plus the effect of missed paths (Maddison et al. 2017). Hence the chosen rate maximises the
mean of log p̂ over pilot filters, minus two standard errors. For a linear model all weights are
equal without a discount, and the rate is zero. The best of several rates may be best by chance. So
it must also be better than no discount in a second set of pilot runs.

*Chains over parameters* use one rate for all parameters. If nearly every p̂ is too small in a
region, the chain avoids this region and cannot detect the error. The loss of a rate is the decrease
of the mean of log p̂ below that at the best rate. It is computed at several parameters, which are
about as likely as those of the chains. The chosen rate has the smallest mean loss. The log of the
mean of p̂ would be a worse criterion for two reasons. With few pilot runs a single large estimate
decides it. And with a rate that is too low, chains stay where it is sufficient, which seems to
confirm it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..engine.averages import nan_to_neg_inf
from .particle_filter import Filtered
from .several import Records

# Rates γ times the mean time between observations. Below the variance `_ALL_EQUAL` of log p̂ all
# weights count as equal. A larger variance does not show whether all filters miss the same paths.
_RATES, _ALL_EQUAL = (0.0, 0.5, 2.0, 8.0, 64.0), 1e-4
# Parameters count if log p̂ is at most `_LIKELY` below the largest. The loss of each is bounded, so
# that a single parameter does not decide.
_LIKELY, _LARGEST_LOSS = 10.0, 5.0
# With so few steps per segment, a single step discounts almost everything or nothing. Pilot runs
# then use the full grid.
_FEW_STEPS = 4
# log p̂ of a filter that lost all its particles, below that of the best filter.
_LOST = 50.0


class RateChoice(NamedTuple):
    """Best discount rate so far.

    - `rate`: the rate.
    - `score`: mean of log p̂ at this rate, minus two standard errors.
    - `of_none`: the score without a discount.
    - `settled`: whether all weights were equal at some rate. Then no other rate needs a pilot run.
    """

    rate: Float[Array, ""]
    score: Float[Array, ""]
    of_none: Float[Array, ""]
    settled: Bool[Array, ""]


def rates_for(records: Records) -> Float[Array, " rates"]:
    """Return the rates to try, in increasing order from zero."""
    record = records.stacked.record
    num_seen = jnp.sum(jnp.any(jnp.isfinite(record.values), axis=-1))
    rates = jnp.asarray(_RATES, record.dt.dtype)
    return rates * jnp.maximum(num_seen, 1).astype(rates.dtype) / jnp.sum(record.dt)


def half_will_do(records: Records) -> bool:
    """Return whether pilot runs may use half as many steps."""
    return records.stacked.record.num_equal_steps > _FEW_STEPS


def undecided(dtype) -> RateChoice:
    """Return the choice before any pilot run."""
    lowest = jnp.full((), -jnp.inf, dtype)
    return RateChoice(jnp.zeros((), dtype), lowest, lowest, jnp.zeros((), bool))


def chosen_of(
    best: RateChoice, rate: Float[Array, ""], filtered: Filtered, num_particles: int
) -> RateChoice:
    """Return the choice, with `rate` if its score is higher.

    The score is the mean of log p̂ minus two standard errors.
    `filtered` holds the pilot filters of all records at `rate`.
    """
    score, variance = _score_and_variance(filtered, num_particles)
    return RateChoice(
        jnp.where(score > best.score, rate, best.rate),
        jnp.maximum(score, best.score),
        jnp.where(rate == 0, score, best.of_none),
        best.settled | (variance < _ALL_EQUAL),
    )


def confirmed(best: RateChoice, filtered: Filtered, num_particles: int) -> RateChoice:
    """Return the choice, with rate zero unless a second set of filters confirms its rate.

    It is confirmed if the second score exceeds the score without a discount.
    """
    score, _ = _score_and_variance(filtered, num_particles)
    return best._replace(rate=jnp.where(score > best.of_none, best.rate, 0))


def _score_and_variance(
    filtered: Filtered, num_particles: int
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the mean of log p̂ minus two standard errors, and the variance of log p̂."""
    log_estimate, R = _bound_lost(filtered.log_estimate), filtered.log_estimate.shape[1]
    variance = _variance(log_estimate, filtered, num_particles)
    mean = jnp.sum(jnp.mean(log_estimate, axis=1))
    return nan_to_neg_inf(mean - 2 * jnp.sqrt(variance / R)), variance


def _bound_lost(log_estimate: Float[Array, "records R"]) -> Float[Array, "records R"]:
    """Bound log p̂ from below, for filters that lost all particles while others did not."""
    best = jnp.max(log_estimate, axis=1, keepdims=True)
    return jnp.maximum(log_estimate, best - _LOST)


def _variance(
    log_estimate: Float[Array, "records R"], filtered: Filtered, num_particles: int
) -> Float[Array, ""]:
    """Return the variance of log p̂ of all records.

    For each record it is the larger of the filters' own estimate and of the variance between
    filters.
    """
    estimated = jnp.mean(
        jax.vmap(lambda filters: filters.variance(num_particles))(filtered), axis=1
    )
    spread = jnp.var(log_estimate, axis=1, ddof=min(1, log_estimate.shape[1] - 1))
    return jnp.sum(jnp.maximum(estimated, spread))


def rate_for_several(
    run: Callable[[Float[Array, ""]], Filtered], records: Records, num_particles: int
) -> Float[Array, ""]:
    """Return the common rate for several models.

    `run` evaluates filters at a rate; its results have a leading axis of models. If all weights are
    equal for all models without a discount, no other rate is tried.
    """

    def mean_and_equal(filtered: Filtered):
        log_estimate = _bound_lost(filtered.log_estimate)
        variance = _variance(log_estimate, filtered, num_particles)
        return nan_to_neg_inf(jnp.sum(jnp.mean(log_estimate, axis=1))), variance < _ALL_EQUAL

    def tried(settled, rate):
        def try_it():
            means, equal = jax.vmap(mean_and_equal)(run(rate))
            return jnp.all(equal) & (rate == 0), means

        left_out = lambda: (settled, jnp.full(shape, -jnp.inf, rates.dtype))
        return lax.cond(settled, left_out, try_it)

    rates = rates_for(records)
    shape = jax.eval_shape(run, rates[0]).log_estimate.shape[:1]
    _, means = lax.scan(tried, jnp.zeros((), bool), rates)
    return rates[loses_least(means)]


def loses_least(means: Float[Array, "rates models"]) -> Int[Array, ""]:
    """Return the index of the rate with the smallest total loss over the likely models."""
    best = jnp.max(means, axis=0)
    likely = best > jnp.max(best) - _LIKELY
    loss = jnp.where(likely, jnp.minimum(best - means, _LARGEST_LOSS), 0)
    return jnp.argmin(jnp.sum(loss, axis=1))
