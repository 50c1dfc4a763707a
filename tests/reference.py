"""The associated diffusion in NumPy, written from the paper as an independent cross-check.

Euler steps, σ = I, linear drift: `dX = -B X dt + dW` with symmetric B, so the time reversal has
the same drift. (The approximate bridge in NumPy is `studies.numpy_reference`, in `notebooks`.)
"""

import itertools

import numpy as np


def hitting_frequency(rng, B, path, dt, gamma, starts):
    """The share of associated diffusions, one from each of `starts` (n, d), that hit the path."""
    y = starts.copy()
    hit = np.zeros(len(y), bool)
    for z, z_next in itertools.pairwise(path):
        dw = z_next - z + B @ z * dt
        difference = y - z - (y - z) @ B.T * dt  # after the drift of the step
        gap = np.linalg.norm(difference, axis=1)
        u = difference / np.where(gap > 0, gap, 1)[:, None]
        du = np.sqrt(dt) * rng.normal(size=len(y))
        along = (gamma - 1) * (u @ dw) + np.sqrt(1 - gamma**2) * du
        y = y - y @ B.T * dt + dw + along[:, None] * u
        gap_next = (u * (y - z_next)).sum(1)
        exponent = np.minimum(0, -gap * gap_next / ((1 - gamma) * dt))
        hit |= rng.uniform(size=len(y)) < np.exp(exponent)
    return hit.mean()
