"""Weights of guided paths where explicit steps are far too long for the drift."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb

# A double well, of which the logarithm a of the time scale is unknown; dt * |slope of the drift| is
# 10 e^a dt / 100.
SIGMA, NOISE, GAP, N = 0.7, 0.2, 0.5, 10
TIMES = np.arange(20) * GAP


def model():
    return jb.Diffusion(lambda x, a: jnp.exp(a) * (x - x**3), [[SIGMA]], params=jnp.zeros(()))


SEEN = jb.LinearGaussian(covariance=NOISE**2)
LAW = jb.GaussianLaw([0.0], [[1.0]])


def record(seed):
    rng = np.random.default_rng(seed)
    x, values = rng.choice([-1.0, 1.0]), []
    for _ in TIMES:
        values.append(x + NOISE * rng.normal())
        for noise in rng.normal(size=250):
            x += 0.002 * (x - x**3) + SIGMA * np.sqrt(0.002) * noise
    return np.array(values)[:, None]


def log_likelihood_of_steps(a, values):
    """By quadrature, of the chain of the steps of second order."""
    nodes, h = np.linspace(-4, 4, 1201, retstep=True)
    dt, rate = GAP / N, np.exp(a)
    beta, slope, bend = rate * (nodes - nodes**3), rate * (1 - 3 * nodes**2), -6 * rate * nodes
    mean = nodes + dt * beta + dt**2 / 2 * (slope * beta + SIGMA**2 / 2 * bend)
    variance = dt * SIGMA**2 * (1 + dt * slope + dt**2 / 3 * slope**2)
    distance = (nodes - mean[:, None]) ** 2 / variance[:, None]
    move = np.exp(-distance / 2) / np.sqrt(2 * np.pi * variance[:, None]) * h
    density, value = np.exp(-(nodes**2) / 2) / np.sqrt(2 * np.pi) * h, 0.0
    for number, y in enumerate(values[:, 0]):
        if number > 0:
            for _ in range(N):
                density = density @ move
        density = density * np.exp(-(((y - nodes) / NOISE) ** 2) / 2)
        density /= NOISE * np.sqrt(2 * np.pi)
        value, density = value + np.log(density.sum()), density / density.sum()
    return value


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "precision"), [(2, 32), (0, 64)])
def test_no_weight_is_larger_than_that_of_a_real_path(seed, precision, request):
    """log w ≤ ½|ξ|² + the largest log densities of what was seen. Sums that telescope over h break
    it by 1e12 and more (at a = 2.55 to 4.5 in single, 2.95 to 5 in double precision)."""
    if precision == 64:
        request.getfixturevalue("x64")
    values = record(seed)
    paths = jb.innovations(model(), TIMES, values, observation=SEEN, initial=LAW, num_steps=N)
    rates = jnp.linspace(1.0, 5.0, 81).at[0].set(0.0)
    xi = np.random.default_rng(5).normal(size=(400, paths.size))
    of_noise = jax.vmap(paths.log_weight, (None, 0))
    log_w = jax.jit(jax.vmap(of_noise, (0, None)))(rates, jnp.asarray(xi, rates.dtype))
    largest = np.sum(xi**2, axis=1) / 2 - len(TIMES) / 2 * np.log(2 * np.pi * NOISE**2)
    assert np.all(log_w <= largest) and not np.any(np.isnan(log_w))
    # And they are those of a likelihood: at a = 0 with this mean.
    w = np.exp(np.asarray(log_w[0], float) - log_likelihood_of_steps(0.0, values))
    assert abs(w.mean() - 1) < 5 * w.std() / np.sqrt(len(w)) < 0.6
