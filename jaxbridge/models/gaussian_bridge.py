"""The bridges of the Ornstein–Uhlenbeck process in closed form (section 3.1 of the paper).

The bridge from a to b in T is Gaussian. With Γ_t of `ornstein_uhlenbeck` and the gain
`K_t = Γ_t e^{-Bᵀ(T-t)} Γ_T⁻¹` its moments are

    E Z_t = m + e^{-tB}(a - m) + K_t (b - m - e^{-TB}(a - m)),
    Var Z_t = Γ_t - K_t e^{-B(T-t)} Γ_t.

(The paper prints the gain without these transposes; that is right for reversible processes.)
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key

from ..engine.checks import Numbers, as_floating, is_traced
from ..engine.compiled import compiled_sooner
from ..engine.doors import door
from ..engine.linalg import any_cholesky, any_solve
from .diffusion import Diffusion
from .ornstein_uhlenbeck import (
    OrnsteinUhlenbeckParams,
    decay_and_covariance,
    ou_params,
    single_interval,
)


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
        return _paths(self, key, num_paths)


@compiled_sooner
def _paths(bridge: GaussianBridge, key, num_paths):
    params = ou_params(bridge._model)
    grid = jnp.concatenate([bridge.times, bridge._duration[None]])
    steps = jnp.diff(grid, prepend=jnp.zeros((), grid.dtype))
    decay, covariance = jax.vmap(lambda t: decay_and_covariance(params, t))(steps)
    still = (steps <= 0)[:, None, None]  # two equal times: no noise between them
    identity = jnp.eye(len(bridge._start), dtype=grid.dtype)
    root = jax.vmap(any_cholesky)(jnp.where(still, identity, covariance))
    root = jnp.where(still, 0, root)
    noise = jax.random.normal(key, (len(steps), num_paths, len(bridge._start)), grid.dtype)

    def step(x, inputs):  # x: deviations from the mean, (num_paths, d)
        decay, root, noise = inputs
        x = x @ decay.T + noise @ root.T
        return x, x

    start = jnp.broadcast_to(bridge._start - params.mean, (num_paths, len(bridge._start)))
    _, path = lax.scan(step, start, (decay, root, noise))
    miss = bridge._end - params.mean - path[-1]
    correction = jnp.einsum("kij,nj->nki", bridge._gain, miss)
    return params.mean + jnp.moveaxis(path[:-1], 0, 1) + correction


@door
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
    params = ou_params(model)
    a, b, total = single_interval(params, start, end, duration)
    times = as_floating("times", times).astype(params.B.dtype)
    if times.ndim != 1:
        raise ValueError(f"`times` must have shape (K,); got {times.shape}.")
    if not is_traced(times, total) and not (
        np.all(np.diff(times, prepend=0, append=total) >= 0) and times.size
    ):
        raise ValueError(f"`times` must increase within [0, {total}]; got {times}.")
    mean, covariance, gain = _moments(params, a, b, total, times)
    return GaussianBridge(times, mean, covariance, model, a, b, total, gain)


@compiled_sooner
def _moments(params: OrnsteinUhlenbeckParams, a, b, total, times):
    decay_T, covariance_T = decay_and_covariance(params, total)
    miss = b - params.mean - decay_T @ (a - params.mean)

    def moments(t):
        decay, covariance = decay_and_covariance(params, t)
        remaining, _ = decay_and_covariance(params, total - t)
        gain = any_solve(covariance_T, remaining @ covariance).T
        mean = params.mean + decay @ (a - params.mean) + gain @ miss
        return mean, covariance - gain @ remaining @ covariance, gain

    return jax.vmap(moments)(times)
