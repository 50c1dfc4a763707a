"""What is known of compilers that compute wrong numbers, so that none is used unawares."""

import functools
import operator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax


@pytest.mark.parametrize("fusion_emitters", [True, False])
def test_small_loops_are_compiled_correctly(fusion_emitters, x64):
    """From 0.11.1 to 0.12.0.1 jaxlib's CPU compiler makes one function of a small loop, in which
    the tangent here is written over while the scalars that it is made of are still read: a
    derivative 20 % off. Where this fails, so may whatever runs in small loops, as records do:
    install a version that `pyproject.toml` allows, or set, before JAX is imported,
    XLA_FLAGS=--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=0
    """
    matrix = np.random.default_rng(0).standard_normal((3, 3)) + 3

    def normed(matrix):
        numbers = [matrix.ravel()[i] for i in range(9)]
        square = functools.reduce(operator.add, [number * number for number in numbers])
        positive = square > 0
        return matrix / jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)

    def twice_by_a_loop(matrix):
        return lax.fori_loop(0, 2, lambda _, matrix: normed(matrix), matrix)

    def slope(function):
        program = lambda x: jax.jvp(function, (x,), (jnp.sin(x),))[1]
        options = {"xla_cpu_use_fusion_emitters": fusion_emitters}
        return jax.jit(program, compiler_options=options)(matrix)

    twice = slope(lambda matrix: normed(normed(matrix)))
    np.testing.assert_allclose(slope(twice_by_a_loop), twice, atol=1e-12)
