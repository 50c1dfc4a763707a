"""Where noise reaches a part of the state only: posteriors, against Kalman's likelihood."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kalman import exact_step, kalman
from scipy.optimize import minimize

import jaxbridge as jb

KEY = jax.random.key(0)
# Of an oscillator with noise in its velocity: log of the spring, of sigma, and of the noise.
TRUE, SD = np.log([4.0, 0.8, 0.05]), np.array([0.5, 0.5, 0.5])
TIMES, N = np.arange(40) * 0.25, 4


def drift(x, p):
    return jnp.stack([x[1], -jnp.exp(p[0]) * x[0] - 0.5 * x[1]])


def sigma(x, p):
    return jnp.stack([jnp.zeros_like(p[1]), jnp.exp(p[1])])[:, None]


MODEL = jb.Diffusion(drift, sigma, params=jnp.asarray(TRUE))
SEEN = jb.LinearGaussian([[1.0, 0.0]], covariance=lambda p: jnp.exp(2 * p[2]))
START = jb.GaussianLaw([0.0, 0.0], [[0.1, 0.0], [0.0, 0.4]])
OPTIONS = {"observation": SEEN, "initial": START, "num_steps": N}
PRIOR = jb.NormalPrior(jnp.asarray(TRUE), jnp.asarray(SD) ** 2)


def system(theta):
    spring, scale, _ = np.exp(theta)
    return np.array([[0.0, -1.0], [spring, 0.5]]), np.diag([0.0, scale**2])


@functools.cache
def record():
    rng = np.random.default_rng(2)
    decay, spread = exact_step(*system(TRUE))(0.25)
    x, values = rng.normal(size=2) * np.sqrt([0.1, 0.4]), []
    for _ in TIMES:
        values.append(x[0] + 0.05 * rng.normal())
        x = rng.multivariate_normal(decay @ x, spread)
    return np.array(values)[:, None]


def log_likelihood(theta):
    law = np.zeros(2), np.diag([0.1, 0.4])
    noise = np.array([[np.exp(2 * theta[2])]])
    seen = TIMES, record(), np.array([[1.0, 0.0]]), noise
    return kalman(exact_step(*system(theta)), *seen, *law, 1).log_likelihood


def log_posterior(theta):
    return log_likelihood(theta) - np.sum(((theta - TRUE) / SD) ** 2) / 2


@functools.cache
def moments():
    """Means and sds, by quadrature around the mode."""
    sizes = [(1.3, 19), (0.9, 13), (0.75, 13)]
    axes = [np.linspace(-reach, reach, num) for reach, num in sizes]
    best = minimize(lambda theta: -log_posterior(theta), TRUE, method="Nelder-Mead").x
    points = best + np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    logs = np.array([log_posterior(point) for point in points])
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    mean = weights @ points
    return mean, np.sqrt(weights @ (points - mean) ** 2)


def assert_posterior(made):
    mean, sd = moments()
    draws = np.asarray(made.theta, float).reshape(-1, 3)
    size = np.asarray(made.effective_sample_size)
    assert (made.r_hat < 1.02).all() and (size > 400).all()
    # Of second order, the steps are off by a few per cent of an sd.
    np.testing.assert_array_less(np.abs(draws.mean(0) - mean), (5 / np.sqrt(size) + 0.05) * sd)
    np.testing.assert_allclose(draws.std(0) / sd, 1, atol=0.05 + 5 / np.sqrt(2 * size.min()))
    assert (np.abs(made.step_error) < 0.1 * sd).all()


@pytest.mark.slow
@pytest.mark.optimised
def test_gibbs_has_the_posterior():
    made = jb.gibbs(
        KEY, MODEL, TIMES, record(), prior=PRIOR, num_iterations=400, num_chains=4, **OPTIONS
    )
    assert_posterior(made)
