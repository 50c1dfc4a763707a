"""Means over bridges: Σ w h(path) of functions h of one path, shape (K, d)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Inexact, PyTree, Shaped

from .arguments import as_returned, check_function, named
from .indices import check_indices

# A function of one path; its values may be truth values and counts.
PathFunction = Callable[[Array], PyTree]


def proper(log_weights: Float[Array, "*I"]) -> Float[Array, "*I"]:
    """Log weights; -inf, no weight, where one is NaN or +inf."""
    return jnp.where(log_weights < jnp.inf, log_weights, -jnp.inf)


def normalised(log_weights: Float[Array, "*I n"]) -> Float[Array, "*I n"]:
    """The weights, normalised to sum to one; all zero where nothing has weight."""
    largest = jnp.max(log_weights, axis=-1, keepdims=True)
    weights = jnp.exp(log_weights - jnp.where(jnp.isfinite(largest), largest, 0))
    total = jnp.sum(weights, axis=-1, keepdims=True)
    return weights / jnp.where(total > 0, total, 1)


def effective_size(weights: Float[Array, "*I n"]) -> Float[Array, "*I"]:
    """1/Σw², for weights that sum to one: between 0, where nothing has weight, and n."""
    squares = jnp.sum(weights**2, axis=-1)
    return jnp.where(squares > 0, 1 / jnp.where(squares > 0, squares, 1), 0)


def filled(paths: Float[Array, "*I n K d"], met: Bool[Array, "*I n"]) -> Float[Array, "*I n K d"]:
    """The first bridge that was found in place of those that were not, which are NaN."""
    first = jnp.argmax(met, axis=-1)[..., None, None, None]
    return jnp.where(met[..., None, None], paths, jnp.take_along_axis(paths, first, axis=-3))


def values_of(fn: PathFunction, paths: Float[Array, "*I n K d"]) -> PyTree:
    """`fn` of every path, with leading axes (*I, n); truth values and counts as numbers."""
    like = jax.ShapeDtypeStruct(paths.shape[-2:], paths.dtype)
    each = path_function("fn", fn, like)
    for _ in paths.shape[:-2]:
        each = jax.vmap(each)
    return each(paths)


def path_function(name: str, fn: PathFunction, like: jax.ShapeDtypeStruct) -> PathFunction:
    """Return `fn` of paths like this one; truth values and counts among its values are numbers.

    **Raises:** `TypeError` where it is no function of one path, or cannot be traced; `ValueError`
    where it takes a point beyond the end of the path.
    """
    check_function(name, fn, "(path)")

    def number(value):
        value = as_returned(name, value, complex_too=True)
        inexact = jnp.issubdtype(value.dtype, jnp.inexact)
        return value if inexact else value.astype(like.dtype)

    numbers = lambda path: jax.tree.map(number, named(name, fn)(path))
    check_indices(name, numbers, like)
    return numbers


def weighted_mean(
    weights: Float[Array, "*I n"], values: Inexact[Array, "..."]
) -> Inexact[Array, "..."]:
    """Σ w h, for weights that sum to one and values of shape (*I, n, ...); NaN where nothing has
    weight."""
    axis = weights.ndim - 1
    each = expanded(weights, values)
    total = jnp.sum(jnp.where(each > 0, each * values, 0), axis)
    return jnp.where(jnp.sum(each, axis) > 0, total, jnp.nan)


def mean_over_paths(
    fn: PathFunction,
    weights: Float[Array, "*I n"],
    paths: Float[Array, "*I n K d"],
    met: Bool[Array, "*I n"],
) -> PyTree:
    """The weighted mean of `fn` over the paths that there are."""
    values = values_of(fn, filled(paths, met))
    return jax.tree.map(lambda value: weighted_mean(weights, value), values)


def expanded(weights: Shaped[Array, "*I n"], values: Inexact[Array, "..."]) -> Shaped[Array, "..."]:
    """The weights with as many axes as the values."""
    return weights.reshape(*weights.shape, *[1] * (values.ndim - weights.ndim))
