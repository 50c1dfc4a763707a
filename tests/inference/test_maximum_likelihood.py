"""Maximum likelihood against the maximum of the closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from inference_oracles import (
    multivariate_ou,
    ou_1d,
    ou_data,
    ou_log_likelihood,
    ou_transitions_log_density,
)

import jaxbridge as jb

OPTIONS = dict(
    where=lambda params: params.B,
    num_steps=20,
    proposal=jb.Guided(density=jb.ItoTaylorDensity()),
)


def exact_maximum():
    """By Newton's method, and the inverse of the information there."""
    model, times, observations = multivariate_ou()

    def log_likelihood(b):
        params = model.params._replace(B=b.reshape(2, 2))
        return ou_transitions_log_density(model.with_params(params), times, observations)

    b = model.params.B.reshape(-1)
    derivatives = jax.jit(lambda b: (jax.grad(log_likelihood)(b), jax.hessian(log_likelihood)(b)))
    for _ in range(30):
        gradient, hessian = derivatives(b)
        b = b - 0.7 * jnp.linalg.solve(hessian, gradient)
    assert jnp.abs(gradient).max() < 0.01
    return b, jnp.linalg.inv(-hessian)


@pytest.mark.slow
def test_one_unknown_rate():
    """From near and from far."""
    times = np.arange(0.0, 30.0)
    data = ou_data(1, times)
    grid = np.linspace(0.05, 4, 4_000)
    log_likelihood = ou_log_likelihood(times, data, grid, 1.0)
    exact = grid[log_likelihood.argmax()]
    options = dict(
        where=lambda params: params[0],
        constraint=lambda rate: rate > 0,
        num_steps=15,
        num_bridges=500,
        proposal=jb.ModifiedDiffusionBridge(jb.ItoTaylorDensity()),
    )
    arguments = (jax.random.key(0), ou_1d(), times, data)
    made = jb.maximum_likelihood(*arguments, method="em", num_iterations=60, **options)
    error, sd = float(made.monte_carlo_errors), float(made.standard_errors)
    assert made.newton and made.num_missing == 0 and made.num_truncated == 0
    assert abs(float(made.theta[0]) - exact) < 5 * error + 0.03 * sd and error < 0.1 * sd
    with jax.numpy_dtype_promotion("standard"):  # optax raises a float to a whole number
        far = jb.maximum_likelihood(
            jax.random.key(0), ou_1d(5.0), times, data, num_iterations=20, **options
        )
    assert 4 < far.iterates[-1, 0] < 5  # the search by the optimiser has only begun
    error = float(far.monte_carlo_errors)
    assert far.newton and abs(float(far.theta[0]) - exact) < 5 * error + 0.03 * sd
    assert np.all(np.abs(far.fall - 0.5) < 0.3)


@pytest.mark.parametrize("method", ["em", "gradient"])
@pytest.mark.slow
@pytest.mark.optimised
def test_finds_the_maximum(method):
    model, times, observations = multivariate_ou()
    exact, covariance = exact_maximum()
    with jax.numpy_dtype_promotion("standard"):
        made = jb.maximum_likelihood(
            jax.random.key(0),
            model,
            times,
            observations,
            optax.adam(0.03) if method == "gradient" else None,
            method=method,
            num_iterations=300 if method == "gradient" else 80,
            num_bridges=2_000,
            **OPTIONS,
        )
    assert made.newton and made.num_missing == 0
    sd = np.sqrt(np.diagonal(covariance))
    error = np.asarray(made.monte_carlo_errors).reshape(-1)
    # Beside the Monte Carlo error: what Newton's last step leaves, and the step error.
    np.testing.assert_array_less(np.abs(made.theta - exact), 5 * error + 0.03 * sd)
    assert (error < 0.05 * sd).all()
    np.testing.assert_allclose(made.standard_errors.reshape(-1), sd, rtol=0.1)
    assert np.abs(exact - model.params.B.reshape(-1)).max() > 0.3 * sd.max()
    np.testing.assert_allclose(made.params.B, made.theta.reshape(2, 2))


def test_a_network_is_too_large_for_some():
    model = jb.Diffusion(lambda x, p: p[:1] * x, params=jnp.zeros(301))
    arguments = (jax.random.key(0), model, np.arange(3.0), np.zeros((3, 1)))
    with pytest.raises(ValueError, match="a matrix of 301 × 301 numbers"):
        jb.maximum_likelihood(*arguments, method="em")
    noisy = dict(observation=jb.LinearGaussian(covariance=1.0), initial=[0.0])
    with pytest.raises(ValueError, match=r"301 unknown .* `log_density` of `innovations`"):
        jb.maximum_likelihood(*arguments, **noisy)


@pytest.mark.slow
def test_a_network_is_trained_without_a_hessian():
    """Its drift is nearer to the true one than that of no motion, and the verdict says what is not
    known."""
    true = jb.Diffusion(lambda x, p: -2 * x, [0.5])
    times = 0.2 * np.arange(501)
    values = jb.simulate(jax.random.key(0), true, [0.0], times)[0]
    network = eqx.nn.MLP(1, 1, 16, 2, activation=jnp.tanh, key=jax.random.key(1))
    model = jb.Diffusion(lambda x, p: p(x), [0.5], params=network)
    with jax.numpy_dtype_promotion("standard"):  # optax raises a float to a whole number
        made = jb.maximum_likelihood(
            jax.random.key(2), model, times, values, num_iterations=300, num_steps=4,
            proposal=jb.ModifiedDiffusionBridge(),
        )  # fmt: skip
    assert made.theta.shape == (321,) and made.iterates.shape == (300, 321)
    assert made.covariance is None and "neither its errors" in made.why()
    points = jnp.linspace(-0.4, 0.4, 9)[:, None]  # where the process is
    drift = jax.vmap(model.with_params(made.params).drift)(points)
    assert jnp.sqrt(jnp.mean((drift + 2 * points) ** 2)) < 0.3 < jnp.sqrt(jnp.mean(4 * points**2))
