"""The observations completed by bridges, and the Markov kernels that renew them.

Given θ the bridges of all intervals are independent. A kernel moves each of them once, leaving its
exact law invariant whatever θ it was made with (section 2.3 of the paper):

* `ByRenewal` keeps a bridge until a diffusion associated with it hits it, for couplings. It
  keeps nothing but the path.
* `ByWeights` accepts a new weighted proposal with the ratio of the weights, which for the path
  at hand is drawn anew from its law given θ and the path: for the counts of a coupling that is
  the size-biased law, for proposals that are pulled to the end point a function of the path.
* `Unweighted` takes each new proposal of a coupling: approximate, as in section 4 of the paper.
"""

from abc import abstractmethod
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from ..coupling.start_laws import run_is_cut
from ..engine.checks import is_traced
from ..exact.kernels import acceptance_rate
from ..exact.renewal import as_pairs, first_paths, propose_paths, renew
from ..models.diffusion import Diffusion
from ..models.intervals import Intervals
from ..proposals.base import AbstractWeightedProposal
from ..proposals.coupled import CoupledPairs
from ..proposals.modified_bridge import ModifiedDiffusionBridge
from ..schemes.path_likelihood import Form, log_likelihoods
from .blocks import Block, Bounds, log_halvings, make_blocks, step_shares
from .data import Group

# One array of shape (I, N+1, d) for each block.
Paths = tuple[Float[Array, "_ _ d"], ...]


class BridgeInfo(NamedTuple):
    """Of one step on all intervals: whether the path of each was replaced; how many paths were
    simulated, or weighed, for it; whether no proposal was found though one was called for. Then
    the path stays, which leaves the exact law invariant, for whether one is found does not
    depend on the path. Last, whether a weight was cut off by a bound on its trials, or the run
    that replaces a sampler of the stationary law by one on its steps."""

    moved: Bool[Array, " I"]
    num_simulated: Int[Array, " I"]
    missing: Bool[Array, " I"]
    truncated: Bool[Array, " I"]


class AbstractBridgeKernel(eqx.Module):
    """A Markov kernel on the bridges of many intervals."""

    @abstractmethod
    def first(
        self, keys: Key[Array, " I"], model: Diffusion, intervals: Intervals, num_steps: int
    ) -> Float[Array, "I points d"]:
        """Paths to start from, NaN where none was found."""

    @abstractmethod
    def renew(
        self,
        keys: Key[Array, " I"],
        model: Diffusion,
        intervals: Intervals,
        paths: Float[Array, "I points d"],
    ) -> tuple[Float[Array, "I points d"], BridgeInfo]:
        """One step of each."""


class ByRenewal(AbstractBridgeKernel):
    """The renewal kernel."""

    pairs: CoupledPairs

    def first(self, keys, model, intervals, num_steps):
        return first_paths(keys, model, self.pairs, intervals, num_steps)[0]

    def renew(self, keys, model, intervals, paths):
        everything = jnp.ones(len(keys), bool)
        paths, info = renew(keys, model, self.pairs, intervals, paths, everything)
        num_steps = paths.shape[1] - 1
        law, dt = self.pairs.coupling.start_law, intervals.duration / num_steps
        cut = run_is_cut(law, model, dt, num_steps)
        return paths, BridgeInfo(info.is_accepted, info.num_simulated, info.is_missing, cut)


