"""Probabilities of rare events of paths, and means given them, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxbridge as jb

BROWNIAN = jb.Diffusion(lambda x, p: p * jnp.ones(2), jnp.ones(2), params=0.0)
SLOW = jb.ornstein_uhlenbeck([[0.7]], sigma=[[0.8]])


def assert_agrees(events, log_probability, allowance=0.0):
    error = float(events.standard_error)
    assert events.trustworthy, events.why()
    assert abs(events.log_probability - log_probability) < 4.5 * error + allowance
    assert error < 0.25


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.parametrize("level", [0.8, 2.5, 4.0])
def test_reaching_a_half_space(level):
    """At T, 3e-10 for the last. Given that, the state half way has a known mean."""
    a, s, T = 0.7, 0.8, 1.5
    variance = lambda t: s**2 * (1 - np.exp(-2 * a * t)) / (2 * a)
    mean, sd = 0.3 * np.exp(-a * T), np.sqrt(variance(T))
    events = jb.sample_events(
        jax.random.key(0), SLOW, [0.3], T, lambda path: path[-1, 0] - level, num_steps=60
    )
    z = (level - mean) / sd
    assert_agrees(events, stats.norm.logsf(z), 0.01)
    tail_mean = mean + sd * np.exp(stats.norm.logpdf(z) - stats.norm.logsf(z))
    slope = variance(T / 2) * np.exp(-a * T / 2) / variance(T)
    exact = 0.3 * np.exp(-a * T / 2) + slope * (tail_mean - mean)
    half_way = lambda path: path[30, 0]
    error = events.standard_error_of(half_way)
    assert abs(events.mean(half_way) - exact) < 5 * error + 0.002 and error < 0.05


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.parametrize(("centre", "radius"), [(1.0, 0.5), (4.0, 0.3)])
def test_reaching_a_ball(centre, radius):
    """By a Brownian motion with drift in the plane; 1e-8 for the second."""
    centre, drift = np.array([centre, -centre]), 0.4
    inside = lambda path: radius - jnp.linalg.norm(path[-1] - centre)
    events = jb.sample_events(
        jax.random.key(1), BROWNIAN.with_params(drift), [0.0, 0.0], 1.0, inside, num_steps=20
    )
    exact = stats.ncx2.logcdf(radius**2, 2, np.sum((centre - drift) ** 2))
    assert_agrees(events, exact)
    reached = events.paths[events.occurred][:, -1] - centre
    assert np.all(np.linalg.norm(reached, axis=1) <= radius)


@pytest.mark.slow
@pytest.mark.optimised
def test_an_integral_that_is_large():
    """The mean of a Brownian motion over an interval is normal; 2e-6."""
    N, level = 50, 2.6
    events = jb.sample_events(
        jax.random.key(2), BROWNIAN, [0.0, 0.0], 1.0,
        lambda path: jnp.mean(path[1:, 0]) - level, num_steps=N,
    )  # fmt: skip
    i = np.arange(1, N + 1) / N
    sd = np.sqrt(np.minimum(i[:, None], i).mean())
    assert_agrees(events, stats.norm.logsf(level / sd))


@pytest.mark.slow
@pytest.mark.parametrize(("num_steps", "is_small"), [(5, False), (160, True)])
def test_the_error_of_long_steps_is_told(num_steps, is_small):
    """Euler steps of an Ornstein-Uhlenbeck process end in another normal law, which is known."""
    T, level, dt = 2.0, 2.0, 2.0 / num_steps
    log_tail = lambda variance: stats.norm.logsf(level / np.sqrt(variance))
    decay = (1 - 0.7 * dt) ** 2
    simulated = 0.64 * dt * (1 - decay**num_steps) / (1 - decay)
    exact = 0.64 * (1 - np.exp(-1.4 * T)) / 1.4
    error = log_tail(simulated) - log_tail(exact)
    event = lambda path: path[-1, 0] - level
    long = jb.sample_events(
        jax.random.key(4), SLOW, [0.0], T, event, num_steps=num_steps, density=jb.EulerDensity(),
        num_paths=1000 if is_small else 4000,
    )  # fmt: skip
    assert abs(long.log_probability - log_tail(simulated)) < 4.5 * long.standard_error
    # An error of first order; that of the told one is also of higher order.
    assert abs(long.step_error - error) < 4.5 * long.step_uncertainty + 0.6 * abs(error)
    assert bool(long.trustworthy) is is_small
    assert is_small or "The discretisation error (`step_error`) exceeds" in long.why()


@pytest.mark.slow
def test_noise_that_grows_with_the_state():
    """By steps of second order: Euler's are off by .18 with ten steps."""
    model = jb.Diffusion(lambda x, p: 0.5 * x, lambda x, p: 0.8 * x)
    event = lambda path: path[-1, 0] - 9.0
    events = jb.sample_events(jax.random.key(5), model, [1.0], 1.0, event, num_steps=10)
    exact = stats.norm.logsf((np.log(9) - 0.5 + 0.32) / 0.8)
    assert_agrees(events, exact, 0.02)
    assert events.step_uncertainty < 0.05


@pytest.mark.slow
@pytest.mark.optimised
def test_errors_are_those_of_repetitions():
    """Of 24 repetitions with few paths."""
    event = lambda path: path[-1, 0] - 3.5
    run = jax.jit(
        lambda key: jb.sample_events(
            key, BROWNIAN, [0.0, 0.0], 1.0, event, num_steps=10, num_paths=300
        )
    )
    made = [run(key) for key in jax.random.split(jax.random.key(3), 24)]
    errors = np.array([each.standard_error for each in made])
    z = (np.array([each.log_probability for each in made]) - stats.norm.logsf(3.5)) / errors
    assert np.sqrt(np.mean(z**2)) < 1.4 and np.max(np.abs(z)) < 4
    assert abs(np.mean(z)) < 4.5 / np.sqrt(24)


@pytest.mark.slow
def test_events_that_do_not_occur_are_said():
    never = jb.sample_events(
        jax.random.key(0), BROWNIAN, [0.0, 0.0], 1.0, lambda path: -1.0, num_paths=20, num_runs=2,
        num_steps=5,
    )  # fmt: skip
    assert not never.trustworthy and never.log_probability == -np.inf
    assert "no path of it goes on" in never.why()
