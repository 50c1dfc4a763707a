"""Circles and tori: coordinates that are angles.

A diffusion on a circle of circumference L is the image of a diffusion on the line whose
coefficients have period L. Its transition density at y is the sum of those of the line over all
points y + kL, the windings of y. Its bridge to y is a mixture of the bridges to the windings, with
their shares of this sum.
"""

import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..engine.checks import Numbers, as_floating, check_count, is_traced


def windings(point: Numbers, periods: Numbers, most: int = 2) -> Float[Array, "W d"]:
    """Return all points with the same angles as `point`, up to a number of turns.

    The log density on the circle or torus is the `total()` of the log densities at these points.

    **Arguments:**

    - `point`: a point, shape (d,). Choose it within half a turn of the start, so that the likely
        windings are among the results.
    - `periods`: circumference of each coordinate, shape (d,), or one number for all; infinite for a
        coordinate that is no angle.
    - `most`: maximum number of turns in each direction. More are needed if the noise spreads over
        several turns.

    **Returns:** the points, shape (W, d) with W = (2 `most` + 1)^c for c angles; `point` itself is
    in the middle.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    circle = jb.Diffusion(lambda x, p: -jnp.sin(x))
    ends = jb.windings([0.0], 2 * jnp.pi)  # shape (5, 1)
    densities = jb.transition_log_density(key, circle, [1.5], ends, 2.0, proposal=jb.Guided())
    densities.total().value
    ```
    """
    point = as_floating("point", point)
    if point.ndim != 1 or not point.size:
        raise ValueError(f"`point` must have shape (d,); got shape {point.shape}.")
    lengths = as_floating("periods", periods)
    if lengths.shape not in ((), point.shape):
        raise ValueError(
            f"`periods` must have shape () or {point.shape}, one per coordinate; got shape "
            f"{lengths.shape}."
        )
    most = check_count("most", most)
    if is_traced(lengths):
        raise ValueError("`periods` must be concrete; got traced values.")
    lengths = np.broadcast_to(np.asarray(lengths, float), point.shape)
    if not np.all(lengths > 0):
        raise ValueError(f"`periods` must be positive; got {lengths}.")
    turns = [range(-most, most + 1) if np.isfinite(length) else (0,) for length in lengths]
    shifts = np.array(list(itertools.product(*turns))) * np.where(np.isfinite(lengths), lengths, 0)
    return point + jnp.asarray(shifts, point.dtype)
