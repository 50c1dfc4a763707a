"""Unconditional paths against transition laws that are known exactly."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from helpers import assert_moments

import jaxbridge as jb

B = np.array([[1.0, 2.0], [-0.5, 1.5]])
MEAN = np.array([0.5, -1.0])
SIGMA = np.array([[1.0, 0.0], [0.4, 0.8]])
START = np.array([2.0, 1.0])
TIMES = np.array([0.0, 0.3, 1.0], np.float32)
NUM_PATHS = 10_000


def process(decay=1.0):
    return jb.ornstein_uhlenbeck(*(jnp.asarray(a, jnp.float32) for a in (decay * B, MEAN, SIGMA)))


def joint_law(first, second):
    """Mean and covariance of (X_s, X_t), s < t, given X_0 = START."""
    stationary = scipy.linalg.solve_continuous_lyapunov(B, SIGMA @ SIGMA.T)
    decay = lambda t: scipy.linalg.expm(-t * B)
    covariance = lambda t: stationary - decay(t) @ stationary @ decay(t).T
    mean = [MEAN + decay(t) @ (START - MEAN) for t in (first, second)]
    lagged = covariance(first) @ decay(second - first).T
    blocks = [[covariance(first), lagged], [lagged.T, covariance(second)]]
    return np.concatenate(mean), np.block(blocks)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, num_steps",
    [
        (None, 20),
        pytest.param(diffrax.Euler(), 200, marks=pytest.mark.slow),
        pytest.param(diffrax.SEA(), 200, marks=pytest.mark.slow),
        (diffrax.ShARK(), 20),
    ],
    ids=["default", "Euler", "SEA", "ShARK"],
)
def test_paths_have_the_transition_law(solver, num_steps):
    paths = jb.simulate(
        jax.random.key(0),
        process(),
        START,
        TIMES,
        num_paths=NUM_PATHS,
        num_steps=num_steps,
        solver=solver,
    )
    assert paths.shape == (NUM_PATHS, 3, 2)
    np.testing.assert_array_equal(paths[:, 0], np.broadcast_to(START, (NUM_PATHS, 2)))
    later = paths[:, 1:].reshape(NUM_PATHS, 4)
    assert_moments(later, *joint_law(*TIMES[1:]))
    # At slightly later times the law is another, and the gates notice.
    with pytest.raises(AssertionError):
        assert_moments(later, *joint_law(0.33, 1.1))


# X = sinh Y with dY = -κ (Y - μ) dt + s dW. By Itô's formula
#   dX = {-κ (asinh X - μ) √(1+X²) + ½ s² X} dt + s √(1+X²) dW.
KAPPA, CENTRE, NOISE = 1.0, 0.5, 0.8


def sinh_drift(x, p):
    return -KAPPA * (jnp.arcsinh(x) - CENTRE) * jnp.sqrt(1 + x**2) + p * NOISE**2 * x / 2


SINH = jb.Diffusion(sinh_drift, lambda x, p: NOISE * jnp.sqrt(1 + x**2), params=1.0)


def assert_sinh_law(paths, start):
    y = np.arcsinh(np.asarray(paths, float))[:, 1:, 0]
    s, t = np.asarray(TIMES[1:], float)
    variance = lambda t: NOISE**2 * -np.expm1(-2 * KAPPA * t) / (2 * KAPPA)
    lagged = variance(s) * np.exp(-KAPPA * (t - s))
    mean = [CENTRE + np.exp(-KAPPA * u) * (np.arcsinh(start) - CENTRE) for u in (s, t)]
    assert_moments(y, mean, [[variance(s), lagged], [lagged, variance(t)]])


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, num_steps",
    [
        (None, 40),
        pytest.param(diffrax.ItoMilstein(), 200, marks=pytest.mark.slow),
        pytest.param(diffrax.StratonovichMilstein(), 200, marks=pytest.mark.slow),
        pytest.param(diffrax.EulerHeun(), 200, marks=pytest.mark.slow),
        pytest.param(diffrax.Euler(), 200, marks=pytest.mark.slow),
    ],
    ids=["default", "ItoMilstein", "StratonovichMilstein", "EulerHeun", "Euler"],
)
def test_a_state_dependent_sigma_is_read_as_itos(solver, num_steps):
    options = {"num_paths": NUM_PATHS, "num_steps": num_steps, "solver": solver}
    simulate = lambda model: jb.simulate(jax.random.key(1), model, [2.0], TIMES, **options)
    assert_sinh_law(simulate(SINH), 2.0)
    # Without Itô's term, which is what a solver of the other kind would make of it, it fails.
    with pytest.raises(AssertionError):
        assert_sinh_law(simulate(SINH.with_params(0.0)), 2.0)


def test_a_start_for_each_path():
    starts = np.random.default_rng(0).standard_normal((5, 2)).astype(np.float32)
    paths = jb.simulate(jax.random.key(0), process(), starts, [0.0, 1e-6], num_paths=5, num_steps=1)
    np.testing.assert_array_equal(paths[:, 0], starts)
    np.testing.assert_allclose(paths[:, 1], starts, atol=0.02)


@pytest.mark.slow
def test_without_a_start_paths_are_stationary():
    paths = jb.simulate(jax.random.key(0), process(), None, TIMES, num_paths=NUM_PATHS)
    stationary = scipy.linalg.solve_continuous_lyapunov(B, SIGMA @ SIGMA.T)
    for k in range(3):
        assert_moments(paths[:, k], MEAN, stationary)
    # Paths from a fixed start have not forgotten it.
    with pytest.raises(AssertionError):
        fixed = jb.simulate(jax.random.key(0), process(), MEAN, TIMES, num_paths=NUM_PATHS)
        assert_moments(fixed[:, 1], MEAN, stationary)


def test_paths_follow_the_precision_of_the_start(precision):
    model = jb.ornstein_uhlenbeck(*(jnp.asarray(a, precision) for a in (B, MEAN, SIGMA)))
    start = jnp.asarray(START, precision)
    paths = jb.simulate(jax.random.key(0), model, start, [0, 1], num_steps=2)
    assert paths.dtype == precision
    assert np.all(np.isfinite(paths))


def test_numbers_may_change_without_a_new_compilation():
    traces = []

    def drift(x, p):
        traces.append(x)
        return -p * x

    run = lambda seed, rate, start, end: jb.simulate(
        jax.random.key(seed),
        jb.Diffusion(drift, params=rate),
        [start],
        [0.0, end],
        num_paths=3,
        num_steps=2,
    )
    first, count = run(0, 1.0, 0.0, 1.0), len(traces)
    assert np.any(first != run(1, 2.0, 3.0, 4.0))
    assert len(traces) == count
    run(0, 1.0, 0.0, 1.0)
    np.testing.assert_array_equal(first, run(0, 1.0, 0.0, 1.0))


@pytest.mark.slow
def test_simulation_inside_jit_equals_that_outside():
    simulate = lambda key, model, times: jb.simulate(key, model, START, times, num_steps=4)
    arguments = jax.random.key(0), process(), jnp.asarray(TIMES)
    np.testing.assert_allclose(jax.jit(simulate)(*arguments), simulate(*arguments), rtol=1e-5)


def test_paths_are_differentiable_in_forward_mode():
    # At fixed noise the derivative in the start of an OU path is e^{-tB}.
    end = lambda x: jb.simulate(jax.random.key(0), process(), x, TIMES, num_steps=50)[0, -1]
    jacobian = jax.jit(jax.jacfwd(end))(jnp.asarray(START, jnp.float32))
    np.testing.assert_allclose(jacobian, scipy.linalg.expm(-B), atol=2e-3)


BROWNIAN = jb.Diffusion(lambda x, p: 0 * x)
WAVE = jb.Diffusion(lambda x, p, t: jnp.cos(2 * jnp.pi * t) + 0 * x)


def test_paths_do_not_depend_on_the_zero_of_time(precision):
    """Nor do increments: their variance is the gap, and there are no copies among them, though
    these times are equal in single precision."""
    gap = 1 / 16  # exact beside the offset
    start, days = jnp.zeros(1, precision), gap * np.arange(201)
    run = lambda times: jb.simulate(
        jax.random.key(0), BROWNIAN, start, times, num_paths=50, num_steps=1
    )
    near, far = run(days), run(2_460_000 + days)
    np.testing.assert_array_equal(near, far)
    increments = np.diff(np.asarray(far, float)[..., 0], axis=1) / np.sqrt(gap)
    assert abs(increments.var() - 1) < 5 * np.sqrt(2 / increments.size)
    correlations = np.corrcoef(increments.T)
    assert np.abs(correlations - np.eye(200)).max() < 0.75  # of copies it is 1


@pytest.mark.slow
def test_coefficients_get_the_callers_time_or_nothing():
    """Whole periods change nothing; what single precision cannot resolve is refused."""
    times = np.arange(5) / 4
    run = lambda shift: jb.simulate(jax.random.key(0), WAVE, [0.0], shift + times, num_steps=5)
    np.testing.assert_allclose(run(0), run(100), atol=1e-4)
    assert np.abs(run(0) - run(0.25)).max() > 0.1  # the time counts
    with pytest.raises(ValueError, match="too far from zero for coefficients that depend on time"):
        run(2_460_000)
    with jax.enable_x64(True):
        np.testing.assert_allclose(run(0), run(2_460_000), atol=1e-8)
