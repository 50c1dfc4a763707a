"""Split of lanes over the devices of the ambient mesh (`jax.set_mesh`).

Lanes are independent, so each device simulates its share of them and sends the results to the
others. All other work is small, and every device repeats it: arrays hold the same numbers as on one
device. The number of devices changes results by rounding only.

Along the explicit axes of a mesh, JAX 0.10 to 0.12 cannot `vmap` loops whose state has unmapped
parts. Functions under such a `vmap` therefore run on the whole batch (`on_whole_batches`).
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


def replicate(array: Array) -> Array:
    """Replicate an array on every device if its type has explicit axes of a mesh.

    A program cannot index single points of such an array. Without an ambient mesh, the array goes
    to the first device, because all other arrays are there.
    """
    if not _has_explicit_axes(array):
        return array
    sharding = jax.typeof(array).sharding
    if jax.sharding.get_abstract_mesh().empty and not isinstance(array, jax.core.Tracer):
        return jnp.asarray(jax.device_get(array))  # via the host: `device_put` keeps the type
    return jax.sharding.reshard(array, NamedSharding(sharding.mesh, PartitionSpec()))


def on_whole_batches(function: Callable[..., _Result], *args: Any, **kwargs: Any) -> _Result:
    """Return `function(*args, **kwargs)`, evaluated on the whole batch of a `jax.vmap`.

    This applies to a `vmap` along an explicit axis of a mesh, and has no effect otherwise. Every
    device gets the whole batch; the results are split along that axis as the arguments were.
    """
    arrays, static_inputs = eqx.partition((args, kwargs), eqx.is_array)
    leaves, treedef = jax.tree.flatten(arrays)
    if not any(map(_is_split_by_vmap, leaves)):
        return function(*args, **kwargs)

    def call_one(leaves):
        args, kwargs = eqx.combine(jax.tree.unflatten(treedef, leaves), static_inputs)
        return function(*args, **kwargs)

    # A `custom_vmap` function must know the shapes of its results before its rule sees the batch.
    # So a first call only stores the results in `computed`; a second one, with known shapes,
    # returns them.
    computed = []

    @custom_vmap
    def compute(*leaves):
        return leaves

    @compute.def_vmap
    def compute_on_batch(size, are_batched, *leaves):
        axes = [0 if is_batched else None for is_batched in are_batched]
        call_batch = eqx.filter_vmap(
            call_one, in_axes=(axes,), out_axes=eqx.if_array(0), axis_size=size
        )
        split = next(filter(_is_split, leaves))
        results, static = eqx.partition(call_batch(_whole_as(split, leaves)), eqx.is_array)
        computed.append((_split_as(split, results), static))
        return leaves, tuple(are_batched)

    compute(*leaves)
    [(results, static)] = computed

    @custom_vmap
    def return_results(*_):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[1:], leaf.dtype), results)

    @return_results.def_vmap
    def return_batch(*_):
        return results, jax.tree.map(lambda _: True, results)

    return eqx.combine(return_results(*leaves), static)


def _is_split_by_vmap(array: Array | np.ndarray | np.generic) -> bool:
    """Return whether the array belongs to a batch that is split along an explicit axis of a mesh.

    Its own type lacks the batch axis; only a rule of `vmap` sees the batch.
    """
    if not isinstance(array, jax.core.Tracer) or not _has_explicit_axes(array):
        return False
    batches = []

    @custom_vmap
    def observe(array):
        return array

    @observe.def_vmap
    def observe_batch(size, is_batched, batch):
        batches.append(batch)
        return batch, True

    # Only the batch is of interest; without tangents, `custom_vmap` needs no derivative rule.
    observe(lax.stop_gradient(array))
    return any(map(_is_split, batches))


def _whole_as(batch: Array, arrays: Sequence[Array]) -> list[Array]:
    """Replicate the arrays on every device, with types that agree with that of the batch."""
    if not isinstance(batch, jax.core.Tracer):
        return list(map(replicate, arrays))
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
    """Return whether the first axis of the batch is split along an explicit axis of a mesh."""
    spec = jax.typeof(batch).sharding.spec
    return _has_explicit_axes(batch) and len(spec) > 0 and spec[0] is not None


def _has_explicit_axes(array: Array) -> bool:
    """Return whether the mesh of the array's type has explicit axes."""
    return AxisType.Explicit in jax.typeof(array).sharding.mesh.axis_types


def num_devices() -> int:
    """Return the number of devices that share the lanes.

    It is one without a mesh, and inside a `shard_map`, where the caller has split the work already.
    """
    mesh = jax.sharding.get_abstract_mesh()
    return 1 if mesh.empty or AxisType.Manual in mesh.axis_types else mesh.size


def lanes_per_device(num_lanes: int) -> int:
    """Return how many of these lanes each device simulates, rounded up."""
    return -(-num_lanes // num_devices())  # division rounded up


def over_devices(
    function: Callable[..., _Result], in_axes: tuple[int | None, ...], out_axis: int = 0
) -> Callable[..., _Result]:
    """Return `function` with its lanes split over the devices; with one device, `function` itself.

    - `in_axes`: the axis of lanes of each argument, `None` for an argument without lanes.
    - `out_axis`: the axis of lanes of all results.

    If `function` needs other traced arrays, pass an `eqx.Partial` that holds them: a `shard_map`
    can close over few traced arrays.
    """
    if num_devices() == 1:
        return function
    names = jax.sharding.get_abstract_mesh().axis_names
    arrays, static_parts = eqx.partition(function, eqx.is_array)

    def split(*arguments):
        num_lanes = _num_lanes(arguments, in_axes)
        length = lanes_per_device(num_lanes)

        def on_one_device(arrays, arguments):
            lanes = lax.axis_index(names) * length + jnp.arange(length)
            own_arguments = (_take(*pair, lanes) for pair in zip(arguments, in_axes, strict=True))
            return jax.tree.map(gather, eqx.combine(arrays, static_parts)(*own_arguments))

        def gather(leaf):
            gathered = lax.all_gather(leaf, names, axis=out_axis, tiled=True)
            return lax.slice_in_dim(gathered, 0, num_lanes, axis=out_axis)

        everywhere = PartitionSpec()
        # Without `check_vma`, JAX accepts results that differ between devices until `gather`.
        on_all_devices = jax.shard_map(
            on_one_device, in_specs=everywhere, out_specs=everywhere, check_vma=False
        )
        return on_all_devices(arrays, arguments)

    return split


def _take(argument: PyTree, axis: int | None, lanes: Int[Array, " lanes"]) -> PyTree:
    """Select these lanes of an argument; indices beyond the last lane select the last one.

    The last device may have fewer lanes than its share; its surplus results are cut off later.
    """
    if axis is None:
        return argument
    return jax.tree.map(lambda leaf: jnp.take(leaf, lanes, axis, mode="clip"), argument)


def _num_lanes(arguments: tuple, in_axes: tuple[int | None, ...]) -> int:
    """Return the number of lanes, which is the same in all arguments."""
    (size,) = {
        leaf.shape[axis]
        for argument, axis in zip(arguments, in_axes, strict=True)
        if axis is not None
        for leaf in jax.tree.leaves(argument)
    }
    return size
