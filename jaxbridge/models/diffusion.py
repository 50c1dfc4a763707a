"""A diffusion and its time reversal (sections 2 and 2.1 of the paper).

The diffusion solves `dX = α(X) dt + σ(X) dW` in R^d and is ergodic with stationary density ν.
Run backwards in time, the stationary process is a diffusion with the same σ and the drift of
equation (reversedrift),

    α*(x) = -α(x) + ν(x)⁻¹ Σ_j ∂_j(ν V_ij)(x) = -α + V ∇log ν + div V,    V = σσᵀ,

in which the normaliser of ν cancels. It is reversible if and only if α* = α, equation
(timereversible).
"""

import copy
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Inexact, Key, PyTree

from ..engine.checks import Numbers, as_floating, cast_floats, is_traced
from . import decisions
from .dynamics import Dynamics, stationary_flux
from .sigma import AbstractSigma, Constant, Diagonal, Full, Identity
from .tracing import traced_once, uses_argument


class Diffusion(eqx.Module):
    """The diffusion `dX = α(X) dt + σ(X) dW`, from pure functions of one point.

    A pytree: its leaves are the arrays of `params` (and a constant σ), so it passes through
    `jit`, `vmap` and `grad`; its functions are static and compared by identity, so define
    them once to compile once. Differentiate and batch with respect to `params`, not with
    respect to values that the functions close over.

    **Arguments:**

    - `drift`: α, a function `(x, params) -> (d,)` of a point `x` of shape (d,), in space per
        unit of time.
    - `diffusion`: σ. `None` is the identity; an array of shape (d, d), or (d,) for a
        diagonal, is constant; a function `(x, params)` returns one of these. Whether it
        uses `x` is seen when it is traced: one that does not is constant as well. In space per
        square root of a unit of time. Must be invertible.
    - `log_stationary`: log ν up to a constant, `(x, params) -> ()`.
    - `params`: any pytree. Floating point numbers in it become JAX arrays, and whatever is no array
        stays what it is: whole numbers, truth values, names, the activation of a neural network.
        These are static: another value compiles again, and they are neither inferred nor
        differentiated. So write 1.0 for a rate.
    - `reverse_drift`: α*, `(x, params) -> (d,)`, where it is known in closed form. Otherwise
        it comes from `log_stationary` by automatic differentiation.
    - `sample_stationary`: an exact sampler of ν, `(key, params) -> (d,)`.
    - `reversible`: declare α* = α; then no reverse drift is computed. See
        `reversibility_residual` for a check.
    - `normalised`: declare that `log_stationary` is the logarithm of a density, not only up to a
        constant. Transition densities by couplings from the stationary law rest on it.
    - `domain`: the state space, where it is not all of R^d: a function `(x, params)` to whether x
        is inside. A path that leaves it is a miss, and counted among `num_nonfinite`. Where paths
        come near the boundary, `transform` loses none of them.
    - `prepare`: maps `params` to what the functions above receive in their place, for
        quantities that depend on the parameters but not on the point. It runs once per call,
        outside every loop.

    **Raises:** `TypeError` where a function is not callable; `ValueError` for a constant σ of
    a wrong shape, or singular.

    **Example:**

    ```python
    model = jb.Diffusion(lambda x, p: -p * x, None, lambda x, p: -p * x @ x, params=1.0)
    model.reverse_drift(jnp.ones(2))  # Array([-1., -1.], dtype=float32)
    ```
    """

    _drift: Callable = eqx.field(static=True)
    _diffusion: Callable | None = eqx.field(static=True)
    _log_stationary: Callable | None = eqx.field(static=True)
    _reverse_drift: Callable | None = eqx.field(static=True)
    _sample_stationary: Callable | None = eqx.field(static=True)
    _prepare: Callable | None = eqx.field(static=True)
    _domain: Callable | None = eqx.field(static=True)
    _coordinates: Callable | None = eqx.field(static=True)
    _constant_sigma: Inexact[Array, "..."] | None
    _numbers: PyTree
    _others: "_Others" = eqx.field(static=True)
    reversible: bool = eqx.field(static=True)
    normalised: bool = eqx.field(static=True)

    def __init__(
        self,
        drift: Callable,
        diffusion: Callable | Numbers | None = None,
        log_stationary: Callable | None = None,
        params: PyTree = None,
        *,
        reverse_drift: Callable | None = None,
        sample_stationary: Callable | None = None,
        reversible: bool = False,
        normalised: bool = False,
        domain: Callable | None = None,
        prepare: Callable | None = None,
        _coordinates: Callable | None = None,
    ):
        for name, function in [
            ("drift", drift),
            ("log_stationary", log_stationary),
            ("reverse_drift", reverse_drift),
            ("sample_stationary", sample_stationary),
            ("domain", domain),
            ("prepare", prepare),
        ]:
            if not (callable(function) or (function is None and name != "drift")):
                raise TypeError(f"`{name}` must be a function, got {function!r}.")
        self._drift = drift
        self._log_stationary = log_stationary
        self._reverse_drift = reverse_drift
        self._sample_stationary = sample_stationary
        self._prepare = prepare
        self._domain = domain
        self._coordinates = _coordinates
        if diffusion is None or callable(diffusion):
            self._diffusion, self._constant_sigma = diffusion, None
        else:
            self._diffusion, self._constant_sigma = None, _check_constant_sigma(diffusion)
        self._numbers, self._others = _parts(params)
        self.reversible = reversible
        self.normalised = normalised

    @property
    def params(self) -> PyTree:
        """The parameters, as they were given, but for numbers that have become arrays."""
        others, structure = self._others
        leaves = structure.flatten_up_to(self._numbers)
        for place, leaf in others:
            leaves[place] = leaf
        return structure.unflatten(leaves)

    def drift(self, x: Numbers) -> Float[Array, " d"]:
        """α(x), shape (d,)."""
        x = as_floating("x", x)
        return self.forward(x).drift(x)

    def diffusion(self, x: Numbers) -> Float[Array, "d d"]:
        """σ(x) as a dense matrix, shape (d, d)."""
        x = as_floating("x", x)
        return self.forward(x).sigma(x).as_matrix(x.shape[0], x.dtype)

    def reverse_drift(self, x: Numbers) -> Float[Array, " d"]:
        """α*(x), shape (d,): equation (reversedrift) of the paper.

        **Raises:** `ValueError` for a model without `log_stationary` or `reverse_drift` that
        is not declared reversible.
        """
        x = as_floating("x", x)
        return self.backward(x).drift(x)

    def log_stationary(self, x: Numbers) -> Float[Array, ""]:
        """log ν(x) up to a constant."""
        return self._log_stationary_function()(as_floating("x", x))

    def sample_stationary(self, key: Key[Array, ""]) -> Float[Array, " d"]:
        """One draw from ν, shape (d,), by the model's own sampler."""
        if self._sample_stationary is None:
            raise ValueError(
                "this model has no sampler of its stationary law: pass `sample_stationary=`, "
                "a function `(key, params) -> x`, to `Diffusion`."
            )
        return self._sample_stationary(key, self._prepared_params())

    @property
    def has_sampler(self) -> bool:
        """Whether the model comes with a sampler of its stationary law."""
        return self._sample_stationary is not None

    @property
    def has_density(self) -> bool:
        """Whether the model knows its stationary density."""
        return self._log_stationary is not None

    @property
    def has_reverse_drift(self) -> bool:
        """Whether the drift of the reversed diffusion was given, and need not be derived."""
        return self._reverse_drift is not None

    def reversibility_residual(self, points: Numbers) -> Float[Array, "n d"]:
        """α - ½ (V ∇log ν + div V) at each of the points, shape (n, d).

        Zero everywhere if and only if the diffusion is time-reversible: equation
        (timereversible) of the paper, divided by ν.
        """
        points = as_floating("points", points)
        forward, log_nu = self.forward(points[0]), self._log_stationary_function()
        divergence = forward.sigma_varies
        flux = functools.partial(stationary_flux, forward, log_nu, divergence=divergence)
        return jax.vmap(lambda x: forward.drift(x) - flux(x) / 2)(points)

    def with_params(self, params: PyTree) -> "Diffusion":
        """The same functions with other parameters."""
        made = copy.copy(self)
        # `eqx.tree_at` would not reach what is static.
        for name, part in zip(("_numbers", "_others"), _parts(params), strict=True):
            object.__setattr__(made, name, part)
        return made

    def prepared(self) -> "Diffusion":
        """The same model with `prepare` done, so that no loop repeats it."""
        if self._prepare is None:
            return self
        sigma = self._constant_sigma if self._diffusion is None else self._diffusion
        return self._functions_with(sigma, self._prepared_params())

    def unbound(self) -> "Diffusion":
        """The functions alone, for `with_params` of what `preparation` makes of the parameters. It
        has no arrays, and can be compared and hashed.

        **Raises:** `ValueError` for a constant σ that is traced.
        """
        sigma = self._constant_sigma
        if is_traced(sigma):
            raise ValueError(
                "this model has a constant σ that is traced: let `diffusion` be a function "
                "`(x, params)` that finds it in `params`."
            )
        function = self._diffusion if sigma is None else _constant_function(_as_tuples(sigma))
        return self._functions_with(function, None)

    def _functions_with(
        self, diffusion: Callable | Numbers | None, prepared_params: PyTree
    ) -> "Diffusion":
        """The same functions, of parameters that need no preparation."""
        return Diffusion(
            self._drift,
            diffusion,
            self._log_stationary,
            prepared_params,
            reverse_drift=self._reverse_drift,
            sample_stationary=self._sample_stationary,
            reversible=self.reversible,
            normalised=self.normalised,
            domain=self._domain,
            _coordinates=self._coordinates,
        )

    @property
    def preparation(self) -> Callable | None:
        """`prepare`, as it was given."""
        return self._prepare

    @property
    def coordinates(self) -> Callable[[PyTree], PyTree] | None:
        """Where the coordinates of the model depend on its parameters, as those of `lamperti` do:
        a function of the prepared parameters, to values that depend on the same of them."""
        return self._coordinates

    def coordinate_values(self) -> PyTree:
        """The values of that function, none where the coordinates are fixed."""
        return () if self._coordinates is None else self._coordinates(self._prepared_params())

    @property
    def has_reversal(self) -> bool:
        """Whether the time reversal of this model is known."""
        given = (self._reverse_drift, self._log_stationary)
        return self.reversible or any(function is not None for function in given)

    def check_reversal(self) -> None:
        """Raise `ValueError` where the time reversal of this model is unknown."""
        if not self.has_reversal:
            raise ValueError(
                "the time reversal of this model is unknown, and couplings need it: give "
                "`Diffusion` a `log_stationary` (up to a constant), a `reverse_drift`, or "
                "`reversible=True`; or choose a proposal that does not need it, such as "
                "`ModifiedDiffusionBridge()` or `Guided()`."
            )

    @property
    def reverse_drift_effect(self) -> decisions.Effect:
        """Whether α* comes by automatic differentiation."""
        return decisions.reverse_drift(self.reversible, self._reverse_drift is not None)

    def forward(self, like: Float[Array, " d"]) -> Dynamics:
        """The coefficients α and σ at points like this one (only its shape and dtype count),
        with everything done that does not depend on the point."""
        params = self._prepared_params()
        drift = self._inside("drift", self._drift, params)

        if self._diffusion is not None:
            diffusion = traced_once(self._diffusion)

            def sigma(x):
                return _as_sigma(diffusion(x, params), x, constant=False)

            if uses_argument(lambda x: diffusion(x, params), like):
                return Dynamics(drift, sigma, sigma_varies=True)
            constant_sigma = _as_sigma(diffusion(jnp.zeros_like(like), params), like)
        else:
            constant_sigma = _as_sigma(self._constant_sigma, like)
        return Dynamics(drift, lambda x: constant_sigma, sigma_varies=False)

    def sigma_varies(self, like: Float[Array, " d"]) -> bool:
        """Whether σ depends on the point. Nothing is computed for the answer."""
        return eqx.filter_eval_shape(lambda model, x: model.forward(x).sigma_varies, self, like)

    def backward(self, like: Float[Array, " d"]) -> Dynamics:
        """The coefficients α* and σ of the time-reversed diffusion, as for `forward`."""
        self.check_reversal()
        forward = self.forward(like)
        if self.reversible:
            return forward
        derived = self.reverse_drift_effect
        params, reverse_drift = self._prepared_params(), self._reverse_drift
        if reverse_drift is not None and not derived.simulated:
            drift = self._inside("reverse_drift", reverse_drift, params)
        else:
            log_nu = self._log_stationary_function()
            divergence = decisions.divergence(derived, forward.sigma_varies).simulated

            def derived_drift(x):
                return -forward.drift(x) + stationary_flux(forward, log_nu, x, divergence)

            drift = derived_drift

        return forward._replace(drift=drift)

    def _inside(
        self, name: str, function: Callable, params: PyTree
    ) -> Callable[[Float[Array, " d"]], Float[Array, " d"]]:
        """A drift, NaN outside the state space: a path that steps out is lost with the next step,
        and no bridge ends there."""
        inside, function = self._state_space(params), traced_once(function)

        def drift(x):
            value = check_value(name, function(x, params), x.shape, x)
            return value if inside is None else jnp.where(inside(x), value, jnp.nan)

        return drift

    def state_space(self) -> Callable[[Float[Array, " d"]], Bool[Array, ""]] | None:
        """Whether a point is inside, a function with everything done that does not depend on it;
        `None` where the state space is all of R^d."""
        return self._state_space(self._prepared_params())

    def _state_space(self, params: PyTree) -> Callable[[Array], Array] | None:
        domain = self._domain
        if domain is None:
            return None

        def inside(x):
            value = jnp.asarray(domain(x, params))
            if value.shape != () or value.dtype != bool:
                raise ValueError(
                    "`domain` must return one truth value, such as `jnp.all(x > 0)`; it returned "
                    f"shape {value.shape} and dtype {value.dtype}."
                )
            return value

        return inside

    def _prepared_params(self) -> PyTree:
        return self.params if self._prepare is None else self._prepare(self.params)

    def _log_stationary_function(self) -> Callable[[Array], Array]:
        if self._log_stationary is None:
            raise ValueError(
                "this model has no stationary density: pass `log_stationary=` to `Diffusion`."
            )
        params, log_stationary = self._prepared_params(), traced_once(self._log_stationary)
        return lambda x: check_value("log_stationary", log_stationary(x, params), (), x)


