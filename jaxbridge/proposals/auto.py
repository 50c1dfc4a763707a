"""Candidates of `proposal="auto"`, and conversion of the argument `proposal` (`as_proposal`).

On short intervals guided proposals are nearly exact, and coupled pairs rarely meet. On long
intervals the opposite holds. The crossover depends on the model, the end points and the step size.
Hence pilot runs select the proposal with the least error per second for each interval (`pilots`).

The paths of pilot runs are not used again, so weights remain unbiased for every choice. But a pilot
run of finite size may select a poor proposal. For instance, it may miss a second way to the end
point.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float, Key

from ..coupling import AbstractCoupling, Coupling, check_max_trials
from ..engine.checks import (
    check_bound,
    check_count,
    is_traced,
    nondifferentiable_choice,
    without_derivatives,
)
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from .base import AbstractProposal, AbstractSingleProposal
from .choice import Choice
from .coupled import CoupledPairs
from .linear_guide import Guided
from .modified_bridge import ModifiedDiffusionBridge
from .pilots import run_pilots

# Bounds the tries for one bridge, unless the user says otherwise.
_MAX_PROPOSALS = 10_000


class Auto(AbstractProposal):
    """A choice to be made: between these, by pilot runs of so many paths, or the default.
    `left_out` says why there are no couplings among them, where that is not the user's doing."""

    candidates: tuple[AbstractSingleProposal, ...]
    num_pilot: int | None = eqx.field(static=True, default=None)
    left_out: str = eqx.field(static=True, default="")

    @property
    def singles(self):
        return self.candidates

    @property
    def is_open(self):
        return True

    @property
    def by_coupling(self):
        return None

    def describe(self):
        names = ", ".join(candidate.describe() for candidate in self.candidates)
        reason = f"\ncouplings left out: {self.left_out}" if self.left_out else ""
        return f"a choice to be made between {names}{reason}"

    def fractions(self, num_steps):
        return self.candidates[0].fractions(num_steps)

    def of(self, which):
        return self

    def for_model(self, model, like, for_density=False):
        candidates = tuple(
            candidate.for_model(model, like, for_density) for candidate in self.candidates
        )
        return dataclasses.replace(self, candidates=candidates)

    def check(self, model, intervals):
        for candidate in self.candidates:
            candidate.check(model, intervals)

    def check_prepared(self, model):
        raise ValueError(
            'a kernel makes no pilot run, so `proposal="auto"` is not possible: call '
            "`choose_proposal` before, and pass its result."
        )

    def prepared(self, key, model, intervals, num_steps):
        return self.choose(key, model, intervals, num_steps)

    def choose(
        self,
        key: Key[Array, ""],
        model: Diffusion,
        intervals: Intervals,
        num_steps: int,
        timed: bool = False,
    ) -> Choice:
        """The choice, by the rule for seconds or by the clock. What is chosen has no derivative in
        the model, but that of which it is chosen may have one, unless it may be a coupling."""
        if self.coupled:
            model, intervals = nondifferentiable_choice((model, intervals))
        else:
            model, intervals = without_derivatives((model, intervals))
        arguments = (self.candidates, intervals, num_steps, self.num_pilot)
        choice = run_pilots(key, model, *arguments, timed)
        return dataclasses.replace(choice, left_out=self.left_out)

    def __str__(self) -> str:
        return self.describe()


def resolve(
    proposal: AbstractProposal,
    key: Key[Array, ""],
    model: Diffusion,
    intervals: Intervals,
    num_steps: int,
) -> AbstractProposal:
    """The proposal, with a choice made before compiling where that can be, so that only what was
    chosen is compiled."""
    if not isinstance(proposal, Auto):
        return proposal
    if not proposal.coupled:
        model, intervals = without_derivatives((model, intervals))  # known under `grad`
    if is_traced(key, model, proposal, intervals):
        return proposal
    return proposal.choose(key, model, intervals, num_steps)


class Budget(NamedTuple):
    """What the user said of the work for a coupling's pairs: N hitting counts, and bounds on the
    tries for a pair and on the trials for its counts."""

    num_counts: int | None = None
    max_proposals: int | None = None
    max_trials: int | None = None

    def refuse(self, reason: str) -> None:
        """Raise `ValueError`, which says what they are for, where any of these is given."""
        given = [f"`{name}`" for name, value in self._asdict().items() if value is not None]
        if given:
            raise ValueError(f"{' and '.join(given)}: {reason}. Leave this out.")


