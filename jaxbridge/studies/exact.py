"""The study of section 3 continued: exact bridges, and why γ → 1 makes approximate ones exact.

Chains and weights for the unlikely and the very unlikely bridge, beside the paper's own
algorithm with the start law that it prints; how much the hitting probabilities vary; and what
an exact bridge costs as its duration grows.
"""

from collections.abc import Sequence
from itertools import groupby
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key

import jaxbridge as jb

from .clock import fastest, timed
from .paper import CASES, Fit, Point, compare, law_half_way, study_model
from .report import Say, Study, silent, table

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
    iteration; `seconds` once compiled; `paper_seconds` in words.
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
    """std/mean of 1/π_T for one bridge and γ, from ν and from the printed start law."""

    bridge: str
    gamma: float
    right: jb.HittingVariation
    published: jb.HittingVariation


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


def run_exact(key: Key[Array, ""], scale: float, say: Say) -> list[ExactResult]:
    """All methods on the unlikely and the very unlikely bridge; `scale` shortens the runs."""
    model, coupling = study_model(), jb.Coupling(_GAMMA)
    say("fitting a start law to the very unlikely bridge")
    law = jb.fit_start_law(key, model, *VERY_UNLIKELY, 1.0, num_steps=_NUM_STEPS, coupling=coupling)
    fitted = jb.Coupling(_GAMMA, start_law=law)
    published = jb.Coupling.as_published(_GAMMA)
    runs = [
        (UNLIKELY, "pseudo-marginal", 50_000, coupling, "44"),
        (UNLIKELY, "renewal", 500_000, coupling, "32"),
        (UNLIKELY, "weights", 50_000, coupling, ""),
        (UNLIKELY, "as published", 50_000, published, "44"),
        (VERY_UNLIKELY, "pseudo-marginal", 50_000, fitted, ""),
        (VERY_UNLIKELY, "weights", 50_000, fitted, ""),
        (VERY_UNLIKELY, "as published", 50_000, published, ""),
    ]
    results = []
    for i, (ends, method, iterations, coupling, paper_seconds) in enumerate(runs):
        say(f"{_words(ends)}, {method}")
        size = round(iterations * scale)
        results.append(_run(key, i, ends, method, size, coupling, paper_seconds))
    return results


def _run(key, i, ends: Ends, method, iterations, coupling, paper_seconds) -> ExactResult:
    simulate = {"weights": _weights, "renewal": _renewal}.get(method, _chain)
    arguments = (study_model(), ends, iterations, coupling)
    timed(lambda: simulate(jax.random.fold_in(key, 2 * i), *arguments))  # compiles
    (middle, weights, simulated), seconds = timed(
        lambda: simulate(jax.random.fold_in(key, 2 * i + 1), *arguments)
    )
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


