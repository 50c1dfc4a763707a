"""Decorators of public functions: they switch off the caller's guards and check shared arguments.

- Transfers are intended here: numbers and lists of the caller become arrays, and checks read
  values. `jax.transfer_guard` is therefore off inside.
- NaN marks missing values and -inf is the log of a zero weight, as each result documents.
  `jax.debug_nans` and `jax.debug_infs` are therefore off inside.
- Ctrl-C ends a call with a progress meter at a step of its loop, within about a second
  (`interrupt`).
- Under a transformation, traced values that user functions close over become arguments
  (`captured`).
"""

import contextlib
import functools
import inspect
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

from .arguments import SHARED
from .captured import call_with_captured
from .compiled import is_outermost
from .devices import on_whole_batches
from .interrupt import listening

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def public_entry(fn: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Decorate a public function: apply `disable_guards`, and pass captured values as arguments.

    Captured values are traced values that user functions close over (`captured`).
    """

    @disable_guards
    @functools.wraps(fn)
    def entered(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        return fn(*args, **kwargs) if is_outermost() else call_with_captured(fn, args, kwargs)

    return entered


def disable_guards(fn: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Decorate `fn`: switch the caller's guards off inside, and check the arguments in `SHARED`."""
    shared = [name for name in SHARED if name in inspect.signature(fn).parameters]

    @functools.wraps(fn)
    def entered(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        for name in shared:  # these arguments are keyword-only in all public functions
            if name in kwargs:
                SHARED[name](name, kwargs[name])
        is_metered = kwargs.get("progress_meter") is not None
        with (
            jax.transfer_guard("allow"),
            jax.debug_nans(False),
            jax.debug_infs(False),
            listening() if is_metered else contextlib.nullcontext(),
        ):
            return on_whole_batches(fn, *args, **kwargs)

    return entered
