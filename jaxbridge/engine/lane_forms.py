"""Two representations of a value that differs between lanes, with the operations on each.

- `Coordinates`: an array of Python objects, each of them one coordinate in all lanes. Indexing,
  stacking, transposing and broadcasting happen while tracing. Only arithmetic on arrays of lanes
  remains to be compiled. It suits functions of few numbers.
- `LanesLast`: an array with lanes in the last axis. It suits functions of more numbers, such as
  full matrices in higher dimension.
"""

import functools
import math
import operator
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, cast

import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import JaxprEqn, Literal, Var
from jaxtyping import Array, Shaped

# Longer sums take long to compile when they are written out.
_MOST_TERMS = 16


class AbstractForm:
    """Representation of values while a function of one point is evaluated in all lanes.

    `moves` maps primitives that only rearrange numbers to their implementations.
    """

    moves: ClassVar[dict[str, Callable]]

    @abstractmethod
    def split(self, array: Shaped[Array, "*shape lanes"]) -> Any:
        """Convert an array with lanes in the last axis to this form."""

    @abstractmethod
    def join(self, value: Any, num_lanes: int) -> Shaped[Array, "*shape lanes"]:
        """Convert a value to an array with lanes in the last axis; a shared value is repeated."""

    @abstractmethod
    def is_own(self, value: Any) -> bool:
        """Return whether the value differs between lanes, and so has this form."""

    @abstractmethod
    def elementwise(self, equation: JaxprEqn, operands: Sequence) -> Any:
        """Apply an elementwise operation to operands of one shape, or scalars such as bounds."""

    @abstractmethod
    def move_entries(self, equation: JaxprEqn, operands: Sequence) -> list:
        """Apply one of `moves`; return the list of its results."""

    @abstractmethod
    def reduce_axes(self, combine: Callable, value: Any, axes: Sequence) -> Any:
        """Reduce a value over some axes by `combine`, written out."""

    @abstractmethod
    def product(self, equation: JaxprEqn, left: Any, right: Any) -> Any:
        """Multiply two values and sum over one axis of each, written out."""


class Coordinates(AbstractForm):
    """Array of objects, one for each coordinate."""

    def split(self, array):
        return _objects(array.shape[:-1], lambda index: array[index])

    def join(self, value, num_lanes):
        if not self.is_own(value):
            return shared_by(value, num_lanes)
        rows = [jnp.broadcast_to(number, (num_lanes,)) for number in value.flat]
        return jnp.stack(rows).reshape(*value.shape, num_lanes) if value.ndim else rows[0]

    def is_own(self, value):
        return isinstance(value, np.ndarray) and value.dtype == object

    def elementwise(self, equation, operands):
        shape = aval(equation.outvars[0]).shape
        operands = [np.broadcast_to(self._all(operand), shape) for operand in operands]

        def entry(index):
            numbers = _of_one_shape([operand[index] for operand in operands])
            # One operation on an array of lanes for each coordinate: all that is compiled.
            return equation.primitive.bind(*numbers, **equation.params)

        return _objects(shape, entry)

    def move_entries(self, equation, operands):
        move = self.moves[equation.primitive.name]
        result = move(*map(self._all, operands), **equation.params)
        return result if isinstance(result, list) else [result]

    def reduce_axes(self, combine, value, axes):
        value = np.moveaxis(value, axes, range(len(axes)))
        remaining = value.shape[len(axes) :]
        rows = value.reshape(-1, *remaining)
        return _objects(remaining, lambda index: functools.reduce(combine, rows[:, *index]))

    def product(self, equation, left, right):
        result = aval(equation.outvars[0])
        axes, _ = equation.params["dimension_numbers"]
        left, right = (
            _objects(value.shape, lambda index, value=value: value[index].astype(result.dtype))
            for value in map(self._all, (left, right))
        )
        # NumPy multiplies and adds the objects, which are arrays of lanes.
        product = np.asarray(np.tensordot(left, right, axes), object)
        return _objects(result.shape, lambda index: product[index])

    def _all(self, value) -> np.ndarray:
        """Return the value in this form, also if all lanes share it."""
        if self.is_own(value):
            return value
        return _objects(np.shape(value), lambda index: value[index])

    moves: ClassVar[dict[str, Callable]] = {
        "broadcast_in_dim": lambda value, **params: _broadcast(value, **params),
        "concatenate": lambda *values, dimension: np.concatenate(values, dimension),
        "pad": lambda value, padding, **params: _pad(value, padding, **params),
        "reshape": lambda value, **params: _reshape(value, **params),
        "rev": lambda value, *, dimensions: np.flip(value, dimensions),
        "slice": lambda value, **params: value[_slices(**params)],
        "split": lambda value, *, sizes, axis: np.split(value, np.cumsum(sizes)[:-1], axis),
        "squeeze": lambda value, *, dimensions: value.squeeze(dimensions),
        "stack": lambda *values, axis: np.stack(values, axis),
        "transpose": lambda value, *, permutation: value.transpose(permutation),
        "unstack": lambda value, *, axis: [
            row.squeeze(axis) for row in np.split(value, value.shape[axis], axis)
        ],
    }


