"""The simulation study of section 3: approximate Ornstein–Uhlenbeck bridges beside exact ones.

Three bridges on [0, 1] of the process with B = ((3/2, 1), (1, 3/2)), m = 0 and σ = I, in 50
steps, with growing γ, by the library's default method and by the paper's own. The law at time
1/2, where the bridge is felt most, is compared with the exact one.
"""

import itertools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Float, Key

from ..coupling.bridges import Bridges, sample_bridges
from ..coupling.gamma import Coupling
from ..models.diffusion import Diffusion
from ..models.gaussian_bridge import GaussianBridge, gaussian_bridge
from ..models.gaussian_law import GaussianLaw
from ..models.ornstein_uhlenbeck import ornstein_uhlenbeck

Point = tuple[float, float]


class Case(NamedTuple):
    """A bridge of the study, by the paper's word for it, and the γ of its coupling."""

    name: str
    start: Point
    end: Point
    gamma: float

    @property
    def bridge(self) -> str:
        """The end points, in words."""
        start, end = (f"({x:g}, {y:g})" for x, y in (self.start, self.end))
        return f"{start} -> {end}"


CASES = (
    Case("likely", (0.0, 0.0), (0.0, 0.0), -1.0),
    *(Case("unlikely", (0.785, 0.785), (1.091, 1.091), gamma) for gamma in (0.0, 0.5, 0.9, 0.95)),
    *(Case("very unlikely", (2.0, -2.0), (3.0, -3.0), gamma) for gamma in (0.5, 0.9, 0.99)),
)

METHODS: dict[str, Callable[[float], Coupling]] = {
    "default": Coupling,
    "as published": Coupling.as_published,
}


class Fit(NamedTuple):
    """How far draws are from an exact Gaussian law, margin by margin.

    `mean_bias`: mean less exact mean, in exact standard deviations. `sd_bias`: ratio of the
    standard deviations less one. `ks_distance`: Kolmogorov–Smirnov distance. Shape (d,) each.
    """

    mean_bias: Float[np.ndarray, " d"]
    sd_bias: Float[np.ndarray, " d"]
    ks_distance: Float[np.ndarray, " d"]


class Chance(NamedTuple):
    """What n draws of the exact law itself would show: the standard errors of both biases, and
    the distance that they exceed one time in 20."""

    mean_error: float
    sd_error: float
    ks_critical: float


class Result(NamedTuple):
    """One case by one method.

    `samples`, shape (n, 2), are the bridges at time 1/2 and `law` the exact law there.
    `acceptance` is the share of proposals that met. `seconds` is the time of the run once
    compiled; `compile_seconds` that of a first call that compiles it, if it was not at hand.
    """

    case: Case
    method: str
    samples: Float[np.ndarray, "n 2"]
    law: GaussianLaw
    fit: Fit
    acceptance: float
    seconds: float
    compile_seconds: float


def study_model() -> Diffusion:
    """The process of section 3.2."""
    return ornstein_uhlenbeck([[1.5, 1.0], [1.0, 1.5]])


def run_study(
    key: Key[Array, ""],
    num_bridges: int = 50_000,
    cases: Sequence[Case] = CASES,
    on_start: Callable[[int, int, str], None] = lambda index, total, what: None,
) -> list[Result]:
    """Every case by every method, in the order of the table.

    `on_start(index, total, what)` is called before each run, with `index` from 1 on.
    """
    runs = list(itertools.product(cases, METHODS))
    results = []
    for i, (case, method) in enumerate(runs):
        on_start(i + 1, len(runs), f"{case.bridge}, gamma {case.gamma:g}, {method}")
        results.append(run_case(jax.random.fold_in(key, i), case, method, num_bridges))
    return results


def run_case(key: Key[Array, ""], case: Case, method: str, num_bridges: int) -> Result:
    """Simulate one case by one method, and compare.

    **Raises:** `RuntimeError` where a bridge was not found or misses an end point.
    """
    model, coupling = study_model(), METHODS[method](case.gamma)

    def bridges(max_proposals: int | None) -> Bridges:
        return sample_bridges(
            key,
            model,
            case.start,
            case.end,
            1.0,
            num_bridges=num_bridges,
            num_steps=50,
            coupling=coupling,
            max_proposals=max_proposals,
            save_at=[0.0, 0.5, 1.0],
        )

    # The bound is traced: with one proposal the very program of the run is compiled, hardly run.
    _, compile_seconds = _timed(lambda: bridges(1))
    result, seconds = _timed(lambda: bridges(None))
    first, middle, last = np.moveaxis(np.asarray(result.paths), 1, 0)
    ends = np.array([case.start, case.end], first.dtype)
    if not (np.all(first == ends[0]) and np.all(last == ends[1])):
        raise RuntimeError(f"not all paths are bridges {case.bridge}: {case}, {method}.")
    exact = gaussian_bridge(model, case.start, case.end, 1.0, times=[0.5])
    law = GaussianLaw(exact.mean[0], exact.covariance[0])
    return Result(
        case,
        method,
        middle,
        law,
        compare(middle, law),
        num_bridges / int(result.num_proposals),
        seconds,
        compile_seconds,
    )


