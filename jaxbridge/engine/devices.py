"""Lanes split over the devices of the ambient mesh, that of `jax.set_mesh`.

Lanes know nothing of each other, so every device simulates its share of them and then tells the
others. All else is little work and is done on every device alike: arrays hold the same numbers
as on one device, and where lanes run changes results by rounding only.

Along the explicit axes of a mesh JAX (0.10 to 0.12) has no `vmap` of loops that carry what is not
mapped. What is called under such a `vmap` therefore runs on the whole batch (`on_whole_batches`).
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, PyTree

_Result = TypeVar("_Result")


def whole(array: Array) -> Array:
    """The array, handed whole to every device where its type says that they share it, as types do
    along the explicit axes of a mesh: there a program cannot take single points out of it. Where no
    mesh is in force, to the first device, for nothing else has such a type."""
    if not _has_explicit_axes(array):
        return array
    sharding = jax.typeof(array).sharding
    if jax.sharding.get_abstract_mesh().empty and not isinstance(array, jax.core.Tracer):
        return jnp.asarray(jax.device_get(array))  # by the host, for `device_put` keeps the type
    return jax.sharding.reshard(array, NamedSharding(sharding.mesh, PartitionSpec()))


def on_whole_batches(function: Callable[..., _Result], *args: Any, **kwargs: Any) -> _Result:
    """Return `function(*args, **kwargs)`. If the call is under `jax.vmap` along an explicit axis of
    a mesh, every device gets the whole batch, and results are split along that axis as before."""
    arrays, rest = eqx.partition((args, kwargs), eqx.is_array)
    leaves, treedef = jax.tree.flatten(arrays)
    if not any(map(_is_split_by_vmap, leaves)):
        return function(*args, **kwargs)

    def of_one(leaves):
        args, kwargs = eqx.combine(jax.tree.unflatten(treedef, leaves), rest)
        return function(*args, **kwargs)

    computed = []

    @custom_vmap
    def compute(*leaves):
        return leaves

    @compute.def_vmap
    def compute_on_batch(size, are_batched, *leaves):
        axes = [0 if is_batched else None for is_batched in are_batched]
        of_batch = eqx.filter_vmap(
            of_one, in_axes=(axes,), out_axes=eqx.if_array(0), axis_size=size
        )
        split = next(filter(_is_split, leaves))
        results, static = eqx.partition(of_batch(_whole_as(split, leaves)), eqx.is_array)
        computed.append((_split_as(split, results), static))
        return leaves, tuple(are_batched)

    compute(*leaves)
    [(results, static)] = computed

    @custom_vmap
    def hand_back(*_):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[1:], leaf.dtype), results)

    @hand_back.def_vmap
    def hand_back_batch(*_):
        return results, jax.tree.map(lambda _: True, results)

    return eqx.combine(hand_back(*leaves), static)


def _is_split_by_vmap(array: Array | np.ndarray | np.generic) -> bool:
    """Return whether the array is one of a batch that is split along an explicit axis of a mesh.

    Its type has the mesh, but not the axis: only rules of `vmap` get the batch.
    """
    if not isinstance(array, jax.core.Tracer) or not _has_explicit_axes(array):
        return False
    batches = []

    @custom_vmap
    def look(array):
        return array

    @look.def_vmap
    def look_at_batch(size, is_batched, batch):
        batches.append(batch)
        return batch, True

    look(lax.stop_gradient(array))
    return any(map(_is_split, batches))


def _whole_as(batch: Array, arrays: Sequence[Array]) -> list[Array]:
    """Return the arrays whole on every device, of types that agree with that of the batch."""
    if not isinstance(batch, jax.core.Tracer):
        return list(map(whole, arrays))
    everywhere = NamedSharding(jax.typeof(batch).sharding.mesh, PartitionSpec())
    return [jax.sharding.reshard(array, everywhere) for array in arrays]


def _split_as(batch: Array, results: PyTree) -> PyTree:
    """Split the first axes of the results over devices as that of the batch."""
    is_traced = isinstance(batch, jax.core.Tracer)
    sharding = jax.typeof(batch).sharding if is_traced else batch.sharding
    assert isinstance(sharding, NamedSharding)
    along = NamedSharding(sharding.mesh, PartitionSpec(sharding.spec[0]))
    put = jax.sharding.reshard if is_traced else jax.device_put
    return jax.tree.map(lambda leaf: put(leaf, along), results)


def _is_split(batch: Array) -> bool:
    spec = jax.typeof(batch).sharding.spec
    return _has_explicit_axes(batch) and len(spec) > 0 and spec[0] is not None


def _has_explicit_axes(array: Array) -> bool:
    return AxisType.Explicit in jax.typeof(array).sharding.mesh.axis_types


def num_devices() -> int:
    """How many devices share the lanes: one without a mesh, and where the caller has split the
    work already, inside a `shard_map`."""
    mesh = jax.sharding.get_abstract_mesh()
    return 1 if mesh.empty or AxisType.Manual in mesh.axis_types else mesh.size


def share(num_lanes: int) -> int:
    """How many of these lanes each device gets."""
    return -(-num_lanes // num_devices())


def over_devices(
    function: Callable[..., _Result], in_axes: tuple[int | None, ...], out_axis: int = 0
) -> Callable[..., _Result]:
    """`function`, its lanes split over the devices; where there is one only, as it is.

    Lanes are in those axes of the arguments that `in_axes` says (`None` for an argument without),
    and in `out_axis` of all results. Traced arrays that `function` needs besides must be in an
    `eqx.Partial`, for JAX lets a `shard_map` close over few of them.
    """
    if num_devices() == 1:
        return function
    names = jax.sharding.get_abstract_mesh().axis_names
    arrays, rest = eqx.partition(function, eqx.is_array)

    def split(*arguments):
        num_lanes = _num_lanes(arguments, in_axes)
        length = share(num_lanes)

        def on_one_device(arrays, arguments):
            mine = lax.axis_index(names) * length + jnp.arange(length)
            taken = (_take(*pair, mine) for pair in zip(arguments, in_axes, strict=True))
            return jax.tree.map(gather, eqx.combine(arrays, rest)(*taken))

        def gather(leaf):
            everything = lax.all_gather(leaf, names, axis=out_axis, tiled=True)
            return lax.slice_in_dim(everything, 0, num_lanes, axis=out_axis)

        everywhere = PartitionSpec()
        # What devices do may vary as it will, until all are told.
        shared = jax.shard_map(
            on_one_device, in_specs=everywhere, out_specs=everywhere, check_vma=False
        )
        return shared(arrays, arguments)

    return split


def _take(argument: PyTree, axis: int | None, lanes: Int[Array, " lanes"]) -> PyTree:
    """These lanes; for numbers beyond them, the last one."""
    if axis is None:
        return argument
    return jax.tree.map(lambda leaf: jnp.take(leaf, lanes, axis, mode="clip"), argument)


def _num_lanes(arguments: tuple, in_axes: tuple[int | None, ...]) -> int:
    (size,) = {
        leaf.shape[axis]
        for argument, axis in zip(arguments, in_axes, strict=True)
        if axis is not None
        for leaf in jax.tree.leaves(argument)
    }
    return size
