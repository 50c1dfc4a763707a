"""Densities and bridges on a circle, against the generator in Fourier series."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import jaxbridge as jb

KEY = jax.random.key(1)
CIRCLE = jb.Diffusion(
    lambda x, p: -p["pull"] * jnp.sin(x - p["at"]),
    lambda x, p: p["sigma"] * jnp.ones(1),
    params={"pull": 1.0, "at": 0.0, "sigma": 1.0},
)
MODES = np.arange(-40, 41)


def density(pull, at, sigma, start, duration):
    """p(start, y) as a function of y: coefficients c_k of Σ c_k e^{iky} obey c' = A c."""
    A = np.diag(-(sigma**2) / 2 * MODES**2).astype(complex)
    for k in MODES:
        # ∂_y(pull sin(y - at) p), with sin(y - at) = (e^{i(y - at)} - e^{-i(y - at)}) / 2i.
        for shift in (1, -1):
            if abs(k - shift) <= 40:
                A[k + 40, k - shift + 40] += pull * shift * k / 2 * np.exp(-1j * shift * at)
    c = expm(A * duration) @ (np.exp(-1j * MODES * start) / (2 * np.pi))
    return lambda y: np.real(np.exp(1j * np.multiply.outer(y, MODES)) @ c)


def on_circle(start, end, duration, params=None, most=2, period=2 * np.pi, **options):
    model = CIRCLE if params is None else CIRCLE.with_params(params)
    ends = jb.windings([end], period, most)
    options = {"proposal": jb.ModifiedDiffusionBridge(), "num_proposals": 2000} | options
    return jb.transition_log_density(KEY, model, [start], ends, duration, **options)


def assert_told(estimate, exact):
    told = 4.5 * estimate.standard_error + abs(estimate.step_error) + estimate.step_uncertainty
    assert estimate.trustworthy and estimate.value.shape == ()
    assert abs(estimate.value - exact) < told


def test_the_oracle_is_the_published_table():
    values = density(1, 0, 1, np.pi / 2, 2)(np.array([0, 1.5, 3, -3, -1.5]))
    np.testing.assert_allclose(values, [0.46293, 0.15650, 0.02298, 0.01834, 0.03707], atol=6e-6)


@pytest.mark.parametrize("end", [0.0, 1.5, 3.0, -3.0, -1.5])
def test_densities_are_those_of_the_circle(end):
    exact = np.log(density(1, 0, 1, np.pi / 2, 2)(np.array(end)))
    assert_told(on_circle(np.pi / 2, end, 2.0).total(), exact)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pull", "at", "sigma", "start", "end", "duration", "most"),
    [
        (0.5, 1.0, 1.5, 2.0, -2.5, 1.0, 2),
        (2.0, -0.5, 0.7, 0.4, 3.0, 0.6, 1),  # rare: below 1e-5
        (0.3, 0.0, 2.0, 1.0, 2.0, 4.0, 3),  # round more than once
    ],
)
def test_other_circles(pull, at, sigma, start, end, duration, most):
    exact = density(pull, at, sigma, start, duration)(np.array(end))
    assert (exact < 1e-5) == (most == 1)
    params = {"pull": pull, "at": at, "sigma": sigma}
    assert_told(on_circle(start, end, duration, params, most).total(), np.log(exact))


@pytest.mark.slow
def test_a_torus_of_independent_angles_is_a_product():
    """And a line beside a circle."""
    both = jb.Diffusion(lambda x, p: jnp.stack([-jnp.sin(x[0]), -x[1]]))
    ends = jb.windings([3.0, 0.5], [2 * np.pi, np.inf])
    assert ends.shape == (5, 2) and jb.windings([3.0, 0.5], 2 * np.pi).shape == (25, 2)
    made = jb.transition_log_density(
        KEY, both, [1.0, 0.2], ends, 1.0, proposal=jb.ModifiedDiffusionBridge()
    ).total()
    circle = density(1, 0, 1, 1.0, 1.0)(np.array(3.0))
    spread = (1 - np.exp(-2)) / 2
    line = -((0.5 - 0.2 * np.exp(-1)) ** 2) / (2 * spread) - np.log(2 * np.pi * spread) / 2
    assert_told(made, np.log(circle) + line)


def test_bridges_choose_a_winding():
    """To the opposite point half of the paths go each way round: the law at half time."""
    start, end, duration = 0.5, 0.5 + np.pi, 2.0
    bridges = jb.sample_weighted_bridges(
        KEY,
        CIRCLE,
        [start],
        jb.windings([end], 2 * np.pi),
        duration,
        num_bridges=2000,
        num_steps=20,
        proposal=jb.ModifiedDiffusionBridge(),
    )
    middle, weights = np.asarray(bridges.paths[..., 10, 0], float), jnp.exp(bridges.log_weights)
    weights = np.asarray(weights / weights.sum(), float)
    nodes = np.linspace(0, 2 * np.pi, 201)[:-1]
    there = density(1, 0, 1, start, 1.0)(nodes)
    back = np.array([density(1, 0, 1, node, 1.0)(np.array(end)) for node in nodes])
    exact = there * back / np.sum(there * back)
    for fn in (np.cos, np.sin):
        mean = np.sum(weights * fn(middle))
        error = np.sqrt(np.sum(weights**2 * (fn(middle) - mean) ** 2))
        assert abs(mean - exact @ fn(nodes)) < 4.5 * error + 0.01
        assert error < 0.02
    shares = weights.sum(1)  # of -2, ..., 2 turns
    assert shares[1] > 0.3 and shares[2] > 0.3


def test_a_sum_ignores_what_has_no_share():
    """An end point that no path reaches is no fault of the sum."""
    estimate = on_circle(0.0, 0.3, 0.1)
    total = estimate.total()
    assert total.trustworthy and np.isfinite(total.standard_error)
    np.testing.assert_allclose(total.value, estimate.value[2], atol=1e-6)
    np.testing.assert_allclose(total.effective_sample_size, estimate.effective_sample_size[2])


def test_a_pair_without_a_bridge_has_an_unknown_share():
    estimate = on_circle(0.0, 0.3, 0.1)
    lost = dataclasses.replace(
        estimate,
        value=estimate.value.at[1].set(-jnp.inf),
        num_met=estimate.num_met.at[1].set(0),
    ).total()
    assert np.isinf(lost.standard_error) and not lost.trustworthy


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0.0, 1.0), "shape (d,)"),
        (([0.0], [1.0, 2.0]), "one per coordinate"),
        (([0.0], -1.0), "must be positive"),
        (([0.0], np.nan), "must be positive"),
        (([0.0], 1.0, 0), "`most`"),
    ],
)
def test_refusals(arguments, words):
    with pytest.raises((ValueError, TypeError)) as error:
        jb.windings(*arguments)
    assert words in str(error.value)
