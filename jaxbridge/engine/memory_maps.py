"""How near is the process to its limit of memory maps?

A compiled program keeps some hundreds of them, about as many as it has kernels, for as long as it
is kept. Linux gives a process 65,530 (`vm.max_map_count`), and beyond that LLVM ends it.
"""

import functools
import time
import warnings
from pathlib import Path

_SHARE = 0.75
_SECONDS = 5.0


def warn_near_limit_of_maps() -> None:
    """Warn where compiled programs have taken three quarters of the memory maps that there are."""
    num, most = _num_maps(int(time.monotonic() / _SECONDS)), _most_maps()
    if most and num > _SHARE * most:
        warnings.warn(
            f"compiled programs have taken {num:,} of the {most:,} memory maps that this process "
            "may have, and beyond them it would end: call `jax.clear_caches()` when you have tried "
            "many models, or raise the limit, `vm.max_map_count`.",
            RuntimeWarning,
            stacklevel=4,
        )


@functools.lru_cache(maxsize=1)
def _num_maps(moment: int) -> int:
    """As of a moment, for to count them takes milliseconds."""
    return count_maps()


def count_maps() -> int:
    """Those that this process has, zero where the system does not tell."""
    maps = Path("/proc/self/maps")  # not on every system
    try:
        return maps.read_bytes().count(b"\n")
    except OSError:
        return 0


@functools.lru_cache(maxsize=1)
def _most_maps() -> int:
    try:
        return int(Path("/proc/sys/vm/max_map_count").read_text())
    except (OSError, ValueError):
        return 0
