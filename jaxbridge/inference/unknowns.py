"""What is not known: the parameters to be inferred, as a vector θ in R^p, and their prior.

All parameters of the model are unknown, or those that a function `where(params)` picks, as in
`equinox.tree_at`. What is observed in between is a path in the coordinates of the model, so σ must
not depend on θ wherever paths are part of the state: two σ's give singular laws of paths, and a
path would never let go of the θ it was made with.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from ..engine.checks import as_floating, cast_floats, is_traced
from ..engine.linalg import any_inverse, dot, matvec
from ..models.diffusion import Diffusion
from ..models.tracing import uses_argument


class _Named:
    """A parameter's name in its place, and its shape, if it is of floating point numbers."""

    def __init__(self, name: str, shape: tuple[int, ...] | None):
        self.name, self.shape = name, shape

    @property
    def entries(self) -> list[str]:
        """The names of its entries, in the order of `ravel`."""
        if self.shape is None:
            return []
        places = [",".join(map(str, place)) for place in np.ndindex(self.shape)]
        return [f"{self.name}[{place}]" if place else self.name for place in places]


class Unknowns(eqx.Module):
    """The model, and which of its parameters are unknown."""

    model: Diffusion
    where: Callable[[PyTree], PyTree] | None = eqx.field(static=True)

    @property
    def params(self) -> PyTree:
        """The unknown parameters, as they are in the model."""
        return self.model.params if self.where is None else self.where(self.model.params)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of θ's entries, as the model's parameters have them: "alpha", "B[0,1]"; "0" and
        "1" for those of a tuple, and "theta" where the parameters are one array without a name."""

        def named(path, leaf):
            name = jax.tree_util.keystr(path, simple=True, separator=".") or "theta"
            return _Named(name, np.shape(leaf) if eqx.is_inexact_array(leaf) else None)

        leaves = jax.tree_util.tree_map_with_path(named, self.model.params)
        leaves = jax.tree.leaves(leaves if self.where is None else self.where(leaves))
        return tuple(name for leaf in leaves for name in leaf.entries)

    def vector(self, params: PyTree) -> Float[Array, " p"]:
        """θ of these unknown parameters."""
        return ravel_pytree(eqx.filter(params, eqx.is_inexact_array))[0]

    def pick(self, theta: Float[Array, " p"]) -> PyTree:
        """The unknown parameters of θ, in its dtype."""
        floats, others = eqx.partition(self.params, eqx.is_inexact_array)
        _, unravel = ravel_pytree(cast_floats(floats, theta.dtype))
        return eqx.combine(unravel(theta), others)

    def all(self, theta: Float[Array, " p"]) -> PyTree:
        """All parameters of the model, the unknown ones from θ."""
        if self.where is None:
            return self.pick(theta)
        return eqx.tree_at(self.where, self.model.params, self.pick(theta))

    def at(self, theta: Float[Array, " p"]) -> Diffusion:
        """The model at θ."""
        return self.model.with_params(self.all(theta))


class NormalPrior(eqx.Module):
    """A normal prior of the unknown parameters.

    **Arguments:**

    - `mean`: a number for all of them, a vector of shape (p,), or a pytree like the parameters.
    - `variance`: likewise; or a covariance matrix of shape (p, p). A vector has the parameters in
        the order of `jax.flatten_util.ravel_pytree`.

    **Raises:** `ValueError`, by the function it is passed to, if shapes do not fit the parameters.

    **Example:**

    ```python
    jb.NormalPrior(1.0, 1.0)
    jb.NormalPrior(jnp.zeros(4), 0.5 * jnp.eye(4))
    ```
    """

    mean: PyTree
    variance: PyTree


class NormalDensity(eqx.Module):
    """N(mean, precision⁻¹), up to the constant."""

    mean: Float[Array, " p"]
    precision: Float[Array, "p p"]

    def __call__(self, theta: Float[Array, " p"]) -> Float[Array, ""]:
        deviation = theta - self.mean
        return -dot(deviation, matvec(self.precision, deviation)) / 2


class GivenDensity(eqx.Module):
    """The user's log density of the unknown parameters, as a function of θ."""

    unknowns: Unknowns
    function: Callable[[PyTree], Any] = eqx.field(static=True)

    def __call__(self, theta: Float[Array, " p"]) -> Float[Array, ""]:
        value = jnp.asarray(self.function(self.unknowns.pick(theta)))
        if value.shape != ():
            raise ValueError(f"`prior` must return a number; it returned shape {value.shape}.")
        return value.astype(theta.dtype)