def _as_sigma(
    values: Numbers | AbstractSigma | None, x: Float[Array, " d"], constant: bool = True
) -> AbstractSigma:
    if values is None:
        return Identity()
    d = x.shape[0]
    if isinstance(values, AbstractSigma):  # of a model that knows the form of its σ
        sigma: AbstractSigma = cast_floats(values, x.dtype)
        return Constant(sigma.as_matrix(d, x.dtype)) if constant else sigma
    values = _as_real("diffusion", values)
    if values.shape not in ((d,), (d, d)):
        raise ValueError(
            f"`diffusion` must have shape ({d}, {d}), or ({d},) for a diagonal, at a point of "
            f"shape ({d},); it has {values.shape}."
        )
    values = values.astype(x.dtype)
    if values.ndim == 1:
        return Diagonal(values)
    return Constant(values) if constant else Full(values)


def check_value(name: str, value: Numbers, shape: tuple, x: Float[Array, " d"]) -> Array:
    value = _as_real(name, value)
    if value.shape != shape:
        raise ValueError(
            f"`{name}` must return shape {shape} at a point of shape {x.shape}; "
            f"it returned {value.shape}."
        )
    return value.astype(x.dtype)


def _as_real(name: str, value: Numbers) -> Array:
    value = jnp.asarray(value)
    if jnp.iscomplexobj(value):
        raise TypeError(
            f"`{name}` must return real numbers; it returned dtype {value.dtype}: write a complex "
            "equation in its real and imaginary parts."
        )
    return value


