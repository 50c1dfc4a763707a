"""Detection of array indices that are out of bounds.

JAX clamps them silently: `path[50]` of 20 points is the last point. Here, a function is traced for
arrays of given shapes. Its jaxpr yields all indices that do not depend on values of these arrays;
these are compared with the shapes.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from jax import lax
from jax.extend import core
from jaxtyping import Array

from .checks import is_traced

_CALLS = ("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call")


def check_indices(name: str, function: Callable, like: Array | jax.ShapeDtypeStruct) -> None:
    """Raise `ValueError` if `function` indexes beyond the end of an array.

    `like` has the shape and dtype of the function's argument.
    """
    closed = jax.make_jaxpr(function)(like)
    for index, length in _beyond(closed.jaxpr, [_value(c) for c in closed.consts], [None]):
        raise ValueError(
            f"`{name}` takes the entry {index} of an axis of length {length}; its argument is "
            f"one array of shape {like.shape}. Use an index within the axis."
        )


def _beyond(jaxpr: Any, consts: list, inputs: list) -> Iterator[tuple[int, int]]:
    """Yield each known index that is out of bounds, with the length of its axis."""
    constants = dict(zip(jaxpr.constvars, consts, strict=True))
    constants |= dict(zip(jaxpr.invars, inputs, strict=True))

    def value_of(atom):
        return np.asarray(atom.val) if isinstance(atom, core.Literal) else constants.get(atom)

    for equation in jaxpr.eqns:
        values = [value_of(atom) for atom in equation.invars]
        name = equation.primitive.name
        if name in _CALLS:
            inner = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
            closed = hasattr(inner, "jaxpr")
            body = inner.jaxpr if closed else inner
            yield from _beyond(body, [_value(c) for c in inner.consts] if closed else [], values)
        elif name == "dynamic_slice":
            shape = equation.invars[0].aval.shape
            sizes = equation.params["slice_sizes"]
            yield from _outside(range(len(shape)), values[1:], sizes, shape)
        elif name == "gather" and values[1] is not None:
            # Other modes define the result beyond the end (clip, fill), perhaps on purpose.
            if equation.params["mode"] == lax.GatherScatterMode.PROMISE_IN_BOUNDS:
                shape, sizes = equation.invars[0].aval.shape, equation.params["slice_sizes"]
                axes = equation.params["dimension_numbers"].start_index_map
                yield from _outside(axes, np.moveaxis(values[1], -1, 0), sizes, shape)
        if name in _EVALUATED and all(value is not None for value in values):
            constants[equation.outvars[0]] = _EVALUATED[name](*values, **equation.params)


def _outside(axes, starts, sizes, shape) -> Iterator[tuple[int, int]]:
    """Yield each start whose slice leaves the axis, with the length of the axis.

    Negative starts are reported as the caller wrote them, relative to the end of the axis.
    """
    for axis, start in zip(axes, starts, strict=True):
        if start is None:  # depends on values of the argument
            continue
        is_outside = (start < 0) | (start + sizes[axis] > shape[axis])
        for index in np.atleast_1d(start)[np.atleast_1d(is_outside)]:
            yield int(index) - (shape[axis] if index < 0 else 0), shape[axis]


def _value(const: Any) -> np.ndarray | None:
    """Return the value of a constant, or `None` if it is traced."""
    return None if is_traced(const) else np.asarray(const)


def _broadcast(value, *, shape, broadcast_dimensions, **_):
    """Evaluate `broadcast_in_dim` by NumPy."""
    expanded = [1] * len(shape)
    for axis, length in zip(broadcast_dimensions, value.shape, strict=True):
        expanded[axis] = length
    return np.broadcast_to(value.reshape(expanded), shape)


def _iota(*, dtype, shape, dimension, **_):
    """Evaluate `iota` by NumPy."""
    expanded = [1] * len(shape)
    expanded[dimension] = shape[dimension]
    return np.broadcast_to(np.arange(shape[dimension], dtype=dtype).reshape(expanded), shape)


# Operations that JAX applies to indices before it uses them, such as wrapping negative ones.
_EVALUATED = {
    "lt": lambda a, b, **_: np.less(a, b),
    "add": lambda a, b, **_: np.add(a, b),
    "sub": lambda a, b, **_: np.subtract(a, b),
    "mul": lambda a, b, **_: np.multiply(a, b),
    "select_n": lambda which, *cases, **_: np.choose(which.astype(int), cases),
    "convert_element_type": lambda a, *, new_dtype, **_: np.asarray(a).astype(new_dtype),
    "concatenate": lambda *values, dimension, **_: np.concatenate(values, dimension),
    "reshape": lambda a, *, new_sizes, **_: np.reshape(a, new_sizes),
    "squeeze": lambda a, *, dimensions, **_: np.squeeze(a, dimensions),
    "broadcast_in_dim": _broadcast,
    "iota": _iota,
}
