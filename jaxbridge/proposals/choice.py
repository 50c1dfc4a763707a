"""A separate proposal for each interval: the result of "auto" and of `choose_proposal`.

The module has the criterion of the choice, too: effective samples per second, with penalties for
discretisation errors and for heavy tails.
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

# W, in units of a modified diffusion bridge's paths.
_WORK = 10_000
# What weights of heavy tails are worth beside others.
_HEAVY = 1e-6
# Above this share of effective paths, as foreseen for a larger sample, no tail is of account.
_NEARLY_EQUAL = 0.9
# Each candidate in use is compiled, in pilot runs and runs: one that is worth less than this share
# of the work on all intervals is left out.
_SPARED = 0.05


class Choice(AbstractWeightedProposal):
    """Chosen proposal for each interval, with the results of the pilot runs.

    `choose_proposal` returns it, and functions with `proposal="auto"` use it. It prints as a table.

    - `candidates`: tuple of C proposals.
    - `seconds`: seconds per simulated path, shape (C, I). They are estimated by a rule, relative to
        a modified diffusion bridge, or measured if a measurement could change the choice.
    - `efficiency`: effective samples per simulated path, shape (C, I), extrapolated from the pilot
        run to a larger sample. NaN without a pilot run: the candidate could not be the best, or its
        gain over all intervals would be negligible.
    - `step_error`: discretisation error of log p̂ in the pilot run, shape (C, I), reduced by twice
        its uncertainty.
    - `pareto_k`: k̂ of the weights in the pilot run, shape (C, I). NaN if there were too few paths.
    - `chosen`: index of the candidate of each interval, shape (I,).
    - `used`: indices of the candidates that are chosen for any interval; inside `jit`, of all
        candidates. Only these are compiled, so another set compiles again.
    - `left_out`: the reason why "auto" does not try couplings, empty if it does. Without a time
        reversal there are no couplings. Densities need a normalised `log_stationary`.

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
        return "a choice between " + ", ".join(each.describe() for each in self.candidates)

    def fractions(self, num_steps):
        return self.candidates[0].fractions(num_steps)

    def of(self, which):
        seconds, efficiency, step_error, shape, chosen = (
            index_without_compiling(leaf, (..., which))
            for leaf in (self.seconds, self.efficiency, self.step_error, self.pareto_k, self.chosen)
        )
        told = (seconds, efficiency, step_error, shape, chosen)
        used = self.used if is_traced(chosen) else tuple(np.unique(chosen).tolist())
        return Choice(self.candidates, *told, used, self.left_out)

    def for_model(self, model, like, for_density=False):
        candidates = tuple(
            candidate.for_model(model, like, for_density) for candidate in self.candidates
        )
        return dataclasses.replace(self, candidates=candidates)

    def check(self, model, intervals):
        for candidate in self.candidates:
            candidate.check(model, intervals)
        if self.chosen.shape != intervals.duration.shape:
            raise ValueError(
                f"this choice is one for {self.chosen.shape[0]} intervals, but there are "
                f"{len(intervals.duration)}: call `choose_proposal` with the same intervals."
            )

    def check_prepared(self, model):
        for single in self.singles:
            single.check_prepared(model)

    def prepared(self, key, model, intervals, num_steps):
        return self

    def step_share(self, model, intervals):
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
            return _draw_each((self, model, intervals), *draws)
        if self.coupled:
            fixed = nondifferentiable_choice((model, intervals))
            return _draw_each((self, *fixed), *draws)
        return _draw_pulled((self, model, intervals), *draws)

    def reweigh(self, keys, model, intervals, paths, active=None):
        def reweigh(candidate, active):
            return candidate.reweigh(keys, model, intervals, paths, active)

        return self.of_each(reweigh, active)

    def of_each(
        self,
        make: Callable[[AbstractSingleProposal, Bool[Array, " I"] | None], WeightedPaths],
        active: Bool[Array, " I"] | None,
    ) -> WeightedPaths:
        """Combine the results of `make` for the candidate of each interval."""
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

    def for_all(self):
        """Return the candidate with the least variance, Σ 1/(effective paths), at its cost."""
        rates = np.asarray(_presumed_rates(self), float)
        return self.candidates[int(np.argmin(np.sum(1 / np.maximum(rates, 1e-30), axis=1)))]

    def split(self):
        mine = [(np.flatnonzero(np.asarray(self.chosen) == i), i) for i in self.used]
        return [(which, self.candidates[i]) for which, i in mine if which.size > 0]

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
            known = ~np.isnan(efficiency[i])
            seen = 4 * ["-"]
            if known.any():
                seen = [
                    f"{np.median(efficiency[i, known]):.3g}",
                    f"{np.median(np.abs(step_error[i, known])):.3g}",
                    "-" if np.isnan(shape[i]).all() else f"{np.nanmedian(shape[i]):.2f}",
                    f"{np.median(rates[i, known] / best[known]):.2f}",
                ]
            cost = f"{np.median(seconds[i] / seconds[0]):.2f}"
            count = f"{np.sum(chosen == i)} of {len(chosen)}"
            lines.append(row.format(candidate.describe(), *seen[:3], cost, seen[3], count))
        return "\n".join([*lines, *reason])


