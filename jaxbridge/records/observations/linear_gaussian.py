"""Linear observations with normal noise, exact or missing components included.

An observation y = L x + b + N(0, R) becomes a series of independent scalars. The factorisation
R = U D Uᵀ of the observed components, with U unit triangular, gives scalars c·x + N(0, ρ), with
ρ = 0 for exact ones. They are used one after the other. Hence R need not be invertible, and missing
components are left out. A scalar that follows from exact ones is left out, too, if it agrees with
them. If it does not agree, or if R has a negative variance, the likelihood is zero.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from ...engine.checks import Numbers, as_floating, is_traced
from ...engine.linalg import dot, matvec, safe_norm, semidefinite_cholesky
from .base import AbstractObservation, Quantity, Scalars, as_matrix, check_matrix, matrix_for


class LinearGaussian(AbstractObservation):
    """Observation model with linear observations and normal noise: y = L x + b + N(0, R).

    NaN marks missing components of an observation. R may be singular, and zero for exact
    components.

    **Arguments:**

    - `matrix`: L, shape (m, d); by default `None`, which means that the whole state is observed.
    - `covariance`: R in squared units of y, with shape (m, m), (m,) for a diagonal matrix, or ()
        for a multiple of I. The default 0 means exact observations. For unknown or time-dependent
        noise pass a function `params -> R` of the model's parameters, or `(params, t) -> R`.
    - `offset`: b in units of y, shape (m,) or (), or a function of the same arguments.

    **Raises:** `ValueError` and `TypeError` for an invalid matrix or covariance.

    **Example:**

    ```python
    observation = jb.LinearGaussian(matrix=[[1.0, 0.0]], covariance=0.01)
    ```
    """

    matrix: Float[Array, "m d"] | None
    _covariance: Quantity
    _offset: Quantity

    def __init__(
        self,
        matrix: Numbers | None = None,
        covariance: Numbers | Callable[..., Array] = 0.0,
        *,
        offset: Numbers | Callable[..., Array] = 0.0,
    ):
        self.matrix = as_matrix(matrix)
        self._covariance, self._offset = (
            Quantity("covariance", covariance),
            Quantity("offset", offset),
        )
        if self.covariance is not None:
            _check_covariance(self.covariance)

    @property
    def covariance(self) -> Float[Array, "..."] | None:
        """Return R as it was given; `None` if it is a function."""
        return self._covariance.value

    @property
    def depends_on_time(self):
        return self._covariance.depends_on_time or self._offset.depends_on_time

    def covariance_for(self, params: PyTree, m: int, time: Float[Array, ""]) -> Float[Array, "m m"]:
        """Return the covariance R of the noise at these parameters and this time, shape (m, m).

        **Raises:** `ValueError` for a covariance of another shape.
        """
        value = self._covariance.at(params, time)
        if value.shape not in ((), (m,), (m, m)):
            raise ValueError(
                f"`covariance` must have shape (), ({m},) or ({m}, {m}) for observations of {m} "
                f"components; got shape {value.shape}."
            )
        return value if value.ndim == 2 else value * np.eye(m, dtype=time.dtype)

    def offset_for(self, params: PyTree, m: int, time: Float[Array, ""]) -> Float[Array, " m"]:
        """Return b at these parameters and this time."""
        return self._offset.for_components(params, time, m)

    def check(self, values, like, time, params):
        m, (d,) = values.shape[1], like.shape
        check_matrix(self.matrix, m, like)
        self.offset_for(params, m, time)
        matrix, R = matrix_for(self.matrix, d, like.dtype), self.covariance_for(params, m, time)
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

    def scalars(self, row, params, d):
        y, time = row
        m, present = y.shape[0], jnp.isfinite(y)
        y = y - self.offset_for(params, m, time)
        rows = jnp.where(present[:, None], matrix_for(self.matrix, d, y.dtype), 0)
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

    def sample(self, key, x, params=None, time=0.0):
        x = as_floating("x", x)
        rows = matrix_for(self.matrix, len(x), x.dtype)
        m, time = len(rows), jnp.asarray(time, x.dtype)
        root = semidefinite_cholesky(self.covariance_for(params, m, time))
        noise = matvec(root, jax.random.normal(key, (m,), x.dtype))
        return matvec(rows, x) + self.offset_for(params, m, time) + noise

    def check_sample(self):
        pass

    def correction(self, row, x, params):
        return jnp.zeros((), x.dtype)


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
            "`covariance` must not be negative; a matrix must be symmetric and positive "
            f"semidefinite (zero variances for exact components); got {matrix}."
        )
