"""What accuracy costs in time: the paper's setting beside better ones, and what effects cost.

The paper's unlikely bridge, by Euler's scheme with the sign test in a radius, as published, and
then with another meeting rule and other schemes. With exact Gaussian transitions the meeting rule
is the only error of discretisation, and none is left with the Brownian crossing. The same for a
process with a full σ(x), whose bridges are known because it is an Ornstein–Uhlenbeck process in
other coordinates, on one grid and extrapolated from two.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import jaxbridge as jb
from jaxbridge.engine.linalg import matvec, solve
from jaxbridge.studies.clock import fastest, timed
from jaxbridge.studies.exact import UNLIKELY
from jaxbridge.studies.paper import law_half_way, study_model
from jaxbridge.studies.report import Say, Study, Table, table

_GAMMA = 0.5
TARGETS = (0.1, 0.03, 0.01)
_MIXING = ((1.0, 0.5), (-0.5, 1.0))


class Curve(NamedTuple):
    """A coupling of the study, and the order of its step error that theory leads to expect."""

    name: str
    coupling: jb.Coupling
    num_steps: tuple[int, ...]
    expected: float


def curves() -> list[Curve]:
    """Couplings in each of which one error of discretisation dominates."""
    fine, coarse = (20, 40, 80, 160), (6, 10, 16)
    schemes = {
        "sign test, exact transitions": (jb.SignTest(), jb.GaussianTransition(), fine, 0.5),
        "crossing, Euler": (jb.BrownianCrossing(), jb.Euler(), fine, 1.0),
        "crossing, Heun": (jb.BrownianCrossing(), jb.Heun(), coarse, 2.0),
    }
    return [
        Curve(name, jb.Coupling(0.0, meeting, scheme), num_steps, expected)
        for name, (meeting, scheme, num_steps, expected) in schemes.items()
    ]


def run_accuracy(
    key: Key[Array, ""], num_bridges: int, say: Say, brief: bool
) -> dict[str, jb.WorkPrecision]:
    """The parts of the study, by their titles; a `brief` one has the fewest settings."""
    of_the_paper = functools.partial(jb.work_precision, key, study_model(), *UNLIKELY, 1.0)
    all_steps, results = (10, 80) if brief else (10, 20, 40, 80), {}
    for curve in curves():
        say(f"order of {curve.name}")
        results[f"order of {curve.name}"] = of_the_paper(
            proposals=[curve.coupling],
            num_steps=curve.num_steps[:: 2 if brief else 1],
            methods=("density",),
            num_bridges=20 * num_bridges if curve.expected == 2 else 4 * num_bridges,
            repeats=1,
        )
    say("the paper's setting and better ones")
    better = [
        jb.Coupling(_GAMMA, jb.SignTest(0.05), jb.Euler()),
        jb.Coupling(_GAMMA, jb.BrownianCrossing(), jb.Euler()),
        jb.Coupling(_GAMMA, jb.BrownianCrossing(), jb.Heun()),
        jb.Coupling(_GAMMA, jb.BrownianCrossing(), jb.GaussianTransition()),
    ]
    results["the paper's process"] = of_the_paper(
        proposals=better,
        num_steps=all_steps,
        methods=("approximate", "weights"),
        num_bridges=2 * num_bridges,
        target=TARGETS[1],
    )
    say("float32 and float64")
    results["precision"] = of_the_paper(
        proposals=[better[2]],
        num_steps=(10,) if brief else (10, 20),
        methods=("weights",),
        dtypes=("float32", "float64"),
        num_bridges=2 * num_bridges,
        target=TARGETS[1],
    )
    say("a full sigma(x)")
    other, start, end, reference = sinh_model()
    results["a full σ(x)"] = jb.work_precision(
        key,
        other,
        start,
        end,
        1.0,
        proposals=better[1:3],
        num_steps=(12, 80) if brief else (12, 20, 40),  # half as many, too, have one half way
        methods=("weights", "extrapolated_weights"),
        reference=reference,
        num_bridges=num_bridges,
        repeats=1,
        target=TARGETS[1],
    )
    return results


def sinh_model() -> tuple[jb.Diffusion, np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Y = M sinh(X), coordinate by coordinate, for the paper's X: a diffusion with the full
    σ(y) = M diag(cosh x); the unlikely bridge's end points in its coordinates, and the exact mean
    and standard deviation of its bridge half way."""
    model = jb.Diffusion(
        _sinh_drift,
        _sinh_sigma,
        _sinh_log_density,
        np.array(_MIXING),
        sample_stationary=_sample_sinh,
    )
    law = law_half_way(*UNLIKELY)
    mean, covariance = np.asarray(law.mean, float), np.asarray(law.covariance, float)
    variance = np.diag(covariance)
    sinh_mean = np.sinh(mean) * np.exp(variance / 2)
    # E sinh X_i sinh X_j = ½ E [cosh(X_i + X_j) - cosh(X_i - X_j)]
    total = variance[:, None] + variance
    second = sum(
        sign * np.cosh(mean[:, None] + sign * mean) * np.exp(total / 2 + sign * covariance)
        for sign in (1, -1)
    )
    mixing = np.array(_MIXING)
    spread = mixing @ (second / 2 - np.outer(sinh_mean, sinh_mean)) @ mixing.T
    start, end = (mixing @ np.sinh(np.array(point)) for point in UNLIKELY)
    return model, start, end, (mixing @ sinh_mean, np.sqrt(np.diag(spread)))


