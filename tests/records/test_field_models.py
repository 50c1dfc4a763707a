"""Models that people bring: populations that never are negative."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import logsumexp

import jaxbridge as jb

RATES = jnp.log(jnp.array([0.5, 0.0025, 0.3]))
NUM_STEPS, NOISE = 5, 10.0


def hazards(x, p):
    """Births of prey, meetings, and deaths of predators."""
    birth, meeting, death = jnp.exp(p)
    return birth * x[0], meeting * x[0] * x[1], death * x[1]


def lotka_volterra_drift(x, p):
    births, meetings, deaths = hazards(x, p)
    return jnp.stack([births - meetings, meetings - deaths])


def lotka_volterra_sigma(x, p):
    births, meetings, deaths = hazards(x, p)
    first = jnp.sqrt(births + meetings)
    across = -meetings / first
    second = jnp.sqrt(meetings + deaths - across**2)
    return jnp.stack([jnp.stack([first, jnp.zeros_like(first)]), jnp.stack([across, second])])


@functools.cache
def populations():
    """The chemical Langevin equation, observed at unit intervals with noise; Euler's steps, for
    one law of all."""
    model = jb.Diffusion(
        lotka_volterra_drift,
        lotka_volterra_sigma,
        params=RATES,
        domain=lambda x, p: jnp.all(x > 0),
    )
    times = np.arange(31.0)
    start = jnp.array([100.0, 100.0])
    hidden = jb.simulate(jax.random.key(4), model, start, np.linspace(0, 30, 3001))[0, ::100]
    observations = np.asarray(hidden) + NOISE * np.random.default_rng(1).normal(size=(31, 2))
    observations[0] = np.nan
    options = dict(
        observation=jb.LinearGaussian(covariance=NOISE**2), initial=start, num_steps=NUM_STEPS
    )
    return (model, times, observations), options


def bootstrap_filter(key, values, num_particles):
    """log p̂ of the particle filter that knows nothing of what is coming."""

    def step(x, key):
        noise = jax.random.normal(key, (2,)) / np.sqrt(NUM_STEPS)
        x = x + lotka_volterra_drift(x, RATES) / NUM_STEPS + lotka_volterra_sigma(x, RATES) @ noise
        return x, jnp.all(x > 0)

    def one(x, inputs):
        key, y = inputs
        keys = jax.random.split(key, (num_particles + 1, NUM_STEPS))
        x, inside = jax.vmap(lambda x, keys: jax.lax.scan(step, x, keys))(x, keys[1:])
        square = jnp.sum((x - y) ** 2, axis=-1) / NOISE**2
        log_weight = -square / 2 - 2 * np.log(NOISE) - np.log(2 * np.pi)
        log_weight = jnp.where(jnp.all(inside, axis=-1), log_weight, -jnp.inf)
        grid = jnp.arange(num_particles, dtype=x.dtype) + jax.random.uniform(keys[0, 0])
        bounds = jnp.cumsum(jax.nn.softmax(log_weight))
        ancestors = jnp.minimum(jnp.searchsorted(bounds, grid / num_particles), num_particles - 1)
        return x[ancestors], logsumexp(log_weight) - np.log(num_particles)

    x = jnp.full((num_particles, 2), 100.0)
    inputs = jax.random.split(key, len(values)), values
    return jnp.sum(jax.lax.scan(one, x, inputs)[1])


@pytest.mark.slow
def test_the_likelihood_of_populations_is_that_of_a_bootstrap_filter():
    """Of the same Euler steps."""
    (model, times, observations), options = populations()
    options = options | {"density": jb.EulerDensity()}
    made = jb.log_likelihood(
        jax.random.key(0), model, times, observations, num_particles=100, **options
    )
    keys = jax.random.split(jax.random.key(1), 100)
    values = jnp.asarray(observations[1:], jnp.float32)
    log_estimates = np.asarray(
        jax.jit(lambda keys: jax.lax.map(lambda key: bootstrap_filter(key, values, 1000), keys))(
            keys
        ),
        float,
    )
    estimates = np.exp(log_estimates - log_estimates.max())
    log_mean = np.log(estimates.mean()) + log_estimates.max()
    error = np.hypot(estimates.std() / estimates.mean() / 10, float(made.standard_error))
    assert error < 0.1
    assert abs(float(made.value) - log_mean) < 4.5 * error
    assert made.effective_sample_size.min() > 50  # of a hundred
