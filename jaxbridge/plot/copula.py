"""Copulas of two variables, exact for Gaussian laws and empirical for draws.

C(u, v) is the probability that the first variable is below its u-quantile and the second below its
v-quantile.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import multivariate_normal, norm

from .style import Reals


def gaussian_copula(
    u: Float[np.ndarray, "..."], v: Float[np.ndarray, "..."], correlation: float
) -> Float[np.ndarray, "..."]:
    """Return the Gaussian copula C(u, v), for u, v in [0, 1] and -1 < correlation < 1."""
    covariance: Any = [[1, correlation], [correlation, 1]]
    law = multivariate_normal(cov=covariance)
    return law.cdf(norm.ppf(np.stack([u, v], axis=-1)))


def empirical_copula(
    samples: Float[Reals, "n 2"], resolution: int
) -> Float[np.ndarray, "{resolution}+1 {resolution}+1"]:
    """Return the empirical copula C_n(u, v) for u, v = 0, 1/m, ..., 1 with m = `resolution`.

    C_n(u, v) is the fraction of the n draws whose ranks are at most n u and n v.
    """
    n = len(samples)
    ranks = np.argsort(np.argsort(np.asarray(samples), axis=0), axis=0) + 1
    cell = (ranks * resolution - 1) // n  # rank/n lies in (cell/m, (cell + 1)/m]
    counts = np.zeros((resolution + 1, resolution + 1))
    # Count the draws of each cell; cumulative sums then give the counts below and to the left.
    np.add.at(counts, tuple(cell.T + 1), 1)
    return counts.cumsum(0).cumsum(1) / n
