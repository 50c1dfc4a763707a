"""Evaluation of functions of one point in many lanes, written out in the point's coordinates.

`jax.vmap` puts the lanes first wherever a number meets a vector. States are then interleaved lane
by lane, and loops over time do not vectorise. Here, a function of one small point is traced. Its
equations are evaluated one by one with lanes last: coordinate by coordinate for few numbers, else
array by array (`lane_forms`).

Short sums and products of matrices are written out. Only arithmetic on arrays of lanes remains,
which XLA fuses into a few passes. Equations without a rule here use `vmap`.
"""

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun
from jaxtyping import Array, Bool, PyTree

from .lane_forms import AbstractForm, Coordinates, LanesLast, aval, is_short

# Larger functions and points take long to compile when they are written out in coordinates.
_MOST_NUMBERS = 1024
_MOST_ROWS = 4
# A shared matrix of so many entries multiplies all lanes at once instead.
_LEAST_WEIGHTS = 16


def over_lanes(*in_axes: PyTree) -> Callable[[Callable], Callable[..., Any]]:
    """Apply a function of one point in all lanes: `jax.vmap` with lanes in the last axis.

    `in_axes` has one entry for each argument, or a tree of entries for its parts: -1 for values
    with lanes, `None` for values that all lanes share.
    """

    def decorate(function: Callable) -> Callable[..., Any]:
        def apply(*args):
            leaves, treedef = jax.tree.flatten(args)
            has_lanes = [axis is not None for axis in _axes_of_leaves(in_axes, args)]

            def call_at_point(*values):
                values = iter(values)
                merged = [
                    next(values) if with_lanes else leaf
                    for leaf, with_lanes in zip(leaves, has_lanes, strict=True)
                ]
                return function(*jax.tree.unflatten(treedef, merged))

            # Shared values are closed over, so that they stay constants of the jaxpr.
            arrays = [
                leaf for leaf, with_lanes in zip(leaves, has_lanes, strict=True) if with_lanes
            ]
            points = [jax.ShapeDtypeStruct(array.shape[:-1], array.dtype) for array in arrays]
            closed, out = jax.make_jaxpr(call_at_point, return_shape=True)(*points)
            is_small = _count_numbers(closed.jaxpr) <= _MOST_NUMBERS
            form = Coordinates() if is_small else LanesLast()
            lanes = arrays[0].shape[-1]
            values = _evaluate(closed, [form.split(array) for array in arrays], form, lanes)
            results = [form.join(value, lanes) for value in values]
            return jax.tree.unflatten(jax.tree.structure(out), results)

        return apply

    return decorate


def over_points(function: Callable) -> Callable[..., Any]:
    """Apply a function to points along the first axis of all arguments, as `jax.vmap(function)`.

    Use it for user functions at many points: XLA's CPU compiler (JAX 0.10.2) computes only the
    first 32,768 numbers of some reductions. A model may contain several such reductions for each
    point, for example a sum of features.
    """

    def apply(*args):
        lanes_last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), args)
        results = over_lanes(*len(args) * [-1])(function)(*lanes_last)
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), results)

    return apply


def compute_once(tree: PyTree[Array]) -> PyTree[Array]:
    """Make the compiler compute the numbers of a point once, however many functions read them.

    In lanes, the numbers pass through a product with the identity (`_held`), where 0 · ∞ is NaN.
    They pass as halves, and ±∞ passes as the least power of two whose double is infinite.
    """

    def finite(array):
        # The bound doubles to infinity, so the doubling below restores ±∞.
        largest = 2.0 ** (jnp.finfo(array.dtype).maxexp - 1)
        return jnp.clip(array / 2, -largest, largest)

    held = lax.optimization_barrier(jax.tree.map(finite, tree))
    return jax.tree.map(lambda array: 2 * array, held)


@custom_vmap
def in_any_lane(condition: Bool[Array, ""]) -> Bool[Array, ""]:
    """Return the condition; under `vmap`, return whether it holds in any lane.

    A `lax.cond` on the result remains a branch under `vmap`, instead of computing both sides.
    """
    return condition


@in_any_lane.def_vmap
def _in_any_lane_of_batch(axis_size, in_batched, condition):
    return in_any_lane(jnp.any(condition)), False  # there may be an outer `vmap`


class Rows(tuple[Array, ...]):
    """Rows of an array as separate arrays, for the state of a compiled loop.

    Each step would otherwise write the rows into one array, element by element.
    """


jax.tree_util.register_pytree_node(Rows, lambda rows: (rows, None), lambda _, rows: Rows(rows))


def split_rows(tree: PyTree, axis: int = 0) -> PyTree:
    """Convert arrays of points to `Rows`, with coordinates in `axis` and lanes in the next, last
    axis.

    Other arrays and points of more than four coordinates stay as they are.
    """

    def split(leaf):
        if leaf.ndim != axis + 2 or leaf.shape[axis] > _MOST_ROWS:
            return leaf
        return Rows(jnp.moveaxis(leaf, axis, 0))

    return jax.tree.map(split, tree)


