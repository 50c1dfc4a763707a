"""Chains that begin with a path of no weight, and chains that never move."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.inference.record_gibbs import RecordPosterior, RecordState
from jaxbridge.records import as_record_problems, linearised
from jaxbridge.records.path_blocks import Paths, blocks_of_both_cuts, has_segments, sweep

MODEL = jb.ornstein_uhlenbeck([[1.0]])
TIMES, COUNTS = np.arange(7) * 0.3, np.array([2.0, 1, 0, 3, 2, 1, 1])[:, None]
GUESS = jb.LinearGaussian(covariance=1.0)
# Counts with mean x: NaN where x is negative.
POSITIVE = jb.ObservationDensity(lambda y, x, p: y[0] * jnp.log(x[0]) - x[0], GUESS)
NEVER = jb.ObservationDensity(lambda y, x, p: -jnp.inf, GUESS)
LAW = jb.GaussianLaw([0.0], [[0.5]])


def problem_of_length(num, observation=POSITIVE):
    counts = np.resize(COUNTS, (num + 1, 1))
    return as_record_problems(
        MODEL, np.arange(num + 1) * 0.3, counts, observation, LAW, num_steps=4, any_constant=True
    ).problem(0)


@pytest.mark.slow
def test_a_path_of_no_weight_is_left():
    problem = problem_of_length(6)
    both = blocks_of_both_cuts(problem, *linearised(problem, MODEL)[:2], 2)
    scales = jnp.zeros((2, both.segment.shape[-1]))
    paths = Paths(jnp.full((1, 3), -1.0), jnp.full((6, 4, 1, 3), -1.0))
    step = jax.jit(lambda key, paths: sweep(key, problem, MODEL, both, scales, paths))
    for number in range(40):
        paths, _ = step(jax.random.key(number), paths)
    assert np.all(paths.start > 0) and np.all(paths.points[:, -1] > 0)


@pytest.mark.slow
def test_a_chain_that_never_moves_says_so():
    options = dict(num_draws=4, num_warmup=0, num_chains=2, num_steps=4)
    arguments = (jax.random.key(0), MODEL, TIMES, COUNTS)
    made = jb.smooth(*arguments, observation=NEVER, initial=LAW, **options)
    with pytest.raises(Exception, match="never moved"):
        thrown = jb.smooth(*arguments, observation=NEVER, initial=LAW, **options, throw=True)
        jax.block_until_ready(thrown.paths)
    real = has_segments(problem_of_length(6), 10)
    assert np.all(made.stuck) and np.all(made.accepted[real] == 0)
    assert np.all(np.isfinite(made.paths)) and np.all(made.standard_error() == np.inf)


def test_blocks_beyond_the_record_are_not_stuck():
    """Of nine segments in blocks of four the second cut needs all three of its blocks, the first
    its first three; of four segments in one block the first cut's second is empty."""
    assert has_segments(problem_of_length(9), 4).tolist() == [[True] * 3, [True] * 3]
    assert has_segments(problem_of_length(4), 4).tolist() == [[True, False], [True, True]]


def test_parameters_that_never_moved_have_no_error():
    theta = jax.random.normal(jax.random.key(0), (2, 50, 2)).at[1, :, 1].set(0.3)
    moved, share = jnp.ones((2, 50), bool), jnp.ones((2, 50))
    state = RecordState(theta[:, 0], *6 * [share[:, :0]])

    def error(stuck):
        draws = (theta, theta, ("a", "b"), moved, share, jnp.asarray(stuck), share, False, state)
        return RecordPosterior(*draws).standard_error

    assert 0 < error([False, False])[0] < 1 and error([False, False])[1] == np.inf
    assert np.all(error([False, True]) == np.inf)
