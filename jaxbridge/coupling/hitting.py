"""Hitting counts: how many associated diffusions does it take to hit a bridge? (section 2.3)

    T(x) = min {i : the i-th associated diffusion hits x}

is geometric with mean 1/π(x), so the mean of N counts is an unbiased estimate of 1/π(x). The
counts of one bridge are the gaps between the hits in one sequence of independent trials: the
mean of N counts is the number of trials up to the N-th hit, divided by N.
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
from ..engine.doors import door
from ..engine.keys import key_for, numbered_keys
from ..engine.rejection import Attempts, Search, over_problems, rejection_sample
from ..engine.verdict import AbstractResult, Verdict, missing_bridges, truncated_weights
from ..models.diffusion import Diffusion, check_diffusion
from .associated import run_associated
from .base import AbstractCoupling
from .burn_in import with_burn_in
from .start_laws import AnyStartLaw, as_start_law, run_is_cut

# A count that takes longer than this is cut off, unless the user says otherwise.
_MAX_TRIALS_PER_COUNT = 10_000


@runtime_checkable
class BridgePaths(Protocol):
    """What has bridges in it: `Bridges`, `WeightedBridges` and `Chain`."""

    times: Array
    paths: Array
    met: Array
    num_steps: int

    @property
    def coupling(self) -> AbstractCoupling | None:
        """That which proposed them, if one did."""
        ...


class HittingCounts(AbstractResult):
    """What `hitting_counts` returns: counts of n bridges, or of I × n with a leading axis I.

    - `counts`: N independent counts for each bridge, shape (n, N); -1 where the trials ran out
        before the count was complete, and for a bridge that is missing.
    - `truncated`: whether the trials ran out, shape (n,). Also where they did not start from ν,
        because the run that replaces a sampler of it was cut off: see `Stationary`.
    - `num_trials`: how many there were in all, shape (n,).
    - `num_nonfinite`: how many of them left the finite numbers, which is no hit.
    - `start`: where the last trial that hit had started, shape (n, d).
    """

    counts: Int[Array, "*I n N"]
    truncated: Bool[Array, "*I n"]
    num_trials: Int[Array, "*I n"]
    num_nonfinite: Int[Array, "*I n"]
    start: Float[Array, "*I n d"]

    @property
    def verdict(self) -> Verdict:
        """Return the faults of each bridge: it is missing, or its trials ran out."""
        return Verdict((missing_bridges(self.num_trials == 0), truncated_weights(self.truncated)))

    @property
    def mean(self) -> Float[Array, "*I n"]:
        """ρ̂, the mean of the counts: an unbiased estimate of 1/π(x).

        Where the trials ran out, all of them divided by the hits, or their number if nothing
        hit: finite, and too small on average. NaN for a bridge that is missing.
        """
        hits = jnp.maximum(self._num_hits, 1).astype(self.start.dtype)
        mean = self.num_trials.astype(self.start.dtype) / hits
        return jnp.where(self.num_trials > 0, mean, jnp.nan)

    @property
    def probability(self) -> Float[Array, "*I n"]:
        """An unbiased estimate of the hitting probability π(x), (N - 1)/(Σ_j T_j - 1) for N
        counts (Haldane 1945); with N = 1, whether the first trial hit. NaN for a bridge that is
        missing."""
        hits, trials = self._num_hits, self.num_trials
        # Trials that ran out are a binomial sample, estimated by hits / trials.
        less = jnp.where(hits < self.counts.shape[-1], 0, 1)
        numerator, denominator = hits - less, trials - less
        certain = denominator <= 0  # one trial, one hit
        numerator, denominator = (
            value.astype(self.start.dtype)
            for value in (numerator, jnp.where(certain, 1, denominator))
        )
        ratio = jnp.where(certain & (hits > 0), 1, numerator / denominator)
        return jnp.where(trials > 0, ratio, jnp.nan)

    @property
    def standard_error(self) -> Float[Array, "*I n"]:
        """That of `probability`, about π √((1-π)/N), and about 1/N where no trial missed: N hits
        in N trials tell π from 1 no better than that. Infinite for fewer than three counts, of
        which nothing is known, as where the trials ran out without a hit."""
        hits, trials, probability = self._num_hits, self.num_trials, self.probability
        # The smallest share of misses that the trials tell from none is one of them.
        resolution = 1 / jnp.maximum(trials, 1).astype(probability.dtype)
        variance = probability**2 * jnp.maximum(1 - probability, resolution)
        error = jnp.sqrt(variance / jnp.maximum(hits - 2, 1).astype(variance.dtype))
        return jnp.where(hits > 2, error, jnp.inf)

    @property
    def _num_hits(self) -> Int[Array, "*I n"]:
        return jnp.sum(self.counts > 0, axis=-1, dtype=jnp.int32)


@door
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
    """Independent counts T(x) for each of the bridges, and so their hitting probabilities.

    **Arguments:**

    - `key`: a typed key.
    - `model`: the model the bridges were made with.
    - `bridges`: from `sample_bridges`, `weigh_bridges` or `sample_exact_bridges`, with their
        whole paths (no `save_at`).
    - `num_counts`: N, for each bridge.
    - `start_law`: μ, by default that of the bridges' coupling.
    - `max_trials`: bounds the trials of each bridge; by default 10,000 for each count.
    - `batch_size`: trials simulated side by side; changes results by rounding only.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.

    **Returns:** `HittingCounts`.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    **Example:**

    ```python
    counts = jb.hitting_counts(key, model, bridges, num_counts=10)
    counts.probability, counts.standard_error
    ```
    """
    check_key(key)
    check_diffusion(model)
    coupling = coupling_of(bridges, start_law)
    search = search_for_hits(bridges, num_counts, max_trials, batch_size, progress_meter)
    return _hitting_counts(key_for("hitting counts", key), model, coupling, bridges, search)


@compiled_for(lambda key, model, coupling, bridges, search: bridges.met.size * bridges.num_steps)
def _hitting_counts(key, model, coupling, bridges, search):
    return counts_of(key, model, coupling, bridges, search)[0]


def search_for_hits(
    bridges: BridgePaths,
    num_counts: int,
    max_trials: int | None,
    batch_size: int | None,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> Search:
    """What was asked for, checked, with what was not told."""
    num_counts = check_count("num_counts", num_counts)
    bound = check_max_trials(max_trials, num_counts)
    if batch_size is None:
        batch_size = default_lanes(bridges.paths, num_counts)
    return Search(num_counts, bound, check_count("batch_size", batch_size), progress_meter)


def default_lanes(paths: Float[Array, "*P points d"], num_counts: int) -> int:
    """Trials side by side, for so many counts of each of the paths."""
    *leading, points, _ = paths.shape
    return default_num_lanes(math.prod(leading) * num_counts, points - 1, paths)


def counts_of(
    key: Key[Array, ""],
    model: Diffusion,
    coupling: AbstractCoupling,
    bridges: BridgePaths,
    search: Search,
) -> tuple[HittingCounts, AbstractCoupling]:
    """Counts for all the bridges, and the coupling with its burn-in measured."""
    model, coupling, bridges = nondifferentiable((model.prepared(), coupling, bridges))
    shape, num_steps = bridges.met.shape, bridges.num_steps
    paths = bridges.paths.reshape(-1, *bridges.paths.shape[-2:])
    duration = durations_of(bridges)
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
    """Counts for each of P bridges that is active, from trials that share the lanes."""
    return over_problems(_count_hits, (keys, paths, duration, active), (model, coupling), search)


def _count_hits(each: tuple, shared: tuple, search: Search) -> HittingCounts:
    (keys, paths, duration, active), (model, coupling) = each, shared
    num_steps, num_counts = paths.shape[1] - 1, search.wanted
    trial = eqx.Partial(_trial, keys, model, coupling, paths, duration)
    num_rows = paths.shape[0] * num_counts
    rows = jnp.full((num_rows, paths.shape[2]), jnp.nan, paths.dtype)
    found = rejection_sample(trial, rows, active, search)
    number = found.number.reshape(-1, num_counts)
    before = jnp.concatenate([jnp.full_like(number[:, :1], -1), number[:, :-1]], axis=1)
    last = jnp.maximum(found.num_found - 1, 0)
    starts = found.outputs.reshape(*number.shape, -1)
    cut = run_is_cut(coupling.start_law, model, duration / num_steps, num_steps)
    return HittingCounts(
        jnp.where(number >= 0, number - before, -1),
        active & ((found.num_found < num_counts) | cut),
        found.num_trials,
        found.num_nonfinite,
        starts[jnp.arange(len(number)), last],
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
    num_steps = paths.shape[1] - 1
    made = run_associated(
        model,
        coupling,
        numbered_keys(keys, problem, number),
        jnp.moveaxis(paths[problem], 0, -1),
        duration[problem] / num_steps,
    )
    return Attempts(made.hit, made.finite, made.start.T)


def durations_of(bridges: BridgePaths) -> Float[Array, " P"]:
    """The duration of each of the I × n bridges."""
    duration = bridges.times[..., -1]
    if bridges.times.ndim == 2:
        duration = duration[:, None]
    return jnp.broadcast_to(duration, bridges.met.shape).reshape(-1)


def coupling_of(bridges: BridgePaths, start_law: AnyStartLaw | None) -> AbstractCoupling:
    """The coupling that proposed the bridges, with this start law if there is one.

    **Raises:** `TypeError` or `ValueError` for anything but bridges by a coupling at all steps of
    their grid.
    """
    if not isinstance(bridges, BridgePaths):
        raise TypeError(f"`bridges` must come from `sample_bridges`; got {type(bridges).__name__}.")
    if bridges.coupling is None:
        raise ValueError("`bridges` must have been proposed by a `Coupling`.")
    if bridges.paths.shape[-2] != bridges.num_steps + 1:
        raise ValueError(
            "whether a bridge is hit depends on its whole path, but these bridges were kept at "
            f"{bridges.paths.shape[-2]} of {bridges.num_steps + 1} grid points: sample them "
            "without `save_at`, or use `sample_exact_bridges`, which takes it."
        )
    if start_law is None:
        return bridges.coupling
    return eqx.tree_at(lambda c: c.start_law, bridges.coupling, as_start_law(start_law))


def check_max_trials(max_trials: int | None, num_counts: int) -> Int[Array, ""]:
    """The bound on the trials of a bridge."""
    return check_bound("max_trials", max_trials, _MAX_TRIALS_PER_COUNT * num_counts)
