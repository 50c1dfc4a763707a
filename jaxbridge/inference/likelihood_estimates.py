"""Unbiased estimates of the likelihood at any parameters, of which `pmmh` is made.

Of complete observations without noise it is a product of transition densities, of which weighted
proposals give estimates, interval by interval; of a record that was seen with noise or in part,
what a guided particle filter makes.
"""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from ..engine.averages import proper
from ..exact import estimate_log_density
from ..models.diffusion import Diffusion
from ..proposals import AbstractWeightedProposal
from ..records import RecordProblem, guided, run_filters
from .blocks import Block, with_keys


class Estimate(NamedTuple):
    """log of an unbiased estimate of the likelihood, -inf where there is none, with its variance
    and its step error; and how many of its weights were cut off."""

    log_likelihood: Float[Array, ""]
    variance: Float[Array, ""]
    log_step_error: Float[Array, ""]
    num_truncated: Int[Array, ""]


class AbstractLikelihood(eqx.Module):
    """What estimates the likelihood of the observations at given parameters."""

    @abstractmethod
    def estimate(self, key: Key[Array, ""], model: Diffusion) -> Estimate:
        """The estimate for this model."""

    @property
    @abstractmethod
    def proposals(self) -> tuple[AbstractWeightedProposal, ...]:
        """Of the paths, decided, for each group of intervals."""


class TransitionLikelihood(AbstractLikelihood):
    """Transition densities by so many weighted paths for each interval."""

    blocks: tuple[Block, ...]
    num_proposals: int = eqx.field(static=True)

    def estimate(self, key, model):
        model = model.prepared()
        zero = jnp.zeros((), self.blocks[0].problem.like.dtype)
        total = Estimate(zero, zero, zero, jnp.int32(0))
        for block_key, block in with_keys(key, self.blocks):
            arguments = (model, block.proposal, block.problem, self.num_proposals)
            made = estimate_log_density(block_key, *arguments)
            mine = Estimate(
                jnp.sum(made.value),
                jnp.sum(made.standard_error**2),
                jnp.sum(made.step_error),
                jnp.sum(made.num_truncated, dtype=jnp.int32),
            )
            total = jax.tree.map(jnp.add, total, mine)
        known = ~jnp.isnan(total.log_likelihood)
        return total._replace(log_likelihood=jnp.where(known, total.log_likelihood, -jnp.inf))

    @property
    def proposals(self):
        return tuple(block.proposal for block in self.blocks)


class RecordLikelihood(AbstractLikelihood):
    """A guided particle filter, linearised along the same points at all parameters."""

    problem: RecordProblem
    points: Float[Array, "points d"]
    num_particles: int = eqx.field(static=True)

    def estimate(self, key, model):
        guide = guided(self.problem, model, self.points)
        made = run_filters(key, self.problem, model, guide, 1, self.num_particles)
        value, variance = proper(made.log_estimate[0]), made.variance(self.num_particles)[0]
        unknown = jnp.full_like(value, jnp.nan)
        return Estimate(value, variance, unknown, jnp.int32(0))

    @property
    def proposals(self):
        return ()
