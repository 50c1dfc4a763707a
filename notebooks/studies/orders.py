"""Transition densities with a state-dependent σ: error against number of steps and seconds.

Each model has guided proposals whose target has Euler steps (first order), and steps of weak order
2. The reference is a closed form, or the second scheme with ten times as many steps.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key
from scipy import special

import jaxbridge as jb
from jaxbridge.studies.clock import fastest
from jaxbridge.studies.report import Say, Study, markdown

from .rival_posteriors import cir_log_density

STEPS = (5, 10, 20, 40)
_REFERENCE_STEPS = 400


class Case(NamedTuple):
    """A transition from `start` to `end`, and its log density, `None` without a closed form."""

    name: str
    model: jb.Diffusion
    start: Sequence[float]
    end: Sequence[float]
    duration: float
    log_density: float | None


class OrderRow(NamedTuple):
    """One case with one number of steps.

    For Euler steps, steps of weak order 2, and "auto": the error of log p̂, its standard error, the
    reported discretisation error, the share of effective weights, the seconds of a call after
    compilation, and the verdict.
    """

    case: str
    num_steps: int
    errors: tuple[float, ...]
    standard_errors: tuple[float, ...]
    step_errors: tuple[float, ...]
    shares: tuple[float, ...]
    seconds: tuple[float, ...]
    trusted: tuple[bool, ...]


def _positive(x: Any, p: Any) -> Any:
    return jnp.all(x > 0)


def _cir(start: float, end: float, duration: float) -> Case:
    """dX = 1.2 (½ - X) dt + .6 √X dW, by a scale of time from a process at unit time."""
    model = jb.Diffusion(
        lambda x, p: 1.2 * (0.5 - x), lambda x, p: 0.6 * jnp.sqrt(x), domain=_positive
    )
    # In time units of the duration the rate is 1.2 T, and σ is .6 √T.
    exact = float(cir_log_density(start, end, 1.2 * duration, 0.6 * np.sqrt(duration)))
    name = f"CIR, {start:g} to {end:g}, T = {duration:g}"
    return Case(name, model, [start], [end], duration, exact)


def _jacobi(start: float, end: float, duration: float) -> Case:
    """dX = κ (½ - X) dt + s √(X (1 - X)) dW, by its expansion in Jacobi's polynomials."""
    kappa, s = 1.5, 0.7
    model = jb.Diffusion(
        lambda x, p: kappa * (0.5 - x),
        lambda x, p: s * jnp.sqrt(x * (1 - x)),
        domain=lambda x, p: jnp.all((x > 0) & (x < 1)),
    )
    shape = kappa / s**2  # both of the stationary beta law
    n, a = np.arange(60), shape - 1
    rates = n * kappa + s**2 / 2 * n * (n - 1)
    values = [special.eval_jacobi(n, a, a, 2 * x - 1) for x in (start, end)]
    log_norm = 2 * special.gammaln(n + shape) - special.gammaln(n + 1)
    log_norm -= special.gammaln(n + 2 * shape - 1) + np.log(2 * n + 2 * shape - 1)
    series = np.sum(np.exp(-rates * duration - log_norm) * values[0] * values[1])
    exact = float(np.log(series) + a * np.log(end * (1 - end)))
    return Case(
        f"Jacobi, {start:g} to {end:g}, T = {duration:g}", model, [start], [end], duration, exact
    )


def _logistic() -> Case:
    """dX = X (1 - X) dt + ½ X dW. In logarithms σ is constant: many steps of second order."""
    model = jb.Diffusion(lambda x, p: x * (1 - x), lambda x, p: 0.5 * x, domain=_positive)
    logs = jb.Diffusion(
        lambda y, p: 1 - jnp.exp(y) - 0.125, lambda y, p: jnp.array([[0.5]], y.dtype)
    )
    start, end, duration = 0.4, 1.3, 1.5
    density = jb.transition_log_density(
        jax.random.key(9), logs, np.log([start]), np.log([end]), duration,
        num_proposals=200_000, num_steps=200, proposal=jb.Guided(),
    )  # fmt: skip
    exact = float(density.value) - np.log(end)
    return Case("logistic, multiplicative noise", model, [start], [end], duration, exact)


