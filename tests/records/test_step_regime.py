"""Steps longer than the relaxation time or than a cycle: nothing is known of what they change."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.records.several import as_record_problems
from jaxbridge.records.step_regime import steps_are_too_long

# Linear, but not in form: steps of linear models are exact.
MODEL = jb.Diffusion(lambda x, p: -p * x + 0 * x**3, [[1.0]], params=jnp.float32(1.0))
TIMES, VALUES = np.arange(4) * 20.0, np.array([0.5, -0.2, 0.9, 0.1])[:, None]
RECORD = {
    "observation": jb.LinearGaussian(covariance=0.01),
    "initial": jb.GaussianLaw([0.0], [[0.5]]),
    "num_steps": 10,
}


@pytest.mark.slow
def test_smoothed_paths_of_steps_that_are_too_long():
    made = jb.smooth(
        jax.random.key(0), MODEL, TIMES, VALUES, num_draws=40, num_warmup=10, num_chains=2, **RECORD
    )
    assert np.all(np.isinf(made.step_uncertainty())) and not made.trustworthy


@pytest.mark.slow
def test_posteriors_of_steps_that_are_too_long():
    posterior = jb.pmmh(
        jax.random.key(0), MODEL, TIMES, VALUES, prior=jb.NormalPrior(1.0, 0.01),
        num_iterations=60, **RECORD,
    )  # fmt: skip
    assert np.all(np.isinf(posterior.step_uncertainty)) and not posterior.trustworthy
    assert "num_steps" in posterior.why() and "longer than the relaxation" in posterior.why()


@pytest.mark.parametrize(
    ("in_drift", "in_sigma", "num_steps", "too_long"),
    [(5.0, 0.0, 4, True), (5.0, 0.0, 32, False), (0.0, 0.9, 4, True), (0.0, 0.9, 32, False)],
)
def test_a_cycle_within_a_step_is_noticed(in_drift, in_sigma, num_steps, too_long):
    """Four cycles in each interval: with four steps, or two, all have the same phase."""
    cycle = lambda t: jnp.sin(8 * np.pi * t)
    model = jb.Diffusion(
        lambda x, p, t: p[0] * cycle(t) ** 2 - x - x**3 / 100,
        lambda x, p, t: 1 + p[1] * cycle(t) * jnp.ones(1),
        params=jnp.array([in_drift, in_sigma]),
    )
    arguments = np.arange(4.0), np.zeros(4), jb.LinearGaussian(covariance=0.01), [0.0]
    problem = as_record_problems(model, *arguments, num_steps=num_steps).problem(0)
    path = jnp.zeros((3 * num_steps + 1, 1))
    assert bool(steps_are_too_long(problem, model, path)) is too_long
