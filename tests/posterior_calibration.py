"""Are posteriors of `gibbs` and `pmmh` calibrated? `python tests/posterior_calibration.py gibbs`

Simulation-based calibration (Talts, Betancourt, Simpson, Vehtari & Gelman 2018) on records of a
double well dX = e^a (X - X³) dt + .7 dW whose time scale is unknown: a is drawn from its prior and
a record given a, so that the rank of a among the draws is uniform. Chains used to move to a > 2.5,
where explicit steps are too long for the drift and weights were larger than any real path has.

The state has one dimension, so each posterior is also known on a grid of a: the likelihood of the
chain of the steps, by sums over a grid of states.
"""

import argparse
import functools
import json
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import kstest

import jaxbridge as jb

SIGMA, NOISE, GAP, NUM_STEPS, NUM_TIMES, PRIOR_SD = 0.7, 0.2, 0.5, 10, 20, 0.5
TIMES = np.arange(NUM_TIMES) * GAP
MODEL = jb.Diffusion(lambda x, a: jnp.exp(a) * (x - x**3), [[SIGMA]], params=jnp.zeros(()))
OPTIONS = {
    "observation": jb.LinearGaussian(covariance=NOISE**2),
    "initial": jb.GaussianLaw([0.0], [[1.0]]),
    "prior": jb.NormalPrior(0.0, PRIOR_SD**2),
    "num_steps": NUM_STEPS,
}
# Beyond four standard deviations of the prior there is nothing left.
RATES = np.linspace(-4, 4, 61) * PRIOR_SD


class Posterior(NamedTuple):
    """Mean and standard deviation of one posterior by a chain and on the grid, with the errors and
    the verdict of the chain, and the share of draws below the true a."""

    number: int
    mean: float
    sd: float
    standard_error: float
    effective_sample_size: float
    r_hat: float
    trusted: bool
    rank: float
    exact_mean: float
    exact_sd: float

    @property
    def z(self) -> float:
        """Return the error of the mean, in its standard errors."""
        return (self.mean - self.exact_mean) / self.standard_error

    @property
    def z_of_sd(self) -> float:
        """Return the error of the logarithm of the sd, in standard errors of normal draws."""
        error = np.sqrt(0.5 / self.effective_sample_size)
        return float(np.log(self.sd / self.exact_sd) / error)


def draw_records(num: int, seed: int = 2024) -> tuple[np.ndarray, np.ndarray]:
    """Return a from its prior and a record for each, shapes (num,) and (num, 20, 1)."""
    rng = np.random.default_rng(seed)
    rates = PRIOR_SD * rng.normal(size=num)
    x = rng.normal(size=num)
    states, dt = [x], GAP / 250
    for _ in range(NUM_TIMES - 1):
        for _ in range(250):
            x = x + np.exp(rates) * (x - x**3) * dt + SIGMA * np.sqrt(dt) * rng.normal(size=num)
        states.append(x)
    noise = NOISE * rng.normal(size=(num, NUM_TIMES, 1))
    return rates, np.stack(states, axis=1)[..., None] + noise


def log_likelihoods_of_steps(rate: float, values: np.ndarray, num_nodes: int = 301) -> np.ndarray:
    """Return log L(a) of each record, shape (num,), of the chain of Itô–Taylor steps of second
    order, by sums over a grid of states."""
    nodes, h = np.linspace(-4, 4, num_nodes, retstep=True)
    dt, speed = GAP / NUM_STEPS, np.exp(rate)
    drift, slope, bend = speed * (nodes - nodes**3), speed * (1 - 3 * nodes**2), -6 * speed * nodes
    mean = nodes + dt * drift + dt**2 / 2 * (slope * drift + SIGMA**2 / 2 * bend)
    variance = dt * SIGMA**2 * (1 + dt * slope + dt**2 / 3 * slope**2)
    squares = (nodes - mean[:, None]) ** 2 / variance[:, None]
    step = np.exp(-squares / 2) / np.sqrt(2 * np.pi * variance[:, None]) * h
    move = np.linalg.matrix_power(step, NUM_STEPS)
    density = np.exp(-(nodes**2) / 2) / np.sqrt(2 * np.pi) * h
    density, log_likelihood = np.tile(density, (len(values), 1)), np.zeros(len(values))
    for i in range(NUM_TIMES):
        density = density if i == 0 else density @ move
        seen = np.exp(-(((values[:, i] - nodes) / NOISE) ** 2) / 2)
        density = density * seen / (NOISE * np.sqrt(2 * np.pi))
        total = density.sum(axis=1)
        density, log_likelihood = density / total[:, None], log_likelihood + np.log(total)
    return log_likelihood


