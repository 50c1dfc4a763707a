"""Density of each reading given the states before and after, by exact laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxbridge as jb
from jaxbridge.records import as_record_problems, guided, log_densities_left_out

KEY, NOISE = jax.random.key(0), 0.2
# An irregular record, with a missing reading.
VALUES = np.array([0.3, 1.1, -0.4, np.nan, 0.8, 0.1, 0.6])[:, None]
TIMES = np.array([0.0, 0.4, 1.3, 1.5, 2.5, 2.6, 3.4])


RATE, START = 0.7, (0.2, 0.9)
MODEL, INITIAL = jb.ornstein_uhlenbeck([[RATE]]), jb.GaussianLaw([0.2], [[0.9]])


def left_out(keys, observation, values, knots, num_steps=4):
    """Estimates for each reading, shape (keys, readings), linearised along zero."""
    problem = as_record_problems(
        MODEL, TIMES[: len(values)], values, observation, INITIAL, num_steps=num_steps
    ).problem(0)
    points = jnp.zeros((len(knots), 1))
    linearisation = points, guided(problem, MODEL, points)
    arguments = problem, MODEL, linearisation, jnp.asarray(knots)[:, None]
    estimate = lambda key: log_densities_left_out(key, *arguments)
    return np.asarray(jax.jit(jax.vmap(estimate))(keys))


def law_given_neighbours(k, states, values):
    """Mean and sd of x_k given the states before and after.

    The first and the last state are not fixed: their readings are given.
    """
    num = len(values)
    near = [i for i in (k - 1, k + 1) if 0 <= i < num]
    at_edge = np.isin(near, [0, num - 1])
    known = np.where(at_edge, values[near, 0], states[near])
    times = TIMES[[k, *near]]
    decay, stationary = np.exp(-RATE * times), 1 / (2 * RATE)
    covariance = stationary * np.exp(-RATE * np.abs(np.subtract.outer(times, times)))
    covariance += (START[1] - stationary) * np.outer(decay, decay)
    covariance[1:, 1:] += NOISE * np.diag(at_edge)
    gain = np.linalg.solve(covariance[1:, 1:], covariance[1:, 0])
    mean = START[0] * decay[0] + gain @ (known - START[0] * decay[1:])
    return mean, np.sqrt(covariance[0, 0] - gain @ covariance[1:, 0])


@pytest.mark.parametrize("num", [2, 6, 7])
def test_linear_model(num):
    values = VALUES[:num]
    knots = np.random.default_rng(0).normal(size=4 * (num - 1) + 1)
    found = left_out(KEY[None], jb.LinearGaussian(covariance=NOISE), values, knots)[0]
    for k in range(num):
        mean, sd = law_given_neighbours(k, knots[::4], values)
        expected = stats.norm.logpdf(values[k, 0], mean, np.sqrt(sd**2 + NOISE))
        # A missing reading has the density 1.
        np.testing.assert_allclose(found[k], np.nan_to_num(expected), atol=2e-4)


def test_counts():
    """The density of inner readings is estimated without bias, as that of the ends is exact."""
    values = np.array([[1.0], [0.0], [2.0], [3.0], [np.nan], [0.0], [1.0]])
    knots = np.random.default_rng(0).normal(size=4 * 6 + 1)
    seen = jb.PoissonCounts()
    found = np.exp(left_out(jax.random.split(KEY, 400), seen, values, knots))
    for k in (2, 3):
        mean, sd = law_given_neighbours(k, knots[::4], values)
        x = mean + sd * np.linspace(-8, 8, 2001)
        weights = stats.norm.pdf(x, mean, sd) * (x[1] - x[0])
        expected = weights @ stats.poisson.pmf(values[k, 0], np.exp(x))
        error = found[:, k].std() / np.sqrt(len(found))
        assert abs(found[:, k].mean() - expected) < 4.5 * error + 1e-4 * expected
        assert error < 0.03 * expected
    assert (found[:, 4] == 1).all()
