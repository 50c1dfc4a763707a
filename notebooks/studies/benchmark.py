"""Benchmarks of speed. A ratio compares two times, measured in turns in one run.

- Calls are compared with drawing the same random numbers by the same generator (the floor),
  with a vectorised NumPy version, and with the paper's discretisation at equal accuracy.
- The proposals of the package are compared with each other.
- First calls are measured in seconds. Most of this time is compilation.

Results are stored as JSON with the device, the versions and the date. The tables of
`notebooks/costs.md` are made from that file.
"""

import datetime
import json
import math
import os
import platform
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Key

import jaxbridge as jb
from jaxbridge.coupling.join import Inputs, propose
from jaxbridge.engine.batch_size import most_lanes
from jaxbridge.models.bridge_problem import Intervals
from jaxbridge.studies.clock import in_turns
from jaxbridge.studies.exact import UNLIKELY
from jaxbridge.studies.paper import study_model
from jaxbridge.studies.report import Say, Study, Table, markdown, silent, table

from .accuracy import run_sigma_costs, sigma_table
from .crossover import DURATIONS, LONG, Process, Rate, crossover_table, processes, run_crossover
from .first_calls import ENTRIES, FirstCall, first_calls_table, run_first_calls
from .numpy_reference import approximate_bridges
from .peers import versions

_NUM_STEPS = 50
# Divisors of the number of proposals, about as many as the package runs side by side, on a CPU and
# on an accelerator.
_LANES = 6_250, 50_000
_TARGETS = (0.1, 0.05)


class Ratio(NamedTuple):
    """Two times in seconds, medians of runs in turns, what they are of, and the target of their
    ratio, where there is one."""

    what: str
    against: str
    seconds: float
    reference_seconds: float
    target: float | None

    @property
    def ratio(self) -> float:
        return self.seconds / self.reference_seconds


class Benchmark(NamedTuple):
    """All results, with where and when they were found."""

    device: str
    processor: str
    versions: dict[str, str]
    date: str
    ratios: list[Ratio]
    sigmas: list[tuple[int, float, float]]
    rates: list[Rate]
    first_calls: list[FirstCall]


def run_benchmark(
    key: Key[Array, ""],
    scale: float = 1.0,
    durations: Sequence[float] = DURATIONS,
    chosen: Sequence[Process] | None = None,
    dimensions: Sequence[int] = (2, 5, 10),
    entries: Sequence[str] = tuple(ENTRIES),
    say: Say = silent,
) -> Benchmark:
    """All parts; `scale` shortens them."""
    lanes = _lanes()
    num_proposals = max(lanes, round(50_000 * scale / lanes) * lanes)
    ratios = []
    for gamma in (-1.0, 0.5):
        for scheme, target in ((jb.Euler(), 1.3), (jb.Heun(), 1.6)):
            say(f"proposals, gamma {gamma:g}, {type(scheme).__name__}")
            ratios.append(_proposals(key, gamma, scheme, num_proposals, target))
    for gamma in (-1.0, 0.5):
        say(f"sample_bridges, gamma {gamma:g}")
        ratios.append(_whole_call(key, gamma, num_proposals))
    say("a batch of intervals")
    ratios.append(_batch(key, max(50, round(1_000 * scale))))
    say("NumPy")
    ratios.append(_against_numpy(key, num_proposals))
    say("the paper's discretisation at equal accuracy")
    ratios += _against_published(key, round(100_000 * scale))
    num_bridges = max(1_000, round(20_000 * scale))
    sigmas = run_sigma_costs(key, num_bridges, dimensions, say)
    rates = run_crossover(key, round(1e7 * scale), durations, chosen, say)
    first_calls = run_first_calls(entries, say)
    packages = ("jaxbridge", "jax", "jaxlib", "diffrax", "equinox", "numpy")
    return Benchmark(
        jax.devices()[0].device_kind,
        f"{platform.machine()}, {num_cores()} cores",
        versions(packages) | {"python": platform.python_version()},
        datetime.date.today().isoformat(),
        ratios,
        sigmas,
        rates,
        first_calls,
    )


def _lanes() -> int:
    return max(lanes for lanes in _LANES if lanes <= most_lanes(2))


def draw_floor(own_noise: bool, num_proposals: int) -> Callable[[Key[Array, ""]], Any]:
    """Draws the random numbers of so many proposals and nothing else: for each step two normals,
    one more for dU, and a uniform number for the meeting."""

    @jax.jit
    def draw(key):
        keys = jax.random.split(key, 3)
        normals = jax.random.normal(keys[0], (_NUM_STEPS, 2, num_proposals))
        uniforms = jax.random.uniform(keys[1], (_NUM_STEPS, num_proposals))
        if not own_noise:
            return normals, uniforms
        return normals, uniforms, jax.random.normal(keys[2], (_NUM_STEPS, num_proposals))

    return draw


