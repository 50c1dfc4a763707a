"""Weighted means Σ w h(path) over bridges, for functions h of one path of shape (K, d)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Inexact, PyTree, Shaped

from .arguments import as_returned, check_function, named
from .indices import check_indices

# A function of one path. It may return Booleans and integers, which `as_path_function` converts.
PathFunction = Callable[[Array], PyTree]


def nan_to_neg_inf(log_weights: Float[Array, "*I"]) -> Float[Array, "*I"]:
    """Replace NaN and +inf among log weights by -inf, the log of a zero weight."""
    return jnp.where(log_weights < jnp.inf, log_weights, -jnp.inf)


def normalise_weights(log_weights: Float[Array, "*I n"]) -> Float[Array, "*I n"]:
    """Return the weights, normalised to sum to one over the last axis.

    All are zero where no weight is positive.
    """
    largest = jnp.max(log_weights, axis=-1, keepdims=True)
    # Subtracting the largest log weight keeps `exp` from overflowing.
    weights = jnp.exp(log_weights - jnp.where(jnp.isfinite(largest), largest, 0))
    total = jnp.sum(weights, axis=-1, keepdims=True)
    return weights / jnp.where(total > 0, total, 1)


def effective_size(weights: Float[Array, "*I n"]) -> Float[Array, "*I"]:
    """Return the effective sample size 1/Σw² of weights that sum to one, between 1 and n.

    It is 0 where no weight is positive.
    """
    squares = jnp.sum(weights**2, axis=-1)
    return jnp.where(squares > 0, 1 / jnp.where(squares > 0, squares, 1), 0)


def fill_missing_paths(
    paths: Float[Array, "*I n K d"], met: Bool[Array, "*I n"]
) -> Float[Array, "*I n K d"]:
    """Replace each missing path (NaN where `met` is false) by the first path that exists."""
    # Missing paths have weight zero, but 0 · NaN is NaN in a mean and in its derivative.
    first = jnp.argmax(met, axis=-1)[..., None, None, None]
    return jnp.where(met[..., None, None], paths, jnp.take_along_axis(paths, first, axis=-3))


def evaluate_on_paths(fn: PathFunction, paths: Float[Array, "*I n K d"]) -> PyTree:
    """Evaluate `fn` at every path; the results have leading axes (*I, n).

    Booleans and integers among its values become floating point numbers.
    """
    path_type = jax.ShapeDtypeStruct(paths.shape[-2:], paths.dtype)
    evaluate = as_path_function("fn", fn, path_type)
    for _ in paths.shape[:-2]:
        evaluate = jax.vmap(evaluate)
    return evaluate(paths)


def as_path_function(name: str, fn: PathFunction, like: jax.ShapeDtypeStruct) -> PathFunction:
    """Return `fn` with floating point values, for paths of the shape and dtype of `like`.

    Booleans and integers among its values become numbers of the paths' dtype.

    **Raises:** `TypeError` if `fn` is not a function of one path or cannot be traced; `ValueError`
    if it indexes beyond the end of the path.
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
    """Compute Σ w h for weights that sum to one and values of shape (*I, n, ...).

    The mean is NaN where no weight is positive. Values of weight zero are ignored, even NaN.
    """
    axis = weights.ndim - 1
    aligned = align_axes(weights, values)
    # 0 · NaN is NaN, so values of weight zero are masked.
    total = jnp.sum(jnp.where(aligned > 0, aligned * values, 0), axis)
    return jnp.where(jnp.sum(aligned, axis) > 0, total, jnp.nan)


def mean_over_paths(
    fn: PathFunction,
    weights: Float[Array, "*I n"],
    paths: Float[Array, "*I n K d"],
    met: Bool[Array, "*I n"],
) -> PyTree:
    """Compute the weighted mean of `fn` over the paths that exist."""
    values = evaluate_on_paths(fn, fill_missing_paths(paths, met))
    return jax.tree.map(lambda value: weighted_mean(weights, value), values)


def align_axes(
    weights: Shaped[Array, "*I n"], values: Inexact[Array, "..."]
) -> Shaped[Array, "..."]:
    """Append axes of length one to the weights until they have as many axes as the values."""
    return weights.reshape(*weights.shape, *[1] * (values.ndim - weights.ndim))
