"""The bridges asked for: end points and durations, checked and brought to one shape.

What is wrong and visible before tracing is refused here, with a sentence that says what to
change. Values that are being traced cannot be looked at and pass.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..engine.checks import Numbers, as_real, is_traced


class Intervals(NamedTuple):
    """I bridges of one model: from `start` to `end`, both (I, d), in `duration`, (I,)."""

    start: Float[Array, "I d"]
    end: Float[Array, "I d"]
    duration: Float[Array, " I"]


def as_intervals(start: Numbers, end: Numbers, duration: Numbers) -> tuple[Intervals, bool, bool]:
    """The intervals, and whether the end points and the duration came with an axis I."""
    points = {"start": as_real("start", start), "end": as_real("end", end)}
    duration = as_real("duration", duration)
    for name, point in points.items():
        if point.ndim not in (1, 2) or point.shape[-1] == 0:
            raise ValueError(
                f"`{name}` must be one point, shape (d,), or one for each interval, shape "
                f"(I, d); got {point.shape}."
            )
    if duration.ndim > 1:
        raise ValueError(f"`duration` must have shape () or (I,); got {duration.shape}.")
    if points["start"].shape[-1] != points["end"].shape[-1]:
        raise ValueError(
            "`start` and `end` must be points of one dimension; got shapes "
            f"{points['start'].shape} and {points['end'].shape}."
        )
    dtype = _working_dtype(*points.values(), duration)
    lengths = {point.shape[0] for point in points.values() if point.ndim == 2}
    lengths |= {duration.shape[0]} if duration.ndim == 1 else set()
    if len(lengths - {1}) > 1:
        raise ValueError(
            "`start`, `end` and `duration` must agree in the number of intervals; got shapes "
            f"{points['start'].shape}, {points['end'].shape} and {duration.shape}."
        )
    for name, value in {**points, "duration": duration}.items():
        if not is_traced(value) and not np.all(np.isfinite(value)):
            raise ValueError(f"`{name}` must be finite; got {value}.")
    if not is_traced(duration) and not np.all(np.asarray(duration) > 0):
        raise ValueError(f"`duration` must be positive; got {duration}.")
    shortest = 2**30 * float(jnp.finfo(dtype).tiny)  # divided into steps it is still a number
    if not is_traced(duration) and np.any(np.asarray(duration) < shortest):
        raise ValueError(
            f"`duration` = {duration} is too short for steps of type {dtype}: choose another unit "
            "of time."
        )
    num_intervals = max(lengths, default=1)
    d = points["start"].shape[-1]
    intervals = Intervals(
        jnp.broadcast_to(points["start"], (num_intervals, d)).astype(dtype),
        jnp.broadcast_to(points["end"], (num_intervals, d)).astype(dtype),
        jnp.broadcast_to(duration, (num_intervals,)).astype(dtype),
    )
    return intervals, bool(lengths), duration.ndim == 1


def _working_dtype(*arrays: Array) -> jnp.dtype:
    """The widest floating point type that was given; JAX's default if none was."""
    floating = [
        a.dtype for a in arrays if jnp.issubdtype(a.dtype, jnp.floating) and not a.weak_type
    ]
    return max(floating, key=lambda dtype: dtype.itemsize, default=jnp.asarray(0.0).dtype)
