"""Rejection sampling: lanes, numbers and bounds, on attempts whose outcomes are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbridge.engine.rejection import (
    Attempts,
    Search,
    _assign_lanes,
    rejection_sample,
)


def test_lanes_of_each_problem_carry_consecutive_numbers():
    """Whatever the rounding: places 0, 1, ... without gaps, and no lane for those done."""
    num_problems, num_lanes = 5_000, 8_192
    assign = jax.jit(_assign_lanes, static_argnums=(3, 4))
    for seed in range(40):
        rng = np.random.default_rng(seed)
        tried = rng.integers(0, 60, num_problems)
        found = (rng.uniform(size=num_problems) < 0.5) & (tried > 0)
        first, problem, place = map(
            np.asarray,
            assign(
                jnp.asarray(found, jnp.int32),
                jnp.asarray(tried, jnp.int32),
                jnp.asarray(~found),
                1,
                num_lanes,
            ),
        )
        assert not found[problem].any()
        assert (np.diff(problem) >= 0).all() and len(problem) == num_lanes
        expected = np.arange(num_lanes) - np.searchsorted(problem, problem)
        np.testing.assert_array_equal(place, expected)
        np.testing.assert_array_equal(first[problem], np.arange(num_lanes) - expected)


def table_sample(table, active, wanted, max_attempts, num_lanes):
    """Attempts whose successes are read off a table (problem, number)."""
    table = jnp.asarray(table)

    def attempt(problem, number):
        inside = number < table.shape[1]
        success = table[problem, jnp.minimum(number, table.shape[1] - 1)] & inside
        return Attempts(success, ~(number % 7 == 3), {"square": number**2})

    rows = {"square": jnp.full(len(table) * wanted, -5, jnp.int32)}
    search = Search(wanted, jnp.int32(max_attempts), num_lanes)
    return jax.jit(lambda: rejection_sample(attempt, rows, active, search))()


@pytest.mark.parametrize("num_lanes", [1, 7, 64])
def test_it_finds_the_first_successes(num_lanes):
    """Recomputed one attempt at a time."""
    rng = np.random.default_rng(0)
    wanted, max_attempts = 3, 40
    table = rng.uniform(size=(9, 60)) < rng.uniform(0, 0.5, size=(9, 1))
    active = np.arange(9) != 8
    found = table_sample(table, jnp.asarray(active), wanted, max_attempts, num_lanes)
    number = np.asarray(found.number).reshape(9, wanted)
    assert (np.asarray(found.num_found) < wanted).any()
    for p in range(9):
        successes = np.flatnonzero(table[p, :max_attempts])[:wanted] if active[p] else []
        spent = successes[-1] + 1 if len(successes) == wanted else max_attempts * active[p]
        assert list(number[p]) == [*successes, *[-1] * (wanted - len(successes))]
        assert found.num_found[p] == len(successes) and found.num_trials[p] == spent
        assert found.num_nonfinite[p] == (np.arange(spent) % 7 == 3).sum()
        squares = np.asarray(found.outputs["square"]).reshape(9, wanted)[p]
        assert list(squares[: len(successes)]) == [s**2 for s in successes]
        assert (squares[len(successes) :] == -5).all()


def test_no_problem_is_passed_over_for_its_small_share():
    """However many they are, each that lacks a success gets its lane in the end."""
    num_problems = 3_000
    table = np.ones((num_problems, 1), bool)
    table[0] = False
    found = table_sample(table, jnp.ones(num_problems, bool), 1, 50, 16)
    np.testing.assert_array_equal(found.num_found, table[:, 0])
