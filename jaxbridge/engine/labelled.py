"""Results as labelled arrays: the annotations of their fields name the axes.

A field of a result with the annotation `Float[Array, "*I n K d"]` has the dimensions interval,
draw, time and state in `to_xarray`. An axis that an array lacks, as `*I` for a single interval, is
left out.
"""

import dataclasses
from typing import Any, get_args

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, PyTree

from .checks import is_traced

# Names of axes for which annotations have a letter. Other axes keep the name in the annotation.
_DIMENSIONS = {
    "I": "interval",
    "K": "time",
    "N": "trial",
    "P": "particle",
    "R": "run",
    "S": "data_set",
    "chains": "chain",
    "d": "state",
    "durations": "interval",
    "m": "component",
    "n": "draw",
    "num_filters": "filter",
    "p": "parameter",
    "iterations": "iteration",
    "points": "time",
    "readings": "reading",
    "records": "record",
    "times": "time",
}

_Labelled = tuple[tuple[str, ...], np.ndarray]  # the axes of an array, and its values


def dataset(result: Any) -> Any:
    """Return the arrays of a result as an `xarray.Dataset`, its numbers and `why()` as attributes.

    **Raises:** `TypeError` inside `jit`, where the values are traced.
    """
    import xarray

    if is_traced(result):
        raise TypeError(
            "`to_xarray()` returns NumPy arrays, which compiled code cannot: return the result "
            "from `jit` and call `to_xarray()` there."
        )
    fields = {field.name: field.type for field in dataclasses.fields(result)}
    # The leaves of parameters begin with the axes of the draws, as θ does. Those of each record
    # have one more axis.
    of_draws = _labelled(result, "theta", fields["theta"])[0][:-1] if "theta" in fields else ()
    arrays: dict[str, _Labelled] = {}
    numbers: dict[str, Any] = {"why": result.why()}
    for field, annotation in fields.items():
        name = field.removeprefix("_")  # a property of this name has what users see of the field
        value = getattr(result, name, None)
        if isinstance(value, bool | int | float):
            numbers[name] = int(value) if isinstance(value, bool) else value
        elif annotation is PyTree:
            for path, leaf in named_leaves(value, name).items():
                first = (*of_draws, "record") if name == "unit_params" else of_draws
                own = tuple(f"{path}_{i}" for i in range(leaf.ndim))
                arrays[path] = ((*first, *own[len(first) :]), jax.device_get(leaf))
        elif value is not None and _axes(annotation) is not None:
            arrays[name] = _labelled(result, name, annotation)
    arrays["trustworthy"] = _labelled(result, "trustworthy", Bool[Array, "*I"])
    coordinates: dict[str, Any] = {}
    if "times" in arrays:
        axes, times = arrays.pop("times")
        coordinates["time" if axes == ("time",) else "times"] = (axes, times)
    if "names" in fields:
        coordinates["parameter"] = list(result.names)
    return xarray.Dataset(arrays, coordinates, numbers)


def named_leaves(tree: PyTree, name: str = "") -> dict[str, Array]:
    """Return the arrays of a pytree by their paths, like "params.rate"."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    keys = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves]
    return {
        ".".join(filter(None, (name, key))): leaf
        for key, (_, leaf) in zip(keys, leaves, strict=True)
        if eqx.is_array(leaf)
    }


def _axes(annotation: Any) -> list[str] | None:
    """Return the axes in the annotation of an array, `None` for what is no array."""
    of_arrays = [each for each in (annotation, *get_args(annotation)) if hasattr(each, "dim_str")]
    return of_arrays[0].dim_str.split() if of_arrays else None


def _labelled(result: Any, name: str, annotation: Any) -> _Labelled:
    """Return the names of the axes of an array, and its values."""
    values, axes = jax.device_get(getattr(result, name)), _axes(annotation) or []
    several = [axis for axis in axes if axis.startswith(("*", "..."))]  # any number of axes
    missing = np.ndim(values) - len(axes) + len(several)
    names = [_DIMENSIONS.get(axis, axis) for axis in axes if axis not in several]
    first = _DIMENSIONS.get(several[0].strip("*"), name) if several else "batch"
    leading = (
        [first] if missing == 1 and first != name else [f"{first}_{i}" for i in range(missing)]
    )
    # Neither numbers nor a name that was used before, as in "p p", name an axis.
    names = [
        f"{each}_{i}" if each in names[:i] else f"{name}_{i}" if each.isdigit() else each
        for i, each in enumerate(names)
    ]
    return (*leading, *names), np.asarray(values)