def exact_posteriors(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean and the sd of a given each record, shapes (num,)."""
    log_density = np.stack([log_likelihoods_of_steps(a, values) for a in RATES], axis=1)
    log_density = log_density - RATES**2 / 2 / PRIOR_SD**2
    weights = np.exp(log_density - log_density.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    mean = weights @ RATES
    return mean, np.sqrt(np.sum(weights * (RATES - mean[:, None]) ** 2, axis=1))


@functools.cache
def exact_of_first(num: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the same for the first records of `draw_records(60)`."""
    return exact_posteriors(draw_records(60)[1][:num])


def posterior_of(method: str, number: int, **options) -> Posterior:
    """Run one chain of `method` with its defaults on the record of this number."""
    rates, values = draw_records(60)
    run = getattr(jb, method)
    made = run(jax.random.key(number), MODEL, TIMES, values[number], **OPTIONS, **options)
    draws = np.asarray(made.theta, float).ravel()
    mean, sd = (float(exact[number]) for exact in exact_of_first(60))
    return Posterior(
        number,
        float(draws.mean()),
        float(draws.std()),
        float(made.standard_error[0]),
        float(made.effective_sample_size[0]),
        float(made.r_hat[0]),
        bool(made.trustworthy),
        float(np.mean(draws < rates[number])),
        mean,
        sd,
    )


def summary(posteriors: list[Posterior]) -> dict[str, float]:
    """Return the p-value of uniform ranks, the root mean square of the errors in standard errors,
    the largest of them, and how many chains disagree in silence."""
    z, z_of_sd = (np.array([getattr(p, name) for p in posteriors]) for name in ("z", "z_of_sd"))
    return {
        "uniform ranks, p": float(kstest([p.rank for p in posteriors], "uniform").pvalue),
        "rms z of means": float(np.sqrt(np.mean(z**2))),
        "largest z of means": float(np.max(np.abs(z))),
        "rms z of sds": float(np.sqrt(np.mean(z_of_sd**2))),
        "largest z of sds": float(np.max(np.abs(z_of_sd))),
        "largest R-hat": max(p.r_hat for p in posteriors),
        "R-hat > 1.1 and trusted": sum(p.r_hat > 1.1 and p.trusted for p in posteriors),
        "trusted": sum(p.trusted for p in posteriors),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Calibration of gibbs and pmmh")
    parser.add_argument("methods", nargs="*", default=["gibbs", "pmmh"])
    parser.add_argument("--count", type=int, default=60, help="records, at most 60")
    parser.add_argument("--out", type=Path, help="a JSON file for all posteriors")
    options, made = parser.parse_args(), {}
    for method in options.methods:
        begin = time.perf_counter()
        made[method] = [posterior_of(method, number) for number in range(options.count)]
        print(f"{method}: {time.perf_counter() - begin:.0f} s", file=sys.stderr)
        for name, value in summary(made[method]).items():
            print(f"{method}, {name}: {value:.3g}")
    if options.out:
        rows = {method: [p._asdict() for p in posteriors] for method, posteriors in made.items()}
        options.out.write_text(json.dumps(rows))


if __name__ == "__main__":
    main()
