"""Functions of one point over many lanes, written out in the coordinates of the points.

`jax.vmap` takes lanes through a function as an axis of its arrays, the first wherever a number
meets a vector: states are then interleaved lane by lane, and loops over time do not vectorise.
Here a function of one small point is traced and evaluated on coordinates, each of them an array
of lanes. What only moves numbers about (indexing, stacking, transposing, broadcasting) happens
while tracing, and a product of matrices is a sum of products; what is left to compile is
arithmetic on arrays of lanes, which XLA fuses into a few passes.
"""

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, cast

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun
from jaxtyping import Array, PyTree, Shaped

# Beyond these, what is written out takes long to compile, and vectors are long enough for `vmap`.
_MOST_NUMBERS = 512
_MOST_ROWS = 4


def over_lanes(*in_axes: PyTree) -> Callable[[Callable], Callable[..., Any]]:
    """`jax.vmap` of a function of one point, lanes in the last axis of arguments and results.

    `in_axes` has for each argument, or each part of one, -1 or, for what lanes share, `None`.
    """

    def decorate(function: Callable) -> Callable[..., Any]:
        def over(*args):
            leaves, treedef = jax.tree.flatten(args)
            in_lanes = [axis is not None for axis in _axes_of_leaves(in_axes, args)]

            def of_point(*values):
                values = iter(values)
                each = [
                    next(values) if own else leaf
                    for leaf, own in zip(leaves, in_lanes, strict=True)
                ]
                return function(*jax.tree.unflatten(treedef, each))

            arrays = [leaf for leaf, own in zip(leaves, in_lanes, strict=True) if own]
            points = [jax.ShapeDtypeStruct(array.shape[:-1], array.dtype) for array in arrays]
            closed, out = jax.make_jaxpr(of_point, return_shape=True)(*points)
            if _count_numbers(closed.jaxpr) > _MOST_NUMBERS:
                results = jax.vmap(jaxpr_as_fun(closed), in_axes=-1, out_axes=-1)(*arrays)
            else:
                lanes = arrays[0].shape[-1]
                values = _evaluate(closed, [_split(array) for array in arrays], lanes)
                results = [_join(value, lanes) for value in values]
            return jax.tree.unflatten(jax.tree.structure(out), results)

        return over

    return decorate


class Rows(tuple[Array, ...]):
    """The rows of an array as arrays of their own, for the state of a compiled loop: each step
    would otherwise write them into one array, element by element."""


jax.tree_util.register_pytree_node(Rows, lambda rows: (rows, None), lambda _, rows: Rows(rows))


def split_rows(tree: PyTree, axis: int = 0) -> PyTree:
    """Every array of points in the tree, coordinates in this axis and lanes after it, as `Rows`."""

    def split(leaf):
        if leaf.ndim != axis + 2 or leaf.shape[axis] > _MOST_ROWS:
            return leaf
        return Rows(jnp.moveaxis(leaf, axis, 0))

    return jax.tree.map(split, tree)


def join_rows(tree: PyTree, axis: int = 0) -> PyTree:
    """The inverse of `split_rows`."""
    are_rows = lambda leaf: isinstance(leaf, Rows)
    return jax.tree.map(
        lambda leaf: jnp.stack(leaf, axis) if are_rows(leaf) else leaf, tree, is_leaf=are_rows
    )


# While a function is evaluated, a value is an array that all lanes share, or its coordinates: an
# `np.ndarray` of objects, each of them an array of lanes or a number that all lanes share.


def _split(array: Shaped[Array, "*shape lanes"]) -> np.ndarray:
    return _objects(array.shape[:-1], lambda index: array[index])


def _join(value, lanes: int) -> Shaped[Array, "*shape lanes"]:
    if not _is_split(value):
        return jnp.broadcast_to(jnp.asarray(value)[..., None], (*np.shape(value), lanes))
    rows = [jnp.broadcast_to(number, (lanes,)) for number in value.flat]
    return jnp.stack(rows).reshape(*value.shape, lanes) if value.ndim else rows[0]


def _axes_of_leaves(in_axes: Sequence[PyTree], args: Sequence[PyTree]) -> list[int | None]:
    def spread(axis, part):
        return [axis] * len(jax.tree.leaves(part))

    is_none = lambda axis: axis is None
    axes = jax.tree.map(spread, tuple(in_axes), tuple(args), is_leaf=is_none)
    return jax.tree.leaves(axes, is_leaf=is_none)


def _is_split(value) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == object


def _objects(shape: tuple[int, ...], entry: Callable[[tuple[int, ...]], Any]) -> np.ndarray:
    """The array of objects with these entries."""
    objects = np.empty(shape, object)
    for index in np.ndindex(shape):
        objects[index] = entry(index)
    return objects


def _coordinates(value) -> np.ndarray:
    return value if _is_split(value) else _objects(np.shape(value), lambda index: value[index])


def _aval(atom: Var | Literal) -> jax.core.ShapedArray:
    return cast(jax.core.ShapedArray, atom.aval)


def _inner(equation: JaxprEqn) -> ClosedJaxpr | None:
    """The body of a call that is no more than its body."""
    return equation.params["jaxpr"] if equation.primitive.name in ("jit", "pjit") else None


