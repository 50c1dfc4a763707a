"""How public functions are entered: with what the caller's guards would take for mistakes.

What is given, numbers and lists among it, is put on the device here, and what is refused is looked
at: transfers, and meant. A NaN stands here for what is missing and -inf for the log of no weight,
and each result says which. So `jax.transfer_guard`, `jax.debug_nans` and `jax.debug_infs`, by which
a program looks for the mistakes of its own, are off inside, and as they were outside.

Under a transformation of the caller's, traced values that user functions close over are passed
along as arguments (`captured`).
"""

import functools
import inspect
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

from .arguments import SHARED
from .captured import call_with_captured
from .compiled import is_outermost
from .devices import on_whole_batches

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def door(fn: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """`fn`, a public function, inside which the caller's guards are off, whose arguments that all
    functions share are checked, and which passes along what functions close over."""

    @guards_off
    @functools.wraps(fn)
    def entered(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        return fn(*args, **kwargs) if is_outermost() else call_with_captured(fn, args, kwargs)

    return entered


def guards_off(fn: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """`fn`, inside which the caller's guards are off, and whose arguments that all functions share
    are checked."""
    shared = [name for name in SHARED if name in inspect.signature(fn).parameters]

    @functools.wraps(fn)
    def entered(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        for name in shared:  # given by name only, in all of them
            if name in kwargs:
                SHARED[name](name, kwargs[name])
        with jax.transfer_guard("allow"), jax.debug_nans(False), jax.debug_infs(False):
            return on_whole_batches(fn, *args, **kwargs)

    return entered
