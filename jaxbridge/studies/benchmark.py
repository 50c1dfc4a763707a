"""How fast it is: ratios, each of two times taken in turns in one run.

Against drawing the same random numbers with the same generator, which is the floor; against a
vectorised NumPy version of the same method; against the paper's discretisation at equal
accuracy; and the package's proposals against each other. Results are kept as JSON with the
device, the versions and the date, and the README's table is made from that file.
"""

import datetime
import json
import math
import os
import platform
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Key

from ..coupling.bridges import Bridges, sample_bridges
from ..coupling.gamma import Coupling
from ..coupling.join import propose
from ..coupling.meeting import SignTest
from ..schemes.base import AbstractScheme
from ..schemes.euler import Euler
from ..schemes.heun import Heun
from ..tuning.work_precision import work_precision
from .accuracy import run_sigma_costs
from .crossover import Process, Rate, run_crossover, share_of_best, thousands
from .exact import UNLIKELY
from .numpy_bridges import approximate_bridges
from .paper import study_model

_NUM_STEPS = 50
DURATIONS = (0.05, 0.25, 1.0, 5.0, 20.0, 50.0)
# A divisor of the number of proposals, about as many as the package runs side by side.
_LANES = 6_250
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


def run_benchmark(
    key: Key[Array, ""],
    scale: float = 1.0,
    durations: Sequence[float] = DURATIONS,
    chosen: Sequence[Process] | None = None,
    dimensions: Sequence[int] = (2, 5, 10),
    on_start: Callable[[str], None] = lambda what: None,
) -> Benchmark:
    """All parts; `scale` shortens them."""
    num_proposals = max(_LANES, round(50_000 * scale / _LANES) * _LANES)
    ratios = []
    for gamma in (-1.0, 0.5):
        for scheme, target in ((Euler(), 1.3), (Heun(), 1.6)):
            on_start(f"proposals, gamma {gamma:g}, {type(scheme).__name__}")
            ratios.append(_proposals(key, gamma, scheme, num_proposals, target))
    for gamma in (-1.0, 0.5):
        on_start(f"sample_bridges, gamma {gamma:g}")
        ratios.append(_whole_call(key, gamma, num_proposals))
    on_start("a batch of intervals")
    ratios.append(_batch(key, max(50, round(1_000 * scale))))
    on_start("NumPy")
    ratios.append(_against_numpy(key, num_proposals))
    on_start("the paper's discretisation at equal accuracy")
    ratios += _against_published(key, round(100_000 * scale))
    num_bridges = max(1_000, round(20_000 * scale))
    sigmas = run_sigma_costs(key, num_bridges, dimensions, on_start)
    rates = run_crossover(key, round(1e7 * scale), durations, chosen, on_start)
    packages = ("jaxbridge", "jax", "jaxlib", "diffrax", "equinox", "numpy")
    return Benchmark(
        jax.devices()[0].device_kind,
        f"{platform.machine()}, {_num_cores()} cores",
        {name: version(name) for name in packages} | {"python": platform.python_version()},
        datetime.date.today().isoformat(),
        ratios,
        sigmas,
        rates,
    )


