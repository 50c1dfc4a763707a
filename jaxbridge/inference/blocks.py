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
    ProposalLike,
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

# Purpose of the bridges. "means": means at a single θ. For a θ that moves: "weights", "density"
# (estimates of the transition density), or "renewal" (the renewal kernel of a coupling).
# "approximate": unweighted pairs of a coupling.
Use = Literal["means", "weights", "density", "renewal", "approximate"]


class Block(eqx.Module):
    """Intervals with the same number of steps, and their proposal.

    - `index`: positions of the intervals among all intervals.
    - `fractions`: step sizes as fractions of the durations.
    """

    intervals: Intervals
    index: Int[Array, " I"]
    fractions: Float[Array, " N"]
    proposal: AbstractWeightedProposal

    @property
    def num_steps(self) -> int:
        return self.fractions.shape[0]

    @property
    def problem(self) -> BridgeProblem:
        """Return the bridge problem of the intervals."""
        return BridgeProblem(self.intervals, None, self.num_steps, True, True)

    @property
    def steps(self) -> Float[Array, "N I"]:
        return self.fractions[:, None] * self.intervals.duration

    def log_halvings(
        self, model: Diffusion, paths: Float[Array, "P points d"], form: Form
    ) -> Float[Array, " P"]:
        """Return D of `halving` for paths under the step law of this form of the likelihood.

        All intervals have the same number of paths, and `P` is the total number.
        """
        # The paths of an interval are consecutive, as in `jnp.repeat`.
        steps = jnp.repeat(self.steps, paths.shape[0] // len(self.index), axis=1)
        dynamics = model.forward(self.intervals.start[0])
        return log_halving_of_paths(density_of_form(form), dynamics, steps, paths)

    def step_shares(self, model: Diffusion, form: Form) -> Float[Array, " I"]:
        """Return the discretisation error of each interval, as a fraction of a change.

        The change is the difference that half as many steps make. The fraction is the larger one of
        two: that for the bridges, and that for this form of the likelihood.
        """
        share = share_of_order(density_of_form(form).order)
        return jnp.maximum(guessed(self.proposal.step_share(model, self.intervals)), share)


def make_blocks(
    key: Key[Array, ""],
    model: Diffusion,
    problem: Problem,
    proposal: ProposalLike,
    budget: Budget,
    use: Use,
) -> tuple[Block, ...]:
    """Validate the user's proposal; select and prepare the proposal of each block at `model`.

    Unless `use` is "means" or "approximate", the proposals must be valid for every θ.

    **Raises:** `ValueError` and `TypeError` for a proposal that does not fit.
    """
    like, groups = problem.like, problem.groups
    for_density, weighted = use == "density", use != "approximate"
    moving = use in ("weights", "density", "renewal")
    is_auto = isinstance(proposal, str) and proposal == "auto"
    # A burn-in has a length for one θ only, so "auto" then selects guided proposals.
    if moving and is_auto and needs_burn_in(Stationary(), model) and not model.has_density:
        left_out = why_left_out(model, for_density) or _NO_SAMPLER
        proposal = choice_between(guided_candidates(), budget, left_out=left_out)
    selected = as_proposal(proposal, model, like, budget, for_density)
    selected.check(model, problem.intervals)
    if for_density:
        selected.check_for_density(model)
    if moving:
        _check_for_moving(selected, model)
    if use in ("renewal", "approximate"):
        selected = as_pairs(selected) if weighted else as_pairs(selected, *_FOR_APPROXIMATE)
    # Select for all intervals at once, with the largest number of steps: then the pilot run of each
    # candidate is compiled once.
    choice_key, key = jax.random.split(key)
    most = max(group.num_steps for group in groups)
    resolved = resolve(selected, choice_key, model, problem.intervals, most)
    blocks = []
    for block_key, group in zip(jax.random.split(key, len(groups)), groups, strict=True):
        single, at = resolved.of(group.which), (block_key, model, group.intervals, group.num_steps)
        blocks.append(block_of(group, single.prepared(*at) if weighted else as_pairs(single)))
    return tuple(blocks)


def block_of(group: Group, proposal: AbstractWeightedProposal) -> Block:
    """Return the block of a group of intervals with its selected proposal."""
    fractions = np.diff(proposal.fractions(group.num_steps))
    fractions = jnp.asarray(fractions, group.intervals.duration.dtype)
    return Block(group.intervals, jnp.asarray(group.which), fractions, proposal)


def with_keys(
    key: Key[Array, ""], blocks: tuple[Block, ...]
) -> Iterator[tuple[Key[Array, ""], Block]]:
    """Yield each block with a separate key."""
    return zip(jax.random.split(key, len(blocks)), blocks, strict=True)


def over_intervals(blocks: tuple[Block, ...], of_blocks: Sequence[Any]) -> Any:
    """Combine the results of the blocks, which are named tuples, to one for all intervals.

    Fields with a value for each interval are joined in the order of the intervals: effective sample
    size, k̂ and counts. The other fields are summed.
    """
    # Blocks are not in the order of the intervals; this restores it.
    order = jnp.argsort(jnp.concatenate([block.index for block in blocks]))
    fields = ("effective_sample_size", "pareto_k", "num_found", "num_simulated", "num_nonfinite")
    joined = {f: jnp.concatenate([getattr(one, f) for one in of_blocks])[order] for f in fields}
    sums = [one._replace(**dict.fromkeys(fields, 0)) for one in of_blocks]
    return jax.tree.map(lambda *leaves: sum(leaves), *sums)._replace(**joined)


def target_forms(blocks: tuple[Block, ...], model: Diffusion) -> tuple[Form, ...]:
    """Return the forms of the path likelihood that match the bridges of all blocks."""
    targets = [single.target for block in blocks for single in block.proposal.singles]
    return forms_of_targets(targets, model, blocks[0].intervals.start[0])


def _check_for_moving(proposal: AbstractProposal, model: Diffusion) -> None:
    """Raise `ValueError` for a proposal that is valid at the first parameters only.

    A proposal whose start law has a density is valid at all parameters.
    """
    if any(single.must_measure(model) for single in proposal.singles) and not model.has_density:
        raise ValueError(
            "this model has no sampler of its stationary law, and the length of a burn-in depends "
            "on the parameters. Pass `sample_stationary=` or `log_stationary=` to `Diffusion`. Or "
            "give the coupling a `Stationary(burn_in=...)` that is long enough for all "
            "parameters, or use guided proposals."
        )
