"""Several records that share a model, against the Kalman filters of each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear_records import plane

import jaxbridge as jb

LONG = plane(9)
SHORT = LONG._replace(times=LONG.times[:6] + 1, values=-LONG.values[5::-1])


def both():
    times, values = [LONG.times, SHORT.times], [LONG.values, SHORT.values]
    return LONG.model, times, values


@pytest.mark.slow
def test_likelihoods_multiply():
    made = jb.log_likelihood(
        jax.random.key(0), *both(), **LONG.options, num_particles=5, num_filters=2, num_steps=4,
        density=jb.EulerDensity(),
    )  # fmt: skip
    exact = LONG.kalman(4).log_likelihood + SHORT.kalman(4).log_likelihood
    assert abs(made.value - exact) < 1e-4
    assert made.effective_sample_size.shape == (15,)
    np.testing.assert_allclose(made.effective_sample_size, 5, rtol=1e-3)


@pytest.mark.slow
def test_paths_of_several_records_are_those_of_each():
    """The noise of a record is as long as that of the longest; the rest of it has no effect."""
    together = jb.innovations(*both(), **LONG.options, num_steps=4)
    noise = np.random.default_rng(0).normal(size=(2, together.size // 2)).astype(np.float32)
    params, other = LONG.model.params, noise * np.array([[1.0], [0.5]], np.float32)
    long, short = together.path(params, jnp.array(noise.ravel()))
    alone = jb.innovations(*SHORT.arguments, **SHORT.options, num_steps=4)
    own, halved = (jnp.array(xi[1, : alone.size]) for xi in (noise, other))
    np.testing.assert_allclose(short, alone.path(params, own), atol=2e-5)
    np.testing.assert_allclose(together.times[1], alone.times, rtol=1e-6)
    np.testing.assert_array_equal(long, together.path(params, jnp.array(other.ravel()))[0])
    # Log weights add, so that the other record does not matter.
    change = together.log_weight(params, jnp.array(noise.ravel()))
    change -= together.log_weight(params, jnp.array(other.ravel()))
    expected = alone.log_weight(params, own) - alone.log_weight(params, halved)
    np.testing.assert_allclose(change, expected, atol=1e-4)
    assert together.start_share().shape == (2,)


@pytest.mark.slow
def test_each_record_is_smoothed():
    """The shorter of two records has the mean and the step error that it has by itself. Steps of
    second order are stored by their noise."""
    model = jb.Diffusion(lambda x, p: -x, lambda x, p: 0.5 * jnp.sqrt(1 + x**2))
    seen = jb.LinearGaussian(covariance=0.05)
    options = {"observation": seen, "initial": [0.5], "num_steps": 4}
    times = [0.4 * np.arange(8), 1.0 + 0.4 * np.arange(4)]
    values = [np.sin(t) for t in times]
    together = jb.smooth(jax.random.key(0), model, times, values, **options)
    (longer, made), (_, short) = together, zip(times, values, strict=True)
    assert longer.paths.shape[2] == 29 and longer.trustworthy
    alone = jb.smooth(jax.random.key(1), model, *short, **options)
    assert made.paths.shape == alone.paths.shape and made.trustworthy
    np.testing.assert_allclose(made.times, alone.times, rtol=1e-6)
    error = np.hypot(made.standard_error(), alone.standard_error())
    np.testing.assert_array_less(np.abs(made.mean() - alone.mean()), 5 * error + 1e-6)
    told, doubt = (made.step_error(), alone.step_error()), made.step_uncertainty()
    np.testing.assert_array_less(np.abs(told[0] - told[1]), 5 * doubt + 1e-6)


@pytest.mark.slow
def test_records_of_one_shape_may_share_their_times():
    model, times = jb.ornstein_uhlenbeck([[1.0]]), np.arange(3) * 0.5
    values = np.linspace(-0.5, 0.5, 6).reshape(2, 3, 1)
    made = jb.log_likelihood(jax.random.key(0), model, times, values, num_particles=50)
    each = [
        jb.log_likelihood(jax.random.key(0), model, times, row, num_particles=50) for row in values
    ]
    error = np.sqrt(made.standard_error**2 + sum(one.standard_error**2 for one in each))
    assert abs(made.value - sum(one.value for one in each)) < 4.5 * error + 1e-5
