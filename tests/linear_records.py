"""Records of linear models, in part and with gaps, of which everything is known."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from kalman import Smoothed, euler_step, exact_step, kalman

import jaxbridge as jb


class LinearRecord(NamedTuple):
    A: np.ndarray
    sigma: np.ndarray
    times: np.ndarray
    values: np.ndarray
    matrix: np.ndarray
    noise: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray

    @property
    def model(self):
        return jb.ornstein_uhlenbeck(jnp.asarray(self.A), sigma=jnp.asarray(self.sigma))

    @property
    def arguments(self):
        """What all who read records are given, after the key."""
        return self.model, self.times, self.values

    @property
    def options(self):
        return {
            "observation": jb.LinearGaussian(self.matrix, self.noise),
            "initial": jb.GaussianLaw(self.mean, self.covariance),
        }

    def kalman(self, num_steps, exact=False, jumps=None) -> Smoothed:
        V = self.sigma @ self.sigma.T
        step = (exact_step if exact else euler_step)(self.A, V)
        seen = (self.times, self.values, self.matrix, self.noise)
        return kalman(step, *seen, self.mean, self.covariance, num_steps, jumps)


def plane(num=30, exact_part=False) -> LinearRecord:
    """A rotation with noise, of which two mixtures are seen at unequal times, some or none."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(num, 2))
    values[3, 0] = values[5] = values[7, 1] = np.nan
    noise = np.diag([0.0, 0.2]) if exact_part else np.array([[0.1, 0.05], [0.05, 0.2]])
    return LinearRecord(
        np.array([[1.0, 2.0], [-2.0, 0.5]]),
        np.array([[0.8, 0.0], [0.3, 0.6]]),
        np.cumsum(rng.uniform(0.1, 0.5, num)),
        values,
        np.array([[1.0, 0.5], [0.0, 1.0]]),
        noise,
        np.array([0.3, -0.2]),
        np.array([[0.5, 0.1], [0.1, 0.4]]),
    )


def four(num=15) -> LinearRecord:
    """Four dimensions that turn in two ways, of which one coordinate and one sum are seen."""
    rng = np.random.default_rng(1)
    A = 0.7 * np.eye(4) + np.kron(np.diag([1.0, 0.4]), np.array([[0, 2.0], [-2.0, 0]]))
    A[0, 2], A[3, 1] = 0.5, -0.3
    values = rng.normal(size=(num, 2))
    values[4, 1] = np.nan
    return LinearRecord(
        A,
        0.5 * np.eye(4) + 0.1 * np.tril(np.ones((4, 4))),
        np.cumsum(rng.uniform(0.2, 0.4, num)),
        values,
        np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 1.0]]),
        np.diag([0.05, 0.1]),
        np.zeros(4),
        0.4 * np.eye(4),
    )
