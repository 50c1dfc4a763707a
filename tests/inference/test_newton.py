"""Newton's method on log-likelihoods in closed form, and estimates from data without a maximum."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inference_oracles import ou_log_likelihood

import jaxbridge as jb
from jaxbridge.inference.newton import Slope, falls, is_maximum, maximum_faults, newton_passes
from jaxbridge.inference.parameters import as_parameters


def search(log_likelihood, start, noise=0.0, constraint=None):
    """The passes, and whether the end is called a maximum, and one inside."""
    model = jb.Diffusion(lambda x, p: -p * x, params=jnp.asarray(start, jnp.float32))
    parameters = as_parameters(model, None, constraint)

    def evaluate(i, theta, offsets, memory):
        error = noise * jax.random.normal(jax.random.fold_in(jax.random.key(0), i), theta.shape)
        rises = jax.vmap(jax.vmap(lambda move: log_likelihood(theta + move)))(offsets)
        gradient, hessian = jax.grad(log_likelihood)(theta), jax.hessian(log_likelihood)(theta)
        covariance = noise**2 * jnp.eye(len(theta))
        slope = Slope(gradient + error, covariance, -hessian, rises - log_likelihood(theta))
        return slope, None, memory

    made = jax.jit(lambda theta: newton_passes(evaluate, parameters, theta, None))(
        parameters.vector(parameters.params)
    )
    fall = falls(made.slope, made.offsets)
    newton = made.converged & is_maximum(made.slope)
    none, outside = (bool(fault.present) for fault in maximum_faults(newton, fall))
    return made, fall, not none, not outside


def test_steps_go_on_to_the_maximum():
    """Of Poisson counts of two rates, from logs far away; the fall is about a half."""
    data = jnp.array([40.0, 90.0])
    made, fall, found, inside = search(lambda p: data @ p - jnp.sum(jnp.exp(p)), [7.0, 1.5])
    np.testing.assert_allclose(made.theta, np.log(data), atol=1e-5)
    assert found and inside and made.number > 3
    np.testing.assert_allclose(fall, 0.5, atol=0.05)


def test_steps_end_in_the_noise():
    """Within a few Monte Carlo errors; where these are large nothing is found."""
    information = 25.0
    for noise, some in ((0.5, True), (4.0, False)):
        made, _, found, _ = search(lambda p: -information * jnp.sum(p**2) / 2, [1.0], noise)
        assert found == some and np.abs(made.theta[0]) < 5 * noise / information


@pytest.mark.parametrize("correlation", [0.9, 1.1])
def test_parameters_in_very_different_units(correlation):
    """Curvatures 1e8 to 1e-8, of a maximum and of a saddle."""
    scale = jnp.array([1e4, 1.0, 1e-4])
    information = correlation * jnp.ones((3, 3)) + (1 - correlation) * jnp.eye(3)
    information = information * scale[:, None] * scale
    zeros = jnp.zeros(3), jnp.zeros((3, 3)), information, jnp.zeros((2, 3))
    assert bool(is_maximum(Slope(*zeros))) == (correlation < 1)


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_a_slope_that_levels_off_has_no_maximum(scale):
    """Its maximum is at minus infinity: the gradient vanishes and the information is positive."""
    made, fall, found, inside = search(lambda p: -scale * jnp.sum(jnp.exp(p)), [0.0])
    assert not (found and inside)
    assert not found or fall.min() < 0.1
    assert not made.converged or made.slope.information[0, 0] > 0


def test_a_maximum_out_of_the_constraint_is_not_found():
    bound = lambda p: jnp.all(p > 0)
    made, _, found, _ = search(lambda p: -jnp.sum((p + 1.0) ** 2), [2.0], 0.0, bound)
    assert not found and 0 < made.theta[0] < 0.5
    _, fall, found, inside = search(lambda p: -jnp.sum((p - 0.5) ** 2), [2.0], 0.0, bound)
    assert found and inside and np.isinf(fall[0, 0]) and abs(fall[1, 0] - 0.5) < 0.01


@jax.numpy_dtype_promotion("standard")  # optax raises a float to a whole number
def estimate(*arguments, **options):
    return jb.maximum_likelihood(jax.random.key(0), *arguments, **options)


def log_rate():
    """dX = -exp(p) X dt + dW."""
    return jb.Diffusion(lambda x, p: -jnp.exp(p[0]) * x, lambda x, p: jnp.ones(1), params=(-1.0,))


@functools.cache
def drifting():
    """A path that runs away from zero: no rate of return, however small, is small enough."""
    times = np.arange(21) * 0.5
    path = 0.5 + 0.3 * times + 0.3 * np.random.default_rng(1).normal(size=21)
    rates = np.exp(np.array([-8.0, -6, -4, -2, 0]))
    logs = ou_log_likelihood(times, path[:, None], rates, 1.0)
    assert np.all(np.diff(logs) < 0)
    return times, path[:, None]


SHORT = {"num_iterations": 50, "num_bridges": 50, "num_steps": 5}


@pytest.mark.slow
def test_a_record_without_a_maximum():
    times, values = drifting()
    law = jb.GaussianLaw([0.0], [[1.0]])
    seen = jb.LinearGaussian(covariance=0.09)
    made = estimate(log_rate(), times, values, observation=seen, initial=law, **SHORT)
    assert not made.trustworthy and ("no maximum" in made.why() or "No maximum" in made.why())
