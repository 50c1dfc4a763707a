"""How often is a result trusted and wrong, or right and not trusted? `python tests/calibration.py`

Results of all kinds are compared with exact numbers (closed forms, Kalman's filter, Kolmogorov's
equation on a grid), and each is counted once. With |e| the error, told is 4 standard errors + the
step error that it reports:

- wrong: |e| beyond what is told, and beyond 0.05 (of log p, or of a standard deviation);
- right: |e| within the larger of 0.05 and 2 standard errors, which are below 0.25.

Between the two are results that are vague and say so.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cir
import helpers
import jax
import jax.numpy as jnp
import numpy as np
from kalman import exact_step, kalman
from scipy.integrate import cumulative_simpson
from scipy.linalg import eigh_tridiagonal
from scipy.special import logsumexp

import jaxbridge as jb

_FLOOR, _VAGUE = 0.05, 0.25
_LEAST_LOG_DENSITY = -20.0


class Case(NamedTuple):
    """One result beside the exact number; `trusted` is its verdict, `why` its sentences."""

    family: str
    name: str
    value: float
    exact: float
    error: float
    step_error: float
    pareto_k: float
    trusted: bool
    why: str

    @property
    def is_wrong(self) -> bool:
        off = abs(self.value - self.exact)
        within = off <= 4 * self.error + abs(np.nan_to_num(self.step_error))
        return not (within or off <= _FLOOR)

    @property
    def is_right(self) -> bool:
        off = abs(self.value - self.exact)
        return self.error < _VAGUE and off <= max(_FLOOR, 2 * self.error)


# Diffusions on a line.


class Line(NamedTuple):
    """Transition densities of a diffusion on a line, by a chain on the nodes x = `map`(u) of a
    uniform grid in u, which is reversible, and two grids to extrapolate to spacing zero."""

    nodes: np.ndarray
    rates: list  # eigenvalues, of each grid
    vectors: list  # and eigenvectors, at the shared nodes
    log_measure: np.ndarray  # log of the stationary density at the nodes

    def log_density(self, time: float) -> np.ndarray:
        """log p_T from each node to each other."""
        densities = [
            (vectors * np.exp(rates * time)) @ vectors.T
            for rates, vectors in zip(self.rates, self.vectors, strict=True)
        ]
        density = (4 * densities[1] - densities[0]) / 3
        return np.log(np.maximum(density, 1e-300)) + self.log_measure

    def nearest(self, x: np.ndarray) -> np.ndarray:
        return np.abs(self.nodes[:, None] - x).argmin(axis=0)


def line(drift, sigma, low, high, count=401, forward=lambda u: u) -> Line:
    """Between `low` and `high` of u, reflected there, of a diffusion x = `forward`(u)."""
    rates, vectors, kept = [], [], None
    for refinement in (1, 2):
        size = refinement * (count - 1) + 1
        u = np.linspace(low, high, size)
        h = u[1] - u[0]
        fine = np.linspace(low, high, 8 * (size - 1) + 1)
        x = forward(fine)
        slope = np.gradient(x, fine, edge_order=2)
        V = sigma(x) ** 2
        # The stationary density in x is exp(∫ 2b/V dx) / V, and in u that times dx/du.
        potential = cumulative_simpson(2 * drift(x) / V * slope, x=fine, initial=0.0)
        log_x = potential - np.log(V)
        log_x -= logsumexp(log_x + np.log(slope)) + np.log(fine[1] - fine[0])
        at = slice(None, None, 8)
        log_u = (log_x + np.log(slope))[at]
        # Rates between neighbours, by the geometric mean of π V at the half-way points.
        half = (log_x + np.log(V) - np.log(slope))[4::8]
        diagonal = np.zeros(size)
        up, down = np.exp(half - log_u[:-1]), np.exp(half - log_u[1:])
        diagonal[:-1] -= up / (2 * h**2)
        diagonal[1:] -= down / (2 * h**2)
        off = np.exp(half - (log_u[:-1] + log_u[1:]) / 2) / (2 * h**2)
        values, basis = eigh_tridiagonal(diagonal, off)
        # p(x, y) = π(y) Σ e^{λt} φ(x) φ(y), φ = ψ / √(π h).
        basis = basis / np.exp((log_u + np.log(h)) / 2)[:, None]
        rates.append(values)
        vectors.append(basis[::refinement])
        if refinement == 1:
            kept = forward(u), log_x[at]
    return Line(kept[0], rates, vectors, kept[1])


class Model(NamedTuple):
    """A diffusion on a line with its exact law, and where points are taken from."""

    name: str
    model: jb.Diffusion
    exact: Callable  # (start, end, duration) -> points that were used, log p
    points: tuple[float, float]
    durations: tuple[float, ...] = (0.1, 0.5, 1.0, 2.0, 5.0)


def on_line(grid: Line, durations) -> Callable:
    """The exact function of `Model`, at the nodes nearest to the points."""
    tables = {duration: grid.log_density(duration) for duration in durations}

    def exact(start, end, duration):
        i, j = grid.nearest(start), grid.nearest(end)
        rows = [tables[t][a, b] for a, b, t in zip(i, j, duration, strict=True)]
        return grid.nodes[i], grid.nodes[j], np.array(rows)

    return exact


def _langevin(log_density):
    return jb.Diffusion(
        lambda x, p: jax.grad(lambda x: log_density(x[0]))(x) / 2,
        None,
        lambda x, p: log_density(x[0]),
        reversible=True,
    )


def constant_sigma() -> Iterator[Model]:
    """Langevin diffusions on a line: wells, rotors, light and heavy tails."""
    durations = (0.1, 0.5, 1.0, 2.0, 5.0)
    laws = {
        "double well": (lambda x: 2 * x**2 - x**4, lambda x: 2 * x - 2 * x**3, -4, 4, (-1.8, 1.8)),
        "steep wells": (
            lambda x: 12 * x**2 - 6 * x**4,
            lambda x: 12 * x - 12 * x**3,
            -3,
            3,
            (-1.5, 1.5),
        ),
        "quartic": (lambda x: -(x**4), lambda x: -2 * x**3, -3, 3, (-1.5, 1.5)),
        "hyperbolic": (
            lambda x: -2 * jnp.sqrt(1 + x**2),
            lambda x: -x / np.sqrt(1 + x**2),
            -25,
            25,
            (-4, 4),
        ),
        "rotor": (lambda x: 2 * jnp.cos(x), lambda x: -np.sin(x), -30, 30, (-3, 3)),
    }
    for name, (law, drift, low, high, points) in laws.items():
        grid = line(drift, np.ones_like, low, high, 801)
        yield Model(name, _langevin(law), on_line(grid, durations), points, durations)
    tails = {"Cauchy": (1.0, 10.0), "Student, 3 degrees": (2.0, 20.0)}
    durations = (0.5, 2.0, 5.0, 20.0, 100.0)
    for name, (power, far) in tails.items():
        grid = line(
            lambda x, power=power: -power * x / (1 + x**2),
            np.ones_like, -8.0, 8.0, 1201, np.sinh,
        )  # fmt: skip
        law = lambda x, power=power: -power * jnp.log1p(x**2)
        yield Model(name, _langevin(law), on_line(grid, durations), (-far, far), durations)


def _cir_model(params, coordinates) -> Model:
    made = cir.model(params)
    if coordinates != "raw":
        made = (cir.in_logarithms if coordinates == "logarithms" else cir.in_roots)(params)

    def exact(start, end, duration):
        value = cir.log_density(np.array(params), start, end, np.array(duration))
        if coordinates == "raw":
            return start, end, value
        ends = jnp.asarray(end[:, None], jnp.float32)
        value -= np.asarray(made.log_jacobian(ends), float)
        return (
            *(
                np.asarray(made.forward(jnp.asarray(x[:, None], jnp.float32)))[:, 0]
                for x in (start, end)
            ),
            value,
        )

    ratio = 2 * params[0] * params[1] / params[2] ** 2
    model = made if coordinates == "raw" else made.model
    level = params[1]
    low = 0.02 * level if ratio < 1.5 else 0.2 * level
    return Model(f"CIR {coordinates}, 2κθ/σ² = {ratio:.2g}", model, exact, (low, 2.5 * level))


def varying_sigma() -> Iterator[Model]:
    """Diffusions on a line whose σ varies: boundaries that are attained, or not."""
    for params in [(1.0, 0.5, 0.4), (1.0, 0.5, 0.9), (0.5, 0.05, 0.7)]:
        yield _cir_model(params, "raw")
    for coordinates in ("logarithms", "roots"):
        yield _cir_model((1.0, 0.5, 0.4), coordinates)
        yield _cir_model((1.0, 0.5, 0.9), coordinates)
    durations = (0.1, 0.5, 1.0, 2.0, 5.0)
    for shape in (0.3, 2.0):
        # dX = κ (1/2 - X) dt + √(X (1 - X)) dW, with both shape parameters κ; x = sin²(u/2).
        rate = 2 * shape * 0.5
        grid = line(
            lambda x, rate=rate: rate * (0.5 - x),
            lambda x: np.sqrt(x * (1 - x)),
            1e-3, np.pi - 1e-3, 801, lambda u: np.sin(u / 2) ** 2,
        )  # fmt: skip
        model = jb.Diffusion(
            lambda x, p, rate=rate: rate * (0.5 - x),
            lambda x, p: jnp.sqrt(x * (1 - x)),
            lambda x, p, shape=shape: jnp.sum((shape - 1) * (jnp.log(x) + jnp.log1p(-x))),
            reversible=True,
            domain=lambda x, p: jnp.all((x > 0) & (x < 1)),
        )
        yield Model(
            f"Jacobi, shape {shape}", model, on_line(grid, durations), (0.02, 0.98), durations
        )
    grid = line(lambda x: x * (1 - x), lambda x: 0.4 * x, np.log(0.02), np.log(6.0), 801, np.exp)
    model = jb.Diffusion(
        lambda x, p: x * (1 - x),
        lambda x, p: 0.4 * x,
        lambda x, p: jnp.sum((2 / 0.16 - 2) * jnp.log(x) - 2 * x / 0.16),
        reversible=True,
        domain=lambda x, p: jnp.all(x > 0),
    )
    yield Model("logistic", model, on_line(grid, durations), (0.3, 2.0), durations)
    grid = line(lambda x: -x, lambda x: 0.6 * np.sqrt(1 + x**2), -5.0, 5.0, 801, np.sinh)
    model = jb.Diffusion(
        lambda x, p: -x,
        lambda x, p: 0.6 * jnp.sqrt(1 + x**2),
        lambda x, p: -jnp.sum((1 + 1 / 0.36) * jnp.log1p(x**2)),
        reversible=True,
    )
    yield Model("multiplicative noise", model, on_line(grid, durations), (-2.0, 2.0), durations)


def intervals_of(model: Model, rng, count: int):
    """Start, end, duration and log p of intervals: every other as likely as data, else anywhere,
    but not so unlikely that the exact numbers have no digits left."""
    size = 200
    start, end = rng.uniform(*model.points, size=(2, size * count))
    duration = np.repeat(rng.choice(model.durations, size=count), size)
    start = np.repeat(start[::size], size)
    start, end, exact = model.exact(start, end, duration)
    rows = []
    for i, log_p in enumerate(exact.reshape(count, size)):
        likely = np.exp(log_p - log_p.max()) if i % 2 == 0 else 1.0 * (log_p > _LEAST_LOG_DENSITY)
        rows.append(i * size + rng.choice(size, p=likely / likely.sum()))
    return start[rows], end[rows], duration[rows], exact[rows]


_PROPOSALS = {
    "auto": "auto",
    "modified": jb.ModifiedDiffusionBridge(),
    "guided": jb.Guided(),
}


def _cases(family, name, estimate, exact) -> Iterator[Case]:
    """One for each interval of a result of densities."""
    for i, one in enumerate(exact):
        yield Case(
            family,
            f"{name}, {i}",
            *(
                float(x)
                for x in (
                    estimate.value[i],
                    one,
                    estimate.standard_error[i],
                    estimate.step_error[i],
                    estimate.pareto_k[i],
                )
            ),
            bool(estimate.trustworthy[i]),
            "; ".join(f.sentence.split(".")[0] for f in estimate.verdict.faults if f.present[i]),
        )


def densities(models, family, seed, count, thorough=True) -> Iterator[Case]:
    """By each proposal, on a coarse and a fine grid; on one of them by turns if not `thorough`."""
    rng = np.random.default_rng(seed)
    for i, model in enumerate(models):
        intervals = intervals_of(model, rng, count)
        for j, name in enumerate(_PROPOSALS):
            grids = (10, 50) if thorough else ((10, 50)[(i + j) % 2],)
            for num_steps in grids:
                yield from density_cases(family, model, intervals, name, num_steps, rng)


def density_cases(family, model: Model, intervals, name, num_steps, rng) -> Iterator[Case]:
    """Of one proposal, by name, on one grid."""
    start, end, duration, exact = intervals
    estimate = jb.transition_log_density(
        jax.random.key(rng.integers(2**31)),
        model.model,
        jnp.asarray(start[:, None], jnp.float32),
        jnp.asarray(end[:, None], jnp.float32),
        jnp.asarray(duration, jnp.float32),
        num_steps=num_steps,
        proposal=_PROPOSALS[name],
    )
    yield from _cases(family, f"{model.name}, {name}, N = {num_steps}", estimate, exact)


# Ornstein–Uhlenbeck processes, and images of them.


def linear_densities(seed, count, thorough=True) -> Iterator[Case]:
    """In two dimensions, with rotation, a full σ(x), couplings, and steps that are hopeless."""
    rng = np.random.default_rng(seed)
    processes = {
        "plain": (helpers.NON_REVERSIBLE, None, (0.1, 0.5, 2.0, 5.0)),
        "rotation": (np.array([[0.5, 4.0], [-4.0, 0.5]]), None, (0.5, 2.0, 5.0)),
        "long": (np.array([[1.0, 0.3], [0.0, 0.7]]), None, (50.0, 1000.0)),
        "swirled": (helpers.NON_REVERSIBLE, (helpers.swirl, helpers.unswirl), (0.2, 0.5, 1.0, 2.0)),
    }
    for name, (B, warp, durations) in processes.items():
        inner = jb.ornstein_uhlenbeck(B)
        cov = np.asarray(jb.ou_stationary(inner).covariance, float)
        start, end = rng.multivariate_normal(np.zeros(2), cov, size=(2, count)).astype(np.float32)
        duration = rng.choice(durations, size=count).astype(np.float32)
        exact = np.array(
            [
                float(jb.ou_transition(inner, jnp.asarray(a), t).log_density(jnp.asarray(b)))
                for a, b, t in zip(start, end, duration, strict=True)
            ]
        )
        model = inner
        if warp is not None:
            forward, backward = warp
            model = helpers.warped_model(inner, forward, backward)
            start, end = (np.asarray(jax.vmap(forward)(jnp.asarray(x))) for x in (start, end))
            jacobians = jax.vmap(jax.jacfwd(backward))(jnp.asarray(end))
            exact += np.linalg.slogdet(np.asarray(jacobians, float))[1]
        couplings = {"coupling": jb.Coupling(0.0)} if warp is None else {}
        for kind, proposal in {**_PROPOSALS, **couplings}.items():
            for num_steps in (10, 50) if thorough else (20,):
                estimate = jb.transition_log_density(
                    jax.random.key(rng.integers(2**31)),
                    model, start, end, duration, num_steps=num_steps, proposal=proposal,
                )  # fmt: skip
                title = f"{name}, {kind}, N = {num_steps}"
                yield from _cases("OU, images of it", title, estimate, exact)


def linear_means(seed, count, thorough=True) -> Iterator[Case]:
    """Mid-points of bridges, by weights and by chains, in standard deviations."""
    rng = np.random.default_rng(seed)
    model = jb.ornstein_uhlenbeck(helpers.NON_REVERSIBLE)
    cov = np.asarray(jb.ou_stationary(model).covariance, float)
    start, end = rng.multivariate_normal(np.zeros(2), cov, size=(2, count)).astype(np.float32)
    duration = rng.choice([0.3, 1.0, 3.0], size=count).astype(np.float32)
    laws = [
        jb.gaussian_bridge(model, jnp.asarray(a), jnp.asarray(b), t, [t / 2])
        for a, b, t in zip(start, end, duration, strict=True)
    ]
    mean = np.array([np.asarray(law.mean[0]) for law in laws])
    sd = np.array([np.sqrt(np.diag(np.asarray(law.covariance[0]))) for law in laws])
    for kind, proposal in {**_PROPOSALS, "coupling": jb.Coupling(0.5)}.items():
        for num_steps in (10, 50) if thorough else (20,):
            for method in ("weights", "chain"):
                key = jax.random.key(rng.integers(2**31))
                sample = (
                    jb.sample_weighted_bridges if method == "weights" else jb.sample_exact_bridges
                )
                result = sample(
                    key, model, start, end, duration, num_steps=num_steps, num_bridges=1000,
                    proposal=proposal,
                )  # fmt: skip
                middle = lambda path, num_steps=num_steps: path[num_steps // 2]
                columns = [
                    np.asarray(f(middle), float) / sd
                    for f in (result.mean, result.standard_error, result.step_error)
                ]
                k = result.pareto_k
                for i in range(count):
                    for j in range(2):
                        yield Case(
                            "means of bridges",
                            f"{method}, {kind}, N = {num_steps}, {i}, {j}",
                            columns[0][i, j],
                            mean[i, j] / sd[i, j],
                            columns[1][i, j],
                            columns[2][i, j],
                            float(k[i]),
                            bool(result.trustworthy[i]),
                            "; ".join(
                                f.sentence.split(".")[0]
                                for f in result.verdict.faults
                                if np.broadcast_to(f.present, count)[i]
                            ),
                        )


# Records with noise.


def _told(family, name, result, value, exact, error, step_error, k=np.nan) -> Case:
    why = "; ".join(f.sentence.split(".")[0] for f in result.verdict.faults if np.any(f.present))
    numbers = map(float, (value, exact, error, step_error, k))
    return Case(family, name, *numbers, bool(result.trustworthy), why)


def linear_records(seed, count, thorough=True) -> Iterator[Case]:
    """Likelihoods and smoothed means of linear models beside Kalman's."""
    rng = np.random.default_rng(seed)
    models = {
        "relaxation": (np.array([[1.0]]), np.array([[1.0]]), np.array([[1.0]])),
        "oscillator": (
            np.array([[0.0, -1.0], [9.0, 0.4]]),
            np.diag([0.3, 1.0]),
            np.array([[1.0, 0.0]]),
        ),
        "fast oscillator": (
            np.array([[0.0, -1.0], [100.0, 1.0]]),
            np.diag([0.3, 3.0]),
            np.array([[1.0, 0.0]]),
        ),
    }
    for name, (A, sigma, matrix) in models.items():
        d = len(A)
        model = jb.Diffusion(
            lambda x, p, A=A: -jnp.asarray(A, x.dtype) @ x, jnp.asarray(sigma, jnp.float32)
        )
        step = exact_step(A, sigma @ sigma.T)
        for i in range(count):
            noise, gap = rng.choice([0.05, 0.2, 0.5]), rng.choice([0.1, 0.3, 1.0])
            times = gap * np.arange(12)
            x, values = rng.normal(size=d), []
            for _ in times:
                values.append(matrix @ x + noise * rng.normal(size=len(matrix)))
                decay, spread = step(round(gap, 12))
                x = rng.multivariate_normal(decay @ x, spread)
            values = np.array(values)
            R = np.eye(len(matrix)) * noise**2
            seen = jb.LinearGaussian(matrix=matrix, covariance=noise**2)
            law = jb.GaussianLaw(np.zeros(d), np.eye(d))
            for num_steps in (4, 20) if thorough else (20,):
                exact = kalman(step, times, values, matrix, R, np.zeros(d), np.eye(d), num_steps)
                key = jax.random.key(rng.integers(2**31))
                record = dict(observation=seen, initial=law, num_steps=num_steps)
                title = f"{name}, N = {num_steps}, {i}"
                result = jb.log_likelihood(key, model, times, values, **record)
                yield _told(
                    "linear records", f"log p, {title}", result, result.value, exact.log_likelihood,
                    result.standard_error, result.step_error, jnp.max(result.pareto_k),
                )  # fmt: skip
                smoothed = jb.smooth(
                    key, model, times, values, num_draws=300, num_warmup=100, **record
                )
                sd = np.sqrt(np.diagonal(exact.covariance, axis1=1, axis2=2))
                off = np.abs(np.asarray(smoothed.mean(), float) - exact.mean) / sd
                told = 4 * np.asarray(smoothed.standard_error(), float) / sd
                told += np.abs(np.nan_to_num(np.asarray(smoothed.step_error(), float))) / sd
                worst = np.unravel_index(np.argmax(off - told), off.shape)
                scaled = [
                    np.asarray(f(), float)[worst] / sd[worst]
                    for f in (smoothed.mean, smoothed.standard_error, smoothed.step_error)
                ]
                yield _told(
                    "linear records", f"means, {title}", smoothed, scaled[0],
                    exact.mean[worst] / sd[worst], *scaled[1:],
                )  # fmt: skip


