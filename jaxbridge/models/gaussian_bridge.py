"""Bridges of the Ornstein–Uhlenbeck process in closed form (section 3.1 of the paper).

The bridge from a to b in time T is Gaussian. Γ_t is that of `ornstein_uhlenbeck`, and the gain is
`K_t = Γ_t e^{-Bᵀ(T-t)} Γ_T⁻¹`. The moments are:

    E Z_t = m + e^{-tB}(a - m) + K_t (b - m - e^{-TB}(a - m));
    Var Z_t = Γ_t - K_t e^{-B(T-t)} Γ_t.

The paper prints the gain without these transposes, which is right for reversible processes only.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key

from ..engine.checks import Numbers, as_floating, is_traced
from ..engine.compiled import compiled_sooner
from ..engine.entry import public_entry
from ..engine.linalg import any_cholesky, any_solve
from .diffusion import Diffusion
from .ornstein_uhlenbeck import (
    OrnsteinUhlenbeckParams,
    decay_and_covariance,
    ou_params,
    single_interval,
)


class GaussianBridge(eqx.Module):
    """Exact law of an Ornstein–Uhlenbeck bridge at K times, from `gaussian_bridge`.

    - `times`: shape (K,).
    - `mean`: the mean at each time, (K, d).
    - `covariance`: the covariance at each time, (K, d, d).

    `sample` samples paths at all K times jointly.
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
        """Sample `num_paths` independent paths at `times`, exact in law.

        A path is Z_t = X_t + K_t (b - X_T) for an unconditional path X, as in the paper's lemma on
        the bridge. The gain K_t is defined in the docstring of the module.
        """
        return _paths(self, key, num_paths)


@compiled_sooner
def _paths(bridge: GaussianBridge, key, num_paths):
    params = ou_params(bridge._model)
    grid = jnp.concatenate([bridge.times, bridge._duration[None]])
    steps = jnp.diff(grid, prepend=jnp.zeros((), grid.dtype))
    decay, covariance = jax.vmap(lambda t: decay_and_covariance(params, t))(steps)
    is_empty = (steps <= 0)[:, None, None]  # no noise between equal times
    identity = jnp.eye(len(bridge._start), dtype=grid.dtype)
    # A zero covariance has no Cholesky factor: factor the identity there, then set zero.
    root = jax.vmap(any_cholesky)(jnp.where(is_empty, identity, covariance))
    root = jnp.where(is_empty, 0, root)
    noise = jax.random.normal(key, (len(steps), num_paths, len(bridge._start)), grid.dtype)

    # `x` holds the deviations from the mean, shape (num_paths, d).
    def step(x, inputs):
        decay, root, noise = inputs
        x = x @ decay.T + noise @ root.T
        return x, x

    start = jnp.broadcast_to(bridge._start - params.mean, (num_paths, len(bridge._start)))
    _, path = lax.scan(step, start, (decay, root, noise))
    # The correction moves each end X_T to b.
    gap = bridge._end - params.mean - path[-1]
    correction = jnp.einsum("kij,nj->nki", bridge._gain, gap)
    return params.mean + jnp.moveaxis(path[:-1], 0, 1) + correction


@public_entry
def gaussian_bridge(
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    times: Numbers,
) -> GaussianBridge:
    """Return the exact law of the bridge from `start` to `end` of an Ornstein–Uhlenbeck model: the
    paper's lemma on the bridge, for any B.

    **Arguments:**

    - `model`: from `ornstein_uhlenbeck`, reversible or not.
    - `start`, `end`: points, shape (d,).
    - `duration`: in units of time, shape ().
    - `times`: within [0, duration], in non-decreasing order, shape (K,).

    **Returns:** `GaussianBridge`.

    **Raises:** `TypeError` for any other model, `ValueError` for arguments that do not fit.

    **Example:**

    ```python
    exact = jb.gaussian_bridge(model, start, end, 1.0, times=[0.25, 0.5])
    exact.mean[1], exact.covariance[1], exact.sample(key, num_paths=1000)
    ```
    """
    params = ou_params(model)
    a, b, horizon = single_interval(params, start, end, duration)
    times = as_floating("times", times).astype(params.B.dtype)
    if times.ndim != 1:
        raise ValueError(f"`times` must have shape (K,); got {times.shape}.")
    if not is_traced(times, horizon) and not (
        np.all(np.diff(times, prepend=0, append=horizon) >= 0) and times.size
    ):
        raise ValueError(
            f"`times` must increase within [0, {horizon}], with at least one entry; got {times}. "
            "Equal times are allowed."
        )
    mean, covariance, gain = _moments(params, a, b, horizon, times)
    return GaussianBridge(times, mean, covariance, model, a, b, horizon, gain)


@compiled_sooner
def _moments(params: OrnsteinUhlenbeckParams, a, b, horizon, times):
    """Return the means, covariances and gains K_t at `times`."""
    decay_T, covariance_T = decay_and_covariance(params, horizon)
    gap = b - params.mean - decay_T @ (a - params.mean)

    def moments(t):
        decay, covariance = decay_and_covariance(params, t)
        remaining, _ = decay_and_covariance(params, horizon - t)
        # K_t is the transpose of Γ_T⁻¹ e^{-B(T-t)} Γ_t, as Γ is symmetric.
        gain = any_solve(covariance_T, remaining @ covariance).T
        mean = params.mean + decay @ (a - params.mean) + gain @ gap
        return mean, covariance - gain @ remaining @ covariance, gain

    return jax.vmap(moments)(times)
