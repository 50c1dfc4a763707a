"""Room that compiled programs take: memory maps, and memory.

A compiled program keeps some hundreds of maps, about as many as it has kernels, and some megabytes,
for as long as it is kept. Linux gives a process 65,530 maps (`vm.max_map_count`), and beyond that
LLVM ends it. A new function (each evaluation of a `lambda`) is a new program: a hundred of them
keep about .9 GB.
"""

import functools
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import jax

# Share of the machine's memory beyond which there is a warning, once.
_MUCH_MEMORY = 0.75
# Shares of the limit beyond which there is a warning, and beyond which room is made.
_NEAR, _TOO_NEAR = 0.75, 0.9
_SECONDS = 1.0


def mind_memory_maps(is_outermost: Callable[[], bool]) -> None:
    """Warn where compiled programs have taken three quarters of the memory maps that there are, and
    drop them all where it is nine tenths: to compile again is better than to end. Not in the midst
    of tracing. Warn, once, where the process has three quarters of the memory of the machine."""
    _warn_of_memory(*_memory(int(time.monotonic() / _SECONDS)))
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
        "have tried many models, or raise the limit, `vm.max_map_count`. Each new function (each "
        "evaluation of a `lambda`) is compiled anew and kept, a hundred of them in about 0.9 GB: "
        "define functions once, and pass numbers through `params`.",
        RuntimeWarning,
        stacklevel=3,
    )


def _warn_of_memory(resident: int, total: int) -> None:
    if not total or resident <= _MUCH_MEMORY * total or _warned:
        return
    _warned.append(True)
    warnings.warn(
        f"this process holds {resident / 2**30:.1f} of the {total / 2**30:.1f} GiB of memory that "
        "the machine has. Compiled programs may be part of it: each new function (each evaluation "
        "of a `lambda`) is compiled anew and kept, a hundred of them in about 0.9 GB. Define "
        "functions once and pass numbers through `params`, or call `jax.clear_caches()`.",
        RuntimeWarning,
        stacklevel=4,
    )


_warned: list[bool] = []


@functools.lru_cache(maxsize=1)
def _memory(moment: int) -> tuple[int, int]:
    """Bytes of this process in memory, and of the machine; zeros where the system does not say."""
    try:
        page = os.sysconf("SC_PAGE_SIZE")
        resident = int(Path("/proc/self/statm").read_text().split()[1])
        return resident * page, os.sysconf("SC_PHYS_PAGES") * page
    except (OSError, ValueError, AttributeError):
        return 0, 0


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
