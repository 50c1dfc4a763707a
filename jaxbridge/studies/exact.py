"""The study of section 3 continued: exact bridges, and why γ → 1 makes approximate ones exact.

Chains and weights for the unlikely and the very unlikely bridge, beside the paper's own
algorithm with the start law that it prints; how much the hitting probabilities vary; and what
an exact bridge costs as its duration grows.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key

from ..coupling.bridges import sample_bridges
from ..coupling.gamma import Coupling
from ..coupling.start_laws import AnyStartLaw, Reversed, Stationary
from ..engine.diagnostics import effective_sample_size
from ..exact.chains import sample_exact_bridges
from ..exact.importance import weigh_bridges
from ..models.gaussian_bridge import gaussian_bridge
from ..models.gaussian_law import GaussianLaw
from ..tuning.hitting_variation import HittingVariation, hitting_variation
from ..tuning.start_law import fit_start_law
from .paper import CASES, Fit, Point, compare, study_model

Ends = tuple[Point, Point]
UNLIKELY: Ends = ((0.785, 0.785), (1.091, 1.091))
VERY_UNLIKELY: Ends = ((2.0, -2.0), (3.0, -3.0))
_GAMMA = 0.5
_NUM_STEPS = 50
# Of the proposals of the unlikely bridge with this γ, as the approximate study measures it.
_SHARE_MET = 0.811


class ExactResult(NamedTuple):
    """One way to exact bridges, on [0, 1], looked at in the middle.

    `samples`, shape (m, 2), equally weighted; `bias`, of the weighted or chain mean in exact
    standard deviations, with its `error`; `effective` samples; paths simulated for each
    iteration; `seconds` once compiled, and to compile; `paper_seconds` in words.
    """

    bridge: str
    method: str
    iterations: int
    samples: Float[np.ndarray, "m 2"]
    law: GaussianLaw
    bias: Float[np.ndarray, " 2"]
    error: Float[np.ndarray, " 2"]
    sd_bias: Float[np.ndarray, " 2"]
    effective: float
    simulated: float
    seconds: float
    compile_seconds: float
    paper_seconds: str


class Variation(NamedTuple):
    """std/mean of 1/π_T for one bridge and γ, from ν and from the printed start law."""

    bridge: str
    gamma: float
    right: HittingVariation
    published: HittingVariation


class Cost(NamedTuple):
    """Seconds per effective sample for one duration, and the share of steps that the chain
    accepted."""

    duration: float
    seconds: float
    acceptance: float


class Floor(NamedTuple):
    """Seconds to draw as many random numbers as the pseudo-marginal chain did, and how many."""

    numbers: int
    seconds: float


def run_exact(
    key: Key[Array, ""], scale: float, on_start: Callable[[str], None] = lambda what: None
) -> list[ExactResult]:
    """All methods on the unlikely and the very unlikely bridge; `scale` shortens the runs."""
    model = study_model()
    on_start("fitting a start law to the very unlikely bridge")
    fitted = fit_start_law(
        key, model, *VERY_UNLIKELY, 1.0, num_steps=_NUM_STEPS, coupling=Coupling(_GAMMA)
    )
    published = Coupling.as_published(_GAMMA)
    runs: list[tuple[Ends, str, int, Coupling, str]] = [
        (UNLIKELY, "pseudo-marginal", 50_000, Coupling(_GAMMA), "44"),
        (UNLIKELY, "renewal", 500_000, Coupling(_GAMMA), "32"),
        (UNLIKELY, "weights", 50_000, Coupling(_GAMMA), ""),
        (UNLIKELY, "as published", 50_000, published, "44"),
        (VERY_UNLIKELY, "pseudo-marginal", 50_000, Coupling(_GAMMA, start_law=fitted), ""),
        (VERY_UNLIKELY, "weights", 50_000, Coupling(_GAMMA, start_law=fitted), ""),
        (VERY_UNLIKELY, "as published", 50_000, published, ""),
    ]
    results = []
    for i, (ends, method, iterations, coupling, paper_seconds) in enumerate(runs):
        on_start(f"{_words(ends)}, {method}")
        iterations = round(iterations * scale)
        run = _weights if method == "weights" else _chain
        name = "renewal" if method == "renewal" else "pseudo_marginal"
        arguments = (model, ends, iterations, coupling, name)
        begin = time.perf_counter()
        run(jax.random.fold_in(key, 2 * i), *arguments)
        first = time.perf_counter() - begin
        begin = time.perf_counter()
        middle, weights, simulated = run(jax.random.fold_in(key, 2 * i + 1), *arguments)
        seconds = time.perf_counter() - begin
        exact = gaussian_bridge(model, *ends, 1.0, times=[0.5])
        law = GaussianLaw(exact.mean[0], exact.covariance[0])
        samples, fit, error, effective = _judge(middle, weights, law)
        results.append(
            ExactResult(
                _words(ends),
                method,
                iterations,
                samples,
                law,
                fit.mean_bias,
                error,
                fit.sd_bias,
                effective,
                simulated / iterations,
                seconds,
                max(first - seconds, 0.0),
                paper_seconds,
            )
        )
    return results


def _chain(key, model, ends: Ends, iterations, coupling, method):
    chain = sample_exact_bridges(
        key,
        model,
        *ends,
        1.0,
        num_bridges=iterations,
        num_steps=_NUM_STEPS,
        proposal=coupling,
        method=method,
        save_at=[0.5],
    )
    return np.asarray(chain.paths[:, 0]), None, float(chain.num_simulated)


def _weights(key, model, ends: Ends, iterations, coupling, method):
    bridges = sample_bridges(
        key, model, *ends, 1.0, num_bridges=iterations, num_steps=_NUM_STEPS, coupling=coupling
    )
    weighted = weigh_bridges(key, model, bridges)
    middle = np.asarray(weighted.paths[:, _NUM_STEPS // 2])
    weights = np.asarray(weighted.weights, float)
    return middle, weights / weights.sum(), float(weighted.num_simulated)


def _judge(middle, weights, law: GaussianLaw) -> tuple[Any, Fit, Any, float]:
    """Equally weighted samples, their fit, the error of the bias and the effective size."""
    sd = np.sqrt(np.diag(np.asarray(law.covariance, float)))
    deviations = (middle - np.asarray(law.mean)) / sd
    if weights is None:
        fit, sizes = compare(middle, law), np.asarray(effective_sample_size(middle))
        return middle, fit, deviations.std(0) / np.sqrt(sizes), float(sizes.min())
    mean = weights @ deviations
    spread = np.sqrt(weights @ (deviations - mean) ** 2)
    drawn = np.random.default_rng(0).choice(len(middle), size=len(middle), p=weights)
    fit = Fit(mean, spread - 1, compare(middle[drawn], law).ks_distance)
    error = np.sqrt(weights**2 @ (deviations - mean) ** 2)
    return middle[drawn], fit, error, float(1 / (weights**2).sum())


def run_variation(
    key: Key[Array, ""],
    num_bridges: int,
    gammas: Sequence[float] = (0.0, 0.5, 0.9, 0.99),
    on_start: Callable[[str], None] = lambda what: None,
) -> list[Variation]:
    """The regression of section 3.2 for the three bridges of the paper."""
    model, results = study_model(), []
    bridges = {case.bridge: (case.start, case.end) for case in CASES}
    for name, ends in bridges.items():
        for gamma in gammas:
            on_start(f"{name}, variation of 1/pi for gamma {gamma:g}")
            laws: list[tuple[Coupling, AnyStartLaw]] = [
                (Coupling(gamma), Stationary()),
                (Coupling.as_published(gamma), Reversed()),
            ]
            both = [_variation(key, model, ends, *law, num_bridges) for law in laws]
            results.append(Variation(name, gamma, *both))
    return results


def _variation(key, model, ends: Ends, coupling, law, num_bridges) -> HittingVariation:
    bridge_key, weigh_key, count_key = jax.random.split(key, 3)
    bridges = sample_bridges(
        bridge_key,
        model,
        *ends,
        1.0,
        num_bridges=num_bridges,
        num_steps=_NUM_STEPS,
        coupling=coupling,
    )
    bound = 200_000  # no count of the study comes near it
    weighted = weigh_bridges(weigh_key, model, bridges, max_trials=bound)
    return hitting_variation(
        count_key, model, weighted, (5, 10, 20), start_law=law, max_trials=bound
    )


def run_cost(
    key: Key[Array, ""],
    work: int,
    durations: Sequence[float] = (1.0, 3.0, 10.0, 30.0, 100.0),
    on_start: Callable[[str], None] = lambda what: None,
) -> list[Cost]:
    """Seconds per effective bridge against the duration, at a fixed step of 0.02; each duration
    has as many bridges as make `work` units of time, 50,000 at most."""
    model, costs = study_model(), []
    for duration in durations:
        on_start(f"cost of an exact bridge of duration {duration:g}")
        num_bridges = min(round(work / duration), 50_000)

        def run(key, duration=duration, num_bridges=num_bridges):
            return jax.block_until_ready(
                sample_exact_bridges(
                    key,
                    model,
                    *UNLIKELY,
                    duration,
                    num_bridges=num_bridges,
                    num_steps=round(duration / 0.02),
                    proposal=Coupling(_GAMMA),
                    save_at=[duration / 2],
                )
            )

        run(key)
        seconds, chain = fastest(lambda key=key, run=run: run(key))
        acceptance = float(chain.acceptance_rate)
        # Of a chain that moves with probability p in each step, whatever it looks at.
        effective = num_bridges * acceptance / (2 - acceptance)
        costs.append(Cost(duration, seconds / effective, acceptance))
    return costs


def slope(costs: Sequence[Cost], shortest: float = 10.0) -> float:
    """The exponent p of seconds ∝ T^p, from `shortest` on."""
    long = np.array([(c.duration, c.seconds) for c in costs if c.duration >= shortest])
    duration, seconds = np.log(long).T
    return float(np.polyfit(duration, seconds, 1)[0])


def draw_as_many(key: Key[Array, ""], result: ExactResult) -> Floor:
    """The time of drawing the random numbers of a pseudo-marginal chain, and of nothing else:
    for each step of a proposal two normals, one more for dU and a uniform number for the
    meeting; for each step of a trial the last two."""
    proposals = result.iterations / _SHARE_MET
    trials = result.simulated * result.iterations - proposals
    lanes = 8_192
    rounds = max(1, round(proposals / lanes)), max(1, round(trials / lanes))

    def draw(num_normals, total, key):
        normal_key, uniform_key = jax.random.split(key)
        normals = jax.random.normal(normal_key, (_NUM_STEPS, num_normals, lanes))
        uniforms = jax.random.uniform(uniform_key, (_NUM_STEPS, lanes))
        return total + jnp.sum(normals) + jnp.sum(uniforms)

    @jax.jit
    def run(key):
        keys = jax.random.split(key, sum(rounds))
        total = jnp.zeros(())
        for num_normals, some in ((3, keys[: rounds[0]]), (1, keys[rounds[0] :])):
            total, _ = lax.scan(
                lambda total, key, k=num_normals: (draw(k, total, key), None), total, some
            )
        return total

    run(key).block_until_ready()
    seconds, _ = fastest(lambda: run(key).block_until_ready())
    return Floor(_NUM_STEPS * lanes * (4 * rounds[0] + 2 * rounds[1]), seconds)


def format_exact(results: Sequence[ExactResult]) -> str:
    """The results as a table, in plain characters."""
    lines = [
        f"{'bridge':<32}  {'method':<15}  {'n':>7}  {'seconds':>7}  {'paper, s':>8}  "
        f"{'paths/n':>7}  {'worth':>6}  {'bias of mean, with error':^31}  {'bias of sd':^15}",
        "-" * 144,
    ]
    for r in results:
        biases = "  ".join(f"{b:+.4f} +- {e:.4f}" for b, e in zip(r.bias, r.error, strict=True))
        spread = " ".join(f"{b:+.4f}" for b in r.sd_bias)
        lines.append(
            f"{r.bridge:<32}  {r.method:<15}  {r.iterations:>7}  {r.seconds:>7.2f}  "
            f"{r.paper_seconds:>8}  {r.simulated:>7.2f}  {r.effective:>6.0f}  {biases:>31}  "
            f"{spread:>15}"
        )
    return "\n".join(lines)


def format_variation(results: Sequence[Variation]) -> str:
    """std/mean of 1/π_T and its mean, from ν and from the printed start law."""
    lines = [
        f"{'bridge':<32}  {'gamma':>5}  {'nu: std/mean':>16}  {'mean 1/pi':>9}  "
        f"{'printed: std/mean':>17}  {'mean 1/pi':>9}",
        "-" * 98,
    ]
    for r in results:
        (a, b), (c, d) = ((v.ratio, v.ratio_error) for v in (r.right, r.published))
        lines.append(
            f"{r.bridge:<32}  {r.gamma:>5g}  {a:>7.3f} +- {b:.3f}  {r.right.mean:>9.2f}  "
            f"{c:>8.3f} +- {d:.3f}  {r.published.mean:>9.2f}"
        )
    return "\n".join(lines)


def format_cost(costs: Sequence[Cost]) -> str:
    """Milliseconds per effective bridge, by duration."""
    lines = [f"{'duration':>8}  {'ms per effective bridge':>23}  {'accepted':>8}", "-" * 43]
    lines += [f"{c.duration:>8g}  {1e3 * c.seconds:>23.4f}  {c.acceptance:>8.1%}" for c in costs]
    return "\n".join(lines)


def write_exact_figures(
    results: Sequence[ExactResult],
    variation: Sequence[Variation],
    costs: Sequence[Cost],
    directory: Path,
) -> list[Path]:
    """Q-Q plots and copulas of the exact methods, and the figures of variation and cost.

    **Raises:** `ImportError` without matplotlib.
    """
    from . import figures as study_figures

    paths = []

    def save(figure, name):
        paths.append(directory / name)
        figure.savefig(paths[-1], dpi=150)

    for bridge, group in _by_bridge(results):
        samples = {r.method: r.samples for r in group}
        title = f"{bridge.replace('->', '→')} in time 1, at time ½: exact methods, γ = {_GAMMA:g}"
        name = "very_unlikely" if group[0].bridge == _words(VERY_UNLIKELY) else "unlikely"
        figure = study_figures.margins_and_copula(samples, group[0].law, title.replace("-", "−"))
        save(figure, f"exact_{name}.png")
    save(study_figures.variation(variation), "variation.png")
    save(study_figures.cost(costs, slope(costs)), "cost.png")
    return paths


def _by_bridge(results: Sequence[ExactResult]) -> Iterator[tuple[str, list[ExactResult]]]:
    for bridge in dict.fromkeys(r.bridge for r in results):
        yield bridge, [r for r in results if r.bridge == bridge]


def _words(ends: Ends) -> str:
    start, end = (f"({x:g}, {y:g})" for x, y in ends)
    return f"{start} -> {end}"


def fastest(function: Callable[[], Any], repeats: int = 3) -> tuple[float, Any]:
    """The shortest of some runs in seconds, and the last result."""
    times, result = [], None
    for _ in range(repeats):
        begin = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - begin)
    return min(times), result
