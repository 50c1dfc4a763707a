"""Positive readings with proportional errors."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...engine.arguments import check_choice
from ...engine.checks import Numbers
from .base import Quantity, as_matrix
from .components import AbstractComponents, Link, check_positive, log_where_positive


class LogNormal(AbstractComponents):
    """Observation model with proportional errors: log y_j = log μ_j + s ε_j, ε_j ~ N(0, 1).

    With η = L x + offset the medians μ are e^η (`link="log"`) or η (`link="identity"`). The guide
    is exact for "log"; for "identity" it has the moments of a log-normal law around y.

    **Arguments:**

    - `matrix`: L, shape (m, d); by default `None`: each component of the state is observed.
    - `scale`: s, for small values the relative error; shape () or (m,), or a function `params -> s`
        or `(params, t) -> s`.
    - `offset`: shape () or (m,), or such a function.
    - `link`: "log" (default) for a state that is a logarithm, "identity" for a positive state. With
        "identity" the density is zero where η is not positive.

    **Raises:** `ValueError` and `TypeError` for invalid arguments; `ValueError` for observations
    that are not positive.

    **Example:**

    ```python
    errors = jb.LogNormal(scale=0.1)
    errors.sample(key, jnp.array([0.7]))  # an observation of this state
    ```
    """

    matrix: Float[Array, "m d"] | None
    scale: Quantity
    offset: Quantity
    link: Link = eqx.field(static=True)

    def __init__(
        self,
        matrix: Numbers | None = None,
        *,
        scale: Numbers | Callable[..., Array],
        offset: Numbers | Callable[..., Array] = 0.0,
        link: Link = "log",
    ):
        check_choice("link", link, ("log", "identity"))
        self.matrix, self.link = as_matrix(matrix), link
        self.scale, self.offset = Quantity("scale", scale), Quantity("offset", offset)
        check_positive(self.scale)

    @property
    def quantities(self):
        return (self.scale, self.offset)

    def log_density(self, y, eta, params, time):
        s = self.scale.for_components(params, time, len(y))
        log_median = eta if self.link == "log" else log_where_positive(eta)
        possible = jnp.isfinite(log_median)
        z = (jnp.log(y) - jnp.where(possible, log_median, 0)) / s
        log_g = -(z**2) / 2 - jnp.log(s * y) - np.log(2 * np.pi) / 2
        return jnp.where(possible, log_g, -jnp.inf)

    def guide(self, y, params, time):
        variance = self.scale.for_components(params, time, len(y)) ** 2
        if self.link == "log":
            return jnp.log(y), variance
        mean = y * jnp.exp(variance / 2)
        return mean, mean**2 * jnp.expm1(variance)

    def draw(self, key, eta, params, time):
        s = self.scale.for_components(params, time, len(eta))
        median = jnp.exp(eta) if self.link == "log" else jnp.maximum(eta, 0)
        return median * jnp.exp(s * jax.random.normal(key, eta.shape, eta.dtype))

    def check_data(self, data):
        if np.any(data <= 0):
            raise ValueError(
                f"`observations` must be positive for `LogNormal`; got {data[data <= 0][0]:g}. "
                "Pass NaN for a missing value, or use `Censored` for values below a limit."
            )
