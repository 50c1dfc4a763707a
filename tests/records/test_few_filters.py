"""Standard errors of the mean of a few filters, whose estimates have heavy tails."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_filter import grid_filter
from scipy.special import gammaln

import jaxbridge as jb
from jaxbridge.exact import log_mean_of_runs

MEAN = jax.jit(jax.vmap(log_mean_of_runs))


@pytest.mark.parametrize("spread", [0.1, 0.8])
@pytest.mark.parametrize("num_filters, num_records", [(4, 1), (8, 1), (8, 5)])
def test_errors_of_lognormal_estimates(spread, num_filters, num_records):
    """Logs of filters are nearly normal. Two standard errors hold 95 %, and hardly any error is
    beyond five."""
    spread = spread / np.sqrt(num_records)
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(4000, num_records, num_filters))
    values, errors = MEAN(jnp.asarray(spread * noise - spread**2 / 2, jnp.float32))
    z = np.asarray(values / errors)
    assert 0.9 < np.quantile(np.abs(z), 0.954) / 2 < 1.2
    assert np.mean(np.abs(z) > 5) < 0.006


def test_filters_without_an_estimate():
    """All lost, or one alone: nothing is known; and equal ones have no error."""
    lost, same = np.full((1, 8), -np.inf), np.full((1, 8), -3.0)
    some = np.array([[-np.inf, *np.linspace(-1, 1, 7)]])
    error = MEAN(np.array([lost, same, some], np.float32))[1]
    assert np.isinf(error[0]) and error[1] == 0 and 0.1 < error[2] < 1
    assert np.isinf(MEAN(np.array([some[:, 1:2]], np.float32))[1])


COUNTS = jb.ObservationDensity(
    lambda y, x, p: y[0] * x[0] - jnp.exp(x[0]) - jax.scipy.special.gammaln(y[0] + 1),
    jb.LinearGaussian(covariance=1.5),
)


def counts(seed, rate, sigma):
    """Poisson counts, with an intensity of which the log is an Ornstein–Uhlenbeck process."""
    rng = np.random.default_rng(seed)
    sd, decay = sigma / np.sqrt(2 * rate), np.exp(-rate / 2)
    x, values = sd * rng.normal(), []
    for _ in range(30):
        values.append(rng.poisson(np.exp(x)))
        x = decay * x + sd * np.sqrt(1 - decay**2) * rng.normal()
    return np.arange(30) / 2, np.array(values, float)[:, None]


@pytest.mark.slow
def test_errors_of_counts():
    """Of 48 keys, against a filter on a grid. The root of the mean square of n standard normal
    errors has a standard deviation of about 1 / √(2n)."""
    seed, rate, sigma = 1, 0.5, 1.0
    times, values = counts(seed, rate, sigma)
    sd = sigma / np.sqrt(2 * rate)
    nodes = np.linspace(-6 * sd, 6 * sd, 501)
    logs = values * nodes - np.exp(nodes) - gammaln(values + 1)
    initial = np.exp(-(nodes**2) / (2 * sd**2))
    drift, variance = lambda x: -rate * x, lambda x: sigma**2 + 0 * x
    exact = grid_filter(drift, variance, nodes, initial, np.diff(times), logs).log_likelihood
    model = jb.ornstein_uhlenbeck([[rate]], sigma=jnp.array([[sigma]]))
    law = jb.GaussianLaw([0.0], [[sd**2]])
    made = [
        jb.log_likelihood(
            jax.random.key(i), model, times, values, observation=COUNTS, initial=law, num_steps=10
        )
        for i in range(48)
    ]
    z = np.array([float((each.value - exact) / each.standard_error) for each in made])
    lowest = 1 - 5 / np.sqrt(2 * len(z))
    assert lowest < np.sqrt(np.mean(z**2)) < 1.3 and np.mean(np.abs(z) > 3) <= 1 / 24


def test_many_filters_run_in_batches():
    """Each filter has noise of its own, in the last batch too; records stay apart."""
    times, model = np.arange(4.0), jb.ornstein_uhlenbeck([[1.0]])
    records = [times, times], [[1, 0, 3, 2], [0, 0, 1, 0]]
    options = {"observation": jb.PoissonCounts(), "num_particles": 125, "num_steps": 2}
    many = jb.log_likelihood(jax.random.key(0), model, *records, num_filters=20, **options)
    few = jb.log_likelihood(jax.random.key(1), model, *records, num_filters=8, **options)
    assert many.log_estimates.shape == (20,) and len(np.unique(many.log_estimates)) == 20
    error = np.hypot(many.standard_error, few.standard_error)
    assert abs(many.value - few.value) < 4.5 * error and error < 0.05
    assert many.num_weights == 2500 and many.standard_error < few.standard_error
    np.testing.assert_allclose(
        many.effective_sample_size, few.effective_sample_size, rtol=0.2, atol=1
    )
