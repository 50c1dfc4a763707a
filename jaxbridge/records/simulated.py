"""Simulated observations of a model, with the times and the missing values of a record."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from ..coupling import Stationary
from ..engine.checks import Numbers, check_key
from ..engine.entry import public_entry
from ..models.diffusion import Diffusion
from ..models.jumps import JumpsLike
from .forecast import forecast
from .initial import Initial, as_initial, bound
from .observations import AbstractObservation
from .record import as_rows

# Number of paths from which one is drawn, if they start from the stationary law. If this law is not
# normal, their first states are a sample of it by importance resampling.
_NUM_STATIONARY = 500


@public_entry
def simulate_observations(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    observation: AbstractObservation,
    initial: Initial = None,
    num_steps: int | None = None,
    step_size: float | None = None,
    initial_time: Numbers | None = None,
    jumps: JumpsLike = None,
) -> Float[Array, "times m"]:
    """Simulate observations of the model, for posterior predictive checks and trials.

    For checks with uncertain parameters, call this function under `jax.vmap` over draws of a
    posterior.

    **Arguments:**

    - `key`: a typed key.
    - `model`: the diffusion at fixed parameters.
    - `times`, `observation`, `initial`, `num_steps`, `step_size`, `initial_time`, `jumps`: as in
        `forecast`, for one record. Use short steps, because their error is not reported.
    - `observations`: the record, or any numbers of its shape. Simulated ones have its shape and its
        missing values; other values do not matter.

    **Returns:** observations of shape (n, m). NaN where `observations` are, and for a path that
    left the state space.

    **Raises:** as `forecast`.

    **Example:**

    ```python
    model, observation = jb.ornstein_uhlenbeck([[1.0]]), jb.LinearGaussian(covariance=0.1)
    times, like = jnp.arange(10.0), jnp.zeros(10)
    made = jb.simulate_observations(key, model, times, like, observation=observation, num_steps=4)
    ```
    """
    check_key(key)
    rows = as_rows(observations)
    is_stationary = initial is None or isinstance(bound(as_initial(initial), model), Stationary)
    num_paths = _NUM_STATIONARY if is_stationary else 2
    path_key, pick_key = jax.random.split(key)
    # Without readings each particle is a path of the model, with readings.
    drawn = forecast(
        path_key,
        model,
        times,
        jnp.full(rows.shape, jnp.nan, rows.dtype),
        observation=observation,
        initial=initial,
        num_particles=num_paths,
        num_steps=num_steps,
        step_size=step_size,
        initial_time=initial_time,
        jumps=jumps,
    )
    picked = jax.random.randint(pick_key, (), 0, num_paths)
    return jnp.where(jnp.isnan(rows), jnp.nan, drawn.readings[picked])
