"""How soon a guide forgets what is seen later.

The path that guides a record is one of many. Where others lead elsewhere (wells, spikes, chaos), a
linear process along it is too sure of what is seen much later, and particles that keep to it may
miss what weighs most. So h_i is made of h_{i+1} to the power exp(-γ δ), at a rate γ. Weights are
exact whatever h is: only their variance depends on γ.

By Jensen's inequality E log p̂ is below log p, by about half the variance of log p̂ and by all that
particles miss (Maddison et al. 2017). So the rate is the one of several with the largest mean of
log p̂ of pilot filters, less two standard errors: of a linear model, whose weights are equal without
forgetting, it is zero.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..engine.averages import proper
from .particle_filter import Filtered
from .several import Records

# γ times the mean time between observations; and a variance of log p̂ that is worth no pilot.
_RATES, _SMALL = (0.0, 0.5, 2.0, 8.0, 64.0), 0.04


class Choice(NamedTuple):
    """The best rate so far, and its mean of log p̂ less two standard errors; whether no other can
    be better by much."""

    rate: Float[Array, ""]
    score: Float[Array, ""]
    settled: Bool[Array, ""]


def rates_for(records: Records) -> Float[Array, " rates"]:
    """Those that are tried, from zero on."""
    dt = records.stacked.record.dt
    return jnp.asarray(_RATES, dt.dtype) * sum(records.num_times) / jnp.sum(dt)


def undecided(dtype) -> Choice:
    """Before anything was tried."""
    return Choice(jnp.zeros((), dtype), jnp.full((), -jnp.inf, dtype), jnp.zeros((), bool))


def chosen_of(
    best: Choice, rate: Float[Array, ""], filtered: Filtered, num_particles: int
) -> Choice:
    """The better one, where filters of all records at this rate made this of them."""
    R = filtered.log_estimate.shape[1]
    told = jnp.mean(jax.vmap(lambda each: each.variance(num_particles))(filtered), axis=1)
    spread = jnp.var(filtered.log_estimate, axis=1, ddof=min(1, R - 1))
    variance = jnp.sum(jnp.maximum(told, spread))
    score = jnp.sum(jnp.mean(filtered.log_estimate, axis=1)) - 2 * jnp.sqrt(variance / R)
    score = proper(score)
    better = score > best.score
    return Choice(
        jnp.where(better, rate, best.rate),
        jnp.maximum(score, best.score),
        best.settled | (variance < _SMALL),
    )


def chosen_rate(
    run: Callable[[Float[Array, ""]], Filtered], records: Records, num_particles: int
) -> Float[Array, ""]:
    """The best rate, where `run` makes filters of all records at one."""

    def tried(best: Choice, rate):
        try_it = lambda best: chosen_of(best, rate, run(rate), num_particles)
        return lax.cond(best.settled, lambda best: best, try_it, best), None

    rates = rates_for(records)
    return lax.scan(tried, undecided(rates.dtype), rates)[0].rate
