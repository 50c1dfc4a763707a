"""Records and their groups of steps."""

import jax
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.inference import data
from jaxbridge.inference.data import _cheapest_groups, step_groups
from jaxbridge.models.bridge_problem import as_intervals
from jaxbridge.records import as_observations


def groups_of(durations, step_size):
    points = np.zeros((len(durations), 1))
    intervals, _, _ = as_intervals(points, points, np.asarray(durations))
    return step_groups(intervals, None, step_size)


def test_no_step_is_longer_than_was_asked_for():
    durations = np.exp(np.random.default_rng(0).uniform(np.log(0.05), np.log(4), 300))
    groups = groups_of(durations, 0.05)
    assert sorted(np.concatenate([group.which for group in groups])) == list(range(300))
    for group in groups:
        np.testing.assert_allclose(group.intervals.duration, durations[group.which], rtol=1e-6)
        assert durations[group.which].max() / group.num_steps <= 0.05 * (1 + 1e-3)


def test_a_short_record_has_one_group_and_a_long_one_many():
    rng = np.random.default_rng(0)
    short, long = (rng.uniform(0.05, 4.0, size) for size in (300, 30_000))
    assert len(groups_of(short, 0.05)) == 1
    assert len(groups_of(long, 0.05)) > 4


@pytest.mark.parametrize("cost", [1, 30, 1_000])
def test_the_groups_are_the_cheapest(cost, monkeypatch):
    """Against all ways to group five numbers of steps."""
    monkeypatch.setattr(data, "_STEPS_PER_GROUP", cost)
    numbers, counts = [1, 3, 4, 9, 20], [5, 1, 7, 2, 3]

    def total(ends):
        sizes = [next(end for end in ends if end >= number) for number in numbers]
        return cost * len(ends) + int(np.dot(sizes, counts))

    ways = [
        [number for i, number in enumerate(numbers) if i == 4 or kept >> i & 1]
        for kept in range(16)
    ]
    assert total(_cheapest_groups(numbers, counts)) == min(map(total, ways))


def test_a_record_in_two_parts_that_share_a_point_is_the_same_record():
    model, times = jb.ornstein_uhlenbeck([[1.0]]), np.cumsum([0.0, 0.5, 0.25, 1.0, 0.5])
    values = np.linspace(-1, 1, 5)[:, None]
    parts = [times[:3], times[2:] + 7], [values[:3], values[2:]]
    whole, cut = as_observations(model, times, values), as_observations(model, *parts)
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(cut), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


def test_masked_arrays_without_anything_masked_are_arrays():
    model, times, values = jb.ornstein_uhlenbeck([[1.0]]), np.arange(3.0), np.zeros((3, 1))
    masked = as_observations(model, np.ma.masked_less(times, -1), np.ma.masked_invalid(values))
    plain = as_observations(model, times, values)
    jax.tree.map(np.testing.assert_array_equal, masked, plain)