class _Lanes:
    """Array that has an axis of lanes; the type distinguishes it from arrays that lanes share."""

    def __init__(self, array: Shaped[Array, "*shape lanes"]):
        self.array = array


class LanesLast(AbstractForm):
    """Arrays with lanes in the last axis, of length one for shared values, which broadcast."""

    def split(self, array):
        return _Lanes(array)

    def join(self, value, num_lanes):
        if not self.is_own(value):
            return shared_by(value, num_lanes)
        return jnp.broadcast_to(value.array, (*value.array.shape[:-1], num_lanes))

    def is_own(self, value):
        return isinstance(value, _Lanes)

    def elementwise(self, equation, operands):
        arrays = _of_one_shape(list(map(self._array, operands)))
        return _Lanes(equation.primitive.bind(*arrays, **equation.params))

    def move_entries(self, equation, operands):
        move = self.moves[equation.primitive.name]
        result = move(*map(self._array, operands), **equation.params)
        return [_Lanes(part) for part in result] if isinstance(result, list) else [_Lanes(result)]

    def reduce_axes(self, combine, value, axes):
        array = jnp.moveaxis(value.array, axes, range(len(axes)))
        rows = array.reshape(-1, *array.shape[len(axes) :])
        return _Lanes(functools.reduce(combine, list(rows)))

    def product(self, equation, left, right):
        ((left_axis,), (right_axis,)), _ = equation.params["dimension_numbers"]
        dtype = aval(equation.outvars[0]).dtype
        lefts, rights = (
            list(jnp.moveaxis(self._array(value).astype(dtype), axis, 0))
            for value, axis in ((left, left_axis), (right, right_axis))
        )
        ones = [1] * (rights[0].ndim - 1)  # for the axes of the result that come from the right
        lefts = [row.reshape(*row.shape[:-1], *ones, row.shape[-1]) for row in lefts]
        products = [a * b for a, b in zip(lefts, rights, strict=True)]
        return _Lanes(functools.reduce(operator.add, products))

    def _array(self, value) -> Shaped[Array, "*shape lanes"]:
        """Return the array of the value, with an axis of length one if all lanes share it."""
        return value.array if self.is_own(value) else jnp.asarray(value)[..., None]

    moves: ClassVar[dict[str, Callable]] = {
        "broadcast_in_dim": lambda array, *, shape, broadcast_dimensions, **_: lax.broadcast_in_dim(
            array, (*shape, array.shape[-1]), (*broadcast_dimensions, len(shape))
        ),
        "concatenate": lambda *arrays, dimension: jnp.concatenate(_wide(arrays), dimension),
        "pad": lambda array, padding, **params: _pad_lanes(array, padding, **params),
        "reshape": lambda array, **params: _reshape(array, **params, num_last=1),
        "rev": lambda array, *, dimensions: jnp.flip(array, dimensions),
        "slice": lambda array, **params: array[_slices(**params)],
        "split": lambda array, *, sizes, axis: jnp.split(array, np.cumsum(sizes)[:-1], axis),
        "squeeze": lambda array, *, dimensions: array.squeeze(dimensions),
        "stack": lambda *arrays, axis: jnp.stack(_wide(arrays), axis),
        "transpose": lambda array, *, permutation: array.transpose(*permutation, array.ndim - 1),
        "unstack": lambda array, *, axis: list(jnp.moveaxis(array, axis, 0)),
    }