def _heston() -> Case:
    """log price and variance, correlated."""

    def drift(x, p):
        return jnp.stack([0.05 - x[1] / 2, 2 * (0.3 - x[1])])

    def sigma(x, p):
        root, zero = jnp.sqrt(x[1]), jnp.zeros_like(x[1])
        return jnp.stack([jnp.stack([0.8 * root, -0.6 * root]), jnp.stack([zero, 0.5 * root])])

    model = jb.Diffusion(drift, sigma, domain=lambda x, p: x[1] > 0)
    return Case("Heston", model, [0.0, 0.3], [0.2, 0.4], 1.0, None)


def _bent(d: int) -> Case:
    """An Ornstein–Uhlenbeck process through a triangular bijection: columns of σ commute."""

    def forward(z):
        x = [z[0], z[1] + 0.5 * z[0] ** 2, *z[2:]]
        return jnp.stack(x if d == 2 else [*x[:2], z[2] + 0.4 * z[0] * z[1]])

    def inverse(x):
        second = x[1] - 0.5 * x[0] ** 2
        return jnp.stack([x[0], second, *([] if d == 2 else [x[2] - 0.4 * x[0] * second])])

    B = np.eye(d) + 0.3 * np.eye(d, k=1)
    ou = jb.ornstein_uhlenbeck(B)
    start, end = jnp.array([0.5, -0.2, 0.3][:d]), jnp.array([-0.4, 0.6, -0.1][:d])
    exact = float(jb.ou_transition(ou, inverse(start), 1.0).log_density(inverse(end)))
    model = jb.transform(ou, forward, inverse).model
    return Case(f"OU by a bijection, d = {d}", model, start.tolist(), end.tolist(), 1.0, exact)


def _curved(d: int) -> Case:
    """Columns of σ do not commute, and no coordinates make V constant."""

    def drift(x, p):
        return x[::-1] / (1 + x**2) - x

    def sigma(x, p):
        return 0.3 * x / (1 + x[:, None] ** 2) + jnp.diag(1 + 0.6 / (1 + x[::-1] ** 2))

    end = [-0.6, 0.8, 0.5][:d]
    return Case(
        f"columns do not commute, d = {d}", jb.Diffusion(drift, sigma), d * [0.2], end, 1.0, None
    )


def _lotka_volterra() -> Case:
    """Chemical Langevin equation of two species and three reactions."""
    changes = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0]], np.float32)

    def rates(x):
        return jnp.stack([0.5 * x[0], 0.0025 * x[0] * x[1], 0.3 * x[1]])

    model = jb.Diffusion(
        lambda x, p: changes @ rates(x), lambda x, p: changes * jnp.sqrt(rates(x)), domain=_positive
    )
    return Case("Lotka–Volterra, chemical Langevin", model, [70.0, 80.0], [95.0, 90.0], 1.0, None)


def cases(quick: bool) -> list[Case]:
    """Return all cases; the first and an even simpler one of each kind if `quick`."""
    simple = [_cir(0.5, 0.8, 1.0), _jacobi(0.3, 0.6, 1.0)]
    if quick:
        return simple
    return [
        *simple,
        _cir(0.3, 0.6, 2.0),
        _cir(1.5, 0.15, 1.0),
        _logistic(),
        _heston(),
        _bent(2),
        _bent(3),
        _curved(2),
        _curved(3),
        _lotka_volterra(),
    ]


