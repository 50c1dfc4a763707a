"""What half as many steps would have given, from the same paths.

Every other point of a path on the grid is a path on the grid of half as many steps, whose law has
steps of twice the length, of density q_2δ. With points between of some density r(x'| x, x'') that
is a law of whole paths, and so, with weights w for the law of N steps,

    E[w e^D h(path)] = the same for N/2 steps,
    D = Σ log [q_2δ(x, x'') r(x'| x, x'')] - log [q_δ(x, x') q_δ(x', x'')],

a sum over every other step, and nothing need be simulated anew. The nearer r is to what it is for
N steps, the less random is D. It is here what it would be if the drift were linear, as it is seen
from x, and σ were as it is there: then the second step has a density n(x''| x, x'), normal with a
mean linear in x', both steps together a normal density n_2(x''| x), and r = q_δ n / n_2, so that

    D = Σ log [q_2δ(x, x'') / n_2(x''| x)] + log [n(x''| x, x') / q_δ(x', x'')].

Where σ is constant its variance is O(δ²): differences are known to a fraction of a standard error.
Otherwise it is of O(1), like log weights themselves. An error of O(δ^p) is the (2^p - 1)-th part of
the difference (`step_error`).

Of an odd number of steps the last is left as it is, and D counts for a little more; of one step
nothing is known.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .diffusion import Dynamics
from .lanes import over_lanes
from .linalg import cholesky, matmul, matvec
from .sigma import AbstractSigma
from .step_density import AbstractStepDensity, StepLaw, StepsFrom

# D is worked out for one in so many paths, but for so many at least.
_LOOKED_SHARE, _LOOKED_SHARE_WHERE_SIGMA_VARIES, _FEWEST_LOOKED = 16, 2, 64


class Opened(NamedTuple):
    """A pair of steps seen from where it began, x, without a σ that is constant.

    - `twice`: mean and root of one step that lasts as long as both, q_2δ.
    - `both`: those of the two together if the drift were linear, n_2.
    - `second`: those of the second step if it began in x.
    - `decay`: what that gains for each unit by which σ⁻¹x' is further on.
    """

    x: Float[Array, "d *lanes"]
    sigma: AbstractSigma | None
    twice: tuple[Float[Array, "d *lanes"], Float[Array, "..."]]
    both: tuple[Float[Array, "d *lanes"], Float[Array, "..."]]
    second: tuple[Float[Array, "d *lanes"], Float[Array, "..."]]
    decay: Float[Array, "d d *lanes"]


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


def open_pair(
    dynamics: Dynamics,
    x: Float[Array, " d"],
    steps: StepsFrom,
    first: Float[Array, ""],
    second: Float[Array, ""],
) -> Opened:
    """A pair of steps of these lengths from x."""
    laws = steps.law(first), steps.law(second)
    sigma, decay = laws[0].sigma, steps.decay(second)
    S, S_second = (_square(law.root, x) for law in laws)
    moved = sigma.mv(matvec(decay, sigma.solve(laws[0].mean - x)))
    both = first * matmul(matmul(decay, S), decay.T) + second * S_second
    return Opened(
        x,
        sigma if dynamics.sigma_varies else None,
        _mean_and_root(steps.law(first + second)),
        (laws[1].mean + moved, cholesky(both / (first + second))),
        _mean_and_root(laws[1]),
        decay,
    )


def close_pair(
    dynamics: Dynamics,
    opened: Opened,
    x: Float[Array, " d"],
    x_next: Float[Array, " d"],
    dt: tuple[Float[Array, ""], Float[Array, ""]],
    law: StepLaw,
) -> Float[Array, ""]:
    """The pair's part of D: it led to x, and from there, by this law, to x_next, in steps of these
    lengths."""
    first, second = dt
    sigma = dynamics.sigma(opened.x) if opened.sigma is None else opened.sigma
    twice, both = (
        StepLaw(mean, sigma, root, first + second) for mean, root in (opened.twice, opened.both)
    )
    mean, root = opened.second
    moved = sigma.mv(matvec(opened.decay, sigma.solve(x - opened.x)))
    linear = StepLaw(mean + moved, sigma, root, second)
    value = _log_relative(twice, x_next) - _log_relative(both, x_next)
    value += _log_relative(linear, x_next) - _log_relative(law, x_next)
    if dynamics.sigma_varies:
        value += law.sigma.log_abs_det() - sigma.log_abs_det()
    return value


def _log_relative(law: StepLaw, point: Float[Array, " d"]) -> Float[Array, ""]:
    return law.log_relative(law.noise(point))


def _mean_and_root(law: StepLaw) -> tuple[Float[Array, " d"], Float[Array, "..."]]:
    return law.mean, law.root


def _square(root: Float[Array, "..."], x: Float[Array, " d"]) -> Float[Array, "d d"]:
    """L Lᵀ."""
    if root.ndim == 0:
        return root**2 * jnp.eye(x.shape[0], dtype=x.dtype)
    return matmul(root, root.T)


def of_all_steps(log_halving: Float[Array, "*rows"], num_steps: int) -> Float[Array, "*rows"]:
    """D as if all steps had been in pairs; NaN of a single step. What overflowed was of steps out
    of all proportion, and the other density is taken to be zero."""
    paired = num_steps - num_steps % 2
    if not paired:
        return jnp.full_like(log_halving, jnp.nan)
    return jnp.where(jnp.isfinite(log_halving), log_halving * (num_steps / paired), -jnp.inf)


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
        steps, from_middle = (density.steps_from(dynamics, point) for point in (x, middle))
        opened = open_pair(dynamics, x, steps, first, second)
        law = from_middle.law(second)
        return close_pair(dynamics, opened, middle, x_next, (first, second), law)

    def every_other(leaf, shift):
        leaf = leaf[..., shift : shift + 2 * num_pairs : 2, :][..., :num_pairs, :]
        return leaf.reshape(*leaf.shape[:-2], -1)

    pairs = [every_other(points, shift) for shift in (0, 1)]
    pairs.append(every_other(points[:, 2:], 0))
    steps = [every_other(dt, shift) for shift in (0, 1)]
    parts = over_lanes(-1, -1, -1, -1, -1)(one)(*pairs, *steps)
    log_halving = jnp.sum(parts.reshape(num_pairs, -1), axis=0)
    return of_all_steps(log_halving, num_steps)


def num_looked(num_draws: int, sigma_varies: bool) -> int:
    """Of how many paths of an interval D is worked out: of few where it is hardly random."""
    share = _LOOKED_SHARE_WHERE_SIGMA_VARIES if sigma_varies else _LOOKED_SHARE
    return min(num_draws, max(_FEWEST_LOOKED, num_draws // share))
