"""What of a record is seen, and the grid between its times."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from helpers import count_compilations, slow_beyond

import jaxbridge as jb
from jaxbridge.records.record import as_records, as_rows, split_records

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


def grid_of_record(times, values):
    (record,) = as_records([(times, values)], None, 0.1)
    return record.clock(record.grid())


def grid_of_paths(times, values):
    options = dict(observation=SEEN, initial=[0.0, 0.0], step_size=0.1)
    return jb.innovations(MODEL, times, values, **options).times


@pytest.mark.parametrize("grid_of", slow_beyond(1, [grid_of_record, grid_of_paths]))
def test_long_gaps_are_cut_into_segments(grid_of):
    """With `step_size` no step is longer, the end of every gap is a point of the grid, and so is
    what is seen there."""
    times = np.array([0.0, 0.1, 2.1, 2.3])
    grid = np.asarray(grid_of(times, np.arange(8.0).reshape(4, 2)))
    steps = np.diff(grid)
    assert steps.max() < 0.1 * (1 + 1e-4) and steps.min() > 0
    assert len(steps) < 60
    assert np.all(np.abs(times[:, None] - grid).min(1) < 1e-6)


def test_segments_begin_at_their_times():
    """To the last digit, also where the first times are small beside steps."""
    times = np.array([1e-3, 30.0, 100.0, 170.0], np.float32)
    (record,) = as_records([(times, np.zeros((4, 1)))], 7, None)
    np.testing.assert_array_equal(record.clock(record.grid()[::7]), times)


ONE = jb.ornstein_uhlenbeck([[1.0]])
SEASONAL = jb.seasonal_ornstein_uhlenbeck(1.5, period=0.5)
READINGS = np.array([[0.3], [np.nan], [-0.2], [0.5]])


def log_weight(times, values=READINGS, model=ONE, **options):
    options = {"observation": SEEN, "initial": jb.GaussianLaw([0.0], [[1.0]]), **options}
    made = jb.innovations(model, times, values, num_steps=4, **options)
    return float(made.log_weight(model.params, jnp.zeros(made.size)))


@pytest.mark.slow
def test_a_record_does_not_depend_on_the_zero_of_time():
    """Whole periods change nothing, or are refused: where the model depends on time, or how it is
    seen does."""
    assert log_weight(TIMES) == log_weight(2_460_000 + TIMES)
    near, far = log_weight(TIMES, model=SEASONAL), log_weight(500 + TIMES, model=SEASONAL)
    assert abs(near - far) < 1e-3
    assert abs(near - log_weight(0.2 + TIMES, model=SEASONAL)) > 0.1  # the time counts
    noise = jb.LinearGaussian(covariance=lambda p, t: 0.2 + 0.1 * jnp.sin(t))
    for options in ({"model": SEASONAL}, {"observation": noise}):
        with pytest.raises(ValueError, match="too far from zero for coefficients"):
            log_weight(2_460_000 + TIMES, **options)


@pytest.mark.slow
def test_in_double_precision_seasons_are_kept_far_from_the_zero_of_time(x64):
    double = jb.seasonal_ornstein_uhlenbeck(1.5, period=0.5)
    near, far = (log_weight(shift + TIMES, model=double) for shift in (0, 2_460_000))
    assert abs(near - far) < 1e-6


@pytest.mark.slow
def test_times_of_paths_are_the_callers():
    """Also where single precision would round them, and where they are integers of 64 bits."""
    days = 2_460_000 + TIMES
    made = jb.innovations(ONE, days, READINGS, observation=SEEN, num_steps=4)
    np.testing.assert_array_equal(made.times, 2_460_000 + np.arange(13) / 4)
    milliseconds = 1_700_000_000_000 + 1000 * np.arange(4)
    slow = jb.ornstein_uhlenbeck([[1e-3]])
    made = jb.innovations(slow, milliseconds, READINGS, observation=SEEN, num_steps=4)
    np.testing.assert_array_equal(made.times[::4], milliseconds)


@pytest.mark.slow
def test_one_series_of_numbers_is_one_column():
    expected = log_weight(TIMES)
    missing = [0.3, None, -0.2, 0.5]
    given = [READINGS[:, 0], missing, [[value] for value in missing]]
    given += [pd.Series(missing, dtype="Float64"), pd.DataFrame({"y": [0.3, pd.NA, -0.2, 0.5]})]
    for values in given:
        assert log_weight(TIMES, values) == expected
    assert log_weight(pd.Series(range(4), dtype="Int64")) == expected


def test_several_series_of_numbers_are_several_records():
    given = [TIMES, 2 * TIMES[:3]], [READINGS[:, 0], READINGS[:3, 0]]
    columns = given[0], [values[:, None] for values in given[1]]
    for times, values in (given, columns):
        seen = split_records(times, values)
        assert [np.shape(as_rows(each)) for _, each in seen] == [(4, 1), (3, 1)]
    both = [record.values for record in as_records(split_records(*given), 2, None)]
    np.testing.assert_array_equal(both[1][:, 0], READINGS[:3, 0].astype(np.float32))


@pytest.mark.slow
def test_a_record_may_begin_before_its_first_time():
    later = np.concatenate([[[np.nan]], READINGS])
    expected = log_weight(1e6 + np.array([-0.5, *TIMES]), later)
    assert log_weight(1e6 + TIMES, initial_time=1e6 - 0.5) == expected != log_weight(TIMES)


def test_only_readings_have_entries():
    """Neither an earlier time of the initial law has one, nor has a jump."""
    jumps = jb.Jumps([0.5, 2.25], np.zeros((2, 2)))
    for entry, begins in ((None, 0.0), (None, -1.0), (jumps, -1.0)):
        (record,) = as_records([(TIMES, VALUES)], 2, None, begins, entry and [entry])
        np.testing.assert_allclose(record.since[record.which], TIMES - begins)
        np.testing.assert_array_equal(record.values[record.which], VALUES)
        assert np.sum(np.isfinite(record.values)) == VALUES.size


def test_all_that_take_a_record_refuse_times_that_cannot_be_resolved():
    """Where the season counts, and where it would have to be `initial_time` that is resolved."""
    key, prior = jax.random.key(0), jb.NormalPrior(1.0, 1.0)
    options = {"observation": SEEN, "initial": [0.0], "initial_time": 2_459_999.5}
    inference = {"prior": prior, "where": lambda p: p.rate}
    for function, more in (
        (jb.log_likelihood, {}),
        (jb.smooth, {}),
        (jb.gibbs, inference),
        (jb.pmmh, inference),
        (jb.maximum_likelihood, {"where": lambda p: p.rate}),
    ):
        with pytest.raises(ValueError, match="too far from zero for coefficients"):
            function(key, SEASONAL, 2_460_000 + TIMES, READINGS, **options, **more)


@pytest.mark.slow
def test_a_likelihood_does_not_depend_on_the_zero_of_time(x64):
    """Nor on that of the initial law, by what all samplers of records use."""
    model = jb.seasonal_ornstein_uhlenbeck(1.5, period=0.5)
    at = lambda shift: log_weight(
        shift + TIMES, model=model, initial=[0.0], initial_time=shift - 0.5
    )
    np.testing.assert_allclose(at(0), at(1e7), atol=1e-6)
