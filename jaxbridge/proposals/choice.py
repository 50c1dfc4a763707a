"""A separate proposal for each interval: the result of "auto" and of `choose_proposal`.

The module also defines the criterion of the choice: effective samples per second, reduced for
discretisation errors and for heavy tails (`pilots` explains the formulas).
"""

import dataclasses
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.checks import index_without_compiling, is_traced, nondifferentiable_choice
from ..engine.pareto import is_reliable
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from .base import AbstractSingleProposal, AbstractWeightedProposal, WeightedPaths

# W of `pilots`, in paths of the cheapest candidate.
_WORK = 10_000
# Factor on the rate of heavy-tailed weights: they rank last, but remain ordered among themselves.
_HEAVY_TAIL_FACTOR = 1e-6
# Above this extrapolated share of effective paths the weights are nearly equal. Then their tail
# does not matter, and k̂ of a small pilot run is mostly noise.
_NEARLY_EQUAL = 0.9
# Each candidate in use costs a compilation, in pilot runs and in runs. A candidate is omitted if
# this increases the total work by at most this share.
_TOLERATED_LOSS = 0.05


class Choice(AbstractWeightedProposal):
    """Chosen proposal for each interval, with the results of the pilot runs.

    `choose_proposal` returns it, and functions with `proposal="auto"` use it. It prints as a table.

    - `candidates`: tuple of C proposals.
    - `seconds`: seconds per simulated path, shape (C, I). `choose_proposal` measures them if this
        could change the choice. Otherwise they follow a rule, in units of the seconds of a modified
        diffusion bridge.
    - `efficiency`: effective samples per simulated path, shape (C, I), extrapolated from the pilot
        run to a larger sample. NaN without a pilot run: the candidate could not be the best, or its
        gain over all intervals would be negligible.
    - `step_error`: size of the discretisation error of log p̂ in the pilot run, minus twice its
        uncertainty, and at least zero; shape (C, I).
    - `pareto_k`: k̂ of the weights in the pilot run, shape (C, I). NaN if there were too few paths.
    - `chosen`: index of the candidate of each interval, shape (I,).
    - `used`: indices of the candidates that are chosen for at least one interval; inside `jit`, of
        all candidates. Only these are compiled, so another set compiles again.
    - `left_out`: the reason why "auto" does not try couplings, empty if it does. Couplings need a
        time reversal, and for densities a normalised `log_stationary`.

    If all used candidates are guided proposals, paths and weights are differentiable, in forward
    and reverse mode. Couplings have no derivatives.
    """

    candidates: tuple[AbstractSingleProposal, ...]
    seconds: Float[Array, "C I"]
    efficiency: Float[Array, "C I"]
    step_error: Float[Array, "C I"]
    pareto_k: Float[Array, "C I"]
    chosen: Int[Array, " I"]
    used: tuple[int, ...] = eqx.field(static=True)
    left_out: str = eqx.field(static=True, default="")

    @property
    def singles(self):
        return tuple(self.candidates[i] for i in self.used)

    @property
    def is_open(self):
        return False

    @property
    def by_coupling(self):
        return None

    def describe(self):
        return "a choice between " + ", ".join(
            candidate.describe() for candidate in self.candidates
        )

    def fractions(self, num_steps):
        return self.candidates[0].fractions(num_steps)

    def of(self, which):
        seconds, efficiency, step_error, shape, chosen = (
            index_without_compiling(leaf, (..., which))
            for leaf in (self.seconds, self.efficiency, self.step_error, self.pareto_k, self.chosen)
        )
        results = (seconds, efficiency, step_error, shape, chosen)
        used = self.used if is_traced(chosen) else tuple(np.unique(chosen).tolist())
        return Choice(self.candidates, *results, used, self.left_out)

    def for_model(self, model, like, normal_steps=True):
        candidates = tuple(
            candidate.for_model(model, like, normal_steps) for candidate in self.candidates
        )
        return dataclasses.replace(self, candidates=candidates)

    def check(self, model, intervals):
        for candidate in self.candidates:
            candidate.check(model, intervals)
        if self.chosen.shape != intervals.duration.shape:
            raise ValueError(
                f"this result of `choose_proposal` is for {self.chosen.shape[0]} intervals, but "
                f"the problem has {len(intervals.duration)}: call `choose_proposal` with the same "
                "intervals."
            )

    def check_prepared(self, model):
        for single in self.singles:
            single.check_prepared(model)

    def prepared(self, key, model, intervals, num_steps):
        return self

    def step_share(self, model, intervals):
        shares = jnp.stack(
            [candidate.step_share(model, intervals) for candidate in self.candidates]
        )
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
            return _draw_by_candidate((self, model, intervals), *draws)
        if self.coupled:
            fixed = nondifferentiable_choice((model, intervals))
            return _draw_by_candidate((self, *fixed), *draws)
        return _draw_guided((self, model, intervals), *draws)

    def reweigh(self, keys, model, intervals, paths, active=None):
        def reweigh(candidate, active):
            return candidate.reweigh(keys, model, intervals, paths, active)

        return self.by_candidate(reweigh, active)

    def by_candidate(
        self,
        evaluate: Callable[[AbstractSingleProposal, Bool[Array, " I"] | None], WeightedPaths],
        active: Bool[Array, " I"] | None,
    ) -> WeightedPaths:
        """Return the results of `evaluate` for the candidate of each interval, as one batch."""
        if len(self.used) == 1:
            return evaluate(self.candidates[self.used[0]], active)
        paths = None
        for i in self.used:
            mask = self.chosen == i
            mask = mask if active is None else mask & active
            part = evaluate(self.candidates[i], mask)
            paths = part if paths is None else _join(mask, part, paths)
        assert paths is not None
        return paths

    def for_all(self):
        """Return the candidate with the least variance for equal work, summed over intervals.

        The variance of an interval is 1 / (effective samples per second).
        """
        rates = np.asarray(_presumed_rates(self), float)
        return self.candidates[int(np.argmin(np.sum(1 / np.maximum(rates, 1e-30), axis=1)))]

    def split(self):
        members = [(np.flatnonzero(np.asarray(self.chosen) == i), i) for i in self.used]
        return [(which, self.candidates[i]) for which, i in members if which.size > 0]

    def __str__(self) -> str:
        reason = [f"couplings left out: {self.left_out}"] if self.left_out else []
        if is_traced(self.chosen, self.efficiency, self.seconds):
            return "\n".join([self.describe(), *reason])
        chosen, efficiency = np.asarray(self.chosen), np.asarray(self.efficiency, float)
        seconds, step_error = np.asarray(self.seconds, float), np.asarray(self.step_error, float)
        shape = np.asarray(self.pareto_k, float)
        rates = value_rates(self.efficiency, self.seconds, self.step_error, self.pareto_k)
        rates = np.asarray(rates, float)
        best = np.maximum(np.nanmax(rates, axis=0), np.finfo(float).tiny)
        head = ("", "effective per path", "step error", "k", "cost of a path", "value")
        row = "{:<44}  {:>18}  {:>10}  {:>5}  {:>14}  {:>6}  {}"
        lines = [row.format(*head, "chosen for")]
        for i, candidate in enumerate(self.candidates):
            piloted = ~np.isnan(efficiency[i])
            cells = 4 * ["-"]
            if piloted.any():
                cells = [
                    f"{np.median(efficiency[i, piloted]):.3g}",
                    f"{np.median(np.abs(step_error[i, piloted])):.3g}",
                    "-" if np.isnan(shape[i]).all() else f"{np.nanmedian(shape[i]):.2f}",
                    f"{np.median(rates[i, piloted] / best[piloted]):.2f}",
                ]
            cost = f"{np.median(seconds[i] / seconds[0]):.2f}"
            count = f"{np.sum(chosen == i)} of {len(chosen)}"
            lines.append(row.format(candidate.describe(), *cells[:3], cost, cells[3], count))
        return "\n".join([*lines, *reason])


