"""Markov kernels for the bridges given the parameters: one step for the path of each interval.

The first two kernels leave the exact law of a bridge at the current θ invariant (section 2.3 of the
paper). The current path may come from another θ.

- `ByRenewal`, for couplings, holds a bridge until its associated diffusion hits it. The path is its
  only state.
- `ByWeights` accepts a new weighted proposal with the ratio of the weights. It redraws the weight
  of the current path from its law given θ and the path. For the counts of a coupling this is the
  size-biased law; for guided proposals the weight is a function of the path.
- `Unweighted` accepts each new proposal of a coupling. It is approximate, as in section 4 of the
  paper.
"""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from ..coupling import run_is_cut
from ..engine.keys import split_each
from ..exact import acceptance_rate, first_paths, propose_paths, renew
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from ..proposals import AbstractWeightedProposal, CoupledPairs


class BridgeInfo(NamedTuple):
    """Events of one step, for each interval.

    - `moved`: whether the path was replaced.
    - `num_simulated`: number of simulated or reweighted paths.
    - `missing`: whether a proposal was needed but not found. Then the path stays. This leaves the
      exact law invariant, because the event does not depend on the path.
    - `truncated`: whether a weight was truncated by the bound on its trials, or a burn-in for the
      stationary law by the bound on its steps.
    - `num_nonfinite`: number of paths that diverged or left the state space.
    """

    moved: Bool[Array, " I"]
    num_simulated: Int[Array, " I"]
    missing: Bool[Array, " I"]
    truncated: Bool[Array, " I"]
    num_nonfinite: Int[Array, " I"]


class AbstractBridgeKernel(eqx.Module):
    """Base class of Markov kernels on the bridges of many intervals."""

    @abstractmethod
    def first(
        self, keys: Key[Array, " I"], model: Diffusion, intervals: Intervals, num_steps: int
    ) -> Float[Array, "I points d"]:
        """Sample the first paths; they are NaN for intervals without a proposal."""

    @abstractmethod
    def renew(
        self,
        keys: Key[Array, " I"],
        model: Diffusion,
        intervals: Intervals,
        paths: Float[Array, "I points d"],
    ) -> tuple[Float[Array, "I points d"], BridgeInfo]:
        """Return the paths after one step of each bridge, and its events."""


class ByRenewal(AbstractBridgeKernel):
    """Renewal kernel: it replaces a bridge when the associated diffusion hits it."""

    pairs: CoupledPairs

    def first(self, keys, model, intervals, num_steps):
        return first_paths(keys, model, self.pairs, intervals, num_steps)[0]

    def renew(self, keys, model, intervals, paths):
        all_intervals = jnp.ones(len(keys), bool)
        # The current path is kept where no associated diffusion has hit it.
        paths, info = renew(keys, model, self.pairs, intervals, paths, all_intervals)
        num_steps = paths.shape[1] - 1
        # The length of a burn-in may be limited; the draw is then only approximately stationary.
        law, dt = self.pairs.coupling.start_law, intervals.duration / num_steps
        cut = run_is_cut(law, model, dt, num_steps)
        counts = info.is_accepted, info.num_simulated, info.is_missing, cut
        return paths, BridgeInfo(*counts, info.num_nonfinite)


class ByWeights(AbstractBridgeKernel):
    """Pseudo-marginal kernel: it accepts a new bridge with the ratio of the weights."""

    proposal: AbstractWeightedProposal

    def first(self, keys, model, intervals, num_steps):
        draws = self.proposal.draw(keys[:, None], model, intervals, num_steps, None, False)
        return draws.paths[:, 0]

    def renew(self, keys, model, intervals, paths):
        weigh_keys, draw_keys, accept_keys = split_each(keys, 3)
        num_steps = paths.shape[1] - 1
        # A new weight of the current path from its law given the path and the current θ.
        old = self.proposal.reweigh(weigh_keys, model, intervals, paths)
        new = self.proposal.draw(draw_keys[:, None], model, intervals, num_steps, None, False)
        uniform = jax.vmap(lambda key: jax.random.uniform(key, dtype=paths.dtype))(accept_keys)
        # A missing proposal has weight zero and is never accepted.
        accepted = uniform < acceptance_rate(old.log_weights[:, 0], new.log_weights[:, 0])
        num_simulated = old.num_simulated[:, 0] + new.num_simulated[:, 0]
        paths = jnp.where(accepted[:, None, None], new.paths[:, 0], paths)
        truncated = old.truncated[:, 0] | new.truncated[:, 0]
        num_nonfinite = old.num_nonfinite[:, 0] + new.num_nonfinite[:, 0]
        counts = accepted, num_simulated, ~new.found[:, 0], truncated
        return paths, BridgeInfo(*counts, num_nonfinite)


class Unweighted(AbstractBridgeKernel):
    """Approximate kernel: it accepts each new approximate bridge."""

    pairs: CoupledPairs

    def first(self, keys, model, intervals, num_steps):
        return first_paths(keys, model, self.pairs, intervals, num_steps)[0]

    def renew(self, keys, model, intervals, paths):
        num_steps = paths.shape[1] - 1
        proposed = propose_paths(keys, model, self.pairs, intervals, None, num_steps)
        has_bridge = proposed.num_found > 0
        paths = jnp.where(has_bridge[:, None, None], proposed.outputs.paths, paths)
        counts = has_bridge, proposed.num_trials, ~has_bridge, jnp.zeros_like(has_bridge)
        return paths, BridgeInfo(*counts, proposed.num_nonfinite)