def _sinh_state(y: Float[Array, " d"], mixing: Float[Array, "d d"]) -> Float[Array, " d"]:
    return jnp.arcsinh(solve(mixing.astype(y.dtype), y))


def _sinh_drift(y: Float[Array, " d"], mixing: Float[Array, "d d"]) -> Float[Array, " d"]:
    """By Itô's formula: M [cosh(x) α(x) + ½ sinh(x)]."""
    x = _sinh_state(y, mixing)
    drift = -matvec(study_model().params.B.astype(y.dtype), x)
    return matvec(mixing.astype(y.dtype), jnp.cosh(x) * drift + jnp.sinh(x) / 2)


def _sinh_sigma(y: Float[Array, " d"], mixing: Float[Array, "d d"]) -> Float[Array, "d d"]:
    return mixing.astype(y.dtype) * jnp.cosh(_sinh_state(y, mixing))


def _sinh_log_density(y: Float[Array, " d"], mixing: Float[Array, "d d"]) -> Float[Array, ""]:
    x = _sinh_state(y, mixing)
    # The paper's B is symmetric and σ = I, so Γ⁻¹ = 2B.
    quadratic = jnp.sum(x * matvec(study_model().params.B.astype(y.dtype), x))
    return -quadratic - jnp.sum(jnp.log(jnp.cosh(x)))


def _sample_sinh(key: Key[Array, ""], mixing: Float[Array, "d d"]) -> Float[Array, " d"]:
    x = study_model().sample_stationary(key)
    return matvec(mixing.astype(x.dtype), jnp.sinh(x))


def format_accuracy(results: dict[str, jb.WorkPrecision]) -> str:
    """All tables, the fitted orders beside those expected, and what accuracies cost."""
    blocks = [f"{title}\n{'-' * len(title)}\n{result}" for title, result in results.items()]
    orders = []
    for curve in curves():
        (order,) = results[f"order of {curve.name}"].orders().values()
        found = f"{order.order:.2f} ± {order.error:.2f}"
        orders.append((curve.name, found, f"{curve.expected:g}"))
    paper = results["the paper's process"]
    weighted = {
        (s.scheme, s.num_steps): s
        for s in paper.settings
        if s.method == "weights" and s.meeting == "BrownianCrossing"
    }
    heun, euler = weighted["Heun", 10], weighted["Euler", 80]
    lines = [
        f"Heun with 10 steps: error {heun.error:.4f} ± {heun.uncertainty:.4f} at "
        f"{heun.per_second:,.0f} effective samples per second;\nEuler with 80: "
        f"{euler.error:.4f} ± {euler.uncertainty:.4f} at {euler.per_second:,.0f}.",
        *(paper.statement(target) for target in TARGETS),
    ]
    titles = ("Orders of the step error", "fitted", "expected")
    return "\n\n".join([*blocks, table(titles, orders), "\n".join(lines)])


class EffectCost(NamedTuple):
    """A scene, and the nanoseconds of one path and step in it."""

    scene: str
    nanoseconds: float


def run_effect_costs(key: Key[Array, ""], num_bridges: int, say: Say) -> list[EffectCost]:
    """Time for each path and step of approximate bridges, one effect after another."""
    plain = jb.hyperbolic(0.8, 2)
    scenes = {
        "reflection, Euler, sign test": (
            plain,
            jb.Coupling(-1.0, jb.SignTest(), jb.Euler()),
            False,
        ),
        "+ crossing uniforms": (plain, jb.Coupling(-1.0, jb.BrownianCrossing(), jb.Euler()), False),
        "+ independent noise (γ = ½)": (
            plain,
            jb.Coupling(0.5, jb.BrownianCrossing(), jb.Euler()),
            False,
        ),
        "+ Heun": (plain, jb.Coupling(0.5), False),
        "+ whole paths kept": (plain, jb.Coupling(0.5), True),
        "+ reverse drift by autodiff": (_not_declared(), jb.Coupling(0.5), True),
        "+ constant σ": (_not_declared(_constant), jb.Coupling(0.5), True),
        "+ diagonal σ(x)": (_not_declared(_diagonal), jb.Coupling(0.5), True),
        "full σ(x), Euler, no rotation": (
            _not_declared(_full),
            jb.Coupling(0.5, scheme=jb.Euler(), rotation=jb.no_rotation),
            True,
        ),
        "+ rotation": (_not_declared(_full), jb.Coupling(0.5, scheme=jb.Euler()), True),
        "+ Stratonovich form (Heun)": (
            _not_declared(_full),
            jb.Coupling(0.5, scheme=jb.Heun()),
            True,
        ),
    }
    costs = []
    for name, (model, coupling, whole) in scenes.items():
        say(f"cost of {name.replace('½', '1/2').replace('γ', 'gamma').replace('σ', 'sigma')}")
        costs.append(EffectCost(name, time_of_step(key, model, coupling, num_bridges, 2, whole)))
    return costs


