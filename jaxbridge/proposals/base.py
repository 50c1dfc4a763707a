"""Weighted proposals: a bridge proposal is a path with an unbiased weight,

    E[w h(path)] = p_T(a, b) E_bridge[h].

Chains, importance means and transition densities are written on this alone. A coupling gives
random weights (`coupled`), proposals that are pulled to the end point weights that are functions of
the path (`guided`), and each interval may have its own (`choice`).
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import diffrax
import equinox as eqx
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

    `log_weights` are -inf and `paths` NaN where none was `found`; `truncated` says where a
    weight is not exact because a bound on the work was reached; `num_simulated` counts the
    simulated paths, and `num_nonfinite` those that left the finite numbers. `log_halving` is D of
    `halving`, and `log_coarse` the log weight of the path of half as many steps from the same noise
    (`coupled_grids`), -inf if that path was lost; each is NaN where it was not computed.
    """

    paths: Float[Array, "I n K d"]
    log_weights: Float[Array, "I n"]
    found: Bool[Array, "I n"]
    truncated: Bool[Array, "I n"]
    num_simulated: Int[Array, "I n"]
    num_nonfinite: Int[Array, "I n"]
    log_halving: Float[Array, "I n"]
    log_coarse: Float[Array, "I n"]

    def step_error(
        self, share: Float[Array, " I"], num_steps: int, sigma_varies: bool, held: bool = False
    ) -> StepError:
        """Return the step error of the log of the mean of the weights; for paths of which nothing
        is stored."""
        if not sigma_varies:
            return error_of_log_mean(self.log_weights, self.log_halving, share, held)
        return error_of_coupled_grids(self.log_weights, self.log_coarse, share, num_steps, held)


class AbstractProposal(eqx.Module):
    """What may be given as `proposal`: one way to propose bridges, or several to choose between."""

    @property
    @abstractmethod
    def singles(self) -> tuple["AbstractSingleProposal", ...]:
        """The ways that may be used."""

    @property
    def coupled(self) -> bool:
        """Whether any interval may have a coupling, of which no derivative may be taken."""
        return any(single.by_coupling is not None for single in self.singles)

    @property
    @abstractmethod
    def by_coupling(self) -> AbstractCoupling | None:
        """The coupling whose pairs are proposed, if there is one way and that is it."""

    @abstractmethod
    def describe(self) -> str:
        """The proposal in a few words."""

    @abstractmethod
    def fractions(self, num_steps: int) -> Float[np.ndarray, "N+1"]:
        """The grid, t_i / T, from 0 to 1."""

    @abstractmethod
    def for_model(self, model: Diffusion, like: Float[Array, " d"]) -> "AbstractProposal":
        """The proposal with all decided that it leaves to the model, for points like this one."""

    @abstractmethod
    def check(self, model: Diffusion, intervals: Intervals) -> None:
        """Raise `ValueError` for a model or end points that do not fit, as far as visible."""

    @abstractmethod
    def check_prepared(self, model: Diffusion) -> None:
        """Raise `ValueError` where `prepared` would have to measure something."""

    def check_for_density(self, model: Diffusion) -> None:
        """Raise `ValueError` where the size of weights rests on what is not known."""
        for single in self.singles:
            single.check_size(model)

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """Whether there is a choice yet to be made."""

    @abstractmethod
    def of(self, which: Int[np.ndarray, " J"]) -> "AbstractProposal":
        """The proposal for some of the intervals that it is for."""

    @abstractmethod
    def prepared(
        self, key: Key[Array, ""], model: Diffusion, intervals: Intervals, num_steps: int
    ) -> "AbstractWeightedProposal":
        """The proposal with everything measured that it must know of these intervals."""


class AbstractWeightedProposal(AbstractProposal):
    """A proposal that has been prepared: paths, each with an unbiased weight.

    Intervals that are not `active`, where that is given, cost no work, and have no paths.
    """

    @abstractmethod
    def for_all(self) -> "AbstractSingleProposal":
        """One way for all intervals. Not under `jit` where there are several."""

    @abstractmethod
    def split(self) -> Sequence[tuple[Int[np.ndarray, " J"] | slice, "AbstractSingleProposal"]]:
        """The intervals of each way. Not under `jit` where there are several."""

    @abstractmethod
    def step_share(self, model: Diffusion, intervals: Intervals) -> Float[Array, " I"]:
        """The step error as a share of what half as many steps change (`step_error`)."""

    def share_in_regime(
        self, model: Diffusion, intervals: Intervals, num_steps: int
    ) -> Float[Array, " I"]:
        """Return that share, infinite where steps are too long for it to say anything."""
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
        """One weighted path for each key, a function of that key and its interval.

        With `misses_count` a proposal that does not become a bridge has weight zero, so that
        `E[w] = p_T(a, b)`; otherwise it is tried again, and weights are in proportion only.
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
        """Given paths, one for each interval, with weights from their conditional law under the
        target of a chain."""


class AbstractSingleProposal(AbstractWeightedProposal):
    """One way to propose bridges, and what a choice between several must know of it."""

    @property
    def singles(self):
        return (self,)

    @property
    def is_open(self):
        return False

    @abstractmethod
    def for_model(self, model: Diffusion, like: Float[Array, " d"]) -> "AbstractSingleProposal":
        """The proposal with all decided that it leaves to the model, for points like this one."""

    def of(self, which):
        return self

    def for_all(self):
        return self

    def split(self):
        return [(slice(None), self)]

    @property
    @abstractmethod
    def target(self) -> AbstractStepDensity | None:
        """The law of the steps of the chain of which its bridges are exact; `None` where that is
        the diffusion itself, but for the error of a scheme."""

    @property
    @abstractmethod
    def efficiency_bound(self) -> float:
        """Effective samples per simulated path, at most."""

    @abstractmethod
    def relative_seconds(self, model: Diffusion, intervals: Intervals) -> Float[Array, " I"]:
        """Seconds per simulated path beside those of a modified diffusion bridge, as measured for
        models whose functions cost little beside the random numbers."""

    @abstractmethod
    def ingredients(self) -> tuple[str, str, float]:
        """The scheme, or the law of the target's steps, the meeting rule, and γ."""

    @abstractmethod
    def most_accurate(self, model: Diffusion, like: Float[Array, " d"]) -> "AbstractSingleProposal":
        """The same with the smallest step error that it can have."""

    @abstractmethod
    def for_pilot(self) -> "AbstractSingleProposal":
        """The same, which gives up early what is not worth waiting for."""

    @abstractmethod
    def prepared(
        self, key: Key[Array, ""], model: Diffusion, intervals: Intervals, num_steps: int
    ) -> "AbstractSingleProposal":
        """The proposal with everything measured that it must know of these intervals."""

    @abstractmethod
    def must_measure(self, model: Diffusion) -> bool:
        """Whether `prepared` has something to measure."""

    @abstractmethod
    def check_size(self, model: Diffusion) -> None:
        """Raise `ValueError` where the size of the weights, and not only their proportion, rests on
        what is not known."""
