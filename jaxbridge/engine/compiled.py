"""How our programs are compiled: `equinox.filter_jit`, with keys that take less of the compiler's
time (`generator`), options that the installed compiler accepts (`compiler`), and an eye on the room
that is left for programs (`memory_maps`).

On CPUs XLA up to JAX 0.11.0 can make its kernels in two ways. Those of its fusion emitters, the
default, are up to twice as fast in a loop that works on many lanes, for they are vectorised where a
number is overwritten by a function of itself; its former emitters take a third less time, and their
programs a third of the memory maps. So what takes longer to compile than to run, as chains of
parameters and all that is done once for each model, is `compiled_sooner`, and proposals are
`compiled_for` their number.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax.core import eval_context
from jax.extend.core import get_opaque_trace_state

from .captured import call_with_captured
from .compiler import cpu_options, warn_of_loop_fault
from .generator import with_keys_written_out
from .memory_maps import mind_memory_maps

# Steps of paths, at some 10 ns more for each: 20 ms a call for .5 s to the first.
_MANY = 2_000_000

_LESS_MEMORY = (
    "Memory does not suffice for these paths. Keep only some times of each path (`save_at=[...]`), "
    "or ask for fewer paths, particles or steps in one call."
)


def compiled(fn: Callable) -> Callable:
    """`fn`, compiled for each structure of its arguments; arrays in them are traced."""
    return _compiled(fn, lambda *_, **__: False)


def compiled_sooner(fn: Callable) -> Callable:
    """As `compiled`, for what takes longer to compile than to run."""
    return _compiled(fn, lambda *_, **__: True)


def compiled_for(num_path_steps: Callable[..., int]) -> Callable[[Callable], Callable]:
    """As `compiled` where that many steps of paths, a function of `fn`'s arguments, are no fewer
    than some millions, and else as `compiled_sooner`."""
    return lambda fn: _compiled(fn, lambda *args, **kwargs: num_path_steps(*args, **kwargs) < _MANY)


def _compiled(fn: Callable, is_wanted_sooner: Callable[..., bool]) -> Callable:
    within = _program(fn)  # JAX takes options for none but outermost programs
    on_cpu = functools.cache(lambda sooner: _program(fn, compiler_options=cpu_options(sooner)))

    @functools.wraps(fn)
    def call(*args, **kwargs):
        mind_memory_maps(is_outermost)
        try:
            return run(*args, **kwargs)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" in str(error):
                error.add_note(_LESS_MEMORY)
            raise

    def run(*args, **kwargs):
        on_other = jax.default_backend() != "cpu"
        if not on_other:
            warn_of_loop_fault()
        if not is_outermost():
            return call_with_captured(within, args, kwargs)
        if on_other:
            return within(*args, **kwargs)
        return on_cpu(is_wanted_sooner(*args, **kwargs))(*args, **kwargs)

    return call


def is_outermost() -> bool:
    """Whether what is called now is run, and not traced or transformed."""
    now = get_opaque_trace_state(convention="jaxbridge")
    with eval_context():
        return now == get_opaque_trace_state(convention="jaxbridge")


def _program(fn: Callable, **options: Any) -> Callable:
    @eqx.filter_jit(**options)
    @functools.wraps(fn)
    def program(*args, **kwargs):
        return fn(*with_keys_written_out(args), **with_keys_written_out(kwargs))

    return program
