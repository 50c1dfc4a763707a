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
    linearisations,
    on_each_grid,
    rate_for_several,
    run_filters,
    steps_are_too_long,
)
from ..schemes import share_of_grid
from .blocks import Block, with_keys
from .parameters import Parameters
from .record_paths import GuidedRecords, guided_near, likely_root

# A pilot run has at least so many filters at each θ, and so many particles in all of them.
_FEWEST_FILTERS, _FEWEST_PARTICLES = 16, 128


class Guide(NamedTuple):
    """Guides of the filters of R records.

    - `fine`, `coarse`: points along which the model is linearised, on the grid and on the grid with
      half as many steps.
    - `rate`: discount rate of the guides.
    - `check`: diagnostics of the guides on the fine grid.
    """

    fine: Float[Array, "R points d"]
    coarse: Float[Array, "R coarse_points d"]
    rate: Float[Array, ""]
    check: GuideCheck


class Estimate(NamedTuple):
    """Unbiased estimate of a likelihood.

    - `log_likelihood`: its log, -inf if it is zero; `variance`: variance of the log.
    - `log_step_error`: discretisation error of the log. It is infinite if steps are too long to
        estimate it, and NaN if it was not computed.
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
    """Return discretisation errors, infinite instead of NaN if steps are too long to estimate them.

    Such errors are NaN with an infinite uncertainty.
    """
    return jnp.where(jnp.isnan(error) & jnp.isinf(uncertainty), jnp.inf, error)


def _share(
    part: Int[Array, " I"], total: Int[Array, " I"], like: Float[Array, ""]
) -> Float[Array, " I"]:
    """Return part / total, or zero if the total is zero."""
    return part.astype(like.dtype) / jnp.maximum(total, 1).astype(like.dtype)


class AbstractLikelihood(eqx.Module):
    """Base class of estimators of the likelihood L(θ) of the observations.

    The exponential of an estimated log-likelihood has the mean L(θ).

    - A chain calls `estimate` once in each iteration, at the proposed θ. It stores the estimate of
      its current θ until it accepts another θ.
    - During the warm-up the chain replaces the estimator by that of `near`, if there is a `guide`.
    - For some draws the chain needs the discretisation error. The stored estimate contains this
      error if `tells_step_error` is true; otherwise `log_step_error` computes it.

    All methods are traced inside one compiled loop, and under `vmap` over chains.
    """

    @abstractmethod
    def estimate(self, key: Key[Array, ""], model: Diffusion) -> Estimate:
        """Estimate the likelihood of this model, with random numbers that depend on the key only.

        The log-likelihood is never NaN. If there is no estimate it is -inf, so the chain rejects
        the parameters, and counts this.
        """

    @abstractmethod
    def log_step_error(self, key: Key[Array, ""], model: Diffusion) -> Float[Array, ""]:
        """Estimate the discretisation error of log L(θ) with separate noise; NaN if unavailable."""

    @abstractmethod
    def near(
        self,
        key: Key[Array, ""],
        at: Callable[[Float[Array, " p"]], Diffusion],
        theta: Float[Array, " p"],
        around: Float[Array, "n p"],
    ) -> "AbstractLikelihood":
        """Return an estimator of the same likelihood with a smaller variance near θ.

        `around` contains n vectors θ that the chains may visit, and `at` returns the model at a θ.
        All arrays must keep their shapes, because both estimators are states of one loop.
        """

    @abstractmethod
    def likely_root(
        self,
        parameters: Parameters,
        log_prior: Callable[[Array], Array],
        theta: Float[Array, " p"],
        root: Float[Array, "p p"],
    ) -> Float[Array, "p p"]:
        """Return a root S of the covariance S Sᵀ of the first proposals from θ.

        Each parameter moves by about the width of its posterior given the other parameters. `root`
        is the default S. It is returned if the likelihood cannot be evaluated without random
        numbers. The sampler calls this method only if there is a `guide`.
        """

    @property
    @abstractmethod
    def guide(self) -> Guide | None:
        """Return the guide that `near` replaces, for continued chains; `None` if there is none."""

    @property
    @abstractmethod
    def tells_step_error(self) -> bool:
        """Return whether every `Estimate` contains its `log_step_error`, at little extra cost."""

    @property
    @abstractmethod
    def like(self) -> Float[Array, " d"]:
        """Return a point of the state space. Only its shape and dtype are used."""

    @property
    @abstractmethod
    def proposals(self) -> tuple[AbstractWeightedProposal, ...]:
        """Return the selected proposal of each group of intervals with equal numbers of steps.

        The state of `pmmh` stores them, so that continued chains use the same. Empty for particle
        filters.
        """


class TransitionLikelihood(AbstractLikelihood):
    """Product of transition densities, each estimated by `num_proposals` weighted paths."""

    blocks: tuple[Block, ...]
    num_proposals: int = eqx.field(static=True)

    def estimate(self, key, model):
        model = model.prepared()
        zero = jnp.zeros((), self.like.dtype)
        total = Estimate(zero, zero, zero, jnp.int32(0), zero)
        num_intervals = sum(len(block.index) for block in self.blocks)
        for block_key, block in with_keys(key, self.blocks):
            arguments = (model, block.proposal, block.problem, self.num_proposals)
            density = estimate_log_density(block_key, *arguments, held=True)
            of_block = Estimate(
                jnp.sum(density.value),
                jnp.sum(density.standard_error**2),
                jnp.sum(_infinite_where_unknown(density.step_error, density.step_uncertainty)),
                jnp.sum(density.num_truncated, dtype=jnp.int32),
                jnp.sum(_share(density.num_nonfinite, density.num_simulated, zero)) / num_intervals,
            )
            total = jax.tree.map(jnp.add, total, of_block)
        # NaN counts as an estimate of zero.
        is_number = ~jnp.isnan(total.log_likelihood)
        return total._replace(log_likelihood=jnp.where(is_number, total.log_likelihood, -jnp.inf))

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
    """Guided particle filters of all records.

    - `fine`: records with the points of linearisation, which are the same at all parameters.
    - `coarse`: the same with half as many steps, for the discretisation error.
    - `rate`: discount rate of all guides.
    """

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
        if problem.density.is_exact:
            return jnp.zeros((), problem.like.dtype)
        if problem.num_steps == 1:
            return jnp.full((), jnp.nan, problem.like.dtype)
        estimate = lambda grid: self._estimate(key, model, grid, skips=True)
        estimates = on_each_grid(estimate, self.fine, self.coarse)
        # The mean of log p̂ is below log p by half the variance of log p̂.
        fine, coarse = (log_p + variance / 2 for log_p, variance, _ in estimates)
        error = share_of_grid(problem.density.order, problem.record.lengths) * (coarse - fine)
        one = lambda problem, points: steps_are_too_long(problem, model, points)
        # Then the difference of the two grids is no leading-order error.
        too_long = self.fine.records.each(one, self.fine.points)
        return jnp.where(jnp.any(too_long), jnp.inf, error)

    def near(self, key, at, theta, around):
        records, P = self.fine.records, self.num_particles
        linearise = lambda records: linearisations(records, at(theta))
        fine, coarse = guided_near(records, self.coarse.records, linearise)
        num_filters = max(_FEWEST_FILTERS, _FEWEST_PARTICLES // P)
        keys = jax.random.split(key, len(around))
        # Pilot runs only compare discount rates, so half as many steps may suffice.
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
        """Return the same estimator with this guide."""
        fine = self.fine._replace(points=guide.fine, check=guide.check)
        coarse = self.coarse._replace(points=guide.coarse)
        return RecordLikelihood(fine, coarse, guide.rate, self.num_particles)

    @property
    def tells_step_error(self):
        return False

    def _estimate(
        self, key: Key[Array, ""], model: Diffusion, grid: GuidedRecords, skips: bool = False
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """Estimate log p with one filter of each record.

        Return the estimate, its variance, and the mass that may be missing: the number of particles
        lost in all filters, divided by the number of particles of one filter.
        """
        filtered = self._filtered(key, model, grid, self.rate, 1, skips)
        # Records are independent, so variances add.
        variance = jax.vmap(lambda record: record.variance(self.num_particles))(filtered)
        lost = jnp.sum(filtered.num_nonfinite).astype(variance.dtype) / self.num_particles
        return jnp.sum(filtered.log_estimate), jnp.sum(variance), lost

    def _filtered(
        self,
        key: Key[Array, ""],
        model: Diffusion,
        grid: GuidedRecords,
        rate: Float[Array, ""],
        num_filters: int,
        skips: bool,
    ) -> Filtered:
        """Run `num_filters` filters of each record with this discount rate of the guides.

        `skips` skips steps of zero length. The test at each step takes time, so this is faster only
        on the coarse grid, which has many such steps.
        """
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
