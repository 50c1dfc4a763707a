"""Copulas of two variables: C(u, v), the probability that both lie below these quantiles."""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import multivariate_normal, norm

from .style import Reals


def gaussian_copula(
    u: Float[np.ndarray, "..."], v: Float[np.ndarray, "..."], correlation: float
) -> Float[np.ndarray, "..."]:
    """The Gaussian copula C(u, v), for u, v in [0, 1] and -1 < correlation < 1."""
    covariance: Any = [[1, correlation], [correlation, 1]]
    law = multivariate_normal(cov=covariance)
    return law.cdf(norm.ppf(np.stack([u, v], axis=-1)))


def empirical_copula(
    samples: Float[Reals, "n 2"], resolution: int
) -> Float[np.ndarray, "{resolution}+1 {resolution}+1"]:
    """C_n(u, v), the share of draws with ranks at most nu and nv, at u, v = 0, 1/m, ..., 1,
    m being the `resolution`."""
    n = len(samples)
    ranks = np.argsort(np.argsort(np.asarray(samples), axis=0), axis=0) + 1
    cell = (ranks * resolution - 1) // n  # rank/n lies in (cell/m, (cell + 1)/m]
    counts = np.zeros((resolution + 1, resolution + 1))
    np.add.at(counts, tuple(cell.T + 1), 1)
    return counts.cumsum(0).cumsum(1) / n
