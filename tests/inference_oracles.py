"""Data and exact likelihoods for tests of inference."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

import jaxbridge as jb


def ou_1d(rate=0.8, sigma=1.0):
    """dX = -rate X dt + sigma dW, with parameters (rate, sigma)."""
    return jb.Diffusion(
        lambda x, p: -p[0] * x,
        lambda x, p: p[1] * jnp.ones(1),
        lambda x, p: jnp.sum(-p[0] * x**2 / p[1] ** 2 + jnp.log(p[0] / (jnp.pi * p[1] ** 2)) / 2),
        params=(rate, sigma),
        sample_stationary=lambda key, p: p[1] / jnp.sqrt(2 * p[0]) * jax.random.normal(key, (1,)),
        reversible=True,
        normalised=True,
    )


def ou_data(seed, times, rate=0.8, sigma=1.0):
    """Exact observations of the stationary process, shape (n + 1, 1)."""
    rng = np.random.default_rng(seed)
    sd = sigma / np.sqrt(2 * rate)
    x = [sd * rng.normal()]
    for dt in np.diff(times):
        decay = np.exp(-rate * dt)
        x.append(decay * x[-1] + sd * np.sqrt(1 - decay**2) * rng.normal())
    return np.array(x)[:, None]


def ou_log_likelihood(times, observations, rate, sigma):
    """Of the transitions, for arrays of parameters."""
    rate, sigma = np.asarray(rate, float)[..., None], np.asarray(sigma, float)[..., None]
    dt, x = np.diff(times), np.asarray(observations, float)[:, 0]
    decay = np.exp(-rate * dt)
    variance = sigma**2 * (1 - decay**2) / (2 * rate)
    residual = x[1:] - decay * x[:-1]
    return np.sum(-(residual**2) / (2 * variance) - np.log(2 * np.pi * variance) / 2, axis=-1)


def grid_moments(grid, log_density):
    """Mean and standard deviation of a density on an equidistant grid."""
    weights = np.exp(log_density - log_density.max())
    weights /= weights.sum()
    mean = (weights * grid).sum()
    return mean, np.sqrt((weights * (grid - mean) ** 2).sum())


@functools.cache
def multivariate_ou(seed=0, num_intervals=30, duration=0.5):
    """Exact observations of a process that is not reversible, and its model."""
    B = jnp.array([[1.2, 0.7], [-0.5, 0.9]])
    model = jb.ornstein_uhlenbeck(B, sigma=jnp.array([[0.9, 0.0], [0.2, 1.1]]))
    times = jnp.linspace(0.0, num_intervals * duration, num_intervals + 1)
    keys = jax.random.split(jax.random.key(seed), num_intervals + 1)
    points = [model.sample_stationary(keys[0])]
    advance = jax.jit(lambda x, key: jb.ou_transition(model, x, duration).sample(key))
    for key in keys[1:]:
        points.append(advance(points[-1], key))
    return model, times, jnp.stack(points)


def ou_transitions_log_density(model, times, observations):
    """Σ log p(x_i, x_{i+1}) in closed form, differentiable in the parameters."""

    def one(x, y, dt):
        return jb.ou_transition(model, x, dt).log_density(y)

    return jnp.sum(jax.vmap(one)(observations[:-1], observations[1:], jnp.diff(times)))


def maximum_of(log_likelihood, start):
    """The maximum and the standard errors of a function of positive parameters, by SciPy."""
    options = dict(xatol=1e-9, fatol=1e-9, maxiter=10_000)
    search = optimize.minimize(
        lambda logs: -log_likelihood(np.exp(logs)),
        np.log(start),
        method="Nelder-Mead",
        options=options,
    )
    exact, h = np.exp(search.x), 1e-3 * np.eye(len(start))

    def difference(i, j):
        corners = [(1, 1), (1, -1), (-1, 1), (-1, -1)]
        return sum(a * b * log_likelihood(exact + a * h[i] + b * h[j]) for a, b in corners) / 4e-6

    each = range(len(start))
    information = -np.array([[difference(i, j) for j in each] for i in each])
    return exact, np.sqrt(np.diagonal(np.linalg.inv(information)))
