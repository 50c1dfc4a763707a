"""Hitting counts: numbers of associated diffusions up to the first hit of a bridge (section 2.3).

The count

    T(x) = min {i : the i-th associated diffusion hits x}

is geometric with mean 1/π(x). So the mean of N counts is an unbiased estimate of 1/π(x).

All counts of a bridge come from one sequence of independent trials: a count is the gap between two
hits. The mean of N counts is therefore the number of trials up to the N-th hit, divided by N.
"""

import math
from typing import Protocol, runtime_checkable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.batch_size import default_num_lanes
from ..engine.checks import check_bound, check_count, check_key, nondifferentiable
from ..engine.compiled import compiled_for
from ..engine.entry import public_entry
from ..engine.keys import attempt_keys, key_for
from ..engine.rejection import Attempts, Search, over_problems, rejection_sample
from ..engine.verdict import AbstractResult, Verdict, missing_bridges, truncated_weights
from ..models.diffusion import Diffusion, check_diffusion
from .associated import run_associated
from .base import AbstractCoupling
from .burn_in import with_burn_in
from .start_laws import AnyStartLaw, as_start_law, run_is_cut

# Default bound on the trials of one count. Counts that would take longer are truncated.
_MAX_TRIALS_PER_COUNT = 10_000


@runtime_checkable
class BridgePaths(Protocol):
    """Interface of results that contain bridges: `Bridges`, `WeightedBridges` and `Chain`."""

    times: Array
    paths: Array
    met: Array
    num_steps: int

    @property
    def coupling(self) -> AbstractCoupling | None:
        """Return the coupling that proposed the bridges, or `None` for another proposal."""
        ...


class HittingCounts(AbstractResult):
    """Result of `hitting_counts`: counts for n bridges.

    With I intervals arrays have a leading axis I.

    - `counts`: N independent counts for each bridge, shape (n, N). An entry is -1 if the trials
        ended before that count was complete, or if the bridge is missing.
    - `truncated`: whether the trials ended early, shape (n,). It is also true if the run that
        replaces a sampler of ν was cut off, so that trials do not start from ν: see `Stationary`.
    - `num_trials`: number of trials up to the last hit, or up to `max_trials`, shape (n,).
    - `num_nonfinite`: number of these trials that became non-finite, which is no hit. Shape (n,).
    - `start`: initial state of the last trial that hit, shape (n, d); NaN without a hit.
    """

    counts: Int[Array, "*I n N"]
    truncated: Bool[Array, "*I n"]
    num_trials: Int[Array, "*I n"]
    num_nonfinite: Int[Array, "*I n"]
    start: Float[Array, "*I n d"]

    @property
    def verdict(self) -> Verdict:
        """Return the faults of each bridge: it is missing, or its counts are `truncated`."""
        return Verdict((missing_bridges(self.num_trials == 0), truncated_weights(self.truncated)))

    @property
    def mean(self) -> Float[Array, "*I n"]:
        """Return ρ̂, the mean of the counts: an unbiased estimate of 1/π(x), shape (n,).

        If the trials ended early, ρ̂ is their number divided by the number of hits, or their number
        if there was no hit. It is then finite and biased: too small on average if the bridge is
        rarely hit within `max_trials`, and always for N = 1. It is NaN for a missing bridge.
        """
        # Complete counts add up to `num_trials`, so both cases are one formula.
        hits = jnp.maximum(self._num_hits, 1).astype(self.start.dtype)
        mean = self.num_trials.astype(self.start.dtype) / hits
        return jnp.where(self.num_trials > 0, mean, jnp.nan)

    @property
    def probability(self) -> Float[Array, "*I n"]:
        """Return an unbiased estimate of the hitting probability π(x), shape (n,).

        It is (N - 1)/(Σ_j T_j - 1) for N counts T_j (Haldane 1945). For N = 1 it is 1 if the first
        trial hit, else 0. If the trials ended early, it is the share of hits among them. It is NaN
        for a missing bridge.
        """
        hits, trials = self._num_hits, self.num_trials
        # If the trials ended early, their number was fixed: a binomial sample, with estimate
        # hits / trials. Otherwise the last trial is a hit by construction and does not count.
        excluded = jnp.where(hits < self.counts.shape[-1], 0, 1)
        numerator, denominator = hits - excluded, trials - excluded
        certain = denominator <= 0  # one trial, one hit
        numerator, denominator = (
            value.astype(self.start.dtype)
            for value in (numerator, jnp.where(certain, 1, denominator))
        )
        ratio = jnp.where(certain & (hits > 0), 1, numerator / denominator)
        return jnp.where(trials > 0, ratio, jnp.nan)

    @property
    def standard_error(self) -> Float[Array, "*I n"]:
        """Return the standard error of `probability`, shape (n,): about π √((1-π)/N) for N hits.

        If all trials hit, it is about 1/N, because π may be that far below 1. It is infinite for
        fewer than three hits, which are too few for an estimate.
        """
        hits, trials, probability = self._num_hits, self.num_trials, self.probability
        # One miss in all trials is the smallest share of misses that is visible.
        resolution = 1 / jnp.maximum(trials, 1).astype(probability.dtype)
        variance = probability**2 * jnp.maximum(1 - probability, resolution)
        # N - 2 in place of N corrects for few hits.
        error = jnp.sqrt(variance / jnp.maximum(hits - 2, 1).astype(variance.dtype))
        return jnp.where(hits > 2, error, jnp.inf)

    @property
    def _num_hits(self) -> Int[Array, "*I n"]:
        # Incomplete counts are -1.
        return jnp.sum(self.counts > 0, axis=-1, dtype=jnp.int32)


