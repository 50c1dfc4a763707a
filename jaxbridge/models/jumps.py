"""Jumps of the state at known times: doses, harvests, switches.

At the time τ of a jump the state X(τ-) becomes J(X(τ-), u), with a known input u. Between jumps the
process is the diffusion. An observation at τ is taken before the jump, and so is the state at τ of
a path.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from ..engine.arguments import as_returned, check_function, evaluated
from ..engine.captured import Captured
from ..engine.checks import Numbers, as_floating, is_traced
from ..engine.times import Times
from .tracing import is_affine

# Jumps within two rounding errors of a time are at this time, but at most this share of a gap away.
_MOST_MOVED = 1e-4


class Jump(NamedTuple):
    """Possible jump at the beginning of a step or interval, or of several of them.

    `inputs` is u, and `exists` states whether there is a jump. Without one u is arbitrary.
    """

    inputs: Float[Array, "*steps q"]
    exists: Bool[Array, "*steps"]


class JumpMap(eqx.Module):
    """Map J of a jump, from the state before it to the state after it."""

    function: Callable | None = eqx.field(static=True)
    _captured: Captured

    def __init__(self, function: Callable | None):
        check_function("apply", function, "(x, u, params)", optional=True)
        self.function = function
        self._captured = Captured(function)

    def __call__(self, x: Float[Array, " d"], jump: Jump, params: PyTree) -> Float[Array, " d"]:
        """Return the state after the jump; x itself if there is none."""
        u = jump.inputs.astype(x.dtype)
        if self.adds:
            return jnp.where(jump.exists, x + u, x)
        # Elsewhere the function may have no derivative.
        return lax.cond(jump.exists, lambda x: self._after(x, u, params), lambda x: x, x)

    @property
    def adds(self) -> bool:
        """Return whether J(x, u) = x + u, with derivative I."""
        return self.function is None

    def is_affine(self, like: Float[Array, " d"], jump: Jump, params: PyTree) -> bool:
        """Return whether J(x, u) is affine in x."""
        u = jump.inputs.reshape(-1, jump.inputs.shape[-1])[0].astype(like.dtype)
        return self.adds or is_affine(lambda x: self._after(x, u, params), like)

    def _after(self, x: Float[Array, " d"], u: Float[Array, " q"], params: PyTree):
        if self.function is None:
            return x + u
        value = evaluated("apply", self._captured.call, self.function, x, u, params)
        return as_returned("apply", value).astype(x.dtype)

    def check(self, like: Float[Array, " d"], u: Float[Array, " q"], params: PyTree) -> None:
        """Raise `ValueError` unless J returns a state."""
        if self.adds:
            if u.shape != like.shape:
                raise ValueError(
                    f"`inputs` of `Jumps` must have shape (J, {len(like)}), as they are added to a "
                    f"state of {len(like)} dimensions; got {len(u)} columns. Pass a function "
                    "`apply(x, u, params)` for other jumps."
                )
            return
        shape = jax.eval_shape(self._after, like, u.astype(like.dtype), params).shape
        if shape != like.shape:
            raise ValueError(
                f"`apply` of `Jumps` must return the state after a jump, shape {like.shape}; it "
                f"returned shape {shape}."
            )


class Jumps(eqx.Module):
    """Jumps of the state at known times, such as doses.

    **Arguments:**

    - `times`: increasing times of the jumps, shape (J,), in the unit and with the origin of the
        times of the observations. A jump that differs from one of these by rounding errors only is
        at this time.
    - `inputs`: u of each jump, shape (J, q), or (J,) for q = 1.
    - `apply`: the state after a jump, `(x, u, params) -> (d,)`. `x` is the state before it, and
        `params` are the parameters of the model. By default `x + u`, with q = d. For several
        records it is evaluated at other states, too: there it needs finite derivatives.

    **Raises:** `ValueError` and `TypeError` for times that do not increase or are traced, and for
    inputs of another shape or that are not finite.

    **Example:**

    ```python
    doses = jb.Jumps([0.0, 12.0], [100.0, 50.0])  # of a state of one dimension
    absorbed = jb.Jumps([0.0], [100.0], apply=lambda x, u, params: x + params.absorbed * u)
    ```
    """

    times: tuple[float, ...] = eqx.field(static=True)
    inputs: Float[Array, "J q"]
    map: JumpMap

    def __init__(self, times: Numbers, inputs: Numbers, apply: Callable | None = None):
        if is_traced(times):
            raise ValueError("`times` of `Jumps` must be concrete; got traced values.")
        shape, at = as_floating("times", times).shape, np.asarray(times)
        if len(shape) != 1 or not shape[0]:
            raise ValueError(f"`times` of `Jumps` must have shape (J,), J ≥ 1; got {shape}.")
        at = at.astype(float)
        if not (np.all(np.isfinite(at)) and np.all(np.diff(at) > 0)):
            raise ValueError(
                f"`times` of `Jumps` must be finite and increase; got {at}. Sort them with their "
                "`inputs`, and combine jumps at equal times into one."
            )
        self.times = tuple(at.tolist())
        numbers = as_floating("inputs", inputs)
        columns = numbers[:, None] if numbers.ndim == 1 else numbers
        if columns.ndim != 2 or len(columns) != len(self.times):
            raise ValueError(
                f"`inputs` must have shape ({len(self.times)}, q), one row per time; got "
                f"{numbers.shape}."
            )
        if not is_traced(columns) and not np.all(np.isfinite(columns)):
            raise ValueError(f"`inputs` must be finite; got {np.asarray(columns)}.")
        self.inputs = columns
        self.map = JumpMap(apply)

    def split(self, times: Times) -> tuple[Times, Bool[np.ndarray, " n"], Jump]:
        """Add the times of the jumps to others.

        **Returns:** all times, which of them are those of `times`, and the possible jump at the
        beginning of each interval between them.

        **Raises:** `ValueError` for a jump before the first of `times`, for two jumps at the same
        time, and if `times` are traced.
        """
        if is_traced(times.values):
            raise ValueError("`times` must be concrete where there are `jumps`; got traced values.")
        old, at = np.asarray(times.values), np.asarray(self.times)
        tolerance = _rounding(old)
        if at[0] < old[0] - tolerance:
            raise ValueError(
                f"`jumps` must not begin before the first time, {old[0]:g}; got a jump at "
                f"{at[0]:g}. Leave it out, or pass `initial_time`."
            )
        # Jumps at or after the last time have no effect.
        before_end = at < old[-1] - tolerance
        at = at[before_end]
        at = _moved(at, old, tolerance)
        if np.any(np.diff(at) <= 0):
            i = int(np.argmin(np.diff(at)))
            raise ValueError(
                f"`jumps` at {self.times[i]} and {self.times[i + 1]} are both at the time {at[i]}, "
                "up to rounding: pass one jump there, with the sum of the inputs."
            )
        values = np.union1d(old, at)
        begins = np.searchsorted(values, at)
        which = np.zeros(len(values) - 1, int)
        which[begins] = np.arange(len(at))
        exists = np.zeros(len(values) - 1, bool)
        exists[begins] = True
        with jax.ensure_compile_time_eval():
            gaps = times.gaps
            if len(values) > len(old):
                gaps = jnp.asarray(np.diff(values), times.dtype)
            jump = Jump(self.inputs[which], jnp.asarray(exists))
        return Times(values, gaps), np.isin(values, old), jump

    def since(self, time: float) -> "Jumps | None":
        """Return the jumps at this time and later; `None` if there are none."""
        later = np.asarray(self.times) >= time - _rounding(np.asarray([time, self.times[-1]]))
        if not np.any(later):
            return None
        first = int(np.argmax(later))
        return Jumps(self.times[first:], self.inputs[first:], self.map.function)


def _moved(at: np.ndarray, times: np.ndarray, tolerance: float) -> np.ndarray:
    """Return times of jumps, moved to the nearest of `times` if it is within the tolerance."""
    next_one = np.searchsorted(times, at).clip(1, len(times) - 1)
    before, after = times[next_one - 1], times[next_one]
    nearest = np.where(at - before < after - at, before, after)
    return np.where(np.abs(nearest - at) <= tolerance, nearest, at)


def _rounding(times: np.ndarray) -> float:
    """Return two rounding errors of the largest time, in the precision that the times have."""
    largest = np.max(np.abs(times))
    if np.all(times == np.round(times)):  # whole numbers are exact
        return 0.0
    if np.all(times == times.astype(np.float32)):
        gaps = np.diff(np.unique(times))
        return min(
            2 * float(np.spacing(np.float32(largest))), _MOST_MOVED * np.min(gaps, initial=np.inf)
        )
    return 2 * float(np.spacing(largest))


# Jumps of all records, or those of each of several records.
JumpsLike = Jumps | Sequence[Jumps | None] | None
