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
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

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

# Default bound on the attempts for one bridge.
_MAX_PROPOSALS = 10_000


class Auto(AbstractProposal):
    """Open choice between candidates, to be decided by pilot runs.

    - `candidates`: tuple of C proposals.
    - `num_pilot`: paths per interval of a pilot run; `None` for the default.
    - `left_out`: the reason why "auto" omits couplings; empty if it does not.
    """

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
        return f"an open choice between {names}{reason}"

    def fractions(self, num_steps):
        return self.candidates[0].fractions(num_steps)

    def of(self, which):
        return self

    def for_model(self, model, like, normal_steps=True):
        candidates = tuple(
            candidate.for_model(model, like, normal_steps) for candidate in self.candidates
        )
        return dataclasses.replace(self, candidates=candidates)

    def check(self, model, intervals):
        for candidate in self.candidates:
            candidate.check(model, intervals)

    def check_prepared(self, model):
        raise ValueError(
            'a kernel makes no pilot run, so `proposal="auto"` is not possible here: call '
            "`choose_proposal` first, and pass its result as `proposal`."
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
        """Return the choice for these intervals.

        Seconds per path follow a rule; if `timed`, they are measured where this could change the
        choice. The choice itself has no derivatives. Paths and weights of the chosen proposal have
        derivatives with respect to the model, unless a candidate is a coupling.
        """
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
    """Return the proposal; make an open choice first, unless its arguments are traced.

    After the choice, only the chosen candidates are compiled.
    """
    if not isinstance(proposal, Auto):
        return proposal
    if not proposal.coupled:
        model, intervals = without_derivatives((model, intervals))  # concrete under `grad`
    if is_traced(key, model, proposal, intervals):
        return proposal
    return proposal.choose(key, model, intervals, num_steps)


class Budget(NamedTuple):
    """Arguments that bound the work of a coupling; `None` for the default.

    - `num_counts`: number of hitting counts per path.
    - `max_proposals`: maximum number of attempts for a pair that meets.
    - `max_trials`: maximum number of trials for the counts of one path.
    """

    num_counts: int | None = None
    max_proposals: int | None = None
    max_trials: int | None = None

    def refuse(self, reason: str) -> None:
        """Raise `ValueError` with this reason if any of the arguments is given."""
        names = [f"`{name}`" for name, value in self._asdict().items() if value is not None]
        if names:
            raise ValueError(f"{' and '.join(names)}: {reason}. Omit this argument.")


_NO_BUDGET = Budget()

# Type checkers find misspelled strings. At run time `as_proposal` refuses them with a sentence.
if TYPE_CHECKING:
    ProposalLike = AbstractProposal | AbstractCoupling | Literal["auto"] | None
else:
    ProposalLike = Any


def as_proposal(
    proposal: ProposalLike,
    model: Diffusion,
    like: Float[Array, " d"],
    budget: Budget = _NO_BUDGET,
    for_density: bool = False,
    normal_steps: bool = True,
    name: str = "proposal",
) -> AbstractProposal:
    """Convert the argument `proposal`, and set all defaults that depend on the model.

    - `proposal`: `None` stands for `Coupling()`.
    - `like`: a point of the right shape and dtype.
    - `for_density`: whether the weights estimate densities, so that a constant factor matters.
    - `normal_steps`: whether paths must determine their noise, so that steps must be normal. It has
        no effect if `for_density` is true.
    - `name`: name of the argument in messages.

    **Raises:** `TypeError` for anything but a coupling, a proposal or "auto". `ValueError` for a
    budget if the proposal has no use for one, or if σ has no inverse and the proposal is guided.
    """
    normal_steps = normal_steps and not for_density
    if isinstance(proposal, str) and proposal == "auto":
        candidates = default_candidates(model, for_density)
        converted = choice_between(candidates, budget, left_out=why_left_out(model, for_density))
        return converted.for_model(model, like, normal_steps)
    converted = _convert(Coupling() if proposal is None else proposal, budget, name)
    return converted.for_model(model, like, normal_steps)


def _convert(proposal: ProposalLike, budget: Budget, name: str = "proposal") -> AbstractProposal:
    """Return a coupling as `CoupledPairs` with this budget, and a proposal unchanged.

    **Raises:** `ValueError` for a budget of another proposal, `TypeError` for other types.
    """
    if isinstance(proposal, AbstractProposal):
        if any(value is not None for value in budget):
            raise ValueError(
                "`num_counts`, `max_proposals` and `max_trials` are for a `Coupling` only; this "
                "`proposal` has its own values, or needs none. Omit these arguments."
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
    """Return an open choice between these candidates, with the budget for couplings among them.

    **Raises:** `ValueError` for no candidates, for candidates on different grids, for a candidate
    that is itself a choice, and for a budget without couplings. The message of this last error
    states the reason `left_out`. `TypeError` for candidates of other types.
    """
    if len(candidates) == 0:
        raise ValueError("`candidates` must contain at least one proposal; got none.")
    if not any(isinstance(candidate, AbstractCoupling) for candidate in candidates):
        budget.refuse(f'for couplings, which `proposal="auto"` omits here, because {left_out}')
    proposals = tuple(
        _convert(
            candidate,
            budget if isinstance(candidate, AbstractCoupling) else _NO_BUDGET,
            "candidates",
        )
        for candidate in candidates
    )
    if not all(isinstance(proposal, AbstractSingleProposal) for proposal in proposals):
        raise ValueError(
            "`candidates` must be single proposals; got a result of `choose_proposal`. Pass its "
            "`candidates` instead."
        )
    # Any number of steps shows whether the grids differ.
    grids = {tuple(proposal.fractions(8)) for proposal in proposals}
    if len(grids) > 1:
        raise ValueError("`candidates` must be on one grid: use the same `refinement` for all.")
    return Auto(proposals, num_pilot, left_out)  # pyright: ignore


def guided_candidates() -> list[AbstractSingleProposal]:
    """Return the guided candidates of "auto".

    Their default targets are the most accurate step densities. For constant σ these have the same
    order of discretisation error as couplings; for a state-dependent σ, usually a higher one.
    """
    return [ModifiedDiffusionBridge(), Guided("end"), Guided("path")]


def default_candidates(model: Diffusion, for_density: bool = False) -> list[Any]:
    """Return the candidates of "auto", with couplings if the model is suitable.

    Couplings need a time reversal. For a density they also need a model that is declared
    `normalised`.
    """
    coupled = model.has_reversal and (model.normalised or not for_density)
    # Guided candidates come first: couplings then have pilot runs only where they could be better.
    couplings = [Coupling(0.0), Coupling(0.5)] if coupled else []
    return [*guided_candidates(), *couplings]


def why_left_out(model: Diffusion, for_density: bool) -> str:
    """Return the reason why `default_candidates` has no couplings; empty if it has them."""
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
