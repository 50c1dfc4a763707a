"""Proposals by a coupling, with random weights that make them exact (section 2.3 of the paper).

The weight of a pair is

    w = 1{met} · ν(b)/ν(x_0) · μ(x_0) · (mean of N hitting counts).

Here x_0 is the reversed path at time 0, and μ is the start law of the associated diffusion. The
factor 1{met} is 1 if the pair met, otherwise 0. `start_laws` has the derivation.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..coupling import (
    AbstractCoupling,
    AnyStartLaw,
    HittingCounts,
    Inputs,
    Reversed,
    Stationary,
    count_hits,
    default_lanes,
    describe_coupling,
    find_bridges,
    ingredients,
    log_ratio,
    most_accurate,
    needs_burn_in,
    step_law_of,
    with_start_law,
)
from ..engine.batch_size import default_num_lanes
from ..engine.checks import nondifferentiable
from ..engine.keys import split_each
from ..engine.lanes import over_points
from ..engine.rejection import Search
from ..models.bridge_problem import Intervals, uniform_fractions
from ..models.diffusion import Diffusion
from ..schemes import check_model, log_halving_of_paths, num_looked
from .base import AbstractProposal, AbstractSingleProposal, WeightedPaths
from .memory_blocks import in_blocks

# Weights need complete paths. A block has at most this many bytes of them.
_BLOCK_BYTES = 2**28

# Seconds per simulated path, relative to a modified diffusion bridge (measured).
_SECONDS = 3.5
# Maximum of trials per hitting count in a pilot run. Slower hits are not worth their time.
_PILOT_TRIALS = 64

# A path with its counts costs much more than D. Hence D is evaluated for this many times more
# paths than for guided proposals.
_LOOKED = 4


class CoupledPairs(AbstractSingleProposal):
    """Proposal by a coupling, weighted by hitting counts.

    `sample_exact_bridges` and other functions return it as `proposal` if they receive a `Coupling`.

    - `coupling`: the coupling, with the start law of the weights.
    - `max_proposals`: maximum number of attempts for a pair that meets.
    - `max_trials`: maximum number of trials for the counts of one path.
    - `num_counts`: number of hitting counts per path.
    """

    coupling: AbstractCoupling
    max_proposals: Int[Array, ""]
    max_trials: Int[Array, ""]
    num_counts: int = eqx.field(static=True)

    @property
    def by_coupling(self):
        return self.coupling

    @property
    def target(self):
        return None

    @property
    def efficiency_bound(self):
        return 1 / (1 + self.num_counts)

    def describe(self):
        return describe_coupling(self.coupling)

    def relative_seconds(self, model, intervals):
        seconds, law = jnp.full_like(intervals.duration, _SECONDS), self.coupling.start_law
        if isinstance(law, Stationary) and not model.has_sampler and law.burn_in is not None:
            # Each trial starts with a run of the burn-in, in steps that cost half as much. At least
            # half of the simulated paths are trials: 1/2 · 1/2 = 1/4.
            seconds *= 1 + law.burn_in.astype(seconds.dtype) / intervals.duration / 4
        return seconds

    def ingredients(self):
        return ingredients(self.coupling)

    def for_model(self, model, like, normal_steps=True):
        return self

    def most_accurate(self, model, like):
        return eqx.tree_at(lambda p: p.coupling, self, most_accurate(self.coupling))

    def for_pilot(self):
        bound = jnp.minimum(self.max_trials, _PILOT_TRIALS * self.num_counts)
        return eqx.tree_at(lambda p: p.max_trials, self, bound)

    def check(self, model, intervals):
        check_model(model, intervals, self.coupling.scheme)
        model.check_reversal()
        check_density(self.coupling.start_law, model)

    def check_prepared(self, model):
        if self.must_measure(model):
            raise ValueError(
                "this model has no sampler of its stationary law, so the coupling needs a burn-in: "
                "pass `Stationary(burn_in=...)`, in units of time, for instance from "
                "`measure_burn_in`; or pass `sample_stationary=` to `Diffusion`; or use a start "
                "law with a density (`fit_start_law`)."
            )

    def must_measure(self, model):
        return needs_burn_in(self.coupling.start_law, model)

    def check_size(self, model):
        """Raise `ValueError` if the weights are known only up to a constant.

        The weights have the factor ν(b)/ν(x_0) · μ(x_0). If μ has a normalised density, the
        constant of ν cancels. If μ is ν, the factor is ν(b), which needs a normalised
        `log_stationary`. `Reversed` has the same weights as ν.
        """
        if not model.has_density:
            raise ValueError(
                "transition densities by couplings need the stationary density, and this model has "
                "none: give `Diffusion` a `log_stationary`, normalised if the start law is "
                "`Stationary()`; or use a proposal that does not need it, such as "
                "`ModifiedDiffusionBridge()` or `Guided()`."
            )
        law = self.coupling.start_law
        # A law that needs a burn-in is replaced by one with a density (`prepared`).
        replaced = needs_burn_in(law, model)
        if isinstance(law, Stationary | Reversed) and not (model.normalised or replaced):
            raise ValueError(
                "a coupling from the stationary law gives densities in proportion to exp of "
                "`log_stationary`, which is not declared to be normalised, so densities may be "
                "wrong by any factor. If it is normalised for all parameters, pass "
                "`Diffusion(..., normalised=True)`. Otherwise use a start law with a density, "
                "`Coupling(..., start_law=fit_start_law(..., for_density=True))`, or pass "
                '`proposal="auto"` or a guided proposal, such as `ModifiedDiffusionBridge()` or '
                "`Guided()`."
            )

    def prepared(self, key, model, intervals, num_steps):
        coupling, (_, end, duration) = nondifferentiable((self.coupling, intervals))
        coupling = with_start_law(key, model, coupling, end, duration, num_steps)
        return eqx.tree_at(lambda p: p.coupling, self, coupling)

    def fractions(self, num_steps):
        return uniform_fractions(num_steps)

    def step_share(self, model, intervals):
        _, share = step_law_of(self.coupling, model, intervals.start[0])
        return jnp.full_like(intervals.duration, share)

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
        self, model, intervals = nondifferentiable((self, model, intervals))
        max_proposals = jnp.int32(1) if misses_count else self.max_proposals

        def block(keys, intervals, active):
            num_intervals, num_draws = keys.shape
            keys = keys.reshape(-1)
            if active is None:
                active = jnp.ones(num_intervals, bool)
            active = jnp.repeat(active, num_draws)
            intervals = jax.tree.map(lambda leaf: jnp.repeat(leaf, num_draws, axis=0), intervals)
            num_lanes = default_num_lanes(len(keys), num_steps, intervals.start)
            propose_keys, count_keys = split_each(keys, 2)
            inputs = Inputs(model, self.coupling, intervals)
            search = Search(1, max_proposals, num_lanes)
            proposed = find_bridges(propose_keys, inputs, active, num_steps, None, search)
            paths, reverse_start, _ = proposed.outputs
            is_found = proposed.num_found > 0
            counts = self._counts(
                count_keys, model, intervals, paths, is_found, self.num_counts, progress_meter
            )
            law = self.coupling.start_law
            log_weights = pair_log_weights(law, model, intervals.end, reverse_start, counts.mean)
            log_weights, unusable = usable(log_weights, is_found)
            log_halving = self.log_halving(model, intervals, paths, num_draws)
            stored_paths = paths if stored is None else paths[:, stored]
            weighted = WeightedPaths(
                jnp.where(is_found[:, None, None], stored_paths, jnp.nan),
                log_weights,
                is_found,
                counts.truncated | unusable,
                proposed.num_trials + counts.num_trials,
                proposed.num_nonfinite + counts.num_nonfinite,
                log_halving,
                jnp.full_like(log_weights, jnp.nan),
                None,
            )
            return jax.tree.map(
                lambda leaf: leaf.reshape(num_intervals, num_draws, *leaf.shape[1:]), weighted
            )

        d, itemsize = intervals.start.shape[1], intervals.start.dtype.itemsize
        most_rows = _BLOCK_BYTES // ((num_steps + 1) * d * itemsize)
        return in_blocks(block, keys, intervals, most_rows, active)

    def reweigh(self, keys, model, intervals, paths, active=None):
        # Under the target law, given the path, x_0 is the start of a trial that hit, and the counts
        # are size-biased. This equals N + 1 counts with one trial less in their sum.
        self, model, intervals, paths = nondifferentiable((self, model, intervals, paths))
        is_found = jnp.all(jnp.isfinite(paths), axis=(1, 2))
        if active is not None:
            is_found &= active
        counts = self._counts(keys, model, intervals, paths, is_found, self.num_counts + 1)
        num_hits = jnp.sum(counts.counts > 0, axis=1, dtype=jnp.int32)
        one_less = jnp.maximum(counts.num_trials - 1, 1).astype(paths.dtype)
        mean = one_less / jnp.maximum(num_hits - 1, 1).astype(paths.dtype)
        # Without a hit x_0 is unknown. The weight is marked as truncated, so any point will do.
        start = jnp.where((num_hits > 0)[:, None], counts.start, intervals.start)
        log_weights = pair_log_weights(self.coupling.start_law, model, intervals.end, start, mean)
        log_weights, unusable = usable(log_weights, is_found)
        weighted = WeightedPaths(
            jnp.where(is_found[:, None, None], paths, jnp.nan),
            log_weights,
            is_found,
            counts.truncated | unusable,
            counts.num_trials,
            counts.num_nonfinite,
            self.log_halving(model, intervals, paths, 1),
            jnp.full_like(log_weights, jnp.nan),
            None,
        )
        return jax.tree.map(lambda leaf: leaf[:, None], weighted)

    def log_halving(
        self, model: Diffusion, intervals: Intervals, paths: Float[Array, "P points d"], n: int
    ) -> Float[Array, " P"]:
        """Return the log change of the weight of each path by half as many steps (`halving`).

        `paths` has n successive paths of each interval. For constant σ only the first few of each
        interval have a value; it is NaN for the others.
        """
        dynamics = model.forward(intervals.start[0])
        density, _ = step_law_of(self.coupling, model, intervals.start[0])
        num_rows = num_looked(_LOOKED * n, dynamics.sigma_varies)
        rows = jnp.arange(len(paths)).reshape(-1, n)[:, :num_rows].reshape(-1)
        num_steps = paths.shape[1] - 1
        dt = jnp.broadcast_to(intervals.duration[rows] / num_steps, (num_steps, len(rows)))
        log_halving = log_halving_of_paths(density, dynamics, dt, paths[rows])
        return jnp.full(len(paths), jnp.nan, paths.dtype).at[rows].set(log_halving)

    def _counts(
        self, keys, model, intervals, paths, is_found, num_counts, progress_meter=None
    ) -> HittingCounts:
        """Count trials until `num_counts` hits of each path that was found."""
        num_lanes = default_lanes(paths, num_counts)
        search = Search(num_counts, self.max_trials, num_lanes, progress_meter)
        return count_hits(keys, model, self.coupling, paths, intervals.duration, is_found, search)


def pair_log_weights(
    law: AnyStartLaw,
    model: Diffusion,
    end: Float[Array, "P d"],
    reverse_start: Float[Array, "P d"],
    mean_count: Float[Array, " P"],
) -> Float[Array, " P"]:
    """Return log [ν(b)/ν(x_0) · μ(x_0) · ρ̂], with ρ̂ the mean of the hitting counts.

    If the model has no ν, the result omits ν(b), which is constant for each interval.
    """
    log_weights = over_points(lambda x: log_ratio(law, model, x))(reverse_start)
    log_weights += jnp.log(mean_count)
    if model.has_density:
        log_weights += over_points(model.log_stationary)(end)
    return log_weights


def usable(
    log_weights: Float[Array, "*rows"], is_found: Bool[Array, "*rows"]
) -> tuple[Float[Array, "*rows"], Bool[Array, "*rows"]]:
    """Return log weights with -inf in place of NaN and +inf, and the mask of the replaced ones.

    Paths that were not found also get -inf, and are not in the mask. A single NaN would make every
    weighted mean NaN.
    """
    is_number = log_weights < jnp.inf  # false for NaN, which densities of start laws may return
    return jnp.where(is_found & is_number, log_weights, -jnp.inf), is_found & ~is_number


def check_density(law: AnyStartLaw, model: Diffusion) -> None:
    """Raise `ValueError` if the start law has a density but the model has no ν."""
    if not isinstance(law, Stationary | Reversed) and not model.has_density:
        raise ValueError(
            "the weights of a start law other than `Stationary()` need the stationary density: "
            "give `Diffusion` a `log_stationary` (up to a constant)."
        )


def as_pairs(
    proposal: AbstractProposal,
    method: str = "renewal",
    instead: str = 'method="pseudo_marginal"',
) -> CoupledPairs:
    """Return the proposal, or raise `TypeError` if it is not a coupling.

    `method` and `instead` are the argument and the alternative that the message names.
    """
    if not isinstance(proposal, CoupledPairs):
        raise TypeError(
            f"{method} is for couplings: pass a `Coupling` as `proposal`, or use {instead}."
        )
    return proposal
