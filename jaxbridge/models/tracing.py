"""Tracing of the functions that make a model: once, and what is seen of them by it."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax.extend
import numpy as np
from jaxtyping import Array, Float, PyTree


def traced_once(function: Callable) -> Callable:
    """`function`, whose jaxpr is kept for arguments of the same shapes: a program evaluates the
    coefficients of a model in some twenty places, and derivatives in them are long to trace."""

    def call(*args: PyTree) -> PyTree:
        leaves, structure = jax.tree.flatten(args)
        arrays = [leaf if isinstance(leaf, _ARRAYS) else None for leaf in leaves]
        # With their types, for 1 and 1.0 are equal.
        others = tuple((type(leaf), leaf) for leaf in leaves if not isinstance(leaf, _ARRAYS))
        return _of_parts(function, structure, others, arrays)

    return call


_ARRAYS = (jax.Array, np.ndarray)


@functools.partial(jax.jit, static_argnums=(0, 1, 2), inline=True)
def _of_parts(function, structure, others, arrays):
    values = iter(others)
    leaves = [next(values)[1] if array is None else array for array in arrays]
    return function(*jax.tree.unflatten(structure, leaves))


def takes_time(function: Any, num_others: int = 2) -> bool:
    """Whether a function must be given one argument more than so many, the time. One that has a
    default is none."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # no function, or one that does not tell
        return False
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    required = [p for p in parameters if p.kind in positional and p.default is p.empty]
    return len(required) > num_others


def uses_argument(function: Callable, like: Float[Array, " d"]) -> bool:
    """Whether the values of `function` depend on its argument, by following its jaxpr."""
    jaxpr = jax.make_jaxpr(function)(like).jaxpr
    return any(_reached(jaxpr, [True] * len(jaxpr.invars)))


def _reached(jaxpr: jax.extend.core.Jaxpr, given: list[bool]) -> list[bool]:
    """Which results depend on the given arguments."""
    reached = {var for var, own in zip(jaxpr.invars, given, strict=True) if own}

    def is_reached(atom) -> bool:
        return not isinstance(atom, jax.extend.core.Literal) and atom in reached

    for equation in jaxpr.eqns:
        into = [is_reached(atom) for atom in equation.invars]
        if equation.primitive.name in ("jit", "pjit"):
            out = _reached(equation.params["jaxpr"].jaxpr, into)
        else:
            out = [any(into)] * len(equation.outvars)
        reached.update(var for var, own in zip(equation.outvars, out, strict=True) if own)
    return [is_reached(atom) for atom in jaxpr.outvars]
