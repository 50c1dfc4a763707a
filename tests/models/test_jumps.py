"""Jumps at known times: where they split times, and the paths of `simulate`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_moments

import jaxbridge as jb
from jaxbridge.engine.times import as_times

KEY = jax.random.key(0)
LINE = jb.ornstein_uhlenbeck([[1.0]])


def test_times_are_split_where_the_state_jumps():
    jumps = jb.Jumps([0.0, 0.7, 1.1, 2.0, 9.0], [1.0, 2.0, 3.0, 4.0, 5.0])
    single = np.array([0.0, 1.1, 2.0], np.float32)  # in which 1.1 is another number
    times, is_time, jump = jumps.split(as_times("times", single))
    np.testing.assert_allclose(times.values, [0.0, 0.7, 1.1, 2.0], rtol=1e-6)
    np.testing.assert_allclose(times.gaps, [0.7, 0.4, 0.9], rtol=1e-6)
    np.testing.assert_array_equal(is_time, [True, False, True, True])
    # The last two jumps come at the end or after it.
    np.testing.assert_array_equal(jump.exists, [True, True, True])
    np.testing.assert_array_equal(jump.inputs[:, 0], [1, 2, 3])


@pytest.mark.parametrize("scale", [1, 2_460_000])
def test_a_jump_shortly_before_a_time_is_before_it(scale):
    """However short the gap, if it is no rounding error; also in days of a Julian date."""
    times, is_time, jump = jb.Jumps([scale + 0.4999], [1.0]).split(
        as_times("times", np.array([0.0, 0.5, 1.0]) + scale)
    )
    np.testing.assert_array_equal(is_time, [True, False, True, True])
    np.testing.assert_array_equal(jump.exists, [False, True, False])
    np.testing.assert_allclose(times.gaps[1], 1e-4, rtol=1e-4)


def test_jumps_of_one_time_are_one():
    near = np.float32(1.1)
    with pytest.raises(ValueError, match="pass one jump there, with the sum"):
        jb.Jumps([1.1, np.nextafter(near, 2)], [1.0, 2.0]).split(
            as_times("times", np.array([0.0, near, 2.0], np.float32))
        )


def test_jumps_since_a_time():
    jumps = jb.Jumps([0.0, 1.5, 2.0], [1.0, 2.0, 3.0])
    assert jumps.since(1.5).times == (1.5, 2.0) and jumps.since(2.1) is None
    np.testing.assert_array_equal(jumps.since(1.6).inputs, [[3.0]])


def test_an_interval_without_a_jump():
    jumps = jb.Jumps([0.5], [[2.0, 1.0]])
    times, is_time, jump = jumps.split(as_times("times", [0.0, 1.0, 2.0]))
    np.testing.assert_array_equal(jump.exists, [False, True, False])
    assert times.shape == (4,) and is_time.sum() == 3


def test_simulated_paths_jump_and_show_the_state_before():
    """Readings of a process with doses: normal, with the doses that decayed."""
    times, doses = [0.0, 1.0, 1.5], jb.Jumps([0.0, 0.5, 1.0], [1.0, -2.0, 4.0])
    paths = jb.simulate(
        KEY, LINE, [0.3], times, num_paths=4000, jumps=doses, num_steps=20
    )[..., 0]  # fmt: skip
    np.testing.assert_array_equal(paths[:, 0], np.float32(0.3))
    decayed = lambda at, t: np.exp(-(t - at))
    mean = [
        1.3 * decayed(0, 1) - 2 * decayed(0.5, 1),
        1.3 * decayed(0, 1.5) - 2 * decayed(0.5, 1.5) + 4 * decayed(1, 1.5),
    ]
    variance = (1 - np.exp(-2 * np.array([1.0, 1.5]))) / 2
    between = variance[0] * np.exp(-0.5)
    covariance = [[variance[0], between], [between, variance[1]]]
    assert_moments(paths[:, 1:], mean, covariance, mean_allowance=0.01)


def test_a_map_sees_inputs_and_parameters():
    """A still process that is multiplied, then set by a parameter."""
    still = jb.Diffusion(lambda x, p: 0 * x, 1e-6 * jnp.eye(1), params={"level": 5.0})
    jumps = jb.Jumps(
        [0.5, 1.5],
        [[3.0, 0.0], [0.0, 1.0]],
        apply=lambda x, u, params: u[0] * x + u[1] * params["level"],
    )
    (path,) = jb.simulate(KEY, still, [2.0], [0.0, 1.0, 2.0], jumps=jumps, num_steps=1)
    np.testing.assert_allclose(path[:, 0], [2.0, 6.0, 5.0], atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (([[0.0, 1.0]], [1.0]), "shape (J,)"),
        (([], []), "J ≥ 1"),
        ((1.0, 2.0), "shape (J,)"),
        (([1.0, 0.0], [1.0, 1.0]), "Sort them with their `inputs`"),
        (([1.0, 1.0], [1.0, 1.0]), "combine jumps at equal times"),
        (([np.nan], [1.0]), "must be finite"),
        (([0.0, 1.0], [1.0]), "one row per time"),
        (([0.0], [np.nan]), "finite"),
        (([0.0], [1.0], 3), "`apply`"),
        (([0.0], [1.0], lambda x: x), "`apply`"),
    ],
)
def test_refusals(arguments, words):
    with pytest.raises((ValueError, TypeError)) as error:
        jb.Jumps(*arguments)
    assert words in str(error.value)


def test_times_of_jumps_are_concrete():
    with pytest.raises(ValueError, match="must be concrete"):
        jax.jit(lambda t: jb.Jumps(t, [1.0]).inputs)(jnp.zeros(1))


@pytest.mark.parametrize(
    ("jumps", "words"),
    [
        (jb.Jumps([-1.0], [1.0]), "must not begin before"),
        (jb.Jumps([0.5], [[1.0, 2.0]]), "shape (J, 1)"),
        (jb.Jumps([0.5], [1.0], lambda x, u, params: jnp.zeros(2)), "it returned shape (2,)"),
        ([1.0], "must be a `Jumps`"),
    ],
)
def test_simulate_refuses(jumps, words):
    with pytest.raises((ValueError, TypeError)) as error:
        jb.simulate(KEY, LINE, [0.0], [0.0, 1.0], jumps=jumps)
    assert words in str(error.value)
