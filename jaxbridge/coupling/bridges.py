"""Approximate bridges by rejection sampling (section 2.2): propose until the pair meets.

The proposals of an interval are numbered attempts (`rejection`). The j-th attempt whose pair meets
is the j-th bridge of the interval.
"""

import functools
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.batch_size import default_num_lanes
from ..engine.checks import Numbers, check_bound, check_count, check_key, without_derivatives
from ..engine.compiled import compiled_for
from ..engine.devices import over_devices
from ..engine.entry import public_entry
from ..engine.keys import attempt_keys
from ..engine.rejection import Accepted, Attempts, Search, over_problems, rejection_sample
from ..engine.verdict import AbstractResult, Verdict, missing_bridges, throw_where_untrustworthy
from ..models.bridge_problem import (
    BridgeProblem,
    Intervals,
    bridge_problem,
    uniform_fractions,
)
from ..models.diffusion import Diffusion
from ..schemes import check_model
from .base import AbstractCoupling, check_coupling
from .gamma import Coupling
from .join import Inputs, Proposals, propose


class Bridges(AbstractResult):
    """Result of `sample_bridges`: n approximate bridges in R^d.

    With I intervals arrays have a leading axis I. `times` has it only if there are I durations.

    - `times`: the K stored times, shape (K,). `save_at` selects them; by default they are the whole
        grid from 0 to the duration.
    - `paths`: the bridges, shape (n, K, d). A missing bridge is NaN at all times.
    - `met`: whether the bridge was found, shape (n,).
    - `meeting_step`: ρ, the first step at which the path follows the reversed path, between 1 and
        N; -1 for a missing bridge. Shape (n,).
    - `reverse_start`: the reversed path at time 0, shape (n, d); NaN for a missing bridge.
    - `num_proposals`: number of proposals up to the last bridge, or `max_proposals`, shape (). The
        number of bridges found divided by it estimates the acceptance probability.
    - `num_nonfinite`: number of these proposals that became non-finite (NaN, infinite or beyond
        1e18), shape (). They are rejected.
    - `coupling`, `num_steps`: the coupling and the number N of steps of the proposals.
    """

    times: Float[Array, "*durations K"]
    paths: Float[Array, "*I n K d"]
    met: Bool[Array, "*I n"]
    meeting_step: Int[Array, "*I n"]
    reverse_start: Float[Array, "*I n d"]
    num_proposals: Int[Array, "*I"]
    num_nonfinite: Int[Array, "*I"]
    coupling: AbstractCoupling
    num_steps: int = eqx.field(static=True)

    @property
    def verdict(self) -> Verdict:
        """Return the only possible fault of approximate bridges: missing bridges."""
        return Verdict((missing_bridges(jnp.any(~self.met, axis=-1)),))


