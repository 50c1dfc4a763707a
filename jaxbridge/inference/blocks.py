"""Proposals of all intervals, in blocks of intervals with the same number of steps.

A block is one program. The module selects its proposal for all parameters that a chain may visit.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from ..coupling import Stationary, needs_burn_in
from ..models.bridge_problem import BridgeProblem, Intervals
from ..models.diffusion import Diffusion
from ..proposals import (
    AbstractProposal,
    AbstractWeightedProposal,
    Budget,
    as_pairs,
    as_proposal,
    choice_between,
    guided_candidates,
    resolve,
    why_left_out,
)
from ..schemes import (
    Form,
    density_of_form,
    forms_of_targets,
    guessed,
    log_halving_of_paths,
    share_of_order,
)
from .data import Group, Problem

_NO_SAMPLER = (
    "without a sampler of the stationary law (`Diffusion(..., sample_stationary=)`) they need a "
    "burn-in, whose length changes with the parameters"
)
_FOR_APPROXIMATE = ('bridges="approximate"', 'bridges="exact"')

# What bridges are for: means at this θ alone; where θ moves, their weights, estimates of the
# density, or the renewal kernel of a coupling; or, approximate, pairs of a coupling as they are.
Use = Literal["means", "weights", "density", "renewal", "approximate"]


class Block(eqx.Module):
    """Intervals with one number of steps, which are these fractions of their durations; which of
    all intervals they are; and their proposal."""

    intervals: Intervals
    index: Int[Array, " I"]
    fractions: Float[Array, " N"]
    proposal: AbstractWeightedProposal

    @property
    def num_steps(self) -> int:
        return self.fractions.shape[0]

    @property
    def problem(self) -> BridgeProblem:
        """The bridges of these intervals."""
        return BridgeProblem(self.intervals, None, self.num_steps, True, True)

    @property
    def steps(self) -> Float[Array, "N I"]:
        return self.fractions[:, None] * self.intervals.duration

    def log_halvings(
        self, model: Diffusion, paths: Float[Array, "P points d"], form: Form
    ) -> Float[Array, " P"]:
        """D of `halving` under the step law of this form of the likelihood, of paths that are as
        many for each interval."""
        steps = jnp.repeat(self.steps, paths.shape[0] // len(self.index), axis=1)
        dynamics = model.forward(self.intervals.start[0])
        return log_halving_of_paths(density_of_form(form), dynamics, steps, paths)

    def step_shares(self, model: Diffusion, form: Form) -> Float[Array, " I"]:
        """The step error of each interval, of its bridges or of this form, as a share of what half
        as many steps change."""
        share = share_of_order(density_of_form(form).order)
        return jnp.maximum(guessed(self.proposal.step_share(model, self.intervals)), share)


def make_blocks(
    key: Key[Array, ""],
    model: Diffusion,
    problem: Problem,
    proposal: Any,
    budget: Budget,
    use: Use,
) -> tuple[Block, ...]:
    """The proposal that the user gave, checked, and settled and prepared for each block at this
    model, from which θ moves unless means are wanted.

    **Raises:** `ValueError` and `TypeError` for a proposal that does not fit.
    """
    like, groups = problem.like, problem.groups
    for_density, weighted = use == "density", use != "approximate"
    moving = use in ("weights", "density", "renewal")
    is_auto = isinstance(proposal, str) and proposal == "auto"
    if moving and is_auto and needs_burn_in(Stationary(), model) and not model.has_density:
        left_out = why_left_out(model, for_density) or _NO_SAMPLER
        proposal = choice_between(guided_candidates(), budget, left_out=left_out)
    given = as_proposal(proposal, model, like, budget, for_density)
    given.check(model, problem.intervals)
    if for_density:
        given.check_for_density(model)
    if moving:
        _check_for_moving(given, model)
    if use in ("renewal", "approximate"):
        given = as_pairs(given) if weighted else as_pairs(given, *_FOR_APPROXIMATE)
    # A choice is made for all intervals at once, in as many steps as the longest has, so that each
    # candidate's pilot run is one program.
    choice_key, key = jax.random.split(key)
    most = max(group.num_steps for group in groups)
    chosen = resolve(given, choice_key, model, problem.intervals, most)
    blocks = []
    for block_key, group in zip(jax.random.split(key, len(groups)), groups, strict=True):
        mine, at = chosen.of(group.which), (block_key, model, group.intervals, group.num_steps)
        blocks.append(block_of(group, mine.prepared(*at) if weighted else as_pairs(mine)))
    return tuple(blocks)


def block_of(group: Group, proposal: AbstractWeightedProposal) -> Block:
    """The intervals of a group with a proposal that is settled for them."""
    fractions = np.diff(proposal.fractions(group.num_steps))
    fractions = jnp.asarray(fractions, group.intervals.duration.dtype)
    return Block(group.intervals, jnp.asarray(group.which), fractions, proposal)


def with_keys(
    key: Key[Array, ""], blocks: tuple[Block, ...]
) -> Iterator[tuple[Key[Array, ""], Block]]:
    """Each block with a key of its own."""
    return zip(jax.random.split(key, len(blocks)), blocks, strict=True)


def over_intervals(blocks: tuple[Block, ...], made: Sequence[Any]) -> Any:
    """What was made of each block, named tuples, for all intervals: sums, and of the effective
    number of paths, k̂ and the counts of each interval those of all, in their order."""
    order = jnp.argsort(jnp.concatenate([block.index for block in blocks]))
    fields = ("effective_sample_size", "pareto_k", "num_found", "num_simulated", "num_nonfinite")
    each = {f: jnp.concatenate([getattr(one, f) for one in made])[order] for f in fields}
    sums = [one._replace(**dict.fromkeys(fields, 0)) for one in made]
    return jax.tree.map(lambda *leaves: sum(leaves), *sums)._replace(**each)


def target_forms(blocks: tuple[Block, ...], model: Diffusion) -> tuple[Form, ...]:
    """Those of the path likelihood that go with the bridges of all blocks."""
    targets = [single.target for block in blocks for single in block.proposal.singles]
    return forms_of_targets(targets, model, blocks[0].intervals.start[0])


def _check_for_moving(proposal: AbstractProposal, model: Diffusion) -> None:
    """Raise `ValueError` where something is known at the first parameters only. (A start law with a
    density serves at all.)"""
    if any(single.must_measure(model) for single in proposal.singles) and not model.has_density:
        raise ValueError(
            "this model has no sampler of its stationary law, and the length of a burn-in depends "
            "on the parameters: pass `sample_stationary=` or `log_stationary=` to `Diffusion`, "
            "give the coupling a `Stationary(burn_in=...)` that is long enough for all "
            "parameters, or use guided proposals."
        )
