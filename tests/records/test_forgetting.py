"""Guides that forget what is seen later: any is a right one, and the better is chosen."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.records import Filtered, as_record_problems, linearised, run_filters
from jaxbridge.records.forgetting import chosen_of, confirmed, loses_least, undecided
from jaxbridge.records.guided_record import forgetful

MODEL = jb.ornstein_uhlenbeck([[1.0]])
SEEN, LAW = jb.LinearGaussian(covariance=0.04), jb.GaussianLaw([0.0], [[0.5]])
TIMES, VALUES = np.arange(6) * 0.5, np.array([0.1, 0.7, -0.2, np.nan, -0.9, 0.3])[:, None]


@pytest.mark.slow
def test_likelihoods_are_unbiased_whatever_is_forgotten():
    """Of a linear model: all weights are equal where nothing is."""
    problem = as_record_problems(MODEL, TIMES, VALUES, SEEN, LAW, num_steps=4).problem(0)
    guide = linearised(problem, MODEL).guide

    @jax.jit
    def filters(rate):
        return run_filters(jax.random.key(0), problem, MODEL, forgetful(guide, rate), (1000, 20))

    exact = filters(jnp.float32(0)).log_estimate
    assert np.ptp(exact) < 1e-4
    for rate in (0.5, 4.0, 1000.0):
        ratio = np.exp(np.asarray(filters(jnp.float32(rate)).log_estimate - exact[0], float))
        error = ratio.std() / np.sqrt(len(ratio))
        assert 1e-4 < error and abs(ratio.mean() - 1) < 5 * error < 0.2


def pilot(log_estimates, size):
    """Of one record, with one end of a segment, where so many of ten particles count."""
    logs = jnp.asarray(log_estimates, jnp.float32)[None]
    sizes = jnp.full((1, logs.shape[1], 1), size, jnp.float32)
    return Filtered(logs, sizes, jnp.zeros((1, 1)), jnp.zeros((1, logs.shape[1]), jnp.int32))


def test_the_rate_with_the_larger_mean_is_chosen():
    better = functools.partial(chosen_of, num_particles=10)
    first = better(undecided(jnp.float32), jnp.float32(0), pilot([-3.0, -5.0], 2.0))
    assert first.rate == 0 and not first.settled
    np.testing.assert_allclose(first.score, -4 - 2 * np.sqrt(2 / 2), rtol=1e-6)  # its spread
    second = better(first, jnp.float32(1), pilot([-2.0, -2.0], 2.0))
    assert second.rate == 1 and not second.settled
    np.testing.assert_allclose(second.score, -2 - 2 * np.sqrt(0.4 / 2), rtol=1e-6)  # what it knows
    for worse in ([-2.2, -2.2], [-jnp.inf, 3.0], [jnp.nan, 3.0]):
        assert better(second, jnp.float32(2), pilot(worse, 2.0)).rate == 1
    equal = pilot([-3.0, -3.001], 10.0)
    assert better(undecided(jnp.float32), jnp.float32(0), equal).settled
    assert second.of_none == first.score
    assert confirmed(second, pilot([-3.0, -3.0], 2.0), 10).rate == 1
    assert confirmed(second, pilot([-6.0, -6.0], 2.0), 10).rate == 0  # it was luck
    nothing = better(undecided(jnp.float32), jnp.float32(0), pilot([-jnp.inf, -jnp.inf], 0.0))
    assert nothing.rate == 0 and not nothing.settled


def test_the_rate_that_loses_least_is_chosen():
    """At one of the models that are likely much is missed at the first, at the second little; a
    third does not count."""
    means = np.array([[-10.0, -13.0, -90.0], [-10.1, -10.3, -95.0], [-10.6, -10.0, -70.0]])
    assert loses_least(jnp.asarray(means, jnp.float32)) == 1
    assert loses_least(jnp.asarray(means[:, :1], jnp.float32)) == 0
    assert loses_least(jnp.array([[-jnp.inf, -3.0], [-4.0, -3.0]])) == 1
    assert loses_least(jnp.full((3, 2), -jnp.inf)) == 0
    assert loses_least(jnp.zeros((3, 2))) == 0  # the least of several


@pytest.mark.slow
def test_nothing_is_forgotten_where_all_weights_are_equal():
    given = {"observation": SEEN, "initial": LAW, "num_steps": 4}
    made = jb.log_likelihood(jax.random.key(0), MODEL, TIMES, VALUES, **given)
    assert made.forgetting == 0 and made.standard_error < 1e-5