def in_turns(
    first: Callable[[], Any], second: Callable[[], Any], repeats: int = 9
) -> tuple[float, float]:
    """The median times of two functions, run in turns, once compiled."""
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(repeats + 1):
        for function, taken in zip((first, second), times, strict=True):
            begin = time.perf_counter()
            jax.block_until_ready(function())
            taken.append(time.perf_counter() - begin)
    return float(np.median(times[0][1:])), float(np.median(times[1][1:]))


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
    key: Key[Array, ""], gamma: float, scheme: AbstractScheme, num_proposals: int, target: float
) -> Ratio:
    """Joined paths of all proposals, met or not, against their random numbers."""
    model, coupling = study_model(), Coupling(gamma, scheme=scheme)

    @jax.jit
    def simulate(key):
        prepared = model.prepared()
        start, end = (
            jnp.broadcast_to(jnp.asarray(point)[:, None], (2, _LANES)) for point in UNLIKELY
        )
        dt = jnp.full(_LANES, 1 / _NUM_STEPS)

        def block(_, number):
            keys = jax.random.split(jax.random.fold_in(key, number), _LANES)
            made = propose(prepared, coupling, keys, start, end, dt, _NUM_STEPS)
            return None, (made.paths, made.meeting_step)

        return lax.scan(block, None, jnp.arange(num_proposals // _LANES))[1]

    draw = draw_floor(gamma > -1, num_proposals)
    return Ratio(
        f"{num_proposals:,} proposals, γ = {gamma:g}, {type(scheme).__name__}",
        "drawing their random numbers",
        *in_turns(lambda: simulate(key), lambda: draw(key)),
        target,
    )


def _likely_bridges(key: Key[Array, ""], coupling: Coupling, num_bridges: int) -> Bridges:
    return sample_bridges(
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
        return _likely_bridges(key, Coupling(gamma, scheme=Euler()), num_bridges)

    num_proposals = int(sample().num_proposals)
    draw = draw_floor(gamma > -1, num_proposals)
    return Ratio(
        f"`sample_bridges`, {num_bridges:,} bridges, γ = {gamma:g}",
        f"drawing the random numbers of the {num_proposals:,} proposals that takes",
        *in_turns(sample, lambda: draw(key)),
        1.8,
    )


def _batch(key: Key[Array, ""], num_intervals: int) -> Ratio:
    """One bridge for each of many pairs of end points, against the proposals' ideal cost: the sum
    of 1/p_i proposals at the price of one among very many."""
    model, coupling, trials = study_model(), Coupling(0.5, scheme=Euler()), 200
    start_keys, end_keys = jax.random.split(jax.random.key(1), (2, num_intervals))
    draws = jax.jit(jax.vmap(model.sample_stationary))
    start, end = draws(start_keys), draws(end_keys)

    def sample(num_bridges=1):
        return sample_bridges(
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
        f"the price of their {expected:,.0f} expected proposals",
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
        return sample_bridges(
            key,
            model,
            *UNLIKELY,
            1.0,
            num_bridges=wanted,
            num_steps=_NUM_STEPS,
            coupling=Coupling(0.5, scheme=Euler()),
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
    ours, published = Coupling(0.5), Coupling(0.5, SignTest(0.05), Euler())
    found = [
        work_precision(
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


def _num_cores() -> int:
    usable = getattr(os, "sched_getaffinity", None)  # not on every system
    return len(usable(0)) if usable else os.cpu_count() or 1


def save(benchmark: Benchmark, path: Path) -> None:
    """Everything as JSON."""
    content = benchmark._asdict()
    for name in ("ratios", "rates"):
        content[name] = [row._asdict() for row in content[name]]
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def load(path: Path) -> Benchmark:
    """What `save` wrote."""
    content = json.loads(path.read_text())
    content["ratios"] = [Ratio(**row) for row in content["ratios"]]
    content["rates"] = [Rate(**row) for row in content["rates"]]
    content["sigmas"] = [tuple(row) for row in content["sigmas"]]
    return Benchmark(**content)


def format_ratios(benchmark: Benchmark) -> str:
    """The ratios in plain characters."""
    lines = []
    for r in benchmark.ratios:
        goal = "" if r.target is None else f"  (at most {r.target:g})"
        lines += [f"{r.what}\n    against {r.against}: {_times(r)}{goal}"]
    return "\n".join(lines)


def _times(r: Ratio) -> str:
    if not (math.isfinite(r.seconds) and math.isfinite(r.reference_seconds)):
        return f"{_seconds(r.seconds)} / {_seconds(r.reference_seconds)}"
    return f"{r.seconds:.3g} s / {r.reference_seconds:.3g} s = {r.ratio:.3g}"


def _seconds(value: float) -> str:
    return f"{value:.2g} s" if math.isfinite(value) else "not reached"


def markdown(benchmark: Benchmark) -> str:
    """The README's tables."""
    versions = benchmark.versions
    lines = [
        f"{benchmark.device}, {benchmark.processor}, JAX {versions['jax']}, {benchmark.date}:",
        "",
        "| call | takes | against | ratio |",
        "|---|---|---|---|",
    ]
    for r in benchmark.ratios:
        both = math.isfinite(r.seconds) and math.isfinite(r.reference_seconds)
        ratio = f"{r.ratio:.2g}" if both else "-"
        against = r.against if both else f"{r.against}: {_seconds(r.reference_seconds)}"
        lines.append(f"| {r.what} | {_seconds(r.seconds)} | {against} | {ratio} |")
    lines += [
        "",
        "| σ(x), d = | ns a path and step, σ = I | full σ(x) | ratio |",
        "|---|---|---|---|",
    ]
    for d, one, full in benchmark.sigmas:
        lines.append(f"| {d} | {one:.0f} | {full:.0f} | {full / one:.1f} |")
    durations = list(dict.fromkeys(rate.duration for rate in benchmark.rates))
    head = " | ".join(f"T = {t:g}" if i == 0 else f"{t:g}" for i, t in enumerate(durations))
    lines += ["", f"| process | proposal | {head} |", "|---|---" + "|---" * len(durations) + "|"]
    for process in dict.fromkeys(rate.process for rate in benchmark.rates):
        group = [rate for rate in benchmark.rates if rate.process == process]
        table = {(rate.proposal, rate.duration): rate for rate in group}
        for i, proposal in enumerate(dict.fromkeys(rate.proposal for rate in group)):
            values = " | ".join(thousands(table[proposal, t]) for t in durations)
            name = proposal.strip('"')
            lines.append(f"| {process if i == 0 else ''} | {name} | {values} |")
        shares = " | ".join(f"{share_of_best(group, t):.2f}" for t in durations)
        lines.append(f"| | *auto / best* | {shares} |")
    return "\n".join(lines)
