"""Lanes split over the devices of the ambient mesh, that of `jax.set_mesh`.

Lanes know nothing of each other, so every device simulates its share of them and then tells the
others. All else is little work and is done on every device alike: arrays hold the same numbers
as on one device, and where lanes run changes results by rounding only.
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jax import lax
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, PyTree

_Result = TypeVar("_Result")


def whole(array: Array) -> Array:
    """The array, handed whole to every device where its type says that they share it, as types do
    along the explicit axes of a mesh: there a program cannot take single points out of it. Where no
    mesh is in force, to the first device, for nothing else has such a type."""
    sharding = jax.typeof(array).sharding
    if AxisType.Explicit not in sharding.mesh.axis_types:
        return array
    if jax.sharding.get_abstract_mesh().empty and not isinstance(array, jax.core.Tracer):
        return jnp.asarray(jax.device_get(array))  # by the host, for `device_put` keeps the type
    return jax.sharding.reshard(array, NamedSharding(sharding.mesh, PartitionSpec()))


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
