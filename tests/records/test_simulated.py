"""Simulated observations: the law of the model, and the missing values of the record."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxbridge as jb

KEY = jax.random.key(0)
TIMES, LIKE = np.array([0.0, 0.5, 1.5]), np.array([[0.0], [np.nan], [0.0]])


def simulated(model, number, **options):
    one = lambda key: jb.simulate_observations(key, model, TIMES, LIKE, num_steps=8, **options)
    return np.asarray(jax.vmap(one)(jax.random.split(KEY, number)), float)[..., 0]


def test_ornstein_uhlenbeck():
    seen = jb.LinearGaussian(covariance=0.3)
    initial, n = jb.GaussianLaw([1.0], [[0.4]]), 2000
    made = simulated(jb.ornstein_uhlenbeck([[1.0]]), n, observation=seen, initial=initial)
    assert np.isnan(made[:, 1]).all()
    decay = np.exp(-1.5)
    variances = np.array([0.4, 0.5 + (0.4 - 0.5) * decay**2])
    covariance = np.array([[0.4, 0.4 * decay], [0.4 * decay, variances[1]]]) + 0.3 * np.eye(2)
    both = made[:, [0, 2]]
    np.testing.assert_array_less(
        np.abs(both.mean(0) - [1, decay]), 4.5 * np.sqrt(np.diag(covariance) / n)
    )
    # The standard error of a covariance is at most √2 times the product of the sds over √n.
    np.testing.assert_allclose(np.cov(both.T), covariance, atol=4.5 * np.sqrt(2 / n) * 0.8)


def test_a_stationary_law_that_is_not_normal():
    model = jb.langevin(lambda x, p: -jnp.sum(x**4))
    n = 400
    made = simulated(model, n, observation=jb.LinearGaussian(covariance=0.0))
    # E x² of the density exp(-x⁴) is Γ(3/4) / Γ(1/4), and E x⁴ is 1/4.
    variance = 1.2254167 / 3.6256099
    squares = made[:, [0, 2]] ** 2
    error = np.sqrt((0.25 - variance**2) / n)
    np.testing.assert_array_less(np.abs(squares.mean(0) - variance), 4.5 * error)
