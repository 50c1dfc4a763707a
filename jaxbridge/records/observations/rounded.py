"""Rounded readings."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Float

from ...engine.checks import Numbers
from .base import Quantity, as_matrix
from .components import AbstractComponents, check_positive


class Rounded(AbstractComponents):
    """Observation model of rounded readings: y_j is η_j + s ε_j, rounded to a multiple of `width`.

    η = L x + offset, and the ε_j are normal. Paths are guided by normal noise with the variance
    s² + width²/12, that of η given y under a flat prior.

    **Arguments:**

    - `matrix`: L, shape (m, d); by default `None`: each component of the state is observed.
    - `scale`: s in units of y, shape () or (m,), or a function `params -> s` or `(params, t) -> s`.
    - `width`: the distance of neighbouring rounded values, shape () or (m,).
    - `offset`: in units of y, shape () or (m,), or such a function.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    observation = jb.Rounded(scale=0.2, width=1.0)
    observation.sample(key, jnp.array([0.7]))  # a reading of this state, a whole number
    ```
    """

    matrix: Float[Array, "m d"] | None
    scale: Quantity
    width: Quantity
    offset: Quantity

    def __init__(
        self,
        matrix: Numbers | None = None,
        *,
        scale: Numbers | Callable[..., Array],
        width: Numbers,
        offset: Numbers | Callable[..., Array] = 0.0,
    ):
        self.matrix = as_matrix(matrix)
        self.scale, self.offset = Quantity("scale", scale), Quantity("offset", offset)
        self.width = Quantity("width", width)
        check_positive(self.scale)
        check_positive(self.width)

    @property
    def quantities(self):
        return (self.scale, self.width, self.offset)

    def log_density(self, y, eta, params, time):
        s, width = self._numbers(y, params, time)
        # By symmetry the reading is above η: then the difference of both tails loses no digits.
        distance, half = jnp.abs(y - eta) / s, width / s / 2
        upper, lower = log_ndtr(half - distance), log_ndtr(-half - distance)
        return upper + jnp.log(-jnp.expm1(lower - upper))

    def guide(self, y, params, time):
        s, width = self._numbers(y, params, time)
        return y, s**2 + width**2 / 12

    def draw(self, key, eta, params, time):
        s, width = self._numbers(eta, params, time)
        value = eta + s * jax.random.normal(key, eta.shape, eta.dtype)
        return width * jnp.round(value / width)

    def check_data(self, data):
        pass

    def _numbers(self, y, params, time):
        return [part.for_components(params, time, len(y)) for part in (self.scale, self.width)]
