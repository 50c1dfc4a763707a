"""Poisson counts."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...engine.arguments import check_choice
from ...engine.checks import Numbers
from .base import Quantity, as_matrix
from .components import (
    AbstractComponents,
    Link,
    check_counts,
    draw_poisson,
    expm1_remainder,
    log_counting,
    moments_of_log_gamma,
)


class PoissonCounts(AbstractComponents):
    """Observation model of Poisson counts with means μ_j, independent given the state.

    With η = L x + offset the means are e^η (`link="log"`) or η (`link="identity"`). Paths are
    guided by the normal law with the mean and variance of η given y under Jeffreys' prior: μ then
    has the law Gamma(y + ½, 1).

    **Arguments:**

    - `matrix`: L, shape (m, d); by default `None`: each component of the state has counts.
    - `offset`: shape () or (m,), or a function `params -> offset` or `(params, t) -> offset`; for
        instance the log of an exposure.
    - `link`: "log" (default) for a state that is a logarithm, "identity" for a positive state. With
        "identity" the density is zero where η is negative.

    **Raises:** `ValueError` and `TypeError` for invalid arguments; `ValueError` for observations
    that are not whole numbers from 0 on.

    **Example:**

    ```python
    model = jb.ornstein_uhlenbeck([[1.0]])
    observation = jb.PoissonCounts(offset=jnp.log(20.0))
    jb.log_likelihood(key, model, [0.0, 1.0], [17, 25], observation=observation)
    ```
    """

    matrix: Float[Array, "m d"] | None
    offset: Quantity
    link: Link = eqx.field(static=True)

    def __init__(
        self,
        matrix: Numbers | None = None,
        *,
        offset: Numbers | Callable[..., Array] = 0.0,
        link: Link = "log",
    ):
        check_choice("link", link, ("log", "identity"))
        self.matrix, self.offset, self.link = as_matrix(matrix), Quantity("offset", offset), link

    @property
    def quantities(self):
        return (self.offset,)

    def log_density(self, y, eta, params, time):
        # y log μ - μ - log y! with μ = y e^τ. Its large terms cancel, so they are not computed.
        is_positive, safe = y > 0, jnp.where(y > 0, y, 1)
        if self.link == "log":
            tau = eta - jnp.log(safe)
            some, none = -safe * expm1_remainder(tau), -jnp.exp(eta)
        else:
            possible = eta > 0
            mean = jnp.where(possible, eta, safe)
            some = -safe * expm1_remainder(jnp.log(mean) - jnp.log(safe))
            some = jnp.where(possible, some, -jnp.inf)
            none = jnp.where(eta >= 0, -eta, -jnp.inf)
        return jnp.where(is_positive, some - log_counting(y), none)

    def guide(self, y, params, time):
        return moments_of_log_gamma(y + 0.5) if self.link == "log" else (y + 0.5, y + 0.5)

    def draw(self, key, eta, params, time):
        mean = jnp.exp(eta) if self.link == "log" else jnp.maximum(eta, 0)
        return draw_poisson(key, mean)

    def check_data(self, data):
        check_counts(data)
