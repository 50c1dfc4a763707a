"""The Ornstein–Uhlenbeck process and its bridges in closed form (section 3.1 of the paper).

For `dX = -B (X - m) dt + σ dW`, V = σσᵀ and B with eigenvalues in the right half plane,

    Γ solves B Γ + Γ Bᵀ = V,   Γ_t = ∫_0^t e^{-sB} V e^{-sBᵀ} ds = Γ - e^{-tB} Γ e^{-tBᵀ},

the stationary law is N(m, Γ), and X_t given X_0 = x is N(m + e^{-tB}(x - m), Γ_t). The bridge
from a to b in T is Gaussian. With the gain `K_t = Γ_t e^{-Bᵀ(T-t)} Γ_T⁻¹` its moments are

    E Z_t = m + e^{-tB}(a - m) + K_t (b - m - e^{-TB}(a - m)),
    Var Z_t = Γ_t - K_t e^{-B(T-t)} Γ_t.

(The paper prints the gain without these transposes; that is right for reversible processes.)
"""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key

from ..engine.checks import Numbers, as_floating, is_traced
from ..engine.linalg import any_cholesky, any_inverse, any_solve, dot, matvec, solve
from .diffusion import Diffusion, check_invertible
from .intervals import as_intervals
from .linear import linear_transition


class GaussianLaw(eqx.Module):
    """The normal distribution N(mean, covariance).

    **Arguments:** `mean`, shape (d,); `covariance`, shape (d, d).

    **Raises:** `ValueError` for shapes that do not fit, or a covariance that is visibly not
    symmetric and positive definite.

    **Example:**

    ```python
    law = jb.GaussianLaw([0.0, 0.0], jnp.eye(2))
    coupling = jb.Coupling(0.5, start_law=law)
    ```
    """

    mean: Float[Array, " d"]
    covariance: Float[Array, "d d"]

    def __init__(self, mean: Numbers, covariance: Numbers):
        mean, covariance = as_floating("mean", mean), as_floating("covariance", covariance)
        dtype = jnp.promote_types(mean.dtype, covariance.dtype)
        self.mean, self.covariance = mean.astype(dtype), covariance.astype(dtype)
        if mean.ndim != 1 or covariance.shape != 2 * mean.shape:
            raise ValueError(
                "`mean` must have shape (d,) and `covariance` (d, d); got "
                f"{mean.shape} and {covariance.shape}."
            )
        if is_traced(covariance):
            return
        matrix = np.asarray(covariance, float)
        tolerance = 100 * np.finfo(dtype).eps * np.abs(matrix).max()
        symmetric = np.abs(matrix - matrix.T).max() <= tolerance  # false for NaN
        if not (symmetric and np.linalg.eigvalsh(matrix).min() >= -tolerance):
            raise ValueError(
                f"`covariance` must be symmetric and positive definite; got {covariance}."
            )

    def __iter__(self) -> Iterator[Array]:
        """`mean, covariance = law`."""
        yield from (self.mean, self.covariance)

    def sample(self, key: Key[Array, ""], model: Diffusion | None = None) -> Float[Array, " d"]:
        """One draw, shape (d,). The model is not looked at: start laws are called with one."""
        noise = jax.random.normal(key, self.mean.shape, self.mean.dtype)
        return self.mean + matvec(any_cholesky(self.covariance), noise)

    def log_density(self, x: Float[Array, " d"]) -> Float[Array, ""]:
        """The normalised log density at a point."""
        root = any_cholesky(self.covariance)
        white = matvec(any_inverse(root), (x - self.mean).astype(root.dtype))
        return -dot(white, white) / 2 - jnp.sum(jnp.log(jnp.sqrt(2 * np.pi) * jnp.diag(root)))


class OrnsteinUhlenbeckParams(NamedTuple):
    """The parameters of an Ornstein–Uhlenbeck model, `params` of `ornstein_uhlenbeck`: `B`, shape
    (d, d), per unit of time; `mean`, (d,); `sigma`, (d, d), (d,) for a diagonal, or `None` for I.

    **Example:**

    ```python
    moved = model.with_params(model.params._replace(mean=jnp.ones(2)))
    ```
    """

    B: Float[Array, "d d"]
    mean: Float[Array, " d"]
    sigma: Float[Array, "..."] | None


class _Prepared(NamedTuple):
    """What depends on the parameters alone."""

    B: Float[Array, "d d"]
    mean: Float[Array, " d"]
    sigma: Float[Array, "..."] | None
    covariance: Float[Array, "d d"]
    precision: Float[Array, "d d"]
    log_normaliser: Float[Array, ""]
    reverse_B: Float[Array, "d d"]