class ByWeights(AbstractBridgeKernel):
    """The pseudo-marginal kernel."""

    proposal: AbstractWeightedProposal

    def first(self, keys, model, intervals, num_steps):
        drawn = self.proposal.draw(keys[:, None], model, intervals, num_steps, None, False)
        return drawn.paths[:, 0]

    def renew(self, keys, model, intervals, paths):
        weigh_keys, draw_keys, accept_keys = jax.vmap(
            lambda key: jax.random.split(key, 3), out_axes=1
        )(keys)
        num_steps = paths.shape[1] - 1
        old = self.proposal.reweigh(weigh_keys, model, intervals, paths)
        new = self.proposal.draw(draw_keys[:, None], model, intervals, num_steps, None, False)
        uniform = jax.vmap(lambda key: jax.random.uniform(key, dtype=paths.dtype))(accept_keys)
        accepted = uniform < acceptance_rate(old.log_weights[:, 0], new.log_weights[:, 0])
        num_simulated = old.num_simulated[:, 0] + new.num_simulated[:, 0]
        paths = jnp.where(accepted[:, None, None], new.paths[:, 0], paths)
        truncated = old.truncated[:, 0] | new.truncated[:, 0]
        return paths, BridgeInfo(accepted, num_simulated, ~new.found[:, 0], truncated)


class Unweighted(AbstractBridgeKernel):
    """A new approximate bridge each time."""

    pairs: CoupledPairs

    def first(self, keys, model, intervals, num_steps):
        return first_paths(keys, model, self.pairs, intervals, num_steps)[0]

    def renew(self, keys, model, intervals, paths):
        num_steps = paths.shape[1] - 1
        proposed = propose_paths(keys, model, self.pairs, intervals, None, num_steps)
        found = proposed.num_found > 0
        paths = jnp.where(found[:, None, None], proposed.outputs.paths, paths)
        return paths, BridgeInfo(found, proposed.num_trials, ~found, jnp.zeros_like(found))


class Augmentation(eqx.Module):
    """How the observations are completed: by bridges of all intervals, in blocks of one number of
    steps each, with a kernel for each block."""

    blocks: tuple[Block, ...]
    kernels: tuple[AbstractBridgeKernel, ...]

    @property
    def num_intervals(self) -> int:
        return sum(len(block.index) for block in self.blocks)

    def check_paths(self, paths: tuple[Float[Array, "..."], ...], chains: tuple[int, ...]) -> None:
        """Raise `ValueError` where these are no paths between the observations."""
        wanted = [
            (*chains, len(block.index), block.num_steps + 1, block.intervals.start.shape[1])
            for block in self.blocks
        ]
        shapes = [mine.shape for mine in paths]
        if shapes != wanted:
            raise ValueError(
                f"`init` is a state with paths of shapes {shapes}, but these observations and "
                f"numbers of steps call for {wanted}."
            )
        for block, mine in zip(self.blocks, paths, strict=True):
            ends = (block.intervals.start, block.intervals.end)
            for end, found in zip(ends, (mine[..., 0, :], mine[..., -1, :]), strict=True):
                if not is_traced(end, found) and not np.allclose(found, end, atol=1e-6, rtol=1e-4):
                    raise ValueError(
                        "`init` is a state whose paths do not join these observations."
                    )

    def first(self, key: Key[Array, ""], model: Diffusion) -> Paths:
        """Paths to start from. Where the proposal finds none, whatever its weight, a modified
        diffusion bridge serves, or a straight line: a chain may start anywhere."""
        return self.first_and_found(key, model)[0]

    def first_and_found(
        self, key: Key[Array, ""], model: Diffusion
    ) -> tuple[Paths, Bool[Array, " I"]]:
        """The same, and which of them the proposal itself has found, in the order of the blocks."""
        model = model.prepared()

        def of_block(block, kernel, keys):
            intervals, num_steps = block.intervals, block.num_steps
            found_keys, other_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
            found = kernel.first(found_keys, model, intervals, num_steps)
            other = ModifiedDiffusionBridge().draw(
                other_keys[:, None], model, intervals, num_steps, None, False
            )
            done = jnp.concatenate([jnp.zeros(1), jnp.cumsum(block.fractions)]).astype(found.dtype)
            start, end = intervals.start[:, None], intervals.end[:, None]
            path = start + done[:, None] * (end - start)
            for better in (other.paths[:, 0], found):
                path = jnp.where(is_there(better)[:, None, None], better, path)
            return path, is_there(found)

        made = list(map(of_block, self.blocks, self.kernels, self._keys(key)))
        return tuple(path for path, _ in made), jnp.concatenate([found for _, found in made])

    def renew(
        self, key: Key[Array, ""], model: Diffusion, paths: Paths
    ) -> tuple[Paths, BridgeInfo]:
        """One step of every bridge, at the parameters of this model."""
        model = model.prepared()
        made = [
            kernel.renew(keys, model, block.intervals, mine)
            for block, kernel, keys, mine in zip(
                self.blocks, self.kernels, self._keys(key), paths, strict=True
            )
        ]
        paths, infos = zip(*made, strict=True)
        return paths, jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *infos)

    def log_likelihoods(
        self, model: Diffusion, paths: Paths, form: Form
    ) -> Float[Array, " intervals"]:
        """Those of the paths, block by block."""
        values = [
            log_likelihoods(model, block.steps, mine, form)
            for block, mine in zip(self.blocks, paths, strict=True)
        ]
        return jnp.concatenate(values)

    def log_step_error(self, model: Diffusion, paths: Paths, form: Form) -> Float[Array, ""]:
        """The step error of the log density of these paths, summed over the intervals: D of
        `halving`, times the share of it that is the error."""
        model = model.prepared()
        return sum(
            (
                jnp.sum(step_shares(block, model, form) * log_halvings(block, model, mine, form))
                for block, mine in zip(self.blocks, paths, strict=True)
            ),
            start=jnp.zeros((), paths[0].dtype),
        )

    def points(self, paths: Paths) -> tuple[Float[Array, "points d"], Float[Array, " points"]]:
        """All points of the paths but their ends, and the steps that begin there."""
        points = [mine[:, :-1].reshape(-1, mine.shape[-1]) for mine in paths]
        steps = [block.steps.T.reshape(-1) for block in self.blocks]
        return jnp.concatenate(points), jnp.concatenate(steps)

    def _keys(self, key: Key[Array, ""]) -> list[Key[Array, " I"]]:
        keys = jax.random.split(key, len(self.blocks))
        return [
            jax.random.split(key, len(block.intervals.duration))
            for key, block in zip(keys, self.blocks, strict=True)
        ]