def join_rows(tree: PyTree, axis: int = 0) -> PyTree:
    """Convert all `Rows` back to arrays, the inverse of `split_rows`."""
    are_rows = lambda leaf: isinstance(leaf, Rows)
    return jax.tree.map(
        lambda leaf: jnp.stack(leaf, axis) if are_rows(leaf) else leaf, tree, is_leaf=are_rows
    )


def _axes_of_leaves(in_axes: Sequence[PyTree], args: Sequence[PyTree]) -> list[int | None]:
    """Return the lane axis of each leaf of the arguments, from one axis for each part of them."""

    def repeat_axis(axis, part):
        return [axis] * len(jax.tree.leaves(part))

    is_none = lambda axis: axis is None
    axes = jax.tree.map(repeat_axis, tuple(in_axes), tuple(args), is_leaf=is_none)
    return jax.tree.leaves(axes, is_leaf=is_none)


def _inner(equation: JaxprEqn) -> ClosedJaxpr | None:
    """Return the jaxpr that a `jit` equation calls, or `None` for other equations."""
    return equation.params["jaxpr"] if equation.primitive.name in ("jit", "pjit") else None


def _count_numbers(jaxpr: Jaxpr) -> int | float:
    """Count the numbers that the function computes in one lane.

    The count is infinite if an array is empty, because `Coordinates` cannot represent it.
    """

    def count_in(equation: JaxprEqn) -> int | float:
        inner, name = _inner(equation), equation.primitive.name
        if any(0 in aval(atom).shape for atom in (*equation.invars, *equation.outvars)):
            return math.inf
        if inner is not None:
            return _count_numbers(inner.jaxpr)
        if name in Coordinates.moves:  # happens while tracing
            return 0
        counted = equation.invars if name in _REDUCTIONS else equation.outvars
        numbers = sum(math.prod(aval(atom).shape) for atom in counted)
        if name == "dot_general":
            (axes, _), _ = equation.params["dimension_numbers"]
            numbers *= math.prod(aval(equation.invars[0]).shape[axis] for axis in axes)
        return numbers

    return sum(map(count_in, jaxpr.eqns))


def _evaluate(closed: ClosedJaxpr, args: Sequence, form: AbstractForm, lanes: int) -> list:
    """Evaluate a jaxpr with arguments in this form; return its results."""
    jaxpr = closed.jaxpr
    values: dict[Var, Any] = dict(zip(jaxpr.constvars, closed.consts, strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))

    def read(atom):
        if isinstance(atom, Literal):
            return np.asarray(atom.val, aval(atom).dtype)  # `val` may be a Python number
        return values[atom]

    for equation in jaxpr.eqns:
        operands = [read(atom) for atom in equation.invars]
        results = _apply(jaxpr, equation, operands, form, lanes)
        values.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _apply(
    jaxpr: Jaxpr, equation: JaxprEqn, operands: list, form: AbstractForm, lanes: int
) -> list:
    """Evaluate one equation by the first rule that applies."""
    name, params = equation.primitive.name, equation.params
    if not any(map(form.is_own, operands)):  # the same for all lanes: computed once
        function, operands = _as_function(jaxpr, equation, operands)
        return function(*operands)
    inner = _inner(equation)
    if inner is not None:
        return _evaluate(inner, operands, form, lanes)
    if name in _ELEMENTWISE:
        return [form.elementwise(equation, operands)]
    if name in form.moves:
        return form.move_entries(equation, operands)
    if name in _REDUCTIONS and is_short(equation, params["axes"]):
        return [form.reduce_axes(_REDUCTIONS[name], operands[0], params["axes"])]
    if name == "dot_general" and _is_plain(equation) and not _is_layer(equation, operands, form):
        return [form.product(equation, *operands)]
    if name == "optimization_barrier":
        return _held(operands, form, lanes)
    if name == "scan" and _is_plain_loop(equation):
        return _repeat(equation, operands, form, lanes)
    return _by_vmap(jaxpr, equation, operands, form, lanes)


