"""What accuracy costs in time: the paper's setting beside better ones, and what effects cost.

The paper's unlikely bridge, by Euler's scheme with the sign test in a radius, as published, and
then with another meeting rule and other schemes. With exact Gaussian transitions the meeting rule
is the only error of discretisation, and none is left with the Brownian crossing. The same for a
process with a full σ(x), whose bridges are known because it is an Ornstein–Uhlenbeck process in
other coordinates.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ..coupling.bridges import sample_bridges
from ..coupling.gamma import Coupling
from ..coupling.meeting import BrownianCrossing, SignTest
from ..coupling.rotation import no_rotation
from ..engine.linalg import matvec, solve
from ..models.diffusion import Diffusion
from ..models.gaussian_bridge import gaussian_bridge
from ..models.hyperbolic import hyperbolic
from ..schemes.euler import Euler
from ..schemes.gaussian_transition import GaussianTransition
from ..schemes.heun import Heun
from ..tuning.settings import WorkPrecision
from ..tuning.work_precision import work_precision
from .exact import UNLIKELY, fastest
from .paper import study_model

_GAMMA = 0.5
TARGETS = (0.1, 0.03, 0.01)
_MIXING = ((1.0, 0.5), (-0.5, 1.0))


class Curve(NamedTuple):
    """A coupling of the study, and the order of its step error that theory leads to expect."""

    name: str
    coupling: Coupling
    num_steps: tuple[int, ...]
    expected: float


def curves() -> list[Curve]:
    """Couplings in each of which one error of discretisation dominates."""
    fine, coarse = (20, 40, 80, 160), (6, 10, 16)
    schemes = {
        "sign test, exact transitions": (SignTest(), GaussianTransition(), fine, 0.5),
        "crossing, Euler": (BrownianCrossing(), Euler(), fine, 1.0),
        "crossing, Heun": (BrownianCrossing(), Heun(), coarse, 2.0),
    }
    return [
        Curve(name, Coupling(0.0, meeting, scheme), num_steps, expected)
        for name, (meeting, scheme, num_steps, expected) in schemes.items()
    ]


def run_accuracy(
    key: Key[Array, ""],
    num_bridges: int,
    on_start: Callable[[str], None] = lambda what: None,
    brief: bool = False,
) -> dict[str, WorkPrecision]:
    """The parts of the study, by their titles; a `brief` one has the fewest settings."""
    model, all_steps = study_model(), (10, 80) if brief else (10, 20, 40, 80)
    ends = (*UNLIKELY, 1.0)
    results = {}
    for curve in curves():
        on_start(f"order of {curve.name}")
        results[f"order of {curve.name}"] = work_precision(
            key,
            model,
            *ends,
            proposals=[curve.coupling],
            num_steps=curve.num_steps[:: 2 if brief else 1],
            methods=("density",),
            num_bridges=20 * num_bridges if curve.expected == 2 else 4 * num_bridges,
            repeats=1,
        )
    on_start("the paper's setting and better ones")
    better = [
        Coupling(_GAMMA, SignTest(0.05), Euler()),
        Coupling(_GAMMA, BrownianCrossing(), Euler()),
        Coupling(_GAMMA, BrownianCrossing(), Heun()),
        Coupling(_GAMMA, BrownianCrossing(), GaussianTransition()),
    ]
    options: dict[str, Any] = {"num_bridges": 2 * num_bridges, "target": TARGETS[1]}
    results["the paper's process"] = work_precision(
        key,
        model,
        *ends,
        proposals=better,
        num_steps=all_steps,
        methods=("approximate", "weights"),
        **options,
    )
    on_start("float32 and float64")
    results["precision"] = work_precision(
        key,
        model,
        *ends,
        proposals=[better[2]],
        num_steps=(10,) if brief else (10, 20),
        methods=("weights",),
        dtypes=("float32", "float64"),
        **options,
    )
    on_start("a full sigma(x)")
    options |= {"num_bridges": num_bridges, "repeats": 1}
    other, start, end, reference = sinh_model()
    results["a full σ(x)"] = work_precision(
        key,
        other,
        start,
        end,
        1.0,
        proposals=better[1:3],
        num_steps=all_steps[:3],
        methods=("weights",),
        reference=reference,
        **options,
    )
    return results


def sinh_model() -> tuple[Diffusion, np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Y = M sinh(X), coordinate by coordinate, for the paper's X: a diffusion with the full
    σ(y) = M diag(cosh x); the unlikely bridge's end points in its coordinates, and the exact mean
    and standard deviation of its bridge half way."""
    model = Diffusion(
        _sinh_drift,
        _sinh_sigma,
        _sinh_log_density,
        np.array(_MIXING),
        sample_stationary=_sample_sinh,
    )
    bridge = gaussian_bridge(study_model(), *UNLIKELY, 1.0, times=[0.5])
    mean, covariance = np.asarray(bridge.mean[0], float), np.asarray(bridge.covariance[0], float)
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


