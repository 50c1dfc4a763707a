"""How our programs are compiled: `equinox.filter_jit`, with keys that take less of the compiler's
time (`generator`)."""

import functools
from collections.abc import Callable

import equinox as eqx

from .generator import with_keys_written_out


def compiled(fn: Callable) -> Callable:
    """`fn`, compiled for each structure of its arguments; arrays in them are traced."""

    @eqx.filter_jit
    @functools.wraps(fn)
    def program(*args, **kwargs):
        return fn(*with_keys_written_out(args), **with_keys_written_out(kwargs))

    return program