_NO_BUDGET = Budget()


def as_proposal(
    proposal: Any,
    model: Diffusion,
    like: Float[Array, " d"],
    budget: Budget = _NO_BUDGET,
    for_density: bool = False,
    name: str = "proposal",
) -> AbstractProposal:
    """What the user gave as `proposal`, for points like this one; `for_density` if the size of its
    weights matters, and not only their proportion."""
    if isinstance(proposal, str) and proposal == "auto":
        candidates = default_candidates(model, for_density)
        given = choice_between(candidates, budget, left_out=why_left_out(model, for_density))
        return given.for_model(model, like, for_density)
    given = _given(Coupling() if proposal is None else proposal, budget, name)
    return given.for_model(model, like, for_density)


def _given(proposal: Any, budget: Budget, name: str = "proposal") -> AbstractProposal:
    if isinstance(proposal, AbstractProposal):
        if any(value is not None for value in budget):
            raise ValueError(
                "`num_counts`, `max_proposals` and `max_trials` are for a `Coupling`; this "
                "`proposal` has its own values, or needs none: omit these arguments."
            )
        return proposal
    if not isinstance(proposal, AbstractCoupling):
        raise TypeError(
            f"`{name}` must be a `Coupling`, `ModifiedDiffusionBridge()`, `ResidualBridge()`, "
            f'`Guided()`, a result of `choose_proposal`, or "auto"; got {proposal!r}.'
        )
    num_counts = 1 if budget.num_counts is None else check_count("num_counts", budget.num_counts)
    return CoupledPairs(
        proposal,
        check_bound("max_proposals", budget.max_proposals, _MAX_PROPOSALS),
        check_max_trials(budget.max_trials, num_counts),
        num_counts,
    )


def choice_between(
    candidates: Sequence[Any],
    budget: Budget = _NO_BUDGET,
    num_pilot: int | None = None,
    left_out: str = "",
) -> Auto:
    """A choice between these, yet to be made; the budget is for couplings among them.

    **Raises:** `ValueError` for a budget where there are none, which `left_out` explains.
    """
    if len(candidates) == 0:
        raise ValueError("`candidates` must contain at least one proposal; got none.")
    if not any(isinstance(each, AbstractCoupling) for each in candidates):
        budget.refuse(f'for couplings, which `proposal="auto"` leaves out here: {left_out}')
    proposals = tuple(
        _given(each, budget if isinstance(each, AbstractCoupling) else _NO_BUDGET, "candidates")
        for each in candidates
    )
    if not all(isinstance(proposal, AbstractSingleProposal) for proposal in proposals):
        raise ValueError(
            "`candidates` must be single proposals; got a result of `choose_proposal`."
        )
    grids = {tuple(proposal.fractions(8)) for proposal in proposals}
    if len(grids) > 1:
        raise ValueError("`candidates` must be on one grid: use the same `refinement` for all.")
    return Auto(proposals, num_pilot, left_out)  # pyright: ignore


def guided_candidates() -> list[AbstractSingleProposal]:
    """With the same order of step error as couplings, where that is to be had."""
    return [ModifiedDiffusionBridge(), Guided("end"), Guided("path")]


def default_candidates(model: Diffusion, for_density: bool = False) -> list[Any]:
    """Couplings only where the time reversal is known; and for a density, where ν is."""
    coupled = model.has_reversal and (model.normalised or not for_density)
    couplings = [Coupling(0.0), Coupling(0.5)] if coupled else []
    return [*guided_candidates(), *couplings]


def why_left_out(model: Diffusion, for_density: bool) -> str:
    """Why there are no couplings among `default_candidates`; empty where there are."""
    if not model.has_reversal:
        return (
            "the model has no time reversal (give `Diffusion` a `log_stationary`, a "
            "`reverse_drift` or `reversible=True`)"
        )
    if for_density and not model.normalised:
        return (
            "their densities need a normalised `log_stationary`, and this one is not declared to "
            "be normalised (`Diffusion(..., normalised=True)`)"
        )
    return ""
