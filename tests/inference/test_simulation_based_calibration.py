"""Calibration of samplers on simulated records: right ones pass, wrong ones are found."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb

KEY = jax.random.key(0)
TIMES, NOISE = np.arange(4.0), 0.5
# A process that stands still at an unknown level: readings are independent, given the level.
STILL = jb.Diffusion(
    lambda x, p: 0 * x, lambda x, p: jnp.array([1e-6]), params={"level": 0.0, "other": 1.0}
)
MODEL = {
    "observation": jb.LinearGaussian(covariance=NOISE**2),
    "initial": lambda p: jnp.stack([p["level"]]),
    "where": lambda p: p["level"],
    "prior": jb.NormalPrior(1.0, 4.0),
}


class Drawn(NamedTuple):
    theta: np.ndarray
    effective_sample_size: np.ndarray
    trustworthy: bool


def conjugate(key, model, times, observations, *, shift=0.0, stretch=1.0, trust=True, **given):
    """Independent draws of the posterior, or of one that is shifted or stretched."""
    assert set(given) >= {"prior", "observation", "initial", "where"}
    seen = np.asarray(observations)[np.isfinite(observations)]
    precision = 1 / 4 + len(seen) / NOISE**2
    mean = (1 / 4 + seen.sum() / NOISE**2) / precision
    noise = np.asarray(jax.random.normal(key, (400, 1)))
    draws = mean + (shift + stretch * noise) / np.sqrt(precision)
    return Drawn(draws, np.array([99.0]), trust)


def calibrate(sampler, num=200, **options):
    readings = np.array([0.3, np.nan, 7.0, -2.0])
    return jb.simulation_based_calibration(
        KEY, STILL, TIMES, readings, sampler, **MODEL | options, num_simulations=num, num_steps=1
    )


@pytest.mark.slow
def test_a_right_sampler_passes():
    made = calibrate(conjugate, 60)
    assert made.names == ("level",) and made.truth.shape == made.uniforms.shape == (60, 1)
    assert made.p_uniform[0] > 0.01 and made.trustworthy
    # The truth is from the prior, and missing readings stay missing.
    assert abs(made.truth.mean() - 1) < 5 * 2 / np.sqrt(60)
    assert abs(made.truth.std() / 2 - 1) < 5 / np.sqrt(120)


@pytest.mark.slow
@pytest.mark.parametrize("fault", [{"shift": 0.8}, {"stretch": 0.5}, {"stretch": 2.0}])
def test_a_wrong_one_is_found(fault):
    assert calibrate(functools.partial(conjugate, **fault), 60).p_uniform[0] < 1e-3


def test_posteriors_that_are_not_trusted_are_a_fault():
    made = calibrate(functools.partial(conjugate, trust=False), 5)
    assert not made.trustworthy and "longer chains" in made.why()


@pytest.mark.slow
def test_a_constraint_cuts_the_prior():
    made = calibrate(conjugate, 20, constraint=lambda level: level > 1.5)
    assert np.all(made.truth > 1.5)
    with pytest.raises(ValueError, match="satisfies `constraint`"):
        calibrate(conjugate, 2, constraint=lambda level: level > 100)


def test_refusals():
    with pytest.raises(TypeError, match="`prior` must be a `NormalPrior`"):
        calibrate(conjugate, prior=lambda p: 0.0)
    with pytest.raises(TypeError, match="`sampler`"):
        calibrate(3)


@pytest.mark.slow
def test_records_that_left_the_state_space_are_a_fault():
    """A square root process without room: its first steps lead below zero now and then."""
    model = jb.Diffusion(
        lambda x, p: 0.3 - x, lambda x, p: jnp.sqrt(x), params={"level": 0.0},
        domain=lambda x, p: x[0] > 0,
    )  # fmt: skip
    given = MODEL | {"initial": [0.3]}
    made = jb.simulation_based_calibration(
        KEY, model, TIMES, np.zeros(4), conjugate, **given, num_simulations=10, num_steps=4
    )
    assert np.isnan(made.uniforms).any() and "left the state space" in made.why()
