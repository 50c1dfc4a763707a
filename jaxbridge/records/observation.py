"""Observation models: the law of y_k given X(t_k).

A normal observation y = L x + N(0, R) becomes a series of independent scalars. The factorisation
R = U D Uᵀ of the observed components, with U unit triangular, gives scalars c·x + N(0, ρ), with
ρ = 0 for exact ones. They are used one after the other. Hence R need not be invertible, and missing
components are left out. A scalar that follows from exact ones is left out, too, if it agrees with
them. If it does not agree, or if R has a negative variance, the likelihood is zero.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from ..engine.arguments import as_returned, check_function, named
from ..engine.captured import Captured
from ..engine.checks import Numbers, as_floating, is_traced
from ..engine.linalg import dot, safe_norm
from ..models.diffusion import check_value
from ..models.tracing import takes_time


class Scalars(NamedTuple):
    """Independent scalar observations of one state x.

    Their law is `values` = `rows` x + N(0, diag(`variances`)). `seen` is false for missing scalars,
    which have row 0 and variance 1.
    """

    rows: Float[Array, "m d"]
    values: Float[Array, " m"]
    variances: Float[Array, " m"]
    seen: Bool[Array, " m"]


class Row(NamedTuple):
    """Observation y at one time, NaN for missing components, and the time."""

    y: Float[Array, "m *lanes"]
    time: Float[Array, "*lanes"]


class LinearGaussian(eqx.Module):
    """Observation model with linear observations and normal noise: y = L x + N(0, R).

    NaN marks missing components of an observation. R may be singular, and zero for exact
    components.

    **Arguments:**

    - `matrix`: L, shape (m, d); by default `None`, which means that the whole state is observed.
    - `covariance`: R in squared units of y, with shape (m, m), (m,) for a diagonal matrix, or ()
        for a multiple of I. The default 0 means exact observations. For unknown or time-dependent
        noise pass a function `params -> R` of the model's parameters, or `(params, t) -> R`.

    **Raises:** `ValueError` and `TypeError` for an invalid matrix or covariance.

    **Example:**

    ```python
    observation = jb.LinearGaussian(matrix=[[1.0, 0.0]], covariance=0.01)
    ```
    """

    matrix: Float[Array, "m d"] | None
    covariance: Float[Array, "..."] | None
    _function: Callable | None = eqx.field(static=True)
    _captured: Captured

    def __init__(
        self, matrix: Numbers | None = None, covariance: Numbers | Callable[[PyTree], Array] = 0.0
    ):
        self.matrix = None if matrix is None else as_floating("matrix", matrix)
        if self.matrix is not None:
            if self.matrix.ndim != 2:
                raise ValueError(f"`matrix` must have shape (m, d); got shape {self.matrix.shape}.")
            if not is_traced(self.matrix) and not np.all(np.isfinite(self.matrix)):
                raise ValueError(f"`matrix` must be finite; got {self.matrix}.")
        if callable(covariance):
            check_function("covariance", covariance, "(params)", "(params, t)")
        self._function = covariance if callable(covariance) else None
        self._captured = Captured(self._function)
        self.covariance = None if callable(covariance) else as_floating("covariance", covariance)
        if self.covariance is not None:
            _check_covariance(self.covariance)

    @property
    def linear(self) -> "LinearGaussian":
        """Return the linear observation model of the guide: this one."""
        return self

    @property
    def depends_on_time(self) -> bool:
        """Return whether R depends on time."""
        return takes_time(self._function, 1)

    def covariance_for(self, params: PyTree, m: int, time: Float[Array, ""]) -> Float[Array, "m m"]:
        """Return the covariance R of the noise at these parameters and this time, shape (m, m).

        **Raises:** `ValueError` for a covariance of another shape.
        """
        value, dtype = self.covariance, time.dtype
        if self._function is not None:
            arguments = (params, time) if self.depends_on_time else (params,)
            value = named("covariance", self._captured.call)(self._function, *arguments)
            value = as_returned("covariance", value)
        assert value is not None
        if value.shape not in ((), (m,), (m, m)):
            raise ValueError(
                f"`covariance` must have shape (), ({m},) or ({m}, {m}) for observations of {m} "
                f"components; got shape {value.shape}."
            )
        value = value.astype(dtype)
        return value if value.ndim == 2 else value * np.eye(m, dtype=dtype)

    def matrix_for(self, d: int, m: int, dtype) -> Float[Array, "m d"]:
        """Return L as a matrix, shape (m, d)."""
        if self.matrix is None:
            return jnp.eye(d, dtype=dtype)
        return self.matrix.astype(dtype)

    def check(self, m: int, like: Array, time: Float[Array, ""], params: PyTree) -> None:
        """Raise `ValueError` if this model does not fit observations of m components.

        `like` is a point of the state space, and `time` the time of an observation.
        """
        (d,) = like.shape
        rows = d if self.matrix is None else self.matrix.shape[0]
        if self.matrix is not None and self.matrix.shape[1] != d:
            raise ValueError(
                f"`matrix` must have shape (m, {d}) for a state of {d} dimensions; got shape "
                f"{self.matrix.shape}."
            )
        if rows != m:
            raise ValueError(
                f"`observations` have {m} components, but the observation model has {rows}: as "
                "many as `matrix` has rows, or the whole state without a `matrix`. Pass a `matrix` "
                f"of shape ({m}, {d})."
            )
        matrix, R = self.matrix_for(d, m, like.dtype), self.covariance_for(params, m, time)
        if is_traced(matrix, R):
            return
        _check_covariance(R)
        blocks = [np.asarray(part, float) for part in (matrix, R)]
        rank = np.linalg.matrix_rank(np.hstack([a / max(np.abs(a).max(), 1e-300) for a in blocks]))
        if rank < m:
            raise ValueError(
                f"{m} components are observed, but `matrix` and `covariance` side by side have "
                f"rank {rank}: leave out components that follow from others without noise, or give "
                "them a variance."
            )

    def scalars(self, row: Row, params: PyTree, d: int) -> Scalars:
        """Return the observations as independent scalars."""
        y, time = row
        m, present = y.shape[0], jnp.isfinite(y)
        rows = jnp.where(present[:, None], self.matrix_for(d, m, y.dtype), 0)
        R = self.covariance_for(params, m, time)
        R = jnp.where(present[:, None] & present, R, 0)
        scalars, sizes, possible = _independent(Scalars(rows, jnp.where(present, y, 0), R, present))
        follows, agrees = _follows(scalars, sizes)
        scalars = scalars._replace(
            rows=jnp.where(follows[:, None], 0, scalars.rows),
            values=jnp.where(follows, 0, scalars.values),
            variances=jnp.where(follows, 1, scalars.variances),
            seen=present & ~follows,
        )
        # If no state explains y, the scalars do not depend on x, and their log density is -inf.
        beyond = 2 * np.sqrt(float(jnp.finfo(y.dtype).max))
        never = Scalars(jnp.zeros_like(rows), jnp.full_like(y, beyond), jnp.ones_like(y), present)
        explained = possible & jnp.all(agrees)
        return jax.tree.map(lambda a, b: jnp.where(explained, a, b), scalars, never)

    def correction(self, row, x, params):
        """Return log g minus the log density of the guide's model: zero."""
        return jnp.zeros((), x.dtype)


