"""Choice of the fastest proposal for each interval, by pilot runs with measured run times.

`proposal="auto"` makes a similar choice in each call, but estimates run times by a rule, so that it
also works inside `jit`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Key

from ..coupling import Coupling
from ..engine.arguments import as_sequence
from ..engine.checks import Numbers, check_count, check_key, is_traced
from ..engine.entry import public_entry
from ..models.bridge_problem import BridgeProblem, bridge_problem
from ..models.diffusion import Diffusion
from ..proposals import Choice, choice_between, default_candidates, why_left_out
from .start_law import best_pilot, coupling_pilots

# Bridges per pilot run of the coupling that is then compared with other proposals.
_TUNING_PILOT = 500


# Largest gain in efficiency to expect from a fitted start law (for unlikely bridges).
_LARGEST_TUNING_GAIN = 10.0


@public_entry
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
    """Choose the proposal with the most effective samples per second for each interval.

    Pilot runs measure effective samples and seconds, without compilation. In contrast,
    `proposal="auto"` chooses in each call and estimates the seconds by a rule. Use this function
    for models whose drift or σ takes long to compute, or to choose once for many calls. Pass the
    result as `proposal=` for the same intervals.

    Call it outside `jit`. The choice between two proposals of similar speed may differ from run to
    run.

    **Arguments:**

    - `key`, `model`, `start`, `end`, `duration`, `num_steps`: as in `sample_bridges`.
    - `candidates`: proposals and couplings. The default candidates are:
        - `ModifiedDiffusionBridge()`, `Guided("end")` and `Guided("path")`;
        - `Coupling(0.0)` and `Coupling(0.5)` if the model has a time reversal;
        - a coupling with a fitted start law, for a single interval, if the pilot runs suggest that
          it may be the fastest.
    - `num_pilot`: pilot paths per candidate and interval. By default about 4,000 over all
        intervals, at least 32 and at most 512 per interval.
    - `for_density`: true if the choice is for `transition_log_density` or `pmmh`. Then the default
        couplings, which start from the stationary law, need a model that is declared `normalised`.
        Without it a coupling with a fitted start law is added, for a single interval, if all guided
        candidates are inefficient.

    **Returns:** `Choice`, which prints as a table.

    **Raises:** `ValueError` and `TypeError` for invalid arguments; `TypeError` inside `jit`.

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
            "`choose_proposal` measures run times, so it cannot run inside `jit` or `vmap`: call "
            'it before, or pass `proposal="auto"`.'
        )
    if num_pilot is not None:
        num_pilot = check_count("num_pilot", num_pilot, 2)
    left_out = ""
    if candidates is None:
        base_candidates = default_candidates(model, for_density)
        left_out = why_left_out(model, for_density)
    else:
        base_candidates = list(as_sequence("candidates", candidates, "proposals"))

    def choose_between(candidates, left_out=""):
        auto = choice_between(candidates, num_pilot=num_pilot, left_out=left_out)
        auto = auto.for_model(model, intervals.start[0], normal_steps=False)
        auto.check(model, intervals)
        if for_density:
            auto.check_for_density(model)
        return auto.choose(key, model, intervals, num_steps, timed=True)

    choice = choose_between(base_candidates, left_out)
    # A fitted start law has a normalised density of its own, so that a density needs
    # `log_stationary` only up to a constant.
    tunable = model.has_reversal and (model.has_density or not for_density)
    if candidates is None and not batched and tunable and _is_tuning_worthwhile(choice):
        tuned = _tuned_coupling(key, model, problem, for_density)
        choice = choice if tuned is None else choose_between([*base_candidates, tuned])
    return choice


def _is_tuning_worthwhile(choice: Choice) -> bool:
    """Return whether a coupling with a fitted start law may become the fastest proposal.

    The criterion is the rate of the best coupling if there is one. Otherwise it is the efficiency
    of all candidates.
    """
    rates = np.asarray(choice.efficiency / choice.seconds)[:, 0]
    coupled = [candidate.coupled for candidate in choice.candidates]
    # NaN: no pilot run, because the candidate could not be the fastest.
    rates = np.where(np.isnan(rates), 0, rates)
    if not any(coupled):
        return bool(np.all(np.asarray(choice.efficiency)[:, 0] * _LARGEST_TUNING_GAIN < 1))
    return bool(np.max(rates, where=coupled, initial=0) * _LARGEST_TUNING_GAIN > rates.max())


def _tuned_coupling(
    key: Key[Array, ""], model: Diffusion, problem: BridgeProblem, for_density: bool
) -> Coupling | None:
    """Return the best coupling of pilot runs with γ = 0 and γ = ½, each with several start laws.

    Return `None` if no pilot run succeeded.
    """
    num_pilot = max(_TUNING_PILOT, 20 * len(problem.like))
    pilots = []
    for coupling in (Coupling(0.0), Coupling(0.5)):
        pilots += coupling_pilots(key, model, problem, coupling, num_pilot, for_density)
    if all(np.isnan(pilot.efficiency) for pilot in pilots):
        return None
    return best_pilot(pilots).coupling
