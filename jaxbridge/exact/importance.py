"""Importance sampling of bridges: independent bridges with weights for the exact law,

    E_bridge[h] = E[w h(path)] / E[w].

The weights belong either to approximate bridges (`weigh_bridges`), or to the paths of any weighted
proposal (`sample_weighted_bridges`).
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..coupling import (
    AnyStartLaw,
    Bridges,
    bridge_durations,
    count_hits_of_bridges,
    coupling_of_bridges,
    search_for_hits,
    with_start_law,
)
from ..engine.averages import (
    PathFunction,
    align_axes,
    effective_size,
    evaluate_on_paths,
    fill_missing_paths,
    normalise_weights,
    weighted_mean,
)
from ..engine.checks import Numbers, check_count, check_key
from ..engine.compiled import compiled_for
from ..engine.entry import public_entry
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
    ProposalLike,
    as_proposal,
    check_density,
    pair_log_weights,
    resolve,
    usable,
)
from ..schemes import step_faults
from .exact_bridges import AbstractExactBridges


class WeightedBridges(AbstractExactBridges):
    """Result of `weigh_bridges` or `sample_weighted_bridges`: weighted bridges of the exact law.

    With I intervals arrays have a leading axis I.

    - `times`, `paths`: as in `Bridges`, shapes (K,) and (n, K, d).
    - `log_weights`: log weights up to a common constant, shape (n,); -inf for a missing bridge.
    - `met`: whether the bridge was found, shape (n,).
    - `truncated`: whether `max_trials` truncated the counts of the bridge, shape (n,). The weight
        is then finite but biased: paths that are hard to hit get too little weight. It is also true
        in two other cases: if the run that replaces a sampler of ν is too short (see `Stationary`),
        and if the weight was NaN or infinite, and became zero.
    - `num_simulated`: number of simulated paths, proposals and trials.
    - `num_nonfinite`: number of these that left the state space or became non-finite. It is a fault
        if the mass that may be missing with them exceeds 5 % and the relative standard error.
    - `proposal`, `num_steps`: the proposal and the number N of steps of the paths. The coupling of
        a proposal has the start law of the weights. If this law is `Stationary` and needs runs, it
        contains their `burn_in`.
    - `log_halving`: log of the factor by which half as many steps would change a weight, shape
        (n,); NaN where it was not computed.
    - `coarse_paths`: the paths that the same noise gives with half as many steps, shape (n, K, d).
        Where none was simulated, the entry is the bridge itself. `None` if no coarse paths are
        needed. Between the points of the coarse grid the distance to the bridge is constant.
    - `step_share`: the discretisation error divided by the change of the estimate under half as
        many steps; infinite if this change has no information about the error.
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
    coarse_paths: Float[Array, "*I n K d"] | None
    step_share: Float[Array, "*I"]
    num_steps: int = eqx.field(static=True)

    @property
    def weights(self) -> Float[Array, "*I n"]:
        """Return the weights, normalised to sum to one, shape (n,); all zero if there is no
        bridge."""
        return normalise_weights(self.log_weights)

    @property
    def effective_sample_size(self) -> Float[Array, "*I"]:
        """Return (Σw)²/Σw²: the equivalent number of independent exact bridges, between 0 and n."""
        return effective_size(self.weights)

    @property
    def efficiency(self) -> Float[Array, "*I"]:
        """Return the effective sample size per simulated path."""
        size = self.effective_sample_size
        return size / jnp.maximum(self.num_simulated, 1).astype(size.dtype)

    @property
    def log_mean_weights(self) -> Float[Array, "*I n"]:
        """Return the log weights of the bridges."""
        return self.log_weights

    def standard_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the standard error of `mean(fn)`, by the delta method, entry by entry.

        It is infinite if weights were truncated, because it does not include the bias of the
        truncation.
        """
        weights, axis = self.weights, self.log_weights.ndim - 1
        is_truncated = jnp.any(self.truncated, axis=-1)

        def error(value):
            mean, entry_weights = weighted_mean(weights, value), align_axes(weights, value)
            # The delta method for a ratio of means: Σ w² (h - mean)², with Σ w = 1.
            deviation = value - jnp.expand_dims(mean, axis)
            # A value without weight may be infinite: 0 · ∞ would be NaN.
            squares = jnp.where(entry_weights > 0, (entry_weights * deviation) ** 2, 0)
            is_unknown = is_truncated.reshape(
                *is_truncated.shape, *[1] * (mean.ndim - is_truncated.ndim)
            )
            value_or_inf = jnp.where(is_unknown, jnp.inf, jnp.sqrt(jnp.sum(squares, axis)))
            return jnp.where(jnp.isnan(mean), jnp.nan, value_or_inf)

        return jax.tree.map(error, evaluate_on_paths(fn, fill_missing_paths(self.paths, self.met)))

    @property
    def pareto_k(self) -> Float[Array, "*I"]:
        """Return k̂ of the weights. Above 0.7 neither means nor their standard errors are reliable.

        The limit is 0.6 if fewer than 20 % of the positive weights are effective, and 1 if more
        than 80 % are.
        """
        return pareto_k(self.log_weights)

    @property
    def verdict(self) -> Verdict:
        """Return the possible faults, as a `Verdict`:

        - missing bridges;
        - truncated weights, weights with heavy tails, or an effective sample size below 20;
        - too many lost paths;
        - a discretisation error of the mean path that is unknown or too uncertain, or that
            dominates and exceeds 0.05 standard deviations;
        - a mean path or standard error that is not finite.
        """
        # In standard deviations, as is the discretisation error of the mean path.
        error = 1 / jnp.sqrt(jnp.maximum(self.effective_sample_size, 1))
        steps = step_faults(self.step_error_in_sds(), error, coupled=self.proposal.coupled)
        verdict = Verdict((*self._weight_faults, *steps))
        return verdict.with_finite(self.mean(), self.standard_error())

    @property
    def _weight_faults(self) -> tuple[Fault, ...]:
        sizes = self.effective_sample_size, jnp.sum(self.log_weights > -jnp.inf, axis=-1)
        # With one simulated path for each bridge a lost path counts as a miss, and is not a fault.
        has_retries = self.num_simulated > self.met.shape[-1]
        missing = ~jnp.any(self.met, axis=-1) | (has_retries & jnp.any(~self.met, axis=-1))
        return (
            missing_bridges(missing, self.proposal.coupled),
            truncated_weights(jnp.any(self.truncated, axis=-1)),
            lost_paths(self.num_nonfinite, self.num_simulated, *sizes),
            *heavy_tails(self.pareto_k, *sizes),
        )

    def resample(self, key: Key[Array, ""], num_bridges: int) -> Float[Array, "*I m K d"]:
        """Sample m = `num_bridges` equally weighted paths by systematic resampling.

        The result has shape (m, K, d). The effective sample size should be large compared to m;
        otherwise many paths occur several times. The paths are NaN if there is no bridge.
        """
        num_bridges = check_count("num_bridges", num_bridges)

        check_key(key)

        def one_interval(key, weights, paths):
            # Systematic resampling uses one random shift for all points.
            shift = jax.random.uniform(key, dtype=weights.dtype)
            points = (jnp.arange(num_bridges, dtype=weights.dtype) + shift) / num_bridges
            cumulative = jnp.cumsum(weights)
            chosen = jnp.searchsorted(cumulative, points * cumulative[-1], side="right")
            # Rounding of the cumulative sum may select an index after the last positive weight.
            last = jnp.max(jnp.where(weights > 0, jnp.arange(len(weights)), 0))
            return paths[jnp.minimum(chosen, last)]

        if self.log_weights.ndim == 1:
            return one_interval(key, self.weights, self.paths)
        keys = jax.random.split(key, len(self.log_weights))
        return jax.vmap(one_interval)(keys, self.weights, self.paths)


@public_entry
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
    """Estimate weights that correct approximate bridges to the exact law (importance sampling).

    **Arguments:**

    - `key`: a typed key.
    - `model`: the model of the bridges.
    - `bridges`: the result of `sample_bridges`, with whole paths (no `save_at`).
    - `num_counts`: number of hitting counts for each bridge. More counts make a weight less noisy;
        one is often the most efficient.
    - `start_law`: μ; by default the start law of the bridges' coupling.
    - `max_trials`: bound on the trials of each bridge; by default 10,000 for each count. See
        `WeightedBridges.truncated`.
    - `batch_size`: number of trials that run side by side. It changes results by rounding only.
    - `progress_meter`: a progress meter of diffrax, for instance `diffrax.TextProgressMeter()`.
    - `throw`: raise an error at run time if the result is not `trustworthy`, or if a parameter is
        not finite.

    **Returns:** `WeightedBridges`. It is not differentiable.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

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
            f"`bridges` must come from `sample_bridges`; got {type(bridges).__name__}. "
            "Results of `sample_exact_bridges`, `weigh_bridges` and `sample_weighted_bridges` are "
            "exact already."
        )
    coupling = coupling_of_bridges(bridges, start_law)
    search = search_for_hits(bridges, num_counts, max_trials, batch_size, progress_meter)
    check_density(coupling.start_law, model)
    # Any row serves: only its dimension and dtype matter.
    like = bridges.reverse_start.reshape(-1, bridges.paths.shape[-1])[0]
    pairs = as_proposal(coupling, model, like, Budget(search.wanted, None, max_trials))
    weighted = _weigh_bridges(key_for("weights", key), model, pairs, bridges, search)
    return throw_where_untrustworthy(weighted, "log_weights", model) if throw else weighted


