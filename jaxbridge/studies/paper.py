"""Simulation study of section 3: approximate Ornstein–Uhlenbeck bridges and their exact law.

The process has B = ((3/2, 1), (1, 3/2)), m = 0 and σ = I. Three bridges on [0, 1] are simulated in
50 steps with growing γ, by the default method of the library and by that of the paper. Their law at
time 1/2, farthest from both end points, is compared with the exact one.
"""

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key
from scipy.stats import kstest

import jaxbridge as jb

from .clock import compile_side_by_side, timed
from .report import Say, Study, silent, table

Point = tuple[float, float]
# Symmetric, so the process is reversible.
_B = np.array([[1.5, 1.0], [1.0, 1.5]])


class Case(NamedTuple):
    """Bridge of the study, named as in the paper, and the γ of its coupling."""

    name: str
    start: Point
    end: Point
    gamma: float

    @property
    def bridge(self) -> str:
        """Return the end points as text."""
        start, end = (f"({x:g}, {y:g})" for x, y in (self.start, self.end))
        return f"{start} -> {end}"


CASES = (
    Case("likely", (0.0, 0.0), (0.0, 0.0), -1.0),
    *(Case("unlikely", (0.785, 0.785), (1.091, 1.091), gamma) for gamma in (0.0, 0.5, 0.9, 0.95)),
    *(Case("very unlikely", (2.0, -2.0), (3.0, -3.0), gamma) for gamma in (0.5, 0.9, 0.99)),
)

METHODS: dict[str, Callable[[float], jb.Coupling]] = {
    "default": jb.Coupling,
    "as published": jb.Coupling.as_published,
}


class Fit(NamedTuple):
    """Deviations of draws from an exact Gaussian law, margin by margin.

    `mean_bias`: mean less exact mean, in exact standard deviations. `sd_bias`: ratio of the
    standard deviations less one. `ks_distance`: Kolmogorov–Smirnov distance. Shape (d,) each.
    """

    mean_bias: Float[np.ndarray, " d"]
    sd_bias: Float[np.ndarray, " d"]
    ks_distance: Float[np.ndarray, " d"]


class Chance(NamedTuple):
    """Deviations of n exact draws by chance: the standard errors of both biases, and the 95 %
    quantile of the Kolmogorov–Smirnov distance."""

    mean_error: float
    sd_error: float
    ks_critical: float


class Result(NamedTuple):
    """Result of one case by one method.

    `samples`, shape (n, 2), are the bridges at time 1/2, and `law` is the exact law there.
    `acceptance` is the share of proposals that met. `seconds` exclude compilation.
    """

    case: Case
    method: str
    samples: Float[np.ndarray, "n 2"]
    law: jb.GaussianLaw
    fit: Fit
    acceptance: float
    seconds: float


def study_model() -> jb.Diffusion:
    """Return the process of section 3.2."""
    return jb.ornstein_uhlenbeck(_B)


def stationary_law() -> jb.GaussianLaw:
    """Return the stationary law ν of that process, N(0, B⁻¹/2) since B is symmetric."""
    return jb.GaussianLaw(np.zeros(2), np.linalg.inv(_B) / 2)


def run_study(
    key: Key[Array, ""],
    num_bridges: int,
    cases: Sequence[Case] = CASES,
    say: Say = silent,
) -> list[Result]:
    """Run every case by every method, in the order of the table."""
    runs = list(itertools.product(cases, METHODS))
    say("compiling")
    # γ is traced, but γ = -1 (independent motions) is a program of its own.
    kinds = {(case.gamma == -1, method): (case, method) for case, method in runs}
    compile_side_by_side([partial(_bridges, key, *run, num_bridges, 1) for run in kinds.values()])
    results = []
    for i, (case, method) in enumerate(runs):
        say(f"[{i + 1}/{len(runs)}] {case.bridge}, gamma {case.gamma:g}, {method}")
        results.append(run_case(jax.random.fold_in(key, i), case, method, num_bridges))
    return results


def run_case(key: Key[Array, ""], case: Case, method: str, num_bridges: int) -> Result:
    """Simulate one case by one method, and compare it with its exact law.

    **Raises:** `RuntimeError` if a bridge is missing or misses an end point.
    """
    result, seconds = timed(lambda: _bridges(key, case, method, num_bridges, None))
    # Saved are both ends and time 1/2.
    first, middle, last = np.moveaxis(np.asarray(result.paths), 1, 0)
    # In the precision of the paths, so that the comparison may be exact.
    ends = np.array([case.start, case.end], first.dtype)
    if not (np.all(first == ends[0]) and np.all(last == ends[1])):
        raise RuntimeError(f"not all paths are bridges {case.bridge}: {case}, {method}.")
    law = law_half_way(case.start, case.end)
    return Result(
        case,
        method,
        middle,
        law,
        compare(middle, law),
        num_bridges / int(result.num_proposals),
        seconds,
    )