def ornstein_uhlenbeck(
    B: Numbers, mean: Numbers | None = None, sigma: Numbers | None = None
) -> Diffusion:
    """The Ornstein–Uhlenbeck process `dX = -B (X - mean) dt + σ dW`: equation (OU).

    Its time reversal is the Ornstein–Uhlenbeck process with matrix Γ Bᵀ Γ⁻¹; it is reversible
    if and only if BΓ is symmetric, which is not asked for. The log stationary density is
    normalised. `params` is an `OrnsteinUhlenbeckParams`, and Γ follows it.

    **Arguments:** `B`, shape (d, d), per unit of time; `mean`, shape (d,), by default zero;
    `sigma`, shape (d, d) or (d,), by default the identity.

    **Raises:** `ValueError` where B has an eigenvalue whose real part is not positive, so
    that the process is not ergodic; for a singular σ; for shapes that do not fit.

    **Example:**

    ```python
    model = jb.ornstein_uhlenbeck(jnp.array([[1.5, 1.0], [1.0, 1.5]]))
    model.reverse_drift(jnp.array([1.0, 0.0]))  # Array([-1.5, -1. ], dtype=float32)
    ```
    """
    B = as_floating("B", B)
    if B.ndim != 2 or B.shape[0] != B.shape[1]:
        raise ValueError(f"`B` must be a square matrix, shape (d, d); got {B.shape}.")
    d = B.shape[0]
    mean = jnp.zeros(d, B.dtype) if mean is None else as_floating("mean", mean)
    if mean.shape != (d,):
        raise ValueError(f"`mean` must have shape ({d},) to fit `B`; got {mean.shape}.")
    if not is_traced(mean) and not np.all(np.isfinite(mean)):
        raise ValueError(f"`mean` must be finite; got {mean}.")
    if sigma is not None:
        sigma = as_floating("sigma", sigma)
        if sigma.shape not in ((d,), (d, d)):
            raise ValueError(f"`sigma` must have shape ({d}, {d}) or ({d},); got {sigma.shape}.")
        check_invertible("sigma", sigma)
    if not is_traced(B):
        if not np.all(np.isfinite(B)):
            raise ValueError(f"`B` must be finite; got {B}.")
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
    """The stationary law N(m, Γ) of `model`, an Ornstein–Uhlenbeck model, with Γ the solution of
    B Γ + Γ Bᵀ = σ σᵀ.

    **Raises:** `TypeError` for any other model.

    **Example:**

    ```python
    jb.ou_stationary(model).covariance  # shape (2, 2)
    ```
    """
    prepared = _prepare(_ou_params(model))
    return GaussianLaw(prepared.mean, prepared.covariance)


def ou_transition(model: Diffusion, start: Numbers, duration: Numbers) -> GaussianLaw:
    """The law of X_t given X_0 = `start`, shape (d,), for t = `duration`, of `model`, an
    Ornstein–Uhlenbeck model.

    **Raises:** `TypeError` for any other model.

    **Example:**

    ```python
    law = jb.ou_transition(model, start, 1.0)
    law.log_density(end)
    ```
    """
    params = _ou_params(model)
    start, _, duration = _one_interval(params, start, start, duration)
    decay, covariance = _decay_and_covariance(params, duration)
    return GaussianLaw(params.mean + decay @ (start - params.mean), covariance)


class GaussianBridge(eqx.Module):
    """The exact law of an Ornstein–Uhlenbeck bridge at K times, from `gaussian_bridge`.

    `times` (K,), `mean` (K, d) and `covariance` (K, d, d), the covariance at each time;
    `sample` draws whole paths.
    """

    times: Float[Array, " K"]
    mean: Float[Array, "K d"]
    covariance: Float[Array, "K d d"]
    _model: Diffusion
    _start: Float[Array, " d"]
    _end: Float[Array, " d"]
    _duration: Float[Array, ""]
    _gain: Float[Array, "K d d"]

    def sample(self, key: Key[Array, ""], num_paths: int) -> Float[Array, "n K d"]:
        """Independent paths at `times`, exact in law: an unconditional path X, corrected by
        `Z_t = X_t + K_t (b - X_T)`, as in the paper's lemma on the bridge."""
        params = _ou_params(self._model)
        grid = jnp.concatenate([self.times, self._duration[None]])
        steps = jnp.diff(grid, prepend=jnp.zeros((), grid.dtype))
        decay, covariance = jax.vmap(lambda t: _decay_and_covariance(params, t))(steps)
        still = (steps <= 0)[:, None, None]  # two equal times: no noise between them
        identity = jnp.eye(len(self._start), dtype=grid.dtype)
        root = jax.vmap(any_cholesky)(jnp.where(still, identity, covariance))
        root = jnp.where(still, 0, root)
        noise = jax.random.normal(key, (len(steps), num_paths, len(self._start)), grid.dtype)

        def step(x, inputs):  # x: deviations from the mean, (num_paths, d)
            decay, root, noise = inputs
            x = x @ decay.T + noise @ root.T
            return x, x

        start = jnp.broadcast_to(self._start - params.mean, (num_paths, len(self._start)))
        _, path = lax.scan(step, start, (decay, root, noise))
        miss = self._end - params.mean - path[-1]
        correction = jnp.einsum("kij,nj->nki", self._gain, miss)
        return params.mean + jnp.moveaxis(path[:-1], 0, 1) + correction