@public_entry
def hitting_counts(
    key: Key[Array, ""],
    model: Diffusion,
    bridges: BridgePaths,
    num_counts: int = 1,
    *,
    start_law: AnyStartLaw | None = None,
    max_trials: int | None = None,
    batch_size: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> HittingCounts:
    """Count the associated diffusions up to a hit, N times for each bridge.

    π(x) is the probability that the diffusion associated with the bridge x hits x. The counts T(x)
    are independent, have the mean 1/π(x), and give estimates of π(x).

    **Arguments:**

    - `key`: a typed key.
    - `model`: the model of the bridges.
    - `bridges`: the result of `sample_bridges`, `weigh_bridges`, `sample_weighted_bridges` or
        `sample_exact_bridges`, for a `Coupling` and with whole paths (no `save_at`).
    - `num_counts`: N, the number of counts for each bridge.
    - `start_law`: μ; by default the start law of the bridges' coupling.
    - `max_trials`: bound on the trials of each bridge. The default is 10,000 for each count.
    - `batch_size`: number of trials that run side by side. It changes results by rounding only.
    - `progress_meter`: a progress meter of diffrax, for instance `diffrax.TextProgressMeter()`.

    **Returns:** `HittingCounts`. It is not differentiable.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    counts = jb.hitting_counts(key, model, bridges, num_counts=10)
    counts.probability, counts.standard_error
    ```
    """
    check_key(key)
    check_diffusion(model)
    coupling = coupling_of_bridges(bridges, start_law)
    search = search_for_hits(bridges, num_counts, max_trials, batch_size, progress_meter)
    return _hitting_counts(key_for("hitting counts", key), model, coupling, bridges, search)


@compiled_for(lambda key, model, coupling, bridges, search: bridges.met.size * bridges.num_steps)
def _hitting_counts(key, model, coupling, bridges, search):
    return count_hits_of_bridges(key, model, coupling, bridges, search)[0]


def search_for_hits(
    bridges: BridgePaths,
    num_counts: int,
    max_trials: int | None,
    batch_size: int | None,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> Search:
    """Return the `Search` for these arguments, with checks and default values."""
    num_counts = check_count("num_counts", num_counts)
    bound = check_max_trials(max_trials, num_counts)
    if batch_size is None:
        batch_size = default_lanes(bridges.paths, num_counts)
    return Search(num_counts, bound, check_count("batch_size", batch_size), progress_meter)


def default_lanes(paths: Float[Array, "*P points d"], num_counts: int) -> int:
    """Return the default number of trials side by side, for `num_counts` counts of each path."""
    *leading, points, _ = paths.shape
    return default_num_lanes(math.prod(leading) * num_counts, points - 1, paths)


def count_hits_of_bridges(
    key: Key[Array, ""],
    model: Diffusion,
    coupling: AbstractCoupling,
    bridges: BridgePaths,
    search: Search,
) -> tuple[HittingCounts, AbstractCoupling]:
    """Return counts for all bridges, and the coupling with its measured burn-in."""
    # Counts are discrete: a derivative raises an error, because it would be zero.
    model, coupling, bridges = nondifferentiable((model.prepared(), coupling, bridges))
    shape, num_steps = bridges.met.shape, bridges.num_steps
    paths = bridges.paths.reshape(-1, *bridges.paths.shape[-2:])
    duration = bridge_durations(bridges)
    # If the start law is ν and the model has no sampler, trials need runs of a measured length.
    coupling = with_burn_in(key, model, coupling, paths[:, -1], duration, num_steps)
    counts = count_hits(
        jax.random.split(key, len(paths)),
        model,
        coupling,
        paths,
        duration,
        bridges.met.reshape(-1),
        search,
    )
    counts = jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), counts)
    return counts, coupling