def _chain(key, model, ends: Ends, iterations, coupling, method: Any = "pseudo_marginal"):
    chain = jb.sample_exact_bridges(
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


def _renewal(*arguments):
    return _chain(*arguments, method="renewal")


def _weights(key, model, ends: Ends, iterations, coupling):
    bridges = jb.sample_bridges(
        key, model, *ends, 1.0, num_bridges=iterations, num_steps=_NUM_STEPS, coupling=coupling
    )
    weighted = jb.weigh_bridges(key, model, bridges)
    middle = np.asarray(weighted.paths[:, _NUM_STEPS // 2])
    weights = np.asarray(weighted.weights, float)
    return middle, weights / weights.sum(), float(weighted.num_simulated)


def _judge(middle, weights, law: jb.GaussianLaw) -> tuple[Any, Fit, Any, float]:
    """Equally weighted samples, their fit, the error of the bias and the effective size."""
    sd = np.sqrt(np.diag(np.asarray(law.covariance, float)))
    deviations = (middle - np.asarray(law.mean)) / sd
    if weights is None:
        fit, sizes = compare(middle, law), np.asarray(jb.effective_sample_size(middle))
        return middle, fit, deviations.std(0) / np.sqrt(sizes), float(sizes.min())
    mean = weights @ deviations
    spread = np.sqrt(weights @ (deviations - mean) ** 2)
    drawn = np.random.default_rng(0).choice(len(middle), size=len(middle), p=weights)
    fit = Fit(mean, spread - 1, compare(middle[drawn], law).ks_distance)
    error = np.sqrt(weights**2 @ (deviations - mean) ** 2)
    return middle[drawn], fit, error, float(1 / (weights**2).sum())


def run_variation(key: Key[Array, ""], num_bridges: int, say: Say) -> list[Variation]:
    """The regression of section 3.2 for the three bridges of the paper."""
    model, results = study_model(), []
    bridges = {case.bridge: (case.start, case.end) for case in CASES}
    for name, ends in bridges.items():
        for gamma in (0.0, 0.5, 0.9, 0.99):
            say(f"{name}, variation of 1/pi for gamma {gamma:g}")
            laws = (
                (jb.Coupling(gamma), jb.Stationary()),
                (jb.Coupling.as_published(gamma), jb.Reversed()),
            )
            both = [_variation(key, model, ends, *law, num_bridges) for law in laws]
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
    bound = 200_000  # no count of the study comes near it
    weighted = jb.weigh_bridges(weigh_key, model, bridges, max_trials=bound)
    return jb.hitting_variation(
        count_key, model, weighted, (5, 10, 20), start_law=law, max_trials=bound
    )


def run_cost(
    key: Key[Array, ""],
    work: int,
    durations: Sequence[float] = (1.0, 3.0, 10.0, 30.0, 100.0),
    say: Say = silent,
) -> list[Cost]:
    """Seconds per effective bridge against the duration, at a fixed step of 0.02; each duration
    has as many bridges as make `work` units of time, 50,000 at most."""
    model, costs = study_model(), []
    for duration in durations:
        say(f"cost of an exact bridge of duration {duration:g}")
        num_bridges = min(round(work / duration), 50_000)

        def run(duration=duration, num_bridges=num_bridges):
            return jb.sample_exact_bridges(
                key,
                model,
                *UNLIKELY,
                duration,
                num_bridges=num_bridges,
                num_steps=round(duration / 0.02),
                proposal=jb.Coupling(_GAMMA),
                save_at=[duration / 2],
            )

        timed(run)
        chain, seconds = fastest(run, repeats=2)
        acceptance = float(chain.acceptance_rate)
        # Of a chain that moves with probability p in each step, whatever it looks at.
        effective = num_bridges * acceptance / (2 - acceptance)
        costs.append(Cost(duration, seconds / effective, acceptance))
    return costs


def slope(costs: Sequence[Cost]) -> float:
    """The exponent p of seconds ∝ T^p, from T = 10 on."""
    long = np.array([(c.duration, c.seconds) for c in costs if c.duration >= 10])
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

    timed(lambda: run(key))
    _, seconds = fastest(lambda: run(key))
    return Floor(_NUM_STEPS * lanes * (4 * rounds[0] + 2 * rounds[1]), seconds)


def format_exact(results: Sequence[ExactResult]) -> str:
    """The results as a table, in plain characters."""
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
    """The time of a chain beside that of its random numbers."""
    return (
        f"Drawing the {floor.numbers / 1e6:.0f} million random numbers of the first row alone "
        f"takes {floor.seconds:.2f} s:\nthe chain takes {first.seconds / floor.seconds:.1f} times "
        "that."
    )


def format_variation(results: Sequence[Variation]) -> str:
    """std/mean of 1/π_T and its mean, from ν and from the printed start law."""
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
    """Milliseconds per effective bridge, by duration, and how they grow."""
    rows = [(f"{c.duration:g}", f"{1e3 * c.seconds:.4f}", f"{c.acceptance:.1%}") for c in costs]
    text = table(("duration", "ms per effective bridge", "accepted"), rows, words=0)
    return f"{text}\nFrom T = 10 on, seconds grow as T to the power {slope(costs):.2f}."


def draw(figures: Any, results: Sequence[ExactResult]) -> dict[str, Any]:
    """Q-Q plots and copulas of the exact methods."""
    drawn = {}
    for bridge, by_method in groupby(results, key=lambda result: result.bridge):
        group = list(by_method)
        samples = {r.method: r.samples for r in group}
        title = f"{bridge} in time 1, at time ½: exact methods, γ = {_GAMMA:g}"
        name = "very_unlikely" if bridge == _words(VERY_UNLIKELY) else "unlikely"
        drawn[f"exact_{name}.png"] = figures.margins_and_copula(samples, group[0].law, title)
    return drawn


def _words(ends: Ends) -> str:
    start, end = (f"({x:g}, {y:g})" for x, y in ends)
    return f"{start} -> {end}"


def _with_floor(key, quick, say) -> tuple[list[ExactResult], Floor]:
    results = run_exact(key, 0.04 if quick else 1.0, say)
    return results, draw_as_many(key, results[0])


EXACT = Study(
    "Exact bridges, gamma = 0.5, at time 1/2, N = 50 steps",
    _with_floor,
    lambda made: f"{format_exact(made[0])}\n\n{format_floor(made[0][0], made[1])}",
    """\
"paths/n" is the number of simulated paths, "worth" that of the independent exact bridges which
the n are worth. "as published" is the paper's pseudo-marginal chain with the start law that it
prints, which leaves most of the bias; started from the stationary law, or from any other that is
paid for, it is gone. The very unlikely bridge has a start law fitted by a pilot run. The paper's
seconds are those of its authors' computer and program, given for the same bridge and number of
iterations: only their order of magnitude can be compared.""",
    lambda figures, made: draw(figures, made[0]),
)
VARIATION = Study(
    "How much hitting probabilities vary",
    lambda key, quick, say: run_variation(key, 50 if quick else 300, say),
    format_variation,
    """\
An approximate bridge is exact if the probability pi that its associated diffusion hits it does
not vary. std/mean of 1/pi shrinks as gamma -> 1 with either start law, while 1/pi grows:
approximate bridges become exact as they become rare.""",
    lambda figures, results: {"variation.png": figures.variation(results)},
)
COST = Study(
    "What duration costs",
    lambda key, quick, say: (
        run_cost(key, 5_000, (1.0, 10.0, 30.0), say) if quick else run_cost(key, 200_000, say=say)
    ),
    format_cost,
    """\
"ms" are those of a run once compiled, for each of the independent bridges that its chain is worth;
"accepted" is the share of its steps that move.""",
    lambda figures, costs: {"cost.png": figures.cost(costs, slope(costs))},
)
