"""The normal distribution, which serves as start law, stationary law and transition law."""

import functools
import math
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ..engine.checks import Numbers, as_floating, check_precision, check_range, is_traced
from ..engine.linalg import any_cholesky, any_inverse, dot, matvec
from .diffusion import Diffusion


class GaussianLaw(eqx.Module):
    """Normal distribution N(mean, covariance).

    **Arguments:** `mean`, shape (d,); `covariance`, shape (d, d), symmetric and positive
    semidefinite. A singular covariance is for `initial` of records only: its `log_density` is NaN,
    and `sample` is NaN in some coordinates.

    **Raises:** `ValueError` for shapes that do not fit, for a mean that is not finite, and for a
    covariance that is not symmetric or has a negative eigenvalue, beyond rounding errors.
    `TypeError` for less than single precision. Traced values are not checked.

    **Example:**

    ```python
    law = jb.GaussianLaw([0.0, 0.0], jnp.eye(2))
    coupling = jb.Coupling(0.5, start_law=law)
    ```
    """

    mean: Float[Array, " d"]
    covariance: Float[Array, "d d"]

    def __init__(self, mean: Numbers, covariance: Numbers):
        mean, covariance = as_floating("mean", mean), as_floating("covariance", covariance)
        dtype = max(mean.dtype, covariance.dtype, key=lambda dtype: dtype.itemsize)
        self.mean, self.covariance = mean.astype(dtype), covariance.astype(dtype)
        if mean.ndim != 1 or covariance.shape != 2 * mean.shape:
            raise ValueError(
                "`mean` must have shape (d,) and `covariance` (d, d); got "
                f"{mean.shape} and {covariance.shape}."
            )
        check_precision("`mean` and `covariance`", dtype)
        check_range("mean", mean)
        if is_traced(covariance):
            return
        matrix = np.asarray(covariance, float)
        # A hundred times the rounding error of the largest entry.
        tolerance = 100 * np.finfo(dtype).eps * np.abs(matrix).max()
        symmetric = np.abs(matrix - matrix.T).max() <= tolerance  # false for NaN
        if not (symmetric and np.linalg.eigvalsh(matrix).min() >= -tolerance):
            raise ValueError(
                f"`covariance` must be symmetric and positive semidefinite; got {covariance}."
            )

    def __iter__(self) -> Iterator[Array]:
        """Yield the mean and the covariance, for `mean, covariance = law`."""
        yield from (self.mean, self.covariance)

    def sample(self, key: Key[Array, ""], model: Diffusion | None = None) -> Float[Array, " d"]:
        """Sample one point, shape (d,). All start laws receive a `model`; this one ignores it."""
        return _draw(self.mean, self.covariance, key)

    def log_density(self, x: Numbers) -> Float[Array, ""]:
        """Return the normalised log density at a point, shape (d,).

        **Raises:** `ValueError` for a point of another shape.
        """
        x = as_floating("x", x)
        if x.shape != self.mean.shape:
            raise ValueError(f"`x` must have shape {self.mean.shape}; got {x.shape}.")
        check_precision("`x`", x.dtype)
        return _log_density(self.mean, self.covariance, x)


@functools.partial(jax.jit, inline=True)
def _draw(mean, covariance, key):
    noise = jax.random.normal(key, mean.shape, mean.dtype)
    return mean + matvec(any_cholesky(covariance), noise)


@functools.partial(jax.jit, inline=True)
def _log_density(mean, covariance, x):
    # Through the Cholesky factor, so that no determinant overflows.
    root = any_cholesky(covariance)
    standardised = matvec(any_inverse(root), (x - mean).astype(root.dtype))
    return -dot(standardised, standardised) / 2 - jnp.sum(
        jnp.log(math.sqrt(2 * math.pi) * jnp.diag(root))
    )