def gaussian_bridge(
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    times: Numbers,
) -> GaussianBridge:
    """The exact law of the (start, end, duration)-bridge of an Ornstein–Uhlenbeck model: the
    paper's lemma on the bridge, for any B.

    **Arguments:**

    - `model`: from `ornstein_uhlenbeck`. It need not be reversible.
    - `start`, `end`: points, shape (d,).
    - `duration`: in units of time, shape ().
    - `times`: increasing, shape (K,), in [0, duration].

    **Returns:** `GaussianBridge`.

    **Raises:** `TypeError` for any other model, `ValueError` for arguments that do not fit.

    **Example:**

    ```python
    exact = jb.gaussian_bridge(model, start, end, 1.0, times=[0.25, 0.5])
    exact.mean[1], exact.covariance[1], exact.sample(key, num_paths=1000)
    ```
    """
    params = _ou_params(model)
    a, b, total = _one_interval(params, start, end, duration)
    times = as_floating("times", times).astype(params.B.dtype)
    if times.ndim != 1:
        raise ValueError(f"`times` must have shape (K,); got {times.shape}.")
    if not is_traced(times, total) and not (
        np.all(np.diff(times, prepend=0, append=total) >= 0) and times.size
    ):
        raise ValueError(f"`times` must increase within [0, {total}]; got {times}.")
    decay_T, covariance_T = _decay_and_covariance(params, total)
    miss = b - params.mean - decay_T @ (a - params.mean)

    def moments(t):
        decay, covariance = _decay_and_covariance(params, t)
        remaining, _ = _decay_and_covariance(params, total - t)
        gain = any_solve(covariance_T, remaining @ covariance).T
        mean = params.mean + decay @ (a - params.mean) + gain @ miss
        return mean, covariance - gain @ remaining @ covariance, gain

    mean, covariance, gain = jax.vmap(moments)(times)
    return GaussianBridge(times, mean, covariance, model, a, b, total, gain)


def _drift(x, p: _Prepared):
    return -matvec(p.B, x - p.mean)


def _reverse_drift(x, p: _Prepared):
    return -matvec(p.reverse_B, x - p.mean)


def _sigma(x, p: _Prepared):
    return p.sigma


def _log_stationary(x, p: _Prepared):
    deviation = x - p.mean
    return -dot(deviation, matvec(p.precision, deviation)) / 2 - p.log_normaliser


def _sample_stationary(key, p: _Prepared):
    return GaussianLaw(p.mean, p.covariance).sample(key)


def _prepare(params: OrnsteinUhlenbeckParams) -> _Prepared:
    B, mean, sigma = params
    covariance = _lyapunov(B, _noise_covariance(params))
    precision = any_inverse(covariance)
    precision = (precision + precision.T) / 2
    root = any_cholesky(2 * jnp.pi * covariance)
    log_normaliser = jnp.sum(jnp.log(jnp.diagonal(root)))
    reverse_B = covariance @ B.T @ precision
    return _Prepared(B, mean, sigma, covariance, precision, log_normaliser, reverse_B)


def _noise_covariance(params: OrnsteinUhlenbeckParams) -> Float[Array, "d d"]:
    """V = σσᵀ."""
    if params.sigma is None:
        return jnp.eye(params.B.shape[0], dtype=params.B.dtype)
    matrix = jnp.diag(params.sigma) if params.sigma.ndim == 1 else params.sigma
    return matrix @ matrix.T


def _lyapunov(B: Float[Array, "d d"], V: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Γ with BΓ + ΓBᵀ = V, equation (Gamma), as one linear system of size d²."""
    identity = jnp.eye(B.shape[0], dtype=B.dtype)
    operator = jnp.kron(B, identity) + jnp.kron(identity, B)
    # Inference does this in a loop, where LAPACK is a hazard; but d² soon is much to write out.
    solved = solve if B.shape[0] <= 3 else jnp.linalg.solve
    solution = solved(operator, V.reshape(-1)).reshape(V.shape)
    return (solution + solution.T) / 2


def _decay_and_covariance(
    params: OrnsteinUhlenbeckParams, t: Float[Array, ""]
) -> tuple[Float[Array, "d d"], Float[Array, "d d"]]:
    """e^{-tB} and Γ_t."""
    moments = linear_transition(-params.B, _noise_covariance(params), t)
    return moments.decay, moments.covariance


def _one_interval(
    params: OrnsteinUhlenbeckParams, start: Numbers, end: Numbers, duration: Numbers
) -> tuple[Float[Array, " d"], Float[Array, " d"], Float[Array, ""]]:
    """The end points and the duration, checked and in the precision of the parameters."""
    intervals, batched, several_durations = as_intervals(start, end, duration)
    if batched or several_durations:
        raise ValueError(
            "`start`, `end` and `duration` must be those of one interval, shapes (d,), (d,) and "
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


def _ou_params(model: Diffusion) -> OrnsteinUhlenbeckParams:
    params = getattr(model, "params", None)
    if not isinstance(params, OrnsteinUhlenbeckParams):
        raise TypeError(
            "the closed form is for models made by `ornstein_uhlenbeck`; got a model with "
            f"params {params!r}."
        )
    return params
