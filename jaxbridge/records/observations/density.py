"""Observations with any density, guided by a normal guess."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...engine.arguments import as_returned, check_function, named
from ...engine.captured import Captured
from ...engine.checks import as_floating, is_traced
from ...engine.generator import with_plain_key
from ...models.diffusion import check_value
from ...models.tracing import takes_time
from .base import AbstractObservation, log_density_of
from .linear_gaussian import LinearGaussian


class ObservationDensity(AbstractObservation):
    """Observation model with any density g(y | x), guided by a normal guess.

    Counts, outliers, proportional errors, and rounded or censored values have models of their own:
    `PoissonCounts`, `NegativeBinomialCounts`, `StudentT`, `LogNormal`, `Rounded`, `Censored`.

    **Arguments:**

    - `log_density`: log g, a function `(y, x, params) -> ()` of an observation, shape (m,), a
        state, shape (d,), and the model's parameters; or a function `(y, x, params, t) -> ()`. A
        row with NaN in every component is missing. The function receives rows with some NaN
        unchanged.
    - `guess`: a similar `LinearGaussian` with positive variances, which guides the paths. The law
        does not depend on it, but the effective sample size does.
    - `sample`: a function `(key, x, params) -> y` or `(key, x, params, t) -> y` that draws an
        observation, shape (m,). Only `forecast` needs it.

    **Raises:** `TypeError` for invalid arguments; `ValueError` if a variance of the guess is not
    positive.

    **Example:**

    ```python
    counts = jb.ObservationDensity(
        lambda y, x, p: jax.scipy.stats.poisson.logpmf(y[0], x[0]),
        guess=jb.LinearGaussian([[1.0]], covariance=20.0),
    )
    ```
    """

    guess: LinearGaussian
    matrix: Float[Array, "m d"] | None
    _log_density: Callable = eqx.field(static=True)
    _sample: Callable | None = eqx.field(static=True)
    _captured: Captured

    def __init__(
        self, log_density: Callable, guess: LinearGaussian, *, sample: Callable | None = None
    ):
        check_function("log_density", log_density, "(y, x, params)", "(y, x, params, t)")
        check_function("sample", sample, "(key, x, params)", "(key, x, params, t)", optional=True)
        if not isinstance(guess, LinearGaussian):
            raise TypeError(f"`guess` must be a `LinearGaussian`; got {guess!r}.")
        if guess.covariance is not None:
            _check_positive(guess.covariance)
        self._log_density, self.guess, self.matrix = log_density, guess, guess.matrix
        self._sample, self._captured = sample, Captured(log_density, sample)

    @property
    def depends_on_time(self):
        functions = (self._log_density, self._sample)
        return any(takes_time(fn, 3) for fn in functions) or self.guess.depends_on_time

    def check(self, values, like, time, params):
        self.guess.check(values, like, time, params)
        _check_positive(self.guess.covariance_for(params, values.shape[1], time))

    def scalars(self, row, params, d):
        return self.guess.scalars(row, params, d)

    def sample(self, key, x, params=None, time=0.0):
        self.check_sample()
        x = as_floating("x", x)
        arguments = (with_plain_key(key), x, params)
        if takes_time(self._sample, 3):
            arguments = (*arguments, jnp.asarray(time, x.dtype))
        y = as_returned("sample", named("sample", self._captured.call)(self._sample, *arguments))
        if y.ndim != 1:
            raise ValueError(f"`sample` must return an observation, shape (m,); got {y.shape}.")
        return y.astype(x.dtype)

    def check_sample(self):
        if self._sample is None:
            raise TypeError(
                "`observation` cannot draw observations: pass `sample`, a function `(key, x, "
                "params) -> y`, to `ObservationDensity`."
            )

    def correction(self, row, x, params):
        y, time = row
        present = jnp.any(jnp.isfinite(y))
        # The user's function receives no empty row, because NaN would spoil its derivatives.
        y_filled = jnp.where(present, y, jnp.zeros_like(y))
        arguments = (y_filled, x, params)
        if takes_time(self._log_density, 3):
            arguments = (*arguments, time)
        true = named("log_density", self._captured.call)(self._log_density, *arguments)
        true = check_value("log_density", true, (), x)
        guess = log_density_of(self.scalars(row, params, x.shape[0]), x)
        return jnp.where(present, true - guess, 0)


def _check_positive(R: Array) -> None:
    """Raise `ValueError` if a variance of the guess is not positive."""
    if is_traced(R):
        return
    if np.any((np.diagonal(R) if R.ndim == 2 else np.asarray(R)) <= 0):
        raise ValueError(f"`guess` must have positive variances; got {R}.")
