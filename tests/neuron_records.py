"""How good are guides of FitzHugh–Nagumo records? `python tests/neuron_records.py`

Four parameter points, three laws of the first state, steps and noises: a guide is compared with the
path that made the readings, and the guided filter with a bootstrap filter of as many particles.
Residuals are in standard deviations of the noise. The largest of 100 standard normal numbers is
itself about 2.5 (2 to 3.4 in nine records of ten), so that a guide which is as near as the true
path passes at that distance, and one that is nearer follows the noise.
"""

import argparse
import functools
import itertools
import json
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jax.scipy.stats import norm

import jaxbridge as jb

# ε, γ, β and σ.
POINTS = [(0.1, 1.5, 0.8, 0.3), (0.08, 1.2, 0.9, 0.4), (0.15, 2.0, 0.5, 0.25), (0.1, 1.5, 0.8, 0.6)]
LAWS = [
    jb.GaussianLaw([0.0, -0.8], jnp.eye(2)),
    jb.GaussianLaw([0.0, 0.0], 0.25 * jnp.eye(2)),
    jb.GaussianLaw([-1.0, -0.5], 0.04 * jnp.eye(2)),
]
STEPS, NOISES = (10, 20, 40), (0.316, 0.1, 0.0316, 0.01)
GAP, NUM_TIMES, NUM_XI = 0.2, 100, 10
NUM_FILTERS, NUM_BOOTSTRAP, NUM_PARTICLES = 24, 48, 100


class Cell(NamedTuple):
    """One record: the largest residual of the guide and of the true path, whether the density at
    ξ = 0 is finite, the share of random ξ at which it is, whether the result of `innovations` is
    trusted, and the variance of log p̂ of the guided and of the bootstrap filter."""

    point: int
    law: int
    num_steps: int
    noise: float
    seed: int
    residual: float
    true_residual: float
    finite_at_zero: bool
    finite_share: float
    trusted: bool
    guided_variance: float
    bootstrap_variance: float

    @property
    def ratio(self) -> float:
        """Return the variance of the guided filter relative to the bootstrap filter's; zero where
        only that lost all particles."""
        return (
            0.0
            if self.bootstrap_variance == np.inf
            else (self.guided_variance / self.bootstrap_variance)
        )