def aval(atom: Var | Literal) -> jax.core.ShapedArray:
    """Return the shape and dtype of a variable or literal of a jaxpr."""
    return cast(jax.core.ShapedArray, atom.aval)


def is_short(equation: JaxprEqn, axes: Sequence) -> bool:
    """Return whether a sum over these axes of the first operand is short enough to write out."""
    shape = aval(equation.invars[0]).shape
    return 0 < math.prod(shape[axis] for axis in axes) <= _MOST_TERMS


def shared_by(value, num_lanes: int) -> Shaped[Array, "*shape lanes"]:
    """Broadcast a shared value to all lanes."""
    return jnp.broadcast_to(jnp.asarray(value)[..., None], (*np.shape(value), num_lanes))


def _objects(shape: tuple[int, ...], entry: Callable[[tuple[int, ...]], Any]) -> np.ndarray:
    """Build the array of objects whose entries are `entry(index)`."""
    objects = np.empty(shape, object)
    for index in np.ndindex(shape):
        objects[index] = entry(index)
    return objects


def _of_one_shape(arrays: Sequence) -> list:
    """Broadcast the arrays to a common shape.

    `jnp.broadcast_arrays` would take longer to trace than the operation: this function runs for
    each coordinate of each operation.
    """
    shape = np.broadcast_shapes(*map(np.shape, arrays))

    def broadcast(array):
        if np.shape(array) == shape:
            return array
        return lax.broadcast_in_dim(array, shape, range(len(shape) - np.ndim(array), len(shape)))

    return list(map(broadcast, arrays))


def _broadcast(value, *, shape, broadcast_dimensions, **_):
    """Apply `lax.broadcast_in_dim` to an array of objects."""
    unit = np.ones(len(shape), int)
    unit[list(broadcast_dimensions)] = value.shape
    return np.broadcast_to(value.reshape(unit), shape)


def _reshape(value, *, new_sizes, dimensions=None, num_last=0, **_):
    """Reshape all but the last `num_last` axes, first permuted by `dimensions` if it is given."""
    last = range(value.ndim - num_last, value.ndim)
    if dimensions is not None:
        value = value.transpose(*dimensions, *last)
    return value.reshape(*new_sizes, *(value.shape[axis] for axis in last))


def _pad(value, padding, *, padding_config):
    """Apply `lax.pad` to an array of objects; negative widths cut entries off."""
    widths = [
        (max(int(low), 0), max(int(high), 0), max(size + (size - 1) * int(between), 0))
        for size, (low, high, between) in zip(value.shape, padding_config, strict=True)
    ]
    shape = tuple(low + size + high for low, high, size in widths)
    fill_value = padding.item()
    padded = _objects(shape, lambda _: fill_value)
    inside = [
        slice(low, low + size, between + 1)
        for (low, _, size), (_, _, between) in zip(widths, padding_config, strict=True)
    ]
    padded[tuple(inside)] = value
    # Negative widths remove entries, after interior padding.
    cut = [slice(max(-low, 0), min(high, 0) or None) for low, high, _ in padding_config]
    return padded[tuple(cut)]


def _pad_lanes(array, padding, *, padding_config):
    """Apply `lax.pad` to an array with lanes in the last axis; padding may differ between lanes."""

    def pad(value, fill_value):
        config = [*padding_config, *[(0, 0, 0)] * (value.ndim - len(padding_config))]
        return lax.pad(value, jnp.asarray(fill_value, value.dtype), config)

    # `lax.pad` takes one padding value, so a padded mask selects that of each lane.
    inside = pad(jnp.ones(array.shape[:-1], bool), False)[..., None]
    return jnp.where(inside, pad(array, 0), padding)


def _slices(*, start_indices, limit_indices, strides) -> tuple[slice, ...]:
    """Return the Python slices of a `lax.slice`."""
    return tuple(map(slice, start_indices, limit_indices, strides or [None] * len(start_indices)))


def _wide(arrays):
    """Broadcast the last axis of all arrays to the number of lanes."""
    num_lanes = max(array.shape[-1] for array in arrays)
    return [jnp.broadcast_to(array, (*array.shape[:-1], num_lanes)) for array in arrays]