@compiled_for(lambda key, model, pairs, bridges, search: bridges.met.size * bridges.num_steps)
def _weigh_bridges(key, model, pairs, bridges, search):
    paths = bridges.paths.reshape(-1, *bridges.paths.shape[-2:])
    ends, durations = paths[:, -1], bridge_durations(bridges)
    coupling_for_weights = with_start_law(
        key, model, pairs.coupling, ends, durations, bridges.num_steps
    )
    counts, coupling = count_hits_of_bridges(key, model, coupling_for_weights, bridges, search)
    d, shape = bridges.paths.shape[-1], bridges.met.shape
    model = model.prepared()
    log_weights = pair_log_weights(
        coupling.start_law,
        model,
        bridges.paths[..., -1, :].reshape(-1, d),
        bridges.reverse_start.reshape(-1, d),
        counts.mean.reshape(-1),
    ).reshape(shape)
    # A weight that is NaN becomes zero, and the bridge is marked as truncated.
    log_weights, unusable = usable(log_weights, bridges.met)
    intervals = Intervals(paths[:, 0], ends, durations)
    log_halving = pairs.log_halving(model, intervals, paths, shape[-1]).reshape(shape)
    share = pairs.share_in_regime(model, intervals, bridges.num_steps)
    # The share is the same for all bridges of an interval.
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
        # The result contains the start law of its weights, with the measured burn-in.
        proposal=eqx.tree_at(lambda p: p.coupling, pairs, coupling),
        log_halving=log_halving,
        coarse_paths=None,
        step_share=share,
        num_steps=bridges.num_steps,
    )


