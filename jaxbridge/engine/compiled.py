"""Compilation of the package's functions: `equinox.filter_jit` with four additions.

- Random keys use a generator that compiles faster (`generator`).
- The compiler gets the options that its release accepts (`compiler`).
- Compiled programs are dropped before they exhaust the memory maps (`memory_maps`).
- Traced values in closures become arguments (`captured`).

On CPUs, XLA up to JAX 0.11.0 generates kernels in two ways. The default fusion emitters vectorise
loops that overwrite numbers in place, which makes loops over many lanes up to twice as fast. The
former emitters need a third less time to compile and a third of the memory maps. Functions that
take longer to compile than to run are therefore `compiled_sooner`, and proposals are `compiled_for`
their number of steps.
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
from .generator import with_unrolled_keys
from .memory_maps import mind_memory_maps

# Path steps in one call. The faster-compiled program needs about 10 ns more for each step, here
# 20 ms, and saves about 0.5 s of compilation once.
_MANY_STEPS = 2_000_000

_LESS_MEMORY = (
    "These paths do not fit into memory. Store only some times of each path (`save_at=[...]`), "
    "or request fewer paths, particles or steps in one call."
)


def compiled(fn: Callable) -> Callable:
    """Compile `fn`; arrays in the arguments are traced, all other values are static.

    It is compiled again for arguments of new structure, shapes, dtypes or static values.
    """
    return _compiled(fn, lambda *_, **__: False)


def compiled_sooner(fn: Callable) -> Callable:
    """Compile `fn` as `compiled` does, with less compilation time and slower loops.

    It suits functions that take longer to compile than to run.
    """
    return _compiled(fn, lambda *_, **__: True)


def compiled_for(num_path_steps: Callable[..., int]) -> Callable[[Callable], Callable]:
    """Compile `fn` as `compiled` for two million path steps or more, else as `compiled_sooner`.

    `num_path_steps` computes the number of path steps from the arguments of `fn`.
    """
    return lambda fn: _compiled(
        fn, lambda *args, **kwargs: num_path_steps(*args, **kwargs) < _MANY_STEPS
    )


def _compiled(fn: Callable, is_wanted_sooner: Callable[..., bool]) -> Callable:
    """Compile `fn` in the way that `is_wanted_sooner` selects from its arguments."""
    inner_program = _program(fn)  # nested programs cannot have compiler options
    cpu_program = functools.cache(lambda sooner: _program(fn, compiler_options=cpu_options(sooner)))

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
        is_accelerator = jax.default_backend() != "cpu"
        if not is_accelerator:
            warn_of_loop_fault()
        if not is_outermost():
            return call_with_captured(inner_program, args, kwargs)
        if is_accelerator:
            return inner_program(*args, **kwargs)
        return cpu_program(is_wanted_sooner(*args, **kwargs))(*args, **kwargs)

    return call


def is_outermost() -> bool:
    """Return whether the current call runs at once, outside of tracing and transformations."""
    # The trace state inside of any transformation differs from that of eager evaluation.
    now = get_opaque_trace_state(convention="jaxbridge")
    with eval_context():
        return now == get_opaque_trace_state(convention="jaxbridge")


def _program(fn: Callable, **options: Any) -> Callable:
    """Compile `fn` by `equinox.filter_jit`, with its keys read by the faster-compiled generator."""

    @eqx.filter_jit(**options)
    @functools.wraps(fn)
    def program(*args, **kwargs):
        return fn(*with_unrolled_keys(args), **with_unrolled_keys(kwargs))

    return program
