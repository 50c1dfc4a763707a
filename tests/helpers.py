"""Oracles and gates shared by the tests."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np

import jaxbridge as jb

# The process of section 3 of the paper.
PAPER_B = np.array([[1.5, 1.0], [1.0, 1.5]])
PAPER_CASES = {
    "likely": ([0.0, 0.0], [0.0, 0.0]),
    "unlikely": ([0.785, 0.785], [1.091, 1.091]),
    "very unlikely": ([2.0, -2.0], [3.0, -3.0]),
}


def paper_model():
    return jb.ornstein_uhlenbeck(jnp.asarray(PAPER_B))


def assert_moments(samples, mean, covariance, num_sigma=5.0, mean_allowance=0.0):
    """Sample means and covariances within `num_sigma` standard errors of the exact ones.

    `samples` (n, d) are independent; standard errors are those of a normal law.
    `mean_allowance`, in exact standard deviations, is for a stated error of the method.
    """
    samples, mean, covariance = (np.asarray(a, float) for a in (samples, mean, covariance))
    n = len(samples)
    variance = np.diag(covariance)
    z = (samples.mean(0) - mean) / np.sqrt(variance)
    np.testing.assert_array_less(np.abs(z), num_sigma / np.sqrt(n) + mean_allowance)
    error = np.sqrt((np.outer(variance, variance) + covariance**2) / n)
    deviation = (np.cov(samples.T).reshape(covariance.shape) - covariance) / error
    np.testing.assert_array_less(np.abs(deviation), num_sigma + mean_allowance * np.sqrt(n))


def warped_model(model, forward, backward):
    """The diffusion `X = forward(Y)` for an Ornstein–Uhlenbeck Y, with `backward` the inverse
    of the smooth bijection `forward`: drift and σ by Itô's formula, log ν by the Jacobian.

    Its bridges are images of Gaussian bridges: an exact law for a full, state-dependent σ.
    """

    def coefficients(x, params):
        inner = model.with_params(params)
        y = backward(x)
        jacobian = jax.jacfwd(forward)(y)
        sigma = inner.diffusion(y)
        hessian = jax.jacfwd(jax.jacfwd(forward))(y)
        ito = jnp.einsum("ijk,jl,kl->i", hessian, sigma, sigma) / 2
        return jacobian @ inner.drift(y) + ito, jacobian @ sigma

    def log_stationary(x, params):
        _, log_determinant = log_abs_det_2x2(jax.jacfwd(backward)(x))
        return model.with_params(params).log_stationary(backward(x)) + log_determinant

    return jb.Diffusion(
        lambda x, p: coefficients(x, p)[0],
        lambda x, p: coefficients(x, p)[1],
        log_stationary,
        model.params,
    )


def log_abs_det_2x2(matrix):
    determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    return jnp.sign(determinant), jnp.log(jnp.abs(determinant))


def swirl(y):
    """A bijection of the plane that turns each circle by its own angle."""
    angle = 0.7 * jnp.sqrt(1 + y @ y)
    return jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]]) @ y


def unswirl(x):
    angle = -0.7 * jnp.sqrt(1 + x @ x)
    return jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]]) @ x


def loglog_slope(sizes, errors):
    """The exponent p of errors ∝ sizes^p."""
    return np.polyfit(np.log(sizes), np.log(errors), 1)[0]


@contextlib.contextmanager
def count_compilations():
    """A list that grows by one entry with each program XLA compiles inside the block."""
    compiled = []

    def listen(event, duration, **_):
        if event.endswith("backend_compile_duration"):
            compiled.append(duration)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield compiled
    finally:
        jax.monitoring.clear_event_listeners()