@public_entry
def sample_weighted_bridges(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_bridges: int = 1000,
    num_steps: int = 50,
    proposal: ProposalLike = None,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    save_at: Numbers | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = False,
) -> WeightedBridges:
    """Sample independent weighted bridges from any proposal (importance sampling).

    **Arguments:**

    - `key`, `model`, `start`, `end`, `duration`, `num_steps`, `save_at`: as in `sample_bridges`.
    - `num_bridges`: n, the number of bridges of each interval.
    - `proposal`, `num_counts`, `max_proposals`, `max_trials`: as in `sample_exact_bridges`.
    - `progress_meter`: a progress meter of diffrax, for instance `diffrax.TextProgressMeter()`.
    - `throw`: raise an error at run time if the result is not `trustworthy`, or if a parameter is
        not finite.

    **Returns:** `WeightedBridges`.

    **Gradients.** Guided proposals are `ModifiedDiffusionBridge`, `ResidualBridge` and `Guided`.
    Their paths and weights are smooth functions of `params`, `start`, `end` and `duration`. So
    derivatives of weighted means, forward and reverse, estimate the derivatives of expectations. A
    choice between guided proposals is differentiable, too. For couplings, the default, and for a
    choice that may select them, a derivative raises `TypeError`.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

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
    proposal = as_proposal(proposal, model, problem.like, budget, normal_steps=False)
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
    weighted_paths = proposal.draw(
        problem.keys(key, num_bridges),
        model,
        intervals,
        num_steps,
        problem.stored,
        False,
        progress_meter=progress_meter,
    )
    results = problem.result(weighted_paths)
    return WeightedBridges(
        times=problem.times(proposal.fractions(num_steps)),
        paths=results.paths,
        log_weights=results.log_weights,
        met=results.found,
        truncated=results.truncated,
        num_simulated=problem.total(weighted_paths.num_simulated),
        num_nonfinite=problem.total(weighted_paths.num_nonfinite),
        proposal=proposal,
        log_halving=problem.result(weighted_paths.log_change),
        coarse_paths=results.coarse_paths,
        step_share=problem.result(proposal.share_in_regime(model, intervals, num_steps)),
        num_steps=num_steps,
    )
