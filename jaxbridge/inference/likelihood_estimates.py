"""Unbiased estimates of the likelihood at given parameters, for `pmmh`.

The likelihood of exact observations is a product of transition densities, which weighted proposals
estimate interval by interval. The likelihood of a noisy or partial record is estimated by guided
particle filters.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from ..engine.averages import nan_to_neg_inf
from ..exact import estimate_log_density
from ..models.diffusion import Diffusion
from ..proposals import AbstractWeightedProposal
from ..records import (
    Filtered,
    GuideCheck,
    guided,
    half_will_do,
    rate_for_several,
    run_filters,
    steps_are_too_long,
)
from ..schemes import share_of_grid
from .blocks import Block, with_keys
from .parameters import Parameters
from .record_paths import GuidedRecords, guided_near, likely_root, on_both_grids

# At least so many filters at each of several parameters, and so many particles, are a pilot.
_FEWEST_FILTERS, _FEWEST_PARTICLES = 16, 128


class Guide(NamedTuple):
    """What guides the filters of R records: the points along which each is linearised, on the grid
    and on one of half as many steps, the rate at which it forgets,
    and how good it is on the grid."""

    fine: Float[Array, "R points d"]
    coarse: Float[Array, "R coarse_points d"]
    rate: Float[Array, ""]
    check: GuideCheck


class Estimate(NamedTuple):
    """Unbiased estimate of a likelihood.

    - `log_likelihood`: its log, -inf if it is zero; `variance`: variance of the log.
    - `log_step_error`: discretisation error of the log, infinite if steps are too long to estimate
        it.
    - `num_truncated`: number of truncated weights.
    - `share_lost`: share of paths, or particles, that left the state space or diverged.
    """

    log_likelihood: Float[Array, ""]
    variance: Float[Array, ""]
    log_step_error: Float[Array, ""]
    num_truncated: Int[Array, ""]
    share_lost: Float[Array, ""]


def _infinite_where_unknown(
    error: Float[Array, " I"], uncertainty: Float[Array, " I"]
) -> Float[Array, " I"]:
    """Return step errors, infinite instead of NaN where steps are too long for an estimate."""
    return jnp.where(jnp.isnan(error) & jnp.isinf(uncertainty), jnp.inf, error)


def _share(
    part: Int[Array, " I"], whole: Int[Array, " I"], like: Float[Array, ""]
) -> Float[Array, " I"]:
    """Return part / whole, zero of nothing."""
    return part.astype(like.dtype) / jnp.maximum(whole, 1).astype(like.dtype)


class AbstractLikelihood(eqx.Module):
    """What estimates the likelihood of the observations, exp(`estimate`) with mean L(θ).

    A chain calls `estimate` once in each iteration, at the parameters that it proposes, and holds
    on to what it gets until a proposal is accepted. While it warms up it asks for another of the
    kind, by `near`, wherever there is a `guide`. Of some draws it asks for the step error: it is
    that of the estimate it holds where `tells_step_error`, and else is worked out by
    `log_step_error`. All of it is traced inside one compiled loop, and under `vmap` over chains.
    """

    @abstractmethod
    def estimate(self, key: Key[Array, ""], model: Diffusion) -> Estimate:
        """One estimate for this model, from random numbers that depend on the key only. Never NaN:
        -inf where none is to be had, which refuses the parameters and is counted."""

    @abstractmethod
    def log_step_error(self, key: Key[Array, ""], model: Diffusion) -> Float[Array, ""]:
        """By how much log L(θ) is too large for the length of the steps, with noise of its own; NaN
        where it is not known."""

    @abstractmethod
    def near(
        self,
        key: Key[Array, ""],
        at: Callable[[Float[Array, " p"]], Diffusion],
        theta: Float[Array, " p"],
        around: Float[Array, "n p"],
    ) -> "AbstractLikelihood":
        """What estimates the same with less variance where a chain is, at θ, and where it may come
        to, `around` it, for the models `at` these: leaves may change, and no shapes, for both are
        states of one loop."""

    @abstractmethod
    def likely_root(
        self,
        parameters: Parameters,
        log_prior: Callable[[Array], Array],
        theta: Float[Array, " p"],
        root: Float[Array, "p p"],
    ) -> Float[Array, "p p"]:
        """S of first moves from θ that are as wide as the likelihood, where that is known without
        random numbers; else the given one. Asked for where there is a `guide`."""

    @property
    @abstractmethod
    def guide(self) -> Guide | None:
        """What `near` finds anew, for one that goes on with the same; `None` where that is
        nothing."""

    @property
    @abstractmethod
    def tells_step_error(self) -> bool:
        """Whether `log_step_error` of an `Estimate` is told at no cost worth mentioning."""

    @property
    @abstractmethod
    def like(self) -> Float[Array, " d"]:
        """A point of the state space, of which only shape and dtype count."""

    @property
    @abstractmethod
    def proposals(self) -> tuple[AbstractWeightedProposal, ...]:
        """Of the paths, decided, for each group of intervals: kept in the state in which a chain
        ends, so that one that goes on has the same. Empty where there is nothing to decide."""


class TransitionLikelihood(AbstractLikelihood):
    """Transition densities by so many weighted paths for each interval."""

    blocks: tuple[Block, ...]
    num_proposals: int = eqx.field(static=True)

    def estimate(self, key, model):
        model = model.prepared()
        zero = jnp.zeros((), self.like.dtype)
        total = Estimate(zero, zero, zero, jnp.int32(0), zero)
        num_intervals = sum(len(block.index) for block in self.blocks)
        for block_key, block in with_keys(key, self.blocks):
            arguments = (model, block.proposal, block.problem, self.num_proposals)
            made = estimate_log_density(block_key, *arguments, held=True)
            mine = Estimate(
                jnp.sum(made.value),
                jnp.sum(made.standard_error**2),
                jnp.sum(_infinite_where_unknown(made.step_error, made.step_uncertainty)),
                jnp.sum(made.num_truncated, dtype=jnp.int32),
                jnp.sum(_share(made.num_nonfinite, made.num_simulated, zero)) / num_intervals,
            )
            total = jax.tree.map(jnp.add, total, mine)
        known = ~jnp.isnan(total.log_likelihood)
        return total._replace(log_likelihood=jnp.where(known, total.log_likelihood, -jnp.inf))

    def log_step_error(self, key, model):
        return self.estimate(key, model).log_step_error

    def near(self, key, at, theta, around):
        return self

    def likely_root(self, parameters, log_prior, theta, root):
        return root

    @property
    def guide(self):
        return None

    @property
    def tells_step_error(self):
        return True

    @property
    def like(self):
        return self.blocks[0].problem.like

    @property
    def proposals(self):
        return tuple(block.proposal for block in self.blocks)


class RecordLikelihood(AbstractLikelihood):
    """Guided particle filters of all records, linearised along the same points at all parameters,
    with one rate at which guides forget; and with half as many steps, which tell the step error."""

    fine: GuidedRecords
    coarse: GuidedRecords
    rate: Float[Array, ""]
    num_particles: int = eqx.field(static=True)

    def estimate(self, key, model):
        value, variance, lost = self._estimate(key, model, self.fine)
        unknown = jnp.full_like(value, jnp.nan)
        return Estimate(nan_to_neg_inf(value), variance, unknown, jnp.int32(0), lost)

    def log_step_error(self, key, model):
        problem = self.fine.records.stacked
        if problem.num_steps == 1:
            return jnp.full((), jnp.nan, problem.like.dtype)
        estimate = lambda grid: self._estimate(key, model, grid, skips=True)
        log_p, variance, _ = on_both_grids(estimate, self.fine, self.coarse)
        # The mean of log p̂ is too small by half its variance.
        fine, coarse = log_p + variance / 2
        error = share_of_grid(problem.density.order, problem.num_steps) * (coarse - fine)
        one = lambda problem, points: steps_are_too_long(problem, model, points)
        too_long = self.fine.records.each(one, self.fine.points)
        return jnp.where(jnp.any(too_long), jnp.inf, error)

    def near(self, key, at, theta, around):
        records, P = self.fine.records, self.num_particles
        fine, coarse = guided_near(records, self.coarse.records, at(theta))
        num_filters = max(_FEWEST_FILTERS, _FEWEST_PARTICLES // P)
        keys = jax.random.split(key, len(around))
        grid = coarse if half_will_do(records) else fine

        def pilots(rate):
            def one(key, theta):
                return self._filtered(key, at(theta), grid, rate, num_filters, skips=True)

            return jax.vmap(one)(keys, around)

        return RecordLikelihood(fine, coarse, rate_for_several(pilots, records, P), P)

    def likely_root(self, parameters, log_prior, theta, root):
        return likely_root(parameters, self.fine, log_prior, theta, root)

    @property
    def guide(self):
        return Guide(self.fine.points, self.coarse.points, self.rate, self.fine.check)

    def guided_by(self, guide: Guide) -> "RecordLikelihood":
        """The same with what another has as `guide`."""
        fine = self.fine._replace(points=guide.fine, check=guide.check)
        coarse = self.coarse._replace(points=guide.coarse)
        return RecordLikelihood(fine, coarse, guide.rate, self.num_particles)

    @property
    def tells_step_error(self):
        return False

    def _estimate(
        self, key: Key[Array, ""], model: Diffusion, grid: GuidedRecords, skips: bool = False
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """log p̂ with its variance, of one filter of each record, and the mass that lost particles
        may be missing from it."""
        made = self._filtered(key, model, grid, self.rate, 1, skips)
        variance = jax.vmap(lambda each: each.variance(self.num_particles))(made)
        lost = jnp.sum(made.num_nonfinite).astype(variance.dtype) / self.num_particles
        return jnp.sum(made.log_estimate), jnp.sum(variance), lost

    def _filtered(
        self,
        key: Key[Array, ""],
        model: Diffusion,
        grid: GuidedRecords,
        rate: Float[Array, ""],
        num_filters: int,
        skips: bool,
    ) -> Filtered:
        """So many filters of each record, whose guides forget at this rate. To skip steps of no
        length takes a decision at each, which pays where there are many: on the coarse grid."""
        (records, points, _), size = grid, (num_filters, self.num_particles)
        moving = records.moving if skips else None

        def one(problem, key, points):
            guide = guided(problem, model, points, rate)
            return run_filters(key, problem, model, guide, size, moving)

        return records.each(one, jax.random.split(key, records.number), points)

    @property
    def like(self):
        return self.fine.records.stacked.like

    @property
    def proposals(self):
        return ()
