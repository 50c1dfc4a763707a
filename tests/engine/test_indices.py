"""Indices that JAX would clamp."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbridge.engine.indices import check_indices

PATH = jax.ShapeDtypeStruct((21, 2), jnp.float32)
INSIDE = {
    "last": lambda path: path[20],
    "first from the end": lambda path: path[-21],
    "slice": lambda path: path[10:60],
    "array": lambda path: path[np.array([0, 20])],
    "of values": lambda path: path[jnp.argmax(path[:, 0])],
    "loop": lambda path: jax.lax.fori_loop(0, 21, lambda i, s: s + path[i], jnp.zeros(2)),
    "closed over": lambda path: jnp.arange(30.0)[25] + path[3],
}
BEYOND = {
    "one": (lambda path: path[21], 21, 21),
    "before": (lambda path: path[-22], -22, 21),
    "coordinate": (lambda path: path[:, 2], 2, 2),
    "both": (lambda path: path[0, -3], -3, 2),
    "derived": (lambda path: jnp.linalg.norm(path, axis=1)[40], 40, 21),
    "array": (lambda path: path[np.array([3, 40])], 40, 21),
    "array of JAX": (lambda path: path[jnp.arange(22)], 21, 21),
    "two axes": (lambda path: path[np.array([1, 2]), np.array([0, 5])], 5, 2),
    "jit": (jax.jit(lambda path: path[30]), 30, 21),
}


@pytest.mark.parametrize("name", INSIDE)
def test_indices_inside_pass(name):
    check_indices("fn", INSIDE[name], PATH)


@pytest.mark.parametrize("name", BEYOND)
def test_indices_beyond_are_refused(name):
    function, index, length = BEYOND[name]
    with pytest.raises(ValueError, match=f"`fn` takes the entry {index} of .* length {length}"):
        check_indices("fn", function, PATH)


def test_indices_are_checked_while_tracing():
    with pytest.raises(ValueError, match="entry 21"):
        jax.eval_shape(lambda path: check_indices("fn", lambda p: p[21], path), PATH)