def check_dimension(x: Float[Array, " d"], dim: int) -> None:
    """Raise `ValueError` where a model whose dimension is known is asked of another point."""
    if x.shape != (dim,):
        raise ValueError(
            f"the `drift` of this model is for points of shape ({dim},); it was called at a point "
            f"of shape {x.shape}."
        )


@functools.lru_cache(maxsize=256)
def _constant_function(values: tuple) -> Callable:
    """σ as a function of a point, the same one for the same numbers."""
    return lambda x, params: jnp.asarray(np.array(values), x.dtype)


def _as_tuples(sigma: Array) -> tuple:
    return tuple(tuple(row) if isinstance(row, list) else row for row in sigma.tolist())


def _check_constant_sigma(sigma: Numbers) -> Array:
    sigma = as_floating("diffusion", sigma)
    square = sigma.ndim == 2 and sigma.shape[0] == sigma.shape[1]
    if not (square or sigma.ndim == 1):
        raise ValueError(
            "a constant `diffusion` must have shape (d, d), or (d,) for a diagonal; "
            f"got {sigma.shape}."
        )
    check_invertible("diffusion", sigma)
    return sigma


def check_diffusion(model) -> None:
    """Raise `TypeError` for anything but a model."""
    if not isinstance(model, Diffusion):
        raise TypeError(f"`model` must be a `jaxbridge.Diffusion`; got {type(model).__name__}.")