Prior = NormalPrior | Callable[[PyTree], Any]
Constraint = Callable[[PyTree], Any]


def as_unknowns(
    model: Diffusion, where: Callable[[PyTree], PyTree] | None, like: Float[Array, " d"]
) -> tuple[Unknowns, Float[Array, " p"]]:
    """The unknown parameters and θ as it is in the model, in the dtype of the points."""
    if where is not None and not callable(where):
        raise TypeError(
            f"`where` must be a function that picks from `model.params`; got {where!r}."
        )
    unknowns = Unknowns(model, where)
    theta = unknowns.vector(cast_floats(unknowns.params, like.dtype))
    if theta.size == 0:
        raise ValueError(
            "this model has no parameters to be inferred: give `Diffusion` its unknown numbers as "
            "`params=`."
        )
    if not is_traced(theta) and not np.all(np.isfinite(theta)):
        raise ValueError(f"the unknown parameters must be finite; the model has {unknowns.params}.")
    return unknowns, theta


def check_sigma_known(
    unknowns: Unknowns, theta: Float[Array, " p"], like: Float[Array, " d"], instead: str
) -> None:
    """Raise `ValueError` where σ depends on the unknown parameters."""
    if uses_argument(lambda theta: unknowns.at(theta).diffusion(like), theta):
        raise ValueError(
            "σ depends on the unknown parameters, and given a whole path σ is known: " + instead
        )


def check_coordinates_known(unknowns: Unknowns, theta: Float[Array, " p"]) -> None:
    """Raise `ValueError` where the coordinates of the model depend on the unknown parameters."""
    if uses_argument(lambda theta: unknowns.at(theta).coordinate_values(), theta):
        raise ValueError(
            "the coordinates of `lamperti` depend on the unknown parameters, those of σ, but the "
            "observations were mapped to them at fixed ones: infer in the original coordinates, "
            "or in those of `jb.transform(model, jnp.log, jnp.exp)`, which depend on no "
            "parameters, by `pmmh` or `maximum_likelihood`; or hold the parameters of σ fixed by "
            "`where=`."
        )


def as_normal(prior: NormalPrior, unknowns: Unknowns, theta: Float[Array, " p"]) -> NormalDensity:
    """The prior of θ, with its shapes checked."""
    p = theta.shape[0]

    def as_vector(name, value):
        structure, like = jax.tree.structure(unknowns.params), jax.tree.leaves(unknowns.params)
        is_array = hasattr(value, "ndim")
        alike = is_array and len(like) == 1 and value.shape == like[0].shape
        if alike and (name == "mean" or value.shape != (p, p)):
            value = jnp.ravel(value)
        if jax.tree.structure(value) == structure and not is_array:
            leaves = [as_floating(f"prior.{name}", leaf) for leaf in jax.tree.leaves(value)]
            for leaf, known in zip(leaves, like, strict=True):
                if leaf.shape not in ((), known.shape):
                    raise ValueError(
                        f"`prior.{name}` has a leaf of shape {leaf.shape} for parameters of shape "
                        f"{known.shape}."
                    )
            full = [jnp.broadcast_to(a, b.shape) for a, b in zip(leaves, like, strict=True)]
            value = unknowns.vector(jax.tree.unflatten(structure, full))
        return as_floating(f"prior.{name}", value).astype(theta.dtype)

    mean, variance = as_vector("mean", prior.mean), as_vector("variance", prior.variance)
    if mean.shape not in ((), (p,)):
        raise ValueError(
            f"`prior.mean` must be a number, a vector of shape ({p},) or a pytree like the unknown "
            f"parameters; got shape {mean.shape}."
        )
    if variance.shape not in ((), (p,), (p, p)):
        raise ValueError(
            f"`prior.variance` must be a number, a vector of shape ({p},), a matrix of shape "
            f"({p}, {p}) or a pytree like the unknown parameters; got shape {variance.shape}."
        )
    if not is_traced(mean, variance):
        least = np.linalg.eigvalsh(variance).min() if variance.ndim == 2 else np.min(variance)
        if not (np.all(np.isfinite(mean)) and np.isfinite(least) and least > 0):
            raise ValueError(
                "`prior` must have a finite mean and a positive (definite) variance; got "
                f"{prior.mean} and {prior.variance}."
            )
    if variance.ndim == 2:
        precision = any_inverse(variance)
        precision = (precision + precision.T) / 2
    else:
        precision = jnp.diag(jnp.broadcast_to(1 / variance, (p,)))
    return NormalDensity(jnp.broadcast_to(mean, (p,)), precision)


