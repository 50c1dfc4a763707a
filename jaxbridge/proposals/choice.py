"""Which proposal for which interval? The one with the least error for a second of work.

On short intervals proposals that are pulled to the end point are nearly exact, and coupled
pairs do not meet; on long ones it is the other way round. Where the one becomes better than
the other depends on the model, the end points and the step, so a pilot run decides, interval
by interval: each candidate draws a few weighted paths, and

    rate = effective samples / (simulated paths × seconds per path)

is compared, as it would be in a larger sample, after two deductions. Candidates have different
targets, at so many steps, and so different step errors (`step_error`). More paths do not reduce
them: with W seconds the mean square error of log p̂ is about 1 / (W rate) + (step error)², which is
that of a rate of

    rate / (1 + W rate (step error)²),

with W the seconds of ten thousand of the cheapest paths, and the step error as far as it is seen
beyond two of its own standard errors. And weights with a Pareto shape above 0.7 come last.

A candidate makes no pilot run where it could not win: of a coupling's simulated paths at most one
in 1 + N is an effective sample, for each proposal needs N hitting counts. Seconds go by a rule, so
that one key gives one choice; or by the clock, where `choose_proposal` makes the choice.

The pilot's paths are not used again, so weights stay what they are whatever is chosen; but a pilot
of finite size can be deceived, by a second way to the end point that it never saw for instance.
"""

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ..coupling.base import AbstractCoupling
from ..coupling.gamma import Coupling
from ..coupling.hitting import check_max_trials
from ..coupling.start_laws import Stationary
from ..engine.averages import effective_size, normalised
from ..engine.checks import check_bound, check_count, is_traced, nondifferentiable_choice
from ..engine.keys import key_for
from ..engine.pareto import is_reliable, pareto_k
from ..models.diffusion import Diffusion
from ..models.intervals import Intervals
from ..schemes.step_density import EulerDensity, ItoTaylorDensity
from ..schemes.step_error import of_log_mean
from .base import AbstractWeightedProposal, WeightedPaths
from .coupled import CoupledPairs
from .linear_guide import Guided
from .modified_bridge import ModifiedDiffusionBridge

# Bounds the tries for one bridge, unless the user says otherwise.
_MAX_PROPOSALS = 10_000
# A pilot run draws about so many paths of each candidate in all, and so many of each interval.
_PILOT_PATHS = 4_096
_PILOT_RANGE = (32, 512)
# Hits that take longer than this are not worth waiting for.
_PILOT_TRIALS = 64
# Seconds per simulated path beside those of a modified diffusion bridge, as measured for models
# whose functions cost little beside the random numbers.
_GUIDED_SECONDS, _COUPLED_SECONDS = 1.3, 3.5
# W, in units of a modified diffusion bridge's paths.
_WORK = 10_000
# What weights of heavy tails are worth beside others.
_HEAVY = 1e-6
# The rule may be wrong by this factor.
_CONTENDS = 3.0


