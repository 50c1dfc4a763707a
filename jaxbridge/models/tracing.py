"""Traces of a model's functions, and tests of the arguments that a function uses."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax.extend
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import Array, Float, PyTree


def traced_once(function: Callable) -> Callable:
    """Return `function` with its jaxpr cached for arguments of the same shapes and dtypes.

    A program evaluates the coefficients of a model in about twenty places, and tracing their
    derivatives takes long.
    """

    def call(*args: PyTree) -> PyTree:
        leaves, structure = jax.tree.flatten(args)
        arrays = [leaf if isinstance(leaf, _ARRAYS) else None for leaf in leaves]
        # With their types, because 1 == 1.0 would give both the same jaxpr.
        static_leaves = tuple(
            (type(leaf), leaf) for leaf in leaves if not isinstance(leaf, _ARRAYS)
        )
        return _call_flat(function, structure, static_leaves, arrays)

    return call


# Leaves that `jit` traces. All others are static.
_ARRAYS = (jax.Array, np.ndarray)


# The cache of `jit` holds the jaxpr, and `inline` removes the call from the program.
@functools.partial(jax.jit, static_argnums=(0, 1, 2), inline=True)
def _call_flat(function, structure, static_leaves, arrays):
    """Call `function` with the arguments that these leaves form: arrays, and static leaves with
    types."""
    remaining = iter(static_leaves)
    leaves = [next(remaining)[1] if array is None else array for array in arrays]
    return function(*jax.tree.unflatten(structure, leaves))


def takes_time(function: Any, num_before_time: int = 2) -> bool:
    """Return whether `function` requires more than `num_before_time` positional arguments.

    The next argument is the time. Arguments with default values do not count. The result is false
    for a function without a signature.
    """
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # not a function, or one without a signature
        return False
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    required = [p for p in parameters if p.kind in positional and p.default is p.empty]
    return len(required) > num_before_time


def uses_argument(function: Callable, like: Float[Array, " d"]) -> bool:
    """Return whether the values of `function` depend on its argument, according to its jaxpr."""
    followed = _follow(jax.make_jaxpr(function)(like).jaxpr, lambda equation, inputs: True)
    return any(followed or [])


# Primitives that are linear in all of their arguments.
_LINEAR = frozenset(
    "add add_any broadcast_in_dim concatenate convert_element_type copy cumsum expand_dims neg pad "
    "reduce_sum reshape rev slice split squeeze stack sub transpose unstack".split()
)
# Primitives that are linear in one argument at a time.
_BILINEAR = frozenset(("mul", "dot_general"))
# Primitives that are linear in their first arguments, as many as the number says.
_LINEAR_IN_FIRST = {"div": 1, "dynamic_slice": 1, "gather": 1, "dynamic_update_slice": 2}


def is_affine(function: Callable, like: Float[Array, " d"]) -> bool:
    """Return whether `function` is an affine function of its argument, according to its jaxpr.

    A constant derivative would not be enough: that of a step function is zero. A function counts as
    affine only if its primitives are sums, rearrangements, and products with constants.
    """
    jaxpr = jax.make_jaxpr(function)(like).jaxpr
    # Drop equations that no result uses: `grad` leaves those of the value that it differentiates.
    jaxpr, _ = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars), instantiate=True)
    return _follow(jaxpr, _keeps_affine) is not None


def _keeps_affine(equation: jax.extend.core.JaxprEqn, inputs: list[bool]) -> bool:
    """Return whether the results of an equation are affine in its inputs that depend on x.

    `inputs` states which inputs depend on x, the argument of the function.
    """
    name = equation.primitive.name
    if name == "select_n":
        return not inputs[0]
    if name in _BILINEAR:
        return not all(inputs)
    if name in _LINEAR_IN_FIRST:
        return not any(inputs[_LINEAR_IN_FIRST[name] :])
    return name in _LINEAR and _are_floating(equation.outvars)


def _follow(
    jaxpr: jax.extend.core.Jaxpr,
    allows: Callable[[jax.extend.core.JaxprEqn, list[bool]], bool],
    marked: list[bool] | None = None,
) -> list[bool] | None:
    """Return, for each result of a jaxpr, whether it depends on a marked argument.

    `marked` has one entry per argument; by default all are marked. Return `None` if
    `allows(equation, inputs)` is false for an equation that depends on a marked argument. `inputs`
    states which inputs of the equation depend on one.
    """
    marked = [True] * len(jaxpr.invars) if marked is None else marked
    reached = {var for var, is_marked in zip(jaxpr.invars, marked, strict=True) if is_marked}

    def is_reached(atom) -> bool:
        return not isinstance(atom, jax.extend.core.Literal) and atom in reached

    for equation in jaxpr.eqns:
        inputs = [is_reached(atom) for atom in equation.invars]
        if not any(inputs):
            continue
        # Follow inner calls of `jit`. Assume that other results depend on every input.
        if equation.primitive.name in ("jit", "pjit"):
            outputs = _follow(equation.params["jaxpr"].jaxpr, allows, inputs)
        else:
            outputs = [True] * len(equation.outvars) if allows(equation, inputs) else None
        if outputs is None:
            return None
        reached.update(
            var for var, is_marked in zip(equation.outvars, outputs, strict=True) if is_marked
        )
    return [is_reached(atom) for atom in jaxpr.outvars]


def _are_floating(variables: Any) -> bool:
    """Return whether all variables of a jaxpr are floating-point numbers."""
    return all(np.issubdtype(variable.aval.dtype, np.floating) for variable in variables)
