"""Number of paths (lanes) that each device simulates side by side.

On a CPU the caches bound it: larger batches are slower. An accelerator takes about as long for one
path as for a hundred thousand, so only its memory bounds the number.
"""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float

from .devices import num_devices


class _Bounds(NamedTuple):
    """Upper bounds of one batch.

    - `num_bytes`: bytes of its stored paths.
    - `lanes`: number of lanes.
    - `numbers`: numbers in one array of the loop over time.
    """

    num_bytes: int
    lanes: int
    numbers: int


# XLA's CPU compiler miscomputes some reductions over more than 32,768 numbers inside loops (see
# `linalg._sum`); a user's model may contain such reductions.
_CPU = _Bounds(2**24, 2**13, 2**15)
_ACCELERATOR = _Bounds(2**30, 2**19, 2**20)

# With fewer lanes the fixed cost of a step dominates its time.
_ENOUGH_LANES = 256


def default_num_lanes(num_wanted: int, num_steps: int, points: Float[Array, "*axes d"]) -> int:
    """Return the default number of lanes: one for each wanted success, at least 64, within bounds.

    The paths on each device may take 16 MiB on a CPU and 1 GiB on an accelerator. Up to 256 lanes
    may take more, at most 512 MiB. `most_lanes` bounds the number, too.
    """
    d = points.shape[-1]
    # A lane holds two paths and their noise, hence the factor 3.
    bytes_per_lane = 3 * d * (num_steps + 1) * points.dtype.itemsize
    enough = min(_ENOUGH_LANES, 2**29 // bytes_per_lane)
    fitting = max(_bounds().num_bytes // bytes_per_lane, enough, 1)
    return min(num_devices() * min(fitting, most_lanes(d)), max(num_wanted, 64))


def most_lanes(d: int) -> int:
    """Return the largest number of lanes that one device runs side by side, for points in R^d."""
    bounds = _bounds()
    return max(1, min(bounds.lanes, bounds.numbers // d))


def _bounds() -> _Bounds:
    """Return the bounds for the current platform."""
    return _CPU if _platform() == "cpu" else _ACCELERATOR


def _platform() -> str:
    """Return the platform that runs the programs, as far as it is known while tracing."""
    chosen = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    if chosen is None:
        return jax.default_backend()
    return chosen if isinstance(chosen, str) else chosen.platform