def _draw_by_candidate(
    inputs: tuple[Choice, Diffusion, Intervals],
    keys: Key[Array, "I n"],
    num_steps: int,
    stored: Int[Array, " K"] | None,
    misses_count: bool,
    active: Bool[Array, " I"] | None,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> WeightedPaths:
    """Draw the paths of each interval by its candidate; candidates skip other intervals."""
    choice, model, intervals = inputs

    def draw(candidate, active):
        arguments = (keys, model, intervals, num_steps, stored, misses_count, active)
        return candidate.draw(*arguments, progress_meter)

    return choice.by_candidate(draw, active)


@eqx.filter_custom_jvp
def _draw_guided(inputs: tuple[Choice, Diffusion, Intervals], *draws) -> WeightedPaths:
    """Draw like `_draw_by_candidate`, for guided proposals only, with derivatives."""
    return _draw_by_candidate(inputs, *draws)


@_draw_guided.def_jvp
def _draw_guided_tangents(primals, tangents):
    """Return paths and log weights with their tangents, in a form that has a reverse mode.

    Drawing on selected intervals needs a loop of unknown length, which has no reverse mode. Hence
    derivatives run each candidate on all intervals and mask the results.
    """
    inputs, keys, num_steps, stored, misses_count, active, _ = primals
    primal_out = _draw_guided(*primals)

    def redraw(inputs):
        choice, model, intervals = inputs
        total = None
        for i in choice.used:
            mask = choice.chosen == i
            mask = mask if active is None else mask & active
            # Intervals of other candidates are replaced by one of this candidate. Elsewhere its
            # results may be infinite, and a masked 0 · ∞ would make the derivative NaN.
            stand_in = jnp.where(mask, jnp.arange(len(mask)), jnp.argmax(mask))
            block = jax.tree.map(lambda leaf, at=stand_in: leaf[at], intervals)
            arguments = (keys[stand_in], model, block, num_steps, stored, misses_count)
            weighted = choice.candidates[i].draw(*arguments)
            parts = [
                jnp.where(mask.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, 0)
                for leaf in (weighted.paths, weighted.log_weights)
            ]
            total = parts if total is None else [a + b for a, b in zip(total, parts, strict=True)]
        assert total is not None
        return tuple(total)

    _, (paths, log_weights) = eqx.filter_jvp(redraw, (inputs,), (tangents[0],))
    return primal_out, WeightedPaths(paths, log_weights, *7 * [None])  # pyright: ignore


def _join(mask: Bool[Array, " I"], new: WeightedPaths, old: WeightedPaths) -> WeightedPaths:
    """Return the new paths where `mask` is true, else the old ones."""

    def select(new, old):
        return jnp.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    if new.coarse_paths is not None or old.coarse_paths is not None:
        new, old = (
            part._replace(coarse_paths=part.paths) if part.coarse_paths is None else part
            for part in (new, old)
        )
    return jax.tree.map(select, new, old)


def best_at_worst(choice: Choice, num: int) -> Choice:
    """Choose one candidate for each group of `num` successive intervals, by its worst rate in it.

    Chains with moving end points use it: a group consists of one interval with several pairs of end
    points, each with pilot runs. The result has one interval per group.
    """
    worst = jnp.min(_presumed_rates(choice).reshape(len(choice.candidates), -1, num), axis=2)
    chosen = jnp.repeat(best_of_few(worst), num)
    results = (choice.seconds, choice.efficiency, choice.step_error, choice.pareto_k)
    repeated = Choice(choice.candidates, *results, chosen, choice.used, choice.left_out)
    return repeated.of(np.arange(0, len(chosen), num))


def worth_a_pilot(potential: Float[Array, " I"], best: Float[Array, " I"]) -> Bool[Array, " I"]:
    """Return the mask of the intervals on which a candidate needs a pilot run.

    `potential` are the highest possible rates of the candidate, `best` the best rates so far. No
    interval needs a run if the candidate cannot reduce the work by more than a small share.
    """
    gain = _loss(best, jnp.maximum(best, potential))
    return (potential > best) & (gain > 1 + _TOLERATED_LOSS)


def best_of_few(rates: Float[Array, "C I"]) -> Int[Array, " I"]:
    """Return the best candidate of each interval, from a small set of candidates.

    The set begins as that of all candidates. As long as the loss remains tolerable, the candidate
    whose removal costs least is removed; of several such candidates, the last one.
    """
    rates = jnp.where(jnp.isnan(rates), 0, rates)
    best, num = jnp.max(rates, axis=0), len(rates)

    def loss(remaining: Bool[Array, " C"]) -> Float[Array, ""]:
        return _loss(jnp.max(jnp.where(remaining[:, None], rates, 0), axis=0), best)

    def leave_out(_, remaining: Bool[Array, " C"]) -> Bool[Array, " C"]:
        without = remaining & ~jnp.eye(num, dtype=bool)
        losses = jnp.where(remaining, jax.vmap(loss)(without), jnp.inf)
        cheapest = num - 1 - jnp.argmin(losses[::-1])
        return jnp.where(losses[cheapest] <= 1 + _TOLERATED_LOSS, without[cheapest], remaining)

    remaining = lax.fori_loop(0, num - 1, leave_out, jnp.ones(num, bool))
    return jnp.argmax(jnp.where(remaining[:, None], rates, -1), axis=0).astype(jnp.int32)


def _loss(rates: Float[Array, " I"], best: Float[Array, " I"]) -> Float[Array, ""]:
    """Return the work at these rates relative to that at the best rates, at least 1.

    It is the larger of two values: the mean of the ratios over intervals, and the ratio of the sums
    over intervals. Difficult intervals dominate the sums.
    """
    attainable, rates = best > 0, jnp.maximum(rates, _least(rates))
    mean_ratio = jnp.mean(jnp.where(attainable, best / rates, 1))
    work = jnp.sum(jnp.where(attainable, 1 / rates, 0))
    least = jnp.sum(jnp.where(attainable, 1 / jnp.where(attainable, best, 1), 0))
    return jnp.maximum(mean_ratio, work / jnp.where(least > 0, least, 1))


def _presumed_rates(choice: Choice) -> Float[Array, "C I"]:
    """Return the rates of pilot runs, with presumed rates of intervals without a pilot run.

    A candidate without a pilot run on an interval has the rate of its efficiency bound there, but
    at most the best measured rate. A candidate without any pilot run has rate zero.
    """
    rates = value_rates(choice.efficiency, choice.seconds, choice.step_error, choice.pareto_k)
    measured = ~jnp.isnan(rates)
    bounds = jnp.array([candidate.efficiency_bound for candidate in choice.candidates], rates.dtype)
    best = jnp.max(jnp.where(measured, rates, 0), axis=0)
    has_pilot = jnp.any(measured, axis=1, keepdims=True)
    presumed = jnp.where(has_pilot, jnp.minimum(bounds[:, None] / choice.seconds, best), 0)
    return jnp.where(measured, rates, presumed)


def _least(rates: Float[Array, " I"]) -> float:
    return float(jnp.finfo(rates.dtype).tiny)


@jax.jit  # outside of `jit` this is one program instead of one per operation
def value_rates(
    efficiency: Float[Array, "*C I"],
    seconds: Float[Array, "*C I"],
    step_error: Float[Array, "*C I"],
    shape: Float[Array, "*C I"],
) -> Float[Array, "*C I"]:
    """Return effective samples per second, reduced for discretisation errors and heavy tails.

    The formula is in the docstring of `pilots`. `shape` is k̂.
    """
    cheapest = jnp.min(seconds, axis=0) if seconds.ndim == 2 else 1.0
    rate = efficiency / seconds
    # W is `_WORK * cheapest` seconds.
    rate /= 1 + _WORK * cheapest * rate * step_error**2
    light = is_reliable(shape) | jnp.isnan(shape) | (efficiency > _NEARLY_EQUAL)
    return rate * jnp.where(light, 1, _HEAVY_TAIL_FACTOR)
