"""Weighted proposals: a bridge proposal is a path with an unbiased weight,

    E[w h(path)] = p_T(a, b) E_bridge[h].

Chains, importance means and transition densities are written on this alone. For a coupling
(`start_laws` has the derivation)

    w = 1{met} · ν(b)/ν(x_0) · μ(x_0) · (mean of N hitting counts).
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from .bridges import Bridges, Inputs, check_key, find_bridges
from .burn_in import with_burn_in
from .coupling import AbstractCoupling, Coupling
from .diffusion import Diffusion, check_diffusion
from .hitting import (
    HittingCounts,
    check_max_trials,
    count_hits,
    counts_of,
    coupling_of,
)
from .intervals import Intervals, check_count
from .search import check_bound, default_num_lanes, key_for
from .start_laws import AnyStartLaw, Reversed, Stationary, log_ratio, needs_burn_in


class WeightedPaths(NamedTuple):
    """One weighted path for each of P keys.

    `log_weights` are -inf and `paths` NaN where none was `found`; `truncated` says where a
    weight is not exact because a bound on the work was reached; `num_simulated` counts the
    simulated paths, and `num_nonfinite` those that left the finite numbers.
    """

    paths: Float[Array, "P K d"]
    log_weights: Float[Array, " P"]
    found: Bool[Array, " P"]
    truncated: Bool[Array, " P"]
    num_simulated: Int[Array, " P"]
    num_nonfinite: Int[Array, " P"]


class AbstractWeightedProposal(eqx.Module):
    """A way to propose bridges, each with an unbiased weight."""

    @abstractmethod
    def prepared(
        self, key: Key[Array, ""], model: Diffusion, intervals: Intervals, num_steps: int
    ) -> "AbstractWeightedProposal":
        """The proposal with everything measured that it must know of these intervals."""

    @abstractmethod
    def draw(
        self,
        keys: Key[Array, " P"],
        model: Diffusion,
        intervals: Intervals,
        num_steps: int,
        stored: Int[Array, " K"] | None,
        misses_count: bool,
        progress_meter: diffrax.AbstractProgressMeter | None = None,
    ) -> WeightedPaths:
        """One weighted path for each key and each of P `intervals`, a function of its key.

        With `misses_count` a proposal that does not become a bridge has weight zero, so that
        `E[w] = p_T(a, b)`; otherwise it is tried again, and weights are in proportion only.
        """

    @abstractmethod
    def reweigh(
        self,
        keys: Key[Array, " P"],
        model: Diffusion,
        intervals: Intervals,
        paths: Float[Array, "P points d"],
    ) -> WeightedPaths:
        """Given paths with weights from their conditional law under the target of a chain."""


class CoupledPairs(AbstractWeightedProposal):
    """The proposals of a coupling, weighted by `num_counts` hitting counts each."""

    coupling: AbstractCoupling
    max_proposals: Int[Array, ""]
    max_trials: Int[Array, ""]
    num_counts: int = eqx.field(static=True)

    def prepared(self, key, model, intervals, num_steps):
        _, end, duration = intervals
        coupling = with_burn_in(key, model, self.coupling, end, duration, num_steps)
        return eqx.tree_at(lambda p: p.coupling, self, coupling)

    def draw(self, keys, model, intervals, num_steps, stored, misses_count, progress_meter=None):
        max_proposals = jnp.int32(1) if misses_count else self.max_proposals

        def block(keys, intervals):
            num_lanes = default_num_lanes(len(keys), num_steps, intervals.start)
            propose_keys, count_keys = _split(keys)
            inputs = Inputs(model, self.coupling, intervals)
            everything = jnp.ones(len(keys), bool)
            proposed = find_bridges(
                propose_keys, inputs, everything, 1, max_proposals, num_steps, None, num_lanes
            )
            paths, reverse_start, _ = proposed.outputs
            found = proposed.num_found > 0
            counts = self._counts(
                count_keys, model, intervals, paths, found, self.num_counts, progress_meter
            )
            log_weights = _log_weights(
                self.coupling.start_law, model, intervals.end, reverse_start, counts.mean
            )
            log_weights, unusable = _usable(log_weights, found)
            kept = paths if stored is None else paths[:, stored]
            return WeightedPaths(
                jnp.where(found[:, None, None], kept, jnp.nan),
                log_weights,
                found,
                counts.truncated | unusable,
                proposed.num_trials + counts.num_trials,
                proposed.num_nonfinite + counts.num_nonfinite,
            )

        return _in_blocks(block, (keys, intervals), num_steps)

    def reweigh(self, keys, model, intervals, paths):
        # Under the target the counts of a path are size-biased, and x_0 is where a trial that
        # hit had started: N + 1 counts, less one trial.
        found = jnp.all(jnp.isfinite(paths), axis=(1, 2))
        counts = self._counts(keys, model, intervals, paths, found, self.num_counts + 1)
        num_hits = jnp.sum(counts.counts > 0, axis=1, dtype=jnp.int32)
        one_less = jnp.maximum(counts.num_trials - 1, 1).astype(paths.dtype)
        mean = one_less / jnp.maximum(num_hits - 1, 1).astype(paths.dtype)
        # Where nothing hit, x_0 is unknown; any point serves for a weight that is flagged.
        start = jnp.where((num_hits > 0)[:, None], counts.start, intervals.start)
        log_weights = _log_weights(self.coupling.start_law, model, intervals.end, start, mean)
        log_weights, unusable = _usable(log_weights, found)
        return WeightedPaths(
            paths,
            log_weights,
            found,
            counts.truncated | unusable,
            counts.num_trials,
            counts.num_nonfinite,
        )

    def _counts(
        self, keys, model, intervals, paths, found, num_counts, progress_meter=None
    ) -> HittingCounts:
        return count_hits(
            keys,
            model,
            self.coupling,
            paths,
            intervals.duration,
            found,
            num_counts,
            self.max_trials,
            progress_meter=progress_meter,
        )


def _log_weights(
    law: AnyStartLaw,
    model: Diffusion,
    end: Float[Array, "P d"],
    reverse_start: Float[Array, "P d"],
    mean_count: Float[Array, " P"],
) -> Float[Array, " P"]:
    """log [ν(b)/ν(x_0) · μ(x_0) · ρ̂]; without ν(b), a constant, where the model has no ν."""
    log_weights = jax.vmap(lambda x: log_ratio(law, model, x))(reverse_start)
    log_weights += jnp.log(mean_count)
    if model.has_density:
        log_weights += jax.vmap(model.log_stationary)(end)
    return log_weights


# Bounds the tries for one bridge, unless the user says otherwise.
_MAX_PROPOSALS = 10_000


def as_proposal(
    proposal: Any,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
) -> AbstractWeightedProposal:
    """What the user gave as `proposal`, as a weighted proposal."""
    proposal = Coupling() if proposal is None else proposal
    if isinstance(proposal, AbstractWeightedProposal):
        if not (num_counts is None and max_proposals is None and max_trials is None):
            raise ValueError(
                "`num_counts`, `max_proposals` and `max_trials` are for a `Coupling`; this "
                "`proposal` has its own."
            )
        return proposal
    if not isinstance(proposal, AbstractCoupling):
        raise TypeError(f"`proposal` must be a `Coupling`; got {proposal!r}.")
    num_counts = 1 if num_counts is None else check_count("num_counts", num_counts)
    return CoupledPairs(
        proposal,
        check_bound("max_proposals", max_proposals, _MAX_PROPOSALS),
        check_max_trials(max_trials, num_counts),
        num_counts,
    )


def check_density(law: AnyStartLaw, model: Diffusion) -> None:
    """Raise `ValueError` where a start law has a density but the model's ν is not known."""
    if not isinstance(law, Stationary | Reversed) and not model.has_density:
        raise ValueError(
            "a start law other than `Stationary()` is paid for with ν(x): give `Diffusion` a "
            "`log_stationary` (up to a constant)."
        )


