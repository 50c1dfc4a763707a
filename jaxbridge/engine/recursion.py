"""States one after the other, x_{i+1} = f(x_i, u_i), with the derivatives of all steps at once.

Differentiated as it stands, a loop goes through its steps once more, each of dozens of kernels for
a few numbers. But tangents solve a linear recursion,

    ẋ_{i+1} = J_i ẋ_i + b_i,   J_i = ∂f/∂x at (x_i, u_i),

where b_i is what the tangents of u_i, and of what f knows besides, make of f. At states that are
known J_i and b_i follow for all steps side by side, and what is left for the loop is the product of
a small matrix and a vector. Transposed it is the adjoint recursion of reverse differentiation.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import PyTree

from .lanes import over_lanes
from .linalg import matvec


class StateDerivative(NamedTuple):
    """∂f/∂x of which more is known than its entries.

    - `coefficients`: of f at (x, u), a function of these alone.
    - `apply`: ∂f/∂x ẋ, from them and ẋ.
    """

    coefficients: Callable[[PyTree, PyTree], PyTree]
    apply: Callable[[PyTree, PyTree], PyTree]


def recursion(
    step: Callable[[Any, Any], tuple[Any, Any]],
    start: PyTree,
    inputs: PyTree,
    derivative: StateDerivative | None = None,
) -> tuple[Any, Any]:
    """x_1, x_2, ..., from x_0 = `start`, and y_0, y_1, ..., for (x_{i+1}, y_i) = `step`(x_i, u_i),
    with `inputs` u along the first axes of their arrays. `step` may know arrays that are
    differentiated; where it has no `derivative` of its own, which is for steps that give no y, a
    state is one vector, of not too many numbers."""
    of_step = jax.tree.map(lambda leaf: leaf[0], inputs)
    step, known = jax.closure_convert(step, start, of_step)
    return _states(step, derivative, known, start, *eqx.partition(inputs, eqx.is_inexact_array))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _states(step, derivative, known, start, inputs, others):
    """With inputs that have derivatives, and others."""

    def one(x, inputs):
        x, _ = step(x, eqx.combine(*inputs), *known)
        return x, x

    def aside(x, inputs, others):
        return step(x, eqx.combine(inputs, others), *known)[1]

    states = lax.scan(one, start, (inputs, others))[1]
    lanes = _moved((_before(start, states), inputs, others), 0, -1)
    return states, _moved(over_lanes(-1, -1, -1)(aside)(*lanes), -1, 0)


@_states.defjvp
def _tangents(step, derivative, primals, tangents):
    known, start, inputs, others = primals
    known_dot, start_dot, inputs_dot, _ = tangents
    made = _states(step, derivative, known, start, inputs, others)

    def one(x, inputs, others, inputs_dot):
        def of(x, inputs, known):
            return step(x, eqx.combine(inputs, others), *known)

        if derivative is None:
            J = jax.jacfwd(of)(x, inputs, known)
        else:
            J = derivative.coefficients(x, eqx.combine(inputs, others)), None
        return J, jax.jvp(functools.partial(of, x), (inputs, known), (inputs_dot, known_dot))[1]

    lanes = _moved((_before(start, made[0]), inputs, others, inputs_dot), 0, -1)
    both = over_lanes(-1, -1, -1, -1)(one)(*lanes)
    (J, J_aside), (b, b_aside) = _moved(both, -1, 0)
    apply = matvec if derivative is None else derivative.apply

    def next_tangent(x_dot, step):
        J, b = step
        x_dot = jax.tree.map(jnp.add, apply(J, x_dot), b)
        return x_dot, x_dot

    states_dot = lax.scan(next_tangent, start_dot, (J, b))[1]
    if derivative is not None:
        return made, (states_dot, b_aside)
    of_states = jax.vmap(lambda J, x_dot: matvec(J.reshape(-1, len(x_dot)), x_dot))
    before_dot = _before(start_dot, states_dot)
    add = lambda J, b: of_states(J, before_dot).reshape(b.shape) + b
    return made, (states_dot, jax.tree.map(add, J_aside, b_aside))


def _before(start: PyTree, states: PyTree) -> PyTree:
    """x_0, x_1, ..., but for the last."""
    return jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs[:-1]]), start, states)


def _moved(tree: PyTree, source: int, destination: int) -> PyTree:
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, source, destination), tree)
