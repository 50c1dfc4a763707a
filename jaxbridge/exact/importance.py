"""Importance sampling: bridges whose weights make them exact.

    E_bridge[h] = E[w h(path)] / E[w],

by weighing approximate bridges, or from any weighted proposal.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..coupling import (
    AnyStartLaw,
    Bridges,
    counts_of,
    coupling_of,
    durations_of,
    search_for_hits,
    with_start_law,
)
from ..engine.averages import (
    PathFunction,
    effective_size,
    expanded,
    filled,
    normalised,
    values_of,
    weighted_mean,
)
from ..engine.checks import Numbers, check_count, check_key
from ..engine.compiled import compiled_for
from ..engine.doors import door
from ..engine.keys import key_for
from ..engine.pareto import pareto_k
from ..engine.verdict import (
    Fault,
    Verdict,
    heavy_tails,
    lost_paths,
    missing_bridges,
    throw_where_untrustworthy,
    truncated_weights,
)
from ..models.bridge_problem import BridgeProblem, Intervals, bridge_problem
from ..models.diffusion import Diffusion, check_diffusion
from ..proposals import (
    AbstractProposal,
    AbstractWeightedProposal,
    Budget,
    as_proposal,
    check_density,
    pair_log_weights,
    resolve,
    usable,
)
from ..schemes import step_fault
from .exact_bridges import AbstractExactBridges


class WeightedBridges(AbstractExactBridges):
    """Bridges whose weights make them exact, from `weigh_bridges` or `sample_weighted_bridges`;
    with I intervals arrays have a leading axis I.

    - `times`, `paths`: as in `Bridges`, shapes (K,) and (n, K, d).
    - `log_weights`: shape (n,), up to a common constant; -inf for a bridge that is missing.
    - `met`: whether the bridge was found, shape (n,).
    - `truncated`: whether its counts were cut off by `max_trials`, shape (n,). Such a weight is
        finite and too small on average, so that paths that are hard to hit weigh too little.
        Also where the start law's density was not a number: then the weight is zero.
    - `num_simulated`: paths simulated in all, proposals and trials.
    - `num_nonfinite`: how many of them left the state space or the finite numbers; where
        more than 5 % of the mass may be missing with them, that is a fault.
    - `proposal`, `num_steps`: those they were made with. The coupling of a proposal has the
        start law of the weights; a `Stationary` that had to be run has its `burn_in` in it.
    - `log_halving`: log of the factor by which half as many steps would change a weight, NaN where
        none was worked out; and `step_share`, the step error as a share of what that changes.
    """

    times: Float[Array, "*durations K"]
    paths: Float[Array, "*I n K d"]
    log_weights: Float[Array, "*I n"]
    met: Bool[Array, "*I n"]
    truncated: Bool[Array, "*I n"]
    num_simulated: Int[Array, "*I"]
    num_nonfinite: Int[Array, "*I"]
    proposal: AbstractWeightedProposal
    log_halving: Float[Array, "*I n"]
    step_share: Float[Array, "*I"]
    num_steps: int = eqx.field(static=True)

    @property
    def weights(self) -> Float[Array, "*I n"]:
        """The weights, normalised to sum to one; all zero where no bridge was found."""
        return normalised(self.log_weights)

    @property
    def effective_sample_size(self) -> Float[Array, "*I"]:
        """(Σw)²/Σw²: how many exact bridges these are worth, between 0 and n."""
        return effective_size(self.weights)

    @property
    def efficiency(self) -> Float[Array, "*I"]:
        """Effective sample size per simulated path."""
        size = self.effective_sample_size
        return size / jnp.maximum(self.num_simulated, 1).astype(size.dtype)

    @property
    def log_mean_weights(self) -> Float[Array, "*I n"]:
        """Those of the bridges."""
        return self.log_weights

    def standard_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """That of `mean(fn)`, by the delta method, entry by entry; infinite where weights were cut
        off, for then the mean is off by more than it shows."""
        weights, axis = self.weights, self.log_weights.ndim - 1
        cut = jnp.any(self.truncated, axis=-1)

        def error(value):
            mean, each = weighted_mean(weights, value), expanded(weights, value)
            deviation = value - jnp.expand_dims(mean, axis)
            squares = jnp.where(each > 0, (each * deviation) ** 2, 0)
            lost = cut.reshape(*cut.shape, *[1] * (mean.ndim - cut.ndim))
            whole = jnp.where(lost, jnp.inf, jnp.sqrt(jnp.sum(squares, axis)))
            return jnp.where(jnp.isnan(mean), jnp.nan, whole)

        return jax.tree.map(error, values_of(fn, filled(self.paths, self.met)))

    @property
    def pareto_k(self) -> Float[Array, "*I"]:
        """k̂ of the weights. Above 0.7 neither means nor their standard errors can be trusted."""
        return pareto_k(self.log_weights)

    @property
    def verdict(self) -> Verdict:
        """Return the faults: missing bridges, weights cut off or with heavy tails, too many of
        the paths lost, a step error of the mean path that dominates and is beyond 0.05 standard
        deviations."""
        error = 1 / jnp.sqrt(jnp.maximum(self.effective_sample_size, 1))  # in the same units
        verdict = Verdict((*self._weight_faults, step_fault(self.step_error_in_sds(), error)))
        return verdict.with_finite(self.mean(), self.standard_error())

    @property
    def _weight_faults(self) -> tuple[Fault, ...]:
        # One path each is simulated where a lost path is a miss, and not tried again.
        sizes = self.effective_sample_size, jnp.sum(self.log_weights > -jnp.inf, axis=-1)
        tried_again = self.num_simulated > self.met.shape[-1]
        missing = ~jnp.any(self.met, axis=-1) | (tried_again & jnp.any(~self.met, axis=-1))
        return (
            missing_bridges(missing, self.proposal.coupled),
            truncated_weights(jnp.any(self.truncated, axis=-1)),
            lost_paths(self.num_nonfinite, self.num_simulated, *sizes),
            heavy_tails(self.pareto_k, *sizes),
        )

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


@door
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
    throw: bool = False,
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
    - `throw`: raise an error at run time where the result is not `trustworthy`, or parameters are
        not finite.

    **Returns:** `WeightedBridges`. Not differentiable.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    **Example:**

    ```python
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
    search = search_for_hits(bridges, num_counts, max_trials, batch_size, progress_meter)
    check_density(coupling.start_law, model)
    like = bridges.reverse_start.reshape(-1, bridges.paths.shape[-1])[0]
    pairs = as_proposal(coupling, model, like, Budget(search.wanted, None, max_trials))
    weighted = _weigh_bridges(key_for("weights", key), model, pairs, bridges, search)
    return throw_where_untrustworthy(weighted, "log_weights", model) if throw else weighted


@compiled_for(lambda key, model, pairs, bridges, search: bridges.met.size * bridges.num_steps)
def _weigh_bridges(key, model, pairs, bridges, search):
    paths = bridges.paths.reshape(-1, *bridges.paths.shape[-2:])
    ends, durations = paths[:, -1], durations_of(bridges)
    known = with_start_law(key, model, pairs.coupling, ends, durations, bridges.num_steps)
    counts, coupling = counts_of(key, model, known, bridges, search)
    d, shape = bridges.paths.shape[-1], bridges.met.shape
    model = model.prepared()
    log_weights = pair_log_weights(
        coupling.start_law,
        model,
        bridges.paths[..., -1, :].reshape(-1, d),
        bridges.reverse_start.reshape(-1, d),
        counts.mean.reshape(-1),
    ).reshape(shape)
    log_weights, unusable = usable(log_weights, bridges.met)
    intervals = Intervals(paths[:, 0], ends, durations)
    log_halving = pairs.log_halving(model, intervals, paths, shape[-1]).reshape(shape)
    share = pairs.share_in_regime(model, intervals, bridges.num_steps)
    share = share.reshape(shape)[..., 0]
    num_trials = jnp.sum(counts.num_trials, axis=-1, dtype=jnp.int32)
    num_nonfinite = jnp.sum(counts.num_nonfinite, axis=-1, dtype=jnp.int32)
    return WeightedBridges(
        times=bridges.times,
        paths=bridges.paths,
        log_weights=log_weights,
        met=bridges.met,
        truncated=counts.truncated | unusable,
        num_simulated=bridges.num_proposals + num_trials,
        num_nonfinite=bridges.num_nonfinite + num_nonfinite,
        proposal=eqx.tree_at(lambda p: p.coupling, pairs, coupling),
        log_halving=log_halving,
        step_share=share,
        num_steps=bridges.num_steps,
    )


@door
def sample_weighted_bridges(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_bridges: int = 1000,
    num_steps: int = 50,
    proposal: Any = None,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    save_at: Numbers | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = False,
) -> WeightedBridges:
    """Independent weighted bridges from any proposal: importance sampling.

    **Arguments:**

    - `key`, `model`, `start`, `end`, `duration`, `num_steps`, `save_at`: as in `sample_bridges`.
    - `num_bridges`: n, for each interval.
    - `proposal`, `num_counts`, `max_proposals`, `max_trials`: as in `sample_exact_bridges`.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.
    - `throw`: raise an error at run time where the result is not `trustworthy`, or parameters are
        not finite.

    **Returns:** `WeightedBridges`.

    **Gradients.** From proposals that are pulled to the end point (`ModifiedDiffusionBridge`,
    `ResidualBridge`, `Guided`) paths and weights are smooth functions of `params`, `start`, `end`
    and `duration`, so derivatives of weighted means, forward and reverse, are estimates of the
    derivatives of expectations; a choice between such proposals has them, too. Those of
    couplings, and of a choice that may take them, raise `TypeError`.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    **Example:**

    ```python
    proposal = jb.ModifiedDiffusionBridge()
    weighted = jb.sample_weighted_bridges(key, model, start, end, 0.1, proposal=proposal)
    weighted.mean(lambda path: path[25]), weighted.effective_sample_size
    ```
    """
    check_key(key)
    problem = bridge_problem(model, start, end, duration, num_steps)
    num_bridges = check_count("num_bridges", num_bridges)
    budget = Budget(num_counts, max_proposals, max_trials)
    proposal = as_proposal(proposal, model, problem.like, budget)
    proposal.check(model, problem.intervals)
    problem = problem.keep(save_at, duration, proposal.fractions(num_steps))
    proposal = resolve(proposal, key, model, problem.intervals, num_steps)
    weighted = _sample_weighted(key, model, proposal, problem, num_bridges, progress_meter)
    return throw_where_untrustworthy(weighted, "log_weights", model) if throw else weighted


@compiled_for(lambda key, model, proposal, problem, num, *_: problem.num_path_steps(num))
def _sample_weighted(
    key: Key[Array, ""],
    model: Diffusion,
    proposal: AbstractProposal,
    problem: BridgeProblem,
    num_bridges: int,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> WeightedBridges:
    model, intervals, num_steps = model.prepared(), problem.intervals, problem.num_steps
    proposal = proposal.prepared(key, model, intervals, num_steps)
    drawn = proposal.draw(
        problem.keys(key, num_bridges),
        model,
        intervals,
        num_steps,
        problem.stored,
        False,
        progress_meter=progress_meter,
    )
    of_interval = problem.result(drawn)
    return WeightedBridges(
        times=problem.times(proposal.fractions(num_steps)),
        paths=of_interval.paths,
        log_weights=of_interval.log_weights,
        met=of_interval.found,
        truncated=of_interval.truncated,
        num_simulated=problem.total(drawn.num_simulated),
        num_nonfinite=problem.total(drawn.num_nonfinite),
        proposal=proposal,
        log_halving=of_interval.log_halving,
        step_share=problem.result(proposal.share_in_regime(model, intervals, num_steps)),
        num_steps=num_steps,
    )
