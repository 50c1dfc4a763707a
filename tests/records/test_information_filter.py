"""The backward information filter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbridge.records.information_filter import information_filter
from jaxbridge.records.linearisation import LinearisedStep
from jaxbridge.records.observations import Scalars

K, N, D, SEEN = 3, 2, 2, 2


def random_record(rng, num_noises):
    """Steps of a linear process that turns, and what is seen of it: part of it without noise, part
    of it not at all."""
    decay = 0.8 * np.eye(D) + 0.4 * rng.normal(size=(K, N, D, D))
    steps = LinearisedStep(
        decay, rng.normal(size=(K, N, D)), 0.5 * rng.normal(size=(K, N, D, num_noises))
    )
    rows, values = rng.normal(size=(K, SEEN, D)), rng.normal(size=(K, SEEN))
    variances = np.abs(rng.normal(size=(K, SEEN)))
    variances[1, 0] = 0
    seen = np.ones((K, SEEN), bool)
    seen[2, 1] = False
    rows[2, 1], values[2, 1], variances[2, 1] = 0, 0, 1
    return jax.tree.map(jnp.asarray, (steps, Scalars(rows, values, variances, seen)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "num_noises, transform",
    [
        (2, lambda f: jax.value_and_grad(f, argnums=(0, 1, 2))),
        pytest.param(
            1, lambda f: jax.jacfwd(jax.grad(f, argnums=(0, 1)), argnums=2), marks=pytest.mark.slow
        ),
    ],
    ids=["first", "second"],
)
def test_derivatives_are_those_of_the_loop(num_noises, transform, x64):
    """In all but where there is nothing to be seen."""
    rng = np.random.default_rng(num_noises)
    steps, scalars = random_record(rng, num_noises)
    slope, curvature = rng.normal(size=(K, N, D)), rng.normal(size=(K, N, D, D))
    slope, curvature = map(jnp.asarray, (slope, curvature + curvature.swapaxes(-1, -2)))

    def value(steps, rows, values, **lanes):
        seen = scalars._replace(rows=rows, values=values)
        h = information_filter(steps, seen, **lanes)
        return jnp.sum(slope * jnp.tanh(h.shift)) + jnp.sum(curvature * jnp.tanh(h.precision))

    def loop(*parts):
        return value(*parts, over_lanes=lambda function: function)

    parts = steps, scalars.rows, scalars.values
    made, wanted = (jax.jit(transform(function))(*parts) for function in (value, loop))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(made))
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9)
    jax.tree.map(close, made, wanted)
