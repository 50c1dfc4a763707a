"""Observation models of independent components, with a derived guide.

Component y_j depends on the state through η_j = (L x + offset)_j alone. A model gives
log g(y_j | η_j), and the normal law that guides paths: that of η_j given y_j, under a flat prior or
Jeffreys' prior.
"""

from abc import abstractmethod
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import digamma, gammaln, polygamma
from jaxtyping import Array, Float, Key, PyTree

from ...engine.checks import as_floating, is_traced
from ...engine.generator import with_plain_key
from ...engine.linalg import dot
from .base import AbstractObservation, Quantity, Row, Scalars, check_matrix, matrix_for

# Sizes and degrees of freedom beyond this bound have the limit law in all digits.
MOST = 1e12

# The mean (or median) of a reading is e^η or η.
Link = Literal["log", "identity"]
Normal = tuple[Float[Array, " m"], Float[Array, " m"]]


class AbstractComponents(AbstractObservation):
    """Base class of observation models with independent components.

    With η = L x + offset, component y_j depends on the state through η_j alone. Subclasses define
    `quantities` (the offset and all other `Quantity` fields), `check_data`, and three functions of
    all components at once: `log_density`, `draw`, and `guide`, which returns the mean and variance
    of a normal law of each η_j given y_j.

    - `matrix`: L, shape (m, d), or `None` for the identity.
    - `offset`: the `Quantity` of the offset.

    **Example:** 0 or 1, with the logit η of the probability of 1.

    ```python
    class Binary(jb.AbstractComponents):
        matrix: jax.Array | None = None
        offset: jb.Quantity = jb.Quantity("offset", 0.0)

        @property
        def quantities(self):
            return (self.offset,)

        def log_density(self, y, eta, params, time):
            return y * eta - jnp.logaddexp(0.0, eta)

        def guide(self, y, params, time):
            return 2 * y - 1, jnp.full_like(y, 4.0)

        def draw(self, key, eta, params, time):
            return jax.random.bernoulli(key, jax.nn.sigmoid(eta)).astype(eta.dtype)

        def check_data(self, data):
            pass
    ```
    """

    offset: eqx.AbstractVar[Quantity]

    @property
    @abstractmethod
    def quantities(self) -> tuple[Quantity, ...]:
        """The offset and all other numbers that may be functions of the parameters."""

    @abstractmethod
    def log_density(
        self,
        y: Float[Array, " m"],
        eta: Float[Array, " m"],
        params: PyTree,
        time: Float[Array, ""],
    ) -> Float[Array, " m"]:
        """Return log g(y_j | η_j) of all components; -inf where y_j is impossible."""

    @abstractmethod
    def guide(self, y: Float[Array, " m"], params: PyTree, time: Float[Array, ""]) -> Normal:
        """Return mean and variance of a normal law of each η_j, given y_j.

        An infinite variance says that y_j does not guide the paths.
        """

    @abstractmethod
    def draw(
        self, key: Key[Array, ""], eta: Float[Array, " m"], params: PyTree, time: Float[Array, ""]
    ) -> Float[Array, " m"]:
        """Draw all components y_j, given η_j."""

    @abstractmethod
    def check_data(self, data: Float[np.ndarray, " n"]) -> None:
        """Raise `ValueError` for data that are impossible; `data` are all finite entries."""

    @property
    def depends_on_time(self):
        return any(quantity.depends_on_time for quantity in self.quantities)

    def check(self, values, like, time, params):
        m = values.shape[1]
        check_matrix(self.matrix, m, like)
        for quantity in self.quantities:
            quantity.for_components(params, time, m)
        if not is_traced(values):
            data = np.asarray(values)
            self.check_data(data[np.isfinite(data)])

    def scalars(self, row, params, d):
        value, variance, guides = self._guide_of(row, params)
        rows = matrix_for(self.matrix, d, row.y.dtype)
        offset = self.offset.for_components(params, row.time, len(row.y))
        return Scalars(
            jnp.where(guides[:, None], rows, 0),
            jnp.where(guides, value - offset, 0),
            jnp.where(guides, variance, 1),
            guides,
        )

    def sample(self, key, x, params=None, time=0.0):
        x = as_floating("x", x)
        time = jnp.asarray(time, x.dtype)
        return self.draw(key, self._predictor(x, params, time), params, time)

    def check_sample(self):
        pass

    def correction(self, row, x, params):
        present, eta = jnp.isfinite(row.y), self._predictor(x, params, row.time)
        true = self.log_density(_filled(row.y), eta, params, row.time)
        value, variance, guides = self._guide_of(row, params)
        safe = jnp.where(guides, variance, 1)
        normal = -((value - eta) ** 2 / safe + jnp.log(2 * np.pi * safe)) / 2
        return jnp.sum(jnp.where(present, true - jnp.where(guides, normal, 0), 0))

    def _predictor(self, x, params, time) -> Float[Array, " m"]:
        """Return η = L x + offset."""
        rows = matrix_for(self.matrix, x.shape[0], x.dtype)
        offset = self.offset.for_components(params, time, len(rows))
        return jnp.stack([dot(row, x) for row in rows]) + offset

    def _guide_of(self, row: Row, params: PyTree):
        """Return mean, variance and whether it guides, of each component."""
        value, variance = self.guide(_filled(row.y), params, row.time)
        return value, variance, jnp.isfinite(row.y) & jnp.isfinite(variance)