def run_sigma_costs(
    key: Key[Array, ""], num_bridges: int, dimensions: Sequence[int], say: Say
) -> list[tuple[int, float, float]]:
    """For each dimension, nanoseconds of a path and step with σ = I and with a full σ(x)."""
    rows = []
    for d in dimensions:
        say(f"full sigma(x) in dimension {d}")
        models = (_not_declared(), _not_declared(_full))
        fewer = max(num_bridges * 4 // d**2, 100)  # a step costs about d³
        rows.append(
            (
                d,
                *(time_of_step(key, model, jb.Coupling(0.5), fewer, d, True) for model in models),
            )
        )
    return rows


def time_of_step(
    key: Key[Array, ""],
    model: jb.Diffusion,
    coupling: jb.Coupling,
    num_bridges: int,
    d: int,
    whole_paths: bool,
) -> float:
    """Nanoseconds of one proposed path and step, over a time long enough for most to meet."""
    num_steps, duration = 50, 5.0

    def run():
        return jb.sample_bridges(
            key,
            model,
            jnp.zeros(d),
            jnp.full(d, 0.5),
            duration,
            num_bridges=num_bridges,
            num_steps=num_steps,
            coupling=coupling,
            save_at=None if whole_paths else [duration / 2],
        )

    timed(run)
    bridges, seconds = fastest(run, repeats=5)
    return seconds / float(bridges.num_proposals) / num_steps * 1e9


def _constant(x: Float[Array, " d"], p: Any) -> Float[Array, "d d"]:
    return jnp.eye(len(x), dtype=x.dtype) + 0.2


def _diagonal(x: Float[Array, " d"], p: Any) -> Float[Array, " d"]:
    return 1 + 0.2 * jnp.tanh(x)


def _full(x: Float[Array, " d"], p: Any) -> Float[Array, "d d"]:
    return jnp.diag(1 + 0.2 * jnp.tanh(x)) + 0.1 * jnp.tanh(x)[:, None] * jnp.tanh(x)[::-1]


def _not_declared(sigma: Callable | None = None) -> jb.Diffusion:
    """dX = -X dt + σ(X) dW with the reversal left to automatic differentiation. For the time of a
    step it is of no account that `log_stationary` belongs to σ = I only."""
    return jb.Diffusion(lambda x, p: -x, sigma, lambda x, p: -jnp.sum(x * x))


def format_effects(costs: Sequence[EffectCost]) -> str:
    """What each effect costs."""
    rows = [(cost.scene, f"{cost.nanoseconds:.0f}") for cost in costs]
    return table(("Nanoseconds of a path and step", "d = 2"), rows)


def sigma_table(sigmas: Sequence[tuple[int, float, float]]) -> Table:
    """Return the table of the times per step with σ = I and with a full σ(x)."""
    titles = ("d", "ns per path and step, σ = I", "the same, full σ(x)", "ratio")
    rows = [(f"{d}", f"{one:.0f}", f"{full:.0f}", f"{full / one:.1f}") for d, one, full in sigmas]
    return titles, rows


def _both(key, quick, say) -> tuple[dict[str, jb.WorkPrecision], list[EffectCost]]:
    results = run_accuracy(key, 1_000 if quick else 50_000, say, quick)
    return results, run_effect_costs(key, 1_000 if quick else 20_000, say)


ACCURACY = Study(
    "What accuracy costs in time",
    _both,
    lambda made: f"{format_accuracy(made[0])}\n\n{format_effects(made[1])}",
    """\
"error" is the distance of the mean half way from the exact one, in standard deviations (of orders:
of the transition density, relative); "step", "method" and "Monte Carlo" are its parts. The method's
own error, that of approximate bridges, no number of steps removes. The Brownian crossing sees the
meetings that the sign test overlooks, which is an error of order 1/2; Heun's scheme brings what is
left from first to second order where sigma is constant; elsewhere it gains less. With exact
Gaussian transitions nothing is left, at any number of steps.""",
    lambda figures, made: {
        "accuracy.png": figures.accuracy(made[0]),
        "effects.png": figures.effect_costs(made[1]),
    },
)
