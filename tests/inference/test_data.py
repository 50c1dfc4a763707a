"""Records and their groups of steps."""

import numpy as np
import pytest

from jaxbridge.inference import data
from jaxbridge.inference.data import _cheapest_groups, step_groups
from jaxbridge.models.bridge_problem import as_intervals


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