def draw_record(point: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the voltage at the readings and standard normal noise, shapes (100,)."""
    epsilon, gamma, beta, sigma = POINTS[point]
    rng = np.random.default_rng(seed)
    v, w = np.array([-0.9, -0.6]) + 0.3 * rng.normal(size=2)
    voltages, num = [], 400
    dt = GAP / num
    for _ in range(NUM_TIMES):
        voltages.append(v)
        for kick in sigma * np.sqrt(dt) * rng.normal(size=num):
            dv, dw = (v - v**3 - w) / epsilon, gamma * v - w + beta
            v, w = v + dt * dv, w + dt * dw + kick
    return np.array(voltages), rng.normal(size=NUM_TIMES)


@functools.partial(jax.jit, static_argnums=5)
def bootstrap_log_estimates(key, model, law, values, noise, num_steps):
    """Return log p̂ of filters whose particles follow the steps of the model, shape (filters,)."""
    dynamics, density = model.forward(jnp.zeros(2)), jb.ItoTaylorDensity()
    dt, P = jnp.float32(GAP / num_steps), NUM_PARTICLES
    root = jnp.linalg.cholesky(law.covariance)

    def one_step(x, key):
        def of_particle(x, z):
            step = density.steps_from(dynamics, x).law(dt)
            return step.mean + step.root @ z

        return jax.vmap(of_particle)(x, jax.random.normal(key, x.shape)), None

    def weighed(key, x, y):
        log_w = jnp.where(jnp.isfinite(y), norm.logpdf(y, x[:, 0], noise), 0.0)
        there = jnp.isfinite(log_w) & jnp.all(jnp.isfinite(x), axis=1)
        log_w = jnp.where(there, log_w, -jnp.inf)
        largest = jnp.max(log_w)
        weights = jnp.exp(log_w - jnp.where(jnp.isfinite(largest), largest, 0))
        bounds = jnp.cumsum(weights) / jnp.sum(weights)
        places = (jnp.arange(P, dtype=x.dtype) + jax.random.uniform(key)) / P
        chosen = jnp.minimum(jnp.searchsorted(bounds, places), P - 1)
        return x[chosen], logsumexp(log_w) - np.float32(np.log(P))

    def interval(x, inputs):
        step_key, key = jax.random.split(inputs[0])
        x, _ = jax.lax.scan(one_step, x, jax.random.split(step_key, num_steps))
        return weighed(key, x, inputs[1])

    def one_filter(key):
        start_key, first_key, key = jax.random.split(key, 3)
        x = law.mean + jax.random.normal(start_key, (P, 2)) @ root.T
        x, first = weighed(first_key, x, values[0])
        keys = jax.random.split(key, len(values) - 1)
        return first + jnp.sum(jax.lax.scan(interval, x, (keys, values[1:]))[1])

    return jax.vmap(one_filter)(jax.random.split(key, NUM_BOOTSTRAP))


def _variance(log_estimates) -> float:
    values = np.asarray(log_estimates, float)
    return float(values.var(ddof=1)) if np.all(np.isfinite(values)) else np.inf


def cell(point: int, law: int, num_steps: int, noise: float, seed: int, filters=True) -> Cell:
    """Examine the guide of one record, whose first reading is missing, and its filters."""
    voltages, white = draw_record(point, seed)
    values = voltages + noise * white
    values[0] = np.nan
    model, times = jb.fitzhugh_nagumo(*POINTS[point]), np.arange(NUM_TIMES) * GAP
    options = {
        "observation": jb.LinearGaussian([[1.0, 0.0]], jnp.float32(noise**2)),
        "initial": LAWS[law],
        "num_steps": num_steps,
    }
    paths = jb.innovations(model, times, values[:, None], **options)
    keys = jax.random.split(jax.random.key(seed), NUM_XI)
    xi = [jnp.zeros(paths.size), *(jax.random.normal(key, (paths.size,)) for key in keys)]
    finite = [bool(jnp.isfinite(paths.log_density(model.params, each))) for each in xi]
    variances = np.nan, np.nan
    if filters:
        made = jb.log_likelihood(
            jax.random.key(seed), model, times, values[:, None],
            num_particles=NUM_PARTICLES, num_filters=NUM_FILTERS, **options,
        )  # fmt: skip
        rival = bootstrap_log_estimates(
            jax.random.key(seed), model, LAWS[law], jnp.asarray(values, jnp.float32),
            jnp.float32(noise), num_steps,
        )  # fmt: skip
        variances = _variance(made.log_estimates), _variance(rival)
    return Cell(
        point, law, num_steps, noise, seed,
        float(np.nanmax(np.abs(values - np.asarray(paths.points)[0, ::num_steps, 0])) / noise),
        float(np.max(np.abs(white[1:]))),
        finite[0], float(np.mean(finite[1:])), bool(paths.trustworthy), *variances,
    )  # fmt: skip


def table(cells: list[Cell]) -> str:
    """Return one row for each number of steps and noise, in Markdown."""
    rows = [
        "| N | noise | largest residual (true path's) | above 2.5 (true path's) | above the true "
        "path's | finite at 0 | all ten ξ finite | ratio below .5 | median, largest ratio |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for key in dict.fromkeys((c.num_steps, c.noise) for c in cells):
        group = [c for c in cells if (c.num_steps, c.noise) == key]
        ratios = [c.ratio for c in group]
        rows.append(
            f"| {key[0]} | {key[1]} | {max(c.residual for c in group):.2f} "
            f"({max(c.true_residual for c in group):.2f}) | "
            f"{sum(c.residual > 2.5 for c in group)} ({sum(c.true_residual > 2.5 for c in group)}) "
            f"| {sum(c.residual > c.true_residual for c in group)} | "
            f"{sum(c.finite_at_zero for c in group)} of {len(group)} | "
            f"{sum(c.finite_share == 1 for c in group)} | {sum(r < 0.5 for r in ratios)} | "
            f"{np.median(ratios):.3f}, {max(ratios):.2f} |"
        )
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Guides of FitzHugh-Nagumo records")
    parser.add_argument("--steps", type=int, nargs="*", default=STEPS)
    parser.add_argument("--noises", type=float, nargs="*", default=NOISES)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--no-filters", action="store_true", help="examine the guides alone")
    parser.add_argument("--out", type=Path, help="a JSON file for all cells")
    options, cells, begin = parser.parse_args(), [], time.perf_counter()
    for num_steps, noise in itertools.product(options.steps, options.noises):
        for point, law in itertools.product(range(len(POINTS)), range(len(LAWS))):
            filters = not options.no_filters
            cells.append(cell(point, law, num_steps, noise, options.seed, filters))
        spent = time.perf_counter() - begin
        print(f"N = {num_steps}, noise {noise}: {spent:.0f} s", file=sys.stderr, flush=True)
        if options.out:
            options.out.write_text(json.dumps([each._asdict() for each in cells]))
    print(table(cells))


if __name__ == "__main__":
    main()
