"""Derivatives of what `innovations` makes, against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxbridge as jb

PARAMS = {"rate": 0.8, "scale": 0.6, "mean": 0.3, "noise": 0.25}


def drift(x, p):
    return jnp.array([x[1] - p["rate"] * x[0] ** 3, jnp.sin(x[0]) - x[1]])


def sigma(x, p):
    """A full matrix."""
    size = p["scale"] * jnp.sqrt(1 + x @ x / 4)
    return size * jnp.array([[1.0, 0.0], [0.3, 0.8]]) + 0.1 * jnp.diag(jnp.tanh(x))


# Partly exact.
SEEN = jb.LinearGaussian([[1.0, 0.5], [0.0, 1.0]], lambda p: jnp.array([0.0, p["noise"] ** 2]))


@pytest.mark.slow
def test_derivatives_are_differences(x64):
    """In parameters, of drift, σ, noise and initial law, and in noise."""
    values = np.random.default_rng(2).normal(scale=0.5, size=(4, 2))
    values[2, 0] = np.nan
    times = np.array([0.0, 0.3, 0.5, 0.9])
    model = jb.Diffusion(drift, sigma, params=PARAMS)
    initial = lambda p: jb.GaussianLaw(
        jnp.stack([p["mean"], p["mean"] ** 2]), p["scale"] ** 2 * jnp.eye(2)
    )
    options = {"observation": SEEN, "initial": initial, "num_steps": 3}
    paths = jb.innovations(model, times, values, **options)
    theta, of_vector = ravel_pytree(jax.tree.map(jnp.float64, PARAMS))
    xi = jax.random.normal(jax.random.key(0), (paths.size,))
    point = jnp.concatenate([theta + 0.05, xi])

    @jax.jit
    def density(point):
        return paths.log_density(of_vector(point[: len(theta)]), point[len(theta) :])

    slope = jax.jit(jax.grad(density))(point)
    assert np.isfinite(slope).all() and np.all(slope[: len(theta)] != 0)
    scale = max(1, float(np.abs(slope).max()))
    steps = np.eye(len(point))[[*range(len(theta)), len(theta), len(theta) + 3, -1]]
    for step in [*steps, np.random.default_rng(3).normal(size=len(point))]:
        # Differences of fourth order.
        ahead = [float(density(point + k * 1e-3 * step)) for k in (-2, -1, 1, 2)]
        difference = (ahead[0] - 8 * ahead[1] + 8 * ahead[2] - ahead[3]) / 12e-3
        assert abs(slope @ step - difference) < 1e-6 * scale