class Choice(AbstractWeightedProposal):
    """A proposal for each interval, and why: what `proposal="auto"` comes to, and what
    `choose_proposal` returns. Printed, it is a table.

    - `candidates`: C proposals.
    - `seconds`: per simulated path, shape (C, I): by rule relative to those of a modified
        diffusion bridge, or measured where that could change the choice.
    - `efficiency`: effective samples per simulated path in the pilot run, extrapolated to
        a larger one, shape (C, I); NaN where none was needed because the candidate could not win.
    - `step_error`: of log p̂, as far as it was seen, and `pareto_k`, k̂ of the weights, both in the
        pilot run and of shape (C, I).
    - `chosen`: the number of each interval's candidate, shape (I,).
    - `num_pilot`: pilot paths of each candidate for each interval, or `None` for the default.
    - `used`: the numbers of those that were chosen for any interval; inside `jit`, where that is
        not known, of all. Only they are compiled, so that another set compiles again.
    - `left_out`: why "auto" does not try couplings, empty where it does: for a density the constant
        of `log_stationary` must be known, and without a time reversal there are none.

    Where all that are used are pulled to the end point, paths and weights are differentiable,
    forward and reverse, each interval by its own proposal. Others have no derivatives.
    """

    candidates: tuple[AbstractWeightedProposal, ...]
    seconds: Float[Array, "C I"] | None
    efficiency: Float[Array, "C I"] | None
    step_error: Float[Array, "C I"] | None
    pareto_k: Float[Array, "C I"] | None
    chosen: Int[Array, " I"] | None
    num_pilot: int | None = eqx.field(static=True)
    used: tuple[int, ...] = eqx.field(static=True)
    left_out: str = eqx.field(static=True, default="")

    def of(self, which: Int[np.ndarray, " J"]) -> "Choice":
        """The choice for some of the intervals."""
        made = (self.seconds, self.efficiency, self.step_error, self.pareto_k, self.chosen)
        seconds, efficiency, step_error, shape, chosen = (
            None if leaf is None else leaf[..., which] for leaf in made
        )
        told = (seconds, efficiency, step_error, shape, chosen)
        return Choice(self.candidates, *told, self.num_pilot, self.used, self.left_out)

    def check(self, model, intervals):
        for candidate in self.candidates:
            candidate.check(model, intervals)
        if self.chosen is not None and self.chosen.shape != intervals.duration.shape:
            raise ValueError(
                f"this choice is one for {self.chosen.shape[0]} intervals, but there are "
                f"{len(intervals.duration)}: use `choose_proposal` with the same intervals."
            )

    def check_prepared(self, model):
        if self.chosen is None:
            raise ValueError(
                'a kernel makes no pilot run, so `proposal="auto"` has nothing to go by: choose '
                "with `choose_proposal` before, and pass what it returns."
            )
        for candidate in singles(self):
            candidate.check_prepared(model)

    def prepared(self, key, model, intervals, num_steps):
        if self.chosen is not None:
            return self
        model, intervals = _for_pilots(self, model, intervals)
        return run_pilots(key, model, self, intervals, num_steps, timed=False)

    def fractions(self, num_steps):
        return self.candidates[0].fractions(num_steps)

    def step_share(self, model, intervals):
        assert self.chosen is not None
        shares = jnp.stack([each.step_share(model, intervals) for each in self.candidates])
        return jnp.take_along_axis(shares, self.chosen[None], axis=0)[0]

    def draw(
        self,
        keys,
        model,
        intervals,
        num_steps,
        stored,
        misses_count,
        active=None,
        progress_meter=None,
    ):
        draws = (keys, num_steps, stored, misses_count, active, progress_meter)
        if len(self.used) == 1:
            return _draw_each(self, model, intervals, *draws)
        if uses_couplings(self):
            model, intervals = nondifferentiable_choice((model, intervals))
            return _draw_each(self, model, intervals, *draws)
        return _draw_pulled((self, model, intervals), *draws)

    def reweigh(self, keys, model, intervals, paths, active=None):
        def reweigh(candidate, active):
            return candidate.reweigh(keys, model, intervals, paths, active)

        return self._of_each(reweigh, active)

    def _of_each(
        self,
        make: Callable[[AbstractWeightedProposal, Bool[Array, " I"] | None], WeightedPaths],
        active: Bool[Array, " I"] | None,
    ) -> WeightedPaths:
        """What each interval's candidate makes."""
        if len(self.used) == 1:
            return make(self.candidates[self.used[0]], active)
        made = None
        for i in self.used:
            mine = self.chosen == i
            mine = mine if active is None else mine & active
            part = make(self.candidates[i], mine)
            made = part if made is None else jax.tree.map(_pick(mine), part, made)
        assert made is not None
        return made

    def __str__(self) -> str:
        made = self.chosen is not None and not is_traced(self.chosen, self.efficiency, self.seconds)
        reason = [f"couplings left out: {self.left_out}"] if self.left_out else []
        if not made:
            names = ", ".join(describe(candidate) for candidate in self.candidates)
            return "\n".join([f"a choice to be made between {names}", *reason])
        assert self.efficiency is not None and self.seconds is not None
        assert self.step_error is not None and self.pareto_k is not None
        chosen, efficiency = np.asarray(self.chosen), np.asarray(self.efficiency, float)
        seconds, step_error = np.asarray(self.seconds, float), np.asarray(self.step_error, float)
        shape = np.asarray(self.pareto_k, float)
        rates = _rates(self.efficiency, self.seconds, self.step_error, self.pareto_k)
        rates = np.asarray(rates, float)
        best = np.maximum(np.nanmax(rates, axis=0), np.finfo(float).tiny)
        head = ("", "effective per path", "step error", "k", "cost of a path", "value")
        row = "{:<44}  {:>18}  {:>10}  {:>5}  {:>14}  {:>6}  {}"
        lines = [row.format(*head, "chosen for")]
        for i, candidate in enumerate(self.candidates):
            known = ~np.isnan(efficiency[i])
            seen = 4 * ["-"]
            if known.any():
                seen = [
                    f"{np.median(efficiency[i, known]):.3g}",
                    f"{np.median(np.abs(step_error[i, known])):.3g}",
                    f"{np.median(shape[i, known]):.2f}",
                    f"{np.median(rates[i, known] / best[known]):.2f}",
                ]
            cost = f"{np.median(seconds[i] / seconds[0]):.2f}"
            count = f"{np.sum(chosen == i)} of {len(chosen)}"
            lines.append(row.format(describe(candidate), *seen[:3], cost, seen[3], count))
        return "\n".join([*lines, *reason])


