"""Traced values that user functions close over, passed as arguments of our programs.

JAX drops the tangents of values that a function with a custom derivative rule (`jax.custom_jvp`)
closes over: its derivative with respect to them would be zero. Public functions therefore find such
values and pass them as leaves of `Captured`, the object that holds the user's functions. They are
then treated like `params`.

Values are found when a function is evaluated: the jaxpr of the function lists them as constants.
The first function with unknown constants ends the attempt, and the public function runs again with
these values passed along. Outside of transformations there are no traced values, and nothing is
done.
"""

import contextvars
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.extend
import numpy as np
from jaxtyping import PyTree

from .checks import without_derivatives

_ARRAYS = (jax.Array, np.ndarray)
_MOST_ATTEMPTS = 64  # each attempt adds the captured values of one function


class Captured:
    """Functions of one object and the traced values that they close over, as a pytree.

    - `functions`: static, compared by identity or by their own equality.
    - `ids`: identities of the tracers in the closures, one for each of `values`.
    - `values`: replacements of these tracers.
    - `context`: the call that found them. Derivative rules may run after this call has ended.
    """

    functions: tuple[Callable, ...]
    ids: tuple[int, ...]
    values: tuple[Any, ...]
    context: "_CallContext | None"

    # A plain class: every call flattens it, and an `eqx.Module` is slower to flatten.
    __slots__ = ("context", "functions", "ids", "values")

    def __init__(self, *functions: Callable | None):
        self.functions = tuple(function for function in functions if function is not None)
        context = _context.get()
        tracers = {} if context is None else context.tracers_of(self.functions)
        self.ids, self.values = tuple(tracers), tuple(tracers.values())
        self.context = context if tracers else None

    # Equality is by content: models with the same functions share one compiled program.
    def __eq__(self, other: object) -> bool:
        return isinstance(other, Captured) and self._identity == other._identity

    def __hash__(self) -> int:
        return hash(self._identity)

    @property
    def _identity(self) -> tuple:
        # Comparing traced values would give a traced Boolean: compare their identities.
        return self.functions, self.ids, tuple(map(id, self.values)), self.context

    def with_values_of(self, context: "_CallContext") -> "Captured":
        """Return the same functions, with all values that `context` has found in their closures.

        Values that were passed along before stay as they are.
        """
        tracers = context.tracers_of(self.functions)
        if not tracers.keys() - set(self.ids):
            return self
        # Of two values for one tracer, the right operand wins: the one passed along before.
        values = tracers | dict(zip(self.ids, self.values, strict=True))
        return _from_parts((self.functions, tuple(values), context), tuple(values.values()))

    def call(self, function: Callable, *args: PyTree, plain: Callable | None = None) -> Any:
        """Evaluate one of the functions with `values` in place of the tracers that it closes over.

        Outside of transformations, call `plain` instead if it is given.
        """
        context = self.context if self.values else _context.get()
        if context is None:
            return (plain or function)(*args)
        values = dict(zip(self.ids, self.values, strict=True))
        return context.closed(function, args).evaluate(function, values, args)


def _to_parts(captured: Captured) -> tuple[tuple, tuple]:
    """Flatten a `Captured` into its values (leaves) and its static parts."""
    return captured.values, (captured.functions, captured.ids, captured.context)


def _from_parts(static: tuple, values: Any) -> Captured:
    """Build a `Captured` from its static parts and its values, without a search for tracers."""
    captured = object.__new__(Captured)
    captured.functions, captured.ids, captured.context = static
    captured.values = values
    return captured


jax.tree_util.register_pytree_node(Captured, _to_parts, _from_parts)