@public_entry
def sample_bridges(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_bridges: int = 1,
    num_steps: int = 50,
    coupling: AbstractCoupling | None = None,
    max_proposals: Numbers | None = None,
    save_at: Numbers | None = None,
    batch_size: int | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = False,
) -> Bridges:
    """Sample independent approximate (start, end, duration)-bridges: section 2.2 of the paper.

    The law is that of the diffusion bridge, conditioned on a hit by its associated diffusion
    (Theorem 1). It is close to the exact law for likely end points, and closer for longer
    durations. The step size adds a discretisation error.

    **Arguments:**

    - `key`: a typed key, `jax.random.key(...)`.
    - `model`: the diffusion. Its time reversal must be known, and σ must be invertible.
    - `start`, `end`: points, shape (d,), or shape (I, d) for I intervals. The paths have the widest
        floating point type of `start`, `end` and `duration`.
    - `duration`: the length of the interval, in units of time, shape () or (I,).
    - `num_bridges`: n, the number of bridges of each interval.
    - `num_steps`: N, the number of steps, so δ = duration / N. Compile time does not grow with it.
    - `coupling`: by default `Coupling(gamma=0.0)`.
    - `max_proposals`: bound on the proposals of each interval. The default is 1,000 for each
        bridge, and at least 100,000.
    - `save_at`: the stored times, shape (K,): increasing grid points in [0, duration]. With several
        durations these are fractions of the duration. By default the whole grid is stored.
    - `batch_size`: number of proposals that run side by side. It bounds memory, and changes results
        by rounding only. The default is one for each bridge, at least 64, and fewer if their paths
        would take more than 16 MiB on a CPU device or 1 GiB on an accelerator. (The paths of up to
        256 proposals may take 512 MiB.)
    - `progress_meter`: a progress meter of diffrax, for instance `diffrax.TextProgressMeter()`.
    - `throw`: raise an error at run time if a bridge is missing or a parameter is not finite.

    **Returns:** `Bridges`.

    **Gradients** of the paths with respect to `params`, `start`, `end` and `duration` exist in
    forward and reverse mode, at fixed noise and fixed meeting step. If a derivative is requested,
    the accepted paths are simulated again from their keys. These gradients are *not* derivatives of
    expectations over bridges, because the parameters also decide whether a pair meets.

    **Raises:** `ValueError` and `TypeError` for invalid arguments, and `ValueError` for a model
    without time reversal. Traced values are not checked.

    **Example:**

    ```python
    bridges = jb.sample_bridges(key, model, [0.0, 0.0], [1.0, 0.0], 1.0, num_bridges=100)
    bridges.paths.shape, 100 / bridges.num_proposals  # (100, 51, 2) and the acceptance rate
    ```
    """
    coupling = Coupling() if coupling is None else coupling
    check_coupling(coupling)
    check_key(key)
    problem = bridge_problem(model, start, end, duration, num_steps)
    num_bridges = check_count("num_bridges", num_bridges)
    check_model(model, problem.intervals, coupling.scheme)
    model.check_reversal()
    # Proposals use a uniform grid, so `save_at` refers to its fractions.
    problem = problem.keep(save_at, duration, uniform_fractions(num_steps))
    max_proposals = check_bound("max_proposals", max_proposals, max(1_000 * num_bridges, 100_000))
    if batch_size is None:
        num_wanted = num_bridges * problem.num_intervals
        batch_size = default_num_lanes(num_wanted, num_steps, problem.intervals.start)
    batch_size = check_count("batch_size", batch_size)
    search = Search(num_bridges, max_proposals, batch_size, progress_meter)
    bridges = _sample_bridges(key, model, coupling, problem, search)
    return throw_where_untrustworthy(bridges, "paths", model) if throw else bridges


@compiled_for(lambda key, model, coupling, problem, search: problem.num_path_steps(search.wanted))
def _sample_bridges(
    key: Key[Array, ""],
    model: Diffusion,
    coupling: AbstractCoupling,
    problem: BridgeProblem,
    search: Search,
) -> Bridges:
    num_intervals, num_steps, stored = problem.num_intervals, problem.num_steps, problem.stored
    num_bridges = search.wanted
    # One key for each interval. The number of an attempt gives the key of that attempt.
    keys = problem.keys(key, 1)[:, 0]
    inputs = Inputs(model.prepared(), coupling, problem.intervals)
    all_active = jnp.ones(num_intervals, bool)
    # The replay below supplies the derivatives, so none pass through the search.
    search_result = find_bridges(
        keys, without_derivatives(inputs), all_active, num_steps, stored, search
    )
    paths, reverse_start, rho = search_result.outputs
    # ρ = N + 1 marks a row without a bridge.
    met = rho <= num_steps
    # Rows are ordered by interval, with n rows for each.
    interval = jnp.repeat(jnp.arange(num_intervals), num_bridges)
    # An empty row has the number -1. It uses the number 0, and its path is masked below.
    accepted = (keys, interval, jnp.maximum(search_result.number, 0), stored, rho)
    paths = _with_replayed_tangents(inputs, accepted, paths, num_steps)
    paths = jnp.where(met[:, None, None], paths, jnp.nan)

    def by_interval(rows):
        return problem.result(rows.reshape(num_intervals, num_bridges, *rows.shape[1:]))

    return Bridges(
        problem.times(uniform_fractions(num_steps)),
        by_interval(paths),
        by_interval(met),
        by_interval(jnp.where(met, rho, -1)),
        by_interval(reverse_start),
        problem.result(search_result.num_trials),
        problem.result(search_result.num_nonfinite),
        coupling,
        num_steps,
    )


class Joined(NamedTuple):
    """Accepted proposals, one in each row: path, X_0 and ρ; ρ = N + 1 marks an empty row."""

    paths: Float[Array, "rows K d"]
    reverse_start: Float[Array, "rows d"]
    meeting_step: Int[Array, " rows"]


