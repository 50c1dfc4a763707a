"""The Ornstein–Uhlenbeck process in closed form (section 3.1 of the paper).

The process solves `dX = -B (X - m) dt + σ dW`, V = σσᵀ. The eigenvalues of B lie in the right half
plane. The stationary law is N(m, Γ), and X_t given X_0 = x is N(m + e^{-tB}(x - m), Γ_t), where:

    Γ solves B Γ + Γ Bᵀ = V;
    Γ_t = ∫_0^t e^{-sB} V e^{-sBᵀ} ds = Γ - e^{-tB} Γ e^{-tBᵀ}.

Γ is computed, factored and inverted in the coordinates x or σ⁻¹x, whichever give the smaller B. If
σ is nearly singular, one of the two may be inaccurate: there B has huge entries that cancel, or the
condition number of Γ exceeds floating point precision.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..engine.checks import Numbers, as_floating, check_precision, is_traced
from ..engine.compiled import compiled_sooner
from ..engine.entry import public_entry
from ..engine.linalg import any_cholesky, any_inverse, any_log_abs_det, dot, matvec, solve
from .bridge_problem import as_intervals
from .diffusion import Diffusion, check_dimension, check_invertible
from .gaussian_law import GaussianLaw
from .linear import linear_transition
from .sigma import Identity


class OrnsteinUhlenbeckParams(NamedTuple):
    """Parameters of `ornstein_uhlenbeck`, the `params` of the model.

    - `B`: shape (d, d), per unit of time.
    - `mean`: shape (d,).
    - `sigma`: shape (d, d), (d,) for a diagonal, or `None` for the identity.

    **Example:**

    ```python
    shifted = model.with_params(model.params._replace(mean=jnp.ones(2)))
    ```
    """

    B: Float[Array, "d d"]
    mean: Float[Array, " d"]
    sigma: Float[Array, "..."] | None


class _Prepared(NamedTuple):
    """The parameters, and quantities that depend on them alone.

    - `root`: a factor of Γ.
    - `precision`: Γ⁻¹.
    - `log_normaliser`: ½ log |2πΓ|.
    - `reverse_B`: Γ Bᵀ Γ⁻¹, the matrix of the time reversal.
    """

    B: Float[Array, "d d"]
    mean: Float[Array, " d"]
    sigma: Float[Array, "..."] | None
    root: Float[Array, "d d"]
    precision: Float[Array, "d d"]
    log_normaliser: Float[Array, ""]
    reverse_B: Float[Array, "d d"]


@public_entry
def ornstein_uhlenbeck(
    B: Numbers, mean: Numbers | None = None, sigma: Numbers | None = None
) -> Diffusion:
    """Return the Ornstein–Uhlenbeck process `dX = -B (X - mean) dt + σ dW`: equation (OU).

    Its time reversal is the Ornstein–Uhlenbeck process with matrix Γ Bᵀ Γ⁻¹. It is reversible if
    and only if BΓ is symmetric, which is not required. The log stationary density is normalised.
    `params` is an `OrnsteinUhlenbeckParams`; Γ is recomputed for new parameters.

    **Arguments:** `B`, shape (d, d), per unit of time; `mean`, shape (d,), by default zero;
    `sigma`, shape (d, d) or (d,), by default the identity.

    **Raises:** `ValueError` if an eigenvalue of B has a real part that is not positive, because the
    process is not ergodic then; for a singular σ; for shapes that do not fit; for values that are
    not finite.

    **Example:**

    ```python
    model = jb.ornstein_uhlenbeck(jnp.array([[1.5, 1.0], [1.0, 1.5]]))
    model.reverse_drift(jnp.array([1.0, 0.0]))  # Array([-1.5, -1. ], dtype=float32)
    ```
    """
    B = as_floating("B", B)
    check_precision("`B`", B.dtype)
    if B.ndim != 2 or B.shape[0] != B.shape[1]:
        raise ValueError(f"`B` must be a square matrix, shape (d, d); got {B.shape}.")
    d = B.shape[0]
    mean = jnp.asarray(np.zeros(d, B.dtype)) if mean is None else as_floating("mean", mean)
    if mean.shape != (d,):
        raise ValueError(f"`mean` must have shape ({d},) to fit `B`; got {mean.shape}.")
    if not is_traced(mean) and not np.all(np.isfinite(mean)):
        raise ValueError(f"`mean` must be finite; got {mean}.")
    if sigma is not None:
        sigma = as_floating("sigma", sigma)
        if sigma.shape not in ((d,), (d, d)):
            raise ValueError(f"`sigma` must have shape ({d}, {d}) or ({d},); got {sigma.shape}.")
        check_precision("`sigma`", sigma.dtype)
        check_invertible("sigma", sigma)
    if not is_traced(B):
        if not np.all(np.isfinite(B)):
            raise ValueError(f"`B` must be finite; got {B}.")
        # Ergodic only if all solutions of dX = -B (X - m) dt decay.
        eigenvalues = np.linalg.eigvals(B)
        if not np.all(eigenvalues.real > 0):
            raise ValueError(
                "the Ornstein–Uhlenbeck process is ergodic only if all eigenvalues of `B` have "
                f"positive real parts; got {eigenvalues}."
            )
    return Diffusion(
        drift=_drift,
        diffusion=_sigma,
        log_stationary=_log_stationary,
        params=OrnsteinUhlenbeckParams(B, mean, sigma),
        reverse_drift=_reverse_drift,
        sample_stationary=_sample_stationary,
        normalised=True,
        prepare=_prepare,
    )


def ou_stationary(model: Diffusion) -> GaussianLaw:
    """Return the stationary law N(m, Γ) of an Ornstein–Uhlenbeck model. Γ solves B Γ + Γ Bᵀ = σ σᵀ.

    **Arguments:** `model`, from `ornstein_uhlenbeck`.

    **Raises:** `TypeError` for any other model.

    **Example:**

    ```python
    jb.ou_stationary(model).covariance  # shape (2, 2)
    ```
    """
    params = ou_params(model)
    return GaussianLaw(params.mean, _stationary_covariance(params))


def ou_transition(model: Diffusion, start: Numbers, duration: Numbers) -> GaussianLaw:
    """Return the law of X_t given X_0 of an Ornstein–Uhlenbeck model.

    **Arguments:** `model`, from `ornstein_uhlenbeck`; `start`, X_0, shape (d,); `duration`, t > 0,
    shape ().

    **Raises:** `TypeError` for any other model, `ValueError` for arguments that do not fit.

    **Example:**

    ```python
    law = jb.ou_transition(model, start, 1.0)
    law.log_density(end)
    ```
    """
    params = ou_params(model)
    start, _, duration = single_interval(params, start, start, duration)
    return GaussianLaw(*_transition(params, start, duration))


@functools.partial(jax.jit, inline=True)
def _stationary_covariance(params: OrnsteinUhlenbeckParams) -> Float[Array, "d d"]:
    return _lyapunov(params.B, _noise_covariance(params))


@compiled_sooner
def _transition(params: OrnsteinUhlenbeckParams, start, duration):
    decay, covariance = decay_and_covariance(params, duration)
    return params.mean + decay @ (start - params.mean), covariance


def _deviation(x, p: _Prepared):
    check_dimension(x, len(p.mean))
    return x - p.mean


def _drift(x, p: _Prepared):
    return -matvec(p.B, _deviation(x, p))


def _reverse_drift(x, p: _Prepared):
    return -matvec(p.reverse_B, _deviation(x, p))


def _sigma(x, p: _Prepared):
    return Identity() if p.sigma is None else p.sigma


def _log_stationary(x, p: _Prepared):
    deviation = _deviation(x, p)
    return -dot(deviation, matvec(p.precision, deviation)) / 2 - p.log_normaliser


def _sample_stationary(key, p: _Prepared):
    return p.mean + matvec(p.root, jax.random.normal(key, p.mean.shape, p.mean.dtype))


def _prepare(params: OrnsteinUhlenbeckParams) -> _Prepared:
    """Return the prepared parameters; compute Γ in x or σ⁻¹x, whichever give the smaller B."""
    B, mean, sigma = params
    if sigma is None:
        return _Prepared(B, mean, sigma, *_stationary(B, jnp.eye(len(B), dtype=B.dtype)))
    if sigma.ndim == 1:
        from_scaled, to_scaled, log_det = (
            jnp.diag(sigma),
            jnp.diag(1 / sigma),
            jnp.sum(jnp.log(abs(sigma))),
        )
    else:
        from_scaled, to_scaled, log_det = sigma, any_inverse(sigma), any_log_abs_det(sigma)
    # B in the coordinates σ⁻¹x is σ⁻¹ B σ; the noise there is the identity.
    is_scaled = jnp.sum((to_scaled @ B @ from_scaled) ** 2) < jnp.sum(B**2)
    identity = jnp.eye(len(B), dtype=B.dtype)
    from_scaled, noise = (
        jnp.where(is_scaled, from_scaled, identity),
        jnp.where(is_scaled, identity, from_scaled),
    )
    to_scaled = jnp.where(is_scaled, to_scaled, identity)
    root, precision, log_normaliser, reverse_B = _stationary(to_scaled @ B @ from_scaled, noise)
    return _Prepared(
        B,
        mean,
        sigma,
        # Back to the coordinates x.
        root=from_scaled @ root,
        precision=to_scaled.T @ precision @ to_scaled,
        # The change of coordinates has the Jacobian |σ|.
        log_normaliser=log_normaliser + jnp.where(is_scaled, log_det, 0),
        reverse_B=from_scaled @ reverse_B @ to_scaled,
    )


def _stationary(B: Float[Array, "d d"], sigma: Float[Array, "d d"]) -> tuple[Array, ...]:
    """Return a factor of Γ, Γ⁻¹, ½ log |2πΓ|, and the matrix ΓBᵀΓ⁻¹ of the time reversal."""
    covariance = _lyapunov(B, sigma @ sigma.T)
    root, precision = any_cholesky(covariance), any_inverse(covariance)
    precision = (precision + precision.T) / 2  # symmetric in spite of rounding
    log_normaliser = jnp.sum(jnp.log(jnp.diagonal(root))) + len(B) / 2 * math.log(2 * math.pi)
    return root, precision, log_normaliser, covariance @ B.T @ precision


def _noise_covariance(params: OrnsteinUhlenbeckParams) -> Float[Array, "d d"]:
    """Return V = σσᵀ."""
    if params.sigma is None:
        return jnp.eye(params.B.shape[0], dtype=params.B.dtype)
    matrix = jnp.diag(params.sigma) if params.sigma.ndim == 1 else params.sigma
    return matrix @ matrix.T


def _lyapunov(B: Float[Array, "d d"], V: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Return Γ with BΓ + ΓBᵀ = V, equation (Gamma), from a linear system of size d².

    Up to two dimensions Γ = [|B| V + (B - tr B I) V (B - tr B I)ᵀ] / (2 |B| tr B).
    """
    identity = jnp.eye(B.shape[0], dtype=B.dtype)
    if B.shape[0] <= 2:
        determinant, trace = _determinant(B), jnp.trace(B)
        shifted = B - trace * identity
        return (determinant * V + shifted @ V @ shifted.T) / (2 * determinant * trace)
    operator = jnp.kron(B, identity) + jnp.kron(identity, B)
    # Inference runs this in a loop, where LAPACK calls are slow and can deadlock. But elimination
    # that is written out for d² unknowns takes long to compile for d > 3.
    solver = solve if B.shape[0] <= 3 else jnp.linalg.solve
    solution = solver(operator, V.reshape(-1)).reshape(V.shape)
    return (solution + solution.T) / 2