def format_accuracy(results: dict[str, WorkPrecision]) -> str:
    """All tables, the fitted orders beside those expected, and what accuracies cost."""
    blocks = [f"{title}\n{'-' * len(title)}\n{result}" for title, result in results.items()]
    lines = ["Orders of the step error, fitted and expected"]
    for curve in curves():
        (order,) = results[f"order of {curve.name}"].orders().values()
        lines.append(
            f"  {curve.name:<30} {order.order:5.2f} ± {order.error:.2f}   {curve.expected:g}"
        )
    paper = results["the paper's process"]
    weighted = {
        (s.scheme, s.num_steps): s
        for s in paper.settings
        if s.method == "weights" and s.meeting == "BrownianCrossing"
    }
    heun, euler = weighted["Heun", 10], weighted["Euler", 80]
    lines.append(
        f"Heun with 10 steps: error {heun.error:.4f} ± {heun.uncertainty:.4f} at "
        f"{heun.per_second:,.0f} effective samples per second;\nEuler with 80: "
        f"{euler.error:.4f} ± {euler.uncertainty:.4f} at {euler.per_second:,.0f}."
    )
    lines += [paper.statement(target) for target in TARGETS]
    return "\n\n".join([*blocks, "\n".join(lines)])


class EffectCost(NamedTuple):
    """A scene, and the nanoseconds of one path and step in it."""

    scene: str
    nanoseconds: float


def run_effect_costs(
    key: Key[Array, ""], num_bridges: int, on_start: Callable[[str], None] = lambda what: None
) -> list[EffectCost]:
    """Time for each path and step of approximate bridges, one effect after another."""
    plain = hyperbolic(0.8, 2)
    scenes = {
        "reflection, Euler, sign test": (plain, Coupling(-1.0, SignTest(), Euler()), False),
        "+ crossing uniforms": (plain, Coupling(-1.0, BrownianCrossing(), Euler()), False),
        "+ independent noise (γ = ½)": (plain, Coupling(0.5, BrownianCrossing(), Euler()), False),
        "+ Heun": (plain, Coupling(0.5), False),
        "+ whole paths kept": (plain, Coupling(0.5), True),
        "+ reverse drift by autodiff": (_not_declared(), Coupling(0.5), True),
        "+ constant σ": (_not_declared(_constant), Coupling(0.5), True),
        "+ diagonal σ(x)": (_not_declared(_diagonal), Coupling(0.5), True),
        "full σ(x), Euler, no rotation": (
            _not_declared(_full),
            Coupling(0.5, scheme=Euler(), rotation=no_rotation),
            True,
        ),
        "+ rotation": (_not_declared(_full), Coupling(0.5, scheme=Euler()), True),
        "+ Stratonovich form (Heun)": (_not_declared(_full), Coupling(0.5), True),
    }
    costs = []
    for name, (model, coupling, whole) in scenes.items():
        on_start(f"cost of {name.replace('½', '1/2').replace('γ', 'gamma').replace('σ', 'sigma')}")
        costs.append(EffectCost(name, time_of_step(key, model, coupling, num_bridges, 2, whole)))
    return costs


