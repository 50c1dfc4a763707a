"""The choice of a proposal for each interval, made once and by the clock."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Key

from ..coupling import Coupling
from ..engine.arguments import as_sequence
from ..engine.checks import Numbers, check_count, check_key, is_traced
from ..engine.doors import door
from ..models.bridge_problem import BridgeProblem, bridge_problem
from ..models.diffusion import Diffusion
from ..proposals import Choice, choice_between, default_candidates, why_left_out
from .start_law import best_pilot, coupling_pilots

# Bridges of a pilot run that looks for the coupling to compare with other proposals.
_TUNING_PILOT = 500


# What a fitted start law may gain.
_GAIN_OF_TUNING = 10.0


@door
def choose_proposal(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_steps: int = 50,
    candidates: Sequence[Any] | None = None,
    num_pilot: int | None = None,
    for_density: bool = False,
) -> Choice:
    """The proposal with most effective samples per second for each interval, by a pilot run.

    What `proposal="auto"` does in each call by a rule for the seconds, done once and by the
    clock, compile time left out: for models whose functions take long, and to choose once and
    use it often. Pass what it returns as `proposal=` for the same intervals. A choice made
    outside `jit`; where two proposals are about as fast, either may be chosen.

    **Arguments:**

    - `key`, `model`, `start`, `end`, `duration`, `num_steps`: as in `sample_bridges`.
    - `candidates`: proposals and couplings. By default `ModifiedDiffusionBridge`,
        `Guided("end")` and `Guided("path")`; where the time reversal of the model is known
        `Coupling(0.0)` and `Coupling(0.5)`; and for a single interval for which one of them comes
        near the best, one with its start law tuned.
    - `num_pilot`: pilot paths of each candidate for each interval; by default about 4,000 over
        all intervals, at least 32 and at most 512.
    - `for_density`: for `transition_log_density` and `pmmh`. Then couplings that start from the
        stationary law are candidates only if the model is declared `normalised`; one with a fitted
        law is tried where the others do badly on a single interval.

    **Returns:** `Choice`; printed, it is a table.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit; `TypeError` inside
    `jit`.

    **Example:**

    ```python
    candidates = [jb.Coupling(0.5), jb.Guided()]
    choice = jb.choose_proposal(key, model, start, end, 1.0, candidates=candidates)
    print(choice)
    chain = jb.sample_exact_bridges(key, model, start, end, 1.0, proposal=choice)
    ```
    """
    check_key(key)
    problem = bridge_problem(model, start, end, duration, num_steps)
    intervals, batched = problem.intervals, problem.batched
    if is_traced(key, model, intervals):
        raise TypeError(
            "a choice by the clock cannot be made inside `jit` or `vmap`: make it before, or use "
            '`proposal="auto"`.'
        )
    if num_pilot is not None:
        num_pilot = check_count("num_pilot", num_pilot, 2)
    left_out = ""
    if candidates is None:
        given = default_candidates(model, for_density)
        left_out = why_left_out(model, for_density)
    else:
        given = list(as_sequence("candidates", candidates, "proposals"))

    def choose_between(candidates, left_out=""):
        auto = choice_between(candidates, num_pilot=num_pilot, left_out=left_out)
        auto = auto.for_model(model, intervals.start[0])
        auto.check(model, intervals)
        if for_density:
            auto.check_for_density(model)
        return auto.choose(key, model, intervals, num_steps, timed=True)

    choice = choose_between(given, left_out)
    possible = model.has_reversal and (model.has_density or not for_density)
    if candidates is None and not batched and possible and _worth_tuning(choice):
        tuned = _tuned_coupling(key, model, problem, for_density)
        choice = choice if tuned is None else choose_between([*given, tuned])
    return choice


def _worth_tuning(choice: Choice) -> bool:
    """Whether a coupling comes near the best proposal, so that a start law might put it first; or,
    where none was tried, whether the best one at all might be put behind."""
    rates = np.asarray(choice.efficiency / choice.seconds)[:, 0]
    coupled = [candidate.coupled for candidate in choice.candidates]
    rates = np.where(np.isnan(rates), 0, rates)
    if not any(coupled):
        return bool(np.all(np.asarray(choice.efficiency)[:, 0] * _GAIN_OF_TUNING < 1))
    return bool(np.max(rates, where=coupled, initial=0) * _GAIN_OF_TUNING > rates.max())


def _tuned_coupling(
    key: Key[Array, ""], model: Diffusion, problem: BridgeProblem, for_density: bool
) -> Coupling | None:
    """The best of a few couplings, `None` where no pilot run succeeded."""
    num_pilot = max(_TUNING_PILOT, 20 * len(problem.like))
    pilots = []
    for coupling in (Coupling(0.0), Coupling(0.5)):
        pilots += coupling_pilots(key, model, problem, coupling, num_pilot, for_density)
    if all(np.isnan(pilot.efficiency) for pilot in pilots):
        return None
    return best_pilot(pilots).coupling
