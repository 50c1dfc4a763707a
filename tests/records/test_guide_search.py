"""The path along which a record is linearised: where the extended Kalman filter finds none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_filter import grid_filter

import jaxbridge as jb
from jaxbridge.records import as_record_problems, check_guide, linearised
from jaxbridge.records.linearisation import stay_inside

VOLTAGE = jb.LinearGaussian([[1.0, 0.0]], 0.01)


def neuron_record(num_steps):
    """Three readings on the left branch, and a first state that may be on either."""
    values = np.array([np.nan, -1.02, -0.90, -0.82])[:, None]
    initial = jb.GaussianLaw([0.0, -0.8], jnp.eye(2))
    return np.arange(4) * 0.2, values, {
        "observation": VOLTAGE, "initial": initial, "num_steps": num_steps
    }  # fmt: skip


def test_a_step_that_would_leave_the_state_space_is_shortened():
    inside = lambda x: x[0] > 0
    at = lambda old, new: float(stay_inside(inside, jnp.array([old]), jnp.array([new]))[0])
    assert at(1.0, 0.5) == 0.5
    assert 0 < at(0.1, -0.075) < 0.1
    assert at(1e-3, -1e6) == pytest.approx(1e-3)  # too far: it stays where it is


@pytest.mark.slow
def test_a_guide_is_found_where_the_filter_is_thrown_off():
    """From the filter alone it passes six standard deviations beside the readings, and no path has
    a weight."""
    times, values, options = neuron_record(num_steps=20)
    model = jb.fitzhugh_nagumo()
    problem = as_record_problems(model, times, values, **options).problem(0)
    guide = linearised(problem, model).guide
    check = check_guide(problem, model, guide)
    assert check.is_usable and check.largest_residual < 2.5
    # In a compiled program it is the same search.
    within = jax.jit(lambda: check_guide(problem, model, linearised(problem, model).guide))()
    np.testing.assert_allclose(within.log_weight, check.log_weight, atol=0.1)
    paths = jb.innovations(model, times, values, **options)
    assert np.isfinite(paths.log_density(model.params, jnp.zeros(paths.size)))
    made = jb.log_likelihood(jax.random.key(0), model, times, values, **options)
    assert made.log_estimates.std() < 0.5


@pytest.mark.slow
def test_a_reading_outside_of_the_state_space():
    """Cox, Ingersoll and Ross's process, with a reading below zero: against a grid."""
    values = np.array([0.2, 0.1, 0.05, -0.075, 0.02, 0.15, 0.3])[:, None]
    times, noise, nodes = np.arange(7) * 0.3, 0.08, np.linspace(5e-4, 1.5, 700)
    model = jb.Diffusion(
        lambda x, p: 0.25 - x, lambda x, p: 0.4 * jnp.sqrt(x), domain=lambda x, p: x[0] > 0
    )
    logs = -((values - nodes) ** 2) / 2 / noise**2 - np.log(noise * np.sqrt(2 * np.pi))
    initial = np.exp(-((nodes - 0.25) ** 2) / 2 / 0.0025)
    variance = lambda x: 0.16 * x
    exact = grid_filter(lambda x: 0.25 - x, variance, nodes, initial, np.diff(times), logs)
    options = {
        "observation": jb.LinearGaussian(covariance=noise**2),
        "initial": jb.GaussianLaw([0.25], [[0.0025]]),
        "num_steps": 20,
    }
    problem = as_record_problems(model, times, values, **options).problem(0)
    points, _, check = linearised(problem, model)
    assert np.all(points > 0) and check.is_usable
    made = jb.log_likelihood(jax.random.key(0), model, times, values, num_particles=500, **options)
    error = 5 * made.standard_error + abs(made.step_error) + 2 * made.step_uncertainty
    assert abs(made.value - exact.log_likelihood) < error < 0.3


@pytest.mark.slow
def test_a_guide_is_finite_where_explicit_steps_explode():
    """A double well whose first state is so far out that paths without noise explode: along one of
    them h is not finite, and no path would have a weight. Others begin further in."""
    a = jnp.float32(1.08)
    model = jb.Diffusion(lambda x, a: jnp.exp(a) * (x - x**3), [[0.7]], params=a)
    values = np.array([2.37, 0.72, 0.78, 1.11, 1.17, 1.02])[:, None]
    options = {"observation": jb.LinearGaussian(covariance=0.04), "num_steps": 10}
    options["initial"] = jb.GaussianLaw([0.0], [[1.0]])
    with pytest.warns(UserWarning, match="zero"):
        paths = jb.innovations(model, np.arange(6) * 0.5, values, **options)
    assert not paths.guide.is_usable and paths.guide.largest_residual < 3
    noise = jax.random.normal(jax.random.key(0), (200, paths.size))
    log_weights = jax.vmap(paths.log_weight, (None, 0))(a, noise)
    assert np.sum(np.isfinite(log_weights)) > 20
    assert not paths.trustworthy and "guide" in paths.why() and "num_steps" in paths.why()
