"""How many paths are simulated side by side, on each device.

On a CPU as many as its caches hold: more would be slower. An accelerator takes about as long for
one path as for a hundred thousand, whose steps it does in the time in which it starts one, so there
only memory bounds them.
"""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float

from .devices import num_devices


class _Bounds(NamedTuple):
    """Of one batch: bytes of its whole paths, lanes, and numbers in one array of the loop."""

    num_bytes: int
    lanes: int
    numbers: int


# See `linalg`: beyond so many numbers per array, reductions that a user's model may contain are not
# safe in XLA's loops on CPU.
_CPU = _Bounds(2**24, 2**13, 2**15)
_ACCELERATOR = _Bounds(2**30, 2**19, 2**20)

# With fewer, much of the time of a step goes into what it costs however many lanes there are.
_ENOUGH_LANES = 256


def default_num_lanes(num_wanted: int, num_steps: int, points: Float[Array, "*axes d"]) -> int:
    """As many lanes as successes are wanted, within a bound on the memory of their paths on each
    device: 16 MiB, or what `_ENOUGH_LANES` need, up to 512 MiB; on an accelerator 1 GiB.

    A lane holds two paths and their noise.
    """
    d = points.shape[-1]
    bytes_per_lane = 3 * d * (num_steps + 1) * points.dtype.itemsize
    enough = min(_ENOUGH_LANES, 2**29 // bytes_per_lane)
    fitting = max(_bounds().num_bytes // bytes_per_lane, enough, 1)
    return min(num_devices() * min(fitting, most_lanes(d)), max(num_wanted, 64))


def most_lanes(d: int) -> int:
    """How many lanes may run side by side, for points in R^d."""
    bounds = _bounds()
    return max(1, min(bounds.lanes, bounds.numbers // d))


def _bounds() -> _Bounds:
    return _CPU if _platform() == "cpu" else _ACCELERATOR


def _platform() -> str:
    """Where programs run, as far as can be told while they are traced."""
    chosen = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    if chosen is None:
        return jax.default_backend()
    return chosen if isinstance(chosen, str) else chosen.platform
