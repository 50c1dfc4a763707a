"""The proposals of all intervals, in parts of one number of steps each."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from .choice import as_proposal, settled
from .diffusion import Diffusion
from .intervals import Intervals
from .observations import Group
from .renewal_chain import as_pairs
from .transition import check_for_density
from .weighted import AbstractWeightedProposal

# num_counts, max_proposals, max_trials
Bounds = tuple[int | None, int | None, int | None]


class Part(eqx.Module):
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
    def steps(self) -> Float[Array, "N I"]:
        return self.fractions[:, None] * self.intervals.duration


def make_parts(
    key: Key[Array, ""],
    model: Diffusion,
    intervals: Intervals,
    groups: tuple[Group, ...],
    proposal: Any,
    bounds: Bounds,
    *,
    for_density: bool = False,
    only_couplings: bool = False,
) -> tuple[Part, ...]:
    """The proposal that the user gave, checked, and settled and prepared for each part at this
    model.

    **Raises:** `ValueError` and `TypeError` for a proposal that does not fit.
    """
    parts = []
    for part_key, group in zip(jax.random.split(key, len(groups)), groups, strict=True):
        mine = jax.tree.map(lambda leaf, which=group.which: leaf[which], intervals)
        chosen = as_proposal(proposal, model, mine.start[0], *bounds, for_density=for_density)
        chosen.check(model, mine)
        if for_density:
            check_for_density(chosen, model)
        if only_couplings:
            chosen = as_pairs(chosen)
        chosen = settled(chosen, part_key, model, mine, group.num_steps)
        chosen = chosen.prepared(part_key, model, mine, group.num_steps)
        fractions = jnp.asarray(np.diff(chosen.fractions(group.num_steps)), mine.duration.dtype)
        parts.append(Part(mine, jnp.asarray(group.which), fractions, chosen))
    return tuple(parts)
