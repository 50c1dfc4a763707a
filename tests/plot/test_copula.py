"""Copulas against what is known of them, and ranks."""

import numpy as np
import pytest
import scipy.stats

from jaxbridge.plot.copula import empirical_copula, gaussian_copula


@pytest.mark.parametrize("correlation", [-0.8, 0.0, 0.6])
def test_gaussian_copula(correlation):
    """Margins are uniform, edges included; at the medians Sheppard's formula holds; and by
    Plackett's identity ∂C/∂r = φ₂(x, y; r)."""
    grid = np.linspace(0, 1, 11)
    one, zero = np.ones(11), np.zeros(11)
    np.testing.assert_allclose(gaussian_copula(grid, one, correlation), grid, atol=1e-12)
    np.testing.assert_allclose(gaussian_copula(zero, grid, correlation), zero, atol=1e-12)
    half = np.full(2, 0.5)
    centre = 1 / 4 + np.arcsin(correlation) / (2 * np.pi)
    np.testing.assert_allclose(gaussian_copula(half, half, correlation), centre, atol=1e-12)
    u, v, h = np.array([0.1, 0.5, 0.9]), np.array([0.2, 0.6, 0.7]), 1e-4
    higher, lower = (gaussian_copula(u, v, correlation + sign * h) for sign in (1, -1))
    x, y = scipy.stats.norm.ppf(u), scipy.stats.norm.ppf(v)
    rest = 1 - correlation**2
    exponent = (x**2 + y**2 - 2 * correlation * x * y) / (2 * rest)
    expected = np.exp(-exponent) / (2 * np.pi * np.sqrt(rest))
    np.testing.assert_allclose((higher - lower) / (2 * h), expected, rtol=1e-5)


def test_empirical_copula_counts_ranks():
    samples = np.random.default_rng(0).normal(size=(97, 2))
    grid = np.linspace(0, 1, 11)
    ranks = scipy.stats.rankdata(samples, axis=0)
    expected = [
        [np.mean((ranks[:, 0] <= 97 * u + 1e-9) & (ranks[:, 1] <= 97 * v + 1e-9)) for v in grid]
        for u in grid
    ]
    np.testing.assert_allclose(empirical_copula(samples, 10), expected)
