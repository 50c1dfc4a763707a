"""Counts that vary more than Poisson counts."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...engine.arguments import check_choice
from ...engine.checks import Numbers
from .base import Quantity, as_matrix
from .components import (
    MOST,
    AbstractComponents,
    Link,
    check_counts,
    check_positive,
    draw_poisson,
    log_counting,
    moments_of_log_gamma,
    stirling,
)


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
    observation = jb.NegativeBinomialCounts(size=5.0, offset=3.0)
    observation.sample(key, jnp.array([0.2]))  # a count in this state
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
        check_positive(self.size, finite=False)

    @property
    def quantities(self):
        return (self.size, self.offset)

    def log_density(self, y, eta, params, time):
        r, is_positive = self._size(y, params, time), y > 0
        possible = jnp.ones_like(is_positive) if self.link == "log" else eta > 0
        safe = jnp.where(is_positive, y, 1)
        log_mean = eta if self.link == "log" else jnp.log(jnp.where(possible, eta, safe))
        # y log(μ/y) + (y + r) log((y + r)/(μ + r)) with μ = y e^τ. Large terms cancel, in one of
        # two ways, and are not computed.
        tau = log_mean - jnp.log(safe)
        is_far = tau > 20  # e^τ would overflow
        growth = jnp.where(
            is_far,
            jnp.logaddexp(jnp.log(r), log_mean) - jnp.log(safe + r),
            jnp.log1p(safe * jnp.expm1(jnp.where(is_far, 0, tau)) / (safe + r)),
        )
        share = jnp.log1p(r / safe) - jnp.logaddexp(0.0, jnp.log(r) - log_mean)
        some = jnp.where(r > safe, safe * (tau - growth), safe * share) - r * growth
        # Stirling's formula for log Γ(y + r) - log Γ(r) - log y!
        some += stirling(safe + r) - stirling(r) - jnp.log1p(safe / r) / 2 - log_counting(safe)
        log_g = jnp.where(is_positive, some, -r * jnp.logaddexp(0.0, log_mean - jnp.log(r)))
        return jnp.where(possible, log_g, jnp.where((eta == 0) & ~is_positive, 0, -jnp.inf))

    def guide(self, y, params, time):
        r, count = self._size(y, params, time), y + 0.5
        if self.link == "identity":
            return count, count + count**2 / r
        # The logit of a Beta(a, b) variable is the difference of two logs of Gamma variables.
        (upper, var_upper), (lower, var_lower) = map(moments_of_log_gamma, (count, r))
        return jnp.log(r) + upper - lower, var_upper + var_lower

    def draw(self, key, eta, params, time):
        r = self._size(eta, params, time)
        mean_key, count_key = jax.random.split(key)
        mean = jnp.exp(eta) if self.link == "log" else jnp.maximum(eta, 0)
        # A Poisson law whose mean has a Gamma law.
        mean = mean * jax.random.gamma(mean_key, r) / r
        return draw_poisson(count_key, mean)

    def check_data(self, data):
        check_counts(data)

    def _size(self, y, params, time):
        """Return r of each component, at most `MOST`.

        With a larger r the counts equal Poisson counts in all digits.
        """
        return jnp.minimum(self.size.for_components(params, time, len(y)), MOST)
