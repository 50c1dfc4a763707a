"""Traces of a model's functions, and tests of the arguments that a function uses."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax.extend
import numpy as np
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

    The next argument is the time. An argument with a default value does not count, nor does a
    function without a signature.
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
    jaxpr = jax.make_jaxpr(function)(like).jaxpr
    return any(_dependent_results(jaxpr, [True] * len(jaxpr.invars)))


def _dependent_results(jaxpr: jax.extend.core.Jaxpr, marked: list[bool]) -> list[bool]:
    """Return, for each result of a jaxpr, whether it depends on a `marked` argument."""
    reached = {var for var, is_marked in zip(jaxpr.invars, marked, strict=True) if is_marked}

    def is_reached(atom) -> bool:
        return not isinstance(atom, jax.extend.core.Literal) and atom in reached

    for equation in jaxpr.eqns:
        inputs = [is_reached(atom) for atom in equation.invars]
        # Follow inner calls of `jit`. Assume that other results depend on every input.
        if equation.primitive.name in ("jit", "pjit"):
            outputs = _dependent_results(equation.params["jaxpr"].jaxpr, inputs)
        else:
            outputs = [any(inputs)] * len(equation.outvars)
        reached.update(
            var for var, is_marked in zip(equation.outvars, outputs, strict=True) if is_marked
        )
    return [is_reached(atom) for atom in jaxpr.outvars]
