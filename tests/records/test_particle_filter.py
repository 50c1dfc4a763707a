"""What one filter knows of its own error, and likelihoods of states that were seen exactly."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow_beyond
from scipy import stats

import jaxbridge as jb
from jaxbridge.records import as_record_problems, linearised, run_filters

MODEL = jb.ornstein_uhlenbeck([[1.0]])
TIMES, COUNTS = np.arange(4) * 0.3, np.array([2.0, 1, 0, 5])[:, None]
GUESS = jb.LinearGaussian([[3.0]], 4.0)


def filters(log_density, num_particles, num_filters=500):
    problem = as_record_problems(
        MODEL, TIMES, COUNTS, jb.ObservationDensity(log_density, GUESS),
        jb.GaussianLaw([0.0], [[0.5]]), num_steps=4,
    ).problem(0)  # fmt: skip
    guide, size = linearised(problem, MODEL).guide, (num_filters, num_particles)
    run = jax.jit(lambda key: run_filters(key, problem, MODEL, guide, size))
    return run(jax.random.key(0))


def of_count(y, x, p):
    return y[0] * x[0] - jnp.exp(x[0])


def nearly_normal(y, x, p):
    return -((y[0] - 3 * x[0]) ** 2) / 6


@pytest.mark.slow
@pytest.mark.parametrize(
    "log_density, resampled", slow_beyond(1, [(of_count, True), (nearly_normal, False)])
)
def test_a_filter_knows_its_own_variance(log_density, resampled):
    """Resampled or not, up to what is of second order and the spread of 500."""
    made = filters(log_density, 200)
    assert np.any(made.size < 100) == resampled
    told, seen = np.mean(made.variance(200)), np.var(made.log_estimate)
    np.testing.assert_allclose(told, seen, rtol=5 * np.sqrt(2 / 500) + 0.05)


@pytest.mark.slow
def test_a_filter_that_lost_all_particles_knows_nothing():
    made = filters(lambda y, x, p: jnp.where(y[0] == 5, -jnp.inf, 0.0), 20, 3)
    assert np.all(made.log_estimate == -np.inf) and np.all(made.variance(20) == np.inf)


@pytest.mark.slow
def test_states_seen_exactly():
    """The sum of the transition densities, given the first."""
    times, points = np.array([0.0, 0.4, 1.0, 1.3]), np.array([0.2, -0.3, 0.1, 0.6])
    made = jb.log_likelihood(
        jax.random.key(0), MODEL, times, points[:, None], num_particles=2000, num_steps=20
    )
    decay = np.exp(-np.diff(times))
    sd = np.sqrt((1 - decay**2) / 2)
    exact = stats.norm.logpdf(points[1:], decay * points[:-1], sd).sum()
    error = 4.5 * made.standard_error + np.abs(made.step_error) + 2 * made.step_uncertainty
    assert abs(made.value - exact) < error < 0.2
    assert made.effective_sample_size.shape == (3,)


def test_what_is_not_to_be_trusted():
    good = jb.LogLikelihood(
        jnp.array(-3.0), jnp.array(0.1), jnp.full(8, -3.0), jnp.full(5, 30.0),
        jnp.full(5, 0.73), 4000, jnp.int32(0), jnp.array(0.05), jnp.array(0.02), jnp.array(0.0),
    )  # fmt: skip
    assert good.trustworthy
    for change in (
        {"value": jnp.array(-jnp.inf)},
        {"standard_error": jnp.array(0.7)},
        {"effective_sample_size": jnp.array([30.0, 30.0, 2.0, 30.0, 30.0])},
        {"pareto_k": jnp.array([0.3, 0.3, 0.9, 0.3, 0.3])},
        # Of so few weights, lighter tails are too heavy.
        {"num_weights": 240, "effective_sample_size": jnp.full(5, 15.0)},
        {"step_error": jnp.array(0.3)},
        {"step_uncertainty": jnp.array(jnp.inf)},
    ):
        assert not dataclasses.replace(good, **change).trustworthy
    # The tail of nearly equal weights is a small part of their sum; here of 500 particles a filter.
    for effective, is_right in [(300.0, False), (450.0, True)]:
        heavy = {"pareto_k": jnp.full(5, 0.95), "effective_sample_size": jnp.full(5, effective)}
        assert dataclasses.replace(good, **heavy).trustworthy == is_right