def _draw_each(
    choice: Choice,
    model: Diffusion,
    intervals: Intervals,
    keys: Key[Array, "I n"],
    num_steps: int,
    stored: Int[Array, " K"] | None,
    misses_count: bool,
    active: Bool[Array, " I"] | None,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> WeightedPaths:
    """Each interval by its candidate, which is run for no other."""

    def draw(candidate, active):
        arguments = (keys, model, intervals, num_steps, stored, misses_count, active)
        return candidate.draw(*arguments, progress_meter)

    return choice._of_each(draw, active)


@eqx.filter_custom_jvp
def _draw_pulled(inputs: tuple[Choice, Diffusion, Intervals], *draws) -> WeightedPaths:
    """`_draw_each` between proposals that are pulled to the end point, with derivatives."""
    return _draw_each(*inputs, *draws)


@_draw_pulled.def_jvp
def _draw_pulled_tangents(primals, tangents):
    """Running a candidate for a few intervals only takes a loop of unknown length, which has no
    reverse mode, so derivatives run each for all. In the place of an interval that is another's
    stands one of its own: a masked 0 · ∞ from where a proposal does not serve would be NaN."""
    inputs, keys, num_steps, stored, misses_count, active, _ = primals
    drawn = _draw_pulled(*primals)

    def again(inputs):
        choice, model, intervals = inputs
        total = None
        for i in choice.used:
            mine = choice.chosen == i
            mine = mine if active is None else mine & active
            stand_in = jnp.where(mine, jnp.arange(len(mine)), jnp.argmax(mine))
            each = jax.tree.map(lambda leaf, at=stand_in: leaf[at], intervals)
            arguments = (keys[stand_in], model, each, num_steps, stored, misses_count)
            made = choice.candidates[i].draw(*arguments)
            masked = [
                jnp.where(mine.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, 0)
                for leaf in (made.paths, made.log_weights)
            ]
            total = masked if total is None else [a + b for a, b in zip(total, masked, strict=True)]
        assert total is not None
        return tuple(total)

    _, (paths, log_weights) = eqx.filter_jvp(again, (inputs,), (tangents[0],))
    return drawn, WeightedPaths(paths, log_weights, *5 * [None])  # pyright: ignore


def _for_pilots(
    undecided: Choice, model: Diffusion, intervals: Intervals
) -> tuple[Diffusion, Intervals]:
    """What pilot runs see: numbers only. What is chosen has no derivative in them, but that of
    which it is chosen may have one, unless it may be a coupling."""
    if uses_couplings(undecided):
        return nondifferentiable_choice((model, intervals))
    return jax.tree.map(
        lambda leaf: lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf,
        (model, intervals),
    )


def _pick(mask: Bool[Array, " I"]) -> Callable[[Array, Array], Array]:
    return lambda new, old: jnp.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def describe(proposal: AbstractWeightedProposal) -> str:
    """The proposal in a few words."""
    if isinstance(proposal, Guided):
        return f"Guided({proposal.linearisation})"
    if not isinstance(proposal, CoupledPairs):
        return type(proposal).__name__
    coupling, words = proposal.coupling, type(proposal.coupling).__name__
    if isinstance(coupling, Coupling) and not is_traced(coupling.gamma):
        words += f"({float(coupling.gamma):.3g})"
    if not isinstance(coupling.start_law, Stationary):
        words += f" from {type(coupling.start_law).__name__}"
    return words


def most_efficient(proposal: AbstractWeightedProposal) -> float:
    """A bound on effective samples per simulated path."""
    return 1 / (1 + proposal.num_counts) if isinstance(proposal, CoupledPairs) else 1.0


class _Seen(NamedTuple):
    """What a pilot run shows: the first three as the fields of a `Choice`, and the paths that were
    simulated."""

    efficiency: Float[Array, " I"]
    step_error: Float[Array, " I"]
    pareto_k: Float[Array, " I"]
    num_simulated: Int[Array, " I"]


def _rates(
    efficiency: Float[Array, "*C I"],
    seconds: Float[Array, "*C I"],
    step_error: Float[Array, "*C I"],
    shape: Float[Array, "*C I"],
) -> Float[Array, "*C I"]:
    """Effective samples per second after the deductions for step errors and heavy tails."""
    cheapest = jnp.min(seconds, axis=0) if seconds.ndim == 2 else 1.0
    rate = efficiency / seconds
    rate /= 1 + _WORK * cheapest * rate * step_error**2
    return rate * jnp.where(is_reliable(shape) | jnp.isnan(shape), 1, _HEAVY)


@eqx.filter_jit
def _pilot(
    key: Key[Array, ""],
    model: Diffusion,
    candidate: AbstractWeightedProposal,
    intervals: Intervals,
    active: Bool[Array, " I"],
    num_steps: int,
    num_pilot: int,
) -> _Seen:
    """What a pilot run shows of each active interval, NaN of the others."""
    if isinstance(candidate, CoupledPairs):
        bound = jnp.minimum(candidate.max_trials, _PILOT_TRIALS * candidate.num_counts)
        candidate = eqx.tree_at(lambda c: c.max_trials, candidate, bound)
    keys = jax.random.split(key, (len(intervals.duration), num_pilot))
    nothing = jnp.zeros(0, jnp.int32)  # no path is kept
    model = model.prepared()
    drawn = candidate.draw(keys, model, intervals, num_steps, nothing, True, active)
    num_simulated = jnp.sum(drawn.num_simulated, axis=1, dtype=jnp.int32)
    # What takes too long to hit would have a weight beyond those that are seen.
    size = _extrapolated_size(jnp.where(drawn.truncated, -jnp.inf, drawn.log_weights))
    efficiency = size / jnp.maximum(num_simulated, 1).astype(size.dtype)
    share = candidate.step_share(model, intervals)
    error = of_log_mean(drawn.log_weights, drawn.log_halving, share)
    seen_error = jnp.maximum(jnp.abs(error.value) - 2 * error.uncertainty, 0)
    seen_error = jnp.where(jnp.isnan(seen_error), 0, seen_error)  # nothing is known of one step
    told = (efficiency, seen_error, pareto_k(drawn.log_weights))
    efficiency, seen_error, shape = (jnp.where(active, value, jnp.nan) for value in told)
    return _Seen(efficiency, seen_error, shape, num_simulated)


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


def as_proposal(
    proposal: Any,
    model: Diffusion,
    like: Float[Array, " d"],
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    for_density: bool = False,
) -> AbstractWeightedProposal:
    """What the user gave as `proposal`, as a weighted proposal, for points like this one;
    `for_density` if the size of its weights matters, and not only their proportion."""
    proposal = Coupling() if proposal is None else proposal
    bounds = (num_counts, max_proposals, max_trials)
    if isinstance(proposal, str) and proposal == "auto":
        candidates = default_candidates(model, like, for_density)
        left_out = why_left_out(model, for_density)
        return undecided_between(candidates, model, like, None, *bounds, left_out=left_out)
    if isinstance(proposal, AbstractWeightedProposal):
        if bounds != (None, None, None):
            raise ValueError(
                "`num_counts`, `max_proposals` and `max_trials` are for a `Coupling`; this "
                "`proposal` has its own, or none."
            )
        return proposal
    if not isinstance(proposal, AbstractCoupling):
        raise TypeError(
            "`proposal` must be a `Coupling`, `ModifiedDiffusionBridge()`, `ResidualBridge()`, "
            f'`Guided()`, what `choose_proposal` returns, or "auto"; got {proposal!r}.'
        )
    num_counts = 1 if num_counts is None else check_count("num_counts", num_counts)
    return CoupledPairs(
        proposal,
        check_bound("max_proposals", max_proposals, _MAX_PROPOSALS),
        check_max_trials(max_trials, num_counts),
        num_counts,
    )


def singles(proposal: AbstractWeightedProposal) -> tuple[AbstractWeightedProposal, ...]:
    """The candidates of a choice that may be used, or the proposal itself."""
    if not isinstance(proposal, Choice):
        return (proposal,)
    return tuple(proposal.candidates[i] for i in proposal.used)


def uses_couplings(proposal: AbstractWeightedProposal) -> bool:
    """Whether any interval may have a coupling."""
    return any(isinstance(single, CoupledPairs) for single in singles(proposal))


def guided_candidates(model: Diffusion, like: Float[Array, " d"]) -> list[AbstractWeightedProposal]:
    """With the same order of step error as couplings, where that is to be had."""
    density = EulerDensity() if model.forward(like).sigma_varies else ItoTaylorDensity()
    guided = [Guided(along, density) for along in ("end", "path")]
    return [ModifiedDiffusionBridge(density), *guided]


def default_candidates(
    model: Diffusion, like: Float[Array, " d"], for_density: bool = False
) -> list[Any]:
    """Couplings only where the time reversal is known; and for a density, where ν is."""
    coupled = model.has_reversal and (model.normalised or not for_density)
    couplings = [Coupling(0.0), Coupling(0.5)] if coupled else []
    return [*guided_candidates(model, like), *couplings]


def why_left_out(model: Diffusion, for_density: bool) -> str:
    """Why there are no couplings among `default_candidates`; empty where there are."""
    if not model.has_reversal:
        return (
            "the time reversal of the model is not known (give `Diffusion` a `log_stationary`, a "
            "`reverse_drift` or `reversible=True`)"
        )
    if for_density and not model.normalised:
        return (
            "their densities rest on `log_stationary`, which is not declared to be normalised "
            "(`Diffusion(..., normalised=True)`)"
        )
    return ""


def undecided_between(
    candidates: Sequence[Any],
    model: Diffusion,
    like: Float[Array, " d"],
    num_pilot: int | None,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    left_out: str = "",
) -> Choice:
    """A choice between these, not yet made."""
    if len(candidates) == 0:
        raise ValueError("`candidates` must have at least one proposal.")
    proposals = []
    for candidate in candidates:
        coupled = isinstance(candidate, AbstractCoupling)
        bounds = (num_counts, max_proposals, max_trials) if coupled else (None, None, None)
        proposals.append(as_proposal(candidate, model, like, *bounds))
    if any(isinstance(proposal, Choice) for proposal in proposals):
        raise ValueError("`candidates` must be single proposals, not choices.")
    grids = {tuple(proposal.fractions(8)) for proposal in proposals}
    if len(grids) > 1:
        raise ValueError("`candidates` must be on one grid: give all the same `refinement`.")
    everything = tuple(range(len(proposals)))
    return Choice(tuple(proposals), None, None, None, None, None, num_pilot, everything, left_out)


def run_pilots(
    key: Key[Array, ""],
    model: Diffusion,
    undecided: Choice,
    intervals: Intervals,
    num_steps: int,
    timed: bool,
) -> Choice:
    """The choice, from pilot runs of the candidates that could win."""
    num_intervals, num_pilot = len(intervals.duration), undecided.num_pilot
    if num_pilot is None:
        num_pilot = np.clip(_PILOT_PATHS // num_intervals, *_PILOT_RANGE).item()
    dtype = intervals.start.dtype
    best = jnp.zeros(num_intervals, dtype)
    candidates, pilots = [], []
    for i, candidate in enumerate(undecided.candidates):

        def look_at(candidate, best=best):
            seconds = _relative_seconds(candidate, model, intervals)
            active = best < most_efficient(candidate) / seconds
            return seconds, active, is_traced(active) or bool(np.any(active))

        seconds, active, called_for = look_at(candidate)
        if called_for:
            candidate = candidate.prepared(key, model, intervals, num_steps)
            seconds, active, called_for = look_at(candidate)
        run, nothing = None, jnp.full(num_intervals, jnp.nan, dtype)
        seen = _Seen(nothing, nothing, nothing, jnp.zeros(num_intervals, jnp.int32))
        if called_for:
            arguments = (model, candidate, intervals, active, num_steps, num_pilot)
            run = functools.partial(_pilot, key_for(f"pilot {i}", key), *arguments)
            seen = run()
        candidates.append(candidate)
        pilots.append(_Pilot(run, seen, seconds))
        best = jnp.fmax(best, pilots[-1].rate)
    each = _measured(pilots, best) if timed else [pilot.seconds for pilot in pilots]
    seconds, seen = (
        jnp.stack(each),
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *(pilot.seen for pilot in pilots)),
    )
    told = (seen.efficiency, seen.step_error, seen.pareto_k)
    rates = _rates(told[0], seconds, *told[1:])
    rates = jnp.where(jnp.isnan(rates), -1, rates)
    chosen = jnp.argmax(rates, axis=0).astype(jnp.int32)
    used = range(len(candidates)) if is_traced(chosen) else np.unique(chosen).tolist()
    made = (seconds, *told, chosen)
    return Choice(tuple(candidates), *made, num_pilot, tuple(used), undecided.left_out)


class _Pilot(NamedTuple):
    """A pilot run, if there was one, what it gave, and the seconds per path that it should
    take."""

    run: Callable[[], Any] | None
    seen: _Seen
    seconds: Float[Array, " I"]

    @property
    def rate(self) -> Float[Array, " I"]:
        return _rates(self.seen.efficiency, self.seconds, self.seen.step_error, self.seen.pareto_k)


def _measured(pilots: list[_Pilot], best: Float[Array, " I"]) -> list[Float[Array, " I"]]:
    """Seconds per path by the clock, where that could change the choice; else by rule."""

    def contends(pilot: _Pilot) -> bool:
        return pilot.run is not None and bool(np.any(pilot.rate * _CONTENDS > best))

    contenders = [pilot for pilot in pilots if contends(pilot)]
    if len(contenders) < 2:
        return [pilot.seconds for pilot in pilots]
    factors = {}
    for pilot in contenders:
        assert pilot.run is not None
        took = min(_seconds_of(pilot.run) for _ in range(3))
        expected = pilot.seconds * pilot.seen.num_simulated.astype(pilot.seconds.dtype)
        factors[id(pilot)] = took / float(jnp.sum(expected))
    others = float(np.median(list(factors.values())))
    return [pilot.seconds * factors.get(id(pilot), others) for pilot in pilots]


def _seconds_of(run: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - begin


def _relative_seconds(
    candidate: AbstractWeightedProposal, model: Diffusion, intervals: Intervals
) -> Float[Array, " I"]:
    """Seconds per simulated path, by rule."""
    ones = jnp.ones_like(intervals.duration)
    if isinstance(candidate, ModifiedDiffusionBridge):
        return ones
    if not isinstance(candidate, CoupledPairs):
        return _GUIDED_SECONDS * ones
    law, seconds = candidate.coupling.start_law, _COUPLED_SECONDS * ones
    if isinstance(law, Stationary) and not model.has_sampler and law.burn_in is not None:
        # A run for the start of each trial, in steps that cost half as much; and of the
        # simulated paths at least half are trials.
        seconds *= 1 + law.burn_in.astype(ones.dtype) / intervals.duration / 4
    return seconds


def settled(
    proposal: AbstractWeightedProposal,
    key: Key[Array, ""],
    model: Diffusion,
    intervals: Intervals,
    num_steps: int,
) -> AbstractWeightedProposal:
    """A choice made before compiling, where that can be, so that only what was chosen is
    compiled."""
    if not isinstance(proposal, Choice) or proposal.chosen is not None:
        return proposal
    if not uses_couplings(proposal):
        model, intervals = _for_pilots(proposal, model, intervals)  # may be known under `grad`
    if not is_traced(key, model, proposal, intervals):
        return run_pilots(key, model, proposal, intervals, num_steps, timed=False)
    return proposal
