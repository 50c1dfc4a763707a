"""The approximate bridge in NumPy, written from the paper as an independent cross-check.

Euler steps, σ = I, linear drift: `dX = -B X dt + dW` with symmetric B, so the time reversal has
the same drift. The meeting is decided by the Brownian bridge of the gap or by its sign.
"""

import itertools

import numpy as np


def approximate_bridges(rng, B, start, end, duration, num_steps, num_proposals, gamma, crossing):
    """Paths (n, N+1, d) of the proposals that met."""
    d, dt = len(start), duration / num_steps
    x = np.empty((num_steps + 1, num_proposals, d))
    x[num_steps] = end
    for i in range(num_steps, 0, -1):
        x[i - 1] = x[i] - x[i] @ B.T * dt + np.sqrt(dt) * rng.normal(size=x[i].shape)
    z = np.empty_like(x)
    z[0] = start
    met = np.zeros(num_proposals, bool)
    for i in range(num_steps):
        dw = x[i + 1] - x[i] + x[i] @ B.T * dt
        difference = x[i] - z[i]
        gap = np.linalg.norm(difference, axis=1)
        u = difference / np.where(gap > 0, gap, 1)[:, None]
        du = np.sqrt(dt) * rng.normal(size=num_proposals)
        along = (gamma - 1) * (u * dw).sum(1) + np.sqrt(1 - gamma**2) * du
        driven = z[i] - z[i] @ B.T * dt + dw + along[:, None] * u
        gap_next = (u * (x[i + 1] - driven)).sum(1)
        if crossing:
            met |= rng.uniform(size=num_proposals) < np.exp(
                np.minimum(0, -gap * gap_next / ((1 - gamma) * dt))
            )
        else:
            met |= gap * gap_next < 0
        z[i + 1] = np.where(met[:, None], x[i + 1], driven)
    return np.moveaxis(z[:, met], 0, 1)


def hitting_frequency(rng, B, path, dt, gamma, starts):
    """The share of associated diffusions, one from each of `starts` (n, d), that hit the path."""
    y = starts.copy()
    hit = np.zeros(len(y), bool)
    for z, z_next in itertools.pairwise(path):
        dw = z_next - z + B @ z * dt
        difference = y - z
        gap = np.linalg.norm(difference, axis=1)
        u = difference / np.where(gap > 0, gap, 1)[:, None]
        du = np.sqrt(dt) * rng.normal(size=len(y))
        along = (gamma - 1) * (u @ dw) + np.sqrt(1 - gamma**2) * du
        y = y - y @ B.T * dt + dw + along[:, None] * u
        gap_next = (u * (y - z_next)).sum(1)
        exponent = np.minimum(0, -gap * gap_next / ((1 - gamma) * dt))
        hit |= rng.uniform(size=len(y)) < np.exp(exponent)
    return hit.mean()
