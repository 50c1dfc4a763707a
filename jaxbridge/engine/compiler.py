"""CPU compiler of the installed JAX: its accepted options, and a possible fault of its loops.

Options differ between releases, and unknown ones raise errors. Each option is therefore tried once,
on an empty program, when the first program is compiled.

From 0.11.1 to 0.12.0.1 at least, jaxlib's pass `small-while-loop-hoisting` compiles some small
loops wrongly: it overwrites a loop variable before its last use. Programs of this package run
without the pass in all these releases, but programs of the caller run with it. `has_loop_fault`
therefore computes one such loop, and a wrong result causes one warning. Few loops show the fault,
so a release that passes this test may still have it.
"""

import functools
import operator
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import eval_context
from jaxtyping import Array, Float32

_FIRST_FAULTY = (0, 11, 1)  # later releases count as faulty, too
_FAULTY_PASS = {"xla_disable_hlo_passes": "small-while-loop-hoisting"}
# These options compile faster, and long runs become slower (see `compiled`).
_SOONER = {
    "xla_cpu_use_fusion_emitters": False,  # up to JAX 0.11.0
    "xla_cpu_parallel_codegen_split_count": 2,  # files of kernels; each file uses memory maps
}

# Input and exact result of the loop in `slope_of_normalised_twice`: with n = |x|, the derivative of
# x / n in the direction v is (v - x (x·v) / n²) / n, and a second normalisation does not change it.
POINT = np.arange(1, 10, dtype=np.float32).reshape(3, 3)
_NORM = np.linalg.norm(POINT)
EXACT_SLOPE = (np.sin(POINT) - POINT * np.sum(POINT * np.sin(POINT)) / _NORM**2) / _NORM


@functools.cache
def cpu_options(sooner: bool) -> dict[str, bool | int | str]:
    """Return the compiler options for programs of this package on a CPU.

    `sooner` requests faster compilation.
    """
    is_faulty = jax.__version_info__ >= _FIRST_FAULTY
    options = {**(_FAULTY_PASS if is_faulty else {}), **(_SOONER if sooner else {})}
    return {name: value for name, value in options.items() if _is_accepted(name, value)}


def warn_of_loop_fault() -> None:
    """Warn, once, if programs that the caller compiles may return wrong results."""
    if not has_loop_fault():
        return
    # Python's default filter shows this warning once for each calling line.
    warnings.warn(
        f"JAX {jax.__version__} compiles some small loops (`lax.fori_loop`, `lax.scan`) wrongly on "
        "this CPU. The functions of jaxbridge are not affected if you call them outside of these. "
        "Other programs may return wrong numbers, whether they use jaxbridge or not: functions "
        "that you compile (`jax.jit`), and loops of JAX that you or another package run "
        "(`lax.scan`, `lax.map`, the samplers of NumPyro and BlackJAX). `jax.vmap` and `jax.grad` "
        "without these are not affected. To switch the faulty optimisation off, set the "
        "environment variable XLA_FLAGS=--xla_disable_hlo_passes=small-while-loop-hoisting before "
        "Python starts. See `howto/debugging.md` in the documentation.",
        RuntimeWarning,
        stacklevel=2,
    )


@functools.cache
def has_loop_fault() -> bool:
    """Return whether the CPU compiler, with its current settings, computes a test loop wrongly."""
    with eval_context(), jax.disable_jit(False):
        slope = jax.jit(slope_of_normalised_twice)(POINT)
        return not np.allclose(jax.device_get(slope), EXACT_SLOPE, atol=1e-3)


def slope_of_normalised_twice(
    point: Float32[Array | np.ndarray, "3 3"],
) -> Float32[Array, "3 3"]:
    """Compute the derivative of x / |x|, normalised twice, in the direction sin x.

    This exact loop shows the compiler's fault; an equivalent loop may not.
    """

    def normalised(point):
        numbers = [point.ravel()[i] for i in range(9)]
        square = functools.reduce(operator.add, [number * number for number in numbers])
        positive = square > 0
        return point / jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)

    twice = lambda point: lax.fori_loop(0, 2, lambda _, point: normalised(point), point)
    return jax.jvp(twice, (point,), (jnp.sin(point),))[1]


def _is_accepted(name: str, value: bool | int | str) -> bool:
    """Return whether the compiler accepts this option."""
    with eval_context():
        empty_program = jax.jit(lambda: np.float32(0), compiler_options={name: value})
        try:
            empty_program.lower().compile()
        except jax.errors.JaxRuntimeError:
            return False
    return True
