"""Steps that are longer than the relaxation time: nothing is known of what they change."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb

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
