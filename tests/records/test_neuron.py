"""FitzHugh and Nagumo's neuron, of which the voltage is read: what guided particles are worth, and
where they say themselves that they are not."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import logsumexp

import jaxbridge as jb
from jaxbridge.exact import log_mean_and_error
from jaxbridge.records import as_record_problems, linearised, run_filters

MODEL = jb.fitzhugh_nagumo()
START = jb.GaussianLaw([0.0, -0.8], jnp.eye(2))
TIMES, N = np.arange(60) * 0.2, 20


def record(noise):
    fine = np.linspace(0, TIMES[-1], 59 * 100 + 1)
    hidden = np.asarray(jb.simulate(jax.random.key(5), MODEL, [0.3, -1.0], fine)[0], float)
    white = np.random.default_rng(0).normal(size=(60, 1))
    seen = jb.LinearGaussian([[1.0, 0.0]], noise**2)
    options = {"observation": seen, "initial": START, "num_steps": N}
    return hidden[::100, :1] + noise * white, options


def bootstrap_filter(key, values, noise, num_particles):
    """log p of the particle filter that knows nothing of what is coming, with the same steps."""
    dynamics, density = MODEL.forward(jnp.zeros(2)), jb.ItoTaylorDensity()

    def step(x, key):
        def one(x, zeta):
            law = density.steps_from(dynamics, x).law(jnp.float32(0.2 / N))
            return law.mean + law.root @ zeta

        return jax.vmap(one)(x, jax.random.normal(key, x.shape)), None

    def weighed(key, x, y):
        log_weight = jax.scipy.stats.norm.logpdf(y, x[:, 0], noise)
        grid = (jnp.arange(num_particles, dtype=x.dtype) + jax.random.uniform(key)) / num_particles
        bounds = jnp.cumsum(jax.nn.softmax(log_weight))
        chosen = jnp.minimum(jnp.searchsorted(bounds, grid), num_particles - 1)
        return x[chosen], logsumexp(log_weight) - np.log(num_particles)

    def interval(x, inputs):
        path_key, resampling_key = jax.random.split(inputs[0])
        x, _ = jax.lax.scan(step, x, jax.random.split(path_key, N))
        return weighed(resampling_key, x, inputs[1])

    start_key, first_key, key = jax.random.split(key, 3)
    x = START.mean + jax.random.normal(start_key, (num_particles, 2))
    x, first = weighed(first_key, x, values[0])
    return first + jnp.sum(jax.lax.scan(interval, x, (jax.random.split(key, 59), values[1:]))[1])


def by_bootstrap(values, noise, num=16):
    """The mean of its estimates, and the error of its log."""
    one = lambda key: bootstrap_filter(key, jnp.asarray(values[:, 0], jnp.float32), noise, 1000)
    run = jax.jit(lambda keys: jax.lax.map(one, keys))
    logs = np.asarray(run(jax.random.split(jax.random.key(1), num)), float)
    weights = np.exp(logs - logs.max())
    return logs.max() + np.log(weights.mean()), weights.std() / weights.mean() / np.sqrt(num)


@pytest.mark.slow
@pytest.mark.optimised
def test_the_likelihood_is_that_of_a_bootstrap_filter():
    values, options = record(0.0316)
    made = jb.log_likelihood(jax.random.key(0), MODEL, TIMES, values, num_particles=300, **options)
    exact, error = by_bootstrap(values, 0.0316)
    error = np.hypot(error, made.standard_error)
    assert made.trustworthy and error < 0.5
    assert abs(made.value - exact) < 4.5 * error
    assert made.log_estimates.std() < 0.3  # of a third of the particles


@pytest.mark.slow
@pytest.mark.optimised
def test_heavy_tails_are_told():
    """With a third as much noise as the voltage has range paths leave the one along which they are
    guided, and few find their way: what sixteen particles say whose guide forgets nothing is too
    small by many standard errors. If the guide forgets what is seen later they find it."""
    noise, num_particles = 0.316, 16
    values, options = record(noise)
    made = jb.log_likelihood(
        jax.random.key(0), MODEL, TIMES, values, num_particles=num_particles, **options
    )
    exact, error = by_bootstrap(values, noise)
    assert made.forgetting > 0
    assert abs(made.value - exact) < 4.5 * np.hypot(error, made.standard_error)

    problem = as_record_problems(MODEL, TIMES, values, **options).problem(0)
    guide = linearised(problem, MODEL).guide
    sure = run_filters(jax.random.key(0), problem, MODEL, guide, (16, num_particles))
    (value,), (standard_error,), _ = log_mean_and_error(sure.log_estimate[None])
    assert error < 0.3 and value - exact < -4 * standard_error
    assert sure.pareto_k.max() > 0.7
    assert not eqx.tree_at(lambda made: made.pareto_k, made, sure.pareto_k).trustworthy