def _determinant(B: Float[Array, "d d"]) -> Float[Array, ""]:
    """Return the determinant of a matrix of one or two dimensions."""
    return B[0, 0] if B.shape[0] == 1 else B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]


def decay_and_covariance(
    params: OrnsteinUhlenbeckParams, t: Float[Array, ""]
) -> tuple[Float[Array, "d d"], Float[Array, "d d"]]:
    """Return e^{-tB} and Γ_t."""
    moments = linear_transition(-params.B, _noise_covariance(params), t)
    return moments.decay, moments.covariance


def single_interval(
    params: OrnsteinUhlenbeckParams, start: Numbers, end: Numbers, duration: Numbers
) -> tuple[Float[Array, " d"], Float[Array, " d"], Float[Array, ""]]:
    """Return `start`, `end` and `duration` of one interval, in the dtype of the parameters.

    **Raises:** `ValueError` for several intervals and for shapes that do not fit.
    """
    intervals, batched, several_durations = as_intervals(start, end, duration)
    if batched or several_durations:
        raise ValueError(
            "`start`, `end` and `duration` must describe one interval, shapes (d,), (d,) and "
            "(); use `jax.vmap` for several."
        )
    d, dtype = params.B.shape[0], params.B.dtype
    if intervals.start.shape[1] != d:
        raise ValueError(
            f"`start` and `end` must have shape ({d},) to fit the model; "
            f"got ({intervals.start.shape[1]},)."
        )
    return (
        intervals.start[0].astype(dtype),
        intervals.end[0].astype(dtype),
        intervals.duration[0].astype(dtype),
    )


def ou_params(model: Diffusion) -> OrnsteinUhlenbeckParams:
    """Return the parameters of an Ornstein–Uhlenbeck model; for others raise `TypeError`."""
    params = getattr(model, "params", None)
    if not isinstance(params, OrnsteinUhlenbeckParams):
        raise TypeError(
            "`model` must be made by `ornstein_uhlenbeck`, as the closed form needs its `params`; "
            f"got {type(model).__name__} with params {params!r}."
        )
    return params