def check_burn_in(proposal: AbstractWeightedProposal, model: Diffusion) -> None:
    """Raise `ValueError` where a burn-in would have to be measured, but there is no place."""
    if isinstance(proposal, CoupledPairs) and needs_burn_in(proposal.coupling.start_law, model):
        raise ValueError(
            "this model has no sampler of its stationary law, so the length of the run that "
            "replaces it must be known: use `Stationary(burn_in=...)`, in units of time, for "
            "instance from `measure_burn_in`; or pass `sample_stationary=` to `Diffusion`, or "
            "choose a start law with a density (`fit_start_law`)."
        )


class WeightedBridges(eqx.Module):
    """Bridges whose weights make them exact; with I intervals arrays have a leading axis I.

    - `times`, `paths`: as in `Bridges`, shapes (K,) and (n, K, d).
    - `log_weights`: shape (n,), up to a common constant; -inf for a bridge that is missing.
    - `met`: whether the bridge was found, shape (n,).
    - `truncated`: whether its counts were cut off by `max_trials`, shape (n,). Such a weight is
        finite and too small on average, so that paths that are hard to hit weigh too little.
        Also where the start law's density was not a number: then the weight is zero.
    - `num_simulated`: paths simulated in all, proposals and trials.
    - `num_nonfinite`: how many of them left the finite numbers.
    - `coupling`, `num_steps`: those they were made with. The coupling has the start law of the
        weights; a `Stationary` that had to be run has its `burn_in` in it.
    """

    times: Float[Array, "*durations K"]
    paths: Float[Array, "*I n K d"]
    log_weights: Float[Array, "*I n"]
    met: Bool[Array, "*I n"]
    truncated: Bool[Array, "*I n"]
    num_simulated: Int[Array, "*I"]
    num_nonfinite: Int[Array, "*I"]
    coupling: AbstractCoupling
    num_steps: int = eqx.field(static=True)

    @property
    def weights(self) -> Float[Array, "*I n"]:
        """The weights, normalised to sum to one; all zero where no bridge was found."""
        largest = jnp.max(self.log_weights, axis=-1, keepdims=True)
        weights = jnp.exp(self.log_weights - jnp.where(jnp.isfinite(largest), largest, 0))
        total = jnp.sum(weights, axis=-1, keepdims=True)
        return weights / jnp.where(total > 0, total, 1)

    @property
    def effective_sample_size(self) -> Float[Array, "*I"]:
        """(Σw)²/Σw²: how many exact bridges these are worth, between 0 and n."""
        squares = jnp.sum(self.weights**2, axis=-1)
        positive = squares > 0
        return jnp.where(positive, 1 / jnp.where(positive, squares, 1), 0)

    @property
    def efficiency(self) -> Float[Array, "*I"]:
        """Effective sample size per simulated path."""
        size = self.effective_sample_size
        return size / jnp.maximum(self.num_simulated, 1).astype(size.dtype)

    def mean(self, fn: Callable[[Array], PyTree] = lambda path: path) -> PyTree:
        """The weighted mean of `fn(path)`, a function of one path of shape (K, d), by default
        the path itself: an estimate of its expectation over exact bridges."""
        values, weights = self._values(fn), self.weights
        return jax.tree.map(lambda value: _weighted_sum(weights, value), values)

    def standard_error(self, fn: Callable[[Array], PyTree] = lambda path: path) -> PyTree:
        """That of `mean(fn)`, by the delta method, entry by entry."""
        values, weights = self._values(fn), self.weights

        def error(value):
            mean = _weighted_sum(weights, value)
            deviation = value - jnp.expand_dims(mean, weights.ndim - 1)
            return jnp.sqrt(_weighted_sum(weights**2, deviation**2))

        return jax.tree.map(error, values)

    def resample(self, key: Key[Array, ""], num_bridges: int) -> Float[Array, "*I m K d"]:
        """Equally weighted paths by systematic resampling, shape (m, K, d): many effective ones
        are needed for few repetitions. NaN where no bridge was found."""
        num_bridges = check_count("num_bridges", num_bridges)

        check_key(key)

        def one_interval(key, weights, paths):
            shift = jax.random.uniform(key, dtype=weights.dtype)
            points = (jnp.arange(num_bridges, dtype=weights.dtype) + shift) / num_bridges
            cumulated = jnp.cumsum(weights)
            chosen = jnp.searchsorted(cumulated, points * cumulated[-1], side="right")
            # Rounding may lead past the last positive weight.
            last = jnp.max(jnp.where(weights > 0, jnp.arange(len(weights)), 0))
            return paths[jnp.minimum(chosen, last)]

        if self.log_weights.ndim == 1:
            return one_interval(key, self.weights, self.paths)
        keys = jax.random.split(key, len(self.log_weights))
        return jax.vmap(one_interval)(keys, self.weights, self.paths)

    def _values(self, fn: Callable[[Array], PyTree]) -> PyTree:
        each = jax.vmap(fn) if self.log_weights.ndim == 1 else jax.vmap(jax.vmap(fn))
        # Missing bridges are NaN and weigh nothing.
        paths = jnp.where(self.met[..., None, None], self.paths, 0)
        return each(paths)


