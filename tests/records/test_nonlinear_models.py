"""Where nothing is linear: against filters and smoothers on a grid."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_filter import grid_filter
from scipy.special import gammaln

import jaxbridge as jb
from jaxbridge.records import guided, linearised, path_and_log_weight
from jaxbridge.records.initial import initial_law
from jaxbridge.records.linearisation import extended_kalman_path
from jaxbridge.records.several import as_record_problems

KEY = jax.random.key(0)


class Case(NamedTuple):
    model: jb.Diffusion
    drift: object
    variance: object
    nodes: np.ndarray
    observation: object
    log_density: object  # of values (n, 1) at nodes, NaN where nothing was seen
    draw: object
    start: float
    gap: float
    num: int = 25

    @property
    def times(self):
        return np.arange(self.num) * self.gap


def normal_density(noise):
    def log_density(values, nodes):
        log = -((values - nodes) ** 2) / (2 * noise**2) - np.log(noise * np.sqrt(2 * np.pi))
        return np.where(np.isnan(values), 0, log)

    return log_density


def double_well():
    """dX = 2 X (1 - X²) dt + .8 dW, with noise that hides in which well it is now and then."""
    return Case(
        jb.Diffusion(lambda x, p: 2 * x * (1 - x**2), [0.8]),
        lambda x: 2 * x * (1 - x**2),
        lambda x: np.full_like(x, 0.64),
        np.linspace(-3, 3, 601),
        jb.LinearGaussian(covariance=0.3**2),
        normal_density(0.3),
        lambda rng, x: x + 0.3 * rng.normal(),
        -1.0,
        0.4,
    )


def bent():
    """σ(x) = .4 √(1 + x²), and a drift that bends."""
    return Case(
        jb.Diffusion(lambda x, p: jnp.sin(2 * x) - x, lambda x, p: 0.4 * jnp.sqrt(1 + x**2)),
        lambda x: np.sin(2 * x) - x,
        lambda x: 0.16 * (1 + x**2),
        np.linspace(-4, 4, 801),
        jb.LinearGaussian(covariance=0.2**2),
        normal_density(0.2),
        lambda rng, x: x + 0.2 * rng.normal(),
        0.5,
        0.5,
    )


def counts():
    """An Ornstein–Uhlenbeck process that is the log of the rate at which something is counted."""

    def log_density(values, nodes):
        log = values * (nodes + 1) - np.exp(nodes + 1) - gammaln(values + 1)
        return np.where(np.isnan(values), 0, log)

    return Case(
        jb.Diffusion(lambda x, p: -x, [0.9]),
        lambda x: -x,
        lambda x: np.full_like(x, 0.81),
        np.linspace(-4, 4, 801),
        jb.ObservationDensity(
            lambda y, x, p: jax.scipy.stats.poisson.logpmf(y[0], jnp.exp(x[0] + 1)),
            guess=jb.LinearGaussian([[3.0]], covariance=9.0),
        ),
        log_density,
        lambda rng, x: rng.poisson(np.exp(x + 1)),
        0.3,
        0.3,
    )


CASES = {"double well": double_well, "bent": bent, "counts": counts}


@functools.cache
def recorded(name):
    """What was seen, and what the grid makes of it."""
    case = CASES[name]()
    rng, x, values = np.random.default_rng(3), case.start, []
    for _ in range(case.num):
        values.append(case.draw(rng, x))
        for _ in range(200):
            dt = case.gap / 200
            x += case.drift(x) * dt + np.sqrt(case.variance(np.array(x)) * dt) * rng.normal()
    values = np.array(values, float)[:, None]
    values[4] = np.nan
    nodes = case.nodes
    initial = np.exp(-((nodes - case.start) ** 2) / 0.5)
    logs = case.log_density(values, nodes)
    gaps = np.diff(case.times)
    return case, values, grid_filter(case.drift, case.variance, nodes, initial, gaps, logs)


def options(case):
    law = jb.GaussianLaw([case.start], [[0.25]])
    return {"observation": case.observation, "initial": law}


@pytest.mark.slow
def test_a_path_that_guides_worse_is_not_taken():
    """From the filter's means, with a well on either side of a gap, to the likeliest path."""
    case, values, _ = recorded("double well")
    given = case.model, case.times, values, case.observation, options(case)["initial"]
    problem = as_record_problems(*given, num_steps=20).problem(0)

    @jax.jit
    def log_weight(points):
        guide = guided(problem, problem.model, points)
        return path_and_log_weight(problem, problem.model, guide, jnp.zeros_like(points))

    initial = initial_law(problem.initial, problem.model, problem.like)
    begun = extended_kalman_path(
        problem.motion(problem.model), initial,
        problem.steps(problem.model),
        problem.scalars(problem.model),
    )  # fmt: skip
    path, first = log_weight(begun)
    assert log_weight(path)[1] < first - 1
    assert log_weight(linearised(problem, problem.model).points)[1] >= first - 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CASES)[:2])
