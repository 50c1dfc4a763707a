"""Derivatives of recursions are those of the loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxbridge.engine.recursion import StateDerivative, recursion

NUM_STEPS, D = 12, 2


def step_of(params, x, inputs):
    """A step that knows parameters, with inputs that have derivatives and others; and something
    aside."""
    pull, flag = inputs
    moved = jnp.sin(params["rate"] * x) + jnp.where(flag, params["pull"] * pull, 0.3 * x[::-1] ** 2)
    return moved, jnp.cos(params["rate"] * x[0]) * pull


def as_loop(step, start, inputs):
    def one(x, inputs):
        x, aside = step(x, inputs)
        return x, (x, aside)

    return lax.scan(one, start, inputs)[1]


def value(run, params, start, pulls):
    flags = jnp.arange(NUM_STEPS) % 3 == 0
    made = run(lambda x, u: step_of(params, x, u), start, (pulls, flags))
    weights = jnp.linspace(0.5, 2, NUM_STEPS)[:, None]
    return sum(jnp.sum(jnp.cos(leaf * weights)) for leaf in made)


@pytest.fixture
def arguments():
    pulls = jnp.asarray(np.random.default_rng(0).normal(size=(NUM_STEPS, D)))
    params = {"rate": jnp.asarray(1.3), "pull": jnp.array([0.5, 2.0])}
    return params, jnp.array([0.3, -0.2]), pulls


def assert_same(one, other):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10), one, other)


def test_derivatives_are_those_of_the_loop(x64, arguments):
    arguments = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), arguments)
    for transform in (
        lambda f: jax.value_and_grad(f, argnums=(0, 1, 2)),
        lambda f: jax.jacfwd(jax.grad(f, argnums=(0, 1)), argnums=(0, 1)),
        lambda f: (
            lambda params, start, pulls: jax.vmap(jax.grad(f, argnums=1), in_axes=(None, 0, None))(
                params, jnp.stack([start, 2 * start]), pulls
            )
        ),
    ):
        by = lambda run, transform=transform: transform(lambda *a: value(run, *a))
        made = [jax.jit(by(run))(*arguments) for run in (recursion, as_loop)]
        assert_same(*made)


def test_a_derivative_of_its_own_is_used(x64):
    """Of a linear step of a matrix: X ↦ A X Aᵀ + u."""
    A = jnp.array([[0.5, 0.2], [-0.3, 0.8]])
    start = jnp.eye(2)
    inputs = jnp.asarray(np.random.default_rng(1).normal(size=(NUM_STEPS, 2, 2)))

    def made(A, start, inputs, derivative):
        of = lambda x, u: (A @ x @ A.T + u, None)
        x, _ = recursion(of, start, inputs, derivative)
        return jnp.sum(jnp.sin(x))

    def loop(A, start, inputs):
        return jnp.sum(jnp.sin(as_loop(lambda x, u: (A @ x @ A.T + u, None), start, inputs)[0]))

    all_of = (0, 1, 2)
    right = StateDerivative(lambda x, u: (A,), lambda J, x_dot: J[0] @ x_dot @ J[0].T)
    wrong = StateDerivative(lambda x, u: (A,), lambda J, x_dot: J[0] @ x_dot)
    wanted = jax.grad(loop, argnums=all_of)(A, start, inputs)
    assert_same(jax.grad(made, argnums=all_of)(A, start, inputs, right), wanted)
    off = jax.grad(made, argnums=all_of)(A, start, inputs, wrong)[1] - wanted[1]
    assert float(jnp.max(jnp.abs(off))) > 0.1
