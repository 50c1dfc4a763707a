"""What half as many steps would have given, from the same paths.

Every other point of a path on the grid is a path on the grid of half as many steps. Their law has
steps of twice the length, of density q; with the points between from Brownian bridges of the σ at
hand, of density r, it is a law of whole paths. So with weights w for the law of N steps,

    E[w e^D h(path)] = the same for N/2 steps,
    D = Σ [log q_2δ(x, x'') + log r(x' | x, x'') - log q_δ(x, x') - log q_δ(x', x'')],

a sum over every other step, and nothing need be simulated anew. Where σ is constant D is small,
of variance O(δ²), and differences are known to a fraction of a standard error; otherwise it is of
O(1), like log weights themselves. An error of O(δ^p) is the (2^p - 1)-th part of the difference.

Of an odd number of steps the last is left as it is, and D counts for a little more; of one step
nothing is known.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .diffusion import Dynamics
from .lanes import over_lanes
from .linalg import dot
from .step_density import AbstractStepDensity, StepLaw


class Opened(NamedTuple):
    """The first of a pair of steps: where it began; the law of a step from there that lasts as
    long as both, without a σ that is constant; and the log density of the first step."""

    x: Float[Array, "d *lanes"]
    law: StepLaw
    log_density: Float[Array, "*lanes"]


class Pairing(NamedTuple):
    """The lengths of the steps before and after this one, and whether a pair ends with this."""

    before: Float[Array, "*steps lanes"]
    after: Float[Array, "*steps lanes"]
    ends: Bool[Array, "*steps lanes"]


def pair_up(dt: Float[Array, "N I"]) -> Pairing:
    """The pairs of N steps of these lengths, of which the first opens one."""
    odd = jnp.arange(dt.shape[0]) % 2 == 1
    ends = jnp.broadcast_to(odd[:, None], dt.shape)
    return Pairing(jnp.roll(dt, 1, axis=0), jnp.roll(dt, -1, axis=0), ends)


def log_of_step(dynamics: Dynamics, law: StepLaw, xi: Float[Array, " d"]) -> Float[Array, ""]:
    """log q of the step with noise ξ, but for constants, of which a σ that stays the same is
    one."""
    value = law.log_relative(xi)
    return value - law.sigma.log_abs_det() if dynamics.sigma_varies else value


def open_pair(
    dynamics: Dynamics, x: Float[Array, " d"], law: StepLaw, log_density: Float[Array, ""]
) -> Opened:
    """A pair of steps from x, given the law of a step that lasts as long as both."""
    return Opened(x, law if dynamics.sigma_varies else law._replace(sigma=None), log_density)


def close_pair(
    dynamics: Dynamics,
    opened: Opened,
    x: Float[Array, " d"],
    x_next: Float[Array, " d"],
    dt: tuple[Float[Array, ""], Float[Array, ""]],
    log_density: Float[Array, ""],
) -> Float[Array, ""]:
    """The pair's part of D: it led to x and x_next in steps of these lengths, the second of this
    log density."""
    law, (first, second) = opened.law, dt
    sigma = dynamics.sigma(opened.x) if law.sigma is None else law.sigma
    law = law._replace(sigma=sigma)
    value = log_of_step(dynamics, law, law.noise(x_next))
    between = sigma.solve((x - opened.x) * second - (x_next - x) * first)
    value -= dot(between, between) / (first * second * (first + second)) / 2
    if dynamics.sigma_varies:
        value -= sigma.log_abs_det()
    return value - opened.log_density - log_density


def of_all_steps(log_halving: Float[Array, "*rows"], num_steps: int) -> Float[Array, "*rows"]:
    """D as if all steps had been in pairs; NaN of a single step."""
    paired = num_steps - num_steps % 2
    return log_halving * (num_steps / paired) if paired else jnp.full_like(log_halving, jnp.nan)


def log_halving_of_paths(
    density: AbstractStepDensity,
    dynamics: Dynamics,
    dt: Float[Array, "N P"],
    paths: Float[Array, "P points d"],
) -> Float[Array, " P"]:
    """D of given paths, with the lengths of their steps in the columns of `dt`."""
    num_steps, num_pairs = dt.shape[0], dt.shape[0] // 2
    if num_pairs == 0:
        return jnp.full(paths.shape[0], jnp.nan, paths.dtype)
    points = lax.optimization_barrier(jnp.moveaxis(paths, (0, 1), (-1, -2)))

    def one(x, middle, x_next, first, second):
        def of_step(law, x_next):
            return log_of_step(dynamics, law, law.noise(x_next))

        steps, from_middle = (density.steps_from(dynamics, point) for point in (x, middle))
        opened = open_pair(dynamics, x, steps(first + second), of_step(steps(first), middle))
        last = of_step(from_middle(second), x_next)
        return close_pair(dynamics, opened, middle, x_next, (first, second), last)

    def every_other(leaf, shift):
        leaf = leaf[..., shift : shift + 2 * num_pairs : 2, :][..., :num_pairs, :]
        return leaf.reshape(*leaf.shape[:-2], -1)

    pairs = [every_other(points, shift) for shift in (0, 1)]
    pairs.append(every_other(points[:, 2:], 0))
    steps = [every_other(dt, shift) for shift in (0, 1)]
    parts = over_lanes(-1, -1, -1, -1, -1)(one)(*pairs, *steps)
    log_halving = jnp.sum(parts.reshape(num_pairs, -1), axis=0)
    return of_all_steps(log_halving, num_steps)


def halving_of_some(
    density: AbstractStepDensity,
    dynamics: Dynamics,
    dt: Float[Array, "N P"],
    paths: Float[Array, "P points d"],
    every: int,
) -> Float[Array, " P"]:
    """D of every so manieth path, NaN of the others."""
    some = log_halving_of_paths(density, dynamics, dt[:, ::every], paths[::every])
    return jnp.full(paths.shape[0], jnp.nan, paths.dtype).at[::every].set(some)
