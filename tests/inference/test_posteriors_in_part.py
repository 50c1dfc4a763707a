"""Where noise reaches a part of the state only: posteriors, against Kalman's likelihood."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_uniform_ranks
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
def test_a_random_walk_with_a_filter_has_the_posterior():
    """All weights are equal: two particles are as good as many."""
    made = jb.pmmh(
        KEY, MODEL, TIMES, record(), prior=PRIOR, num_iterations=2000, num_chains=4,
        num_proposals=2, **OPTIONS,
    )  # fmt: skip
    assert_posterior(made)


@pytest.mark.slow
@pytest.mark.optimised
def test_gibbs_has_the_posterior():
    made = jb.gibbs(
        KEY, MODEL, TIMES, record(), prior=PRIOR, num_iterations=2500, num_chains=4, **OPTIONS
    )
    assert_posterior(made)


@pytest.mark.slow
@pytest.mark.optimised
def test_the_maximum_is_kalmans():
    with jax.numpy_dtype_promotion("standard"):  # optax raises a float to a whole number
        made = jb.maximum_likelihood(
            KEY, MODEL, TIMES, record(), num_iterations=300, num_bridges=40, **OPTIONS
        )
    best = minimize(lambda theta: -log_likelihood(theta), TRUE, method="Nelder-Mead").x
    error = np.sqrt(np.diagonal(made.covariance))
    allowed = 5 * np.asarray(made.monte_carlo_errors) + 0.1 * error
    np.testing.assert_array_less(np.abs(made.theta - best), allowed)


@pytest.mark.slow
@pytest.mark.optimised
def test_ranks_of_true_parameters_are_uniform():
    """Simulation-based calibration (Talts et al. 2018) with a force that is not linear, and data of
    short steps."""
    num_sets, num_draws, num_fine, gap = 80, 31, 20, 0.25
    mean, sd = jnp.array([1.0, -0.3, -2.0]), jnp.array([0.3, 0.3, 0.4])

    def force(x, p):
        return jnp.stack([x[1], -jnp.exp(p[0]) * jnp.sin(x[0]) - 0.5 * x[1]])

    model = jb.Diffusion(force, sigma, params=mean)

    def one_set(key):
        parameter_key, start_key, path_key, noise_key, run_key = jax.random.split(key, 5)
        theta = mean + sd * jax.random.normal(parameter_key, (3,))
        fine = gap / num_fine

        def step(x, key):
            velocity = x[1] + jnp.exp(theta[1]) * np.sqrt(fine) * jax.random.normal(key)
            # The splitting of Leimkuhler & Matthews: of second order in law.
            middle = x[0] + fine / 2 * x[1]
            kick = -jnp.exp(theta[0]) * jnp.sin(middle) - 0.5 * x[1]
            x = jnp.stack([middle + fine / 2 * (velocity + fine * kick), velocity + fine * kick])
            return x, x[0]

        start = jnp.sqrt(jnp.array([0.1, 0.4])) * jax.random.normal(start_key, (2,))
        later = jax.lax.scan(step, start, jax.random.split(path_key, 20 * num_fine))[1]
        values = jnp.concatenate([start[:1], later[num_fine - 1 :: num_fine]])[:, None]
        values = values + jnp.exp(theta[2]) * jax.random.normal(noise_key, values.shape)
        made = jb.gibbs(
            run_key, model, np.arange(21) * gap, values, prior=jb.NormalPrior(mean, sd**2),
            num_iterations=num_draws, num_warmup=300, thin=20, **OPTIONS,
        )  # fmt: skip
        return jnp.sum(made.theta < theta, axis=0)

    keys = jax.random.split(KEY, num_sets)
    ranks = np.asarray(jax.jit(jax.vmap(one_set))(keys)).reshape(num_sets, 3)
    assert_uniform_ranks(ranks, num_draws)