def check_invertible(name: str, sigma: Array | np.ndarray) -> None:
    """Raise `ValueError` for a visibly singular or non-finite σ; silent while tracing."""
    if is_traced(sigma):
        return
    matrix = np.diag(sigma) if sigma.ndim == 1 else np.asarray(sigma)
    if not np.all(np.isfinite(matrix)):
        raise ValueError(f"`{name}` must be finite; got {matrix}.")
    if np.linalg.cond(matrix) > 1 / np.finfo(matrix.dtype).eps:
        raise ValueError(f"`{name}` must be invertible; got the singular matrix {matrix}.")


class _Others(NamedTuple):
    """Of a pytree, the leaves that are no arrays, each with its place, and its structure."""

    leaves: tuple[tuple[int, Any], ...]
    structure: Any


def _parts(params: PyTree) -> tuple[PyTree, _Others]:
    """The arrays of the parameters, and the rest of them."""
    leaves, structure = jax.tree.flatten(jax.tree.map(_as_leaf, params))
    numbers = structure.unflatten([leaf if _is_number(leaf) else None for leaf in leaves])
    others = [(i, leaf) for i, leaf in enumerate(leaves) if not _is_number(leaf)]
    return numbers, _Others(tuple(others), structure)


def _is_number(leaf) -> bool:
    return eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct)


def _as_leaf(leaf):
    if isinstance(leaf, float):
        # `asarray` keeps Python numbers weakly typed, so they follow the precision of the points.
        return jnp.asarray(float(leaf))
    return jnp.asarray(leaf) if isinstance(leaf, np.ndarray | np.generic) else leaf
