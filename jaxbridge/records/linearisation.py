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

from ..engine.linalg import matmul, matvec
from ..models.dynamics import Dynamics, DynamicsAt
from ..schemes import AbstractStepDensity
from .observation import Scalars
from .record import Steps
from .segments import at_every_step, flat, split_first
from .tilted_step import NormalStep

# Shares of a step that would leave the state space, of which the first that does not counts.
_SHARES = 2.0 ** -np.arange(12)


class LinearisedStep(NamedTuple):
    """u' = A u + a + Λ ζ, from u = x - ξ to u' = x' - ξ'."""

    decay: Float[Array, "d d"]
    shift: Float[Array, " d"]
    root: Float[Array, "d m"]


def linear_step(
    density: AbstractStepDensity,
    dynamics: Dynamics,
    point: Float[Array, " d"],
    next_point: Float[Array, " d"],
    dt: Float[Array, ""],
) -> LinearisedStep:
    """The step from `point`, linearised there, relative to the two."""
    law = density.steps_from(dynamics, point).law(dt)
    F = jax.jacfwd(dynamics.drift)(point)
    decay = density.linear_step(F, jnp.zeros_like(F), dt).decay
    return LinearisedStep(decay, law.mean - next_point, law.root)


def filtered(
    mean: Float[Array, " d"], covariance: Float[Array, "d d"], scalars: Scalars
) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """N(mean, covariance) given what is seen: Kalman's update, number by number."""
    for row, value, variance, _ in zip(*scalars, strict=True):
        along = matvec(covariance, row)
        total = jnp.sum(row * along) + variance
        some = total > 0
        gain = jnp.where(some, along / jnp.where(some, total, 1), 0)
        mean = mean + gain * (value - jnp.sum(row * mean))
        covariance = covariance - gain[:, None] * along
    return mean, covariance


def extended_kalman_path(
    density: AbstractStepDensity,
    dynamics_at: DynamicsAt,
    initial: NormalStep,
    steps: Steps,
    scalars: Scalars,
    inside: Callable[[Float[Array, " d"]], Bool[Array, ""]] | None = None,
) -> Float[Array, "points d"]:
    """The means of the extended Kalman filter, where these are finite, else the last ones that
    are. A step that would leave the state space is shortened."""

    def checked(new, old):
        mean, covariance = _finite(new, old)
        return (mean if inside is None else stay_inside(inside, old[0], mean)), covariance

    def step(state, inputs):
        (mean, covariance), ((dt, time), seen) = state, inputs
        law = linear_step(density, dynamics_at(time), mean, jnp.zeros_like(mean), dt)
        spread = matmul(law.root, law.root.T)
        moved = matmul(matmul(law.decay, covariance), law.decay.T) + spread
        before = checked((law.shift, moved), state)
        return checked(filtered(*before, seen), before), mean

    mean, root = initial
    first, rest = split_first(scalars)
    before = mean, matmul(root, root.T)
    state = checked(filtered(*before, first), before)
    inputs = flat(steps), at_every_step(rest, steps.dt.shape[1])
    (last, _), means = lax.scan(step, state, inputs)
    return jnp.concatenate([means, last[None]])


def stay_inside(
    inside: Callable[[Float[Array, " d"]], Bool[Array, ""]],
    old: Float[Array, " d"],
    new: Float[Array, " d"],
) -> Float[Array, " d"]:
    """Return `new` if it is inside of the state space, else a point on the way to it from `old`,
    about half as far as the boundary: near a boundary noise may vanish, and with it the linear
    process."""
    shares = jnp.asarray(_SHARES, old.dtype)
    are_inside = jax.vmap(lambda share: inside(old + share * (new - old)))(shares)
    share = jnp.where(jnp.any(are_inside), shares[jnp.argmax(are_inside)] / 2, 0)
    return jnp.where(inside(new), new, old + share * (new - old))


def _finite(new, old):
    good = jnp.all(jnp.stack([jnp.all(jnp.abs(leaf) < 1e12) for leaf in new]))
    return jax.tree.map(lambda a, b: jnp.where(good, a, b), new, old)
