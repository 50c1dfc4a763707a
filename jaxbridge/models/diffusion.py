"""A diffusion and its time reversal (sections 2 and 2.1 of the paper).

The diffusion solves `dX = α(X) dt + σ(X) dW` in R^d and is ergodic with stationary density ν.
Run backwards in time, the stationary process is a diffusion with the same σ and the drift of
equation (reversedrift),

    α*(x) = -α(x) + ν(x)⁻¹ Σ_j ∂_j(ν V_ij)(x) = -α + V ∇log ν + div V,    V = σσᵀ,

in which the normaliser of ν cancels. It is reversible if and only if α* = α, equation
(timereversible).

Two kinds of diffusions have no such reversal that couplings could use, but can be seen with noise
or in part all the same (`records`): those whose noise reaches only a part of the state at once, σ
of fewer columns than rows; and those whose coefficients α(x, t) and σ(x, t) change with time.
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

from ..engine.arguments import as_returned, check_flag, check_function, evaluated, named
from ..engine.captured import Captured
from ..engine.checks import (
    Numbers,
    as_array,
    as_floating,
    as_numbers,
    cast_floats,
    check_key,
    check_precision,
    is_traced,
    settled,
)
from ..engine.linalg import lower_factor
from . import decisions
from .dynamics import Dynamics, DynamicsAt, stationary_flux
from .sigma import NO_INVERSE, AbstractSigma, Constant, Diagonal, Full, Identity, Tall, Triangular
from .tracing import takes_time, traced_once, uses_argument

_NOT_HOMOGENEOUS = (
    "the coefficients of this model depend on time, and what was asked for is for diffusions whose "
    "do not, as are couplings, reversals, and bridges and transition densities of a duration. What "
    "is not: `simulate`, and with an `observation` `log_likelihood`, `smooth`, `innovations`, "
    "`gibbs`, `pmmh` and `maximum_likelihood`, whose times are absolute; a state that was seen "
    "exactly is `jb.LinearGaussian(covariance=0.0)`. `model.drift(x, time)` is the drift at a time."
)


_OF_POINT, _OF_TIME = "(x, params)", "(x, params, t)"


class Diffusion(eqx.Module):
    """The diffusion `dX = α(X) dt + σ(X) dW`, from pure functions of one point.

    A pytree: its leaves are the arrays of `params` (and a constant σ), so it passes through
    `jit`, `vmap` and `grad`; its functions are static and compared by identity, so define
    them once to compile once. Traced values that the functions close over are differentiated
    and batched like `params`. Such functions are traced again in every call, so prefer `params`.

    **Arguments:**

    - `drift`: α, a function `(x, params) -> (d,)` of a point `x` of shape (d,), in space per
        unit of time; or `(x, params, t)`, with a third argument that has no default, of time.
    - `diffusion`: σ. `None` is the identity; an array of shape (d, d), or (d,) for a
        diagonal, is constant; a function `(x, params)` or `(x, params, t)` returns one of these.
        Whether it uses `x` is seen when it is traced: one that does not is constant as well. In
        space per square root of a unit of time. Of full rank. Where its shape is (d, m) with
        m > d the root of V = σσᵀ stands in for it. With m < d noise reaches only a part of the
        state at once; then V has no inverse, on which couplings rest.
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
    _captured: Captured
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
        check_function("drift", drift, _OF_POINT, _OF_TIME)
        if callable(diffusion):
            check_function("diffusion", diffusion, _OF_POINT, _OF_TIME)
        for name, function, signature in [
            ("log_stationary", log_stationary, _OF_POINT),
            ("reverse_drift", reverse_drift, _OF_POINT),
            ("sample_stationary", sample_stationary, "(key, params)"),
            ("domain", domain, _OF_POINT),
            ("prepare", prepare, "(params)"),
        ]:
            check_function(name, function, signature, optional=True)
        check_flag("reversible", reversible)
        check_flag("normalised", normalised)
        if normalised and log_stationary is None:
            raise ValueError(
                "`normalised=True` is about `log_stationary`: give this function, or leave it out."
            )
        if reversible and reverse_drift is not None:
            raise ValueError(
                "`reversible=True` declares that the reverse drift is the drift: leave out "
                "`reverse_drift`, or this."
            )
        of_stationary = {
            "log_stationary": log_stationary is not None,
            "reverse_drift": reverse_drift is not None,
            "sample_stationary": sample_stationary is not None,
            "reversible": reversible,
        }
        if any(of_stationary.values()) and (takes_time(drift) or takes_time(diffusion)):
            names = ", ".join(f"`{name}`" for name, given in of_stationary.items() if given)
            raise ValueError(
                "`drift` or `diffusion` takes a third argument, the time, and a diffusion whose "
                f"coefficients depend on time is not stationary: leave out {names}."
            )
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
        self._captured = Captured(
            drift,
            self._diffusion,
            log_stationary,
            reverse_drift,
            sample_stationary,
            prepare,
            domain,
            _coordinates,
        )
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

    def drift(self, x: Numbers, time: Numbers | None = None) -> Float[Array, " d"]:
        """α(x), shape (d,), at this time where it depends on it."""
        x = _as_point(x)
        return self._at(x, time).drift(x)

    def diffusion(self, x: Numbers, time: Numbers | None = None) -> Float[Array, "d m"]:
        """σ(x) as a dense matrix, shape (d, d), or (d, m) where m < d; at this time where it
        depends on it."""
        x = _as_point(x)
        return self._at(x, time).sigma(x).as_matrix(x.shape[0], x.dtype)

    def reverse_drift(self, x: Numbers) -> Float[Array, " d"]:
        """α*(x), shape (d,): equation (reversedrift) of the paper.

        **Raises:** `ValueError` for a model without `log_stationary` or `reverse_drift` that
        is not declared reversible.
        """
        x = _as_point(x)
        return self.backward(x).drift(x)

    def log_stationary(self, x: Numbers) -> Float[Array, ""]:
        """log ν(x) up to a constant."""
        return self._log_stationary_function()(_as_point(x))

    def sample_stationary(self, key: Key[Array, ""]) -> Float[Array, " d"]:
        """One draw from ν, shape (d,), by the model's own sampler."""
        if self._sample_stationary is None:
            raise ValueError(
                "this model has no sampler of its stationary law: pass `sample_stationary=`, "
                "a function `(key, params) -> x`, to `Diffusion`."
            )
        check_key(key)
        sample = named("sample_stationary", self._captured.call)
        drawn = sample(self._sample_stationary, key, self._prepared_params())
        point = as_returned("sample_stationary", drawn)
        if point.ndim != 1:
            raise ValueError(
                "`sample_stationary` must return one point, shape (d,); it returned shape "
                f"{point.shape}."
            )
        return point

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
        if points.ndim != 2 or 0 in points.shape:
            raise ValueError(f"`points` must have shape (n, d); got {points.shape}.")
        check_precision("`points`", points.dtype)
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
        free = self._functions_with(function, None)
        object.__setattr__(free, "_captured", Captured())
        return free

    def _functions_with(
        self, diffusion: Callable | Numbers | None, prepared_params: PyTree
    ) -> "Diffusion":
        """The same functions, of parameters that need no preparation."""
        made = Diffusion(
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
        object.__setattr__(made, "_captured", self._captured)  # also within a program
        return made

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
        return (
            ()
            if self._coordinates is None
            else self._captured.call(self._coordinates, self._prepared_params())
        )

    @property
    def has_reversal(self) -> bool:
        """Whether the time reversal of this model is known."""
        given = (self._reverse_drift, self._log_stationary)
        return self.reversible or any(function is not None for function in given)

    def check_reversal(self) -> None:
        """Raise `ValueError` where the time reversal of this model is unknown."""
        if self.depends_on_time:
            raise ValueError(_NOT_HOMOGENEOUS)
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

    @property
    def depends_on_time(self) -> bool:
        """Whether the drift or σ takes the time as a third argument."""
        return takes_time(self._drift) or takes_time(self._diffusion)

    def forward(self, like: Float[Array, " d"]) -> Dynamics:
        """The coefficients α and σ at points like this one (only its shape and dtype count),
        with everything done that does not depend on the point.

        **Raises:** `ValueError` where they depend on time.
        """
        if self.depends_on_time:
            raise ValueError(_NOT_HOMOGENEOUS)
        return self.forward_at(like)(None)

    def forward_at(self, like: Float[Array, " d"]) -> DynamicsAt:
        """The same as a function of time, which does not count where nothing depends on it."""
        params = self._prepared_params()
        drift_at = self._drift_at(params)
        sigma_at, varies = self._sigma_at(params, like)
        return lambda time: Dynamics(drift_at(time), sigma_at(time), varies)

    def _at(self, x: Float[Array, " d"], time: Numbers | None) -> Dynamics:
        if time is None:
            return self.forward(x)
        return self.forward_at(x)(as_numbers({"time": time})["time"].astype(x.dtype))

    def _drift_at(self, params: PyTree) -> Callable[[Any], Callable[[Array], Array]]:
        function = self._traced_once(self._drift)
        if takes_time(self._drift):
            return lambda time: self._inside("drift", lambda x: function(x, params, time), params)
        drift = self._inside("drift", lambda x: function(x, params), params)
        return lambda time: drift

    def _sigma_at(
        self, params: PyTree, like: Float[Array, " d"]
    ) -> tuple[Callable[[Any], Callable[[Array], AbstractSigma]], bool]:
        """σ as a function of time, and whether it varies with the point."""
        if self._diffusion is None:
            constant_sigma = _as_sigma(self._constant_sigma, like)
            return lambda time: lambda x: constant_sigma, False
        function = named("diffusion", self._traced_once(self._diffusion))
        timed = takes_time(self._diffusion)

        def values(x, params, time):
            value = function(x, params, time) if timed else function(x, params)
            # Models that know the form of their σ return it.
            return value if isinstance(value, AbstractSigma) else as_returned("diffusion", value)

        now = jnp.zeros((), like.dtype)
        varies = uses_argument(lambda x: values(x, params, now), like)
        if not (varies or timed):
            constant = _as_sigma(values(jnp.zeros_like(like), params, now), like)
            return lambda time: lambda x: constant, False
        return lambda time: lambda x: _as_sigma(values(x, params, time), x, constant=False), varies

    def sigma_varies(self, like: Float[Array, " d"]) -> bool:
        """Whether σ depends on the point. Nothing is computed for the answer."""
        return self._sees(like)[0]

    def sigma_is_invertible(self, like: Float[Array, " d"]) -> bool:
        """Whether noise reaches the whole state at once. Nothing is computed for the answer."""
        return self._sees(like)[1]

    def check_invertible_sigma(self, like: Float[Array, " d"]) -> None:
        """Raise `ValueError` where noise reaches only a part of the state at once."""
        if not self.sigma_is_invertible(like):
            raise ValueError(NO_INVERSE)

    def _sees(self, like: Float[Array, " d"]) -> tuple[bool, bool]:
        def seen(model, x):
            dynamics = model.forward_at(x)(jnp.zeros((), x.dtype))
            return dynamics.sigma_varies, dynamics.sigma(x).invertible

        return eqx.filter_eval_shape(seen, self, like)

    def backward(self, like: Float[Array, " d"]) -> Dynamics:
        """The coefficients α* and σ of the time-reversed diffusion, as for `forward`."""
        self.check_reversal()
        forward = self.forward(like)
        if self.reversible:
            return forward
        derived = self.reverse_drift_effect
        params, reverse_drift = self._prepared_params(), self._reverse_drift
        if reverse_drift is not None and not derived.simulated:
            function = self._traced_once(reverse_drift)
            drift = self._inside("reverse_drift", lambda x: function(x, params), params)
        else:
            log_nu = self._log_stationary_function()
            divergence = decisions.divergence(derived, forward.sigma_varies).simulated

            def derived_drift(x):
                return -forward.drift(x) + stationary_flux(forward, log_nu, x, divergence)

            drift = derived_drift

        return forward._replace(drift=drift)

    def _inside(
        self, name: str, values: Callable[[Float[Array, " d"]], Array], params: PyTree
    ) -> Callable[[Float[Array, " d"]], Float[Array, " d"]]:
        """A drift with these values, NaN outside the state space: a path that steps out is lost
        with the next step, and no bridge ends there."""
        inside = self._state_space(params)

        values = named(name, values)

        def drift(x):
            value = check_value(name, values(x), x.shape, x)
            return value if inside is None else jnp.where(inside(x), value, jnp.nan)

        return drift

    def state_space(self) -> Callable[[Float[Array, " d"]], Bool[Array, ""]] | None:
        """Whether a point is inside, a function with everything done that does not depend on it;
        `None` where the state space is all of R^d."""
        return self._state_space(self._prepared_params())

    def _state_space(self, params: PyTree) -> Callable[[Array], Array] | None:
        if self._domain is None:
            return None
        domain = named("domain", functools.partial(self._captured.call, self._domain))

        def inside(x):
            value = as_returned("domain", domain(x, params))
            if value.shape != () or value.dtype != bool:
                raise ValueError(
                    "`domain` must return one truth value, such as `jnp.all(x > 0)`; it returned "
                    f"shape {value.shape} and dtype {value.dtype}."
                )
            return value

        return inside

    def _traced_once(self, function: Callable) -> Callable:
        once = traced_once(function)
        return lambda *args: self._captured.call(function, *args, plain=once)

    def _prepared_params(self) -> PyTree:
        if self._prepare is None:
            return self.params
        return named("prepare", self._captured.call)(self._prepare, self.params)

    def _log_stationary_function(self) -> Callable[[Array], Array]:
        if self._log_stationary is None:
            raise ValueError(
                "this model has no stationary density: pass `log_stationary=` to `Diffusion`."
            )
        params = self._prepared_params()
        log_stationary = named("log_stationary", self._traced_once(self._log_stationary))
        return lambda x: check_value("log_stationary", log_stationary(x, params), (), x)


def _as_sigma(
    values: Numbers | AbstractSigma | None, x: Float[Array, " d"], constant: bool = True
) -> AbstractSigma:
    if values is None:
        return Identity()
    d = x.shape[0]
    if isinstance(values, AbstractSigma):
        sigma: AbstractSigma = cast_floats(values, x.dtype)
        as_it_is = isinstance(sigma, Identity) or not constant
        return sigma if as_it_is else Constant(sigma.as_matrix(d, x.dtype))
    values = as_returned("diffusion", values)
    if values.shape != (d,) and not (values.ndim == 2 and values.shape[0] == d and values.size):
        raise ValueError(
            f"`diffusion` must have shape ({d}, m) for noise of m dimensions, or ({d},) for a "
            f"diagonal, at a point of shape ({d},); it has {values.shape}."
        )
    values = values.astype(x.dtype)
    if values.ndim == 1:
        return Diagonal(values)
    if values.shape[1] < d:
        return Tall(values)
    if values.shape[1] > d:
        values = lower_factor(values)
        return Constant(values) if constant else Triangular(values)
    return Constant(values) if constant else Full(values)


def _as_point(x: Numbers) -> Float[Array, " d"]:
    """Return a point of the state space.

    **Raises:** `ValueError` for anything but a vector, `TypeError` for less than single precision.
    """
    x = as_floating("x", x)
    if x.ndim != 1 or not x.size:
        raise ValueError(f"`x` must be a point, shape (d,); got shape {x.shape}.")
    check_precision("`x`", x.dtype)
    return x


def check_value(name: str, value: Numbers, shape: tuple, x: Float[Array, " d"]) -> Array:
    value = as_returned(name, value)
    if value.shape != shape:
        raise ValueError(
            f"`{name}` must return shape {shape} at a point of shape {x.shape}; "
            f"it returned {value.shape}."
        )
    return value.astype(x.dtype)


def value_at(
    name: str, function: Callable, shape: tuple, x: Float[Array, " d"], *others: Any
) -> Array:
    """Return `function(x, *others)`, in the dtype of `x`.

    **Raises:** `ValueError` and `TypeError` with its name, for its errors and for another shape.
    """
    return check_value(name, evaluated(name, function, x, *others), shape, x)


def check_dimension(x: Float[Array, " d"], dim: int) -> None:
    """Raise `ValueError` where a model whose dimension is known is asked of another point."""
    if x.shape != (dim,):
        raise ValueError(
            f"the `drift` of this `model` is for points of shape ({dim},); it was called at a "
            f"point `x` of shape {x.shape}."
        )


def halves(x: Float[Array, " d"], what: str) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """The two halves of a state, which are `what`.

    **Raises:** `ValueError` for one of an odd number of coordinates.
    """
    if x.shape[0] % 2:
        raise ValueError(f"the state `x` is {what}; got shape {x.shape}.")
    first, second = jnp.split(x, 2)
    return first, second


@functools.lru_cache(maxsize=256)
def _constant_function(values: tuple) -> Callable:
    """σ as a function of a point, the same one for the same numbers."""
    return lambda x, params: jnp.asarray(np.array(values), x.dtype)


def _as_tuples(sigma: Array) -> tuple:
    return tuple(tuple(row) if isinstance(row, list) else row for row in sigma.tolist())


def _check_constant_sigma(sigma: Numbers) -> Array:
    sigma = as_floating("diffusion", sigma)
    check_precision("`diffusion`", sigma.dtype)
    if sigma.ndim not in (1, 2) or 0 in sigma.shape:
        raise ValueError(
            "a constant `diffusion` must have shape (d, m) for noise of m dimensions, or (d,) for "
            f"a diagonal; got {sigma.shape}."
        )
    tall = " (or have fewer columns, where noise reaches only a part of the state)"
    check_invertible("diffusion", sigma, tall)
    return sigma


def check_diffusion(model) -> None:
    """Raise `TypeError` for anything but a model."""
    if not isinstance(model, Diffusion):
        raise TypeError(f"`model` must be a `jaxbridge.Diffusion`; got {type(model).__name__}.")


def check_invertible(name: str, sigma: Array | np.ndarray, otherwise: str = "") -> None:
    """Raise `ValueError` for a visibly singular or non-finite σ, which says what it may be
    `otherwise`; silent while tracing."""
    if is_traced(sigma):
        return
    matrix = np.diag(sigma) if sigma.ndim == 1 else np.asarray(sigma)
    if not np.all(np.isfinite(matrix)):
        raise ValueError(f"`{name}` must be finite; got {matrix}.")
    if np.linalg.cond(matrix) > 1 / np.finfo(matrix.dtype).eps:
        raise ValueError(
            f"`{name}` must be invertible{otherwise}; got the singular matrix {matrix}."
        )


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
        return settled(as_array(float(leaf)))
    arrays = np.ndarray | np.generic | jax.Array
    if not isinstance(leaf, arrays):
        return leaf
    try:
        return settled(as_array(leaf))
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"`params` must have arrays of numbers; got one of dtype {leaf.dtype}."
        ) from error
