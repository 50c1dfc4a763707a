"""Comparison of candidate proposals by pilot runs.

Each candidate draws a few weighted paths of each interval. The criterion is

    rate = effective samples / (simulated paths × seconds per path),

extrapolated to a larger sample, with two corrections.

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
  effective sample, because each proposal needs N hitting counts;
- a candidate with a negligible gain over all intervals, because each candidate in use has to be
  compiled.

If no candidate has five effective paths with light tails, pilot runs of couplings whose pairs
rarely met are repeated up to 16 times. (Inside `jit` they are not repeated, because the results are
not yet available.)

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

from ..engine.averages import effective_size, normalised
from ..engine.checks import is_traced
from ..engine.compiled import compiled_sooner
from ..engine.keys import key_for
from ..engine.pareto import most_reliable, pareto_k
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from ..schemes import guessed
from .base import AbstractSingleProposal
from .choice import Choice, best_of_few, value_rates, worth_a_pilot

# A pilot run draws about so many paths of each candidate in all, and so many of each interval.
_PILOT_PATHS = 4_096
_PILOT_RANGE = (32, 512)
# Of fewer paths k̂ is a matter of chance: of many intervals some would seem to have heavy tails.
_FEWEST_FOR_TAIL = 128
# With fewer effective paths a rate is a matter of chance, and a coupling's pilot run is repeated
# up to so often.
_FEWEST_EFFECTIVE, _MOST_REPEATS = 5, 16
# The rule for seconds may be wrong by this factor.
_CONTENDS = 3.0


class _Seen(NamedTuple):
    """What a pilot run shows: the first three as the fields of a `Choice`, the paths that were
    simulated, and the logs of the sums of weights and of their squares."""

    efficiency: Float[Array, " I"]
    step_error: Float[Array, " I"]
    pareto_k: Float[Array, " I"]
    num_simulated: Int[Array, " I"]
    log_sum: Float[Array, " I"]
    log_squares: Float[Array, " I"]


def _rate(seen: _Seen, seconds: Float[Array, "..."]) -> Float[Array, "..."]:
    return value_rates(seen.efficiency, seconds, seen.step_error, seen.pareto_k)


class _Pilot(NamedTuple):
    """A candidate, prepared; its pilot run with a key on active intervals, if there was one, and
    what that gave; and the seconds per path that it should take."""

    candidate: AbstractSingleProposal
    run: Callable[[Key[Array, ""], Bool[Array, " I"]], _Seen] | None
    seen: _Seen
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
    """The choice, from pilot runs of the candidates that could win."""
    num_intervals = len(intervals.duration)
    enough = int(np.clip(_PILOT_PATHS // num_intervals, *_PILOT_RANGE))
    num_paths = enough if num_pilot is None else num_pilot
    best = jnp.asarray(np.zeros(num_intervals, intervals.start.dtype))
    pilots = []
    for i, candidate in enumerate(candidates):
        purpose = f"pilot {i}"
        pilots.append(
            _run_pilot(key, purpose, model, candidate, intervals, num_steps, num_paths, best)
        )
        best = _better(best, pilots[-1].seen, pilots[-1].seconds)
    seconds = _measured(key, pilots, best) if timed else [pilot.seconds for pilot in pilots]
    if not is_traced(best):
        pilots = _repeated(key, pilots)
    seen, seconds, chosen = _compared([pilot.seen for pilot in pilots], seconds)
    used = range(len(candidates)) if is_traced(chosen) else np.unique(chosen).tolist()
    return Choice(
        tuple(pilot.candidate for pilot in pilots),
        seconds,
        seen.efficiency,
        seen.step_error,
        seen.pareto_k,
        chosen,
        tuple(used),
    )


@compiled_sooner
def _better(best: Float[Array, " I"], seen: _Seen, seconds: Float[Array, " I"]):
    """The best rate of each interval so far."""
    return jnp.fmax(best, _rate(seen, seconds))


@compiled_sooner
def _compared(seen: list[_Seen], seconds: list[Float[Array, " I"]]):
    """What was seen of all candidates, their seconds, and which is best in each interval."""
    stacked: _Seen = jax.tree.map(lambda *leaves: jnp.stack(leaves), *seen)
    of_all = jnp.stack(seconds)
    return stacked, of_all, best_of_few(_rate(stacked, of_all))


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
    """The pilot run of one candidate, on the intervals where it could beat the best so far."""

    def look_at(candidate):
        seconds, active = _worth(candidate, model, intervals, best)
        return seconds, active, is_traced(active) or bool(np.any(np.asarray(active)))

    seconds, active, called_for = look_at(candidate)
    if called_for:
        candidate = candidate.prepared(key, model, intervals, num_steps)
        seconds, active, called_for = look_at(candidate)
    if not called_for:
        nothing: Any = np.full(len(best), np.nan, best.dtype)
        none: Any = np.zeros(len(best), np.int32)
        seen = _Seen(nothing, nothing, nothing, none, nothing, nothing)
        return _Pilot(candidate, None, seen, active, seconds)
    arguments = (purpose, model, candidate, intervals, num_steps, num_pilot)
    run = functools.partial(_look, *arguments)
    return _Pilot(candidate, run, run(key, active), active, seconds)


def _repeated(key: Key[Array, ""], pilots: list[_Pilot]) -> list[_Pilot]:
    """Return the pilots, with what repeated runs show of couplings that hardly met in theirs, on
    the intervals where no candidate has enough effective paths of light tails."""
    sizes = [_size(pilot.seen.efficiency, pilot.seen.num_simulated) for pilot in pilots]
    shapes = [np.asarray(pilot.seen.pareto_k) for pilot in pilots]
    light = [~(shape >= most_reliable(10**9)) for shape in shapes]  # NaN is of too few to tell
    best = np.max([np.where(ok, size, 0) for size, ok in zip(sizes, light, strict=True)], axis=0)
    poor = best < _FEWEST_EFFECTIVE
    return [
        _repeat(key, pilot, np.asarray(pilot.active) & poor & (size < _FEWEST_EFFECTIVE))
        for pilot, size in zip(pilots, sizes, strict=True)
    ]


def _repeat(key: Key[Array, ""], pilot: _Pilot, active: Bool[np.ndarray, " I"]) -> _Pilot:
    """Return the pilot of a coupling, with the efficiency of all its runs where that is known."""
    if pilot.run is None or pilot.candidate.by_coupling is None:
        return pilot
    efficiency, step_error, shape, count, log_sum, log_squares = map(np.array, pilot.seen)
    for number in range(1, _MOST_REPEATS + 1):
        if not active.any():
            break
        seen = pilot.run(jax.random.fold_in(key, number), jnp.asarray(active))
        _, error, _, more, more_sum, more_squares = map(np.asarray, seen)
        log_sum[active] = np.logaddexp(log_sum, more_sum)[active]
        log_squares[active] = np.logaddexp(log_squares, more_squares)[active]
        count[active] += more[active]
        some = log_sum > -np.inf
        size = np.exp(2 * np.where(some, log_sum, 0) - np.where(some, log_squares, np.inf))
        found = active & (size >= _FEWEST_EFFECTIVE)
        efficiency[found] = (size / np.maximum(count, 1))[found]
        shape[found], step_error[found] = np.nan, error[found]
        active = active & (size < 2 * _FEWEST_EFFECTIVE)
    values = {"efficiency": efficiency, "step_error": step_error, "pareto_k": shape}
    values = {name: jnp.asarray(value, efficiency.dtype) for name, value in values.items()}
    # The paths of the first run go with its seconds.
    return pilot._replace(seen=pilot.seen._replace(**values))


def _size(efficiency: Float[Array, " I"], num_simulated: Int[Array, " I"]) -> Float[Any, " I"]:
    """Return the effective paths of a pilot run, zero where there was none."""
    return np.nan_to_num(np.asarray(efficiency, float)) * np.asarray(num_simulated, float)


@compiled_sooner
def _worth(
    candidate: AbstractSingleProposal,
    model: Diffusion,
    intervals: Intervals,
    best: Float[Array, " I"],
) -> tuple[Float[Array, " I"], Bool[Array, " I"]]:
    """Seconds per path, and on which intervals to try it."""
    seconds = candidate.relative_seconds(model, intervals)
    return seconds, worth_a_pilot(candidate.efficiency_bound / seconds, best)


@compiled_sooner
def _look(
    purpose: str,
    model: Diffusion,
    candidate: AbstractSingleProposal,
    intervals: Intervals,
    num_steps: int,
    num_pilot: int,
    key: Key[Array, ""],
    active: Bool[Array, " I"],
) -> _Seen:
    """What a pilot run shows of each active interval, NaN of the others."""
    candidate = candidate.for_pilot()
    keys = jax.random.split(key_for(purpose, key), (len(intervals.duration), num_pilot))
    nothing = jnp.zeros(0, jnp.int32)  # no path is kept
    model = model.prepared()
    drawn = candidate.draw(keys, model, intervals, num_steps, nothing, True, active)
    num_simulated = jnp.sum(drawn.num_simulated, axis=1, dtype=jnp.int32)
    # What takes too long to hit would have a weight beyond those that are seen.
    log_weights = jnp.where(drawn.truncated, -jnp.inf, drawn.log_weights)
    size = _extrapolated_size(log_weights)
    efficiency = size / jnp.maximum(num_simulated, 1).astype(size.dtype)
    share = guessed(candidate.step_share(model, intervals))
    varies = model.sigma_varies(intervals.start[0])
    error = drawn.step_error(share, num_steps, varies)
    seen_error = jnp.maximum(jnp.abs(error.value) - 2 * error.uncertainty, 0)
    seen_error = jnp.where(jnp.isnan(seen_error), 0, seen_error)  # nothing is known of one step
    shape = jnp.full_like(efficiency, jnp.nan)
    if num_pilot >= _FEWEST_FOR_TAIL:
        shape = pareto_k(drawn.log_weights)
    told = (efficiency, seen_error, shape)
    efficiency, seen_error, shape = (jnp.where(active, value, jnp.nan) for value in told)
    sums = (logsumexp(power * log_weights, axis=1) for power in (1, 2))
    return _Seen(efficiency, seen_error, shape, num_simulated, *sums)


def _extrapolated_size(log_weights: Float[Array, "I n"]) -> Float[Array, " I"]:
    """Effective samples of n paths, as they would be in a sample 64 times as large.

    Where weights have heavy tails the effective share falls with the sample, about as a power
    of its size, since the largest weights are yet to come: a small sample looks too good. The
    power is seen between eighths of the sample and the whole.
    """
    num_intervals, n = log_weights.shape
    eighth = max(n // 8, 1)
    share = effective_size(normalised(log_weights)) / n
    parts = log_weights[:, : n // eighth * eighth].reshape(num_intervals, -1, eighth)
    share_of_part = jnp.mean(effective_size(normalised(parts)), axis=1) / eighth
    fall = jnp.minimum(share / jnp.where(share_of_part > 0, share_of_part, 1), 1)
    return n * share * fall**2


def _measured(
    key: Key[Array, ""], pilots: list[_Pilot], best: Float[Array, " I"]
) -> list[Float[Array, " I"]]:
    """Seconds per path by the clock, where that could change the choice; else by rule."""

    def contends(pilot: _Pilot) -> bool:
        rate = _rate(pilot.seen, pilot.seconds)
        return pilot.run is not None and bool(np.any(rate * _CONTENDS > best))

    contenders = [pilot for pilot in pilots if contends(pilot)]
    if len(contenders) < 2:
        return [pilot.seconds for pilot in pilots]
    factors = {}
    for pilot in contenders:
        assert pilot.run is not None
        run = functools.partial(pilot.run, key, pilot.active)
        took = min(_seconds_of(run) for _ in range(3))
        expected = pilot.seconds * pilot.seen.num_simulated.astype(pilot.seconds.dtype)
        factors[id(pilot)] = took / float(jnp.sum(expected))
    others = float(np.median(list(factors.values())))
    return [pilot.seconds * factors.get(id(pilot), others) for pilot in pilots]


def _seconds_of(run: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - begin
