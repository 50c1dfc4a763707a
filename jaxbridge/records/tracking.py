"""Path of the diffusion that stays near the observations, as a start of the search for a guide.

The extended Kalman filter may diverge, for instance if the first state is uncertain, between two
wells or on an unstable branch, or if there are spikes. Then the path of its means is far from every
path that explains the observations. Here particles follow several ways, and resampling selects
those near the observations. The weights are tempered at each observation, so that several particles
remain effective although they are further away than the noise suggests.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Key

from ..engine.averages import nan_to_neg_inf, normalise_weights
from ..engine.lanes import over_lanes
from ..engine.linalg import dot, matvec
from ..engine.resampling import systematic
from ..models.diffusion import Diffusion
from .initial import initial_law, log_ratio
from .observations import Scalars
from .problem import RecordProblem
from .segments import split_first

# Number of particles, and the number of them within a standard deviation of an observation. The
# weights use a noise that is large enough for that.
_NUM_PARTICLES, _NUM_NEAR = 64, 8


def tracking_path(
    key: Key[Array, ""], problem: RecordProblem, model: Diffusion
) -> Float[Array, "points d"]:
    """Return the path of one particle that stays near all observations.

    The particle belongs to a filter with tempered weights. The path may contain NaN if all
    particles are lost.
    """
    P, N, (d,), dtype = _NUM_PARTICLES, problem.num_steps, problem.like.shape, problem.like.dtype
    motion, inside = problem.motion(model), model.state_space()
    first, later_scalars = split_first(problem.scalars(model))
    initial = initial_law(problem.initial, model, problem.like)

    def log_weights(x, scalars: Scalars):
        log_weight = _tempered(over_lanes(-1)(lambda x: _misfit(scalars, x))(x))
        finite = jnp.all(jnp.isfinite(x), axis=0)
        if inside is not None:
            finite &= over_lanes(-1)(inside)(x)
        return jnp.where(finite, log_weight, -jnp.inf)

    def one(x, inputs):
        zeta, step = inputs

        def of_particle(x, zeta):
            law = motion.law(x, step)
            return law.mean + matvec(law.root, zeta)

        x = over_lanes(-1, -1)(of_particle)(x, zeta)
        return x, x

    def segment(x, inputs):
        number, steps, scalars = inputs
        noise_key, uniform_key = jax.random.split(jax.random.fold_in(key, number))
        zeta = jax.random.normal(noise_key, (N, d, P), dtype)
        x, path = lax.scan(one, x, (zeta, steps))
        parents = _parents(uniform_key, log_weights(x, scalars))
        return x[:, parents], (path, parents)

    start_key, uniform_key = jax.random.split(jax.random.fold_in(key, 0))
    zeta = jax.random.normal(start_key, (d, P), dtype)
    starts = over_lanes(-1)(lambda zeta: initial.mean + matvec(initial.root, zeta))(zeta)
    ratio = over_lanes(-1)(lambda x: log_ratio(problem.initial, model, initial, x))(starts)
    parents = _parents(uniform_key, log_weights(starts, first) + nan_to_neg_inf(ratio))
    inputs = 1 + jnp.arange(problem.num_segments), problem.steps(model), later_scalars
    _, (paths, later) = lax.scan(segment, starts[:, parents], inputs)

    def back(lane, inputs):
        path, parents = inputs
        lane = parents[lane]
        return lane, path[..., lane]

    # After resampling all weights are equal, so the ancestors of lane 0 are as good as any.
    lane, path = lax.scan(back, jnp.int32(0), (paths, later), reverse=True)
    begin = starts[:, parents[lane]]
    return jnp.concatenate([begin[None], path.reshape(-1, d)])


def _misfit(scalars: Scalars, x: Float[Array, " d"]) -> Float[Array, ""]:
    """Return the sum of squared residuals, in variances of the noise.

    The variance of an exact observation is that of its rounding error.
    """
    total, eps = jnp.zeros((), x.dtype), jnp.finfo(x.dtype).eps
    for row, value, variance, present in zip(*scalars, strict=True):
        size = jnp.abs(value) + 1
        square = (value - dot(row, x)) ** 2 / jnp.maximum(variance, eps * size**2)
        total += jnp.where(present, square, 0)
    return total


def _tempered(misfits: Float[Array, " lanes"]) -> Float[Array, " lanes"]:
    """Return log weights with which several particles stay effective, however small the noise."""
    near = jnp.sort(jnp.where(jnp.isnan(misfits), jnp.inf, misfits))[_NUM_NEAR]
    return -misfits / (2 * jnp.maximum(near, 1))


def _parents(key: Key[Array, ""], log_weights: Float[Array, " lanes"]) -> Int[Array, " lanes"]:
    """Return the lanes of the parents, by systematic resampling."""
    weights = normalise_weights(nan_to_neg_inf(log_weights))
    return systematic(jax.random.uniform(key, (), weights.dtype), weights).astype(jnp.int32)
