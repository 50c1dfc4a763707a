"""Two grids against closed forms: what is left of the step error, and how its noise is told."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import turning_model

import jaxbridge as jb
from jaxbridge.proposals.coupled import CoupledPairs

# An Ornstein–Uhlenbeck process seen through sinh: σ(x) = √(1 + x²).
OU = jb.ornstein_uhlenbeck([[1.0]], [0.0], [[1.0]])
STRETCHED = jb.transform(OU, jnp.sinh, jnp.arcsinh)
START, END = (jnp.sinh(jnp.array([y])) for y in (0.3, 1.0))
DURATION = 1.0
EXACT = jb.ou_transition(OU, jnp.array([0.3]), DURATION).log_density(jnp.array([1.0]))
EXACT = float(EXACT) - float(jnp.log(jnp.cosh(1.0)))
MIDDLE = jb.gaussian_bridge(OU, [0.3], [1.0], DURATION, [0.5])


def density(key, num_steps, num_proposals=100_000, proposal=None):
    """By the Euler scheme, whose error is of first order."""
    proposal = jb.ModifiedDiffusionBridge(jb.EulerDensity()) if proposal is None else proposal
    return jb.transition_log_density(
        key,
        STRETCHED.model,
        START,
        END,
        DURATION,
        num_steps=num_steps,
        num_proposals=num_proposals,
        proposal=proposal,
    )


def weighted(key, num_steps, num_bridges=100_000, **options):
    """By the Euler scheme, too."""
    return jb.sample_weighted_bridges(
        key,
        STRETCHED.model,
        START,
        END,
        DURATION,
        num_steps=num_steps,
        num_bridges=num_bridges,
        proposal=jb.ModifiedDiffusionBridge(jb.EulerDensity()),
        **options,
    )


@pytest.fixture(scope="module")
def densities():
    keys = jax.random.split(jax.random.key(0))
    return [density(key, n) for key, n in zip(keys, (32, 16), strict=True)]


@pytest.mark.slow
def test_the_leading_error_of_a_density_is_gone(densities):
    """On the natural scale, against the closed form; the finer grid alone is seen to be off."""
    fine, coarse = densities
    both = jb.extrapolate(fine, coarse)
    errors = np.expm1([float(one.value) - EXACT for one in (coarse, fine, both)])
    noise = [float(one.standard_error) for one in (coarse, fine, both)]
    assert errors[0] > 8 * noise[0] and errors[1] > 5 * noise[1]
    assert abs(errors[2]) < abs(errors[1]) / 2
    assert float(both.removed) == pytest.approx(float(fine.value - both.value), abs=1e-6)


@pytest.mark.slow
def test_pairs_of_two_gammas_are_two_proposals(densities):
    both = [
        eqx.tree_at(
            lambda one: one.proposal, density, CoupledPairs(jb.Coupling(gamma), 100, 100, 1)
        )
        for density, gamma in zip(densities, (0.0, 0.5), strict=True)
    ]
    with pytest.raises(ValueError, match="the same single proposal"):
        jb.extrapolate(*both)


@pytest.mark.slow
def test_its_noise_is_that_of_a_sum(densities):
    """The arithmetic, in NumPy: E + (E - E') with independent parts."""
    fine, coarse = densities
    both = jb.extrapolate(fine, coarse)
    p, q = np.exp(float(fine.value)), np.exp(float(coarse.value))
    assert float(both.value) == pytest.approx(np.log(2 * p - q), abs=1e-5)
    error = np.hypot(2 * p * fine.standard_error, q * coarse.standard_error) / (2 * p - q)
    assert float(both.standard_error) == pytest.approx(float(error), rel=1e-4)


@pytest.mark.slow
def test_means_are_extrapolated_entry_by_entry():
    """The mid-point of the bridge, through arcsinh, against its closed form."""
    keys = jax.random.split(jax.random.key(1))
    fine, coarse = (weighted(k, n, save_at=[0.5]) for k, n in zip(keys, (16, 8), strict=True))
    both = jb.extrapolate(fine, coarse)

    def fn(path):
        return jnp.arcsinh(path[0])

    error, noise = both.mean(fn) - MIDDLE.mean[0], both.standard_error(fn)
    assert abs(float(error[0])) < 4.5 * float(noise[0]) + 2e-3
    np.testing.assert_allclose(both.mean(fn), 2 * fine.mean(fn) - coarse.mean(fn), atol=1e-6)
    np.testing.assert_allclose(both.removed(fn), fine.mean(fn) - both.mean(fn), atol=1e-7)
    expected = np.hypot(2 * fine.standard_error(fn), coarse.standard_error(fn))
    np.testing.assert_allclose(noise, expected, rtol=1e-5)


@pytest.mark.slow
def test_nothing_is_left_of_a_density_that_noise_made_negative(densities):
    fine, _ = densities
    larger = density(jax.random.key(2), 16, 100)
    larger = jb.TransitionLogDensity(**(vars(larger) | {"value": fine.value + 1.0}))
    both = jb.extrapolate(fine, larger)
    assert both.value == -jnp.inf and both.standard_error == jnp.inf and not both.trustworthy


@pytest.mark.slow
def test_few_steps_of_a_sigma_that_turns():
    """The default scheme, by ten."""
    model = turning_model()
    start, end, duration = jnp.array([0.3, -0.2]), jnp.array([-0.5, 0.4]), 2.0
    law = jb.ou_transition(jb.ornstein_uhlenbeck(0.5 * jnp.eye(2)), start, duration)
    coarse, fine = (
        jb.transition_log_density(
            jax.random.key(num_steps),
            model,
            start,
            end,
            duration,
            num_steps=num_steps,
            num_proposals=100_000,
            proposal=jb.Coupling(0.5),
        )
        for num_steps in (5, 10)
    )
    off = lambda estimate: abs(float(jnp.expm1(estimate.value - law.log_density(end))))
    assert off(fine) < 0.045 and off(jb.extrapolate(fine, coarse)) < 0.045
    assert fine.standard_error < 0.005


@pytest.mark.slow
def test_the_order_of_quadratic_steps_is_two():
    """Though their reported errors, of usual numbers of steps, are those of a lower order."""
    model = jb.Diffusion(lambda x, p: -x, lambda x, p: 0.6 * jnp.sqrt(1 + x**2))
    fine, coarse = (
        jb.transition_log_density(
            jax.random.key(seed), model, [0.5], [-0.6], 1.0, num_proposals=100, num_steps=n,
            proposal=jb.Guided(),
        )
        for seed, n in ((0, 8), (1, 4))
    )  # fmt: skip
    both = jb.extrapolate(fine, coarse)
    p, q = np.exp(float(fine.value)), np.exp(float(coarse.value))
    assert float(both.value) == pytest.approx(np.log(p + (p - q) / 3), abs=1e-5)
    assert fine.step_share > 0.5
