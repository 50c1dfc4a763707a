"""Linear process along a path ξ_0, ..., ξ_M, and the path of the extended Kalman filter.

A step from near ξ_i has the law N(ξ_i + A_i u + a_i, Λ_i Λ_iᵀ), where u = x - ξ_i and A is the
derivative of the mean. The first path is that of the extended Kalman filter. Each further path is
the path without noise that is guided along the previous one. This is the Gauss–Newton iteration for
the most likely path (Bell 1994; `guide_search`).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..engine.linalg import all_finite, matmul, matvec
from .motion import Motion
from .observations import Scalars
from .record import Steps
from .segments import at_every_step, flat, split_first
from .tilted_step import NormalStep

# Shares of a step that would leave the state space. The largest share that stays inside is used.
_SHARES = 2.0 ** -np.arange(12)

# Larger variances overflow soon. They may be large: states are in the user's units.
_LARGEST_VARIANCE = 1e30


class LinearisedStep(NamedTuple):
    """Linear step u' = A u + a + Λ ζ, from u = x - ξ to u' = x' - ξ'."""

    decay: Float[Array, "d d"]
    shift: Float[Array, " d"]
    root: Float[Array, "d m"]


def linear_step(
    motion: Motion,
    point: Float[Array, " d"],
    next_point: Float[Array, " d"],
    step: Steps,
) -> LinearisedStep:
    """Return the step linearised at `point`, from u = x - `point` to u' = x' - `next_point`."""
    law = motion.law(point, step)
    return LinearisedStep(motion.decay(point, step), law.mean - next_point, law.root)


def filtered(
    mean: Float[Array, " d"], covariance: Float[Array, "d d"], scalars: Scalars
) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """Return N(mean, covariance) given the scalar observations.

    This is the Kalman update, one scalar after the other.
    """
    for row, value, variance, _ in zip(*scalars, strict=True):
        along = matvec(covariance, row)
        total = jnp.sum(row * along) + variance
        is_positive = total > 0  # otherwise the scalar is known in advance
        gain = jnp.where(is_positive, along / jnp.where(is_positive, total, 1), 0)
        mean = mean + gain * (value - jnp.sum(row * mean))
        covariance = covariance - gain[:, None] * along
    return mean, covariance


def extended_kalman_path(
    motion: Motion,
    initial: NormalStep,
    steps: Steps,
    scalars: Scalars,
    inside: Callable[[Float[Array, " d"]], Bool[Array, ""]] | None = None,
) -> Float[Array, "points d"]:
    """Return the means of the extended Kalman filter.

    The last finite mean replaces one that is not finite. Steps that would leave the state space are
    shortened.
    """

    def checked(new, old):
        mean, covariance = _finite(new, old)
        return (mean if inside is None else stay_inside(inside, old[0], mean)), covariance

    def step(state, inputs):
        (mean, covariance), (of_step, step_scalars) = state, inputs
        law = linear_step(motion, mean, jnp.zeros_like(mean), of_step)
        spread = matmul(law.root, law.root.T)
        predicted = matmul(matmul(law.decay, covariance), law.decay.T) + spread
        before = checked((law.shift, predicted), state)
        return checked(filtered(*before, step_scalars), before), mean

    mean, root = initial
    first, later = split_first(scalars)
    before = mean, matmul(root, root.T)
    state = checked(filtered(*before, first), before)
    inputs = flat(steps), at_every_step(later, steps.dt.shape[1])
    (last, _), means = lax.scan(step, state, inputs)
    return jnp.concatenate([means, last[None]])


def stay_inside(
    inside: Callable[[Float[Array, " d"]], Bool[Array, ""]],
    old: Float[Array, " d"],
    new: Float[Array, " d"],
) -> Float[Array, " d"]:
    """Return `new` if it is inside the state space, otherwise a point between `old` and `new`.

    Its distance from `old` is a quarter to a half of that of the boundary: near a boundary the
    noise of the linear process may vanish.
    """
    shares = jnp.asarray(_SHARES, old.dtype)
    are_inside = jax.vmap(lambda share: inside(old + share * (new - old)))(shares)
    # Shares decrease, so the first one inside is the largest.
    share = jnp.where(jnp.any(are_inside), shares[jnp.argmax(are_inside)] / 2, 0)
    return jnp.where(inside(new), new, old + share * (new - old))


def _finite(new, old):
    """Return the mean and the covariance `new` if they are bounded, otherwise `old`."""
    mean, covariance = new
    good = all_finite(mean) & jnp.all(jnp.abs(covariance) < _LARGEST_VARIANCE)
    return jax.tree.map(lambda a, b: jnp.where(good, a, b), new, old)
