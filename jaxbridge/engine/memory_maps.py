"""How near is the process to its limit of memory maps?

A compiled program keeps some hundreds of them, about as many as it has kernels, for as long as it
is kept. Linux gives a process 65,530 (`vm.max_map_count`), and beyond that LLVM ends it.
"""

import functools
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import jax

# Shares of the limit beyond which there is a warning, and beyond which room is made.
_NEAR, _TOO_NEAR = 0.75, 0.9
_SECONDS = 1.0


def mind_memory_maps(is_outermost: Callable[[], bool]) -> None:
    """Warn where compiled programs have taken three quarters of the memory maps that there are, and
    drop them all where it is nine tenths: to compile again is better than to end. Not in the midst
    of tracing."""
    num, most = _num_maps(int(time.monotonic() / _SECONDS)), _most_maps()
    if not most or num <= _NEAR * most:
        return
    what_is_done = "beyond nine tenths they will be dropped"
    if num > _TOO_NEAR * most and is_outermost():
        jax.clear_caches()
        _num_maps.cache_clear()
        what_is_done = "they were dropped, and what is called again will be compiled again"
    warnings.warn(
        f"compiled programs have taken {num:,} of the {most:,} memory maps that this process may "
        f"have, and beyond them it would end; {what_is_done}. Call `jax.clear_caches()` when you "
        "have tried many models, or raise the limit, `vm.max_map_count`.",
        RuntimeWarning,
        stacklevel=3,
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