def _held(operands: list, form: AbstractForm, lanes: int) -> list:
    """Keep the operands of one floating dtype from being recomputed by their readers.

    XLA's CPU compiler drops optimisation barriers before it fuses. It then recomputes an inner
    function for each number that the outer function reads. It does not fuse through a product of
    matrices, and I x = x.

    The product is linear in x, so that it also holds tangents. Infinite numbers are made finite
    beforehand, by `compute_once`.
    """
    arrays = [form.join(operand, lanes) if form.is_own(operand) else None for operand in operands]
    floats = [a for a in arrays if a is not None and jnp.issubdtype(a.dtype, jnp.floating)]
    same_dtype = [a for a in floats if a.dtype == floats[0].dtype]
    if not same_dtype:
        return operands

    def times_identity(*arrays):
        rows = jnp.concatenate([array.reshape(-1, lanes) for array in arrays])
        rows = jnp.dot(jnp.eye(len(rows), dtype=rows.dtype), rows)
        parts = jnp.split(rows, np.cumsum([array.size // lanes for array in arrays])[:-1])
        return tuple(row.reshape(array.shape) for row, array in zip(parts, arrays, strict=True))

    def barrier(*arrays):
        return lax.optimization_barrier(arrays)

    held = iter(lax.platform_dependent(*same_dtype, cpu=times_identity, default=barrier))
    return [
        form.split(next(held))
        if any(array is float_array for float_array in same_dtype)
        else operand
        for operand, array in zip(operands, arrays, strict=True)
    ]


class _Loop(NamedTuple):
    """Loop of known length, with the number of its operands and results of each kind.

    - `body`: jaxpr of one step.
    - `num_consts`: operands that every step reads whole.
    - `num_carried`: operands that pass from step to step.
    - `num_read`: operands of which each step reads one slice.
    - `num_stacked`: results that stack one slice of each step.
    """

    body: ClosedJaxpr
    length: int
    num_consts: int
    num_carried: int
    num_read: int
    num_stacked: int


def _loop(equation: JaxprEqn) -> _Loop:
    """Return the structure of a `scan`, inferred from shapes.

    Arrays that are read or stacked slice by slice have one axis more outside than in the body. (The
    parameters of `scan` also state this, in a form that differs between releases of JAX.)
    """
    body = equation.params["jaxpr"]
    num_read, num_stacked = (
        sum(
            aval(outer).ndim > aval(inner).ndim
            for outer, inner in zip(outside, inside, strict=True)
        )
        for outside, inside in (
            (equation.invars, body.jaxpr.invars),
            (equation.outvars, body.jaxpr.outvars),
        )
    )
    num_carried = len(equation.outvars) - num_stacked
    num_consts = len(equation.invars) - num_carried - num_read
    return _Loop(body, equation.params["length"], num_consts, num_carried, num_read, num_stacked)


def _is_plain_loop(equation: JaxprEqn) -> bool:
    """Return whether a `scan` has only constants and a state, and no inputs or outputs of steps."""
    loop = _loop(equation)
    return loop.num_read == loop.num_stacked == 0


def _repeat(equation: JaxprEqn, operands: list, form: AbstractForm, lanes: int) -> list:
    """Evaluate a plain loop by `lax.fori_loop`, whose state has lanes in the last axis."""
    loop = _loop(equation)
    consts, init = operands[: loop.num_consts], operands[loop.num_consts :]

    def step(_, arrays):
        carry = _evaluate(loop.body, [*consts, *map(form.split, arrays)], form, lanes)
        return [form.join(value, lanes) for value in carry]

    # Written out, the body would appear once for each step.
    arrays = lax.fori_loop(0, loop.length, step, [form.join(value, lanes) for value in init])
    return list(map(form.split, arrays))


def _is_plain(equation: JaxprEqn) -> bool:
    """Return whether the product sums over one short axis and has no batch axes."""
    (axes, _), batched = equation.params["dimension_numbers"]
    return not any(batched) and len(axes) == 1 and is_short(equation, axes)


def _is_layer(equation: JaxprEqn, operands: list, form: AbstractForm) -> bool:
    """Return whether a product applies one large shared matrix in all lanes.

    A layer of a network is an example. For all lanes, this is one product of two matrices, and so
    are its derivatives. Written out, it would have one term for each weight.
    """
    shared = [operand for operand in operands if not form.is_own(operand)]
    return len(shared) == 1 and np.size(shared[0]) >= _LEAST_WEIGHTS


def _by_vmap(
    jaxpr: Jaxpr, equation: JaxprEqn, operands: list, form: AbstractForm, lanes: int
) -> list:
    """Evaluate one equation by `jax.vmap`, for primitives without a rule."""
    function, operands = _as_function(jaxpr, equation, operands)
    are_own = [form.is_own(operand) for operand in operands]
    arrays = [
        form.join(operand, lanes) if is_own else operand
        for operand, is_own in zip(operands, are_own, strict=True)
    ]
    results = jax.vmap(function, [-1 if is_own else None for is_own in are_own], -1)(*arrays)
    return [form.split(result) for result in results]


def _as_function(
    jaxpr: Jaxpr, equation: JaxprEqn, operands: list
) -> tuple[Callable[..., list], list]:
    """Return the equation as a function of its own, and its operands."""
    arguments = {
        atom: operand
        for atom, operand in zip(equation.invars, operands, strict=True)
        if not isinstance(atom, Literal)
    }
    jaxpr_of_equation = jaxpr.replace(
        constvars=[], invars=list(arguments), outvars=equation.outvars, eqns=[equation]
    )
    return jaxpr_as_fun(ClosedJaxpr(jaxpr_of_equation, [])), list(arguments.values())


_REDUCTIONS: dict[str, Callable] = {
    "reduce_and": operator.and_,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_or": operator.or_,
    "reduce_prod": operator.mul,
    "reduce_sum": operator.add,
}
_ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh bitcast_convert_type cbrt ceil "
    "clamp convert_element_type copy cos cosh digamma div eq erf erf_inv erfc exp exp2 expm1 floor "
    "ge gt integer_pow is_finite le lgamma log log1p logistic lt max min mul ne neg not or pow rem "
    "round rsqrt select_n shift_left shift_right_arithmetic sign sin sinh sqrt square "
    "stop_gradient sub tan tanh xor".split()
)
