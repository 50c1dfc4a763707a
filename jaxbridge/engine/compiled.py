"""How our programs are compiled: `equinox.filter_jit`, with keys that take less of the compiler's
time (`generator`), and an eye on the room that is left for programs (`memory_maps`)."""

import functools
from collections.abc import Callable

import equinox as eqx

from .checks import is_traced
from .generator import with_keys_written_out
from .memory_maps import mind_memory_maps


def compiled(fn: Callable) -> Callable:
    """`fn`, compiled for each structure of its arguments; arrays in them are traced."""

    @eqx.filter_jit
    @functools.wraps(fn)
    def program(*args, **kwargs):
        return fn(*with_keys_written_out(args), **with_keys_written_out(kwargs))

    @functools.wraps(fn)
    def call(*args, **kwargs):
        mind_memory_maps(lambda: is_traced(args, kwargs))
        return program(*args, **kwargs)

    return call