def _draw_each(
    inputs: tuple[Choice, Diffusion, Intervals],
    keys: Key[Array, "I n"],
    num_steps: int,
    stored: Int[Array, " K"] | None,
    misses_count: bool,
    active: Bool[Array, " I"] | None,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> WeightedPaths:
    """Each interval by its candidate, which is run for no other."""
    choice, model, intervals = inputs

    def draw(candidate, active):
        arguments = (keys, model, intervals, num_steps, stored, misses_count, active)
        return candidate.draw(*arguments, progress_meter)

    return choice.of_each(draw, active)


@eqx.filter_custom_jvp
def _draw_pulled(inputs: tuple[Choice, Diffusion, Intervals], *draws) -> WeightedPaths:
    """`_draw_each` between proposals that are pulled to the end point, with derivatives."""
    return _draw_each(inputs, *draws)


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
    return drawn, WeightedPaths(paths, log_weights, *6 * [None])  # pyright: ignore


def _pick(mask: Bool[Array, " I"]) -> Callable[[Array, Array], Array]:
    return lambda new, old: jnp.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def best_at_worst(choice: Choice, num: int) -> Choice:
    """One way for each of the groups of `num` intervals that follow each other: that which is best
    where it is worst. For chains in which end points move, whose pilot runs were from several."""
    worst = jnp.min(_presumed_rates(choice).reshape(len(choice.candidates), -1, num), axis=2)
    chosen = jnp.repeat(best_of_few(worst), num)
    told = (choice.seconds, choice.efficiency, choice.step_error, choice.pareto_k)
    whole = Choice(choice.candidates, *told, chosen, choice.used, choice.left_out)
    return whole.of(np.arange(0, len(chosen), num))


def worth_a_pilot(potential: Float[Array, " I"], best: Float[Array, " I"]) -> Bool[Array, " I"]:
    """On which intervals to try what could at most have this rate; on none where that would hardly
    gain anything over all of them."""
    gain = _loss(best, jnp.maximum(best, potential))
    return (potential > best) & (gain > 1 + _SPARED)


def best_of_few(rates: Float[Array, "C I"]) -> Int[Array, " I"]:
    """The best candidate of each interval, among as few as hardly lose anything together: one after
    the other is left out that the others replace best, of equals the last."""
    rates = jnp.where(jnp.isnan(rates), 0, rates)
    best, num = jnp.max(rates, axis=0), len(rates)

    def loss(kept: Bool[Array, " C"]) -> Float[Array, ""]:
        return _loss(jnp.max(jnp.where(kept[:, None], rates, 0), axis=0), best)

    def leave_out(_, kept: Bool[Array, " C"]) -> Bool[Array, " C"]:
        without = kept & ~jnp.eye(num, dtype=bool)
        losses = jnp.where(kept, jax.vmap(loss)(without), jnp.inf)
        least = num - 1 - jnp.argmin(losses[::-1])
        return jnp.where(losses[least] <= 1 + _SPARED, without[least], kept)

    kept = lax.fori_loop(0, num - 1, leave_out, jnp.ones(num, bool))
    return jnp.argmax(jnp.where(kept[:, None], rates, -1), axis=0).astype(jnp.int32)


def _loss(rates: Float[Array, " I"], best: Float[Array, " I"]) -> Float[Array, ""]:
    """How many times as much work these rates take as the best: on an interval, in the mean; or on
    all together, where hard ones count for more."""
    some, rates = best > 0, jnp.maximum(rates, _least(rates))
    each = jnp.mean(jnp.where(some, best / rates, 1))
    work = jnp.sum(jnp.where(some, 1 / rates, 0))
    least = jnp.sum(jnp.where(some, 1 / jnp.where(some, best, 1), 0))
    return jnp.maximum(each, work / jnp.where(least > 0, least, 1))


def _presumed_rates(choice: Choice) -> Float[Array, "C I"]:
    """Those of pilot runs; where a candidate had none no more than the best that had, and nothing
    of a candidate that had none at all."""
    rates = value_rates(choice.efficiency, choice.seconds, choice.step_error, choice.pareto_k)
    known = ~jnp.isnan(rates)
    bounds = jnp.array([each.efficiency_bound for each in choice.candidates], rates.dtype)
    best = jnp.max(jnp.where(known, rates, 0), axis=0)
    tried = jnp.any(known, axis=1, keepdims=True)
    presumed = jnp.where(tried, jnp.minimum(bounds[:, None] / choice.seconds, best), 0)
    return jnp.where(known, rates, presumed)


def _least(rates: Float[Array, " I"]) -> float:
    return float(jnp.finfo(rates.dtype).tiny)


@jax.jit  # one program where it is called outside of any
def value_rates(
    efficiency: Float[Array, "*C I"],
    seconds: Float[Array, "*C I"],
    step_error: Float[Array, "*C I"],
    shape: Float[Array, "*C I"],
) -> Float[Array, "*C I"]:
    """Effective samples per second after the deductions for step errors and heavy tails. (Of
    weights that are nearly equal k̂ of a small pilot run is a matter of chance.)"""
    cheapest = jnp.min(seconds, axis=0) if seconds.ndim == 2 else 1.0
    rate = efficiency / seconds
    rate /= 1 + _WORK * cheapest * rate * step_error**2
    light = is_reliable(shape) | jnp.isnan(shape) | (efficiency > _NEARLY_EQUAL)
    return rate * jnp.where(light, 1, _HEAVY)