def line_records(seed, count, thorough=True) -> Iterator[Case]:
    """Likelihoods of noisy records of diffusions on a line beside sums over a grid."""
    rng = np.random.default_rng(seed)
    chosen = [*constant_sigma()][:2] + [m for m in varying_sigma() if m.name == "logistic"]
    settings = {
        "double well": (lambda x: 2 * x - 2 * x**3, np.ones_like, -4, 4, lambda u: u, (0.0, 0.5)),
        "steep wells": (
            lambda x: 12 * x - 12 * x**3, np.ones_like, -3, 3, lambda u: u, (0.0, 0.5),
        ),
        "logistic": (
            lambda x: x * (1 - x), lambda x: 0.4 * x, np.log(0.02), np.log(6.0), np.exp, (1.0, 0.2),
        ),
    }  # fmt: skip
    for model in chosen:
        drift, sigma, low, high, forward, (centre, spread) = settings[model.name]
        grid = line(drift, sigma, low, high, 401, forward)
        nodes = grid.nodes
        width = np.gradient(nodes)
        for i in range(count):
            noise, gap = rng.choice([0.05, 0.2, 0.5]), rng.choice([0.1, 0.5, 1.0])
            P = np.exp(grid.log_density(gap)) * width
            P /= P.sum(axis=1, keepdims=True)
            prior = np.exp(-((nodes - centre) ** 2) / (2 * spread**2)) * width
            prior /= np.sqrt(2 * np.pi) * spread
            x = rng.choice(len(nodes), p=prior / prior.sum())
            values, belief, exact = [], prior, 0.0
            for _ in range(12):
                y = nodes[x] + noise * rng.normal()
                values.append([y])
                belief = belief * np.exp(-((y - nodes) ** 2) / (2 * noise**2))
                belief = belief / (np.sqrt(2 * np.pi) * noise)
                exact += np.log(belief.sum())
                belief = (belief / belief.sum()) @ P
                x = rng.choice(len(nodes), p=P[x] / P[x].sum())
            for num_steps in (5, 20) if thorough else (20,):
                result = jb.log_likelihood(
                    jax.random.key(rng.integers(2**31)), model.model, gap * np.arange(12.0),
                    np.array(values), observation=jb.LinearGaussian(covariance=noise**2),
                    initial=jb.GaussianLaw([centre], [[spread**2]]), num_steps=num_steps,
                )  # fmt: skip
                title = f"{model.name}, noise {noise}, gap {gap}, N = {num_steps}, {i}"
                yield _told(
                    "records on a line", title, result, result.value, exact,
                    result.standard_error, result.step_error, jnp.max(result.pareto_k),
                )  # fmt: skip


