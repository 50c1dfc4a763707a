"""Observations whose noise is singular, or is none at all: what they add to the weight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb

KEY = jax.random.key(0)
MODEL = jb.ornstein_uhlenbeck([[1.0, 0.5], [0.0, 1.0]])
TIMES = np.arange(3) * 0.4


def drift(x, p):
    return -x


POINT = [0.3, -0.1]


def weigher(model, values, observation):
    """log w of the path without noise, in x_0 = `POINT`, as a function of the parameters."""
    options = {"observation": observation, "initial": POINT, "num_steps": 2}
    paths = jb.innovations(model, TIMES, values, **options)
    return jax.jit(lambda params: paths.log_weight(params, jnp.zeros(paths.size)))


@pytest.mark.slow
def test_a_negative_variance_explains_nothing():
    """One that is found in a search, of a combination of two components."""
    model = jb.Diffusion(drift, params=0.5)
    values = np.full((3, 2), 0.2)
    R = lambda p: jnp.eye(2) + (p - 1) / 2
    weigh = weigher(model, values, jb.LinearGaussian(covariance=R))
    assert np.isfinite(weigh(0.5))
    assert weigh(-0.5) == -np.inf


@pytest.mark.slow
def test_no_filter_takes_a_negative_variance():
    model = jb.Diffusion(drift, params=0.5)
    seen = jb.LinearGaussian(covariance=lambda p: p)

    @jax.jit
    def value(params):
        moved, values = model.with_params(params), np.full((3, 1), 0.2)
        made = jb.log_likelihood(
            KEY, moved, TIMES, values, observation=seen, initial=[0.3], num_steps=2, num_particles=5
        )
        return made.value, made.unexplained

    assert np.isfinite(value(0.5)[0])
    assert value(-0.5) == (-np.inf, 0)


def told(values, initial=POINT):
    return jb.log_likelihood(
        KEY, MODEL, TIMES, values, observation=jb.LinearGaussian(covariance=[0.0, 0.1]),
        initial=initial, num_steps=2, num_particles=5,
    )  # fmt: skip


@pytest.mark.slow
def test_a_state_that_is_known_and_seen_exactly():
    """What is seen of it says nothing where it agrees, and is not explained where it does not."""
    values = np.array([[np.nan, 0.2], [0.5, 0.1], [0.2, np.nan]])
    without = told(values)
    values[0, 0] = POINT[0]
    agreeing = told(values)
    assert np.isfinite(agreeing.value) and agreeing.unexplained == -1
    np.testing.assert_allclose(agreeing.value, without.value, rtol=1e-6)
    values[0, 0] += 1e-3
    other = told(values)
    assert other.value == -np.inf and other.unexplained == 0


@pytest.mark.slow
def test_numbers_that_follow_from_others():
    """Two rows with one noise are one number, if the numbers agree: where a correlation is found to
    be one."""
    size = 3.3
    rows, model = np.array([[0.3, 0.7], [0.3 * size, 0.7 * size]]), jb.Diffusion(drift, params=0.5)
    values = np.array([[np.nan, np.nan], [0.5, 0.5 * size], [0.2, 0.2 * size]])
    square = jnp.array([[0.49, 0.0], [0.0, 0.49 * size**2]])
    cross = jnp.array([[0.0, 0.49 * size], [0.49 * size, 0.0]])
    seen = jb.LinearGaussian(rows, covariance=lambda p: square + p * cross)
    once = weigher(model, values[:, :1], jb.LinearGaussian(rows[:1], covariance=0.49))
    np.testing.assert_allclose(weigher(model, values, seen)(1.0), once(1.0), rtol=1e-5)
    values[2, 1] += 1e-3
    assert weigher(model, values, seen)(1.0) == -np.inf
