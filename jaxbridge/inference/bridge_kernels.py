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
    """Of one step on all intervals: whether the path of each was replaced; how many paths were
    simulated, or weighed, for it; whether no proposal was found though one was called for. Then
    the path stays, which leaves the exact law invariant, for whether one is found does not
    depend on the path. Then, whether a weight was cut off by a bound on its trials, or the run
    that replaces a sampler of the stationary law by one on its steps. Last, how many paths left the
    state space or the finite numbers."""

    moved: Bool[Array, " I"]
    num_simulated: Int[Array, " I"]
    missing: Bool[Array, " I"]
    truncated: Bool[Array, " I"]
    num_nonfinite: Int[Array, " I"]


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
        counts = info.is_accepted, info.num_simulated, info.is_missing, cut
        return paths, BridgeInfo(*counts, info.num_nonfinite)


class ByWeights(AbstractBridgeKernel):
    """The pseudo-marginal kernel."""

    proposal: AbstractWeightedProposal

    def first(self, keys, model, intervals, num_steps):
        drawn = self.proposal.draw(keys[:, None], model, intervals, num_steps, None, False)
        return drawn.paths[:, 0]

    def renew(self, keys, model, intervals, paths):
        weigh_keys, draw_keys, accept_keys = split_each(keys, 3)
        num_steps = paths.shape[1] - 1
        old = self.proposal.reweigh(weigh_keys, model, intervals, paths)
        new = self.proposal.draw(draw_keys[:, None], model, intervals, num_steps, None, False)
        uniform = jax.vmap(lambda key: jax.random.uniform(key, dtype=paths.dtype))(accept_keys)
        accepted = uniform < acceptance_rate(old.log_weights[:, 0], new.log_weights[:, 0])
        num_simulated = old.num_simulated[:, 0] + new.num_simulated[:, 0]
        paths = jnp.where(accepted[:, None, None], new.paths[:, 0], paths)
        truncated = old.truncated[:, 0] | new.truncated[:, 0]
        num_nonfinite = old.num_nonfinite[:, 0] + new.num_nonfinite[:, 0]
        counts = accepted, num_simulated, ~new.found[:, 0], truncated
        return paths, BridgeInfo(*counts, num_nonfinite)


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
        counts = found, proposed.num_trials, ~found, jnp.zeros_like(found)
        return paths, BridgeInfo(*counts, proposed.num_nonfinite)
