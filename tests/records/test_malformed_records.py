"""What cannot be a record, or a way to see it, is refused in words that say what to change."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb

KEY, MODEL = jax.random.key(0), jb.ornstein_uhlenbeck([[1.0, 0.5], [0.0, 1.0]])
TIMES, VALUES = np.arange(4.0), np.zeros((4, 2))
SEEN = jb.LinearGaussian(covariance=0.1)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: jb.LinearGaussian([1.0, 0.0]), r"`matrix` must have shape \(m, d\)"),
        (lambda: jb.LinearGaussian([[np.nan, 0.0]]), "`matrix` must be finite"),
        (lambda: jb.LinearGaussian(covariance=-1.0), "without negative variances"),
        (lambda: jb.LinearGaussian(covariance=[[1.0, 2.0], [2.0, 1.0]]), "negative variances"),
        (lambda: jb.LinearGaussian(covariance=[[1.0, 2.0], [0.0, 9.0]]), "symmetric"),
        (lambda: jb.LinearGaussian(covariance=np.ones((1, 2))), "`covariance` must have shape"),
        (lambda: jb.LinearGaussian(covariance=np.inf), "must be finite"),
        (lambda: jb.ObservationDensity(lambda y, x, p: 0.0, jb.LinearGaussian()), "positive"),
    ],
)
def test_ways_to_see(make, message, unchecked):
    with pytest.raises(ValueError, match=message):
        make()


def test_kinds_of_things(unchecked):
    with pytest.raises(TypeError, match="`log_density` must be a function"):
        jb.ObservationDensity(3, SEEN)
    with pytest.raises(TypeError, match="`guess` must be a `LinearGaussian`"):
        jb.ObservationDensity(lambda y, x, p: 0.0, 0.1)
    with pytest.raises(TypeError, match="`observation` must be a `LinearGaussian`"):
        jb.innovations(MODEL, TIMES, VALUES, observation=0.1)


CASES = {
    "matrix for another state": (
        dict(observation=jb.LinearGaussian([[1.0, 0.0, 0.0]], 0.1), values=VALUES[:, :1]),
        r"`matrix` must have shape \(1, 2\)",
    ),
    "other components": (
        dict(observation=jb.LinearGaussian([[1.0, 0.0]], 0.1)),
        "`observations` must have 1 components",
    ),
    "covariance of others": (
        dict(observation=jb.LinearGaussian(covariance=np.eye(3))),
        "`covariance` must have shape",
    ),
    "exact and redundant": (
        dict(observation=jb.LinearGaussian([[1.0, 0.0], [2.0, 0.0]], 0.0)),
        "have rank 1: leave out",
    ),
    "fewer rows": (dict(values=VALUES[:3]), "a row for each of them"),
    "times go back": (dict(times=TIMES[::-1]), "`times` must increase"),
    "a time is missing": (dict(times=[0.0, np.nan, 2.0, 3.0]), r"`times\[1\]` = nan is missing"),
    "one time": (dict(times=TIMES[:1], values=VALUES[:1]), "two times or more"),
    "infinite": (dict(values=np.full((4, 2), np.inf)), r"`observations\[0, 0\]` is infinite"),
    "before the beginning": (dict(initial_time=1.0), "`times` must begin at `initial_time`"),
    "two kinds of steps": (dict(num_steps=4, step_size=0.1), "not both"),
    "no steps": (dict(num_steps=0), "`num_steps` must be at least 1"),
    "backward steps": (dict(step_size=-1.0), "`step_size` must be a positive"),
    "initial of another shape": (dict(initial=[0.0]), "`initial` must be a point of shape"),
    "initial is not finite": (dict(initial=[0.0, np.nan]), "`initial` must be finite"),
}


@pytest.mark.parametrize("name", CASES)
def test_records(name, unchecked):
    changed, message = CASES[name]
    options = {"observation": SEEN, "initial": [0.0, 0.0], **changed}
    times, values = options.pop("times", TIMES), options.pop("values", VALUES)
    for read in (
        lambda: jb.innovations(MODEL, times, values, **options),
        lambda: jb.log_likelihood(KEY, MODEL, times, values, **options),
        lambda: jb.smooth(KEY, MODEL, times, values, **options),
    ):
        with pytest.raises(ValueError, match=message):
            read()


def test_a_beginning_without_a_law(unchecked):
    free = jb.Diffusion(lambda x, p: -x)
    with pytest.raises(ValueError, match="`initial` is missing"):
        jb.innovations(free, TIMES, VALUES, observation=SEEN)


def test_a_constant_that_is_not_known_is_refused(unchecked):
    unknown = jb.Diffusion(lambda x, p: -x, None, lambda x, p: 7 - x @ x)
    for read in (jb.innovations, lambda *record, **how: jb.log_likelihood(KEY, *record, **how)):
        with pytest.raises(ValueError, match="not declared `normalised`"):
            read(unknown, TIMES, VALUES, observation=SEEN)


@pytest.mark.slow
def test_masked_values_and_rows_without_any_are_not_seen():
    masked = np.ma.masked_array(VALUES, np.eye(4, 2, dtype=bool))
    made = jb.innovations(MODEL, TIMES, masked, observation=SEEN, initial=[0.0, 0.0], num_steps=2)
    nothing = np.where(np.eye(4, 2, dtype=bool), np.nan, VALUES)
    same = jb.innovations(MODEL, TIMES, nothing, observation=SEEN, initial=[0.0, 0.0], num_steps=2)
    xi = jnp.zeros(made.size)
    weigh = jax.jit(lambda paths: paths.log_weight(MODEL.params, xi))
    assert weigh(made) == weigh(same) and np.isfinite(weigh(made))


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


POSITIVE = jb.Diffusion(lambda x, p: 1 - x, [0.5], domain=lambda x, p: jnp.all(x > 0))
SIZES = {
    "matrix": (jb.LinearGaussian([[1.0, 0.0, 0.0]], 0.1), r"`matrix` must have shape \(1, 2\)"),
    "no matrix": (SEEN, "`observations` have 1 components, and without a `matrix`"),
}


@pytest.mark.parametrize("name", SIZES)
def test_sizes_that_are_not_those_of_the_state(name, unchecked):
    """With the default initial law, which has no size of its own."""
    observation, message = SIZES[name]
    for read in (jb.innovations, lambda *record, **how: jb.log_likelihood(KEY, *record, **how)):
        with pytest.raises(ValueError, match=message):
            read(MODEL, TIMES, VALUES[:, :1], observation=observation)


@pytest.mark.parametrize(
    "observation, values, initial, message",
    [
        (jb.LinearGaussian(), [1.0, -1.0], [1.0], r"`observations\[1\]` is the state .* `domain`"),
        (jb.LinearGaussian([[-2.0]]), [-1.0, 2.0], [0.5], r"`observations\[1\]` is the state"),
        (jb.LinearGaussian(covariance=0.1), [1.0, -1.0], [-1.0], "`initial` = .* `domain`"),
    ],
)
def test_states_outside_the_state_space(observation, values, initial, message, unchecked):
    record = np.arange(2.0), np.array(values)[:, None]
    with pytest.raises(ValueError, match=message):
        jb.innovations(POSITIVE, *record, observation=observation, initial=initial)
    several = [record[0], record[0]], [np.ones_like(record[1]) * np.sign(values[0]), record[1]]
    with pytest.raises(ValueError, match=message):
        jb.log_likelihood(KEY, POSITIVE, *several, observation=observation, initial=initial)


def test_what_is_known_to_be_redundant_or_of_no_variance(unchecked):
    """Of matrix and covariance together; and by a function of the parameters."""
    singular = jb.LinearGaussian([[1.0, 0.0], [1.0, 0.0]], [[1.0, 1.0], [1.0, 1.0]])
    with pytest.raises(ValueError, match="`matrix` and `covariance` side by side have rank 1"):
        jb.innovations(MODEL, TIMES, VALUES, observation=singular)
    guess = jb.LinearGaussian(covariance=lambda params: jnp.zeros(2))
    density = jb.ObservationDensity(lambda y, x, p: -(y - x) @ (y - x), guess)
    with pytest.raises(ValueError, match="`guess` must have positive variances"):
        jb.innovations(MODEL, TIMES, VALUES, observation=density)
