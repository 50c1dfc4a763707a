"""Counts that vary more than Poisson counts."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Array, Float

from ...engine.arguments import check_choice
from ...engine.checks import Numbers
from .base import Quantity, as_matrix
from .components import (
    AbstractComponents,
    check_counts,
    check_positive,
    log_where_positive,
    moments_of_log_gamma,
)
from .poisson import Link


class NegativeBinomialCounts(AbstractComponents):
    """Observation model of counts with mean μ and variance μ + μ²/r, independent given the state.

    With η = L x + offset the means are e^η (`link="log"`) or η (`link="identity"`). As r → ∞ the
    counts become Poisson counts. Paths are guided by the law of η given y for which μ/(μ + r) is
    Beta(y + ½, r)-distributed.

    **Arguments:**

    - `matrix`: L, shape (m, d); by default `None`: each component of the state has counts.
    - `size`: r, shape () or (m,), or a function `params -> r` or `(params, t) -> r`.
    - `offset`: shape () or (m,), or such a function; for instance the log of an exposure.
    - `link`: "log" for a state that is a logarithm, "identity" for a positive state.

    **Raises:** `ValueError` and `TypeError` for invalid arguments; `ValueError` for observations
    that are not whole numbers from 0 on.

    **Example:**

    ```python
    model = jb.ornstein_uhlenbeck([[1.0]])
    seen = jb.NegativeBinomialCounts(size=5.0, offset=3.0)
    jb.log_likelihood(key, model, [0.0, 1.0], [17, 25], observation=seen)
    ```
    """

    matrix: Float[Array, "m d"] | None
    size: Quantity
    offset: Quantity
    link: Link = eqx.field(static=True)

    def __init__(
        self,
        matrix: Numbers | None = None,
        *,
        size: Numbers | Callable[..., Array],
        offset: Numbers | Callable[..., Array] = 0.0,
        link: Link = "log",
    ):
        check_choice("link", link, ("log", "identity"))
        self.matrix, self.link = as_matrix(matrix), link
        self.size, self.offset = Quantity("size", size), Quantity("offset", offset)
        check_positive(self.size)

    @property
    def quantities(self):
        return (self.size, self.offset)

    def log_density(self, y, eta, params, time):
        r = self.size.for_components(params, time, len(y))
        log_mean = eta if self.link == "log" else log_where_positive(eta)
        # log of 1 + μ/r; for a mean of zero the count is zero.
        log_sum = jnp.logaddexp(0.0, log_mean - jnp.log(r))
        terms = jnp.where(y > 0, y * jnp.where(y > 0, log_mean - jnp.log(r) - log_sum, 0), 0)
        log_g = gammaln(y + r) - gammaln(r) - gammaln(y + 1) + terms - r * log_sum
        return log_g if self.link == "log" else jnp.where(eta >= 0, log_g, -jnp.inf)

    def guide(self, y, params, time):
        r, count = self.size.for_components(params, time, len(y)), y + 0.5
        if self.link == "identity":
            return count, count + count**2 / r
        # The logit of a Beta(a, b) variable is the difference of two logs of Gamma variables.
        (upper, var_upper), (lower, var_lower) = map(moments_of_log_gamma, (count, r))
        return jnp.log(r) + upper - lower, var_upper + var_lower

    def draw(self, key, eta, params, time):
        r = self.size.for_components(params, time, len(eta))
        mean_key, count_key = jax.random.split(key)
        mean = jnp.exp(eta) if self.link == "log" else jnp.maximum(eta, 0)
        # A Poisson law whose mean has a Gamma law.
        mean = mean * jax.random.gamma(mean_key, r) / r
        return jax.random.poisson(count_key, mean).astype(eta.dtype)

    def check_data(self, data):
        check_counts(data)
