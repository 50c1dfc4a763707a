"""Keys of the unrolled generator give JAX's own numbers, by programs without loops but for single
numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbridge.engine.compiled import compiled
from jaxbridge.engine.generator import with_unrolled_keys

KEY = jax.random.key(3)


def data_of(keys):
    return jax.random.key_data(keys)


DRAWS = {
    "split": lambda key: data_of(jax.random.split(key, (3, 2))),
    "fold_in": lambda key: data_of(jax.random.fold_in(key, 7)),
    "lanes": lambda key: data_of(jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(5))),
    "8 bits": lambda key: jax.random.bits(key, (5, 3), "uint8"),
    "16 bits": lambda key: jax.random.bits(key, (5, 3), "uint16"),
    "32 bits": lambda key: jax.random.bits(key, (5, 3)),
    "no shape": lambda key: jax.random.bits(key),
    "one number": lambda key: jax.random.bits(key, (1, 1), "uint16"),
    "one in lanes": lambda key: jax.vmap(jax.random.uniform)(jax.random.split(key, 5)),
    "nothing": lambda key: jax.random.bits(key, (0, 3)),
    "integers": lambda key: jax.random.randint(key, (4,), 0, 10),
    "permutation": lambda key: jax.random.permutation(key, 20),
    "seed": lambda key: data_of(jax.random.key(5, impl=jax.random.key_impl(key))),
}


@pytest.mark.parametrize("name", DRAWS)
def test_numbers_are_those_of_jax(name):
    draw = DRAWS[name]
    np.testing.assert_array_equal(compiled(draw)(KEY), draw(KEY))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_normal_numbers_are_those_of_jax(dtype, x64):
    draw = lambda key: jax.random.normal(key, (7,), dtype)
    np.testing.assert_allclose(compiled(draw)(KEY), draw(KEY), rtol=1e-6)


def test_there_are_no_loops():
    def draw(key):
        return jax.random.normal(jax.random.fold_in(key, 1), (4, 5))

    def num_loops(draw):
        return jax.jit(draw).lower(KEY).as_text().count("stablehlo.while")

    assert num_loops(draw) > 0 == num_loops(lambda key: draw(with_unrolled_keys(key)))


def test_a_single_number_is_a_loop():
    """That a loop which reads it cannot have in its body."""
    for shape in ((), (1,)):
        draw = lambda key, shape=shape: jax.random.uniform(with_unrolled_keys(key), shape)
        assert jax.jit(draw).lower(KEY).compile().as_text().count(" while(") == 1


def test_keys_of_other_kinds_are_as_they_were():
    for impl in ("rbg", "unsafe_rbg"):
        key = jax.random.key(0, impl=impl)
        assert with_unrolled_keys(key) is key
    with jax.threefry_partitionable(False):
        assert with_unrolled_keys(KEY) is KEY
    tree = {"model": jnp.ones(2), "name": "x", "none": None}
    assert with_unrolled_keys(tree)["model"] is tree["model"]


def test_so_many_numbers_are_refused():
    with pytest.raises(ValueError, match="2³²"):
        compiled(lambda key: jax.random.bits(key, (2**17, 2**15)).sum())(KEY)
