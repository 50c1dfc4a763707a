"""Functions of one point over many lanes, written out in the coordinates of the points.

`jax.vmap` takes lanes through a function as an axis of its arrays, the first wherever a number
meets a vector: states are then interleaved lane by lane, and loops over time do not vectorise.
Here a function of one small point is traced and evaluated, equation by equation, with lanes last:
coordinate by coordinate if there are few, else array by array (`lane_forms`). Short sums and
products of matrices are written out, and what is left to compile is arithmetic on arrays of
lanes, which XLA fuses into a few passes. Equations that have no rule here go through `vmap`.
"""

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun
from jaxtyping import Array, PyTree

from .lane_forms import AbstractForm, Coordinates, LanesLast, aval, is_short

# Beyond these, what is written out in coordinates takes long to compile.
_MOST_NUMBERS = 1024
_MOST_ROWS = 4
# A matrix of so many, which all lanes share, is not written out.
_LEAST_WEIGHTS = 16


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
            few = _count_numbers(closed.jaxpr) <= _MOST_NUMBERS
            form = Coordinates() if few else LanesLast()
            lanes = arrays[0].shape[-1]
            values = _evaluate(closed, [form.split(array) for array in arrays], form, lanes)
            results = [form.join(value, lanes) for value in values]
            return jax.tree.unflatten(jax.tree.structure(out), results)

        return over

    return decorate


def over_points(function: Callable) -> Callable[..., Any]:
    """`jax.vmap(function)`, over the first axis of all arguments, written out: for functions of a
    user's at more points than run side by side elsewhere. XLA's CPU compiler (JAX 0.10.2) leaves
    all but the first 32,768 numbers of some reductions uncomputed, of which a model may have
    several for each point, as in a sum of features."""

    def over(*args):
        last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), args)
        made = over_lanes(*len(args) * [-1])(function)(*last)
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), made)

    return over


def hold(tree: PyTree[Array]) -> PyTree[Array]:
    """The numbers of a point as values of their own, which a compiler computes once however many
    functions read them. Where lanes are written out, the numbers of a lane pass through one product
    with the identity, in which 0 · ∞ is NaN: they pass as halves, ∞ as the least power of two of
    which the double is infinite."""

    def finite(array):
        most = 2.0 ** (jnp.finfo(array.dtype).maxexp - 1)
        return jnp.clip(array / 2, -most, most)

    held = lax.optimization_barrier(jax.tree.map(finite, tree))
    return jax.tree.map(lambda array: 2 * array, held)


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


def _axes_of_leaves(in_axes: Sequence[PyTree], args: Sequence[PyTree]) -> list[int | None]:
    def spread(axis, part):
        return [axis] * len(jax.tree.leaves(part))

    is_none = lambda axis: axis is None
    axes = jax.tree.map(spread, tuple(in_axes), tuple(args), is_leaf=is_none)
    return jax.tree.leaves(axes, is_leaf=is_none)


def _inner(equation: JaxprEqn) -> ClosedJaxpr | None:
    """The body of a call that is no more than its body."""
    return equation.params["jaxpr"] if equation.primitive.name in ("jit", "pjit") else None


def _count_numbers(jaxpr: Jaxpr) -> int | float:
    """How many numbers the function computes in one lane; without end where some array is empty,
    of which coordinates know nothing."""

    def of(equation: JaxprEqn) -> int | float:
        inner, name = _inner(equation), equation.primitive.name
        if any(0 in aval(atom).shape for atom in (*equation.invars, *equation.outvars)):
            return math.inf
        if inner is not None:
            return _count_numbers(inner.jaxpr)
        if name in Coordinates.moves:
            return 0
        counted = equation.invars if name in _REDUCTIONS else equation.outvars
        numbers = sum(math.prod(aval(atom).shape) for atom in counted)
        if name == "dot_general":
            (axes, _), _ = equation.params["dimension_numbers"]
            numbers *= math.prod(aval(equation.invars[0]).shape[axis] for axis in axes)
        return numbers

    return sum(map(of, jaxpr.eqns))


def _evaluate(closed: ClosedJaxpr, args: Sequence, form: AbstractForm, lanes: int) -> list:
    jaxpr = closed.jaxpr
    values: dict[Var, Any] = dict(zip(jaxpr.constvars, closed.consts, strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))

    def read(atom):
        if isinstance(atom, Literal):
            return np.asarray(atom.val, aval(atom).dtype)
        return values[atom]

    for equation in jaxpr.eqns:
        operands = [read(atom) for atom in equation.invars]
        results = _apply(jaxpr, equation, operands, form, lanes)
        values.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _apply(
    jaxpr: Jaxpr, equation: JaxprEqn, operands: list, form: AbstractForm, lanes: int
) -> list:
    name, params = equation.primitive.name, equation.params
    if not any(map(form.is_own, operands)):
        function, operands = _alone(jaxpr, equation, operands)
        return function(*operands)
    inner = _inner(equation)
    if inner is not None:
        return _evaluate(inner, operands, form, lanes)
    if name in _ELEMENTWISE:
        return [form.elementwise(equation, operands)]
    if name in form.moves:
        return form.moved(equation, operands)
    if name in _REDUCTIONS and is_short(equation, params["axes"]):
        return [form.reduced(_REDUCTIONS[name], operands[0], params["axes"])]
    if name == "dot_general" and _is_plain(equation) and not _is_layer(equation, operands, form):
        return [form.product(equation, *operands)]
    if name == "optimization_barrier":
        return _held(operands, form, lanes)
    if name == "scan" and _is_plain_loop(equation):
        return _repeat(equation, operands, form, lanes)
    return _by_vmap(jaxpr, equation, operands, form, lanes)


