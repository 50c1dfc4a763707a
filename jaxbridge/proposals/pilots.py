"""Comparison of candidate proposals by pilot runs.

Each candidate draws a few weighted paths of each interval. The criterion is

    rate = effective samples / (simulated paths × seconds per path),

where the effective samples are extrapolated to a larger sample. It has two corrections.

*Discretisation error.* Candidates have different targets and so different discretisation errors
(`step_error`), which more paths do not reduce. With W seconds the mean square error of log p̂ is
about 1 / (W rate) + (step error)². This equals the error of a rate of

    rate / (1 + W rate (step error)²).

W is the time of ten thousand paths of the cheapest candidate. The step error counts only as far as
it exceeds two of its standard errors.

*Heavy tails.* Weights with a Pareto k̂ above 0.7 rank last, if there are enough weights for an
estimate of k̂ and they are not nearly equal.

Some candidates need no pilot run on an interval:

- a candidate that cannot be the best. For a coupling at most one in 1 + N simulated paths is an
  effective sample, because each proposal needs N hitting counts, of at least one trial each;
- a candidate whose gain over all intervals is negligible: each candidate in use has to be compiled.

If no candidate has five effective paths with light tails, the pilot runs of couplings are repeated
up to 16 times. (Inside `jit` they are not repeated, because the results are not yet available.)

Seconds are estimated by a rule, so that a key determines the choice. Only `choose_proposal`
measures them.
"""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.averages import effective_size, normalise_weights
from ..engine.checks import is_traced
from ..engine.compiled import compiled_sooner
from ..engine.keys import key_for
from ..engine.pareto import largest_reliable_k, pareto_k
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from ..schemes import guessed
from .base import AbstractSingleProposal
from .choice import Choice, best_of_few, value_rates, worth_a_pilot

# Paths of a candidate's pilot run: in all, and the range per interval.
_PILOT_PATHS = 4_096
_PILOT_RANGE = (32, 512)
# With fewer paths k̂ is mostly noise: among many intervals some would seem to have heavy tails.
_FEWEST_FOR_TAIL = 128
# With fewer effective paths a rate is mostly noise. Then the pilot run of a coupling is repeated,
# at most this number of times.
_FEWEST_EFFECTIVE, _MOST_REPEATS = 5, 16
# The rule for seconds may be wrong by this factor. Only candidates that are within it of the best
# rate are timed.
_RULE_ACCURACY = 3.0


class _PilotResult(NamedTuple):
    """Results of a pilot run, for each interval.

    - `efficiency`, `step_error`, `pareto_k`: as in `Choice`; NaN for inactive intervals.
    - `num_simulated`: number of simulated paths.
    - `log_sum`, `log_squares`: logs of the sums of the weights and of their squares.
    """

    efficiency: Float[Array, " I"]
    step_error: Float[Array, " I"]
    pareto_k: Float[Array, " I"]
    num_simulated: Int[Array, " I"]
    log_sum: Float[Array, " I"]
    log_squares: Float[Array, " I"]


def _rate(result: _PilotResult, seconds: Float[Array, "..."]) -> Float[Array, "..."]:
    return value_rates(result.efficiency, seconds, result.step_error, result.pareto_k)


class _Pilot(NamedTuple):
    """Candidate with its pilot run.

    - `candidate`: the candidate, prepared if at least one interval needs a pilot run.
    - `run`: function of a key and a mask of intervals that runs the pilot; `None` if no interval
        needs it.
    - `seen`: results of the pilot run; NaN without one.
    - `active`: mask of the intervals of the pilot run.
    - `seconds`: seconds per path by the rule.
    """

    candidate: AbstractSingleProposal
    run: Callable[[Key[Array, ""], Bool[Array, " I"]], _PilotResult] | None
    seen: _PilotResult
    active: Bool[Array, " I"]
    seconds: Float[Array, " I"]


