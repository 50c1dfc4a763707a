"""The Ornstein–Uhlenbeck process with a mean that changes with the season."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..engine.checks import Numbers, as_floating, check_range
from .diffusion import Diffusion


class SeasonalParams(NamedTuple):
    """Parameters of `seasonal_ornstein_uhlenbeck`, the `params` of the model, shape () or (d,)
    each.

    - `rate`: per unit of time.
    - `mean`, `amplitude`: in units of space.
    - `phase`: in radians.
    - `period`: in units of time.
    - `sigma`: in space per square root of a unit of time.

    **Example:**

    ```python
    model = jb.seasonal_ornstein_uhlenbeck()
    stronger = model.with_params(model.params._replace(amplitude=jnp.asarray(3.0)))
    ```
    """

    rate: Float[Array, "..."]
    mean: Float[Array, "..."]
    amplitude: Float[Array, "..."]
    phase: Float[Array, "..."]
    period: Float[Array, "..."]
    sigma: Float[Array, "..."]


def seasonal_ornstein_uhlenbeck(
    rate: Numbers = 1.0,
    mean: Numbers = 0.0,
    amplitude: Numbers = 1.0,
    phase: Numbers = 0.0,
    period: Numbers = 1.0,
    sigma: Numbers = 1.0,
) -> Diffusion:
    """Return the model of independent coordinates that revert to a seasonal mean, as temperatures
    do (Alaton, Djehiche & Stillberger 2002):

        dX = -a (X - m(t)) dt + σ dW,    m(t) = mean + amplitude · sin(2πt / period + phase).

    t is the absolute time, on the same clock as `times`. `params` is a `SeasonalParams`.

    **Arguments:** shape () or (d,) each:

    - `rate`: a, per unit of time.
    - `mean`, `amplitude`: in units of space.
    - `phase`: in radians.
    - `period`: in units of time, positive.
    - `sigma`: σ ≥ 0, in space per square root of a unit of time.

    **Raises:** `ValueError` for other shapes or values.

    **Example:**

    ```python
    model = jb.seasonal_ornstein_uhlenbeck(rate=2.0, period=365.25)
    model.drift(jnp.zeros(1), 365.25 / 4)  # Array([2.], dtype=float32)
    ```
    """
    values = SeasonalParams(rate, mean, amplitude, phase, period, sigma)  # pyright: ignore
    arrays = {name: as_floating(name, value) for name, value in values._asdict().items()}
    for name, value in arrays.items():
        if value.ndim > 1:
            raise ValueError(f"`{name}` must have shape () or (d,); got {value.shape}.")
        check_range(name, value, positive=name == "period", nonnegative=name == "sigma")
    return Diffusion(_drift, _sigma, params=SeasonalParams(**arrays))


def _drift(x: Float[Array, " d"], p: SeasonalParams, t: Float[Array, ""]) -> Float[Array, " d"]:
    # The remainder is exact. After many periods, t / period has a large rounding error.
    time_in_period = jnp.fmod(t, p.period)
    season = jnp.sin(2 * np.pi * time_in_period / p.period + p.phase)
    return -p.rate * (x - p.mean - p.amplitude * season)


def _sigma(x: Float[Array, " d"], p: SeasonalParams) -> Float[Array, " d"]:
    return jnp.broadcast_to(p.sigma, x.shape)