def as_log_prior(
    prior: Prior, unknowns: Unknowns, theta: Float[Array, " p"]
) -> NormalDensity | GivenDensity:
    """The prior's log density, a function of θ."""
    if isinstance(prior, NormalPrior):
        return as_normal(prior, unknowns, theta)
    if not callable(prior):
        raise TypeError(
            "`prior` must be a `NormalPrior`, or a function that maps the unknown parameters to "
            f"the log of a density; got {prior!r}."
        )

    return GivenDensity(unknowns, prior)


def allowed(
    constraint: Constraint | None, unknowns: Unknowns, theta: Float[Array, " p"]
) -> Bool[Array, ""]:
    """Whether θ is finite and satisfies the constraint."""
    finite = jnp.all(jnp.isfinite(theta))
    if constraint is None:
        return finite
    value = jnp.asarray(constraint(unknowns.pick(theta)))
    if value.shape != () or value.dtype != bool:
        raise ValueError(
            "`constraint` must map the unknown parameters to one truth value; it returned shape "
            f"{value.shape} and dtype {value.dtype}."
        )
    return finite & value


def check_allowed(
    constraint: Constraint | None, unknowns: Unknowns, theta: Float[Array, "*chains p"]
) -> None:
    """Raise `ValueError` where a visible θ does not satisfy the constraint."""
    if constraint is not None and not callable(constraint):
        raise TypeError(
            "`constraint` must be a function that maps the unknown parameters to a truth value; "
            f"got {constraint!r}."
        )
    for row in theta.reshape(-1, theta.shape[-1]):
        ok = allowed(constraint, unknowns, row)
        if not is_traced(ok) and not bool(ok):
            why = "are not finite" if constraint is None else "do not satisfy `constraint`"
            raise ValueError(f"the parameters to start from, {unknowns.pick(row)}, {why}.")


def init_vectors(
    unknowns: Unknowns, init: PyTree, chains: tuple[int, ...]
) -> Float[Array, "*chains p"]:
    """θ of the unknown parameters that the user wants to start from, for each chain its own if
    they have such an axis."""
    init = jax.tree.map(lambda leaf: as_floating("init", leaf), init)
    known = unknowns.params
    if jax.tree.structure(init) != jax.tree.structure(known):
        raise ValueError(
            "`init` must be the `state` of earlier draws, or have the structure of the unknown "
            f"parameters, {jax.tree.structure(known)}; got {jax.tree.structure(init)}."
        )
    shapes = [
        (given.shape, leaf.shape)
        for given, leaf in zip(jax.tree.leaves(init), jax.tree.leaves(known), strict=True)
    ]
    if all(given == leaf for given, leaf in shapes):
        return unknowns.vector(init)
    if chains and all(given == (*chains, *leaf) for given, leaf in shapes):
        return jax.vmap(unknowns.vector)(init)
    raise ValueError(
        f"`init` must have leaves of the shapes of the unknown parameters, {[s for _, s in shapes]}"
        f", with a leading axis of {chains[0] if chains else 'no'} chains if they differ; got "
        f"{[s for s, _ in shapes]}."
    )
