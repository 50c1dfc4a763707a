"""Functions of one point over many lanes, written out in the coordinates of the points.

`jax.vmap` carries lanes through a function as an axis of its arrays, in front of the others
wherever a number meets a vector: a state of d numbers is then interleaved lane by lane, and
compiled loops over time do not vectorise. Here a function of one small point is traced and
evaluated on its coordinates, each an array of lanes. What only moves numbers about (indexing,
stacking, transposing, broadcasting) happens while tracing and leaves nothing to compile, and a
product of matrices is a sum of products; all that remains is arithmetic on arrays of lanes,
which XLA fuses into a few passes.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun
from jaxtyping import Array, PyTree

# Written out, a function of many coordinates takes long to compile, and gains little.
_MOST_NUMBERS = 2_000


def over_lanes(*in_axes: PyTree) -> Callable[[Callable], Callable[..., Any]]:
    """`jax.vmap(function, in_axes, out_axes=-1)` for functions of one small point.

    `in_axes` are -1, for lanes in the last axis, or `None`, for what the lanes share.
    """

    def decorate(function: Callable) -> Callable[..., Any]:
        @functools.wraps(function)
        def over(*args):
            leaves, treedef = jax.tree.flatten(args)
            batched = [axis is not None for axis in _leaf_axes(in_axes, args)]
            lanes = next(leaf.shape[-1] for leaf, b in zip(leaves, batched, strict=True) if b)

            def of_point(*point):
                point = iter(point)
                each = [next(point) if b else leaf for leaf, b in zip(leaves, batched, strict=True)]
                return function(*jax.tree.unflatten(treedef, each))

            in_lanes = [leaf for leaf, b in zip(leaves, batched, strict=True) if b]
            one = [jax.ShapeDtypeStruct(leaf.shape[:-1], leaf.dtype) for leaf in in_lanes]
            closed, shapes = jax.make_jaxpr(of_point, return_shape=True)(*one)
            if _numbers(closed.jaxpr) > _MOST_NUMBERS:
                return jax.vmap(of_point, in_axes=-1, out_axes=-1)(*in_lanes)
            values = _evaluate(closed, [split(leaf) for leaf in in_lanes], lanes)
            out = [join(value, lanes) for value in values]
            return jax.tree.unflatten(jax.tree.structure(shapes), out)

        return over

    return decorate


def _leaf_axes(in_axes: Sequence[PyTree], args: Sequence[PyTree]) -> list[int | None]:
    """The axis of each leaf of `args`, of which `in_axes` has prefixes."""
    axes = []
    is_none = lambda axis: axis is None
    for axis, arg in zip(in_axes, args, strict=True):
        jax.tree.map(
            lambda axis, part: axes.extend([axis] * len(jax.tree.leaves(part))),
            axis, arg, is_leaf=is_none,
        )  # fmt: skip
    return axes


# A value is an array that all lanes share, or an `np.ndarray` of objects, its coordinates: each
# an array of lanes, or a number that all lanes share.


def split(values: Array) -> np.ndarray:
    coordinates = np.empty(values.shape[:-1], object)
    for index in np.ndindex(coordinates.shape):
        coordinates[index] = values[index]
    return coordinates


def join(value, lanes: int) -> Array:
    if not _is_split(value):
        return jnp.broadcast_to(jnp.asarray(value)[..., None], (*np.shape(value), lanes))
    rows = [_spread(row, lanes) for row in value.ravel()]
    if value.ndim == 0:
        return rows[0]
    return jnp.stack(rows).reshape(*value.shape, lanes)


def _is_split(value) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == object


def _spread(number: Array, lanes: int) -> Array:
    return jnp.broadcast_to(number, (lanes,))


def _coordinates(value) -> np.ndarray:
    if _is_split(value):
        return value
    coordinates = np.empty(np.shape(value), object)
    for index in np.ndindex(coordinates.shape):
        coordinates[index] = value[index] if index else value
    return coordinates


def _numbers(jaxpr: Jaxpr) -> int:
    total = 0
    for equation in jaxpr.eqns:
        inner = _inlined(equation)
        if inner is not None:
            total += _numbers(inner.jaxpr)
        elif equation.primitive.name not in _MOVES:
            total += sum(np.prod(var.aval.shape, dtype=int) for var in equation.outvars)
    return total


def _evaluate(closed: ClosedJaxpr, args: Sequence, lanes: int) -> list:
    environment: dict[Var, Any] = {}

    def read(atom):
        if isinstance(atom, Literal):
            return np.asarray(atom.val, atom.aval.dtype)
        return environment[atom]

    jaxpr = closed.jaxpr
    environment.update(zip(jaxpr.constvars, closed.consts, strict=True))
    environment.update(zip(jaxpr.invars, args, strict=True))
    for equation in jaxpr.eqns:
        values = _apply(jaxpr, equation, [read(atom) for atom in equation.invars], lanes)
        environment.update(zip(equation.outvars, values, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _apply(jaxpr: Jaxpr, equation: JaxprEqn, values: list, lanes: int) -> list:
    """The results of one equation."""
    name, params = equation.primitive.name, equation.params
    if not any(map(_is_split, values)):
        function, places = _alone(jaxpr, equation)
        return function(*(values[i] for i in places))
    inner = _inlined(equation)
    if inner is not None:
        return _evaluate(inner, values, lanes)
    if name in _ELEMENTWISE:
        return [_elementwise(equation, values, lanes)]
    if name in _MOVES:
        moved = _MOVES[name](*map(_coordinates, values), **params)
        return moved if equation.primitive.multiple_results else [moved]
    if name in _REDUCTIONS:
        return [_reduce(_REDUCTIONS[name], values[0], params["axes"])]
    if name == "dot_general" and not any(params["dimension_numbers"][1]):
        dtype = params["preferred_element_type"] or equation.outvars[0].aval.dtype
        return [_product(*map(_coordinates, values), params["dimension_numbers"][0], dtype)]
    function, places = _alone(jaxpr, equation)
    values = [values[i] for i in places]
    axes = [-1 if _is_split(value) else None for value in values]
    joined = [join(value, lanes) if _is_split(value) else value for value in values]
    made = jax.vmap(function, in_axes=axes, out_axes=-1, axis_size=lanes)(*joined)
    return [split(result) for result in made]


def _alone(jaxpr: Jaxpr, equation: JaxprEqn) -> tuple[Callable[..., list], list[int]]:
    """A function that does nothing but this equation, and the places of its arguments."""
    place = {}
    for i, atom in enumerate(equation.invars):
        if not isinstance(atom, Literal):
            place.setdefault(atom, i)
    jaxpr = jaxpr.replace(
        constvars=[], invars=list(place), outvars=equation.outvars, eqns=[equation]
    )
    return jaxpr_as_fun(ClosedJaxpr(jaxpr, [])), list(place.values())


def _inlined(equation: JaxprEqn) -> ClosedJaxpr | None:
    return equation.params["jaxpr"] if equation.primitive.name in ("jit", "pjit", "closed_call") else None


def _elementwise(equation: JaxprEqn, values: list, lanes: int) -> np.ndarray:
    shape = equation.outvars[0].aval.shape
    operands = [np.broadcast_to(_coordinates(value), shape) for value in values]
    result = np.empty(shape, object)
    for index in np.ndindex(shape):
        numbers = [_spread(operand[index], lanes) for operand in operands]
        result[index] = equation.primitive.bind(*numbers, **equation.params)
    return result


def _reduce(combine: Callable, value: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    kept = [axis for axis in range(value.ndim) if axis not in axes]
    moved = value.transpose(*kept, *axes)
    rows = moved.reshape(*moved.shape[: len(kept)], -1)
    result = np.empty(rows.shape[:-1], object)
    for index in np.ndindex(result.shape):
        result[index] = functools.reduce(combine, rows[index])
    return result


def _product(left: np.ndarray, right: np.ndarray, contracted, dtype) -> np.ndarray:
    product = np.tensordot(left, right, contracted)
    result = np.empty(np.shape(product), object)
    for index in np.ndindex(result.shape):
        result[index] = (product[index] if index else product).astype(dtype)
    return result


def _broadcast(value, *, shape, broadcast_dimensions, **_):
    unit = [1] * len(shape)
    for axis, size in zip(broadcast_dimensions, value.shape, strict=True):
        unit[axis] = size
    return np.broadcast_to(value.reshape(unit), shape)


def _pad(value, padding, *, padding_config):
    shape = [low + size + high + max(size - 1, 0) * inner for size, (low, high, inner) in
             zip(value.shape, padding_config, strict=True)]
    if any(low < 0 or high < 0 for low, high, _ in padding_config): raise NotImplementedError
    padded = np.full(shape, padding[()], object)
    places = tuple(slice(low, low + (inner + 1) * (size - 1) + 1 if size else low, inner + 1) for size, (low, _, inner) in zip(value.shape, padding_config, strict=True))
    padded[places] = value
    return padded


def _slice(value, *, start_indices, limit_indices, strides):
    strides = strides or (None,) * value.ndim
    return value[tuple(map(slice, start_indices, limit_indices, strides))]


_MOVES = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda *values, dimension: np.concatenate(values, dimension),
    "reshape": lambda value, *, new_sizes, **_: value.reshape(new_sizes),
    "pad": _pad,
    "rev": lambda value, *, dimensions: np.flip(value, dimensions),
    "slice": _slice,
    "split": lambda value, *, sizes, axis: np.split(value, np.cumsum(sizes)[:-1], axis),
    "stack": lambda *values, axis: np.stack(values, axis),
    "squeeze": lambda value, *, dimensions: value.squeeze(dimensions),
    "transpose": lambda value, *, permutation: value.transpose(permutation),
}
_REDUCTIONS = {
    "reduce_sum": operator.add,
    "reduce_prod": operator.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": operator.and_,
    "reduce_or": operator.or_,
}
_ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh bessel_i0e bessel_i1e cbrt ceil clamp "
    "convert_element_type copy cos cosh digamma div eq erf erf_inv erfc exp exp2 expm1 floor ge gt "
    "integer_pow is_finite le lgamma log log1p logistic lt max min mul ne neg nextafter not or "
    "pow rem round rsqrt select_n sign sin sinh sqrt square stop_gradient sub tan tanh xor".split()
)
