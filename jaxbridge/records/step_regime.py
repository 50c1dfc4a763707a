"""Check whether the steps of a record are too long for an estimate of the discretisation error."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..engine.compiled import compiled_sooner
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from ..schemes import MOST_TOO_LONG, UNKNOWN_SHARE, share_in_regime
from .problem import RecordProblem


@compiled_sooner
def steps_are_too_long(
    problem: RecordProblem, model: Diffusion, path: Float[Array, "points d"]
) -> Bool[Array, ""]:
    """Return whether steps exceed the relaxation time of the drift on over 2 % of the segments.

    The relaxation times are those at both ends of a segment on this path; one of the two suffices.
    Time-dependent drifts are not examined. Steps without discretisation error are never too long.
    """
    if model.depends_on_time or problem.density.is_exact:
        return jnp.zeros((), bool)
    ends, durations = path[:: problem.num_steps], problem.record.durations
    begins = problem.after_jumps(model, ends[:-1])
    intervals, record = Intervals(begins, ends[1:], durations), problem.record
    num_longest = record.num_equal_steps / max(record.lengths)
    share = share_in_regime(jnp.ones_like(durations), model, intervals, num_longest)
    moving = durations > 0  # segments of length zero lie beyond the record
    number = jnp.maximum(jnp.sum(moving), 1).astype(durations.dtype)
    too_long = jnp.sum(moving & (share == UNKNOWN_SHARE)).astype(durations.dtype)
    return too_long > MOST_TOO_LONG * number
