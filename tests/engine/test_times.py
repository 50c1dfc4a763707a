"""What is given as numbers, and times in a clock of the caller's."""

import datetime

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from jaxbridge.engine.checks import as_floating
from jaxbridge.engine.times import as_times


def test_integers_do_not_wrap():
    for value in (2**32, [2**32], np.array([2**32]), [2**64, 1], np.uint64(2**63), -(2**31) - 1):
        np.testing.assert_array_equal(as_floating("x", value), np.asarray(value, np.float32))
    assert as_floating("x", 2**31 - 1).dtype == jnp.float32


DAYS = pd.date_range("2024-02-28", periods=3)


@pytest.mark.parametrize(
    "dates",
    [
        DAYS,
        DAYS.tz_localize("UTC"),
        pd.Series(DAYS),
        DAYS.to_numpy(),
        list(DAYS.to_pydatetime()),
        [datetime.date(2024, 2, 28)],
        datetime.datetime(2024, 2, 28),
        np.datetime64("2024-02-28"),
        DAYS - DAYS[0],
        datetime.timedelta(days=1),
    ],
    ids=lambda dates: type(dates).__name__,
)
def test_dates_are_refused_with_the_line_that_converts_them(dates):
    """The line, as it is told, makes numbers of days."""
    with pytest.raises(TypeError, match=r"in the model's unit of time; got (time d|d)") as caught:
        as_floating("times", dates)
    line = str(caught.value).split("`")[-2]
    zone = getattr(getattr(dates, "dtype", None), "tz", None)
    days = np.atleast_1d(
        eval(line, {"np": np, "times": dates if zone is None else dates.tz_localize(None)})
    )
    assert np.issubdtype(days.dtype, np.floating)
    np.testing.assert_array_equal(np.diff(days), np.ones(days.size - 1))


def test_differences_are_taken_before_times_are_rounded():
    times = as_times("times", 2_460_000 + np.array([0, 0.1, 0.3]))
    np.testing.assert_allclose(times.gaps, [0.1, 0.2], rtol=1e-6)
    clock, since = times.clock(jnp.dtype(np.float32))
    np.testing.assert_allclose(since, [0, 0.1, 0.3], rtol=1e-6)
    assert isinstance(clock.exactly(since), np.ndarray)
    np.testing.assert_allclose(clock.exactly(since), times.values, rtol=1e-14)
    near = as_times("times", [1.0, 2.0]).clock(jnp.dtype(np.float32))
    assert isinstance(near[0].exactly(near[1]), jax.Array)


def test_times_that_were_rounded_before_are_refused():
    """But not whole numbers, which single precision holds."""
    hours = np.float32(20_000 + np.arange(5) / 24)
    with pytest.raises(
        ValueError, match=r"too far from zero for their dtype float32: .* as a NumPy array"
    ):
        as_times("times", hours)
    with pytest.raises(ValueError, match="too far from zero"):
        as_times("times", np.float32(1.7e9) + np.float32(1000) * np.arange(3, dtype=np.float32))
    as_times("times", np.float32([2_460_000, 2_460_001]))
    as_times("times", hours.astype(float))


def test_a_clock_of_traced_times_gives_these():
    @jax.jit
    def ends(times):
        clock, since = as_times("times", times).clock(times.dtype)
        return clock(since), since

    absolute, since = ends(jnp.array([3.0, 3.5, 5.0]))
    np.testing.assert_array_equal(absolute, [3.0, 3.5, 5.0])
    np.testing.assert_array_equal(since, [0.0, 0.5, 2.0])