# Of a seed, the number of intervals or records, and whether all grids are tried.
_FAMILIES = {
    "constant": lambda seed, n, every: densities(constant_sigma(), "σ constant", seed, n, every),
    "varying": lambda seed, n, every: densities(
        varying_sigma(), "σ(x), boundaries", seed, n, every
    ),
    "linear": linear_densities,
    "means": linear_means,
    "records": linear_records,
    "line": line_records,
}


def table(cases: list[Case]) -> str:
    """The counts of each family, in Markdown."""
    rows = [
        "| results | number | trusted | trusted and wrong | right | right and not trusted |",
        "|---|---|---|---|---|---|",
    ]
    names = list(dict.fromkeys(case.family for case in cases))
    for name in [*names, "all"]:
        group = [case for case in cases if name in ("all", case.family)]
        trusted, right = [c for c in group if c.trusted], [c for c in group if c.is_right]
        wrong = sum(case.is_wrong for case in trusted)
        lost = sum(not case.trusted for case in right)
        share = lambda part, whole: f"{part} ({100 * part / max(whole, 1):.1f} %)"
        rows.append(
            f"| {name} | {len(group)} | {len(trusted)} | {share(wrong, len(trusted))} | "
            f"{len(right)} | {share(lost, len(right))} |"
        )
    return "\n".join(rows)


def run(families, seed, count, thorough=True) -> list[Case]:
    """All cases of these families, with progress on the standard error."""
    cases, begin = [], time.perf_counter()
    for name in families:
        cases += _FAMILIES[name](seed, count, thorough)
        print(f"{name}: {len(cases)} cases, {time.perf_counter() - begin:.0f} s", file=sys.stderr)
    return cases


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("families", nargs="*", help=f"of {', '.join(_FAMILIES)}; all by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=8, help="intervals, or records, of each model")
    parser.add_argument("--thorough", action="store_true", help="all grids for each proposal")
    parser.add_argument("--out", type=Path, help="a JSON file for all cases")
    options = parser.parse_args()
    cases = run(options.families or _FAMILIES, options.seed, options.count, options.thorough)
    print(table(cases))
    for case in cases:
        if case.trusted and case.is_wrong:
            print("wrong:", case[:7])
    if options.out:
        options.out.write_text(json.dumps([case._asdict() for case in cases], default=float))


if __name__ == "__main__":
    main()
