"""Oracles and gates shared by the tests."""

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
