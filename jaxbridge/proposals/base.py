"""Weighted proposals: a bridge proposal is a path with an unbiased weight,

    E[w h(path)] = p_T(a, b) E_bridge[h].

Chains, importance means and transition densities are written on this alone. A coupling gives
random weights (`coupled`), proposals that are pulled to the end point weights that are functions of
the path (`guided`), and each interval may have its own (`auto`).
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ..coupling.base import AbstractCoupling
from ..engine.devices import over_devices, share
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from ..schemes.step_density import AbstractStepDensity


class WeightedPaths(NamedTuple):
    """n weighted paths of each of I intervals.

    `log_weights` are -inf and `paths` NaN where none was `found`; `truncated` says where a
    weight is not exact because a bound on the work was reached; `num_simulated` counts the
    simulated paths, and `num_nonfinite` those that left the finite numbers. `log_halving` is D of
    `halving`, NaN where none was worked out.
    """

    paths: Float[Array, "I n K d"]
    log_weights: Float[Array, "I n"]
    found: Bool[Array, "I n"]
    truncated: Bool[Array, "I n"]
    num_simulated: Int[Array, "I n"]
    num_nonfinite: Int[Array, "I n"]
    log_halving: Float[Array, "I n"]


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
    def most_accurate(self, sigma_varies: bool) -> "AbstractSingleProposal":
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


Block = Callable[[Key[Array, "I n"], Intervals, Bool[Array, " I"] | None], WeightedPaths]


def block_over_devices(function: Block) -> Block:
    """`function` with its draws split over devices: interval by interval, which each then has its
    own work done on one device only, or across all of them where that balances better."""

    def split(keys, intervals, active):
        num_intervals, num_draws = keys.shape
        if share(num_intervals) * num_draws <= num_intervals * share(num_draws):
            return over_devices(function, (0, 0, 0))(keys, intervals, active)
        return over_devices(function, (1, None, None), out_axis=1)(keys, intervals, active)

    return split


def in_blocks(
    function: Block,
    keys: Key[Array, "I n"],
    intervals: Intervals,
    most_rows: int,
    active: Bool[Array, " I"] | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> WeightedPaths:
    """`function`, row by row of its arguments, on blocks of at most `most_rows` rows.

    Active intervals come first, and blocks without any are not run.
    """
    num_intervals, num_draws = keys.shape
    unit = _VECTOR if num_draws >= _WORTH_FILLING else 1
    columns = _even_blocks(num_draws, most_rows, unit)
    unit = _VECTOR // math.gcd(columns.shape[1], _VECTOR)
    unit = unit if num_intervals * num_draws >= _WORTH_FILLING * unit else 1
    rows = _even_blocks(num_intervals, most_rows // columns.shape[1], unit)
    if rows.shape == (1, num_intervals) and columns.shape == (1, num_draws) and active is None:
        return function(keys, intervals, active)
    order = jnp.arange(num_intervals)
    num_active = jnp.int32(num_intervals)
    if active is not None:
        order = jnp.argsort(~active, stable=True)
        num_active = jnp.sum(active, dtype=jnp.int32)

    def one_block(row, column):
        chosen = order[rows[row]]
        block_keys = keys[chosen[:, None], columns[column][None]]
        block = jax.tree.map(lambda leaf: leaf[chosen], intervals)
        return function(block_keys, block, None if active is None else active[chosen])

    num_rows, num_columns = rows.shape[0], columns.shape[0]
    steps = jnp.arange(num_rows * num_columns)
    meter = diffrax.NoProgressMeter() if progress_meter is None else progress_meter

    def step(state, i):
        made = one_block(i // num_columns, i % num_columns)
        progress = (i + 1).astype(jnp.float32) / len(steps)
        return meter.step(state, progress), made

    if active is None:
        state, made = lax.scan(step, meter.init(), steps)
    else:
        shapes = eqx.filter_eval_shape(one_block, 0, 0)
        nothing = jax.tree.map(
            lambda leaf: jnp.zeros((len(steps), *leaf.shape), leaf.dtype), shapes
        )

        def going_on(carry):
            i, _, _ = carry
            return (i < len(steps)) & (rows[i // num_columns, 0] < num_active)

        def next_step(carry):
            i, state, made = carry
            state, block = step(state, i)
            return i + 1, state, jax.tree.map(lambda all, one: all.at[i].set(one), made, block)

        _, state, made = lax.while_loop(going_on, next_step, (0, meter.init(), nothing))
    meter.close(state)

    def join(leaf):
        leaf = leaf.reshape(num_rows, num_columns, *leaf.shape[1:])
        leaf = jnp.moveaxis(leaf, 1, 2).reshape(rows.size, columns.size, *leaf.shape[4:])
        leaf = leaf[:num_intervals, :num_draws]
        return leaf if active is None else leaf[jnp.argsort(order)]

    made = jax.tree.map(join, made)
    return made if active is None else masked(made, active)


def masked(made: WeightedPaths, active: Bool[Array, " I"]) -> WeightedPaths:
    """Nothing for the intervals that are not active."""

    def keep(leaf, otherwise):
        mask = active.reshape(-1, *[1] * (leaf.ndim - 1))
        return jnp.where(mask, leaf, otherwise)

    return WeightedPaths(
        keep(made.paths, jnp.nan),
        keep(made.log_weights, -jnp.inf),
        keep(made.found, False),
        keep(made.truncated, False),
        keep(made.num_simulated, 0),
        keep(made.num_nonfinite, 0),
        keep(made.log_halving, jnp.nan),
    )


# XLA's loops on CPU may be twice as fast where lanes fill whole vectors, of so many numbers. Few
# lanes are not worth a copy.
_VECTOR, _WORTH_FILLING = 16, 256


def _even_blocks(size: int, most: int, unit: int = 1) -> Int[Array, "blocks length"]:
    """0, ..., size - 1 in blocks of one length, a multiple of `unit`, the last of them repeated to
    fill up."""
    num_blocks = -(-size // max(most, 1))
    length = -(-size // num_blocks)
    length = -(-length // unit) * unit
    return jnp.minimum(jnp.arange(num_blocks * length), size - 1).reshape(num_blocks, length)
