"""Where a record begins in a stationary law that is not normal: against quadratures and a filter on
a grid."""

import functools

import cir
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_filter import grid_filter
from scipy.special import gammaln
from scipy.stats import gamma, norm

import jaxbridge as jb
from jaxbridge.records.initial import initial_law

KEY = jax.random.key(0)
NODES = np.linspace(-3, 3, 601)


def log_wells(x):
    """Two wells, of which the left has 42 % of the mass; up to a constant."""
    return (-((x**2 - 1) ** 2) + 0.128 * x) / 0.64


CONSTANT = np.log(np.exp(log_wells(NODES)).sum() * (NODES[1] - NODES[0]))


def wells():
    return jb.Diffusion(
        lambda x, p: -2 * x * (x**2 - 1) + 0.064,
        [0.8],
        lambda x, p: log_wells(x[0]) - CONSTANT,
        reversible=True,
        normalised=True,
    )


@functools.cache
def on_the_grid(values, noise):
    """The filter of what was seen .3 apart."""
    logs = np.array([norm.logpdf(y, NODES, noise) if y is not None else 0 * NODES for y in values])
    return grid_filter(
        lambda x: -2 * x * (x**2 - 1) + 0.064, lambda x: np.full_like(x, 0.64), NODES,
        np.exp(log_wells(NODES)), np.full(len(values) - 1, 0.3), logs,
    )  # fmt: skip


def record(values):
    return np.arange(len(values)) * 0.3, np.array([[np.nan if y is None else y] for y in values])


RECORDS = [(first, None) for first in (-1.0, 1.0)] + [(-1.0, -0.8, None, 0.3)]


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("power", [4, 6])
def test_curvature_that_vanishes_at_the_mode(power, unit):
    """The widths of the densities exp(-x^p) and exp(-x₀^p - x₁²/2), with x in any unit."""
    nodes = np.linspace(-4, 4, 2001)
    weights = np.exp(-(nodes**power))
    width = unit * np.sqrt(weights @ nodes**2 / weights.sum())
    one = jb.langevin(lambda x, p: -jnp.sum((x / unit) ** power))
    two = jb.langevin(lambda x, p: -((x[0] / unit) ** power) - (x[1] / unit) ** 2 / 2)
    for model, expected in (one, [width]), (two, [width, unit]):
        law = initial_law(jb.Stationary(), model, jnp.zeros(len(expected)))
        found = jnp.sqrt(jnp.sum(law.root**2, axis=1))
        np.testing.assert_allclose(found, expected, rtol=0.15)
        np.testing.assert_array_less(jnp.abs(law.mean), 0.2 * np.array(expected))


def square_root_process(shape, mean):
    """dX = (mean - X) dt + σ√X dW with this shape of the stationary gamma law."""
    rate, variance = shape / mean, 2 * mean / shape
    constant = shape * np.log(rate) - gammaln(shape)
    return jb.Diffusion(
        lambda x, p: mean - x,
        lambda x, p: jnp.sqrt(variance * x) * jnp.ones(1),
        lambda x, p: jnp.sum((shape - 1) * jnp.log(x) - rate * x) + constant,
        domain=lambda x, p: x[0] > 0,
        normalised=True,
    )


@pytest.mark.parametrize("mean", [1e-4, 1.0, 1e5])
@pytest.mark.parametrize("shape", [0.5, 2.5, 100.0])
def test_a_law_on_the_half_line(shape, mean):
    """Mean and width of gamma laws, whose log densities are not finite at the origin."""
    law = initial_law(jb.Stationary(), square_root_process(shape, mean), jnp.zeros(1))
    np.testing.assert_allclose(law.mean, [mean], rtol=0.1)
    np.testing.assert_allclose(law.root, [[mean / np.sqrt(shape)]], rtol=0.1)


@pytest.mark.parametrize("mean", [1.0, 1e5])
def test_likelihood_from_a_law_on_the_half_line(mean):
    """Of two exact readings: the gamma density times the transition density."""
    model, readings = square_root_process(2.5, mean), mean * np.array([0.7, 1.1])
    made = jb.log_likelihood(
        KEY, model, [0.0, 0.4], readings, observation=jb.LinearGaussian(covariance=0.0),
        num_steps=8,
    )  # fmt: skip
    exact = gamma.logpdf(readings[0], 2.5, scale=mean / 2.5)
    exact += cir.log_density((1.0, mean, np.sqrt(2 * mean / 2.5)), *readings, 0.4)
    assert made.trustworthy, made.why()
    assert abs(made.value - exact) < 4.5 * made.standard_error + abs(made.step_error) + 0.01


@pytest.mark.slow
def test_tails_that_are_not_normal():
    """Of the hyperbolic law, near its mode and far out, where the first coordinate is seen once."""
    dim = 2
    model, axis = jb.hyperbolic(0.5, dim), np.linspace(-40, 40, 801)
    points = np.stack(np.meshgrid(*dim * [axis], indexing="ij"), -1).reshape(-1, dim)
    nu = np.exp(jax.vmap(model.log_stationary)(jnp.asarray(points)))
    for y, noise in [(0.0, 1.0), (6.0, 1.0), (3.0, 0.2), (0.0, 30.0)]:
        seen = norm.pdf(y, points[:, 0], noise)
        exact = np.log((nu * seen).sum() * (axis[1] - axis[0]) ** dim)
        made = jb.log_likelihood(
            KEY, model, [0.0, 0.1], [[y], [np.nan]], num_steps=2, num_particles=400,
            observation=jb.LinearGaussian(np.eye(1, dim), noise**2),
        )  # fmt: skip
        assert abs(made.value - exact) < 5 * made.standard_error < 0.2
        assert made.effective_sample_size[0] > 100


@pytest.mark.slow
def test_paths_begin_in_both_wells():
    values = RECORDS[-1]
    exact = on_the_grid(values, 1.0)
    made = jb.smooth(
        KEY, wells(), *record(values), observation=jb.LinearGaussian(covariance=1.0),
        num_steps=10, num_draws=2000,
    )  # fmt: skip
    left = lambda path: path[::10, 0] < 0
    wanted = exact.weights @ (exact.nodes < 0)
    assert np.all(np.abs(made.mean(left) - wanted) < 5 * made.standard_error(left) + 0.01)
    assert np.all(made.standard_error(left) < 0.03) and np.all(made.r_hat(left) < 1.05)


@pytest.mark.slow
def test_the_beginning_is_a_smooth_function_of_parameters(x64):
    model = jb.Diffusion(
        lambda x, p: -2 * x * (x**2 - p), [0.8], lambda x, p: -((x[0] ** 2 - p) ** 2) / 0.64,
        params=1.0, reversible=True, normalised=True,
    )  # fmt: skip
    paths = jb.innovations(
        model, *record((-1.0, 0.2)), observation=jb.LinearGaussian(covariance=0.5), num_steps=1
    )
    xi = jnp.array([0.3, -0.4])
    value, slope = jax.jit(jax.value_and_grad(paths.log_density))(1.0, xi)
    density = jax.jit(paths.log_density)
    differences = (density(1.0 + 1e-4, xi) - density(1.0 - 1e-4, xi)) / 2e-4
    assert np.isfinite(value) and abs(slope - differences) < 1e-5 * abs(slope)