def _count_numbers(jaxpr: Jaxpr) -> int:
    """How many numbers the function computes in one lane."""

    def of(equation: JaxprEqn) -> int:
        inner, name = _inner(equation), equation.primitive.name
        if inner is not None:
            return _count_numbers(inner.jaxpr)
        if name in _MOVES:
            return 0
        counted = equation.invars if name in _REDUCTIONS else equation.outvars
        numbers = sum(math.prod(_aval(atom).shape) for atom in counted)
        if name == "dot_general":
            (axes, _), _ = equation.params["dimension_numbers"]
            numbers *= math.prod(_aval(equation.invars[0]).shape[axis] for axis in axes)
        return numbers

    return sum(map(of, jaxpr.eqns))


def _evaluate(closed: ClosedJaxpr, args: Sequence, lanes: int) -> list:
    jaxpr = closed.jaxpr
    values: dict[Var, Any] = dict(zip(jaxpr.constvars, closed.consts, strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))

    def read(atom):
        if isinstance(atom, Literal):
            return np.asarray(atom.val, _aval(atom).dtype)
        return values[atom]

    for equation in jaxpr.eqns:
        operands = [read(atom) for atom in equation.invars]
        results = _apply(jaxpr, equation, operands, lanes)
        values.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _apply(jaxpr: Jaxpr, equation: JaxprEqn, operands: list, lanes: int) -> list:
    name, params = equation.primitive.name, equation.params
    if not any(map(_is_split, operands)):
        function, operands = _alone(jaxpr, equation, operands)
        return function(*operands)
    inner = _inner(equation)
    if inner is not None:
        return _evaluate(inner, operands, lanes)
    if name in _ELEMENTWISE:
        return [_elementwise(equation, operands)]
    if name in _MOVES:
        moved = _MOVES[name](*map(_coordinates, operands), **params)
        return list(moved) if equation.primitive.multiple_results else [moved]
    if name in _REDUCTIONS:
        return [_reduced(_REDUCTIONS[name], operands[0], params["axes"])]
    if name == "dot_general" and not any(params["dimension_numbers"][1]):
        return [_product(equation, *map(_coordinates, operands))]
    function, operands = _alone(jaxpr, equation, operands)
    axes = [-1 if _is_split(operand) else None for operand in operands]
    joined = [_join(operand, lanes) if _is_split(operand) else operand for operand in operands]
    return [_split(result) for result in jax.vmap(function, axes, -1)(*joined)]


def _alone(jaxpr: Jaxpr, equation: JaxprEqn, operands: list) -> tuple[Callable[..., list], list]:
    """The equation as a function by itself, and its arguments."""
    own = {
        atom: operand
        for atom, operand in zip(equation.invars, operands, strict=True)
        if not isinstance(atom, Literal)
    }
    alone = jaxpr.replace(constvars=[], invars=list(own), outvars=equation.outvars, eqns=[equation])
    return jaxpr_as_fun(ClosedJaxpr(alone, [])), list(own.values())


def _elementwise(equation: JaxprEqn, operands: list) -> np.ndarray:
    shape = _aval(equation.outvars[0]).shape
    operands = [np.broadcast_to(_coordinates(operand), shape) for operand in operands]

    def entry(index):
        numbers = jnp.broadcast_arrays(*(operand[index] for operand in operands))
        return equation.primitive.bind(*numbers, **equation.params)

    return _objects(shape, entry)


def _reduced(combine: Callable, value: np.ndarray, axes: Sequence) -> np.ndarray:
    value = np.moveaxis(value, axes, range(len(axes)))
    rest = value.shape[len(axes) :]
    rows = value.reshape(-1, *rest)
    return _objects(rest, lambda index: functools.reduce(combine, rows[:, *index]))


def _product(equation: JaxprEqn, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    aval = _aval(equation.outvars[0])
    axes, _ = equation.params["dimension_numbers"]
    product = np.asarray(np.tensordot(left, right, axes), object)
    return _objects(aval.shape, lambda index: product[index].astype(aval.dtype))


def _broadcast(value, *, shape, broadcast_dimensions, **_):
    unit = np.ones(len(shape), int)
    unit[list(broadcast_dimensions)] = value.shape
    return np.broadcast_to(value.reshape(unit), shape)


def _slice(value, *, start_indices, limit_indices, strides):
    return value[tuple(map(slice, start_indices, limit_indices, strides or [None] * value.ndim))]


_MOVES: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda *values, dimension: np.concatenate(values, dimension),
    "reshape": lambda value, *, new_sizes, **_: value.reshape(new_sizes),
    "rev": lambda value, *, dimensions: np.flip(value, dimensions),
    "slice": _slice,
    "split": lambda value, *, sizes, axis: np.split(value, np.cumsum(sizes)[:-1], axis),
    "squeeze": lambda value, *, dimensions: value.squeeze(dimensions),
    "stack": lambda *values, axis: np.stack(values, axis),
    "transpose": lambda value, *, permutation: value.transpose(permutation),
}
_REDUCTIONS: dict[str, Callable] = {
    "reduce_and": operator.and_,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_or": operator.or_,
    "reduce_prod": operator.mul,
    "reduce_sum": operator.add,
}
_ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp "
    "convert_element_type copy cos cosh digamma div eq erf erf_inv erfc exp exp2 expm1 floor ge "
    "gt integer_pow is_finite le lgamma log log1p logistic lt max min mul ne neg not or pow rem "
    "round rsqrt select_n sign sin sinh sqrt square sub tan tanh xor".split()
)
