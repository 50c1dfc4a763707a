"""Logs of means of weights, and of products of means, with their errors.

An estimate from independent runs, each with a mean of its own, has the error of their spread. For
few runs a standard error is widened, such that twice the error covers as for many.
"""

import math

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float

# Half the 97.7 % quantile of Student's law, by one over its degrees of freedom.
_STUDENT = (
    1 / np.array([np.inf, 40, 20, 10, 7, 5, 4, 3, 2, 1]),
    np.array([1.0, 1.032, 1.067, 1.142, 1.214, 1.324, 1.435, 1.653, 2.263, 6.984]),
)
# Above this bound e^{s²} overflows in single precision.
_LARGEST_VARIANCE = 80.0


def log_mean_and_error(
    log_weights: Float[Array, "I n"],
) -> tuple[Float[Array, " I"], Float[Array, " I"], Float[Array, " I"]]:
    """Return the log of the mean of n weights, its standard error, and the effective sample size.

    The standard error is by the delta method. It is infinite for one weight, or if all weights are
    zero.
    """
    n = log_weights.shape[1]
    # Weights relative to the largest one, so that sums of squares keep their digits.
    largest = lax.stop_gradient(jnp.max(log_weights, axis=1, keepdims=True))
    # If all weights are zero, -inf - (-inf) would be NaN.
    largest = jnp.where(largest > -jnp.inf, largest, 0)
    log_sum = logsumexp(log_weights - largest, axis=1)
    log_squares = logsumexp(2 * (log_weights - largest), axis=1)
    is_positive = log_sum > -jnp.inf
    inverse_size = jnp.where(is_positive, jnp.exp(log_squares - 2 * log_sum), jnp.inf)
    # The variance of the mean, relative to the square of the mean. The form Σw²/(Σw)² - 1/n would
    # cancel for nearly equal weights.
    log_mean = jnp.where(is_positive, log_sum - math.log(n), 0)
    deviation = jnp.expm1(log_weights - largest - log_mean[:, None])
    variance = jnp.sum(deviation**2, axis=1) / n / max(n - 1, 1)
    # One weight does not determine a variance.
    error = jnp.sqrt(variance) if n > 1 else jnp.full_like(variance, jnp.inf)
    size = jnp.where(is_positive, 1 / jnp.where(is_positive, inverse_size, 1), 0)
    return log_sum + largest[:, 0] - math.log(n), jnp.where(is_positive, error, jnp.inf), size


def log_mean_of_runs(
    log_estimates: Float[Array, "records R"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the log of the product over records of the mean of R runs, and its standard error.

    The estimates of the runs of a record are independent and have one mean, the exact value.
    """
    n = log_estimates.shape[1]
    log_mean, error, _ = log_mean_and_error(log_estimates)
    if n == 1:
        return jnp.sum(log_mean), jnp.sqrt(jnp.sum(error**2))
    finite = jnp.isfinite(log_estimates)
    number = jnp.maximum(jnp.sum(finite, axis=1, keepdims=True).astype(error.dtype), 2)
    # Runs with an estimate of zero do not count for the spread.
    centre = jnp.sum(jnp.where(finite, log_estimates, 0), axis=1, keepdims=True) / number
    squares = jnp.where(finite, log_estimates - centre, 0) ** 2
    spread = jnp.sum(squares / (number - 1), axis=1)
    variance = jnp.maximum(error**2, jnp.expm1(jnp.minimum(spread, _LARGEST_VARIANCE)) / n)
    # Welch–Satterthwaite degrees of freedom. Variances are relative to the largest, so that their
    # squares are finite.
    largest = jnp.max(variance)
    is_usable = (largest > 0) & (largest < jnp.inf)
    relative = jnp.where(is_usable, variance / jnp.where(is_usable, largest, 1), 1)
    inverse_degrees = jnp.sum(relative**2) / jnp.sum(relative) ** 2 / (n - 1)
    widening = jnp.interp(inverse_degrees, *(leaf.astype(error.dtype) for leaf in _STUDENT))
    return jnp.sum(log_mean), widening * jnp.sqrt(jnp.sum(variance))