def run_sigma_costs(
    key: Key[Array, ""],
    num_bridges: int,
    dimensions: Sequence[int] = (2, 5, 10),
    on_start: Callable[[str], None] = lambda what: None,
) -> list[tuple[int, float, float]]:
    """For each dimension, nanoseconds of a path and step with σ = I and with a full σ(x)."""
    rows = []
    for d in dimensions:
        on_start(f"full sigma(x) in dimension {d}")
        models = (_not_declared(), _not_declared(_full))
        fewer = max(num_bridges * 4 // d**2, 100)  # a step costs about d³
        rows.append(
            (
                d,
                *(time_of_step(key, model, Coupling(0.5), fewer, d, True) for model in models),
            )
        )
    return rows


def time_of_step(
    key: Key[Array, ""],
    model: Diffusion,
    coupling: Coupling,
    num_bridges: int,
    d: int,
    whole_paths: bool,
) -> float:
    """Nanoseconds of one proposed path and step, over a time long enough for most to meet."""
    num_steps, duration = 50, 5.0

    def run():
        return jax.block_until_ready(
            sample_bridges(
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
        )

    run()
    seconds, bridges = fastest(run, repeats=5)
    return seconds / float(bridges.num_proposals) / num_steps * 1e9


def _constant(x: Float[Array, " d"], p: Any) -> Float[Array, "d d"]:
    return jnp.eye(len(x), dtype=x.dtype) + 0.2


def _diagonal(x: Float[Array, " d"], p: Any) -> Float[Array, " d"]:
    return 1 + 0.2 * jnp.tanh(x)


def _full(x: Float[Array, " d"], p: Any) -> Float[Array, "d d"]:
    return jnp.diag(1 + 0.2 * jnp.tanh(x)) + 0.1 * jnp.tanh(x)[:, None] * jnp.tanh(x)[::-1]


def _not_declared(sigma: Callable | None = None) -> Diffusion:
    """dX = -X dt + σ(X) dW with the reversal left to automatic differentiation. For the time of a
    step it is of no account that `log_stationary` belongs to σ = I only."""
    return Diffusion(lambda x, p: -x, sigma, lambda x, p: -jnp.sum(x * x))


def format_effects(costs: Sequence[EffectCost]) -> str:
    """What each effect costs."""
    lines = ["Nanoseconds of a path and step, d = 2"]
    return "\n".join(lines + [f"  {cost.scene:<34} {cost.nanoseconds:8.0f}" for cost in costs])


def format_sigmas(sigmas: Sequence[tuple[int, float, float]]) -> str:
    """What a full σ(x) costs."""
    lines = ["Nanoseconds of a path and step"]
    lines += [f"{'dimension':>10} {'σ = I':>8} {'full σ(x)':>10} {'ratio':>7}"]
    lines += [f"{d:>10} {one:>8.0f} {full:>10.0f} {full / one:>7.1f}" for d, one, full in sigmas]
    return "\n".join(lines)


def write_accuracy_figures(
    results: dict[str, WorkPrecision], costs: Sequence[EffectCost], directory: Path
) -> list[Path]:
    """Error against time, and what effects cost.

    **Raises:** `ImportError` without matplotlib.
    """
    from matplotlib.figure import Figure

    from . import figures as study_figures

    paths = [directory / "accuracy.png", directory / "effects.png"]
    study_figures.accuracy(results).savefig(paths[0], dpi=150)
    figure = Figure(figsize=(7, 4), layout="constrained")
    study_figures.effect_costs(costs, figure.subplots())
    figure.savefig(paths[1], dpi=150)
    return paths
