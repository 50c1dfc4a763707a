"""Values that the functions of the user close over, as arguments of our programs.

JAX drops the tangents of what a function with a derivative rule of its own (`jax.custom_jvp`)
closes over: such a derivative would be zero. So a public function that is called while a caller's
program is traced or differentiated finds the traced values that the user's functions close over,
and passes them along as leaves of the object that holds these functions (`Captured`), exactly like
`params`.

They are found where a function is evaluated: its jaxpr lists them as constants. The first one that
is unknown ends the attempt, and the public function is run again with that value passed along.
Outside of transformations there are no traced values, and nothing is done.
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
_MOST_ATTEMPTS = 64


class Captured:
    """The functions of one object, and the traced values that they close over, as a pytree: a
    plain one, for it is taken apart in every call.

    - `functions`: static, compared by identity or by their own equality.
    - `ids`: of the tracers in the closures, one for each of `values`.
    - `values`: what is used in the place of these tracers.
    - `entry`: the call in which they were found. Rules of derivatives may run after it.
    """

    functions: tuple[Callable, ...]
    ids: tuple[int, ...]
    values: tuple[Any, ...]
    entry: "_Entry | None"

    __slots__ = ("entry", "functions", "ids", "values")

    def __init__(self, *functions: Callable | None):
        self.functions = tuple(function for function in functions if function is not None)
        entry = _entry.get()
        tracers = {} if entry is None else entry.tracers_of(self.functions)
        self.ids, self.values = tuple(tracers), tuple(tracers.values())
        self.entry = entry if tracers else None

    # Models are compared, so that the functions of transformed ones compile once.
    def __eq__(self, other: object) -> bool:
        return isinstance(other, Captured) and self._identity == other._identity

    def __hash__(self) -> int:
        return hash(self._identity)

    @property
    def _identity(self) -> tuple:
        return self.functions, self.ids, tuple(map(id, self.values)), self.entry

    def known_to(self, entry: "_Entry") -> "Captured":
        """The same functions with all values that are known to be in their closures. Values that
        were passed along before are kept."""
        found = entry.tracers_of(self.functions)
        if not found.keys() - set(self.ids):
            return self
        values = found | dict(zip(self.ids, self.values, strict=True))
        return _made((self.functions, tuple(values), entry), tuple(values.values()))

    def call(self, function: Callable, *args: PyTree, plain: Callable | None = None) -> Any:
        """The value of one of the functions, with `values` in the place of what it closes over;
        `plain` computes it outside of transformations."""
        entry = self.entry if self.values else _entry.get()
        if entry is None:
            return (plain or function)(*args)
        values = dict(zip(self.ids, self.values, strict=True))
        return entry.closed(function, args).evaluate(function, values, args)


def _parts(captured: Captured) -> tuple[tuple, tuple]:
    return captured.values, (captured.functions, captured.ids, captured.entry)


def _made(static: tuple, values: Any) -> Captured:
    made = object.__new__(Captured)
    made.functions, made.ids, made.entry = static
    made.values = values
    return made


jax.tree_util.register_pytree_node(Captured, _parts, _made)


class _Closed:
    """A jaxpr of a function, and the tracers among its constants."""

    def __init__(self, function: Callable, args: tuple):
        leaves, structure = jax.tree.flatten(args)
        arrays = [leaf if isinstance(leaf, _ARRAYS) else None for leaf in leaves]
        statics = []

        def of_arrays(arrays):
            filled = [a if a is not None else b for a, b in zip(arrays, leaves, strict=True)]
            dynamic, static = eqx.partition(
                function(*jax.tree.unflatten(structure, filled)), eqx.is_array
            )
            statics.append(static)
            return dynamic

        with _entered(None):
            self.jaxpr, shapes = jax.make_jaxpr(of_arrays, return_shape=True)(arrays)
        self.structure, self.static = jax.tree.structure(shapes), statics[-1]
        self.tracers = {id(c): c for c in self.jaxpr.consts if isinstance(c, jax.core.Tracer)}

    def evaluate(self, function: Callable, values: dict[int, Any], args: tuple) -> Any:
        unknown = {key: c for key, c in self.tracers.items() if key not in values}
        if unknown:
            raise _Unknown(function, unknown)
        consts = [_like(values.get(id(const), const), const) for const in self.jaxpr.consts]
        closed = jax.extend.core.ClosedJaxpr(self.jaxpr.jaxpr, consts)
        arrays = [leaf for leaf in jax.tree.leaves(args) if isinstance(leaf, _ARRAYS)]
        out = jax.extend.core.jaxpr_as_fun(closed)(*arrays)
        return eqx.combine(jax.tree.unflatten(self.structure, out), self.static)


def _like(value: Any, const: Any) -> Any:
    """The value in the precision of the constant: laws are cast to that of their points."""
    return value if value.dtype == const.dtype else value.astype(const.dtype)


class _Entry:
    """One call of a public function under a transformation: what is known of closures."""

    def __init__(self):
        self._tracers: dict[Callable, dict[int, Any]] = {}
        self._closed: dict[Any, _Closed] = {}

    def add(self, function: Callable, tracers: dict[int, Any]) -> None:
        self._tracers.setdefault(function, {}).update(tracers)

    def tracers_of(self, functions: tuple[Callable, ...]) -> dict[int, Any]:
        """The tracers in the closures of these functions, each once."""
        if not self._tracers:
            return {}
        return {k: c for fn in functions for k, c in self._tracers.get(fn, {}).items()}

    def closed(self, function: Callable, args: tuple) -> _Closed:
        """The jaxpr for arguments of these shapes, traced once."""
        leaves, structure = jax.tree.flatten(args)
        avals = tuple(
            jax.typeof(leaf) if isinstance(leaf, _ARRAYS) else (type(leaf), leaf) for leaf in leaves
        )
        key = (function, structure, avals)
        if key not in self._closed:
            self._closed[key] = _Closed(function, args)
        return self._closed[key]


def without_captured_derivatives(tree: PyTree) -> PyTree:
    """The tree, in which what functions close over has no derivatives."""
    return jax.tree.map(
        lambda node: without_derivatives(node) if isinstance(node, Captured) else node,
        tree,
        is_leaf=lambda node: isinstance(node, Captured),
    )


class _Unknown(BaseException):
    """A function closes over tracers that are not passed along: no error, and not to be handled
    like one."""

    def __init__(self, function: Callable, tracers: dict[int, Any]):
        super().__init__()
        self.function, self.tracers = function, tracers


_entry: contextvars.ContextVar[_Entry | None] = contextvars.ContextVar("entry", default=None)


class _entered:
    """Sets the entry, and resets it."""

    def __init__(self, entry: _Entry | None):
        self.entry = entry

    def __enter__(self):
        self.token = _entry.set(self.entry)

    def __exit__(self, *_):
        _entry.reset(self.token)


def call_with_captured(fn: Callable, args: tuple, kwargs: dict[str, Any]) -> Any:
    """`fn(*args, **kwargs)` under a transformation, with everything that functions of the user
    close over passed along.

    **Raises:** `TypeError` where that can not be done.
    """
    if _entry.get() is not None:
        return fn(*args, **kwargs)
    entry = _Entry()
    for _ in range(_MOST_ATTEMPTS):
        known_args, known_kwargs = jax.tree.map(
            lambda node: node.known_to(entry) if isinstance(node, Captured) else node,
            (args, kwargs),
            is_leaf=lambda node: isinstance(node, Captured),
        )
        with _entered(entry):
            try:
                return fn(*known_args, **known_kwargs)
            except _Unknown as unknown:
                entry.add(unknown.function, unknown.tracers)
    raise TypeError(
        "a function of the model, of the observation or of the prior closes over a traced value "
        "that could not be followed: a derivative in it would be wrong. Pass this value in "
        "`params`."
    )