def test_likelihoods(name):
    case, values, exact = recorded(name)
    made = jb.log_likelihood(
        KEY, case.model, case.times, values, **options(case), num_steps=20, num_particles=600
    )
    assert made.standard_error < 0.18 and made.num_nonfinite == 0
    error = 4.5 * made.standard_error + abs(made.step_error) + 2 * made.step_uncertainty
    assert abs(made.value - exact.log_likelihood) < error
    assert error < 1
    assert np.all(made.effective_sample_size > 3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["counts"])
def test_smoothed_paths(name):
    case, values, exact = recorded(name)
    made = jb.smooth(
        KEY, case.model, case.times, values, **options(case), num_steps=20, num_draws=1500
    )
    at_times = lambda path: path[::20, 0]
    mean = exact.weights @ exact.nodes
    second = exact.weights @ exact.nodes**2
    assert np.all(made.r_hat(at_times) < 1.05)
    for fn, wanted in [(at_times, mean), (lambda path: at_times(path) ** 2, second)]:
        allowance = 4.5 * made.standard_error(fn) + 0.02 * np.sqrt(second - mean**2).max()
        assert np.all(np.abs(made.mean(fn) - wanted) < allowance)


@pytest.mark.slow
def test_what_no_particle_explains_is_said():
    model = jb.ornstein_uhlenbeck([[1.0]])
    flat = jb.ObservationDensity(
        lambda y, x, p: jnp.where(x[0] > 50, 0.0, -jnp.inf), jb.LinearGaussian(covariance=1.0)
    )
    arguments = (KEY, model, np.arange(4.0), np.zeros((4, 1)))
    options = {"observation": flat, "num_particles": 10}
    made = jb.log_likelihood(*arguments, **options)
    assert made.value == -jnp.inf and made.unexplained == 0
    with pytest.raises(Exception, match="No particle explains"):
        jax.block_until_ready(jb.log_likelihood(*arguments, **options, throw=True).value)


# Brownian motion of which nothing is seen, lost where a step leads below zero.
POSITIVE = jb.Diffusion(lambda x, p: 0 * x, domain=lambda x, p: x[0] > 0)
UNSEEN = (KEY, POSITIVE, np.array([0.0, 0.5, 1.0]), np.full((3, 1), np.nan))
FROM_HALF = {"observation": jb.LinearGaussian(covariance=0.1), "initial": [0.5], "num_steps": 2}


@pytest.mark.slow
def test_no_path_ends_outside_of_the_state_space():
    """The likelihood is the probability that none of four steps leads there, by quadrature."""
    nodes = (np.arange(1500) + 0.5) * 0.004
    kernel = lambda x: np.exp(-2 * (nodes - x) ** 2) / np.sqrt(np.pi / 2)
    density = kernel(0.5)
    for _ in range(3):
        density = kernel(nodes[:, None]) @ density * 0.004
    made = jb.log_likelihood(*UNSEEN, **FROM_HALF, num_particles=2000)
    assert abs(made.value - np.log(density.sum() * 0.004)) < 5 * made.standard_error < 0.05
    assert made.num_nonfinite > 1000


@pytest.mark.slow
def test_no_smoothed_path_leaves_the_state_space():
    drawn = jb.smooth(*UNSEEN, **FROM_HALF, num_draws=50, num_warmup=20)
    assert np.all(drawn.paths > 0) and not np.any(drawn.stuck)
