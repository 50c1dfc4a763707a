"""Which proposal is best for which duration: effective samples per second, on three processes.

An Ornstein–Uhlenbeck process, for which guided proposals are exact; the hyperbolic diffusion,
which is a Brownian motion with a bounded drift; and a double well, whose bridges must cross.
Each from a point to another, in times from a twentieth to fifty.
"""

import math
from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import jaxbridge as jb
from jaxbridge.proposals.auto import Budget, as_proposal, default_candidates
from jaxbridge.studies.clock import timed
from jaxbridge.studies.paper import Point, study_model
from jaxbridge.studies.report import Row, Say, Table

DURATIONS = (0.05, 0.25, 1.0, 5.0, 20.0, 50.0)
# Durations from which on there are more steps, and twice as many of them in all.
LONG = 5.0
# Couplings are slower: a share of the proposals will do, the more so on short intervals.
_COUPLED_SHARE, _LONG_COUPLED_SHARE = 0.04, 0.25
_MOST_TRIALS = 1_000
_REPEATS = 2


class Process(NamedTuple):
    """A process of the study, and its bridge."""

    name: str
    model: jb.Diffusion
    start: Point
    end: Point


class Rate(NamedTuple):
    """One proposal for one duration: effective samples per second once compiled, their share
    of the simulated paths, and log p̂_T with its standard error. Of "auto" `seconds` include the
    pilot runs, and `chosen` says what it took."""

    process: str
    duration: float
    proposal: str
    per_second: float
    share: float
    seconds: float
    log_density: float
    error: float
    chosen: str


def processes() -> list[Process]:
    """The three processes."""
    return [
        Process("Ornstein-Uhlenbeck", study_model(), (0.785, 0.785), (1.091, 1.091)),
        Process("hyperbolic", jb.hyperbolic(0.8, 2), (0.0, 0.0), (2.0, 1.0)),
        Process("double well", double_well(), (-1.0, 0.0), (0.8, 0.3)),
    ]


class _Well(NamedTuple):
    """The barrier, log ∫ν, and the distribution function of x_1 on the grid."""

    barrier: Float[Array, ""]
    log_normaliser: Float[Array, ""]
    distribution: Float[Array, " points"]


_GRID = np.linspace(-4, 4, 2001)


def double_well(barrier: float = 1.7) -> jb.Diffusion:
    """dX = ½∇log ν dt + dW with log ν = -barrier [(x_1² - 1)² + x_2²] + constant: two wells, and
    a barrier between them. Normalised, with a sampler, both by quadrature of x_1 on a grid."""
    return jb.Diffusion(
        _well_drift,
        None,
        _log_well,
        barrier,
        reversible=True,
        normalised=True,
        sample_stationary=_sample_well,
        prepare=_prepare_well,
    )


def _prepare_well(barrier: Float[Array, ""]) -> _Well:
    density = jnp.exp(-barrier * (_GRID**2 - 1) ** 2)
    distribution = jnp.cumsum(density)
    mass = distribution[-1] * (_GRID[1] - _GRID[0])
    log_normaliser = jnp.log(mass) + jnp.log(np.pi / barrier) / 2
    return _Well(barrier, log_normaliser, distribution / distribution[-1])


def _well_drift(x: Float[Array, " d"], p: _Well) -> Float[Array, " d"]:
    return -p.barrier * jnp.stack([2 * x[0] * (x[0] ** 2 - 1), x[1]])


def _log_well(x: Float[Array, " d"], p: _Well) -> Float[Array, ""]:
    return -p.barrier * ((x[0] ** 2 - 1) ** 2 + x[1] ** 2) - p.log_normaliser


def _sample_well(key: Key[Array, ""], p: _Well) -> Float[Array, " d"]:
    uniform_key, normal_key = jax.random.split(key)
    uniform = jax.random.uniform(uniform_key, dtype=p.distribution.dtype)
    first = jnp.interp(uniform, p.distribution, jnp.asarray(_GRID, uniform.dtype))
    second = jax.random.normal(normal_key, dtype=uniform.dtype) / jnp.sqrt(2 * p.barrier)
    return jnp.stack([first, second])


