"""The unknown parameters as a vector θ in R^p.

All parameters of the model are unknown, or those that a function `where(params)` selects, as for
`equinox.tree_at`. If θ is drawn given a complete path, σ must not depend on θ. Two different σ give
mutually singular laws of paths, so a path would determine θ and the chain would not move.
"""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from ..engine.arguments import as_returned, check_function, evaluated, named, shown
from ..engine.checks import as_floating, cast_floats, is_traced
from ..engine.compiled import compiled_sooner
from ..models.diffusion import Diffusion, check_diffusion
from ..models.tracing import uses_argument

Constraint = Callable[[PyTree], Any]


class Parameters(eqx.Module):
    """Model with a selection of unknown parameters and a constraint on them.

    Converts between these parameters and vectors θ.
    """

    model: Diffusion
    where: Callable[[PyTree], PyTree] | None = eqx.field(static=True)
    constraint: Constraint | None = eqx.field(static=True, default=None)

    @property
    def params(self) -> PyTree:
        """Return the unknown parameters of the model."""
        return self.model.params if self.where is None else pick(self.where, self.model.params)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the entries of θ.

        Examples are "alpha" and "B[0,1]", "0" and "1" for entries of a tuple, and "theta" if the
        parameters are one array without a name.
        """
        named = self.names_of_params
        leaves = jax.tree.leaves(named if self.where is None else self.where(named))
        return tuple(name for leaf in leaves for name in np.ravel(leaf))

    @property
    def names_of_params(self) -> PyTree:
        """Return the parameters of the model with arrays of names in place of their entries.

        Parameters that cannot be unknown have no entries.
        """

        def entries(path, leaf):
            name = jax.tree_util.keystr(path, simple=True, separator=".") or "theta"
            if not eqx.is_inexact_array(leaf):
                return np.empty(0, object)
            places = [",".join(map(str, place)) for place in np.ndindex(leaf.shape)]
            names = np.empty(leaf.size, object)
            names[:] = [f"{name}[{place}]" if place else name for place in places]
            return names.reshape(leaf.shape)

        return jax.tree_util.tree_map_with_path(entries, self.model.params)

    def vector(self, params: PyTree) -> Float[Array, " p"]:
        """Return θ, given the unknown parameters."""
        return ravel_pytree(eqx.filter(params, eqx.is_inexact_array))[0]

    def select(self, theta: Float[Array, " p"]) -> PyTree:
        """Return the unknown parameters, given θ, in its dtype."""
        return eqx.combine(
            self.each(theta), eqx.filter(self.params, eqx.is_inexact_array, inverse=True)
        )

    def each(self, values: Float[Array, " p"]) -> PyTree:
        """Return values of the entries of θ, such as a score, as a pytree like the parameters.

        Leaves without an entry in θ are `None`.
        """
        floats = eqx.filter(self.params, eqx.is_inexact_array)
        # The inverse of raveling, for leaves in the dtype of `values`.
        return ravel_pytree(cast_floats(floats, values.dtype))[1](values)

    def full(self, theta: Float[Array, " p"]) -> PyTree:
        """Return all parameters of the model, with the unknown ones from θ."""
        if self.where is None:
            return self.select(theta)
        return eqx.tree_at(self.where, self.model.params, self.select(theta))

    def bind(self, theta: Float[Array, " p"]) -> Diffusion:
        """Return the model with the parameters θ."""
        return self.model.with_params(self.full(theta))

    def allowed(self, theta: Float[Array, " p"]) -> Bool[Array, ""]:
        """Return whether θ is finite and satisfies the constraint."""
        finite = jnp.all(jnp.isfinite(theta))
        if self.constraint is None:
            return finite
        value = named("constraint", self.constraint)(self.select(theta))
        value = as_returned("constraint", value)
        if value.shape != () or value.dtype != bool:
            raise ValueError(
                "`constraint` must return one truth value for the unknown parameters; it returned "
                f"shape {value.shape} and dtype {value.dtype}."
            )
        return finite & value

    def check_allowed(self, theta: Float[Array, "*chains p"]) -> None:
        """Raise `ValueError` if a concrete θ is not finite or violates the constraint."""
        ok = of_rows(self.allowed, theta)
        if not is_traced(ok) and not np.all(np.asarray(ok)):
            row = theta.reshape(-1, theta.shape[-1])[int(np.argmin(ok))]
            why = "are not finite" if self.constraint is None else "do not satisfy `constraint`"
            raise ValueError(
                f"the start parameters {self.select(row)} {why}: pass valid ones as `init`, or as "
                "`params` of the model."
            )


@compiled_sooner
def of_rows(function: Callable, theta: Float[Array, "*chains p"]) -> Array:
    """Return `function` at θ of each chain, along one axis."""
    of_row = lambda row: function(row)  # `vmap` takes functions only, and this may be a module
    return jax.vmap(of_row)(theta.reshape(-1, theta.shape[-1]))


def as_parameters(
    model: Diffusion,
    where: Callable[[PyTree], PyTree] | None,
    constraint: Constraint | None = None,
    prior: Any = None,
) -> Parameters:
    """Return the unknown parameters, after the checks that need no data.

    Integers are fixed unless `where` selects them or the prior has entries for them.

    **Raises:** `TypeError` if `model` is no diffusion, or `where` or `constraint` no function;
    `ValueError` if `where` selects no parts of the parameters.
    """
    check_diffusion(model)
    check_function("where", where, "(params)", optional=True)
    check_function("constraint", constraint, "(unknown)", optional=True)
    params = _with_named_integers(model.params, where, prior)
    return Parameters(model.with_params(params), where, constraint)


def _with_named_integers(
    params: PyTree, where: Callable[[PyTree], PyTree] | None, prior: Any
) -> PyTree:
    """Return the parameters, with unknown integers converted to floating-point numbers.

    An integer is unknown if `where` selects it, or if the prior is a pytree with an entry for it.

    **Warns:** if there is no `where` and some integers remain fixed.
    """
    picked = params if where is None else pick(where, params)
    if not any(map(_is_integer, jax.tree.leaves(picked))):
        return params
    # A pytree as mean or variance has an entry for each integer that is unknown.
    means = [getattr(prior, name, None) for name in ("mean", "variance")]
    structure = jax.tree.structure(picked)
    # A single parameter has the structure of a number, so a prior cannot name it.
    named_by_prior = structure.num_nodes > 1 and structure in map(jax.tree.structure, means)
    if named_by_prior or (where is not None and _is_plain(picked)):
        floats = jax.tree.map(lambda leaf: _as_float(leaf) if _is_integer(leaf) else leaf, picked)
        return floats if where is None else eqx.tree_at(where, params, floats)
    if where is None:
        leaves = jax.tree_util.tree_leaves_with_path(params)
        names = [
            jax.tree_util.keystr(path, simple=True, separator=".") or "params"
            for path, leaf in leaves
            if _is_integer(leaf)
        ]
        warnings.warn(
            f"the integers {', '.join(f'`{name}`' for name in names)} among `params` are held "
            "fixed: pass floats (1.0 instead of 1) to infer them, or select the unknown "
            "parameters by `where=`.",
            # Points at the caller of the public function.
            stacklevel=5,
        )
    return params


def pick(where: Callable[[PyTree], PyTree], params: PyTree) -> PyTree:
    """Return the parameters that `where` selects.

    **Raises:** `ValueError` if `where` fails, or returns anything but parts of the parameters.
    """
    picked = evaluated("where", where, params)
    try:
        # `tree_at` fails unless `where` returns distinct nodes of `params`.
        eqx.tree_at(where, params, picked)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            "`where` must return whole leaves or branches of `model.params`, each at most once, "
            "such as `lambda params: params.mean`, not entries of an array; it returned "
            f"{shown(picked)}."
        ) from error
    return picked


def _is_integer(leaf: Any) -> bool:
    if eqx.is_array(leaf) or isinstance(leaf, np.ndarray | np.generic):
        return jnp.issubdtype(leaf.dtype, jnp.integer)
    return isinstance(leaf, int) and not isinstance(leaf, bool)


def _as_float(leaf: Any) -> Array:
    return as_floating("params", leaf)


def _is_plain(tree: PyTree) -> bool:
    """Return whether tuples, lists and dictionaries are the only containers of a pytree.

    Integers in other containers, such as neural networks, are sizes.
    """
    plain = lambda node: isinstance(node, tuple | list | dict)
    nodes = jax.tree.leaves(tree, is_leaf=lambda node: not plain(node))
    return jax.tree_util.all_leaves(nodes)


def theta_of_model(parameters: Parameters, dtype: jnp.dtype) -> Float[Array, " p"]:
    """Return θ of the model's parameters, in this dtype.

    **Raises:** `ValueError` if θ is empty or not finite, or if the coordinates depend on it.
    """
    theta = parameters.vector(cast_floats(parameters.params, dtype))
    if theta.size == 0:
        raise ValueError(
            "this model has no parameters to infer: pass its unknown numbers to `Diffusion` as "
            "`params=`, as floats, because integers are held fixed. If you pass `where`, let it "
            "select some of them."
        )
    if not is_traced(theta) and not np.all(np.isfinite(theta)):
        raise ValueError(
            f"the unknown parameters among `params` must be finite; got {parameters.params}."
        )
    if uses_argument(lambda theta: parameters.bind(theta).coordinate_values(), theta):
        raise ValueError(
            "the coordinates of `lamperti` depend on the unknown parameters of σ, but the "
            "observations were transformed with fixed parameters. Infer these parameters in the "
            "original coordinates, or in coordinates without parameters, such as those of "
            "`jb.transform(model, jnp.log, jnp.exp)`. Or fix the parameters of σ by `where=`."
        )
    return theta


def init_vectors(
    parameters: Parameters, init: PyTree, chains: tuple[int, ...]
) -> Float[Array, "*chains p"]:
    """Return θ of the start parameters `init`.

    If the leaves of `init` have a leading axis of chains, θ has it, too.

    **Raises:** `ValueError` if the structure or the shapes of `init` are wrong.
    """
    like = parameters.params
    if jax.tree.structure(init) != jax.tree.structure(like):
        raise ValueError(
            "`init` must be the `state` of earlier draws, or a pytree like the unknown parameters, "
            f"{jax.tree.structure(like)}; got {jax.tree.structure(init)}."
        )
    init = jax.tree.map(
        lambda leaf, value: as_floating("init", value) if eqx.is_inexact_array(leaf) else None,
        like,
        init,
    )
    floats = eqx.filter(like, eqx.is_inexact_array)
    shapes = [
        (value.shape, leaf.shape)
        for value, leaf in zip(jax.tree.leaves(init), jax.tree.leaves(floats), strict=True)
    ]
    if all(shape == leaf for shape, leaf in shapes):
        return parameters.vector(init)
    if chains and all(shape == (*chains, *leaf) for shape, leaf in shapes):
        return jax.vmap(parameters.vector)(init)
    raise ValueError(
        f"`init` must have leaves of the shapes of the unknown parameters, {[s for _, s in shapes]}"
        f"{f', or with a leading axis of {chains[0]} chains' if chains else ''}; got "
        f"{[s for s, _ in shapes]}."
    )
