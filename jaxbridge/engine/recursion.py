"""Recursions x_{i+1} = f(x_i, u_i) whose derivatives are computed for all steps at once.

Automatic differentiation of a loop repeats its steps, each with dozens of kernels for a few
numbers. Tangents, however, solve a linear recursion,

    ẋ_{i+1} = J_i ẋ_i + b_i,   J_i = ∂f/∂x at (x_i, u_i).

Here b_i is the derivative of f in the direction of the tangents of u_i and of all closed-over
values. At known states, J_i and b_i follow for all steps side by side. The loop then only
multiplies a small matrix by a vector in each step. Its transpose is the adjoint recursion of
reverse-mode differentiation.
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
    """Derivative ∂f/∂x with a known structure.

    - `coefficients(x, u)`: the numbers that define ∂f/∂x.
    - `apply(coefficients, ẋ)`: the product ∂f/∂x ẋ.
    """

    coefficients: Callable[[PyTree, PyTree], PyTree]
    apply: Callable[[PyTree, PyTree], PyTree]


def recursion(
    step: Callable[[Any, Any], tuple[Any, Any]],
    start: PyTree,
    inputs: PyTree,
    derivative: StateDerivative | None = None,
) -> tuple[Any, Any]:
    """Compute x_1, x_2, ... and y_0, y_1, ... of (x_{i+1}, y_i) = `step`(x_i, u_i).

    - `start` is x_0, and `inputs` holds u along the first axes of its arrays.
    - `step` may close over arrays that are differentiated.
    - Without `derivative`, the state must be one vector of few numbers.
    - With `derivative`, steps must not return y.
    """
    first_input = jax.tree.map(lambda leaf: leaf[0], inputs)
    # Closed-over arrays become arguments, so that the derivative rule receives their tangents.
    step, closed_over = jax.closure_convert(step, start, first_input)
    return _states(
        step, derivative, closed_over, start, *eqx.partition(inputs, eqx.is_inexact_array)
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _states(step, derivative, closed_over, start, inputs, other_inputs):
    """Compute the states and outputs; `inputs` are differentiable, `other_inputs` are not."""

    def next_state(x, inputs):
        x, _ = step(x, eqx.combine(*inputs), *closed_over)
        return x, x

    def output(x, inputs, other_inputs):
        return step(x, eqx.combine(inputs, other_inputs), *closed_over)[1]

    # Outputs do not enter later states: the loop leaves them out, and all follow side by side.
    states = lax.scan(next_state, start, (inputs, other_inputs))[1]
    lanes = _move_axis((_before(start, states), inputs, other_inputs), 0, -1)
    return states, _move_axis(over_lanes(-1, -1, -1)(output)(*lanes), -1, 0)


@_states.defjvp
def _tangents(step, derivative, primals, tangents):
    """Compute the tangents of states and outputs by the linear recursion."""
    closed_over, start, inputs, other_inputs = primals
    closed_over_dot, start_dot, inputs_dot, _ = tangents
    results = _states(step, derivative, closed_over, start, inputs, other_inputs)

    def derivatives_of_step(x, inputs, other_inputs, inputs_dot):
        def step_at(x, inputs, closed_over):
            return step(x, eqx.combine(inputs, other_inputs), *closed_over)

        if derivative is None:
            J = jax.jacfwd(step_at)(x, inputs, closed_over)
        else:
            J = derivative.coefficients(x, eqx.combine(inputs, other_inputs)), None
        return J, jax.jvp(
            functools.partial(step_at, x), (inputs, closed_over), (inputs_dot, closed_over_dot)
        )[1]

    lanes = _move_axis((_before(start, results[0]), inputs, other_inputs, inputs_dot), 0, -1)
    derivatives = over_lanes(-1, -1, -1, -1)(derivatives_of_step)(*lanes)
    (J, J_output), (b, b_output) = _move_axis(derivatives, -1, 0)
    apply = matvec if derivative is None else derivative.apply

    def next_tangent(x_dot, step):
        J, b = step
        x_dot = jax.tree.map(jnp.add, apply(J, x_dot), b)
        return x_dot, x_dot

    states_dot = lax.scan(next_tangent, start_dot, (J, b))[1]
    if derivative is not None:
        return results, (states_dot, b_output)
    # Tangents of the outputs: ẏ_i = ∂y/∂x ẋ_i + b_i, with the state before the step.
    apply_output = jax.vmap(lambda J, x_dot: matvec(J.reshape(-1, len(x_dot)), x_dot))
    before_dot = _before(start_dot, states_dot)
    add = lambda J, b: apply_output(J, before_dot).reshape(b.shape) + b
    return results, (states_dot, jax.tree.map(add, J_output, b_output))


def _before(start: PyTree, states: PyTree) -> PyTree:
    """Return x_0, x_1, ... without the last state: the state before each step."""
    return jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs[:-1]]), start, states)


def _move_axis(tree: PyTree, source: int, destination: int) -> PyTree:
    """Move one axis of all arrays in the tree."""
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, source, destination), tree)
