"""The approximate bridge in NumPy: the yardstick of the benchmark, and an independent check.

Written from the paper for Euler steps, σ = I and linear drift, `dX = -B X dt + dW` with symmetric
B, so that the time reversal has the same drift. Vectorised over proposals, which lie in the last
axis, in single precision and in blocks that fit in a processor's cache.
"""

import numpy as np
from jaxtyping import Bool, Float

_BLOCK = 4096


def approximate_bridges(
    rng: np.random.Generator,
    B: Float[np.ndarray, "d d"],
    start: Float[np.ndarray, " d"],
    end: Float[np.ndarray, " d"],
    duration: float,
    num_steps: int,
    num_proposals: int,
    gamma: float,
    crossing: bool,
) -> Float[np.ndarray, "points d met"]:
    """Paths of the proposals that met, decided by the Brownian bridge of the gap (`crossing`) or
    by its sign."""
    B, start, end = (np.asarray(value, np.float32) for value in (B, start, end))
    made = []
    for done in range(0, num_proposals, _BLOCK):
        size = min(_BLOCK, num_proposals - done)
        arguments = (B, start, end, duration, num_steps, size, gamma, crossing)
        paths, met = _one_block(rng, *arguments)
        made.append(paths[:, :, met])
    return np.concatenate(made, axis=2)


def _one_block(
    rng, B, start, end, duration, num_steps, size, gamma, crossing
) -> tuple[Float[np.ndarray, "points d lanes"], Bool[np.ndarray, " lanes"]]:
    dt = np.float32(duration / num_steps)
    root_dt, step = np.sqrt(dt), np.eye(len(start), dtype=np.float32) - dt * B
    x = np.empty((num_steps + 1, len(start), size), np.float32)
    x[num_steps] = end[:, None]
    for i in range(num_steps, 0, -1):
        noise = rng.standard_normal((len(start), size), np.float32)
        x[i - 1] = step @ x[i] + root_dt * noise
    own_scale = root_dt * np.float32(np.sqrt(1 - gamma**2))
    z = np.repeat(start[:, None], size, axis=1)
    paths, met = np.empty_like(x), np.zeros(size, bool)
    paths[0] = z
    for i in range(num_steps):
        dw = x[i + 1] - step @ x[i]
        difference = step @ (x[i] - z) if crossing else x[i] - z  # after the drift, or before
        gap = np.sqrt((difference * difference).sum(0))
        u = difference / np.where(gap > 0, gap, 1)
        along = np.float32(gamma - 1) * (u * dw).sum(0)
        if gamma > -1:
            along += own_scale * rng.standard_normal(size, np.float32)
        driven = step @ z + dw + along * u
        gap_next = (u * (x[i + 1] - driven)).sum(0)
        if crossing:
            exponent = np.minimum(gap * gap_next / np.float32((gamma - 1) * dt), 0)
            met |= rng.random(size, np.float32) < np.exp(exponent)
        else:
            met |= gap * gap_next < 0
        z = np.where(met, x[i + 1], driven)
        paths[i + 1] = z
    return paths, met
