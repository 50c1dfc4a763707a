"""Copulas of two variables: C(u, v), the probability that both lie below these quantiles."""

import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Float

from .style import Reals


def gaussian_copula(
    u: Float[np.ndarray, "..."], v: Float[np.ndarray, "..."], correlation: float
) -> Float[np.ndarray, "..."]:
    """The Gaussian copula C(u, v), for u, v in [0, 1] and -1 < correlation < 1.

    By Plackett's identity ∂C/∂r = φ₂(x, y; r), integrated from independence with r = sin θ.
    """
    # Away from the edges, where the scores are infinite, by less than a picture can show.
    x, y = (np.asarray(ndtri(np.clip(p, 1e-6, 1 - 1e-6)), float)[..., None] for p in (u, v))
    nodes, weights = np.polynomial.legendre.leggauss(48)
    half = np.arcsin(correlation) / 2
    angle = half * (1 + nodes)
    exponent = (x**2 + y**2 - 2 * x * y * np.sin(angle)) / (2 * np.cos(angle) ** 2)
    return u * v + half * np.exp(-exponent) @ weights / (2 * np.pi)


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
