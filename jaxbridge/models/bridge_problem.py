"""The bridges asked for: end points and durations, checked and brought to one shape; the grid of
their times, as fractions of T, and which of its points are kept; and the shapes of results.

What is wrong and visible before tracing is refused here, with a sentence that says what to
change. Values that are being traced cannot be looked at and pass.
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
from ..engine.keys import numbered
from .diffusion import Diffusion, check_diffusion


class Intervals(NamedTuple):
    """I bridges of one model: from `start` to `end`, both (I, d), in `duration`, (I,)."""

    start: Float[Array, "I d"]
    end: Float[Array, "I d"]
    duration: Float[Array, " I"]


class BridgeProblem(eqx.Module):
    """I bridges of one model on a grid of N steps, and how what is found of them is returned: with
    an axis I where the end points or the duration came with one.

    - `stored`: the K grid points at which paths are kept, all where it is `None`.
    - `several_durations`: whether each interval has times of its own.
    """

    intervals: Intervals
    stored: Int[Array, " K"] | None
    num_steps: int = eqx.field(static=True)
    batched: bool = eqx.field(static=True)
    several_durations: bool = eqx.field(static=True)

    @property
    def num_intervals(self) -> int:
        return self.intervals.start.shape[0]

    def num_path_steps(self, num_bridges: int) -> int:
        """The steps of so many paths of each interval."""
        return num_bridges * self.num_intervals * self.num_steps

    @property
    def like(self) -> Float[Array, " d"]:
        """A point, of which only shape and dtype count."""
        return self.intervals.start[0]

    def keep(
        self, save_at: Numbers | None, duration: Numbers, fractions: Float[np.ndarray, " points"]
    ) -> "BridgeProblem":
        """The same, with paths kept at the times that the user asked for."""
        whole = 1.0 if self.several_durations else duration
        stored = _stored_steps(save_at, whole, fractions)
        return dataclasses.replace(self, stored=stored)

    def kept(self, paths: Float[Array, "*I points d"]) -> Float[Array, "*I K d"]:
        """The points of whole paths that are kept."""
        return paths if self.stored is None else paths[..., self.stored, :]

    def times(self, fractions: Float[np.ndarray, " points"]) -> Float[Array, "*durations K"]:
        """The times of the points that are kept, for each interval where durations differ."""
        duration = self.intervals.duration
        duration = duration[:, None] if self.several_durations else duration[0]
        kept = jnp.asarray(fractions, duration.dtype)
        return (kept if self.stored is None else kept[self.stored]) * duration

    def keys(self, key: Key[Array, ""], num: int) -> Key[Array, "I num"]:
        """A key for each of so many paths of each interval, numbered through."""
        return numbered(key, self.num_intervals * num).reshape(self.num_intervals, num)

    def result(self, tree: PyTree) -> PyTree:
        """What was found of each interval; of the only one without an axis."""
        return tree if self.batched else jax.tree.map(lambda leaf: leaf[0], tree)

    def total(self, counts: Shaped[Array, "..."]) -> Int[Array, "*I"]:
        """The sums of counts of which each interval has as many, in order."""
        sums = jnp.sum(counts.reshape(self.num_intervals, -1), axis=1, dtype=jnp.int32)
        return self.result(sums)


def bridge_problem(
    model: Diffusion, start: Numbers, end: Numbers, duration: Numbers, num_steps: int
) -> BridgeProblem:
    """What every function that makes bridges is asked for, checked; whole paths are kept."""
    check_diffusion(model)
    intervals, batched, several_durations = as_intervals(start, end, duration)
    num_steps = check_num_steps(num_steps, len(intervals.duration))
    return BridgeProblem(intervals, None, num_steps, batched, several_durations)


def as_intervals(start: Numbers, end: Numbers, duration: Numbers) -> tuple[Intervals, bool, bool]:
    """The intervals, and whether the end points and the duration came with an axis I."""
    points = {"start": as_points("start", start), "end": as_points("end", end)}
    duration = as_real("duration", duration)
    if duration.ndim > 1:
        raise ValueError(f"`duration` must have shape () or (I,); got {duration.shape}.")
    if points["start"].shape[-1] != points["end"].shape[-1]:
        raise ValueError(
            "`start` and `end` must be points of one dimension; got shapes "
            f"{points['start'].shape} and {points['end'].shape}."
        )
    dtype = _working_dtype(*points.values(), duration)
    check_precision("`start`, `end` and `duration`", dtype)
    lengths = {point.shape[0] for point in points.values() if point.ndim == 2}
    lengths |= {duration.shape[0]} if duration.ndim == 1 else set()
    if len(lengths - {1}) > 1:
        raise ValueError(
            "`start`, `end` and `duration` must agree in the number of intervals; got shapes "
            f"{points['start'].shape}, {points['end'].shape} and {duration.shape}."
        )
    if 0 in lengths:
        raise ValueError(
            "there must be at least one interval; `start`, `end` and `duration` have shapes "
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


def as_points(name: str, value: Numbers) -> Array:
    """Return one point, shape (d,), or several, shape (I, d).

    **Raises:** `ValueError` for another shape.
    """
    points = as_real(name, value)
    if points.ndim not in (1, 2) or points.shape[-1] == 0:
        raise ValueError(
            f"`{name}` must be one point, shape (d,), or one for each interval, shape "
            f"(I, d); got {points.shape}."
        )
    return points


def uniform_fractions(num_steps: int) -> Float[np.ndarray, " points"]:
    """t_i / T on the grid of equal steps."""
    return np.arange(num_steps + 1) / num_steps


def _stored_steps(
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


def _working_dtype(*arrays: Array) -> jnp.dtype:
    """The widest floating point type that was given; JAX's default if none was."""
    floating = [
        a.dtype for a in arrays if jnp.issubdtype(a.dtype, jnp.floating) and not a.weak_type
    ]
    return max(floating, key=lambda dtype: dtype.itemsize, default=jnp.asarray(0.0).dtype)
