"""What draws of paths say of themselves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kalman import exact_step, kalman

import jaxbridge as jb
from jaxbridge.records.several import as_record_problems
from jaxbridge.records.smooth import Smoothed

SEEN = jb.LinearGaussian(covariance=1.0)


def smoothed(paths, stuck=False, num_truncated=0, model=None):
    """A result with these paths of two steps; by default of a Brownian motion, whose steps are
    exact."""
    model = jb.Diffusion(lambda x, p: 0 * x) if model is None else model
    values, law = jnp.zeros((2, paths.shape[-1])), jnp.zeros(paths.shape[-1])
    record = jnp.array([0.0, 2.0]), values, SEEN, law
    problem = as_record_problems(model, *record, num_steps=2).problem(0)
    flags = jnp.full(len(paths), stuck)
    truncated = jnp.int32(num_truncated)
    return Smoothed(jnp.arange(3.0), paths, jnp.ones((2, 1)), flags, truncated, problem)


@pytest.mark.slow
def test_chains_in_two_wells_know_little():
    """The error of the mean of two chains that each stayed in a well is of the size of the gap."""
    paths = 0.1 * jax.random.normal(jax.random.key(0), (4, 500, 3, 1))
    together = smoothed(paths)
    np.testing.assert_allclose(together.standard_error(), 0.1 / np.sqrt(2000), rtol=0.2)
    assert together.trustworthy and not smoothed(paths, stuck=True).trustworthy
    apart = smoothed(paths.at[::2].add(2.0))
    assert (np.asarray(apart.standard_error()) > 0.3).all()
    assert (np.asarray(apart.effective_sample_size()) < 8).all() and not apart.trustworthy


def test_a_long_stay_is_a_fault():
    """Of one point of one chain, at a value that others take as well, so that R̂ stays near 1."""
    paths = jax.random.normal(jax.random.key(0), (4, 1000, 3, 1))
    short, long = (paths.at[1, 300 : 300 + n, 1].set(0.5) for n in (40, 70))
    assert smoothed(short).trustworthy and not smoothed(long).trustworthy
    assert "stayed the same" in smoothed(long).why()


def test_a_point_that_never_moves_is_no_disagreement():
    paths = jax.random.normal(jax.random.key(0), (4, 500, 3, 1)).at[:, :, 0].set(1.0)
    assert smoothed(paths).trustworthy


def test_rounding_of_what_was_observed_exactly_is_no_disagreement():
    """Chains differ by a unit in the last place, each by its own, and R̂ of that is not defined."""
    paths = jax.random.normal(jax.random.key(0), (4, 500, 3, 1))
    units = jnp.arange(4.0)[:, None, None] * 2e-7
    noise = 1e-8 * jax.random.normal(jax.random.key(1), (4, 500, 1))
    result = smoothed(paths.at[:, :, 0].set(1.0 + units + noise))
    assert np.isnan(result.r_hat()[0, 0]) and result.trustworthy


def oscillator(rate, gap, num_steps, density):
    """The result, and the largest and the root mean square error of means, in posterior sds."""
    A = np.array([[0.0, -1.0], [rate**2, 0.1 * rate]])
    sigma, matrix = np.diag([0.3, 0.3 * rate]), np.array([[1.0, 0.0]])
    rng, times = np.random.default_rng(0), gap * np.arange(8)
    values = np.cos(rate * times)[:, None] + 0.2 * rng.normal(size=(8, 1))
    start = np.zeros(2), np.eye(2)
    exact = kalman(
        exact_step(A, sigma @ sigma.T), times, values, matrix, 0.04 * np.eye(1), *start, num_steps
    )
    result = jb.smooth(
        jax.random.key(1),
        jb.Diffusion(lambda x, p: -p @ x, jnp.asarray(sigma, jnp.float32), params=jnp.asarray(A)),
        times,
        values,
        observation=jb.LinearGaussian(matrix=matrix, covariance=0.04),
        initial=jb.GaussianLaw(*start),
        num_draws=300,
        num_warmup=100,
        num_steps=num_steps,
        density=density,
    )
    sd = np.sqrt(np.diagonal(exact.covariance, axis1=1, axis2=2))
    return result, (np.asarray(result.mean(), float) - exact.mean) / sd, sd


@pytest.mark.slow
def test_step_errors_of_a_fast_oscillator():
    """Means off by a tenth of a posterior sd are told, within a half of it; off by two nothing
    is known, and a number would mislead."""
    law = jb.ItoTaylorDensity()
    coarse, off, sd = oscillator(10.0, 0.3, 16, law)
    assert not coarse.trustworthy and "discretisation error" in coarse.why()
    told = np.asarray(coarse.step_error(), float) / sd
    assert np.sqrt(np.mean(off**2)) > 0.06
    assert np.sqrt(np.mean((off - told) ** 2)) < 0.7 * np.sqrt(np.mean(off**2))
    hopeless, off, _ = oscillator(10.0, 1.0, 8, law)
    assert np.max(np.abs(off)) > 2 and not hopeless.trustworthy
    assert np.all(np.isnan(hopeless.step_error()))
