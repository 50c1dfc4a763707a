"""Diffusions with a given stationary density: Langevin diffusions, and the general form."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..engine.arguments import as_returned, check_function, evaluated
from ..engine.checks import Numbers, as_numbers, check_range, is_traced
from ..engine.linalg import matvec
from .diffusion import Diffusion, check_value, value_at
from .dynamics import weighted_divergence
from .sigma import Triangular, root_of


def stationary_diffusion(
    log_density: Callable,
    V: Callable | None = None,
    Q: Callable | None = None,
    params: PyTree = None,
    *,
    normalised: bool = False,
) -> Diffusion:
    """Return the diffusion with stationary density ν, diffusion matrix V and skew-symmetric field
    Q:

        α = ½ ν⁻¹ div(ν (V + Q)),    σ = the Cholesky factor of V,

    where (div M)_i = Σ_j ∂_j M_ij.

    Every diffusion with stationary density ν and V = σσᵀ has this form (Ma, Chen & Fox 2015). Its
    time reversal has -Q instead of Q, so it is reversible if Q = 0.

    **Arguments:**

    - `log_density`: log ν up to a constant, `(x, params) -> ()` of one point `x` of shape (d,).
    - `V`: a function `(x, params)` that returns a positive definite matrix: shape (d, d), or (d,)
        for a diagonal one. By default the identity.
    - `Q`: a function `(x, params)` that returns a skew-symmetric matrix, shape (d, d). By default
        zero.
    - `params`: any pytree; the functions receive it.
    - `normalised`: as in `Diffusion`.

    **Raises:** `TypeError` for arguments that are not functions.

    **Example:**

    ```python
    swirl = jnp.array([[0.0, 1.0], [-1.0, 0.0]])
    model = jb.stationary_diffusion(lambda x, p: -x @ x / 2, Q=lambda x, p: swirl)
    ```
    """
    check_function("log_density", log_density, "(x, params)")
    check_function("V", V, "(x, params)", optional=True)
    check_function("Q", Q, "(x, params)", optional=True)
    return Diffusion(
        drift=_StationaryDrift(log_density, V, Q, 1),
        diffusion=None if V is None else _RootOfV(V),
        log_stationary=log_density,
        params=params,
        # The time reversal changes the sign of Q.
        reverse_drift=None if Q is None else _StationaryDrift(log_density, V, Q, -1),
        reversible=Q is None,
        normalised=normalised,
    )


def langevin(
    log_density: Callable,
    params: PyTree = None,
    *,
    temperature: Numbers | Callable[[PyTree], Numbers] | None = None,
    normalised: bool = False,
) -> Diffusion:
    """Return the Langevin diffusion `dX = ½ ∇log ν(X) dt + dW`, or, at a temperature,

        dX = kT ∇log ν(X) dt + √(2kT) dW.

    The second form is dX = -∇V dt + √(2kT) dW for ν ∝ exp(-V / kT). Both forms are reversible with
    stationary density ν, and differ in the unit of time only: with a `temperature` the process runs
    2kT times as fast as without.

    **Arguments:**

    - `log_density`: log ν up to a constant, so -V / kT. A function `(x, params) -> ()`.
    - `params`: any pytree; `log_density` receives it.
    - `temperature`: kT > 0 in units of V, a number or a function `(params) -> ()`.
    - `normalised`: as in `Diffusion`.

    **Raises:** `TypeError` for a `log_density` that is not a function, and for a traced number as
    `temperature` (pass a function). `ValueError` for a `temperature` that is not positive.

    **Example:**

    ```python
    double_well = jb.langevin(lambda x, p: -p * (x @ x - 1) ** 2, params=1.0)
    V = lambda x: (x @ x - 1) ** 2
    heated = jb.langevin(lambda x, kT: -V(x) / kT, params=0.15, temperature=lambda kT: kT)
    heated.drift(jnp.array([0.5]))  # Array([1.5], dtype=float32), which is -∇V
    ```
    """
    if temperature is None:
        return stationary_diffusion(log_density, params=params, normalised=normalised)
    check_function("log_density", log_density, "(x, params)")
    if callable(temperature):
        check_function("temperature", temperature, "(params)")
    else:
        temperature = _positive_number(temperature)
    return Diffusion(
        _ThermalDrift(log_density, temperature),
        _ThermalNoise(temperature),
        log_density,
        params,
        reversible=True,
        normalised=normalised,
    )


def _positive_number(temperature: Numbers) -> float:
    """Return a `temperature` as a float, so that models with equal temperatures are equal.

    **Raises:** `TypeError` for a traced number, `ValueError` unless it is positive.
    """
    if is_traced(temperature):
        raise TypeError(
            "`temperature` is a traced number: pass a function of `params` instead, such as "
            "`lambda params: params`."
        )
    value = as_numbers({"temperature": temperature})["temperature"]
    check_range("temperature", value, positive=True)
    return float(value)


# The callables below are frozen dataclasses. So two models of the same functions are equal, and
# compile once.


@dataclasses.dataclass(frozen=True)
class _StationaryDrift:
    """Drift ½ ν⁻¹ div(ν (V + `sign` Q)) of `stationary_diffusion`.

    `sign` is 1, or -1 for the time reversal.
    """

    log_density: Callable
    V: Callable | None
    Q: Callable | None
    sign: int

    def __call__(self, x: Float[Array, " d"], params: PyTree) -> Float[Array, " d"]:
        def product(y, v):
            result = v if self.V is None else _multiply(_matrix("V", self.V, y, params), v)
            # One product with V ± Q gives both terms of the divergence.
            if self.Q is not None:
                result += self.sign * _multiply(_matrix("Q", self.Q, y, params), v)
            return result

        has_matrix = not (self.V is None and self.Q is None)
        log_nu = lambda y: _log_nu(self.log_density, y, params)
        return weighted_divergence(product, log_nu, x, has_matrix) / 2


@dataclasses.dataclass(frozen=True)
class _RootOfV:
    """Coefficient σ with σσᵀ = V: triangular, or diagonal if V is."""

    V: Callable

    def __call__(self, x: Float[Array, " d"], params: PyTree) -> Float[Array, " d"] | Triangular:
        V = _matrix("V", self.V, x, params)
        return jnp.sqrt(V) if V.ndim == 1 else root_of(V)


@dataclasses.dataclass(frozen=True)
class _ThermalDrift:
    """Drift kT ∇log ν."""

    log_density: Callable
    temperature: float | Callable

    def __call__(self, x: Float[Array, " d"], params: PyTree) -> Float[Array, " d"]:
        log_nu = lambda y: _log_nu(self.log_density, y, params)
        return _temperature(self.temperature, x, params) * jax.grad(log_nu)(x)


@dataclasses.dataclass(frozen=True)
class _ThermalNoise:
    """Diagonal coefficient σ = √(2kT)."""

    temperature: float | Callable

    def __call__(self, x: Float[Array, " d"], params: PyTree) -> Float[Array, " d"]:
        return jnp.broadcast_to(jnp.sqrt(2 * _temperature(self.temperature, x, params)), x.shape)


def _temperature(
    temperature: float | Callable, x: Float[Array, " d"], params: PyTree
) -> Float[Array, ""]:
    """Return kT for these parameters, in the dtype of `x`."""
    if callable(temperature):
        temperature = evaluated("temperature", temperature, params)
    return check_value("temperature", temperature, (), x)  # pyright: ignore[reportArgumentType]


def _log_nu(log_density: Callable, x: Float[Array, " d"], params: PyTree) -> Float[Array, ""]:
    """Return log ν at one point."""
    return value_at("log_density", log_density, (), x, params)


def _matrix(name: str, function: Callable, x: Float[Array, " d"], params: PyTree) -> Array:
    """Return a matrix field at one point: shape (d, d), or (d,) for a diagonal.

    **Raises:** `ValueError` for any other shape.
    """
    value = as_returned(name, evaluated(name, function, x, params))
    (d,) = x.shape
    if value.shape not in ((d,), (d, d)):
        raise ValueError(
            f"`{name}` must return shape ({d}, {d}), or ({d},) for a diagonal, at a point of shape "
            f"({d},); it returned {value.shape}."
        )
    return value.astype(x.dtype)


def _multiply(matrix: Array, vector: Float[Array, " d"]) -> Float[Array, " d"]:
    """Return the product of a matrix, or of a diagonal, and a vector."""
    return matrix * vector if matrix.ndim == 1 else matvec(matrix, vector)
