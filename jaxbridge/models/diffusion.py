"""Diffusions and their time reversal (sections 2 and 2.1 of the paper).

A diffusion solves `dX = α(X) dt + σ(X) dW` in R^d and is ergodic with stationary density ν. The
stationary process in reversed time is a diffusion with the same σ. Equation (reversedrift) is its
drift:

    α*(x) = -α(x) + ν(x)⁻¹ Σ_j ∂_j(ν V_ij)(x) = -α + V ∇log ν + div V,    V = σσᵀ.

The normaliser of ν cancels. The diffusion is reversible if and only if α* = α, equation
(timereversible).

Couplings need this reversal and an inverse of σ; guided bridges need the inverse. Two kinds of
models are only for simulation and for noisy or partial observations (`simulate`, `records`):

- Hypoelliptic models: σ has fewer columns than rows, so noise enters only some coordinates.
- Time-dependent models: coefficients α(x, t) and σ(x, t), so there is no stationary density.
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
    drop_weak_type,
    is_traced,
)
from ..engine.linalg import lower_factor
from . import decisions
from .dynamics import Dynamics, DynamicsAt, is_linear, stationary_flux
from .sigma import NO_INVERSE, AbstractSigma, Constant, Diagonal, Full, Identity, Tall, Triangular
from .tracing import takes_time, traced_once, uses_argument

_NOT_HOMOGENEOUS = (
    "the coefficients of this `model` depend on time. Couplings, reversals, bridges and transition "
    "densities of a `duration` need coefficients that do not. Use `simulate`; or, with an "
    "`observation` and absolute times, `log_likelihood`, `smooth`, `innovations`, `gibbs`, `pmmh` "
    "and `maximum_likelihood`. For an exactly observed state the `observation` is "
    "`jb.LinearGaussian(covariance=0.0)`. `model.drift(x, time)` is the drift at one time."
)

# Signatures of the user's functions, for error messages.
_OF_POINT, _OF_TIME = "(x, params)", "(x, params, t)"


class Diffusion(eqx.Module):
    """Diffusion `dX = α(X) dt + σ(X) dW`, defined by pure functions of one point.

    A `Diffusion` is a pytree. Its leaves are the arrays in `params` (and a constant σ), so it
    passes through `jit`, `vmap` and `grad`. Its functions are static and compared by identity:
    define them once, and programs compile once. Functions may close over traced values, which are
    differentiated and batched like `params`. But then every call traces the functions again, so
    prefer `params`.

    **Arguments:**

    - `drift`: α, in space per unit of time. A function `(x, params) -> (d,)` of a point `x` of
        shape (d,). If α depends on time, a function `(x, params, t)`; `t` must have no default.
    - `diffusion`: σ, in space per square root of a unit of time, of full rank. `None` is the
        identity. An array of shape (d, m), or (d,) for a diagonal, is a constant σ. A function
        `(x, params)` or `(x, params, t)` returns such an array. If tracing shows that it does not
        use `x`, σ is constant too. For m > d the model uses the triangular root of V = σσᵀ instead
        of σ. For m < d noise enters only some coordinates. Then V has no inverse, and bridges
        between exact states and transition densities do not apply.
    - `log_stationary`: log ν up to a constant, `(x, params) -> ()`.
    - `params`: any pytree. Floating point numbers in it become JAX arrays. Leaves that are not
        arrays are static: integers, booleans, strings, the activation function of a neural network.
        A new static value compiles a new program; it is neither inferred nor differentiated. So
        write 1.0, not 1, for a rate.
    - `reverse_drift`: α* in closed form, `(x, params) -> (d,)`. By default α* is derived from
        `log_stationary` by automatic differentiation.
    - `sample_stationary`: an exact sampler of ν, `(key, params) -> (d,)`.
    - `reversible`: declare that α* = α, so that no reverse drift is computed.
        `reversibility_residual` checks it.
    - `normalised`: declare that `log_stationary` is the logarithm of a normalised density.
        Transition densities from couplings that start in the stationary law need it.
    - `domain`: the state space, if it is not all of R^d. A function `(x, params) -> ()` that is
        true inside. A path that leaves the state space is lost, and counts in `num_nonfinite`. If
        paths come near the boundary, use `transform`, which loses no paths there.
    - `prepare`: a function `(params)`. The functions above receive its result instead of `params`.
        Use it for quantities that depend on the parameters only. It runs once per call, outside
        every loop.

    **Raises:** `TypeError` for functions that cannot be called with these arguments, and for flags
    that are not Booleans. `ValueError` for a constant σ that is singular, not finite or of a wrong
    shape; for stationary functions of a model that depends on time; for declarations that
    contradict the functions.

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
    _arrays: PyTree
    _static_leaves: "_StaticLeaves" = eqx.field(static=True)
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
                "`normalised=True` describes `log_stationary`: pass this function or leave out "
                "`normalised`."
            )
        if reversible and reverse_drift is not None:
            raise ValueError(
                "`reversible=True` declares that the reverse drift is the drift: leave out "
                "`reverse_drift` or `reversible`."
            )
        # Arguments that describe a stationary law, which a time-dependent model lacks.
        of_stationary_law = {
            "log_stationary": log_stationary is not None,
            "reverse_drift": reverse_drift is not None,
            "sample_stationary": sample_stationary is not None,
            "reversible": reversible,
        }
        if any(of_stationary_law.values()) and (takes_time(drift) or takes_time(diffusion)):
            names = ", ".join(
                f"`{name}`" for name, is_given in of_stationary_law.items() if is_given
            )
            raise ValueError(
                "`drift` or `diffusion` takes the time as a third argument, and a diffusion whose "
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
        self._arrays, self._static_leaves = _split_params(params)
        # Traced values in the closures of these functions become leaves of the model.
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
        """Return the parameters, with floating point numbers as arrays."""
        # Arrays are dynamic and other leaves static fields: put them together.
        static_leaves, structure = self._static_leaves
        leaves = structure.flatten_up_to(self._arrays)
        for index, leaf in static_leaves:
            leaves[index] = leaf
        return structure.unflatten(leaves)

    def drift(self, x: Numbers, time: Numbers | None = None) -> Float[Array, " d"]:
        """Return α(x), shape (d,), or α(x, `time`) if the drift depends on time.

        **Raises:** `ValueError` without a `time` if the coefficients depend on time.
        """
        x = _as_point(x)
        return self._dynamics_at(x, time).drift(x)

    def diffusion(self, x: Numbers, time: Numbers | None = None) -> Float[Array, "d m"]:
        """Return σ(x), or σ(x, `time`) if σ depends on time, as a dense matrix: shape (d, d), or
        (d, m) for m < d. For m > d return the triangular root of V = σσᵀ, shape (d, d).

        **Raises:** `ValueError` without a `time` if the coefficients depend on time.
        """
        x = _as_point(x)
        return self._dynamics_at(x, time).sigma(x).as_matrix(x.shape[0], x.dtype)

    def reverse_drift(self, x: Numbers) -> Float[Array, " d"]:
        """Return α*(x), shape (d,): the drift of the time reversal (section 2 of the paper).

        **Raises:** `ValueError` for a model that is not declared reversible and has neither
        `log_stationary` nor `reverse_drift`, and if the coefficients depend on time.
        """
        x = _as_point(x)
        return self.backward(x).drift(x)

    def log_stationary(self, x: Numbers) -> Float[Array, ""]:
        """Return log ν(x) up to a constant, shape ().

        **Raises:** `ValueError` for a model without a stationary density.
        """
        return self._log_stationary_function()(_as_point(x))

    def sample_stationary(self, key: Key[Array, ""]) -> Float[Array, " d"]:
        """Sample one point from ν, shape (d,), with the model's own sampler.

        **Raises:** `ValueError` for a model without a sampler.
        """
        if self._sample_stationary is None:
            raise ValueError(
                "this model has no sampler of its stationary law: pass `sample_stationary=`, "
                "a function `(key, params) -> x`, to `Diffusion`."
            )
        check_key(key)
        sample = named("sample_stationary", self._captured.call)
        value = sample(self._sample_stationary, key, self._prepared_params())
        point = as_returned("sample_stationary", value)
        if point.ndim != 1:
            raise ValueError(
                "`sample_stationary` must return one point, shape (d,); it returned shape "
                f"{point.shape}."
            )
        return point

    @property
    def has_sampler(self) -> bool:
        """Return whether the model has a sampler of its stationary law."""
        return self._sample_stationary is not None

    @property
    def has_density(self) -> bool:
        """Return whether the model has a stationary density."""
        return self._log_stationary is not None

    @property
    def has_reverse_drift(self) -> bool:
        """Return whether the model has a reverse drift in closed form."""
        return self._reverse_drift is not None

    def reversibility_residual(self, points: Numbers) -> Float[Array, "n d"]:
        """Return α - ½ (V ∇log ν + div V) at each of the `points`, shape (n, d).

        It is zero everywhere if and only if the diffusion is reversible. This is the paper's
        condition of reversibility (section 2), divided by ν.

        **Raises:** `ValueError` for points of another shape and for a model without a stationary
        density.
        """
        points = as_floating("points", points)
        if points.ndim != 2 or 0 in points.shape:
            raise ValueError(f"`points` must have shape (n, d); got {points.shape}.")
        check_precision("`points`", points.dtype)
        forward, log_nu = self.forward(points[0]), self._log_stationary_function()
        # V ∇log ν + div V = α + α*, which is 2α for a reversible diffusion.
        divergence = forward.sigma_varies  # div V = 0 for a constant σ
        flux = functools.partial(stationary_flux, forward, log_nu, divergence=divergence)
        return jax.vmap(lambda x: forward.drift(x) - flux(x) / 2)(points)

    def with_params(self, params: PyTree) -> "Diffusion":
        """Return the same model with other parameters."""
        model = copy.copy(self)
        # `eqx.tree_at` cannot replace static fields.
        for name, value in zip(("_arrays", "_static_leaves"), _split_params(params), strict=True):
            object.__setattr__(model, name, value)
        return model

    def prepared(self) -> "Diffusion":
        """Return the model with prepared parameters, so that no loop repeats `prepare`."""
        if self._prepare is None:
            return self
        # `diffusion` as the constructor received it: a constant or a function.
        sigma = self._constant_sigma if self._diffusion is None else self._diffusion
        return self._with_prepared_params(sigma, self._prepared_params())

    def unbound(self) -> "Diffusion":
        """Return the functions alone: a model without parameters, `prepare` and arrays.

        It can be compared and hashed. Pass prepared parameters, from `preparation`, to the
        `with_params` of the result.

        **Raises:** `ValueError` for a constant σ that is traced.
        """
        sigma = self._constant_sigma
        if is_traced(sigma):
            raise ValueError(
                "this model has a constant σ that is traced: put it into `params`, and pass a "
                "function `(x, params)` as `diffusion` that returns it."
            )
        function = self._diffusion if sigma is None else _constant_function(_as_tuples(sigma))
        model = self._with_prepared_params(function, None)
        # Traced values in closures would prevent comparison and hashing.
        object.__setattr__(model, "_captured", Captured())
        return model

    def _with_prepared_params(
        self, diffusion: Callable | Numbers | None, prepared_params: PyTree
    ) -> "Diffusion":
        """Return a model with the same functions, for parameters that need no preparation."""
        model = Diffusion(
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
        object.__setattr__(model, "_captured", self._captured)  # keep traced closures
        return model

    @property
    def preparation(self) -> Callable | None:
        """Return the function `prepare`, or `None`."""
        return self._prepare

    @property
    def coordinates(self) -> Callable[[PyTree], PyTree] | None:
        """Return a function of parameters with values that coordinates of the state depend on.

        Only models from `lamperti` have one: their coordinates depend on the parameters of σ. It is
        `None` for other models.
        """
        return self._coordinates

    def coordinate_values(self) -> PyTree:
        """Return the values of `coordinates` for these parameters; `()` for fixed coordinates."""
        return (
            ()
            if self._coordinates is None
            else self._captured.call(self._coordinates, self._prepared_params())
        )

    @property
    def has_reversal(self) -> bool:
        """Return whether the time reversal of this model is known."""
        functions = (self._reverse_drift, self._log_stationary)
        return self.reversible or any(function is not None for function in functions)

    def check_reversal(self) -> None:
        """Raise `ValueError` if the coefficients depend on time or the time reversal is unknown."""
        if self.depends_on_time:
            raise ValueError(_NOT_HOMOGENEOUS)
        if not self.has_reversal:
            raise ValueError(
                "the time reversal of this model is unknown, and couplings need it: give "
                "`Diffusion` a `log_stationary` (up to a constant), a `reverse_drift`, or "
                "`reversible=True`; or use a proposal without time reversal, such as "
                "`ModifiedDiffusionBridge()` or `Guided()`."
            )

    @property
    def reverse_drift_effect(self) -> decisions.Effect:
        """Return whether α* is derived by automatic differentiation, as an `Effect`.

        Its fields are `simulated` and `why`. It does not check that a reversal is known.
        """
        return decisions.reverse_drift(self.reversible, self._reverse_drift is not None)

    @property
    def depends_on_time(self) -> bool:
        """Return whether the drift or σ takes the time as a third argument."""
        return takes_time(self._drift) or takes_time(self._diffusion)

    def forward(self, like: Float[Array, " d"]) -> Dynamics:
        """Return the coefficients α and σ as functions of a point.

        Quantities that do not depend on the point are computed here, once. Only the shape and dtype
        of `like`, any point, are used.

        **Raises:** `ValueError` if the coefficients depend on time.
        """
        if self.depends_on_time:
            raise ValueError(_NOT_HOMOGENEOUS)
        return self.forward_at(like)(None)

    def forward_at(self, like: Float[Array, " d"]) -> DynamicsAt:
        """Return a function that maps a time to the coefficients at this time, as `Dynamics`.

        If no coefficient depends on time, it ignores its argument, which may be `None`.
        """
        params = self._prepared_params()
        drift_at = self._drift_at(params)
        sigma_at, varies = self._sigma_at(params, like)
        return lambda time: Dynamics(drift_at(time), sigma_at(time), varies)

    def _dynamics_at(self, x: Float[Array, " d"], time: Numbers | None) -> Dynamics:
        """Return the coefficients at a `time`; `None` is for coefficients without time."""
        if time is None:  # raises if a coefficient depends on time
            return self.forward(x)
        return self.forward_at(x)(as_numbers({"time": time})["time"].astype(x.dtype))

    def _drift_at(self, params: PyTree) -> Callable[[Any], Callable[[Array], Array]]:
        """Return the drift as a function of time, with values that are functions of a point."""
        function = self._traced_once(self._drift)
        if takes_time(self._drift):
            return lambda time: self._nan_outside(
                "drift", lambda x: function(x, params, time), params
            )
        # Built once: it is the same function at all times.
        drift = self._nan_outside("drift", lambda x: function(x, params), params)
        return lambda time: drift

    def _sigma_at(
        self, params: PyTree, like: Float[Array, " d"]
    ) -> tuple[Callable[[Any], Callable[[Array], AbstractSigma]], bool]:
        """Return σ as a function of time and whether σ depends on the point."""
        if self._diffusion is None:
            constant_sigma = _as_sigma(self._constant_sigma, like)
            return lambda time: lambda x: constant_sigma, False
        function = named("diffusion", self._traced_once(self._diffusion))
        depends_on_time = takes_time(self._diffusion)

        def values(x, params, time):
            value = function(x, params, time) if depends_on_time else function(x, params)
            # A ready model may return an operator, which holds the structure of its σ.
            return value if isinstance(value, AbstractSigma) else as_returned("diffusion", value)

        # Tracing shows whether σ uses `x`; it needs a time, but not a particular one.
        any_time = jnp.zeros((), like.dtype)
        varies = uses_argument(lambda x: values(x, params, any_time), like)
        if not (varies or depends_on_time):  # evaluate σ once, at any point
            constant = _as_sigma(values(jnp.zeros_like(like), params, any_time), like)
            return lambda time: lambda x: constant, False
        return lambda time: lambda x: _as_sigma(values(x, params, time), x, constant=False), varies

    def sigma_varies(self, like: Float[Array, " d"]) -> bool:
        """Return whether σ depends on the point. Nothing is computed."""
        return self._sigma_traits(like)[0]

    def sigma_is_invertible(self, like: Float[Array, " d"]) -> bool:
        """Return whether σ has at least as many columns as rows.

        Only shapes are examined: a square σ(x) that is singular counts as invertible. `like` is a
        point of the right shape and dtype.
        """
        return self._sigma_traits(like)[1]

    def is_linear(self, like: Float[Array, " d"]) -> bool:
        """Return whether the drift is linear, σ constant, and neither depends on time."""
        return not self.depends_on_time and is_linear(self.forward(like), like)

    def check_invertible_sigma(self, like: Float[Array, " d"]) -> None:
        """Raise `ValueError` if σ has fewer columns than rows."""
        if not self.sigma_is_invertible(like):
            raise ValueError(NO_INVERSE)

    def _sigma_traits(self, like: Float[Array, " d"]) -> tuple[bool, bool]:
        """Return whether σ varies and whether it is invertible, by abstract evaluation."""

        def traits(model, x):
            dynamics = model.forward_at(x)(jnp.zeros((), x.dtype))
            return dynamics.sigma_varies, dynamics.sigma(x).invertible

        # Results that are not arrays, such as booleans, are returned as they are.
        return eqx.filter_eval_shape(traits, self, like)

    def backward(self, like: Float[Array, " d"]) -> Dynamics:
        """Return the coefficients α* and σ of the time-reversed diffusion as functions of a point.

        **Raises:** `ValueError` if the coefficients depend on time or the time reversal is unknown.
        """
        self.check_reversal()
        forward = self.forward(like)
        if self.reversible:
            return forward
        derived = self.reverse_drift_effect
        params, reverse_drift = self._prepared_params(), self._reverse_drift
        if reverse_drift is not None and not derived.simulated:
            function = self._traced_once(reverse_drift)
            drift = self._nan_outside("reverse_drift", lambda x: function(x, params), params)
        else:
            log_nu = self._log_stationary_function()
            divergence = decisions.divergence(derived, forward.sigma_varies).simulated

            # NaN outside the state space, as `forward.drift` is.
            def derived_drift(x):
                return -forward.drift(x) + stationary_flux(forward, log_nu, x, divergence)

            drift = derived_drift

        return forward._replace(drift=drift)

    def _nan_outside(
        self, name: str, values: Callable[[Float[Array, " d"]], Array], params: PyTree
    ) -> Callable[[Float[Array, " d"]], Float[Array, " d"]]:
        """Return a drift with these values that is NaN outside the state space.

        A path that leaves the state space is NaN from the next step on, so no bridge ends there.
        """
        inside = self._state_space(params)
        values = named(name, values)

        def drift(x):
            value = check_value(name, values(x), x.shape, x)
            return value if inside is None else jnp.where(inside(x), value, jnp.nan)

        return drift

    def state_space(self) -> Callable[[Float[Array, " d"]], Bool[Array, ""]] | None:
        """Return a test whether a point is inside the state space; `None` for all of R^d.

        `prepare` runs here, once, and not for each point.
        """
        return self._state_space(self._prepared_params())

    def _state_space(self, params: PyTree) -> Callable[[Array], Array] | None:
        if self._domain is None:
            return None
        domain = named("domain", functools.partial(self._captured.call, self._domain))

        def inside(x):
            value = as_returned("domain", domain(x, params))
            if value.shape != () or value.dtype != bool:
                raise ValueError(
                    "`domain` must return one boolean, such as `jnp.all(x > 0)`; it returned "
                    f"shape {value.shape} and dtype {value.dtype}."
                )
            return value

        return inside

    def _traced_once(self, function: Callable) -> Callable:
        """Return `function` with its trace cached and its closures passed as arguments."""
        traced = traced_once(function)
        return lambda *args: self._captured.call(function, *args, plain=traced)

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
    """Return the operator for a value of `diffusion` at `x`; `constant` if σ does not vary.

    **Raises:** `ValueError` for a value of another shape.
    """
    if values is None:
        return Identity()
    d = x.shape[0]
    if isinstance(values, AbstractSigma):
        sigma: AbstractSigma = cast_floats(values, x.dtype)
        # A constant operator becomes a matrix with its inverse, computed once, outside loops.
        keeps_form = isinstance(sigma, Identity) or not constant
        return sigma if keeps_form else Constant(sigma.as_matrix(d, x.dtype))
    values = as_returned("diffusion", values)
    if values.shape != (d,) and not (values.ndim == 2 and values.shape[0] == d and values.size):
        raise ValueError(
            f"`diffusion` must have shape ({d}, m) for noise of m dimensions, or ({d},) for a "
            f"diagonal, at a point of shape ({d},); got {values.shape}."
        )
    values = values.astype(x.dtype)
    if values.ndim == 1:
        return Diagonal(values)
    if values.shape[1] < d:
        return Tall(values)
    if values.shape[1] > d:  # the law depends on V = σσᵀ only: its root has d columns
        values = lower_factor(values)
        return Constant(values) if constant else Triangular(values)
    return Constant(values) if constant else Full(values)


def _as_point(x: Numbers) -> Float[Array, " d"]:
    """Return `x` as a point of the state space, shape (d,).

    **Raises:** `ValueError` for any other shape, `TypeError` for less than single precision.
    """
    x = as_floating("x", x)
    if x.ndim != 1 or not x.size:
        raise ValueError(f"`x` must be a point, shape (d,); got shape {x.shape}.")
    check_precision("`x`", x.dtype)
    return x


def check_value(name: str, value: Numbers, shape: tuple, x: Float[Array, " d"]) -> Array:
    """Return the `value` of a user's function at `x`, in the dtype of `x`.

    **Raises:** `TypeError` for a value that is not an array of real numbers, `ValueError` for
    another shape; both name the function.
    """
    value = as_returned(name, value)
    if value.shape != shape:
        raise ValueError(
            f"`{name}` must return shape {shape} at a point of shape {x.shape}; "
            f"it returned {value.shape}."
        )
    return value.astype(x.dtype)  # `x` sets the working precision


def value_at(
    name: str, function: Callable, shape: tuple, x: Float[Array, " d"], *arguments: Any
) -> Array:
    """Return `function(x, *arguments)` in the dtype of `x`.

    **Raises:** `TypeError` and `ValueError` with the name of the function, for errors that it
    raises and for a value of another shape.
    """
    return check_value(name, evaluated(name, function, x, *arguments), shape, x)


def check_dimension(x: Float[Array, " d"], dim: int) -> None:
    """Raise `ValueError` if a point does not have the dimension of the model, `dim`."""
    if x.shape != (dim,):
        raise ValueError(
            f"the `drift` of this `model` is for points of shape ({dim},); it was called at a "
            f"point `x` of shape {x.shape}."
        )


def halves(x: Float[Array, " d"], parts: str) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return the two halves of a state. `parts` describes them in the error message.

    **Raises:** `ValueError` for an odd number of coordinates.
    """
    if x.shape[0] % 2:
        raise ValueError(f"the state `x` must consist of {parts}; got shape {x.shape}.")
    first, second = jnp.split(x, 2)
    return first, second


# Functions are compared by identity: cached ones compile once for equal numbers.
@functools.lru_cache(maxsize=256)
def _constant_function(values: tuple) -> Callable:
    """Return a constant σ as a function of a point, the same object for the same numbers."""
    return lambda x, params: jnp.asarray(np.array(values), x.dtype)


def _as_tuples(sigma: Array) -> tuple:
    """Return the numbers of σ as nested tuples, which can be hashed."""
    return tuple(tuple(row) if isinstance(row, list) else row for row in sigma.tolist())


def _check_constant_sigma(sigma: Numbers) -> Array:
    """Return a constant σ as an array.

    **Raises:** `ValueError` for a wrong shape and for a matrix that is singular or not finite.
    """
    sigma = as_floating("diffusion", sigma)
    check_precision("`diffusion`", sigma.dtype)
    if sigma.ndim not in (1, 2) or 0 in sigma.shape:
        raise ValueError(
            "a constant `diffusion` must have shape (d, m) for noise of m dimensions, or (d,) for "
            f"a diagonal; got {sigma.shape}."
        )
    tall = " (or have fewer columns than rows, if noise enters only some coordinates)"
    check_invertible("diffusion", sigma, tall)
    return sigma


def check_diffusion(model) -> None:
    """Raise `TypeError` unless `model` is a `Diffusion`."""
    if not isinstance(model, Diffusion):
        raise TypeError(f"`model` must be a `jaxbridge.Diffusion`; got {type(model).__name__}.")


def check_invertible(name: str, sigma: Array | np.ndarray, alternative: str = "") -> None:
    """Raise `ValueError` for a σ that is numerically singular or not finite; accept traced ones.

    `alternative` is added to the message: the other matrices that are allowed.
    """
    if is_traced(sigma):
        return
    matrix = np.diag(sigma) if sigma.ndim == 1 else np.asarray(sigma)
    if not np.all(np.isfinite(matrix)):
        raise ValueError(f"`{name}` must be finite; got {matrix}.")
    # Above this condition number the inverse has no correct digits.
    if np.linalg.cond(matrix) > 1 / np.finfo(matrix.dtype).eps:
        raise ValueError(
            f"`{name}` must be invertible{alternative}; got the numerically singular value {sigma}."
        )


class _StaticLeaves(NamedTuple):
    """The leaves of a pytree that are not arrays, each with its index, and the structure of the
    pytree."""

    leaves: tuple[tuple[int, Any], ...]
    structure: Any


def _split_params(params: PyTree) -> tuple[PyTree, _StaticLeaves]:
    """Return the arrays of `params`, with `None` for other leaves, and the static leaves."""
    leaves, structure = jax.tree.flatten(jax.tree.map(_as_leaf, params))
    arrays = structure.unflatten([leaf if _is_array(leaf) else None for leaf in leaves])
    static_leaves = [(i, leaf) for i, leaf in enumerate(leaves) if not _is_array(leaf)]
    return arrays, _StaticLeaves(tuple(static_leaves), structure)


def _is_array(leaf) -> bool:
    """Return whether a leaf is an array, or the shape and dtype of one."""
    return eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct)


def _as_leaf(leaf):
    """Return a leaf of `params` as an array if it is a float or an array, else unchanged.

    **Raises:** `TypeError` for arrays without numbers.
    """
    # Without weak types a Python float and an array share one compiled program.
    if isinstance(leaf, float):
        return drop_weak_type(as_array(float(leaf)))
    arrays = np.ndarray | np.generic | jax.Array
    if not isinstance(leaf, arrays):
        return leaf
    try:
        return drop_weak_type(as_array(leaf))
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"arrays in `params` must hold numbers; got an array of dtype {leaf.dtype}."
        ) from error
