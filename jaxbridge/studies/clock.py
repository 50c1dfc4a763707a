"""How long functions take."""

import functools
import time
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

T = TypeVar("T")


def timed(function: Callable[[], T]) -> tuple[T, float]:
    """The result, and the seconds until it is there."""
    begin = time.perf_counter()
    result = jax.block_until_ready(function())
    return result, time.perf_counter() - begin


@functools.cache
def _seconds_compiled() -> list[float]:
    """Its one number grows by what XLA compiles from the first call of this on."""
    total = [0.0]

    def listen(event: str, duration_secs: float, **_: Any) -> None:
        if event.endswith("backend_compile_duration"):
            total[0] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(listen)
    return total


def timed_once_compiled(function: Callable[[], T]) -> tuple[T, float]:
    """As `timed`, less the seconds in which XLA compiled: for what compiles in every call."""
    total = _seconds_compiled()
    before = total[0]
    result, seconds = timed(function)
    return result, max(seconds - (total[0] - before), 0.0)


def fastest(function: Callable[[], T], repeats: int = 3) -> tuple[T, float]:
    """The shortest of some runs."""
    return min((timed(function) for _ in range(repeats)), key=lambda run: run[1])


def in_turns(
    first: Callable[[], Any], second: Callable[[], Any], repeats: int = 9
) -> tuple[float, float]:
    """The median times of two functions, run in turns, once compiled."""
    seconds = [[timed(function)[1] for function in (first, second)] for _ in range(repeats + 1)]
    medians = np.median(seconds[1:], axis=0)
    return float(medians[0]), float(medians[1])
