"""Readings beyond a limit of detection, and rounded readings."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Float

from ...engine.checks import Numbers, is_traced
from .base import Quantity, as_matrix
from .components import AbstractComponents, check_positive


class Censored(AbstractComponents):
    """Observation model with limits: y_j = η_j + s ε_j, seen only between `lower` and `upper`.

    η = L x + offset, and the ε_j are normal. A reading at `lower` or below says that the value was
    at most `lower`; one at `upper` or above, that it was at least `upper`. Such readings do not
    guide the paths. They weight them by the probability of what was seen.

    **Arguments:**

    - `matrix`: L, shape (m, d); by default `None`: each component of the state is observed.
    - `scale`: s in units of y, shape () or (m,), or a function `params -> s` or `(params, t) -> s`.
    - `lower`, `upper`: limits in units of y, shape () or (m,), or such functions; infinite by
        default.
    - `offset`: in units of y, shape () or (m,), or such a function.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    observation = jb.Censored(scale=0.2, lower=-0.5)
    observation.sample(key, jnp.array([-0.4]))  # a reading of this state: -0.5 or more
    ```
    """

    matrix: Float[Array, "m d"] | None
    scale: Quantity
    lower: Quantity
    upper: Quantity
    offset: Quantity

    def __init__(
        self,
        matrix: Numbers | None = None,
        *,
        scale: Numbers | Callable[..., Array],
        lower: Numbers = -np.inf,
        upper: Numbers = np.inf,
        offset: Numbers | Callable[..., Array] = 0.0,
    ):
        self.matrix = as_matrix(matrix)
        self.scale, self.offset = Quantity("scale", scale), Quantity("offset", offset)
        self.lower, self.upper = Quantity("lower", lower), Quantity("upper", upper)
        check_positive(self.scale)
        low, high = self.lower.value, self.upper.value
        if low is not None and high is not None and not is_traced(low, high):
            if not np.all(np.asarray(low) < np.asarray(high)):
                raise ValueError(f"`lower` must be below `upper`; got {low} and {high}.")

    @property
    def quantities(self):
        return (self.scale, self.lower, self.upper, self.offset)

    def log_density(self, y, eta, params, time):
        s, lower, upper = self._numbers(y, params, time)
        is_below, is_above = y <= lower, y >= upper
        # Limits may be infinite: differences to them would have no derivative.
        z = (y - eta) / s
        to_limit = jnp.where(is_below, lower - eta, jnp.where(is_above, eta - upper, 0)) / s
        between = -(z**2) / 2 - jnp.log(s) - np.log(2 * np.pi) / 2
        return jnp.where(is_below | is_above, log_ndtr(to_limit), between)

    def guide(self, y, params, time):
        s, lower, upper = self._numbers(y, params, time)
        return y, jnp.where((y > lower) & (y < upper), s**2, jnp.inf)

    def draw(self, key, eta, params, time):
        s, lower, upper = self._numbers(eta, params, time)
        return jnp.clip(eta + s * jax.random.normal(key, eta.shape, eta.dtype), lower, upper)

    def check_data(self, data):
        pass

    def _numbers(self, y, params, time):
        quantities = (self.scale, self.lower, self.upper)
        return [quantity.for_components(params, time, len(y)) for quantity in quantities]
