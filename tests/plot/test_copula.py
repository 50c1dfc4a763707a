"""Copulas against SciPy's normal law, and ranks."""

import numpy as np
import pytest
import scipy.stats

from jaxbridge.plot.copula import empirical_copula, gaussian_copula


@pytest.mark.parametrize("correlation", [-0.8, 0.0, 0.6])
def test_gaussian_copula(correlation):
    u, v = np.meshgrid([0.1, 0.5, 0.9], [0.2, 0.5, 0.7])
    law = scipy.stats.multivariate_normal(cov=[[1, correlation], [correlation, 1]])
    expected = law.cdf(np.stack([scipy.stats.norm.ppf(u), scipy.stats.norm.ppf(v)], -1))
    np.testing.assert_allclose(gaussian_copula(u, v, correlation), expected, atol=1e-5)


def test_empirical_copula_counts_ranks():
    samples = np.random.default_rng(0).normal(size=(97, 2))
    grid = np.linspace(0, 1, 11)
    ranks = scipy.stats.rankdata(samples, axis=0)
    expected = [
        [np.mean((ranks[:, 0] <= 97 * u + 1e-9) & (ranks[:, 1] <= 97 * v + 1e-9)) for v in grid]
        for u in grid
    ]
    np.testing.assert_allclose(empirical_copula(samples, 10), expected)
