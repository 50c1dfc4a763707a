"""Timing of functions."""

import functools
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import numpy as np

T = TypeVar("T")


def timed(function: Callable[[], T]) -> tuple[T, float]:
    """Call the function; return its result and the seconds until the result is complete."""
    begin = time.perf_counter()
    result = jax.block_until_ready(function())
    return result, time.perf_counter() - begin


def compile_side_by_side(functions: Sequence[Callable[[], Any]]) -> list[Any]:
    """Call all functions, as many at a time as there are processors; return their results.

    Their programs are then compiled side by side. Time the functions afterwards.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return jax.block_until_ready(list(pool.map(lambda function: function(), functions)))


@functools.cache
def _seconds_compiled() -> list[float]:
    """Return a list of one number: the seconds that XLA has compiled since the first call."""
    total = [0.0]

    def listen(event: str, duration_secs: float, **_: Any) -> None:
        if event.endswith("backend_compile_duration"):
            total[0] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(listen)
    return total


def timed_once_compiled(function: Callable[[], T]) -> tuple[T, float]:
    """Time a call that always compiles, like `timed`, without the seconds of compilation."""
    # The listener adds to this list while the function runs.
    total = _seconds_compiled()
    before = total[0]
    result, seconds = timed(function)
    return result, max(seconds - (total[0] - before), 0.0)


def fastest(function: Callable[[], T], repeats: int = 3) -> tuple[T, float]:
    """Return the result and the seconds of the fastest of `repeats` runs."""
    # Other work on the machine only makes runs longer.
    return min((timed(function) for _ in range(repeats)), key=lambda run: run[1])


def in_turns(
    first: Callable[[], Any], second: Callable[[], Any], repeats: int = 9
) -> tuple[float, float]:
    """Return the median seconds of two functions, run in turns, without a first run of each."""
    seconds = [[timed(function)[1] for function in (first, second)] for _ in range(repeats + 1)]
    medians = np.median(seconds[1:], axis=0)
    return float(medians[0]), float(medians[1])
