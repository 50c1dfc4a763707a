"""CPU compiler of the installed JAX: the options that it accepts, and a fault that it may have.

Options differ between releases, and unknown ones raise errors. Each option is therefore tried once,
on a program without operations, when the first program is compiled.

From 0.11.1 to 0.12.0.1 at least, jaxlib's pass `small-while-loop-hoisting` compiles some small
loops wrongly: a loop variable is overwritten before its last use. Programs of this package run
without the pass in all those releases. Programs of the caller run with it: `has_loop_fault`
computes one such loop, and where it is wrong there is a warning, once. Few loops show the fault, so
that a release in which this one is right need not be free of it.
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

_FIRST_FAULTY = (0, 11, 1)
_FAULTY_PASS = {"xla_disable_hlo_passes": "small-while-loop-hoisting"}
# Each saves time of compilation, and costs time of long runs (`compiled`).
_SOONER = {
    "xla_cpu_use_fusion_emitters": False,  # up to JAX 0.11.0
    "xla_cpu_parallel_codegen_split_count": 2,  # files of kernels, of which each takes memory maps
}

POINT = np.arange(1, 10, dtype=np.float32).reshape(3, 3)
_NORM = np.linalg.norm(POINT)
EXACT_SLOPE = (np.sin(POINT) - POINT * np.sum(POINT * np.sin(POINT)) / _NORM**2) / _NORM


@functools.cache
def cpu_options(sooner: bool) -> dict[str, bool | int | str]:
    """Return the options for programs of this package on a CPU; `sooner` for those that take longer
    to compile than to run."""
    is_faulty = jax.__version_info__ >= _FIRST_FAULTY
    wanted = {**(_FAULTY_PASS if is_faulty else {}), **(_SOONER if sooner else {})}
    return {name: value for name, value in wanted.items() if _is_accepted(name, value)}


def warn_of_loop_fault() -> None:
    """Warn, once, where programs that the caller compiles may be wrong."""
    if not has_loop_fault():
        return
    # Python shows a warning once for each line of code that calls for it.
    warnings.warn(
        f"JAX {jax.__version__} compiles some small loops (`lax.fori_loop`, `lax.scan`) wrongly on "
        "this CPU. What jaxbridge compiles itself is not affected; what you compile with `jax.jit` "
        "or the like, jaxbridge inside or not, may return wrong numbers. Set the environment "
        "variable XLA_FLAGS=--xla_disable_hlo_passes=small-while-loop-hoisting before Python "
        "starts, which switches the faulty optimisation off.",
        RuntimeWarning,
        stacklevel=2,
    )


@functools.cache
def has_loop_fault() -> bool:
    """Return whether the CPU compiler, as it is set, computes the loop below wrongly."""
    with eval_context(), jax.disable_jit(False):
        slope = jax.jit(slope_of_normalised_twice)(POINT)
        return not np.allclose(jax.device_get(slope), EXACT_SLOPE, atol=1e-3)


def slope_of_normalised_twice(
    point: Float32[Array | np.ndarray, "3 3"],
) -> Float32[Array, "3 3"]:
    """Return the derivative of x / |x|, normalised again, in the direction sin x. This loop shows
    the fault; if it is rewritten, it may not."""

    def normalised(point):
        numbers = [point.ravel()[i] for i in range(9)]
        square = functools.reduce(operator.add, [number * number for number in numbers])
        positive = square > 0
        return point / jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)

    twice = lambda point: lax.fori_loop(0, 2, lambda _, point: normalised(point), point)
    return jax.jvp(twice, (point,), (jnp.sin(point),))[1]


def _is_accepted(name: str, value: bool | int | str) -> bool:
    with eval_context():
        nothing = jax.jit(lambda: np.float32(0), compiler_options={name: value})
        try:
            nothing.lower().compile()
        except jax.errors.JaxRuntimeError:
            return False
    return True
