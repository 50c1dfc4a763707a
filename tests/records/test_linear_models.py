"""Where everything is linear: likelihoods are Kalman's, and paths those of the smoother.

Weights that are all equal leave no room for error: what is off anywhere shows in the sixth digit.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear_records import four, plane

import jaxbridge as jb

KEY = jax.random.key(0)
PLANE, FOUR = plane(exact_part=True), four()


@pytest.mark.slow
def test_the_filter_is_kalmans():
    record = PLANE
    made = jb.log_likelihood(
        KEY,
        *record.arguments,
        **record.options,
        num_steps=40,
        num_particles=10,
        density=jb.EulerDensity(),
    )
    euler, exact = record.kalman(40), record.kalman(40, exact=True)
    size = abs(euler.log_likelihood)
    assert abs(made.value - euler.log_likelihood) < 1e-4 * max(size, 1)
    assert np.ptp(np.asarray(made.log_estimates)) < 1e-5 * max(size, 1)  # weights all equal
    np.testing.assert_allclose(made.effective_sample_size, 10, rtol=1e-3)
    assert made.num_nonfinite == 0 and made.unexplained == -1
    # The step error is told, to its leading term.
    true = float(made.value) - exact.log_likelihood
    assert abs(made.step_error - true) < 0.5 * abs(true)


@pytest.mark.slow
def test_the_first_state_may_be_known_in_part():
    """Known but for a normal number along one direction: the likelihood, and the path's mean."""
    along = [1.0, -0.5]
    record = plane(8)._replace(covariance=0.3 * np.outer(along, along))
    arguments = (KEY, *record.arguments)
    options = {**record.options, "num_steps": 2, "density": jb.EulerDensity()}
    exact = record.kalman(2)
    made = jb.log_likelihood(*arguments, **options, num_particles=4, num_filters=2)
    assert abs(made.value - exact.log_likelihood) < 1e-4 * abs(exact.log_likelihood)
    paths = jb.smooth(*arguments, **options, num_draws=200, num_warmup=10)
    error = np.asarray(paths.standard_error())
    np.testing.assert_array_less(np.abs(paths.mean() - exact.mean), 5 * error + 1e-5)
    fixed = np.array([along[1], -along[0]])
    np.testing.assert_allclose(paths.paths[:, :, 0] @ fixed, record.mean @ fixed, atol=1e-5)


@pytest.mark.slow
def test_the_filter_is_kalmans_to_many_digits(x64):
    """The model is not reversible; it is seen in part, at unequal times, some not at all."""
    record = FOUR
    made = jb.log_likelihood(
        KEY,
        *record.arguments,
        **record.options,
        num_steps=10,
        num_particles=2,
        num_filters=2,
        density=jb.EulerDensity(),
    )
    assert abs(made.value - record.kalman(10).log_likelihood) < 1e-4
    true = float(made.value) - record.kalman(10, exact=True).log_likelihood
    assert abs(true) < abs(made.step_error) + 2 * made.step_uncertainty
    assert 0.25 * abs(made.step_error) < made.step_uncertainty < jnp.inf


@pytest.mark.slow
def test_the_default_steps_are_exact_and_others_of_second_order():
    record = PLANE
    options = {**record.options, "num_particles": 10, "num_steps": 20}
    exact, euler = record.kalman(20, exact=True), record.kalman(20)
    made = jb.log_likelihood(KEY, *record.arguments, **options | {"num_steps": 1})
    size = max(abs(exact.log_likelihood), 1)
    assert abs(made.value - exact.log_likelihood) < 1e-4 * size and made.step_error == 0
    options["density"] = jb.ItoTaylorDensity()
    made = jb.log_likelihood(KEY, *record.arguments, **options)
    error = abs(float(made.value) - exact.log_likelihood)
    assert error < 0.1 * abs(euler.log_likelihood - exact.log_likelihood)
    assert abs(made.step_error) > 0.5 * error


@pytest.mark.slow
def test_innovations_are_weighted_alike():
    record = PLANE
    paths = jb.innovations(
        *record.arguments, **record.options, num_steps=10, density=jb.EulerDensity()
    )
    xi = jax.random.normal(KEY, (5, paths.size))
    log_weights = jax.jit(jax.vmap(lambda xi: paths.log_weight(record.model.params, xi)))(xi)
    exact = record.kalman(10).log_likelihood
    np.testing.assert_allclose(log_weights, exact, rtol=2e-5)
    assert paths.times.shape == (len(record.times) * 10 - 9,)
    np.testing.assert_allclose(paths.times[::10], record.times, rtol=1e-5)


@pytest.mark.slow
def test_smoothed_paths_are_those_of_rauch_tung_and_striebel():
    record = PLANE
    made = jb.smooth(
        KEY,
        *record.arguments,
        **record.options,
        num_steps=5,
        num_draws=500,
        num_warmup=50,
        density=jb.EulerDensity(),
    )
    exact = record.kalman(5)
    sd = np.sqrt(np.diagonal(exact.covariance, axis1=1, axis2=2))
    moving = sd > 1e-3
    error = np.asarray(made.standard_error())
    z = (np.asarray(made.mean()) - exact.mean)[moving] / error[moving]
    assert np.max(np.abs(z)) < 4.5 and np.std(z) < 1.5
    square = lambda path: (path - exact.mean.astype(path.dtype)) ** 2
    error = np.asarray(made.standard_error(square))
    z = (np.asarray(made.mean(square)) - sd**2)[moving] / error[moving]
    assert np.max(np.abs(z)) < 4.5 and np.std(z) < 1.5
    assert np.all(error[moving] < 0.1 * sd[moving] ** 2)
    # Euler steps of this length are off by .06 to .1 standard deviations; nothing else is wrong.
    faults = made.why().splitlines()
    assert all("discretisation" in fault or "No fault" in fault for fault in faults)
    assert np.all(made.accepted[made.accepted > 0] > 0.99)  # guiding is exact here
    seen = np.isfinite(record.values[:, 0])
    shown = np.asarray(made.paths[:, :, ::5])[..., seen, :] @ record.matrix[0]
    expected = np.broadcast_to(record.values[seen, 0], shown.shape)
    np.testing.assert_allclose(shown, expected, atol=1e-5)


@pytest.mark.slow
def test_where_nothing_is_seen_paths_are_those_of_the_model():
    model = jb.ornstein_uhlenbeck([[1.0]])
    nothing = np.full((5, 1), np.nan)
    options = {"observation": jb.LinearGaussian(covariance=0.1), "num_steps": 4}
    made = jb.log_likelihood(KEY, model, np.arange(5.0), nothing, num_particles=4, **options)
    assert abs(made.value) < 1e-5
    paths = jb.smooth(KEY, model, np.arange(5.0), nothing, num_draws=500, **options).paths
    assert abs(float(jnp.var(paths)) - 0.5) < 0.06  # step error and noise
