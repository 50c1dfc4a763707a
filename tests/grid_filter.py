"""Filter and smoother of a diffusion on the line by Kolmogorov's equation on a grid, in NumPy."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm


class GridSmoothed(NamedTuple):
    log_likelihood: float
    nodes: np.ndarray
    weights: np.ndarray  # (n, nodes), at the times of the observations


def generator(drift, variance, nodes):
    """The rates of the Markov chain on the nodes that has this drift and variance."""
    h = nodes[1] - nodes[0]
    spread, drift = np.maximum(variance(nodes), abs(drift(nodes)) * h), drift(nodes)
    up = spread / (2 * h**2) + drift / (2 * h)
    down = spread / (2 * h**2) - drift / (2 * h)
    up[-1] = down[0] = 0
    return np.diag(up[:-1], 1) + np.diag(down[1:], -1) - np.diag(up + down)


def grid_filter(drift, variance, nodes, initial, gaps, log_densities) -> GridSmoothed:
    """`initial` weighs the nodes at the first time, `log_densities` (n, nodes) are those of what
    was seen at each time."""
    rates = generator(drift, variance, nodes)
    moves = {gap: expm(rates * gap) for gap in np.unique(np.round(gaps, 9))}
    likelihoods = np.exp(log_densities)
    forward, log_likelihood = [initial / initial.sum() * likelihoods[0]], 0.0
    for gap, likelihood in zip(np.round(gaps, 9), likelihoods[1:], strict=True):
        log_likelihood += np.log(forward[-1].sum())
        forward[-1] = forward[-1] / forward[-1].sum()
        forward.append((forward[-1] @ moves[gap]) * likelihood)
    log_likelihood += np.log(forward[-1].sum())
    backward = [np.ones(len(nodes))]
    for gap, likelihood in zip(np.round(gaps, 9)[::-1], likelihoods[:0:-1], strict=True):
        later = moves[gap] @ (likelihood * backward[-1])
        backward.append(later / later.max())
    weights = np.array(forward) * np.array(backward[::-1])
    return GridSmoothed(float(log_likelihood), nodes, weights / weights.sum(1, keepdims=True))
