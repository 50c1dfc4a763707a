"""The Kalman filter and the smoother of Rauch, Tung and Striebel, in NumPy, without the package."""

import functools
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm


class Smoothed(NamedTuple):
    log_likelihood: float
    mean: np.ndarray  # (M + 1, d), at all points of the grid
    covariance: np.ndarray


def euler_step(A, V):
    """Of dX = -A X dt + noise of covariance V, as the Euler scheme makes it."""
    return lambda dt: (np.eye(len(A)) - A * dt, V * dt)


def exact_step(A, V):
    """As it is (Van Loan 1978)."""

    @functools.cache
    def step(dt):
        d = len(A)
        block = expm(np.block([[-A, V], [np.zeros((d, d)), A.T]]) * dt)
        return block[:d, :d], block[:d, d:] @ block[:d, :d].T

    return step


def kalman(step, times, values, matrix, noise, mean, covariance, num_steps, jumps=None) -> Smoothed:
    """For values (n, m), NaN where nothing was seen, `num_steps` between two times; after each
    reading the state jumps by a row of `jumps`."""
    jumps = np.zeros((len(times), len(mean))) if jumps is None else jumps
    log_likelihood = 0.0
    filtered, predicted, decays = [], [], []

    def update(mean, covariance, y):
        nonlocal log_likelihood
        seen = np.isfinite(y)
        if not seen.any():
            return mean, covariance
        L, R = matrix[seen], noise[np.ix_(seen, seen)]
        S, residual = L @ covariance @ L.T + R, y[seen] - L @ mean
        log_likelihood -= residual @ np.linalg.solve(S, residual) / 2
        log_likelihood -= np.linalg.slogdet(2 * np.pi * S)[1] / 2
        gain = covariance @ L.T @ np.linalg.inv(S)
        return mean + gain @ residual, covariance - gain @ L @ covariance

    mean, covariance = update(mean, covariance, values[0])
    filtered.append((mean, covariance))
    for dt, y, jump in zip(np.diff(times) / num_steps, values[1:], jumps[:-1], strict=True):
        decay, spread = step(round(dt, 12))
        for i in range(num_steps):
            mean = mean + (jump if i == 0 else 0)
            mean, covariance = decay @ mean, decay @ covariance @ decay.T + spread
            predicted.append((mean, covariance))
            decays.append(decay)
            if i == num_steps - 1:
                mean, covariance = update(mean, covariance, y)
            filtered.append((mean, covariance))
    smoothed = [filtered[-1]]
    for (m, P), (m_next, P_next), decay in zip(
        filtered[-2::-1], predicted[::-1], decays[::-1], strict=True
    ):
        gain = P @ decay.T @ np.linalg.inv(P_next)
        later, spread = smoothed[-1]
        smoothed.append((m + gain @ (later - m_next), P + gain @ (spread - P_next) @ gain.T))
    means, covariances = zip(*smoothed[::-1], strict=True)
    return Smoothed(float(log_likelihood), np.array(means), np.array(covariances))
