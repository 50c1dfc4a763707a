"""Simulation study of section 3, continued: exact bridges.

- Chains and weights for the unlikely and the very unlikely bridge, compared with the algorithm of
  the paper and the start law that it prints.
- The variation of hitting probabilities, which explains why γ → 1 makes approximate bridges exact.
- The cost of an exact bridge as a function of its duration.
"""

from collections.abc import Sequence
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key

import jaxbridge as jb

from .clock import compile_side_by_side, fastest, timed
from .paper import CASES, Fit, Point, compare, law_half_way, stationary_law, study_model
from .report import Say, Study, silent, table

Ends = tuple[Point, Point]
UNLIKELY: Ends = ((0.785, 0.785), (1.091, 1.091))
VERY_UNLIKELY: Ends = ((2.0, -2.0), (3.0, -3.0))
_GAMMA = 0.5
# Steps of all paths in [0, 1], as in the paper.
_NUM_STEPS = 50
# Share of proposals of the unlikely bridge that meet at this γ, from the approximate study.
_SHARE_MET = 0.811


class ExactResult(NamedTuple):
    """Result of one method for exact bridges on [0, 1], at time 1/2.

    `samples` have shape (m, 2) and equal weights. `bias` is that of the mean in exact standard
    deviations, with its standard `error`. `effective` is the effective sample size, `simulated`
    the number of paths per iteration. `seconds` exclude compilation.
    """

    bridge: str
    method: str
    iterations: int
    samples: Float[np.ndarray, "m 2"]
    law: jb.GaussianLaw
    bias: Float[np.ndarray, " 2"]
    error: Float[np.ndarray, " 2"]
    sd_bias: Float[np.ndarray, " 2"]
    effective: float
    simulated: float
    seconds: float
    paper_seconds: str


class Variation(NamedTuple):
    """Ratio std/mean of 1/π_T for one bridge and γ, from ν and from the printed start law."""

    bridge: str
    gamma: float
    right: jb.HittingVariation
    published: jb.HittingVariation


class Cost(NamedTuple):
    """Seconds per effective sample for one duration, and the acceptance rate of the chain."""

    duration: float
    seconds: float
    acceptance: float


class Floor(NamedTuple):
    """Number of random numbers of the pseudo-marginal chain, and the seconds to draw them."""

    numbers: int
    seconds: float


def run_exact(key: Key[Array, ""], scale: float, say: Say) -> list[ExactResult]:
    """Run all methods on `UNLIKELY` and `VERY_UNLIKELY`.

    Each has `scale` times its full number of iterations. `say` reports progress.
    """
    # ν as a Gaussian law: the very unlikely bridge has another one, and shares all programs.
    coupling = jb.Coupling(_GAMMA, start_law=stationary_law())
    # The chain of the paper, with the start law that it prints.
    published = jb.Coupling.as_published(_GAMMA)
    runs = [
        (UNLIKELY, "pseudo-marginal", 50_000, coupling, "44"),
        (UNLIKELY, "renewal", 500_000, coupling, "32"),
        (UNLIKELY, "weights", 50_000, coupling, ""),
        (UNLIKELY, "as published", 50_000, published, "44"),
    ]

    def fit():
        arguments = (key, study_model(), *VERY_UNLIKELY, 1.0)
        return jb.fit_start_law(*arguments, num_steps=_NUM_STEPS, coupling=coupling)

    def simulate(i, max_proposals):
        ends, method, iterations, coupling, _ = runs[i]
        simulate = {"weights": _weights, "renewal": _renewal}.get(method, _chain)
        arguments = (jax.random.fold_in(key, i), study_model(), ends)
        return simulate(*arguments, round(iterations * scale), coupling, max_proposals)

    # The bound is traced, so one proposal compiles the same program and hardly runs it.
    compiling = partial(simulate, max_proposals=1)

    say("fitting a start law, and compiling all methods")
    law, *_ = compile_side_by_side([fit, *(partial(compiling, i) for i in range(len(runs)))])
    # Pairs for the very unlikely bridge hardly ever meet from ν.
    fitted = jb.Coupling(_GAMMA, start_law=law)
    runs += [
        (VERY_UNLIKELY, "pseudo-marginal", 50_000, fitted, ""),
        (VERY_UNLIKELY, "weights", 50_000, fitted, ""),
        (VERY_UNLIKELY, "as published", 50_000, published, ""),
    ]
    results = []
    for i, (ends, method, iterations, _, paper_seconds) in enumerate(runs):
        say(f"{_words(ends)}, {method}")
        # All programs are compiled, so this is the time of the run alone.
        timed_run = timed(partial(simulate, i, None))
        results.append(_result(timed_run, ends, method, round(iterations * scale), paper_seconds))
    return results


