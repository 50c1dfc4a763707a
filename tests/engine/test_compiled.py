"""Two ways to compile, of which only what is outermost may choose."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbridge.engine.compiled import compiled_for, compiled_sooner, is_outermost

X = jnp.linspace(0.1, 1.0, 5)


@compiled_sooner
def cube(x):
    return jnp.exp(3 * jnp.log(x))


@pytest.mark.parametrize(
    "transformed",
    [
        jax.jit,
        jax.vmap,
        lambda f: jax.vmap(jax.grad(f)),
        lambda f: jax.grad(lambda x: jnp.sum(f(x))),
        lambda f: jax.grad(lambda x: jnp.sum(compiled_sooner(lambda y: f(x) + y)(X))),
        lambda f: lambda x: jax.lax.map(f, x),
        lambda f: lambda x: jax.linearize(f, x)[1](X),
        lambda f: jax.checkpoint(f),
        lambda f: compiled_sooner(f),
    ],
)
def test_what_is_compiled_sooner_can_be_transformed(transformed):
    """With what is closed over, too: JAX refuses options of programs within others."""
    plain = transformed(lambda x: jnp.exp(3 * jnp.log(x)))
    np.testing.assert_allclose(transformed(cube)(X), plain(X), rtol=1e-5)


def test_outermost_is_what_is_neither_traced_nor_transformed():
    seen = []

    def look(x):
        seen.append(is_outermost())
        return 2 * x

    look(X)
    for transform in (jax.jit, jax.vmap, jax.linearize, jax.checkpoint):
        transform(look, X) if transform is jax.linearize else transform(look)(X)
    jax.grad(lambda _: jnp.sum(look(X)))(1.0)
    look(X)
    assert seen == [True] + 5 * [False] + [True]


def test_many_steps_are_compiled_for_speed():
    """And few sooner: of one function there are two programs, each of which is made once."""
    traced, steps = [], [10, 10**9, 10, 10**9]

    @compiled_for(lambda x: steps.pop())
    def double(x):
        traced.append(True)
        return 2 * x

    for _ in range(4):
        np.testing.assert_array_equal(double(X), 2 * X)
    assert len(traced) == 2


def test_errors_of_memory_say_what_takes_less():
    def fill(x):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes.")

    with pytest.raises(jax.errors.JaxRuntimeError) as caught:
        compiled_sooner(fill)(X)
    assert any("save_at" in note for note in caught.value.__notes__)