def compare(samples: Float[np.ndarray, "n d"], law: GaussianLaw) -> Fit:
    """Draws, margin by margin, against their exact law."""
    mean = np.asarray(law.mean, float)
    sd = np.sqrt(np.diag(np.asarray(law.covariance, float)))
    scores = (samples - mean) / sd
    distances = [ks_distance(score) for score in scores.T]
    return Fit(scores.mean(0), scores.std(0, ddof=1) - 1, np.array(distances))


def ks_distance(scores: Float[np.ndarray, " n"]) -> float:
    """The Kolmogorov–Smirnov distance between draws and N(0, 1)."""
    exact = np.asarray(ndtr(np.sort(scores)), float)
    empirical = np.arange(len(scores) + 1) / len(scores)
    return float(max(np.max(empirical[1:] - exact), np.max(exact - empirical[:-1])))


def chance(num_bridges: int) -> Chance:
    """What is due to chance with this many independent draws."""
    n = num_bridges
    return Chance(n**-0.5, (2 * n) ** -0.5, 1.36 * n**-0.5)


def format_table(results: Sequence[Result]) -> str:
    """The results as a table of 119 columns, in plain characters."""
    rule = "-" * 119
    row = "{:<32}  {:>5}  {:<12}  {:>6}  {:>7}  {:>7} {:>7}  {:>7} {:>7}  {:>6} {:>6}"
    wide = "{:<32}  {:>5}  {:<12}  {:>6}  {:>7}  {:^15}  {:^15}  {:^13}"
    titles = ("bridge", "gamma", "method", "met", "seconds", "(exact sd)", "(exact sd)", "(KS)")
    lines = [
        wide.format("", "", "", "share", "", "bias of mean", "bias of sd", "distance"),
        wide.format(*titles),
    ]
    for bridge, rows in itertools.groupby(results, key=lambda result: result.case.bridge):
        lines.append(rule)
        for result in rows:
            fit = result.fit
            biases = (f"{bias:+.4f}" for bias in (*fit.mean_bias, *fit.sd_bias))
            distances = (f"{distance:.4f}" for distance in fit.ks_distance)
            accepted, seconds = f"{result.acceptance:.1%}", f"{result.seconds:.2f}"
            case = (bridge, f"{result.case.gamma:g}", result.method)
            lines.append(row.format(*case, accepted, seconds, *biases, *distances))
            bridge = ""
    due = chance(len(results[0].samples))
    references = (f"{due.mean_error:.4f}", f"{due.sd_error:.4f}", f"{due.ks_critical:.4f}")
    lines += [
        rule,
        wide.format("by chance: s.e. of bias, 5% of KS", "", "", "", "", *references),
    ]
    return "\n".join(line.rstrip() for line in lines)


def write_figures(key: Key[Array, ""], results: Sequence[Result], directory: Path) -> list[Path]:
    """Per case one PNG, with Q-Q plots of both margins and the copula, all methods together;
    and `bridges.png`, whole paths of the unlikely bridge.

    **Raises:** `ImportError` without matplotlib.
    """
    from . import figures as study_figures

    paths = [directory / "bridges.png"]
    study_figures.bridges_overview(*_whole_bridges(key)).savefig(paths[0], dpi=110)
    for case, by_method in itertools.groupby(results, key=lambda result: result.case):
        group = list(by_method)
        samples = {result.method: result.samples for result in group}
        title = f"{case.bridge.replace('->', '→')} in time 1, at time ½,  γ = {case.gamma:g}"
        title = title.replace("-", "−")
        figure = study_figures.margins_and_copula(samples, group[0].law, title)
        paths.append(directory / f"{case.name.replace(' ', '-')}_gamma_{case.gamma:g}.png")
        figure.savefig(paths[-1], dpi=150)
    return paths


def _whole_bridges(key: Key[Array, ""]) -> tuple[Bridges, GaussianBridge]:
    """Bridges between unlikely points, over a time long enough to see them relax, and their
    exact law."""
    model, ends, duration = study_model(), ([0.785, 0.785], [1.091, 1.091]), 3.0
    bridges = sample_bridges(
        key, model, *ends, duration, num_bridges=5_000, num_steps=150, coupling=Coupling(0.9)
    )
    return bridges, gaussian_bridge(model, *ends, duration, bridges.times)


def _timed(function: Callable[[], Bridges]) -> tuple[Bridges, float]:
    begin = time.perf_counter()
    result = jax.block_until_ready(function())
    return result, time.perf_counter() - begin