def _result(timed_run, ends: Ends, method, iterations, paper_seconds) -> ExactResult:
    (middle, weights, simulated), seconds = timed_run
    law = law_half_way(*ends)
    samples, fit, error, effective = _judge(middle, weights, law)
    return ExactResult(
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
        paper_seconds,
    )


def _chain(
    key, model, ends: Ends, iterations, coupling, max_proposals, method: Any = "pseudo_marginal"
):
    chain = jb.sample_exact_bridges(
        key,
        model,
        *ends,
        1.0,
        num_bridges=iterations,
        num_steps=_NUM_STEPS,
        proposal=coupling,
        method=method,
        max_proposals=max_proposals,
        # Points half way are enough, and save memory.
        save_at=[0.5],
    )
    return np.asarray(chain.paths[:, 0]), None, float(chain.num_simulated)


def _renewal(*arguments):
    return _chain(*arguments, method="renewal")


def _weights(key, model, ends: Ends, iterations, coupling, max_proposals):
    bridges = jb.sample_bridges(
        key,
        model,
        *ends,
        1.0,
        num_bridges=iterations,
        num_steps=_NUM_STEPS,
        coupling=coupling,
        max_proposals=max_proposals,
    )
    weighted = jb.weigh_bridges(key, model, bridges)
    # Time 1/2, where the condition at both ends matters most.
    middle = np.asarray(weighted.paths[:, _NUM_STEPS // 2])
    weights = np.asarray(weighted.weights, float)
    return middle, weights, float(weighted.num_simulated)


def _judge(middle, weights, law: jb.GaussianLaw) -> tuple[Any, Fit, Any, float]:
    """Return equally weighted samples, their fit, the error of the bias and the effective size."""
    sd = np.sqrt(np.diag(np.asarray(law.covariance, float)))
    deviations = (middle - np.asarray(law.mean)) / sd
    if weights is None:
        fit, sizes = compare(middle, law), np.asarray(jb.effective_sample_size(middle))
        return middle, fit, deviations.std(0) / np.sqrt(sizes), float(sizes.min())
    # Deviations are means under the weights; samples are for the pictures.
    weights = weights / weights.sum()
    mean = weights @ deviations
    spread = np.sqrt(weights @ (deviations - mean) ** 2)
    indices = np.random.default_rng(0).choice(len(middle), size=len(middle), p=weights)
    fit = Fit(mean, spread - 1, compare(middle[indices], law).ks_distance)
    # Standard error of a self-normalised mean.
    error = np.sqrt(weights**2 @ (deviations - mean) ** 2)
    return middle[indices], fit, error, float(1 / (weights**2).sum())


def run_variation(key: Key[Array, ""], num_bridges: int, say: Say) -> list[Variation]:
    """Estimate the regression of section 3.2 for the three bridges of the paper."""
    model, results = study_model(), []
    bridges = {case.bridge: (case.start, case.end) for case in CASES}

    def of_both_laws(ends, gamma):
        laws = (
            (jb.Coupling(gamma), jb.Stationary()),
            (jb.Coupling.as_published(gamma), jb.Reversed()),
        )
        return [partial(_variation, key, model, ends, *law, num_bridges) for law in laws]

    say("compiling the variation of 1/pi")
    # γ and the ends are traced, so these two programs serve all rows.
    compile_side_by_side(of_both_laws(UNLIKELY, 0.0))
    for name, ends in bridges.items():
        for gamma in (0.0, 0.5, 0.9, 0.99):
            say(f"{name}, variation of 1/pi for gamma {gamma:g}")
            both = [variation() for variation in of_both_laws(ends, gamma)]
            results.append(Variation(name, gamma, *both))
    return results


def _variation(key, model, ends: Ends, coupling, law, num_bridges) -> jb.HittingVariation:
    bridge_key, weigh_key, count_key = jax.random.split(key, 3)
    bridges = jb.sample_bridges(
        bridge_key,
        model,
        *ends,
        1.0,
        num_bridges=num_bridges,
        num_steps=_NUM_STEPS,
        coupling=coupling,
    )
    bound = 200_000  # far above all counts of the study
    weighted = jb.weigh_bridges(weigh_key, model, bridges, max_trials=bound)
    return jb.hitting_variation(
        count_key, model, weighted, (5, 10, 20), start_law=law, max_trials=bound
    )


def run_cost(
    key: Key[Array, ""],
    work: int,
    durations: Sequence[float] = (1.0, 10.0, 100.0),
    say: Say = silent,
) -> list[Cost]:
    """Measure the seconds per effective bridge for each duration, at a fixed step size of 0.02.

    Each duration has `work` units of time in all, and at most 50,000 bridges.
    """
    model, costs = study_model(), []

    def run(duration, max_proposals=None):
        return jb.sample_exact_bridges(
            key,
            model,
            *UNLIKELY,
            duration,
            num_bridges=min(round(work / duration), 50_000),
            num_steps=round(duration / 0.02),
            # The law of `run_exact`: its pseudo-marginal chain is the program for one unit of time.
            proposal=jb.Coupling(_GAMMA, start_law=stationary_law()),
            max_proposals=max_proposals,
            save_at=[duration / 2],
        )

    say("compiling all durations")
    compile_side_by_side([partial(run, duration, 1) for duration in durations])
    for duration in durations:
        say(f"cost of an exact bridge of duration {duration:g}")
        chain, seconds = fastest(partial(run, duration), repeats=2)
        acceptance = float(chain.acceptance_rate)
        # Effective size of a chain that moves with probability p in each step: n p / (2 - p).
        effective = len(chain.accepted) * acceptance / (2 - acceptance)
        costs.append(Cost(duration, seconds / effective, acceptance))
    return costs


def slope(costs: Sequence[Cost]) -> float:
    """Fit the exponent p of seconds ∝ T^p, from T = 10 on."""
    # On shorter intervals acceptance still changes with T.
    long = np.array([(c.duration, c.seconds) for c in costs if c.duration >= 10])
    duration, seconds = np.log(long).T
    return float(np.polyfit(duration, seconds, 1)[0])


def draw_as_many(key: Key[Array, ""], result: ExactResult) -> Floor:
    """Measure the time of drawing the random numbers of a pseudo-marginal chain.

    Each step of a proposal takes two normals, one more for dU, and a uniform number for the
    meeting. Each step of a trial takes the last two.
    """
    proposals = result.iterations / _SHARE_MET
    trials = result.simulated * result.iterations - proposals
    # About as many lanes as the samplers have in a batch.
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
        for num_normals, round_keys in ((3, keys[: rounds[0]]), (1, keys[rounds[0] :])):
            total, _ = lax.scan(
                lambda total, key, k=num_normals: (draw(k, total, key), None), total, round_keys
            )
        return total

    # The first call compiles.
    timed(lambda: run(key))
    _, seconds = fastest(lambda: run(key))
    return Floor(_NUM_STEPS * lanes * (4 * rounds[0] + 2 * rounds[1]), seconds)


def format_exact(results: Sequence[ExactResult]) -> str:
    """Return the results as a plain-text table."""
    titles = ("bridge", "method", "n", "seconds", "paper, s", "paths/n", "worth")
    rows = [
        (
            r.bridge,
            r.method,
            str(r.iterations),
            f"{r.seconds:.2f}",
            r.paper_seconds,
            f"{r.simulated:.2f}",
            f"{r.effective:.0f}",
            "  ".join(f"{b:+.4f} +- {e:.4f}" for b, e in zip(r.bias, r.error, strict=True)),
            " ".join(f"{b:+.4f}" for b in r.sd_bias),
        )
        for r in results
    ]
    return table((*titles, "bias of mean, with error", "bias of sd"), rows, words=2)


def format_floor(first: ExactResult, floor: Floor) -> str:
    """Return the time of a chain relative to that of its random numbers, as text."""
    return (
        f"Drawing the {floor.numbers / 1e6:.0f} million random numbers of the first row alone "
        f"takes {floor.seconds:.2f} s:\nthe chain takes {first.seconds / floor.seconds:.1f} times "
        "that."
    )


def format_variation(results: Sequence[Variation]) -> str:
    """Return a table of std/mean and mean of 1/π_T, from ν and from the printed start law."""
    titles = ("bridge", "gamma", "nu: std/mean", "mean 1/pi", "printed: std/mean", "mean 1/pi")
    rows = [
        (
            r.bridge,
            f"{r.gamma:g}",
            f"{r.right.ratio:.3f} +- {r.right.ratio_error:.3f}",
            f"{r.right.mean:.2f}",
            f"{r.published.ratio:.3f} +- {r.published.ratio_error:.3f}",
            f"{r.published.mean:.2f}",
        )
        for r in results
    ]
    return table(titles, rows)


def format_cost(costs: Sequence[Cost]) -> str:
    """Return a table of milliseconds per effective bridge by duration, and their growth."""
    rows = [(f"{c.duration:g}", f"{1e3 * c.seconds:.4f}", f"{c.acceptance:.1%}") for c in costs]
    text = table(("duration", "ms per effective bridge", "accepted"), rows, words=0)
    return f"{text}\nFrom T = 10 on, seconds grow as T to the power {slope(costs):.2f}."


def draw(figures: Any, results: Sequence[ExactResult]) -> dict[str, Any]:
    """Draw Q-Q plots and copulas of the exact methods."""
    pictures = {}
    for bridge, by_method in groupby(results, key=lambda result: result.bridge):
        group = list(by_method)
        samples = {r.method: r.samples for r in group}
        title = f"{bridge} in time 1, at time ½: exact methods, γ = {_GAMMA:g}"
        name = "very_unlikely" if bridge == _words(VERY_UNLIKELY) else "unlikely"
        pictures[f"exact_{name}.png"] = figures.margins_and_copula(samples, group[0].law, title)
    return pictures


def _words(ends: Ends) -> str:
    start, end = (f"({x:g}, {y:g})" for x, y in ends)
    return f"{start} -> {end}"


def _with_floor(key, quick, say) -> tuple[list[ExactResult], Floor]:
    results = run_exact(key, 0.04 if quick else 1.0, say)
    return results, draw_as_many(key, results[0])


EXACT = Study(
    "Exact bridges, gamma = 0.5, at time 1/2, N = 50 steps",
    _with_floor,
    lambda results: f"{format_exact(results[0])}\n\n{format_floor(results[0][0], results[1])}",
    """\
"paths/n" is the number of simulated paths per bridge, "worth" the effective sample size. "as
published" is the paper's pseudo-marginal chain with the start law that it prints. It leaves a part
of the bias, and most of it for the very unlikely bridge. The stationary law, or any other with the
right weights, removes the bias. The very unlikely bridge has a start law fitted by a pilot run. The
paper's seconds are from its authors' computer and program, for the same bridge and number of
iterations: compare only their order of magnitude.""",
    lambda figures, results: draw(figures, results[0]),
)
VARIATION = Study(
    "Variation of hitting probabilities",
    lambda key, quick, say: run_variation(key, 50 if quick else 300, say),
    format_variation,
    """\
An approximate bridge is exact if the probability pi that its associated diffusion hits it does
not vary. std/mean of 1/pi shrinks as gamma -> 1 with either start law, while 1/pi grows.
So approximate bridges become exact as they become rare.""",
    lambda figures, results: {"variation.png": figures.variation(results)},
)
COST = Study(
    "Cost of an exact bridge by duration",
    lambda key, quick, say: (
        run_cost(key, 5_000, (1.0, 10.0, 30.0), say) if quick else run_cost(key, 200_000, say=say)
    ),
    format_cost,
    """\
"ms" are milliseconds per effective bridge, compilation apart. "accepted" is the share of accepted
steps.""",
    lambda figures, costs: {"cost.png": figures.cost(costs, slope(costs))},
)