def _held(operands: list, form: AbstractForm, lanes: int) -> list:
    """The operands as values of their own, those of them that are of one floating dtype. XLA's CPU
    compiler drops barriers before it fuses, and then computes a function of a function's value
    anew for each number that the outer one reads; through a product of matrices it does not fuse,
    and I x is x. It is linear, for what is held may be tangents; infinite numbers are the affair of
    `hold`."""
    arrays = [form.join(operand, lanes) if form.is_own(operand) else None for operand in operands]
    floats = [a for a in arrays if a is not None and jnp.issubdtype(a.dtype, jnp.floating)]
    alike = [a for a in floats if a.dtype == floats[0].dtype]
    if not alike:
        return operands

    def times_identity(*arrays):
        rows = jnp.concatenate([array.reshape(-1, lanes) for array in arrays])
        rows = jnp.dot(jnp.eye(len(rows), dtype=rows.dtype), rows)
        each = jnp.split(rows, np.cumsum([array.size // lanes for array in arrays])[:-1])
        return tuple(row.reshape(array.shape) for row, array in zip(each, arrays, strict=True))

    def barrier(*arrays):
        return lax.optimization_barrier(arrays)

    held = iter(lax.platform_dependent(*alike, cpu=times_identity, default=barrier))
    return [
        form.split(next(held)) if any(array is other for other in alike) else operand
        for operand, array in zip(operands, arrays, strict=True)
    ]


class _Loop(NamedTuple):
    """A loop of known length: its body, and how many operands it reads as constants, carries from
    step to step, and takes a slice of in each step; and how many results it stacks."""

    body: ClosedJaxpr
    length: int
    num_consts: int
    num_carried: int
    num_read: int
    num_stacked: int


def _loop(equation: JaxprEqn) -> _Loop:
    """What a `scan` is, by its shapes: what is read or stacked has an axis more than in the body.
    (How its parameters say so changes with JAX's versions.)"""
    body = equation.params["jaxpr"]
    num_read, num_stacked = (
        sum(aval(a).ndim > aval(b).ndim for a, b in zip(outside, inside, strict=True))
        for outside, inside in (
            (equation.invars, body.jaxpr.invars),
            (equation.outvars, body.jaxpr.outvars),
        )
    )
    num_carried = len(equation.outvars) - num_stacked
    num_consts = len(equation.invars) - num_carried - num_read
    return _Loop(body, equation.params["length"], num_consts, num_carried, num_read, num_stacked)


def _is_plain_loop(equation: JaxprEqn) -> bool:
    """Whether it is a loop of known length whose steps have no inputs or outputs of their own."""
    loop = _loop(equation)
    return loop.num_read == loop.num_stacked == 0


def _repeat(equation: JaxprEqn, operands: list, form: AbstractForm, lanes: int) -> list:
    loop = _loop(equation)
    consts, init = operands[: loop.num_consts], operands[loop.num_consts :]

    def step(_, arrays):
        carry = _evaluate(loop.body, [*consts, *map(form.split, arrays)], form, lanes)
        return [form.join(value, lanes) for value in carry]

    arrays = lax.fori_loop(0, loop.length, step, [form.join(value, lanes) for value in init])
    return list(map(form.split, arrays))


def _is_plain(equation: JaxprEqn) -> bool:
    """Whether it is a short sum of outer products."""
    (axes, _), batched = equation.params["dimension_numbers"]
    return not any(batched) and len(axes) == 1 and is_short(equation, axes)


def _is_layer(equation: JaxprEqn, operands: list, form: AbstractForm) -> bool:
    """Whether it takes a vector through a matrix that lanes share and that is large, as in a layer
    of a network: for all lanes that is one product of two matrices, as are its derivatives, where
    what is written out has a term for each weight."""
    shared = [operand for operand in operands if not form.is_own(operand)]
    return len(shared) == 1 and np.size(shared[0]) >= _LEAST_WEIGHTS


def _by_vmap(
    jaxpr: Jaxpr, equation: JaxprEqn, operands: list, form: AbstractForm, lanes: int
) -> list:
    function, operands = _alone(jaxpr, equation, operands)
    own = [form.is_own(operand) for operand in operands]
    arrays = [
        form.join(operand, lanes) if mine else operand
        for operand, mine in zip(operands, own, strict=True)
    ]
    results = jax.vmap(function, [-1 if mine else None for mine in own], -1)(*arrays)
    return [form.split(result) for result in results]


def _alone(jaxpr: Jaxpr, equation: JaxprEqn, operands: list) -> tuple[Callable[..., list], list]:
    """The equation as a function by itself, and its arguments."""
    own = {
        atom: operand
        for atom, operand in zip(equation.invars, operands, strict=True)
        if not isinstance(atom, Literal)
    }
    alone = jaxpr.replace(constvars=[], invars=list(own), outvars=equation.outvars, eqns=[equation])
    return jaxpr_as_fun(ClosedJaxpr(alone, [])), list(own.values())


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