def _weighted_sum(weights: Float[Array, "*I n"], values: Array) -> Array:
    axis = weights.ndim - 1
    weights = weights.reshape(*weights.shape, *[1] * (values.ndim - weights.ndim))
    return jnp.sum(jnp.where(weights > 0, weights * values, 0), axis=axis)


def weigh_bridges(
    key: Key[Array, ""],
    model: Diffusion,
    bridges: Bridges,
    num_counts: int = 1,
    *,
    start_law: AnyStartLaw | None = None,
    max_trials: int | None = None,
    batch_size: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> WeightedBridges:
    """Weights that correct approximate bridges to the exact law: importance sampling.

    **Arguments:**

    - `key`: a typed key.
    - `model`: the model the bridges were made with.
    - `bridges`: from `sample_bridges`, with their whole paths (no `save_at`).
    - `num_counts`: N hitting counts for each bridge. More make a weight less noisy; one is often
        the best use of time.
    - `start_law`: μ, by default that of the bridges' coupling.
    - `max_trials`: bounds the trials of each bridge; by default 10,000 for each count. See
        `WeightedBridges.truncated`.
    - `batch_size`: trials simulated side by side; changes results by rounding only.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.

    **Returns:** `WeightedBridges`. Not differentiable.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    !!! example

        ```python
        bridges = jb.sample_bridges(key, model, a, b, 1.0, num_bridges=1000)
        weighted = jb.weigh_bridges(jax.random.key(1), model, bridges)
        weighted.mean(lambda path: path[25]), weighted.effective_sample_size
        ```
    """
    check_key(key)
    check_diffusion(model)
    if not isinstance(bridges, Bridges):
        raise TypeError(
            f"`bridges` must come from `sample_bridges`; got {type(bridges).__name__}. (Those of "
            "`sample_exact_bridges` and `weigh_bridges` are exact already.)"
        )
    coupling = coupling_of(bridges, start_law)
    num_counts = check_count("num_counts", num_counts)
    bound = check_max_trials(max_trials, num_counts)
    check_density(coupling.start_law, model)
    batch_size = None if batch_size is None else check_count("batch_size", batch_size)
    budget = (num_counts, bound, batch_size, progress_meter)
    return _weigh_bridges(key_for("weights", key), model, coupling, bridges, budget)


@eqx.filter_jit
def _weigh_bridges(key, model, coupling, bridges, budget):
    counts, coupling = counts_of(key, model, coupling, bridges, *budget)
    d, shape = bridges.paths.shape[-1], bridges.met.shape
    log_weights = _log_weights(
        coupling.start_law,
        model.prepared(),
        bridges.paths[..., -1, :].reshape(-1, d),
        bridges.reverse_start.reshape(-1, d),
        counts.mean.reshape(-1),
    ).reshape(shape)
    log_weights, unusable = _usable(log_weights, bridges.met)
    num_trials = jnp.sum(counts.num_trials, axis=-1, dtype=jnp.int32)
    num_nonfinite = jnp.sum(counts.num_nonfinite, axis=-1, dtype=jnp.int32)
    return WeightedBridges(
        bridges.times,
        bridges.paths,
        log_weights,
        bridges.met,
        counts.truncated | unusable,
        bridges.num_proposals + num_trials,
        bridges.num_nonfinite + num_nonfinite,
        coupling,
        bridges.num_steps,
    )


def _usable(
    log_weights: Float[Array, "*I n"], found: Bool[Array, "*I n"]
) -> tuple[Float[Array, "*I n"], Bool[Array, "*I n"]]:
    """Weights of which none spoils the others, and where one would have."""
    number = log_weights < jnp.inf  # false for NaN, as densities of start laws may give
    return jnp.where(found & number, log_weights, -jnp.inf), found & ~number


def _split(keys: Key[Array, " P"]) -> tuple[Key[Array, " P"], Key[Array, " P"]]:
    first, second = jax.vmap(jax.random.split, out_axes=1)(keys)
    return first, second


# Whole paths are kept only until they are weighed: at most this many bytes of them at a time.
_BLOCK_BYTES = 2**28


def _in_blocks(
    function: Callable[[Key[Array, " block"], Intervals], WeightedPaths],
    arguments: tuple[Key[Array, " P"], Intervals],
    num_steps: int,
) -> WeightedPaths:
    """`function`, row by row of its arguments, on blocks of rows."""
    keys, intervals = arguments
    num, d = intervals.start.shape
    bytes_per_path = (num_steps + 1) * d * intervals.start.dtype.itemsize
    num_blocks = -(-num * bytes_per_path // _BLOCK_BYTES)
    if num_blocks == 1:
        return function(keys, intervals)
    size = -(-num // num_blocks)
    rows = jnp.minimum(jnp.arange(num_blocks * size), num - 1).reshape(num_blocks, size)
    keys, intervals = keys[rows], jax.tree.map(lambda leaf: leaf[rows], intervals)
    blocks = lax.map(lambda block: function(*block), (keys, intervals))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:num], blocks)