def find_bridges(
    keys: Key[Array, " P"],
    inputs: Inputs,
    active: Bool[Array, " P"],
    num_steps: int,
    stored: Int[Array, " K"] | None,
    search: Search,
) -> Accepted:
    """Propose bridges for P problems until each active one has as many as `search` wants.

    A problem is an interval with a key. The outputs of the result are `Joined`.
    """
    problems, shared = (keys, inputs.intervals, active), (inputs.model, inputs.coupling, stored)
    return over_problems(functools.partial(_find_bridges, num_steps), problems, shared, search)


def _find_bridges(num_steps: int, problems: tuple, shared: tuple, search: Search) -> Accepted:
    (keys, intervals, active), (model, coupling, stored) = problems, shared
    inputs = Inputs(model, coupling, intervals)
    attempt = eqx.Partial(_attempt, inputs, keys, num_steps, stored)
    (num_problems, d), dtype = inputs.intervals.start.shape, inputs.intervals.start.dtype
    # Initial rows mark missing bridges: NaN starts and ρ = N + 1.
    num_rows = num_problems * search.wanted
    num_stored = num_steps + 1 if stored is None else stored.shape[0]
    rows = Joined(
        jnp.zeros((num_rows, num_stored, d), dtype),
        jnp.full((num_rows, d), jnp.nan, dtype),
        jnp.full(num_rows, num_steps + 1, jnp.int32),
    )
    return rejection_sample(attempt, rows, active, search)


def _attempt(
    inputs: Inputs,
    keys: Key[Array, " P"],
    num_steps: int,
    stored: Int[Array, " K"] | None,
    problem: Int[Array, " lanes"],
    number: Int[Array, " lanes"],
) -> Attempts:
    # `propose` has lanes in the last axis, rejection sampling in the first.
    proposals = _propose_numbered(inputs, keys, problem, number, num_steps, stored)
    joined = Joined(
        jnp.moveaxis(proposals.paths, -1, 0), proposals.reverse_start.T, proposals.meeting_step
    )
    return Attempts(proposals.meeting_step <= num_steps, proposals.finite, joined)


def _propose_numbered(
    inputs: Inputs,
    keys: Key[Array, " I"],
    interval: Int[Array, " lanes"],
    number: Int[Array, " lanes"],
    num_steps: int,
    stored: Int[Array, " K"] | None,
    meeting_step: Int[Array, " lanes"] | None = None,
    time_scale: Float[Array, " lanes"] | float = 1.0,
) -> Proposals:
    """Return one proposal in each lane: proposal `number` of `interval`.

    Its random numbers depend only on the key of the interval and on `number`, so the same call
    reproduces it. With `meeting_step` the pair is joined at that step, and the meeting rule is
    ignored (see `propose`). `time_scale` multiplies the durations.
    """
    start, end, duration = inputs.intervals
    lanes = Intervals(start[interval].T, end[interval].T, duration[interval] * time_scale)
    lane_keys = attempt_keys(keys, interval, number)
    return propose(inputs._replace(intervals=lanes), lane_keys, num_steps, stored, meeting_step)


@eqx.filter_custom_jvp
def _with_replayed_tangents(inputs, accepted, paths, num_steps):
    """Return `paths`, with tangents from a replay of the accepted proposals.

    Rejection sampling is a `while_loop`, which has no reverse mode. A replay also skips the
    rejected proposals, which are most of the work.
    """
    return paths


@_with_replayed_tangents.def_jvp
def _replay_tangents(primals, tangents):
    inputs, (keys, interval, number, stored, rho), paths, num_steps = primals

    def replay(inputs):
        # An empty row replays a proposal of nearly zero duration, which stays finite. The caller
        # masks its tangent, but in reverse mode a masked infinity is 0 · ∞ = NaN.
        time_scale = jnp.where(rho <= num_steps, 1, 1e-12).astype(paths.dtype)
        replay_in_lanes = eqx.Partial(_replayed_paths, inputs, keys, num_steps, stored)
        return over_devices(replay_in_lanes, (0, 0, 0, 0))(interval, number, rho, time_scale)

    return paths, eqx.filter_jvp(replay, (inputs,), (tangents[0],))[1]


def _replayed_paths(
    inputs: Inputs,
    keys: Key[Array, " I"],
    num_steps: int,
    stored: Int[Array, " K"] | None,
    interval: Int[Array, " rows"],
    number: Int[Array, " rows"],
    rho: Int[Array, " rows"],
    time_scale: Float[Array, " rows"],
) -> Float[Array, "rows K d"]:
    proposals = _propose_numbered(
        inputs, keys, interval, number, num_steps, stored, rho, time_scale
    )
    return jnp.moveaxis(proposals.paths, -1, 0)