def _bridges(key, case: Case, method, num_bridges, max_proposals: int | None) -> jb.Bridges:
    # The bound is traced, so one proposal compiles the same program and hardly runs it.
    return jb.sample_bridges(
        key,
        study_model(),
        case.start,
        case.end,
        1.0,
        num_bridges=num_bridges,
        num_steps=50,
        coupling=METHODS[method](case.gamma),
        max_proposals=max_proposals,
        save_at=[0.0, 0.5, 1.0],
    )


def law_half_way(start: Point, end: Point) -> jb.GaussianLaw:
    """Return the exact law at time ½ of the bridge on [0, 1]."""
    exact = jb.gaussian_bridge(study_model(), start, end, 1.0, times=[0.5])
    return jb.GaussianLaw(exact.mean[0], exact.covariance[0])


def compare(samples: Float[np.ndarray, "n d"], law: jb.GaussianLaw) -> Fit:
    """Compare draws with their exact law, margin by margin."""
    mean = np.asarray(law.mean, float)
    sd = np.sqrt(np.diag(np.asarray(law.covariance, float)))
    scores = (samples - mean) / sd
    distances = [kstest(score, "norm", method="asymp").statistic for score in scores.T]
    return Fit(scores.mean(0), scores.std(0, ddof=1) - 1, np.array(distances))


def chance(num_bridges: int) -> Chance:
    """Return the deviations of this many independent exact draws."""
    n = num_bridges
    return Chance(n**-0.5, (2 * n) ** -0.5, 1.36 * n**-0.5)


def format_table(results: Sequence[Result]) -> str:
    """Return the results as a plain-text table of 119 columns."""
    titles = ("bridge", "gamma", "method", "met", "seconds")
    titles += ("bias of mean", "bias of sd", "KS distance")
    rows = [
        (
            r.case.bridge,
            f"{r.case.gamma:g}",
            r.method,
            f"{r.acceptance:.1%}",
            f"{r.seconds:.2f}",
            *(
                " ".join(f"{bias:+.4f}" for bias in pair)
                for pair in (r.fit.mean_bias, r.fit.sd_bias)
            ),
            " ".join(f"{distance:.4f}" for distance in r.fit.ks_distance),
        )
        for r in results
    ]
    due = [f"{value:.4f}" for value in chance(len(results[0].samples))]
    chance_row = ("by chance: s.e. of bias, 5% of KS", "", "", "", "", *due)
    text = table(titles, [*rows, chance_row], words=3)
    return f"{len(results[0].samples):,} bridges a case\n\n{text}"


def whole_bridges(key: Key[Array, ""]) -> tuple[jb.Bridges, jb.GaussianBridge]:
    """Sample bridges between unlikely points, long enough to relax between them, and return them
    with their exact law."""
    model, ends, duration = study_model(), ([0.785, 0.785], [1.091, 1.091]), 3.0
    bridges = jb.sample_bridges(
        key, model, *ends, duration, num_bridges=5_000, num_steps=150, coupling=jb.Coupling(0.9)
    )
    return bridges, jb.gaussian_bridge(model, *ends, duration, bridges.times)


def draw(
    figures: Any, results: Sequence[Result], whole: tuple[jb.Bridges, jb.GaussianBridge]
) -> dict[str, Any]:
    """Draw paths of the unlikely bridge, and for each case Q-Q plots and the copula."""
    pictures = {"bridges.png": figures.bridges_overview(*whole)}
    for case, by_method in itertools.groupby(results, key=lambda result: result.case):
        group = list(by_method)
        title = f"{case.bridge} in time 1, at time ½,  γ = {case.gamma:g}"
        name = f"{case.name.replace(' ', '-')}_gamma_{case.gamma:g}.png"
        samples = {result.method: result.samples for result in group}
        pictures[name] = figures.margins_and_copula(samples, group[0].law, title)
    return pictures


APPROXIMATE = Study(
    "Approximate bridges, at time 1/2, N = 50 steps, biases in exact standard deviations",
    lambda key, quick, say: (
        run_study(key, 2_000 if quick else 50_000, say=say),
        whole_bridges(key),
    ),
    lambda results: format_table(results[0]),
    """\
Approximate bridges have the law of the bridge given that an associated diffusion hits it. For
the likely bridge this changes the mean by at most about 1 % of a standard deviation. For the
unlikely ones it pulls the mid-point towards the stationary law, by the bias shown. This is the
error of the method itself, which more bridges do not remove. It shrinks as gamma -> 1, at the
price of fewer pairs that meet. "default" has exact steps and the Brownian crossing. "as
published" has Euler steps and the sign test in radius 0.05. These have a step error of their own,
and the test overlooks about half of the meetings.""",
    lambda figures, results: draw(figures, *results),
)
