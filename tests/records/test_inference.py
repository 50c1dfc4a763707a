"""Posteriors from records with noise, against the likelihood of the Kalman filter on a grid."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import run_program

import jaxbridge as jb
from jaxbridge.engine.checks import nondifferentiable
from jaxbridge.records import (
    as_record_problems,
    linearised,
    noise_and_log_weight,
    path_and_log_weight,
)

TRUE = {"log_rate": 0.0, "log_sigma": 0.0, "log_noise": np.log(0.3)}
TIMES = np.arange(40) * 0.4


def model(params=None, curved=False):
    """dX = -rate X dt + sigma dW, with its noise among its parameters.

    Steps of a linear model are exact. If `curved`, its drift is not linear in form.
    """
    return jb.Diffusion(
        lambda x, p: -jnp.exp(p["log_rate"]) * x + (0 * x**3 if curved else 0),
        lambda x, p: jnp.exp(p["log_sigma"]) * jnp.ones(1),
        lambda x, p: jnp.sum(
            -(x**2) * jnp.exp(p["log_rate"] - 2 * p["log_sigma"])
            + (p["log_rate"] - 2 * p["log_sigma"] - jnp.log(jnp.pi)) / 2
        ),
        params={name: float(value) for name, value in (params or TRUE).items()},
        reversible=True,
        normalised=True,
    )


SEEN = jb.LinearGaussian(covariance=lambda params: jnp.exp(2 * params["log_noise"]))


@functools.cache
def record():
    rng = np.random.default_rng(5)
    x, values = rng.normal() * np.sqrt(0.5), []
    decay = np.exp(-0.4)
    for _ in TIMES:
        values.append(x + 0.3 * rng.normal())
        x = decay * x + np.sqrt((1 - decay**2) / 2) * rng.normal()
    values = np.array(values)[:, None]
    values[7] = np.nan
    return values


def exact_step(rate, V, dt):
    """Decay and variance of a step."""
    decay = np.exp(-rate * dt)
    return decay, V * (1 - decay**2) / (2 * rate)


def ito_taylor_step(rate, V, dt):
    """Those of second order."""
    z = rate * dt
    return 1 - z + z**2 / 2, V * dt * (1 - z + z**2 / 3)


def kalman_log_likelihood(log_rate, log_sigma, log_noise, law=exact_step, num=1, parts=((0, 40),)):
    """Of the parts of the record, each of which begins anew, for arrays of parameters."""
    rate, V, noise = np.exp(log_rate), np.exp(2 * log_sigma), np.exp(2 * log_noise)
    total = 0.0
    for i, j in parts:
        mean, variance = 0.0, V / (2 * rate)
        for k in range(i, j):
            if k > i:
                decay, spread = law(rate, V, (TIMES[k] - TIMES[k - 1]) / num)
                for _ in range(num):
                    mean, variance = decay * mean, decay**2 * variance + spread
            residual, S = record()[k, 0] - mean, variance + noise
            if np.isfinite(residual).all():
                total = total - (residual**2 / S + np.log(2 * np.pi * S)) / 2
                mean, variance = mean + variance / S * residual, variance * noise / S
    return total


def log_prior(params):
    return -sum((params[name] - TRUE[name]) ** 2 for name in TRUE) / 2


@functools.cache
def exact_posterior(**options):
    """Means and sds of (log_noise, log_rate, log_sigma), by quadrature."""
    axes = [np.linspace(-reach, reach, num) for reach, num in [(2.5, 15), (1.4, 15), (4, 21)]]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    points = grid + np.array([TRUE["log_rate"], TRUE["log_sigma"], TRUE["log_noise"]])
    log = kalman_log_likelihood(*points.T, **options) - (grid**2).sum(1) / 2
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    points = points[:, [2, 0, 1]]  # in alphabetical order
    mean = weights @ points
    return mean, np.sqrt(weights @ (points - mean) ** 2)


@pytest.mark.slow
def test_the_likelihood_follows_its_parameters():
    other = {"log_rate": 0.4, "log_sigma": -0.3, "log_noise": -0.8}
    made = jb.log_likelihood(
        jax.random.key(0), model(other), TIMES, record(), observation=SEEN, num_particles=5
    )
    exact = kalman_log_likelihood(*other.values())
    assert abs(made.value - exact) < 2e-3  # that of ten second order steps


@pytest.mark.slow
def test_a_single_chain_is_compiled_in_time():
    """Of one dimension, optimised as for users: LLVM took minutes for a loop that had the random
    number of a decision in its body."""
    run_program(
        """
        import jax, jax.numpy as jnp, numpy as np, jaxbridge as jb
        model = jb.Diffusion(
            lambda x, p: -jnp.exp(p["rate"]) * x,
            lambda x, p: jnp.exp(p["sigma"]) * jnp.ones(1),
            params={"rate": 0.0, "sigma": 0.0, "noise": -1.0},
        )
        made = jb.gibbs(
            jax.random.key(0), model, np.arange(20) * 0.4, np.linspace(-1, 1, 20)[:, None],
            observation=jb.LinearGaussian(covariance=lambda p: jnp.exp(2 * p["noise"])),
            initial=jb.GaussianLaw([0.0], [[1.0]]), prior=jb.NormalPrior(3 * [0.0], 3 * [1.0]),
            num_iterations=50, num_steps=5,
        )
        assert np.isfinite(made.theta).all() and made.parameters_moved.any()
        """
    )


@pytest.mark.slow
def test_rate_sigma_and_noise_are_found():
    """By two steps between observations: the posterior is that of the chain of these steps, and how
    far that is from the exact one is told."""
    posterior = jb.pmmh(
        jax.random.key(0), model(curved=True), TIMES, record(), observation=SEEN, prior=log_prior,
        num_iterations=1500, num_warmup=700, num_chains=4, num_steps=2,
        num_proposals=4,
    )  # fmt: skip
    (exact, _), (of_steps, sd) = exact_posterior(), exact_posterior(law=ito_taylor_step, num=2)
    assert np.all(posterior.r_hat < 1.03)
    error = np.asarray(posterior.standard_error)
    theta = np.asarray(posterior.theta).reshape(-1, 3)
    np.testing.assert_array_less(np.abs(theta.mean(0) - of_steps), 5 * error)
    np.testing.assert_array_less(error, 0.14 * sd)
    np.testing.assert_allclose(theta.std(0), sd, rtol=0.14)
    told, doubt = np.asarray(posterior.step_error), np.asarray(posterior.step_uncertainty)
    assert np.all(np.abs(told - (of_steps - exact)) < 4.5 * doubt)
    assert np.all(doubt < 0.045 * sd)


@pytest.mark.parametrize("law", [lambda params: [0.0], lambda params: jb.GaussianLaw([0.0], [[1]])])
def test_beginnings_may_be_functions_of_parameters(law):
    """In programs of which no derivative is taken, as those of all who infer parameters are."""
    problem = as_record_problems(model(), TIMES, record(), SEEN, law, num_steps=2).problem(0)
    same = nondifferentiable(problem)
    assert same.initial(model().params) is not None and same.initial == problem.initial


@pytest.mark.slow
def test_gradients_are_those_of_differences(x64):
    values = record()[:8]
    paths = jb.innovations(model(), TIMES[:8], values, observation=SEEN, num_steps=3)
    xi = jax.random.normal(jax.random.key(1), (paths.size,))
    theta = jax.tree.map(jnp.asarray, model().params)

    def density(move, along):
        moved = jax.tree.map(lambda leaf, a: leaf + move * a, theta, {**along})
        return paths.log_density(moved, xi + move * jnp.sin(jnp.arange(paths.size)))

    along = {"log_rate": 1.0, "log_sigma": -0.7, "log_noise": 0.5}
    slope = jax.jit(jax.grad(density))(0.0, along)
    value = jax.jit(density)
    differences = (value(1e-4, along) - value(-1e-4, along)) / 2e-4
    assert abs(slope - differences) < 1e-6 * abs(slope)


@pytest.mark.slow
def test_noise_is_that_which_makes_the_path():
    """The inverse of `path_and_log_weight`, to rounding, where noise moves the path everywhere."""
    values, law = record()[:6], jb.GaussianLaw([0.0], [[0.5]])
    problem = as_record_problems(model(), TIMES[:6], values, SEEN, law, num_steps=3).problem(0)
    points, guide, _ = jax.jit(lambda: linearised(problem, model()))()
    noise = jax.random.normal(jax.random.key(2), points.shape)
    path, log_weight = path_and_log_weight(problem, model(), guide, noise)
    again, same = noise_and_log_weight(jax.random.key(3), problem, model(), guide, path)
    np.testing.assert_allclose(again, noise, atol=1e-4)
    assert abs(log_weight - same) < 1e-4