class _Closed:
    """Jaxpr of a function, with the tracers among its constants."""

    def __init__(self, function: Callable, args: tuple):
        leaves, structure = jax.tree.flatten(args)
        arrays = [leaf if isinstance(leaf, _ARRAYS) else None for leaf in leaves]
        statics = []

        def call_with_arrays(arrays):
            merged = [a if a is not None else b for a, b in zip(arrays, leaves, strict=True)]
            dynamic, static = eqx.partition(
                function(*jax.tree.unflatten(structure, merged)), eqx.is_array
            )
            statics.append(static)  # JAX can return arrays only, so the others leave this way
            return dynamic

        with _context_set(None):  # nested functions must appear in this jaxpr as they are
            self.jaxpr, shapes = jax.make_jaxpr(call_with_arrays, return_shape=True)(arrays)
        self.structure, self.static = jax.tree.structure(shapes), statics[-1]
        self.tracers = {id(c): c for c in self.jaxpr.consts if isinstance(c, jax.core.Tracer)}

    def evaluate(self, function: Callable, values: dict[int, Any], args: tuple) -> Any:
        """Evaluate the jaxpr with `values`, by identity of the tracers that they replace.

        **Raises:** `_UnknownTracers` if a tracer among the constants has no value.
        """
        unknown = {key: c for key, c in self.tracers.items() if key not in values}
        if unknown:
            raise _UnknownTracers(function, unknown)
        consts = [_like(values.get(id(const), const), const) for const in self.jaxpr.consts]
        closed = jax.extend.core.ClosedJaxpr(self.jaxpr.jaxpr, consts)
        arrays = [leaf for leaf in jax.tree.leaves(args) if isinstance(leaf, _ARRAYS)]
        out = jax.extend.core.jaxpr_as_fun(closed)(*arrays)
        return eqx.combine(jax.tree.unflatten(self.structure, out), self.static)


def _like(value: Any, const: Any) -> Any:
    """Convert a value to the dtype of the constant that it replaces.

    The dtypes differ because distributions are cast to the dtype of their points.
    """
    return value if value.dtype == const.dtype else value.astype(const.dtype)


class _CallContext:
    """One call of a public function under a transformation, with the closures found so far."""

    def __init__(self):
        self._tracers: dict[Callable, dict[int, Any]] = {}
        self._closed: dict[Any, _Closed] = {}

    def add(self, function: Callable, tracers: dict[int, Any]) -> None:
        """Store tracers that were found in the closure of a function."""
        self._tracers.setdefault(function, {}).update(tracers)

    def tracers_of(self, functions: tuple[Callable, ...]) -> dict[int, Any]:
        """Return the tracers in the closures of these functions, by identity."""
        if not self._tracers:
            return {}
        return {k: c for fn in functions for k, c in self._tracers.get(fn, {}).items()}

    def closed(self, function: Callable, args: tuple) -> _Closed:
        """Return the jaxpr of the function for arguments of these types, traced once."""
        leaves, structure = jax.tree.flatten(args)
        avals = tuple(
            jax.typeof(leaf) if isinstance(leaf, _ARRAYS) else (type(leaf), leaf) for leaf in leaves
        )
        key = (function, structure, avals)
        if key not in self._closed:
            self._closed[key] = _Closed(function, args)
        return self._closed[key]


def without_captured_derivatives(tree: PyTree) -> PyTree:
    """Return the tree with the derivatives of all captured values stopped."""
    return jax.tree.map(
        lambda node: without_derivatives(node) if isinstance(node, Captured) else node,
        tree,
        is_leaf=lambda node: isinstance(node, Captured),
    )


class _UnknownTracers(BaseException):
    """Signal that a function closes over tracers that are not passed along yet.

    It is not an error: it derives from `BaseException` so that no handler of errors catches it.
    """

    def __init__(self, function: Callable, tracers: dict[int, Any]):
        super().__init__()
        self.function, self.tracers = function, tracers


_context: contextvars.ContextVar[_CallContext | None] = contextvars.ContextVar(
    "context", default=None
)


class _context_set:
    """Context manager that sets the current call of a public function, and resets it."""

    def __init__(self, context: _CallContext | None):
        self.context = context

    def __enter__(self):
        self.token = _context.set(self.context)

    def __exit__(self, *_):
        _context.reset(self.token)


def call_with_captured(fn: Callable, args: tuple, kwargs: dict[str, Any]) -> Any:
    """Return `fn(*args, **kwargs)` under a transformation, with captured values passed along.

    **Raises:** `TypeError` if the values do not suffice after 64 attempts.
    """
    if _context.get() is not None:  # a public function inside another: the outer call handles it
        return fn(*args, **kwargs)
    context = _CallContext()
    for _ in range(_MOST_ATTEMPTS):
        full_args, full_kwargs = jax.tree.map(
            lambda node: node.with_values_of(context) if isinstance(node, Captured) else node,
            (args, kwargs),
            is_leaf=lambda node: isinstance(node, Captured),
        )
        with _context_set(context):
            try:
                return fn(*full_args, **full_kwargs)
            except _UnknownTracers as unknown:
                context.add(unknown.function, unknown.tracers)
    raise TypeError(
        "A function of the model, the observation model or the prior closes over traced values "
        "that could not be passed to the compiled program, so derivatives with respect to them "
        "would be wrong. Pass these values through `params` instead."
    )
