"""Grids of times between 0 and T, as fractions of T, and which of their points are kept."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..engine.checks import Numbers, as_floating, is_traced
from .intervals import Intervals


def uniform_fractions(num_steps: int) -> Float[np.ndarray, " points"]:
    """t_i / T on the grid of equal steps."""
    return np.arange(num_steps + 1) / num_steps


def grid_times(
    intervals: Intervals,
    stored: Int[Array, " K"] | None,
    fractions: Float[np.ndarray, " points"],
    several_durations: bool,
) -> Float[Array, "*durations K"]:
    """The times of the stored steps, for each interval where durations differ."""
    duration = intervals.duration[:, None] if several_durations else intervals.duration[0]
    kept = jnp.asarray(fractions, duration.dtype)
    return (kept if stored is None else kept[stored]) * duration


def stored_steps(
    save_at: Numbers | None, duration: Numbers, fractions: Float[np.ndarray, " points"]
) -> Int[Array, " K"] | None:
    """The grid points, t_i = T × fraction, at which paths are kept."""
    if save_at is None:
        return None
    save_at = as_floating("save_at", save_at)
    if save_at.ndim != 1 or save_at.shape[0] == 0:
        raise ValueError(f"`save_at` must be times in an array of shape (K,); got {save_at.shape}.")
    between = (fractions[1:] + fractions[:-1]) / 2
    if is_traced(save_at, duration):
        wanted = save_at / jnp.asarray(duration)
        middle = jnp.asarray(between, wanted.dtype)
        return jnp.searchsorted(middle, wanted).astype(jnp.int32)
    length = float(np.asarray(duration, float))
    wanted = np.asarray(save_at, float) / length
    nearest = np.searchsorted(between, wanted)
    # A thousandth of a step, and what rounding makes of times.
    tolerance = 1e-3 * np.diff(fractions).min() + float(jnp.finfo(save_at.dtype).eps)
    if np.any(wanted < -tolerance) or np.any(wanted > 1 + tolerance):
        raise ValueError(f"`save_at` must lie in [0, {duration}]; got {save_at}.")
    if np.any(np.abs(fractions[nearest] - wanted) > tolerance):
        raise ValueError(
            "`save_at` must lie on the grid of `num_steps` steps: the times nearest to "
            f"those given are {fractions[nearest] * length}."
        )
    if np.any(np.diff(nearest) <= 0):
        raise ValueError(f"`save_at` must increase from one grid point on; got {save_at}.")
    return jnp.asarray(nearest, jnp.int32)
