"""How soon a guide forgets what is seen later.

The path that guides a record is one of many. Where others lead elsewhere (wells, spikes, chaos), a
linear process along it is too sure of what is seen much later, and particles that keep to it may
miss what weighs most. So h_i is made of h_{i+1} to the power exp(-γ δ), at a rate γ. Weights are
exact whatever h is: only their variance depends on γ.

By Jensen's inequality E log p̂ is below log p, by about half the variance of log p̂ and by all that
particles miss (Maddison et al. 2017). So the rate is the one of several with the largest mean of
log p̂ of pilot filters, less two standard errors: of a linear model, whose weights are equal without
forgetting, it is zero. Of several the luckiest is best, so it must be better than none on another
look, too.

A chain over parameters has one rate for all of them, and must not miss what weighs most at any:
where nearly every p̂ is too small it will not go, and then knows nothing of it. So what the mean of
log p̂ is below that at the best rate is worked out at several parameters, all about as likely as
those where the chains are, and the rate is the one that loses least in the mean over these. (The
log of the mean of p̂ is a worse criterion: of few pilots one that is lucky decides it, and a rate
too low, at which chains stay where it is good enough, is confirmed there by what they see.)
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..engine.averages import proper
from .particle_filter import Filtered
from .several import Records

# γ times the mean time between observations; and a variance of log p̂ by which all weights are
# equal, and nothing is missed: a larger one says nothing of what all filters miss.
_RATES, _ALL_EQUAL = (0.0, 0.5, 2.0, 8.0, 64.0), 1e-4
# By how much log p̂ may be below the largest where parameters count, and what is lost at any of them
# at most.
_LIKELY, _LARGEST_LOSS = 10.0, 5.0
# With so few steps between observations nearly all is forgotten, or nothing, at the last.
_FEW_STEPS = 4
# By how much a filter that lost all its particles is below the best beside it.
_LOST = 50.0


class Choice(NamedTuple):
    """The best rate so far, and its mean of log p̂ less two standard errors; the same without
    forgetting; and whether all weights were equal at one rate, and no other is worth a pilot."""

    rate: Float[Array, ""]
    score: Float[Array, ""]
    of_none: Float[Array, ""]
    settled: Bool[Array, ""]


def rates_for(records: Records) -> Float[Array, " rates"]:
    """Those that may be tried, from zero on."""
    record = records.stacked.record
    num_seen = jnp.sum(jnp.any(jnp.isfinite(record.values), axis=-1))
    rates = jnp.asarray(_RATES, record.dt.dtype)
    return rates * jnp.maximum(num_seen, 1).astype(rates.dtype) / jnp.sum(record.dt)


def half_will_do(records: Records) -> bool:
    """Whether pilots may have half as many steps."""
    return records.stacked.num_steps > _FEW_STEPS


def undecided(dtype) -> Choice:
    """Before anything was tried."""
    nothing = jnp.full((), -jnp.inf, dtype)
    return Choice(jnp.zeros((), dtype), nothing, nothing, jnp.zeros((), bool))


def chosen_of(
    best: Choice, rate: Float[Array, ""], filtered: Filtered, num_particles: int
) -> Choice:
    """The better one, where filters of all records at this rate made this of them."""
    score, variance = _score_and_variance(filtered, num_particles)
    return Choice(
        jnp.where(score > best.score, rate, best.rate),
        jnp.maximum(score, best.score),
        jnp.where(rate == 0, score, best.of_none),
        best.settled | (variance < _ALL_EQUAL),
    )


def confirmed(best: Choice, filtered: Filtered, num_particles: int) -> Choice:
    """With its rate where other filters at it say that it is better than none, else with none."""
    score, _ = _score_and_variance(filtered, num_particles)
    return best._replace(rate=jnp.where(score > best.of_none, best.rate, 0))


def _score_and_variance(
    filtered: Filtered, num_particles: int
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    log_estimate, R = _not_lost(filtered.log_estimate), filtered.log_estimate.shape[1]
    variance = _variance(log_estimate, filtered, num_particles)
    mean = jnp.sum(jnp.mean(log_estimate, axis=1))
    return proper(mean - 2 * jnp.sqrt(variance / R)), variance


def _not_lost(log_estimate: Float[Array, "records R"]) -> Float[Array, "records R"]:
    """With a floor for filters that lost all particles, beside others."""
    best = jnp.max(log_estimate, axis=1, keepdims=True)
    return jnp.maximum(log_estimate, best - _LOST)


def _variance(
    log_estimate: Float[Array, "records R"], filtered: Filtered, num_particles: int
) -> Float[Array, ""]:
    """That of log p̂ of all records: what filters tell of themselves, or their spread."""
    told = jnp.mean(jax.vmap(lambda each: each.variance(num_particles))(filtered), axis=1)
    spread = jnp.var(log_estimate, axis=1, ddof=min(1, log_estimate.shape[1] - 1))
    return jnp.sum(jnp.maximum(told, spread))


def rate_for_several(
    run: Callable[[Float[Array, ""]], Filtered], records: Records, num_particles: int
) -> Float[Array, ""]:
    """The rate for several models, which are an axis in front of what `run` makes at one. Where
    all weights are equal at all of them without forgetting, nothing else is tried."""

    def mean_and_equal(filtered: Filtered):
        log_estimate = _not_lost(filtered.log_estimate)
        variance = _variance(log_estimate, filtered, num_particles)
        return proper(jnp.sum(jnp.mean(log_estimate, axis=1))), variance < _ALL_EQUAL

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
    """At which rate the mean of log p̂ is least below that at the best, over models that are
    likely."""
    best = jnp.max(means, axis=0)
    likely = best > jnp.max(best) - _LIKELY
    loss = jnp.where(likely, jnp.minimum(best - means, _LARGEST_LOSS), 0)
    return jnp.argmin(jnp.sum(loss, axis=1))