def count_hits(
    keys: Key[Array, " P"],
    model: Diffusion,
    coupling: AbstractCoupling,
    paths: Float[Array, "P points d"],
    duration: Float[Array, " P"],
    active: Bool[Array, " P"],
    search: Search,
) -> HittingCounts:
    """Count trials up to each hit, for each active one of P bridges.

    Trials of all bridges run in one batch.
    """
    return over_problems(_count_hits, (keys, paths, duration, active), (model, coupling), search)


def _count_hits(problems: tuple, shared: tuple, search: Search) -> HittingCounts:
    (keys, paths, duration, active), (model, coupling) = problems, shared
    num_steps, num_counts = paths.shape[1] - 1, search.wanted
    trial = eqx.Partial(_trial, keys, model, coupling, paths, duration)
    num_rows = paths.shape[0] * num_counts
    # One row for each hit: the initial state of its trial.
    rows = jnp.full((num_rows, paths.shape[2]), jnp.nan, paths.dtype)
    hits = rejection_sample(trial, rows, active, search)
    trial_number = hits.number.reshape(-1, num_counts)
    # A count is the gap between two hits in the sequence of trials, which begins with number 0.
    previous = jnp.concatenate(
        [jnp.full_like(trial_number[:, :1], -1), trial_number[:, :-1]], axis=1
    )
    last = jnp.maximum(hits.num_found - 1, 0)
    # Each output row is the initial state of a trial that hit.
    starts = hits.outputs.reshape(*trial_number.shape, -1)
    is_cut = run_is_cut(coupling.start_law, model, duration / num_steps, num_steps)
    return HittingCounts(
        jnp.where(trial_number >= 0, trial_number - previous, -1),
        active & ((hits.num_found < num_counts) | is_cut),
        hits.num_trials,
        hits.num_nonfinite,
        starts[jnp.arange(len(trial_number)), last],
    )


def _trial(
    keys: Key[Array, " P"],
    model: Diffusion,
    coupling: AbstractCoupling,
    paths: Float[Array, "P points d"],
    duration: Float[Array, " P"],
    problem: Int[Array, " lanes"],
    number: Int[Array, " lanes"],
) -> Attempts:
    """Run trial `number` of the bridge `problem` in each lane. The outputs are the initial
    states."""
    num_steps = paths.shape[1] - 1
    associated = run_associated(
        model,
        coupling,
        attempt_keys(keys, problem, number),
        jnp.moveaxis(paths[problem], 0, -1),
        duration[problem] / num_steps,
    )
    return Attempts(associated.hit, associated.finite, associated.start.T)


def bridge_durations(bridges: BridgePaths) -> Float[Array, " P"]:
    """Return the durations of the P = I × n bridges, one for each bridge."""
    duration = bridges.times[..., -1]
    if bridges.times.ndim == 2:
        # I durations, each shared by the n bridges of an interval.
        duration = duration[:, None]
    return jnp.broadcast_to(duration, bridges.met.shape).reshape(-1)


def coupling_of_bridges(bridges: BridgePaths, start_law: AnyStartLaw | None) -> AbstractCoupling:
    """Return the coupling that proposed the bridges, with `start_law` if it is not `None`.

    **Raises:** `TypeError` if `bridges` are not bridges; `ValueError` if no coupling proposed them,
    or if they are not stored at all steps of their grid.
    """
    if not isinstance(bridges, BridgePaths):
        raise TypeError(
            f"`bridges` must come from `sample_bridges`; got {type(bridges).__name__}. Pass the "
            "result of `sample_bridges`, `weigh_bridges`, `sample_weighted_bridges` or "
            "`sample_exact_bridges`."
        )
    if bridges.coupling is None:
        raise ValueError(
            "`bridges` must come from proposals by a `Coupling`; got bridges of another proposal. "
            "Sample them with a `Coupling`."
        )
    if bridges.paths.shape[-2] != bridges.num_steps + 1:
        raise ValueError(
            "`bridges` must be whole paths, because a hit may occur at any grid point; got "
            f"{bridges.paths.shape[-2]} of {bridges.num_steps + 1} grid points. Sample them "
            "without `save_at`. If you need exact bridges at some times only, use "
            "`sample_exact_bridges` with `save_at`: it corrects the bridges itself."
        )
    if start_law is None:
        return bridges.coupling
    return eqx.tree_at(lambda c: c.start_law, bridges.coupling, as_start_law(start_law))


def check_max_trials(max_trials: int | None, num_counts: int) -> Int[Array, ""]:
    """Return the bound on the trials of a bridge as an array; by default 10,000 for each count.

    **Raises:** as `check_bound`.
    """
    return check_bound("max_trials", max_trials, _MAX_TRIALS_PER_COUNT * num_counts)