class ObservationDensity(eqx.Module):
    """Observation model with any density g(y | x): counts, angles, rounded or censored values.

    **Arguments:**

    - `log_density`: log g, a function `(y, x, params) -> ()` of an observation, shape (m,), a
        state, shape (d,), and the model's parameters; or a function `(y, x, params, t) -> ()`. A
        row with NaN in every component is missing. The function receives rows with some NaN
        unchanged.
    - `guess`: a similar `LinearGaussian` with positive variances, which guides the paths. The law
        does not depend on it, but the effective sample size does.

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
    _log_density: Callable = eqx.field(static=True)
    _captured: Captured

    def __init__(self, log_density: Callable, guess: LinearGaussian):
        check_function("log_density", log_density, "(y, x, params)", "(y, x, params, t)")
        if not isinstance(guess, LinearGaussian):
            raise TypeError(f"`guess` must be a `LinearGaussian`; got {guess!r}.")
        if guess.covariance is not None:
            _check_positive(guess.covariance)
        self._log_density, self.guess = log_density, guess
        self._captured = Captured(log_density)

    @property
    def linear(self) -> LinearGaussian:
        """Return the linear observation model of the guide: `guess`."""
        return self.guess

    @property
    def depends_on_time(self) -> bool:
        """Return whether g or the guess depends on time."""
        return takes_time(self._log_density, 3) or self.guess.depends_on_time

    def check(self, m: int, like: Array, time: Float[Array, ""], params: PyTree) -> None:
        """Raise `ValueError` if the guess does not fit observations of m components.

        `like` is a point of the state space, and `time` the time of an observation.
        """
        self.guess.check(m, like, time, params)
        _check_positive(self.guess.covariance_for(params, m, time))

    def scalars(self, row: Row, params: PyTree, d: int) -> Scalars:
        """Return the observations as independent scalars, under the linear model `guess`."""
        return self.guess.scalars(row, params, d)

    def correction(self, row: Row, x: Float[Array, " d"], params: PyTree) -> Float[Array, ""]:
        """Return log g(y | x) minus the log density of the guess."""
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


Observation = LinearGaussian | ObservationDensity


def log_density_of(scalars: Scalars, x: Float[Array, " d"]) -> Float[Array, ""]:
    """Return the log density of the scalar observations, given x."""
    total = jnp.zeros((), x.dtype)
    for row, value, variance, present in zip(*scalars, strict=True):
        residual = value - dot(row, x)
        terms = residual**2 / variance + jnp.log(2 * np.pi * variance)
        total -= jnp.where(present, terms, 0) / 2
    return total


def _independent(
    correlated: Scalars,
) -> tuple[Scalars, tuple[Float[Array, " m"], Float[Array, " m"]], Bool[Array, ""]]:
    """Return independent scalars by the elimination R = U D Uᵀ.

    The `variances` of `correlated` hold the matrix R.

    **Returns:** the scalars; bounds on the size of the terms in their rows and values, as scales of
    the rounding errors; and whether R is a covariance up to rounding.
    """
    m, eps = correlated.values.shape[0], 100 * jnp.finfo(correlated.values.dtype).eps
    rows, values = list(correlated.rows), list(correlated.values)
    sizes = [[safe_norm(row) for row in rows], [jnp.abs(value) for value in values]]
    R = correlated.variances
    remainder = [[R[i, j] for j in range(m)] for i in range(m)]
    variances, possible = [], jnp.ones((), bool)
    for k in range(m):
        # A pivot within rounding errors of zero belongs to an exact component.
        pivot = jnp.where(jnp.abs(remainder[k][k]) <= eps * jnp.abs(R[k, k]), 0, remainder[k][k])
        is_positive = pivot > 0
        possible &= pivot >= 0
        variances.append(jnp.where(correlated.seen[k], jnp.maximum(pivot, 0), 1))
        for i in range(k + 1, m):
            least = eps * jnp.sqrt(jnp.abs(R[k, k] * R[i, i]))
            # A component without variance must have zero covariances.
            possible &= is_positive | (jnp.abs(remainder[i][k]) <= least)
            factor = jnp.where(is_positive, remainder[i][k] / jnp.where(is_positive, pivot, 1), 0)
            for changed, size in zip((rows, values), sizes, strict=True):
                size[i] = size[i] + jnp.abs(factor) * size[k]
                changed[i] = changed[i] - factor * changed[k]
            for j in range(k + 1, m):
                remainder[i][j] = remainder[i][j] - factor * remainder[k][j]
    of_rows, of_values = (jnp.stack(size) for size in sizes)
    independent = Scalars(jnp.stack(rows), jnp.stack(values), jnp.stack(variances), correlated.seen)
    return independent, (of_rows, of_values), possible


def _follows(
    scalars: Scalars, sizes: tuple[Float[Array, " m"], Float[Array, " m"]]
) -> tuple[Bool[Array, " m"], Bool[Array, " m"]]:
    """Return the masks of exact scalars that earlier ones determine, and of scalars that agree.

    A scalar that earlier ones do not determine always agrees. This is the Gram–Schmidt process.
    Differences within the rounding errors of `sizes` count as zero.
    """
    eps = 100 * jnp.finfo(scalars.values.dtype).eps
    directions, follows, agrees = [], [], []
    for row, value, variance, present, row_size, size in zip(*scalars, *sizes, strict=True):
        for direction, along in directions:
            share = dot(row, direction)
            row, value = row - share * direction, value - share * along
            size = size + jnp.abs(share * along)
        length, exact = safe_norm(row), present & (variance == 0)
        new = length > eps * row_size
        follows.append(exact & ~new)
        agrees.append(~follows[-1] | (jnp.abs(value) <= eps * size))
        # Only exact scalars that do not follow from others give new directions.
        scale = jnp.where(exact & new, 1 / jnp.where(new, length, 1), 0)
        directions.append((row * scale, value * scale))
    return jnp.stack(follows), jnp.stack(agrees)


def check_observation(observation) -> None:
    """Raise `TypeError` for anything but an observation model."""
    if not isinstance(observation, LinearGaussian | ObservationDensity):
        raise TypeError(
            "`observation` must be a `LinearGaussian` or an `ObservationDensity`; got "
            f"{observation!r}."
        )


def _check_covariance(R: Array) -> None:
    """Raise `ValueError` for an invalid R, as far as its values are concrete."""
    if R.ndim > 2 or (R.ndim == 2 and R.shape[0] != R.shape[1]):
        raise ValueError(f"`covariance` must have shape (), (m,) or (m, m); got shape {R.shape}.")
    if is_traced(R):
        return
    matrix = np.asarray(R, float)
    if not np.all(np.isfinite(matrix)):
        raise ValueError(f"`covariance` must be finite; got {matrix}.")
    if matrix.ndim < 2:
        good = np.all(matrix >= 0)
    else:
        size = 100 * np.finfo(R.dtype).eps * np.abs(matrix).max()
        good = np.abs(matrix - matrix.T).max() <= size and np.linalg.eigvalsh(matrix).min() >= -size
    if not good:
        raise ValueError(
            "`covariance` must be symmetric, without negative variances (zero for exact "
            f"components); got {matrix}."
        )


def _check_positive(R: Array) -> None:
    """Raise `ValueError` if a variance of the guess is not positive."""
    if is_traced(R):
        return
    if np.any((np.diagonal(R) if R.ndim == 2 else np.asarray(R)) <= 0):
        raise ValueError(f"`guess` must have positive variances; got {R}.")