def _proposals(
    key: Key[Array, ""], gamma: float, scheme: jb.AbstractScheme, num_proposals: int, target: float
) -> Ratio:
    """Joined paths of all proposals, met or not, against their random numbers."""
    model, coupling, lanes = study_model(), jb.Coupling(gamma, scheme=scheme), _lanes()

    @jax.jit
    def simulate(key):
        prepared = model.prepared()
        start, end = (
            jnp.broadcast_to(jnp.asarray(point)[:, None], (2, lanes)) for point in UNLIKELY
        )
        intervals = Intervals(start, end, jnp.ones(lanes))

        def block(_, number):
            keys = jax.random.split(jax.random.fold_in(key, number), lanes)
            made = propose(Inputs(prepared, coupling, intervals), keys, _NUM_STEPS)
            return None, (made.paths, made.meeting_step)

        return lax.scan(block, None, jnp.arange(num_proposals // lanes))[1]

    draw = draw_floor(gamma > -1, num_proposals)
    return Ratio(
        f"{num_proposals:,} proposals, γ = {gamma:g}, {type(scheme).__name__}",
        "drawing their random numbers",
        *in_turns(lambda: simulate(key), lambda: draw(key)),
        target,
    )


def _likely_bridges(key: Key[Array, ""], coupling: jb.Coupling, num_bridges: int) -> jb.Bridges:
    return jb.sample_bridges(
        key,
        study_model(),
        [0.0, 0.0],
        [0.0, 0.0],
        1.0,
        num_bridges=num_bridges,
        num_steps=_NUM_STEPS,
        coupling=coupling,
    )


def _whole_call(key: Key[Array, ""], gamma: float, num_bridges: int) -> Ratio:
    """`sample_bridges` as a whole, for the likely bridge, against the random numbers of the
    proposals that it takes."""

    def sample():
        return _likely_bridges(key, jb.Coupling(gamma, scheme=jb.Euler()), num_bridges)

    num_proposals = int(sample().num_proposals)
    draw = draw_floor(gamma > -1, num_proposals)
    return Ratio(
        f"`sample_bridges`, {num_bridges:,} bridges, γ = {gamma:g}",
        f"drawing the random numbers of its {num_proposals:,} proposals",
        *in_turns(sample, lambda: draw(key)),
        1.8,
    )


def _batch(key: Key[Array, ""], num_intervals: int) -> Ratio:
    """One bridge for each of many pairs of end points, against the proposals' ideal cost: the sum
    of 1/p_i proposals at the price of one among very many."""
    model, coupling, trials = study_model(), jb.Coupling(0.5, scheme=jb.Euler()), 200
    start_keys, end_keys = jax.random.split(jax.random.key(1), (2, num_intervals))
    draws = jax.jit(jax.vmap(model.sample_stationary))
    start, end = draws(start_keys), draws(end_keys)

    def sample(num_bridges=1):
        return jb.sample_bridges(
            key,
            model,
            start,
            end,
            1.0,
            num_bridges=num_bridges,
            num_steps=_NUM_STEPS,
            coupling=coupling,
            save_at=[0.5] if num_bridges > 1 else None,
        )

    expected = float(jnp.sum(sample(trials).num_proposals / trials))

    def proposals():
        return _likely_bridges(key, coupling, 50_000)

    each = float(proposals().num_proposals)
    seconds, reference = in_turns(sample, proposals)
    return Ratio(
        f"one bridge for each of {num_intervals:,} pairs of end points",
        f"the time of their {expected:,.0f} expected proposals",
        seconds,
        reference * expected / each,
        3.0,
    )


def _against_numpy(key: Key[Array, ""], num_proposals: int) -> Ratio:
    """The same method in NumPy, in single precision too."""
    model, B = study_model(), np.asarray(study_model().params.B)
    generator = np.random.default_rng(0)

    def in_numpy():
        ends = (np.array(UNLIKELY[0]), np.array(UNLIKELY[1]))
        return approximate_bridges(generator, B, *ends, 1.0, _NUM_STEPS, num_proposals, 0.5, True)

    wanted = in_numpy().shape[-1]

    def sample():
        return jb.sample_bridges(
            key,
            model,
            *UNLIKELY,
            1.0,
            num_bridges=wanted,
            num_steps=_NUM_STEPS,
            coupling=jb.Coupling(0.5, scheme=jb.Euler()),
        )

    return Ratio(
        f"`sample_bridges`, {wanted:,} bridges, γ = 0.5",
        "NumPy",
        *in_turns(sample, in_numpy, 5),
        None,
    )


def _against_published(key: Key[Array, ""], num_bridges: int) -> list[Ratio]:
    """Exact bridges by weights: Heun and the Brownian crossing against Euler and the sign test in
    radius 0.05 (from ν, without which no accuracy can be had), for some accuracies."""
    ours = jb.Coupling(0.5, scheme=jb.Heun())
    published = jb.Coupling(0.5, jb.SignTest(0.05), jb.Euler())
    found = [
        jb.work_precision(
            key,
            study_model(),
            *UNLIKELY,
            1.0,
            proposals=[coupling],
            num_steps=steps,
            methods=("weights",),
            num_bridges=num_bridges,
        )
        for coupling, steps in ((ours, (6, 10, 20)), (published, (20, 40, 80, 160)))
    ]
    ratios = []
    for target in _TARGETS:
        best, other = (min(s.seconds_for(target) for s in result.settings) for result in found)
        what = f"mean half way with error {target:g} sd, Heun and crossing"
        ratios.append(Ratio(what, "Euler and the sign test, radius 0.05", best, other, None))
    return ratios


def num_cores() -> int:
    """Those that this process may use."""
    usable = getattr(os, "sched_getaffinity", None)  # not on every system
    return len(usable(0)) if usable else os.cpu_count() or 1


def as_files(benchmark: Benchmark) -> dict[str, str]:
    """Return all results as JSON, and as a line of the history, by file name."""
    content = benchmark._asdict()
    for name in ("ratios", "rates", "first_calls"):
        content[name] = [row._asdict() for row in content[name]]
    return {
        "benchmark.json": json.dumps(content, indent=1, ensure_ascii=False) + "\n",
        "benchmark_history.jsonl": json.dumps(content, ensure_ascii=False) + "\n",
    }


def load(path: Path) -> Benchmark:
    """Read the file of `as_files`."""
    content = json.loads(path.read_text(encoding="utf-8"))
    content["ratios"] = [Ratio(**row) for row in content["ratios"]]
    content["rates"] = [Rate(**row) for row in content["rates"]]
    content["first_calls"] = [FirstCall(**row) for row in content["first_calls"]]
    content["sigmas"] = [tuple(row) for row in content["sigmas"]]
    return Benchmark(**content)


def tables(benchmark: Benchmark) -> list[Table]:
    """Calls, a full σ(x), proposals over durations, and first calls: titles and rows."""
    calls = [
        (
            r.what,
            r.against,
            _seconds(r.seconds),
            _ratio(r),
            "" if r.target is None else f"{r.target:g}",
        )
        for r in benchmark.ratios
    ]
    return [
        (("call", "compared with", "time", "ratio", "limit"), calls),
        sigma_table(benchmark.sigmas),
        crossover_table(benchmark.rates),
        first_calls_table(benchmark.first_calls),
    ]


def _ratio(r: Ratio) -> str:
    if math.isfinite(r.seconds) and math.isfinite(r.reference_seconds):
        return f"{r.ratio:.2g}"
    return "-" if math.isfinite(r.reference_seconds) else "not reached"


def _seconds(value: float) -> str:
    return f"{value:.2g} s" if math.isfinite(value) else "not reached"


def in_plain_characters(benchmark: Benchmark) -> str:
    """The tables as they are printed."""
    return "\n\n".join(
        table(*each, words) for each, words in zip(tables(benchmark), (2, 0, 2, 1), strict=True)
    )


def in_markdown(benchmark: Benchmark) -> str:
    """Device, versions and date, and the tables, as the pages show them."""
    head = (benchmark.device, benchmark.processor, f"JAX {benchmark.versions['jax']}")
    return "\n\n".join(
        [f"{', '.join(head)}, {benchmark.date}:", *(markdown(*each) for each in tables(benchmark))]
    )


def _run(key, quick, say) -> Benchmark:
    if quick:
        few = tuple(ENTRIES)[:1]
        return run_benchmark(key, 0.04, (0.05,), processes()[:1], (2,), few, say)
    return run_benchmark(key, say=say)


BENCHMARK = Study(
    "How fast it is",
    _run,
    in_plain_characters,
    """\
Calls: "ratio" is the time of the call over the time of the comparison.
Full sigma(x): nanoseconds per path and step, with sigma = I and with a full sigma(x).
Durations: thousands of effective samples per second, without compilation. A run has 200,000
proposals of 50 steps (T up to 1), or 20,000 of 1,000 steps (from T = 5 on); couplings alone have
fewer. Steps of this linear model are exact for all. "auto" includes its pilot runs.
First calls: seconds of the first call in a process, of a second call, and of a first call with
programs on disk; programs compiled; memory maps that they keep.""",
    lambda figures, made: {"crossover.png": figures.crossover(made.rates, LONG)},
    as_files,
)
