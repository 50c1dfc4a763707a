"""The functions of a model are traced once."""

import jax
import jax.numpy as jnp
import pytest

import jaxbridge as jb
from jaxbridge.models.tracing import traced_once


def test_a_program_traces_each_function_of_the_model_once():
    traced = {"drift": 0, "log_stationary": 0}

    def drift(x, p):
        traced["drift"] += 1
        return -p * x

    def log_stationary(x, p):
        traced["log_stationary"] += 1
        return -p * x @ x

    model = jb.Diffusion(drift, None, log_stationary, 1.0)
    options = dict(num_bridges=4, num_steps=4, proposal=jb.Coupling(0.0))
    program = jax.jit(
        lambda key: jb.sample_weighted_bridges(key, model, [0.0], [0.3], 1.0, **options)
    )
    program.lower(jax.random.key(0))
    assert traced == {"drift": 1, "log_stationary": 1}


@pytest.mark.parametrize("number", [2, 2.0, True])
def test_what_is_no_array_stays_what_it_is(number):
    seen = []
    function = traced_once(lambda x, p: seen.append(p["number"]) or x * 2)
    for given in (2, 2.0, number):
        function(jnp.ones(()), {"number": given, "name": "a"})
    assert [type(each) for each in seen] == [int, float, *([bool] if number is True else [])]


def test_derivatives_pass_through():
    scale = jnp.asarray(3.0)
    cube = traced_once(lambda x, p: p * scale * x**3)
    slopes = jax.grad(cube, argnums=(0, 1))(jnp.asarray(2.0), jnp.asarray(1.0))
    assert (float(slopes[0]), float(slopes[1])) == (36.0, 24.0)
    inner = lambda x: jax.grad(lambda s: traced_once(lambda y, p: s * y**p)(x, 2))(1.0)
    assert float(jax.jit(jax.vmap(inner))(jnp.arange(3.0))[2]) == 4.0