def run_crossover(
    key: Key[Array, ""],
    work: int,
    durations: Sequence[float],
    chosen: Sequence[Process] | None,
    say: Say,
) -> list[Rate]:
    """Each candidate of "auto", and "auto" itself, for each process and duration, in about `work`
    simulated steps of each run."""
    rates = []
    for process in processes() if chosen is None else chosen:
        candidates = [*default_candidates(process.model), "auto"]
        for duration in durations:
            runs = [_run(key, process, duration, candidate, work) for candidate in candidates]
            seconds = [math.inf] * len(runs)
            for turn in range(1 + _REPEATS):  # in turns, for clocks drift; the first compiles
                for i, (name, run) in enumerate(runs):
                    say(f"{process.name}, T = {duration:g}, {name}, run {turn}")
                    _, took = timed(run)
                    seconds[i] = min(seconds[i], took if turn > 0 else math.inf)
            for (name, run), took in zip(runs, seconds, strict=True):
                rates.append(_rate(process, duration, name, run(), took))
    return rates


def _run(
    key: Key[Array, ""], process: Process, duration: float, candidate: Any, work: int
) -> tuple[str, Callable[[], jb.TransitionLogDensity]]:
    """The name of a proposal, and its run."""
    coupled = isinstance(candidate, jb.Coupling)
    bound = _MOST_TRIALS if coupled else None
    start = jnp.asarray(process.start)
    budget = Budget(max_trials=bound)
    proposal = as_proposal(candidate, process.model, start, budget, for_density=True)
    num_steps, share = (50, _COUPLED_SHARE) if duration < LONG else (1_000, _LONG_COUPLED_SHARE)
    work = work if duration < LONG else 2 * work
    num_proposals = round(work / num_steps * (share if coupled else 1))

    def run():
        return jb.transition_log_density(
            key,
            process.model,
            process.start,
            process.end,
            duration,
            num_steps=num_steps,
            num_proposals=num_proposals,
            proposal=proposal,
        )

    return ('"auto"' if isinstance(candidate, str) else proposal.describe()), run


def _rate(
    process: Process, duration: float, name: str, estimate: jb.TransitionLogDensity, seconds: float
) -> Rate:
    effective = float(estimate.effective_sample_size)
    chosen, made = "", estimate.proposal
    if isinstance(made, jb.Choice):
        chosen = made.candidates[int(made.chosen[0])].describe()
    return Rate(
        process.name,
        duration,
        name,
        effective / seconds,
        effective / float(estimate.num_simulated),
        seconds,
        float(estimate.value),
        float(estimate.standard_error),
        chosen,
    )


def crossover_table(rates: Sequence[Rate]) -> Table:
    """Return the table of effective samples per second, in thousands, by proposal and duration.

    Two more rows have the share of "auto" in the best single proposal, and its selection.
    """
    durations = list(dict.fromkeys(rate.duration for rate in rates))
    rows: list[Row] = []
    for process, of_process in groupby(rates, key=lambda rate: rate.process):
        group = list(of_process)
        rate = {(r.proposal, r.duration): r for r in group}
        for proposal in dict.fromkeys(r.proposal for r in group):
            found = [thousands(rate[proposal, t]) for t in durations]
            rows.append((process, proposal.strip('"'), *found))
        shares = [f"{share_of_best(group, t):.2f}" for t in durations]
        rows.append((process, "auto / best", *shares))
        rows.append(
            (process, "auto selected", *(_short(rate['"auto"', t].chosen) for t in durations))
        )
    return ("process", "proposal", *(f"T = {t:g}" for t in durations)), rows


def share_of_best(rates: Sequence[Rate], duration: float) -> float:
    """Effective samples per second of "auto" beside the best single proposal."""
    here = {r.proposal: r.per_second for r in rates if r.duration == duration}
    auto = here.pop('"auto"')
    return auto / max(here.values())


def thousands(rate: Rate) -> str:
    """Thousands of effective samples per second, in two figures."""
    value = rate.per_second / 1e3
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _short(name: str) -> str:
    kind, _, rest = name.partition("(")
    return {"ModifiedDiffusionBridge": "MDB", "Coupling": f"C({rest}"}.get(kind, f"G({rest}")
