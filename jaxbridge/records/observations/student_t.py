"""Readings with outliers."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...engine.checks import Numbers
from .base import Quantity, as_matrix
from .components import MOST, AbstractComponents, check_positive, stirling


class StudentT(AbstractComponents):
    """Observation model with outliers: y_j = η_j + s t_ν, with η = L x + offset.

    The noise t_ν has Student's law with ν degrees of freedom. Paths are guided by normal noise with
    its variance, s² ν/(ν - 2), but at most 5 s².

    **Arguments:**

    - `matrix`: L, shape (m, d); by default `None`: each component of the state is observed.
    - `scale`: s in units of y, shape () or (m,), or a function `params -> s` or `(params, t) -> s`.
    - `df`: ν > 0, a number or such a function.
    - `offset`: in units of y, shape () or (m,), or such a function.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    observation = jb.StudentT(scale=0.2, df=4.0)
    observation.sample(key, jnp.array([0.7]))  # a reading of this state
    ```
    """

    matrix: Float[Array, "m d"] | None
    scale: Quantity
    df: Quantity
    offset: Quantity

    def __init__(
        self,
        matrix: Numbers | None = None,
        *,
        scale: Numbers | Callable[..., Array],
        df: Numbers | Callable[..., Array] = 4.0,
        offset: Numbers | Callable[..., Array] = 0.0,
    ):
        self.matrix, self.offset = as_matrix(matrix), Quantity("offset", offset)
        self.scale, self.df = Quantity("scale", scale), Quantity("df", df)
        check_positive(self.scale)
        check_positive(self.df, finite=False)

    @property
    def quantities(self):
        return (self.scale, self.df, self.offset)

    def log_density(self, y, eta, params, time):
        s, nu = self._numbers(y, params, time)
        half = nu / 2
        # Stirling's formula for log Γ(ν/2 + ½) - log Γ(ν/2). Large terms cancel.
        ratio = stirling(half + 0.5) - stirling(half) + half * jnp.log1p(0.5 / half) - 0.5
        constant = ratio - np.log(2 * np.pi) / 2 - jnp.log(s)
        return constant - (nu + 1) / 2 * jnp.log1p(((y - eta) / s) ** 2 / nu)

    def guide(self, y, params, time):
        s, nu = self._numbers(y, params, time)
        # Narrower guides follow outliers, and their weights have heavier tails.
        has_less = nu > 2.5
        return y, s**2 * jnp.where(has_less, nu / jnp.where(has_less, nu - 2, 1), 5)

    def draw(self, key, eta, params, time):
        s, nu = self._numbers(eta, params, time)
        return eta + s * jax.random.t(key, nu, eta.shape, eta.dtype)

    def check_data(self, data):
        pass

    def _numbers(self, y, params, time):
        """Return s and ν; beyond a bound the noise is normal in all digits."""
        s, nu = (part.for_components(params, time, len(y)) for part in (self.scale, self.df))
        return s, jnp.minimum(nu, MOST)
