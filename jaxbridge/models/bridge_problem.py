"""The input that all bridge samplers share: end points, durations, time grid and stored times.

The checks raise an error before anything is traced or compiled. They skip traced values, because
those have no numbers yet. `BridgeProblem` also shapes the results.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PyTree, Shaped

from ..engine.checks import (
    Numbers,
    as_floating,
    as_real,
    check_num_steps,
    check_precision,
    is_traced,
)
from ..engine.keys import first_keys
from .diffusion import Diffusion, check_diffusion


class Intervals(NamedTuple):
    """End points and durations of I bridges: `start` and `end`, shape (I, d), and `duration`, (I,),
    in units of time."""

    start: Float[Array, "I d"]
    end: Float[Array, "I d"]
    duration: Float[Array, " I"]


class BridgeProblem(eqx.Module):
    """I bridges of one model on a grid of N steps, and the shape of their results.

    - `stored`: indices of the K grid points at which paths are stored; `None` stores all.
    - `num_steps`: N.
    - `batched`: whether results have an axis I. They have one if an end point or the duration has.
    - `several_durations`: whether the duration has an axis I, so that each interval has its own
        times.
    """

    intervals: Intervals
    stored: Int[Array, " K"] | None
    num_steps: int = eqx.field(static=True)
    batched: bool = eqx.field(static=True)
    several_durations: bool = eqx.field(static=True)

    @property
    def num_intervals(self) -> int:
        """Return I."""
        return self.intervals.start.shape[0]

    def num_path_steps(self, num_bridges: int) -> int:
        """Return the total number of steps of `num_bridges` paths per interval."""
        return num_bridges * self.num_intervals * self.num_steps

    @property
    def like(self) -> Float[Array, " d"]:
        """Return a point with the shape and dtype of the states. Its values have no meaning."""
        return self.intervals.start[0]

    def keep(
        self, save_at: Numbers | None, duration: Numbers, fractions: Float[np.ndarray, " points"]
    ) -> "BridgeProblem":
        """Return the same problem with paths stored at the times `save_at` only; `None` stores all.

        `fractions` is the grid, divided by the duration. For several durations `save_at` are also
        fractions of the duration.

        **Raises:** `ValueError` for times that do not increase, or are not on the grid.
        """
        # Intervals of different durations share `save_at` as fractions of their durations.
        length = 1.0 if self.several_durations else duration
        stored = _stored_steps(save_at, length, fractions)
        return dataclasses.replace(self, stored=stored)

    def kept(self, paths: Float[Array, "*I points d"]) -> Float[Array, "*I K d"]:
        """Return the stored points of paths with all grid points."""
        return paths if self.stored is None else paths[..., self.stored, :]

    def times(self, fractions: Float[np.ndarray, " points"]) -> Float[Array, "*durations K"]:
        """Return the stored times: shape (K,), or (I, K) for several durations."""
        duration = self.intervals.duration
        duration = duration[:, None] if self.several_durations else duration[0]
        grid = jnp.asarray(fractions, duration.dtype)
        return (grid if self.stored is None else grid[self.stored]) * duration

    def keys(self, key: Key[Array, ""], num: int) -> Key[Array, "I num"]:
        """Return `num` random keys per interval, shape (I, num)."""
        return first_keys(key, self.num_intervals * num).reshape(self.num_intervals, num)

    def result(self, tree: PyTree) -> PyTree:
        """Return `tree`, whose arrays have an axis I; drop this axis unless the problem is
        `batched`."""
        return tree if self.batched else jax.tree.map(lambda leaf: leaf[0], tree)

    def total(self, counts: Shaped[Array, "..."]) -> Int[Array, "*I"]:
        """Return the sum of `counts` for each interval.

        The counts are grouped by interval, in order, with equally many for each.
        """
        sums = jnp.sum(counts.reshape(self.num_intervals, -1), axis=1, dtype=jnp.int32)
        return self.result(sums)


def bridge_problem(
    model: Diffusion, start: Numbers, end: Numbers, duration: Numbers, num_steps: int
) -> BridgeProblem:
    """Check the arguments common to all bridge samplers; return a problem that stores all points.

    **Raises:** `TypeError` and `ValueError` for invalid arguments.
    """
    check_diffusion(model)
    intervals, batched, several_durations = as_intervals(start, end, duration)
    num_steps = check_num_steps(num_steps, len(intervals.duration))
    return BridgeProblem(intervals, None, num_steps, batched, several_durations)


def as_intervals(start: Numbers, end: Numbers, duration: Numbers) -> tuple[Intervals, bool, bool]:
    """Check end points and durations; broadcast them to I intervals of one dtype.

    **Returns:** the intervals; whether any argument has an axis I; whether the duration has one.

    **Raises:** `ValueError` for shapes that do not fit, values that are not finite, and durations
    that are not positive or too short for the dtype. `TypeError` for values that are not real
    numbers, or have less than single precision.
    """
    points = {"start": as_points("start", start), "end": as_points("end", end)}
    duration = as_real("duration", duration)
    if duration.ndim > 1:
        raise ValueError(f"`duration` must have shape () or (I,); got {duration.shape}.")
    if points["start"].shape[-1] != points["end"].shape[-1]:
        raise ValueError(
            "`start` and `end` must have the same dimension d; got shapes "
            f"{points['start'].shape} and {points['end'].shape}."
        )
    dtype = _working_dtype(*points.values(), duration)
    check_precision("`start`, `end` and `duration`", dtype)
    # Arguments without an axis I, or with I = 1, apply to all intervals.
    lengths = {point.shape[0] for point in points.values() if point.ndim == 2}
    lengths |= {duration.shape[0]} if duration.ndim == 1 else set()
    if len(lengths - {1}) > 1:
        raise ValueError(
            "`start`, `end` and `duration` must have the same number of intervals; got shapes "
            f"{points['start'].shape}, {points['end'].shape} and {duration.shape}."
        )
    if 0 in lengths:
        raise ValueError(
            "`start`, `end` and `duration` must have at least one interval; got shapes "
            f"{points['start'].shape}, {points['end'].shape} and {duration.shape}."
        )
    for name, value in {**points, "duration": duration}.items():
        if not is_traced(value) and not np.all(np.isfinite(value)):
            raise ValueError(f"`{name}` must be finite; got {value}.")
    if not is_traced(duration) and not np.all(np.asarray(duration) > 0):
        raise ValueError(f"`duration` must be positive; got {duration}.")
    # The factor leaves room for up to 2³⁰ steps, whose size is then still a normal number.
    shortest = 2**30 * float(jnp.finfo(dtype).tiny)
    if not is_traced(duration) and np.any(np.asarray(duration) < shortest):
        raise ValueError(
            f"`duration` = {duration} is too short: in {dtype} it must be at least "
            f"{shortest:.2g}. Choose a smaller unit of time."
        )
    num_intervals = max(lengths, default=1)
    d = points["start"].shape[-1]
    # Conversion first: then a Python number compiles what an array does.
    intervals = Intervals(
        jnp.broadcast_to(points["start"].astype(dtype), (num_intervals, d)),
        jnp.broadcast_to(points["end"].astype(dtype), (num_intervals, d)),
        jnp.broadcast_to(duration.astype(dtype), (num_intervals,)),
    )
    return intervals, bool(lengths), duration.ndim == 1


def as_points(name: str, value: Numbers) -> Array:
    """Return `value` as one point, shape (d,), or as I points, shape (I, d).

    **Raises:** `ValueError` for any other shape.
    """
    points = as_real(name, value)
    if points.ndim not in (1, 2) or points.shape[-1] == 0:
        raise ValueError(
            f"`{name}` must be one point, shape (d,), or one point per interval, shape "
            f"(I, d); got shape {points.shape}."
        )
    return points


def uniform_fractions(num_steps: int) -> Float[np.ndarray, " points"]:
    """Return t_i / T for the grid of N equal steps."""
    return np.arange(num_steps + 1) / num_steps


def _stored_steps(
    save_at: Numbers | None, duration: Numbers, fractions: Float[np.ndarray, " points"]
) -> Int[Array, " K"] | None:
    """Return the indices of the grid points nearest to `save_at`; `None` for all points.

    Grid point i is `duration` × `fractions[i]`. Traced times are not checked.

    **Raises:** `ValueError` for times that are not increasing points of the grid.
    """
    if save_at is None:
        return None
    save_at = as_floating("save_at", save_at)
    if save_at.ndim != 1 or save_at.shape[0] == 0:
        raise ValueError(
            f"`save_at` must be an array of times, shape (K,); got shape {save_at.shape}."
        )
    # The index of the nearest grid point is the number of midpoints below the time.
    midpoints = (fractions[1:] + fractions[:-1]) / 2
    if is_traced(save_at, duration):
        targets = save_at / jnp.asarray(duration)
        traced_midpoints = jnp.asarray(midpoints, targets.dtype)
        return jnp.searchsorted(traced_midpoints, targets).astype(jnp.int32)
    length = float(np.asarray(duration, float))
    targets = np.asarray(save_at, float) / length
    nearest = np.searchsorted(midpoints, targets)
    # A thousandth of a step, plus the rounding error of the times.
    tolerance = 1e-3 * np.diff(fractions).min() + float(jnp.finfo(save_at.dtype).eps)
    if np.any(targets < -tolerance) or np.any(targets > 1 + tolerance):
        raise ValueError(f"`save_at` must lie in [0, {duration}]; got {save_at}.")
    if np.any(np.abs(fractions[nearest] - targets) > tolerance):
        raise ValueError(
            f"`save_at` must lie on the grid of `num_steps` steps; got {save_at}. The nearest grid "
            f"times are {fractions[nearest] * length}."
        )
    if np.any(np.diff(nearest) <= 0):
        raise ValueError(f"`save_at` must increase by at least one grid step; got {save_at}.")
    return jnp.asarray(nearest, jnp.int32)


def _working_dtype(*arrays: Array) -> jnp.dtype:
    """Return the widest floating point dtype of the arrays, or else JAX's default."""
    # Integers and Python numbers, which are weakly typed, do not widen the result.
    floating = [
        a.dtype for a in arrays if jnp.issubdtype(a.dtype, jnp.floating) and not a.weak_type
    ]
    return max(floating, key=lambda dtype: dtype.itemsize, default=jnp.asarray(0.0).dtype)
