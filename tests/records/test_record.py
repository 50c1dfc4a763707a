"""What of a record is seen, and the grid between its times."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import count_compilations

import jaxbridge as jb
from jaxbridge.records.record import as_records

MODEL = jb.ornstein_uhlenbeck([[1.0, 0.5], [0.0, 1.0]])
TIMES, VALUES = np.arange(4.0), np.zeros((4, 2))
SEEN = jb.LinearGaussian(covariance=0.1)


@pytest.mark.slow
def test_masked_values_and_rows_without_any_are_not_seen():
    masked = np.ma.masked_array(VALUES, np.eye(4, 2, dtype=bool))
    made = jb.innovations(MODEL, TIMES, masked, observation=SEEN, initial=[0.0, 0.0], num_steps=2)
    nothing = np.where(np.eye(4, 2, dtype=bool), np.nan, VALUES)
    same = jb.innovations(MODEL, TIMES, nothing, observation=SEEN, initial=[0.0, 0.0], num_steps=2)
    xi = jnp.zeros(made.size)
    with count_compilations() as compiled:
        value = made.log_weight(MODEL.params, xi)
    assert np.isfinite(value) and len(compiled) <= 1  # outside of `jax.jit` as well
    assert same.log_weight(MODEL.params, xi) == value


def test_long_gaps_are_cut_into_segments():
    """With `step_size` no step is longer, the end of every gap is a point of the grid, and so is
    what is seen there."""
    times = np.array([0.0, 0.1, 2.1, 2.3])
    values = np.arange(8.0).reshape(4, 2)
    made = jb.innovations(MODEL, times, values, observation=SEEN, initial=[0.0, 0.0], step_size=0.1)
    steps = np.diff(made.times)
    assert steps.max() < 0.1 * (1 + 1e-4) and steps.min() > 0
    assert len(steps) < 60
    assert np.all(np.abs(times[:, None] - np.asarray(made.times)).min(1) < 1e-6)


def test_segments_begin_at_their_times():
    """To the last digit, also where the first times are small beside steps."""
    times = np.array([1e-3, 30.0, 100.0, 170.0], np.float32)
    (record,) = as_records([(times, np.zeros((4, 1)))], 7, None)
    np.testing.assert_array_equal(record.grid()[::7], times)