def run_orders(key: Key[Array, ""], quick: bool, say: Say) -> list[OrderRow]:
    """Estimate all cases with all numbers of steps."""
    size, rows = (2_000 if quick else 20_000), []
    ways: dict[str, Any] = {"Euler": jb.Guided(density=jb.EulerDensity()), "order 2": jb.Guided()}
    for case in cases(quick):
        arguments = (case.model, case.start, case.end, case.duration)

        def density(proposal, num_steps, num_proposals=size, arguments=arguments):
            return jb.transition_log_density(
                key, *arguments, num_proposals=num_proposals, num_steps=num_steps, proposal=proposal
            )

        exact, noise = case.log_density, 0.0
        if exact is None:
            say(f"{case.name}, reference")
            reference = density(jb.Guided(), _REFERENCE_STEPS, 2 * size)
            exact, noise = float(reference.value), float(reference.standard_error)
        for num_steps in STEPS[:2] if quick else STEPS:
            say(f"{case.name}, {num_steps} steps")
            made = [
                fastest(lambda proposal=proposal, n=num_steps: density(proposal, n), 2)
                for proposal in ways.values()
            ]
            results, seconds = zip(*made, strict=True)
            rows.append(
                OrderRow(
                    case.name,
                    num_steps,
                    tuple(float(r.value) - exact for r in results),
                    tuple(float(np.hypot(r.standard_error, noise)) for r in results),
                    tuple(float(r.step_error) for r in results),
                    tuple(float(r.effective_sample_size) / size for r in results),
                    seconds,
                    tuple(bool(r.trustworthy) for r in results),
                )
            )
    return rows


def format_orders(rows: Sequence[OrderRow]) -> str:
    """Return a table: errors with standard errors, reported step errors, shares, and seconds."""
    titles = ("model", "steps", "Euler", "order 2", "reported", "shares", "seconds", "trusted")
    lines = []
    for row in rows:
        euler, other = (
            f"{error:+.4f} ± {noise:.4f}"
            for error, noise in zip(row.errors, row.standard_errors, strict=True)
        )
        pairs: list[Callable[..., str]] = [
            lambda values: ", ".join(f"{value:+.4f}" for value in values),
            lambda values: ", ".join(f"{value:.2f}" for value in values),
            lambda values: ", ".join(f"{value:.3f}" for value in values),
            lambda values: ", ".join("yes" if value else "no" for value in values),
        ]
        told = zip(pairs, (row.step_errors, row.shares, row.seconds, row.trusted), strict=True)
        cells = [pair(values) for pair, values in told]
        lines.append((row.case, str(row.num_steps), euler, other, *cells))
    return markdown(titles, lines)


def seconds_to(rows: Sequence[OrderRow], way: int, order: float, error: float) -> float:
    """Return the seconds to an error of log p̂, for Euler steps (`way` 0) or those of order 2 (1).

    The error is c / N^p with the order p. c is the median over the numbers of steps, N is at least
    5, and seconds are proportional to N.
    """
    c = np.median([abs(row.errors[way]) * row.num_steps**order for row in rows])
    num_steps = max(5.0, (c / error) ** (1 / order))
    return rows[-1].seconds[way] / rows[-1].num_steps * num_steps


def format_seconds(rows: Sequence[OrderRow]) -> str:
    """Return a table of seconds to an error of 1 % of the density, by model."""
    lines = []
    for name in dict.fromkeys(row.case for row in rows):
        group = [row for row in rows if row.case == name]
        euler = seconds_to(group, 0, 1.0, 0.01)
        # Higher terms make the errors shrink more slowly at first.
        other = seconds_to(group, 1, 1.5, 0.01)
        lines.append((name, f"{euler:.3f}", f"{other:.3f}", f"{euler / other:.1f}"))
    return markdown(("seconds to an error of 1 %", "Euler", "order 2", "ratio"), lines)


ORDERS = Study(
    "Transition densities with a state-dependent σ: errors of log p̂",
    run_orders,
    lambda rows: f"{format_orders(rows)}\n\n{format_seconds(rows)}",
    """\
"reported" is the discretisation error that each result estimates for itself, "shares" are effective
weights per proposal. In all pairs Euler steps come first. At 10 steps those of weak order 2 are
nearer by a factor of 8 or more in most models, in two to four times the seconds.""",
    lambda figures, rows: {},
)
