"""Derivatives in what user functions close over are those in `params`, or the same refusal."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb

KEY = jax.random.key(0)
TIMES = np.array([0.0, 0.5, 1.0])
POINTS = np.array([[0.3], [0.5], [0.1]])
NOISE = 0.04
GUIDED = jb.Guided()
COUPLING = jb.Coupling(0.5, start_law=jb.GaussianLaw([0.0], [[1.0]]))
START = jb.GaussianLaw([0.3], [[0.2]])
THETA = jnp.asarray(0.7)


def drift(x, p):
    return -p * x


def log_nu(x, p):
    return -p * x @ x


def log_normal(y, x, p):
    return -jnp.sum((y - x) ** 2 / p + jnp.log(2 * jnp.pi * p)) / 2


def by_params(theta):
    """A model, an observation model, a density of observations and an initial law."""
    model = jb.Diffusion(drift, None, log_nu, theta)
    guess = jb.LinearGaussian(covariance=NOISE)
    return (
        model,
        jb.LinearGaussian(covariance=lambda p: NOISE * p),
        jb.ObservationDensity(lambda y, x, p: log_normal(y, x, NOISE * p), guess),
        lambda p: jb.GaussianLaw(jnp.array([0.3]) * p, jnp.array([[0.2]])),
    )


def by_closures(theta):
    """The same, made of functions that close over `theta`."""
    model = jb.Diffusion(
        lambda x, p: drift(x, theta), None, lambda x, p: log_nu(x, theta), params=1.0
    )
    guess = jb.LinearGaussian(covariance=NOISE)
    return (
        model,
        jb.LinearGaussian(covariance=lambda p: NOISE * theta),
        jb.ObservationDensity(lambda y, x, p: log_normal(y, x, NOISE * theta), guess),
        lambda p: jb.GaussianLaw(jnp.array([0.3]) * theta, jnp.array([[0.2]])),
    )


def density(proposal):
    def value(model, *_):
        arguments = (KEY, model, [0.3], [0.5], 1.0)
        options = dict(num_proposals=8, num_steps=4, proposal=proposal)
        return jb.transition_log_density(*arguments, **options).value

    return value


def expectation(model, *_):
    fixed = jb.Diffusion(drift, None, log_nu, 0.7)
    options = dict(num_bridges=4, num_steps=4, proposal=GUIDED)
    bridges = jb.sample_weighted_bridges(KEY, fixed, [0.3], [0.5], 1.0, **options)
    return jb.expectation(lambda path: path[2, 0], bridges, model)


def log_likelihood(model, observation, _, initial):
    options = dict(observation=observation, initial=initial, num_particles=8, num_steps=2)
    return jb.log_likelihood(KEY, model, TIMES, POINTS, **options).value


def path_log_likelihood(model, *_):
    return jb.path_log_likelihood(model, TIMES, POINTS)


def simulate(model, *_):
    return jb.simulate(KEY, model, [0.3], TIMES, num_steps=2)[0, -1, 0]


def of_intervals(function, **options):
    def value(model, *_):
        result = function(KEY, model, TIMES, POINTS, num_steps=2, proposal=GUIDED, **options)
        return jax.tree.leaves(result)[0].sum()

    return value


PRIOR = jb.NormalPrior(1.0, 1.0)
FUNCTIONS = {
    "transition_log_density": density(GUIDED),
    "expectation": expectation,
    "path_log_likelihood": path_log_likelihood,
    "simulate": simulate,
    "log_likelihood": log_likelihood,
    "couplings": density(COUPLING),
    "gibbs": of_intervals(jb.gibbs, prior=PRIOR, num_iterations=2),
    "maximum_likelihood": of_intervals(jb.maximum_likelihood, num_iterations=2),
}

NESTINGS = {
    "jit(jacfwd)": lambda f: jax.jit(jax.jacfwd(f)),
    "jit(vmap(grad))": lambda f: lambda x: jax.jit(jax.vmap(jax.grad(f)))(x[None])[0],
}


def outcome(function, made, nesting):
    """The derivative, or the error."""
    try:
        return float(NESTINGS[nesting](lambda theta: function(*made(theta)))(THETA))
    except (TypeError, ValueError) as error:
        return f"{type(error).__name__}: {error}"


def compare(name, nesting):
    right = outcome(FUNCTIONS[name], by_params, nesting)
    if isinstance(right, str):
        assert outcome(FUNCTIONS[name], by_closures, nesting) == right
    else:
        assert right != 0
        assert outcome(FUNCTIONS[name], by_closures, nesting) == pytest.approx(right, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_in_closures_are_those_in_params(name):
    compare(name, "jit(jacfwd)")


@pytest.mark.slow
@pytest.mark.parametrize("nesting", list(NESTINGS)[1:])
def test_under_every_nesting(nesting):
    compare("transition_log_density", nesting)