def _filled(y: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return 1 in place of missing components, a value that all models allow."""
    return jnp.where(jnp.isfinite(y), y, 1)


def stirling(x: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return log Γ(x) - (x - ½) log x + x - ½ log 2π, without loss of digits for large x > 0."""
    is_large = x > 8
    inverse = 1 / jnp.where(is_large, x, 8)
    series = inverse * (1 / 12 - inverse**2 * (1 / 360 - inverse**2 / 1260))
    small = jnp.where(is_large, 1, x)
    exact = gammaln(small) - (small - 0.5) * jnp.log(small) + small - np.log(2 * np.pi) / 2
    return jnp.where(is_large, series, exact)


def expm1_remainder(t: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return e^t - 1 - t, without loss of digits near zero."""
    near = jnp.abs(t) < 0.03
    small = jnp.where(near, t, 0)
    series = small**2 * (1 / 2 + small * (1 / 6 + small * (1 / 24 + small / 120)))
    return jnp.where(near, series, jnp.expm1(t) - t)


def log_counting(y: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return log y! - y log y + y of counts, zero for y = 0."""
    safe = jnp.where(y > 0, y, 1)
    return jnp.where(y > 0, stirling(safe) + jnp.log(2 * np.pi * safe) / 2, 0)


def draw_poisson(key: Key[Array, ""], mean: Float[Array, " m"]) -> Float[Array, " m"]:
    """Draw Poisson counts; beyond a million rounded normal variables, which no integer limits."""
    is_large = mean > 1e6
    normal = jnp.round(mean + jnp.sqrt(mean) * jax.random.normal(key, mean.shape, mean.dtype))
    is_number = mean >= 0
    moderate = jax.random.poisson(with_plain_key(key), jnp.where(is_large | ~is_number, 1, mean))
    counts = jnp.where(is_large, normal, moderate.astype(mean.dtype))
    return jnp.where(is_number, counts, jnp.nan)


def moments_of_log_gamma(shape: Float[Array, " m"]) -> Normal:
    """Return mean and variance of the log of a Gamma(shape, 1) variable."""
    return digamma(shape), polygamma(1, shape)


def log_where_positive(value: Float[Array, " m"]) -> Float[Array, " m"]:
    """Return log(value), and -inf with derivative zero where the value is not positive."""
    positive = value > 0
    return jnp.where(positive, jnp.log(jnp.where(positive, value, 1)), -jnp.inf)


def check_counts(data: Float[np.ndarray, " n"]) -> None:
    """Raise `ValueError` unless all data are whole numbers from 0 on."""
    wrong = data[(data < 0) | (data != np.round(data))]
    if wrong.size:
        raise ValueError(
            f"`observations` must be counts, whole numbers from 0 on; got {wrong[0]:g}. Pass NaN "
            "for a missing count."
        )


def check_positive(quantity: Quantity, finite: bool = True) -> None:
    """Raise `ValueError` unless the numbers, as far as they are known, are positive."""
    value = quantity.value
    if value is None or is_traced(value):
        return
    numbers = np.asarray(value)
    if np.all(numbers > 0) and (not finite or np.all(np.isfinite(numbers))):
        return
    raise ValueError(
        f"`{quantity.name}` must be positive{' and finite' if finite else ''}; got {numbers}."
    )
