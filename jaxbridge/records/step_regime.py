"""Check whether the steps of a record are too long for an estimate of the discretisation error."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..engine.compiled import compiled_sooner
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from ..models.sigma import covariance_of
from ..schemes import MOST_TOO_LONG, UNKNOWN_SHARE, share_in_regime
from .problem import RecordProblem

# Distance in units of δ of two points from the middle of a step. For a smooth coefficient a the
# mean of both differs from the middle as the mean over the step does, by a″δ²/24. If its period is
# δ or a fraction of it, they have another phase than all middles.
_OFFSET = 0.29
# Largest sums of these differences over a segment: of the drift in standard deviations of the
# noise, and of V relative to its own sum.
_MOST_MEAN, _MOST_VARIANCE = 0.1, 0.2


@compiled_sooner
def steps_are_too_long(
    problem: RecordProblem, model: Diffusion, path: Float[Array, "points d"]
) -> Bool[Array, ""]:
    """Return whether steps are too long on over 2 % of the segments.

    They exceed the relaxation time of the drift at either end of a segment on this path, or
    time-dependent coefficients change too much within them. Steps without discretisation error are
    never too long.
    """
    if problem.density.is_exact:
        return jnp.zeros((), bool)
    moving = problem.record.durations > 0  # segments of length zero lie beyond the record
    # Grids of N and of N/2 steps may both miss a change in time, so that they agree.
    if model.depends_on_time:
        too_long = _change_within_steps(problem, model, path)
    else:
        too_long = _exceed_relaxation(problem, model, path)
    number = jnp.maximum(jnp.sum(moving), 1).astype(path.dtype)
    return jnp.sum(moving & too_long).astype(path.dtype) > MOST_TOO_LONG * number


def _exceed_relaxation(
    problem: RecordProblem, model: Diffusion, path: Float[Array, "points d"]
) -> Bool[Array, " K"]:
    """Return the segments in which steps exceed the relaxation time of the drift at an end."""
    ends, durations = path[:: problem.num_steps], problem.record.durations
    begins = problem.after_jumps(model, ends[:-1])
    intervals, record = Intervals(begins, ends[1:], durations), problem.record
    num_longest = record.num_equal_steps / max(record.lengths)
    share = share_in_regime(jnp.ones_like(durations), model, intervals, num_longest)
    return share == UNKNOWN_SHARE


def _change_within_steps(
    problem: RecordProblem, model: Diffusion, path: Float[Array, "points d"]
) -> Bool[Array, " K"]:
    """Return the segments in which coefficients that depend on time change within steps."""
    dt, middles = problem.record.dt, problem.record.middles()
    dynamics_at = model.forward_at(problem.like)

    def mean_and_variance(time, x):
        dynamics = dynamics_at(time)
        return dynamics.drift(x), jnp.diagonal(covariance_of(dynamics.sigma(x), x))

    def over_segment(times):
        """Return the change of the mean and the variance over each segment, from these times."""
        points = path[:-1].reshape(*dt.shape, -1)
        rates = jax.vmap(jax.vmap(mean_and_variance))(times, points)
        return [jnp.sum(dt[..., None] * rate, axis=1) for rate in rates]

    mean, variance = over_segment(middles)
    around = [over_segment(middles + sign * _OFFSET * dt) for sign in (-1, 1)]
    mean_around, variance_around = ((a + b) / 2 for a, b in zip(*around, strict=True))
    largest = jnp.maximum(variance, variance_around)
    safe = jnp.where(largest > 0, largest, 1)
    changed = (jnp.abs(mean_around - mean) > _MOST_MEAN * jnp.sqrt(safe)) & (largest > 0)
    varies = jnp.abs(variance_around - variance) > _MOST_VARIANCE * safe
    return jnp.any(changed | varies, axis=-1)