def is_there(paths: Float[Array, "I points d"]) -> Bool[Array, " I"]:
    """Which paths are not missing."""
    return jnp.all(jnp.isfinite(paths), axis=(1, 2))


def augment(
    key: Key[Array, ""],
    model: Diffusion,
    intervals: Intervals,
    groups: tuple[Group, ...],
    proposal: Any,
    bridges: Literal["exact", "approximate"],
    method: Literal["pseudo_marginal", "renewal"] | None,
    bounds: Bounds,
) -> Augmentation:
    """The augmentation that the user asked for; pilot runs and burn-ins are at the parameters of
    this model.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.
    """
    if bridges not in ("exact", "approximate"):
        raise ValueError(f'`bridges` must be "exact" or "approximate"; got {bridges!r}.')
    if method not in (None, "pseudo_marginal", "renewal"):
        raise ValueError(f'`method` must be "pseudo_marginal" or "renewal"; got {method!r}.')
    if bridges == "approximate" and method is not None:
        raise ValueError("`method` is for exact bridges: approximate ones need none.")
    given = proposal
    if proposal is None and bridges == "exact" and method is None:
        given = "auto"
    only_couplings = bridges == "approximate" or method == "renewal"
    exact = bridges == "exact"
    couplings = {"only_couplings": only_couplings, "weighted": exact}
    blocks = make_blocks(key, model, intervals, groups, given, bounds, **couplings)
    return Augmentation(blocks, tuple(_kernel(block.proposal, bridges, method) for block in blocks))


def _kernel(
    proposal: AbstractWeightedProposal, bridges: str, method: str | None
) -> AbstractBridgeKernel:
    if bridges == "approximate":
        return Unweighted(as_pairs(proposal))
    if method == "renewal" or (method is None and isinstance(proposal, CoupledPairs)):
        return ByRenewal(as_pairs(proposal))
    return ByWeights(proposal)
