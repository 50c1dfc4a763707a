"""Warnings before compiled programs exhaust the memory maps or the memory of the process.

A compiled program uses some hundreds of memory maps, about one for each kernel, and some megabytes,
as long as it is cached. Linux gives a process 65,530 maps (`vm.max_map_count`); beyond them, LLVM
aborts the process. Each new function, such as each evaluation of a `lambda`, is a new program. A
hundred of them use about 0.9 GB.
"""

import functools
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import jax

# Share of the machine's memory above which one warning is issued.
_WARN_MEMORY_SHARE = 0.75
# Shares of the maps above which a warning is issued, and above which programs are dropped.
_WARN_SHARE, _DROP_SHARE = 0.75, 0.9
_SECONDS = 1.0  # a count of the maps is cached for this time


def mind_memory_maps(is_outermost: Callable[[], bool]) -> None:
    """Warn if compiled programs use three quarters of the memory maps; drop all at nine tenths.

    Compiling again is better than an aborted process. Programs are not dropped while tracing. Also
    warn, once, if the process uses three quarters of the machine's memory.
    """
    _warn_of_memory(*_memory(int(time.monotonic() / _SECONDS)))
    num, limit = _num_maps(int(time.monotonic() / _SECONDS)), _most_maps()
    if not limit or num <= _WARN_SHARE * limit:
        return
    action = "beyond nine tenths of them, all programs will be dropped"
    if num > _DROP_SHARE * limit and is_outermost():
        jax.clear_caches()
        _num_maps.cache_clear()
        action = "all programs were dropped, and will be compiled again when called"
    warnings.warn(
        f"Compiled programs use {num:,} of the {limit:,} memory maps of this process, which aborts "
        f"when all are in use; {action}. Call `jax.clear_caches()` after trying many models, or "
        "raise the limit, `vm.max_map_count`. Each new function (each evaluation of a `lambda`) "
        "is compiled again, and a hundred of them use about 0.9 GB: define functions once, and "
        "pass numbers through `params`.",
        RuntimeWarning,
        stacklevel=3,
    )


def _warn_of_memory(resident: int, total: int) -> None:
    """Warn, once, if the process uses more than three quarters of the machine's memory."""
    if not total or resident <= _WARN_MEMORY_SHARE * total or _warned:
        return
    _warned.append(True)
    warnings.warn(
        f"This process uses {resident / 2**30:.1f} of the {total / 2**30:.1f} GiB of memory of the "
        "machine. Compiled programs may be a part of it: each new function (each evaluation of a "
        "`lambda`) is compiled again, and a hundred of them use about 0.9 GB. Define functions "
        "once and pass numbers through `params`, or call `jax.clear_caches()`.",
        RuntimeWarning,
        stacklevel=4,
    )


_warned: list[bool] = []


@functools.lru_cache(maxsize=1)
def _memory(moment: int) -> tuple[int, int]:
    """Return the resident bytes of this process and the bytes of the machine; zeros if unknown.

    `moment` is the key of the cache.
    """
    try:
        page = os.sysconf("SC_PAGE_SIZE")
        resident = int(Path("/proc/self/statm").read_text().split()[1])
        return resident * page, os.sysconf("SC_PHYS_PAGES") * page
    except (OSError, ValueError, AttributeError):
        return 0, 0


@functools.lru_cache(maxsize=1)
def _num_maps(moment: int) -> int:
    """Return the number of memory maps, cached for one `moment`: counting takes milliseconds."""
    return count_maps()


def count_maps() -> int:
    """Return the number of memory maps of this process, zero if the system does not report it."""
    maps = Path("/proc/self/maps")  # Linux only
    try:
        return maps.read_bytes().count(b"\n")
    except OSError:
        return 0


@functools.lru_cache(maxsize=1)
def _most_maps() -> int:
    """Return the largest number of memory maps that the system allows, zero if unknown."""
    try:
        return int(Path("/proc/sys/vm/max_map_count").read_text())
    except (OSError, ValueError):
        return 0
