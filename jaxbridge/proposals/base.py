"""Interface of the proposals: paths with unbiased weights,

    E[w h(path)] = p_T(a, b) E_bridge[h].

Markov chains, importance sampling and transition densities use only this interface. The weights of
a coupling are random (`coupled`). Those of a guided proposal are functions of the path (`guided`).
Each interval may have a separate proposal (`choice`).
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from ..coupling import AbstractCoupling
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from ..schemes import (
    AbstractStepDensity,
    StepError,
    error_of_coupled_grids,
    error_of_log_mean,
    share_in_regime,
)


class WeightedPaths(NamedTuple):
    """n weighted paths of each of I intervals.

    - `paths`, `log_weights`: NaN and -inf for paths that were not found.
    - `found`: whether a path was found.
    - `truncated`: whether the weight is inexact, because a bound on the work was reached or because
        the weight itself was NaN or infinite.
    - `num_simulated`: number of simulated paths.
    - `num_nonfinite`: number of simulated paths that became non-finite.
    - `log_halving`: D of `halving`, NaN if it was not computed.
    - `log_coarse`: log weight of the coarse path, which the same noise gives with half as many
        steps (`guided`); -inf if the coarse path was lost, NaN if it was not computed.
    - `coarse_paths`: the coarse paths; the path itself where there is no coarse path. `None` if
        none were stored. Between two points of the coarse grid, the distance of a coarse path to
        the fine path is constant.
    """

    paths: Float[Array, "I n K d"]
    log_weights: Float[Array, "I n"]
    found: Bool[Array, "I n"]
    truncated: Bool[Array, "I n"]
    num_simulated: Int[Array, "I n"]
    num_nonfinite: Int[Array, "I n"]
    log_halving: Float[Array, "I n"]
    log_coarse: Float[Array, "I n"]
    coarse_paths: Float[Array, "I n K d"] | None

    @property
    def log_change(self) -> Float[Array, "I n"]:
        """Return log(weight with half as many steps / weight) of each path.

        It is `log_coarse - log_weights`, or `log_halving` without coarse paths.
        """
        # A path that was not found has no ratio.
        log_weights = jnp.where(self.found, self.log_weights, 0)
        of_coarse_paths = jnp.where(self.found, self.log_coarse - log_weights, jnp.nan)
        return jnp.where(jnp.isnan(self.log_coarse), self.log_halving, of_coarse_paths)

    def step_error(
        self, share: Float[Array, " I"], num_steps: int, sigma_varies: bool, held: bool = False
    ) -> StepError:
        """Return the discretisation error of log p̂, where p̂ is the mean of the weights.

        For a state-dependent σ it needs `log_coarse`.

        - `share`: the result of `step_share` or `share_in_regime`.
        - `held`: whether the weights belong to the current state of a pseudo-marginal chain. The
            chain prefers states with a large p̂: the density of their weights is that of fresh
            weights times p̂, up to a constant.
        """
        # For constant σ, D varies little, so e^D compares the two grids more precisely.
        if not sigma_varies:
            return error_of_log_mean(self.log_weights, self.log_halving, share, held)
        return error_of_coupled_grids(self.log_weights, self.log_coarse, share, num_steps, held)


class AbstractProposal(eqx.Module):
    """Base class of all values of `proposal=`: a single proposal, or a choice between several."""

    @property
    @abstractmethod
    def singles(self) -> tuple["AbstractSingleProposal", ...]:
        """Return the single proposals that may be used."""

    @property
    def coupled(self) -> bool:
        """Return whether any interval may have a coupling; couplings have no derivatives."""
        return any(single.by_coupling is not None for single in self.singles)

    @property
    @abstractmethod
    def by_coupling(self) -> AbstractCoupling | None:
        """Return the coupling of a single proposal by a coupling; `None` for other proposals."""

    @abstractmethod
    def describe(self) -> str:
        """Return a short description for tables and messages."""

    @abstractmethod
    def fractions(self, num_steps: int) -> Float[np.ndarray, "N+1"]:
        """Return the grid t_i / T, from 0 to 1, shape (N+1,)."""

    @abstractmethod
    def for_model(
        self, model: Diffusion, like: Float[Array, " d"], normal_steps: bool = True
    ) -> "AbstractProposal":
        """Set all defaults that depend on the model; return the proposal.

        `like` is a point of the right shape and dtype. `normal_steps` states that paths must
        determine their noise, so that the steps of guided proposals must be normal.
        """

    @abstractmethod
    def check(self, model: Diffusion, intervals: Intervals) -> None:
        """Raise `ValueError` if the proposal does not fit the model or the end points.

        Traced values are not checked.
        """

    @abstractmethod
    def check_prepared(self, model: Diffusion) -> None:
        """Raise `ValueError` if `prepared` would have to run a simulation."""

    def check_for_density(self, model: Diffusion) -> None:
        """Raise `ValueError` if the weights are known only up to a constant."""
        for single in self.singles:
            single.check_size(model)

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """Return whether a choice between several proposals is still open."""

    @abstractmethod
    def of(self, which: Int[np.ndarray, " J"]) -> "AbstractProposal":
        """Return the proposal for the intervals with the indices `which`."""

    @abstractmethod
    def prepared(
        self, key: Key[Array, ""], model: Diffusion, intervals: Intervals, num_steps: int
    ) -> "AbstractWeightedProposal":
        """Measure the quantities that these intervals need; return the proposal with them."""


class AbstractWeightedProposal(AbstractProposal):
    """Base class of proposals that are ready to draw paths, each with an unbiased weight.

    The methods `draw` and `reweigh` take an optional mask `active` of shape (I,). Where the mask is
    false, the result has no paths, and almost no work is done.
    """

    @abstractmethod
    def for_all(self) -> "AbstractSingleProposal":
        """Return one single proposal for all intervals.

        A choice between several needs concrete values, so call it outside `jit`.
        """

    @abstractmethod
    def split(self) -> Sequence[tuple[Int[np.ndarray, " J"] | slice, "AbstractSingleProposal"]]:
        """Return pairs of interval indices and their single proposal.

        A choice between several needs concrete values, so call it outside `jit`.
        """

    @abstractmethod
    def step_share(self, model: Diffusion, intervals: Intervals) -> Float[Array, " I"]:
        """Return the ratio of the discretisation error to the change by half as many steps, (I,).

        See `schemes.step_error`.
        """

    def share_in_regime(
        self, model: Diffusion, intervals: Intervals, num_steps: int
    ) -> Float[Array, " I"]:
        """Return `step_share`, with infinity where steps are too long for an estimate."""
        return share_in_regime(self.step_share(model, intervals), model, intervals, num_steps)

    @abstractmethod
    def draw(
        self,
        keys: Key[Array, "I n"],
        model: Diffusion,
        intervals: Intervals,
        num_steps: int,
        stored: Int[Array, " K"] | None,
        misses_count: bool,
        active: Bool[Array, " I"] | None = None,
        progress_meter: diffrax.AbstractProgressMeter | None = None,
    ) -> WeightedPaths:
        """Draw one weighted path per key. Its random numbers depend on this key only.

        - `stored`: indices of the grid points to store, shape (K,), or `None` for all.
        - `misses_count`: for couplings. If true, one attempt is made for each path, and a pair that
            does not meet has weight zero, so that `E[w] = p_T(a, b)`. Otherwise attempts are
            repeated until a pair meets, and weights are correct up to a constant factor. Guided
            proposals always make one attempt.
        """

    @abstractmethod
    def reweigh(
        self,
        keys: Key[Array, " I"],
        model: Diffusion,
        intervals: Intervals,
        paths: Float[Array, "I points d"],
        active: Bool[Array, " I"] | None = None,
    ) -> WeightedPaths:
        """Return the given paths, one per interval, with new weights.

        In the stationary law of a pseudo-marginal chain, a state is a path with a random weight.
        The new weights have the conditional law of this weight given the path.
        """


class AbstractSingleProposal(AbstractWeightedProposal):
    """Base class of single proposals, with the properties that a choice between several needs."""

    @property
    def singles(self):
        return (self,)

    @property
    def is_open(self):
        return False

    @abstractmethod
    def for_model(
        self, model: Diffusion, like: Float[Array, " d"], normal_steps: bool = True
    ) -> "AbstractSingleProposal":
        """Set all defaults that depend on the model; return the proposal.

        `like` is a point of the right shape and dtype. `normal_steps` states that paths must
        determine their noise, so that the steps of guided proposals must be normal.
        """

    def of(self, which):
        return self

    def for_all(self):
        return self

    def split(self):
        return [(slice(None), self)]

    @property
    @abstractmethod
    def target(self) -> AbstractStepDensity | None:
        """Return the step density of the target chain.

        It is `None` for couplings: their target is the diffusion, up to the error of the scheme.
        """

    @property
    @abstractmethod
    def efficiency_bound(self) -> float:
        """Return an upper bound of the effective samples per simulated path."""

    @abstractmethod
    def relative_seconds(self, model: Diffusion, intervals: Intervals) -> Float[Array, " I"]:
        """Return the seconds per simulated path relative to a modified diffusion bridge, (I,).

        The values were measured for models with cheap functions.
        """

    @abstractmethod
    def ingredients(self) -> tuple[str, str, float]:
        """Return the names of the scheme (or step density) and of the meeting rule, and γ."""

    @abstractmethod
    def most_accurate(self, model: Diffusion, like: Float[Array, " d"]) -> "AbstractSingleProposal":
        """Return the proposal with the most accurate scheme or target for this model."""

    @abstractmethod
    def for_pilot(self) -> "AbstractSingleProposal":
        """Return the proposal with the tighter bounds on the work that pilot runs use."""

    @abstractmethod
    def prepared(
        self, key: Key[Array, ""], model: Diffusion, intervals: Intervals, num_steps: int
    ) -> "AbstractSingleProposal":
        """Measure the quantities that these intervals need; return the proposal with them."""

    @abstractmethod
    def must_measure(self, model: Diffusion) -> bool:
        """Return whether `prepared` has to run a simulation."""

    @abstractmethod
    def check_size(self, model: Diffusion) -> None:
        """Raise `ValueError` if the weights are known only up to a constant."""