def run_pilots(
    key: Key[Array, ""],
    model: Diffusion,
    candidates: tuple[AbstractSingleProposal, ...],
    intervals: Intervals,
    num_steps: int,
    num_pilot: int | None,
    timed: bool,
) -> Choice:
    """Return the choice, from pilot runs of the candidates that could be the best.

    `num_pilot` is the number of paths per interval. By default it is about 4,000 divided by the
    number of intervals, between 32 and 512. `timed` states that seconds are measured where this
    could change the choice.
    """
    num_intervals = len(intervals.duration)
    default_num = int(np.clip(_PILOT_PATHS // num_intervals, *_PILOT_RANGE))
    num_paths = default_num if num_pilot is None else num_pilot
    # A candidate has pilot runs only where it could exceed the best of the candidates before it.
    best = jnp.asarray(np.zeros(num_intervals, intervals.start.dtype))
    pilots = []
    for i, candidate in enumerate(candidates):
        purpose = f"pilot {i}"
        pilots.append(
            _run_pilot(key, purpose, model, candidate, intervals, num_steps, num_paths, best)
        )
        best = _update_best(best, pilots[-1].seen, pilots[-1].seconds)
    seconds = _measure_seconds(key, pilots, best) if timed else [pilot.seconds for pilot in pilots]
    if not is_traced(best):
        pilots = _repeat_poor(key, pilots)
    results, seconds, chosen = _compare([pilot.seen for pilot in pilots], seconds)
    used = range(len(candidates)) if is_traced(chosen) else np.unique(chosen).tolist()
    return Choice(
        tuple(pilot.candidate for pilot in pilots),
        seconds,
        results.efficiency,
        results.step_error,
        results.pareto_k,
        chosen,
        tuple(used),
    )


@compiled_sooner
def _update_best(best: Float[Array, " I"], result: _PilotResult, seconds: Float[Array, " I"]):
    """Return the best rate of each interval, updated by the results of one more candidate."""
    return jnp.fmax(best, _rate(result, seconds))


@compiled_sooner
def _compare(results: list[_PilotResult], seconds: list[Float[Array, " I"]]):
    """Return results and seconds of all candidates, stacked, and the best one of each interval."""
    stacked: _PilotResult = jax.tree.map(lambda *leaves: jnp.stack(leaves), *results)
    all_seconds = jnp.stack(seconds)
    return stacked, all_seconds, best_of_few(_rate(stacked, all_seconds))


def _run_pilot(
    key: Key[Array, ""],
    purpose: str,
    model: Diffusion,
    candidate: AbstractSingleProposal,
    intervals: Intervals,
    num_steps: int,
    num_pilot: int,
    best: Float[Array, " I"],
) -> _Pilot:
    """Run the pilot of one candidate on the intervals where its rate could exceed `best`."""

    def estimate_need(candidate):
        seconds, active = _worth(candidate, model, intervals, best)
        return seconds, active, is_traced(active) or bool(np.any(np.asarray(active)))

    seconds, active, is_needed = estimate_need(candidate)
    if is_needed:
        # The preparation may change the seconds: with a burn-in each trial takes longer.
        candidate = candidate.prepared(key, model, intervals, num_steps)
        seconds, active, is_needed = estimate_need(candidate)
    if not is_needed:
        nans: Any = np.full(len(best), np.nan, best.dtype)
        zeros: Any = np.zeros(len(best), np.int32)
        result = _PilotResult(nans, nans, nans, zeros, nans, nans)
        return _Pilot(candidate, None, result, active, seconds)
    arguments = (purpose, model, candidate, intervals, num_steps, num_pilot)
    run = functools.partial(_draw_pilot, *arguments)
    return _Pilot(candidate, run, run(key, active), active, seconds)


def _repeat_poor(key: Key[Array, ""], pilots: list[_Pilot]) -> list[_Pilot]:
    """Return the pilots, with repeated runs of couplings that had few effective paths.

    Runs are repeated on the intervals where no candidate has enough effective paths with light
    tails.
    """
    sizes = [_size(pilot.seen.efficiency, pilot.seen.num_simulated) for pilot in pilots]
    shapes = [np.asarray(pilot.seen.pareto_k) for pilot in pilots]
    # NaN counts as a light tail: there were too few paths for k̂.
    light = [~(shape >= largest_reliable_k(10**9)) for shape in shapes]
    best = np.max([np.where(ok, size, 0) for size, ok in zip(sizes, light, strict=True)], axis=0)
    poor = best < _FEWEST_EFFECTIVE
    return [
        _repeat(key, pilot, np.asarray(pilot.active) & poor & (size < _FEWEST_EFFECTIVE))
        for pilot, size in zip(pilots, sizes, strict=True)
    ]


def _repeat(key: Key[Array, ""], pilot: _Pilot, active: Bool[np.ndarray, " I"]) -> _Pilot:
    """Repeat the pilot run of a coupling; return the pilot with the efficiency of all its runs.

    Intervals with too few effective paths after the last run keep their results. Other proposals
    are returned unchanged.
    """
    if pilot.run is None or pilot.candidate.by_coupling is None:
        return pilot
    efficiency, step_error, shape, count, log_sum, log_squares = map(np.array, pilot.seen)
    for number in range(1, _MOST_REPEATS + 1):
        if not active.any():
            break
        result = pilot.run(jax.random.fold_in(key, number), jnp.asarray(active))
        _, error, _, more, more_sum, more_squares = map(np.asarray, result)
        log_sum[active] = np.logaddexp(log_sum, more_sum)[active]
        log_squares[active] = np.logaddexp(log_squares, more_squares)[active]
        count[active] += more[active]
        # (Σ w)² / Σ w², zero if all weights are zero.
        is_hit = log_sum > -np.inf
        size = np.exp(2 * np.where(is_hit, log_sum, 0) - np.where(is_hit, log_squares, np.inf))
        is_enough = active & (size >= _FEWEST_EFFECTIVE)
        efficiency[is_enough] = (size / np.maximum(count, 1))[is_enough]
        shape[is_enough], step_error[is_enough] = np.nan, error[is_enough]
        # Runs continue up to twice the minimum, where the estimate is more reliable.
        active = active & (size < 2 * _FEWEST_EFFECTIVE)
    values = {"efficiency": efficiency, "step_error": step_error, "pareto_k": shape}
    values = {name: jnp.asarray(value, efficiency.dtype) for name, value in values.items()}
    # `num_simulated` remains that of the first run, because only that run is timed.
    return pilot._replace(seen=pilot.seen._replace(**values))


def _size(efficiency: Float[Array, " I"], num_simulated: Int[Array, " I"]) -> Float[Any, " I"]:
    """Return the number of effective paths of a pilot run, zero for intervals without one."""
    return np.nan_to_num(np.asarray(efficiency, float)) * np.asarray(num_simulated, float)


@compiled_sooner
def _worth(
    candidate: AbstractSingleProposal,
    model: Diffusion,
    intervals: Intervals,
    best: Float[Array, " I"],
) -> tuple[Float[Array, " I"], Bool[Array, " I"]]:
    """Return the seconds per path, and the mask of the intervals that need a pilot run."""
    seconds = candidate.relative_seconds(model, intervals)
    return seconds, worth_a_pilot(candidate.efficiency_bound / seconds, best)


@compiled_sooner
def _draw_pilot(
    purpose: str,
    model: Diffusion,
    candidate: AbstractSingleProposal,
    intervals: Intervals,
    num_steps: int,
    num_pilot: int,
    key: Key[Array, ""],
    active: Bool[Array, " I"],
) -> _PilotResult:
    """Draw paths and return the results for active intervals, NaN for the others."""
    candidate = candidate.for_pilot()
    keys = jax.random.split(key_for(purpose, key), (len(intervals.duration), num_pilot))
    no_points = jnp.zeros(0, jnp.int32)  # paths are not stored
    model = model.prepared()
    paths = candidate.draw(keys, model, intervals, num_steps, no_points, True, active)
    num_simulated = jnp.sum(paths.num_simulated, axis=1, dtype=jnp.int32)
    # The true weight of a truncated path exceeds the others. It is unknown, so it is omitted.
    log_weights = jnp.where(paths.truncated, -jnp.inf, paths.log_weights)
    size = _extrapolated_size(log_weights)
    efficiency = size / jnp.maximum(num_simulated, 1).astype(size.dtype)
    share = guessed(candidate.step_share(model, intervals))
    varies = model.sigma_varies(intervals.start[0])
    error = paths.step_error(share, num_steps, varies)
    error_size = jnp.maximum(jnp.abs(error.value) - 2 * error.uncertainty, 0)
    error_size = jnp.where(jnp.isnan(error_size), 0, error_size)  # unknown for N = 1
    shape = jnp.full_like(efficiency, jnp.nan)
    if num_pilot >= _FEWEST_FOR_TAIL:
        shape = pareto_k(paths.log_weights)
    values = (efficiency, error_size, shape)
    efficiency, error_size, shape = (jnp.where(active, leaf, jnp.nan) for leaf in values)
    sums = (logsumexp(power * log_weights, axis=1) for power in (1, 2))
    return _PilotResult(efficiency, error_size, shape, num_simulated, *sums)


def _extrapolated_size(log_weights: Float[Array, "I n"]) -> Float[Array, " I"]:
    """Return n times the effective share that a sample of 64 n paths would have, by extrapolation.

    With heavy-tailed weights the effective share falls about as a power of the sample size, because
    small samples lack the largest weights. The power is estimated from the effective shares of
    eighths of the sample and of the complete sample.
    """
    num_intervals, n = log_weights.shape
    eighth = max(n // 8, 1)
    share = effective_size(normalise_weights(log_weights)) / n
    parts = log_weights[:, : n // eighth * eighth].reshape(num_intervals, -1, eighth)
    share_of_part = jnp.mean(effective_size(normalise_weights(parts)), axis=1) / eighth
    fall = jnp.minimum(share / jnp.where(share_of_part > 0, share_of_part, 1), 1)
    return n * share * fall**2  # 64 = 8²: two more factors of eight


def _measure_seconds(
    key: Key[Array, ""], pilots: list[_Pilot], best: Float[Array, " I"]
) -> list[Float[Array, " I"]]:
    """Return the seconds per path of each candidate, measured where this could change the choice.

    If fewer than two candidates could be the best, nothing is timed and the rule is returned. Other
    candidates have the seconds of the rule times the median ratio of measurement and rule.
    """

    def contends(pilot: _Pilot) -> bool:
        rate = _rate(pilot.seen, pilot.seconds)
        return pilot.run is not None and bool(np.any(rate * _RULE_ACCURACY > best))

    contenders = [pilot for pilot in pilots if contends(pilot)]
    if len(contenders) < 2:
        return [pilot.seconds for pilot in pilots]
    factors = {}
    for pilot in contenders:
        assert pilot.run is not None
        run = functools.partial(pilot.run, key, pilot.active)
        measured = min(_seconds_of(run) for _ in range(3))
        expected = pilot.seconds * pilot.seen.num_simulated.astype(pilot.seconds.dtype)
        # Seconds per unit of the rule, which is a path of a modified diffusion bridge.
        factors[id(pilot)] = measured / float(jnp.sum(expected))
    typical = float(np.median(list(factors.values())))
    return [pilot.seconds * factors.get(id(pilot), typical) for pilot in pilots]


def _seconds_of(run: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - begin
