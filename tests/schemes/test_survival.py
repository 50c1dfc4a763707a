"""Exits from regions between the points of paths, whose points have their exact law."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import j1, jn_zeros

import jaxbridge as jb

BROWNIAN = jb.Diffusion(lambda x, p: 0 * x, lambda x, p: jnp.full(1, p), params=1.0)
positive = lambda x: x[0]


def brownian(rng, start, times, number, dim=1, sigma=1.0, drift=0.0):
    """Paths of shape (number, K, dim)."""
    dt = np.diff(times)[:, None]
    steps = drift * dt + sigma * np.sqrt(dt) * rng.normal(size=(number, len(dt), dim))
    path = np.concatenate([np.zeros((number, 1, dim)), np.cumsum(steps, axis=1)], axis=1)
    return np.asarray(start) + path


def assert_survives(log_survival, expected, allowance=0.0):
    """The mean of the probabilities is the expected one."""
    stays = np.exp(np.asarray(log_survival, float))
    error = stays.std() / np.sqrt(len(stays))
    assert abs(stays.mean() - expected) < 5 * error + allowance
    assert error < 0.01


@pytest.mark.parametrize("sigma", [1.0, 0.3])
def test_a_brownian_bridge_stays_positive(sigma):
    """From .5 to 1 in one unit of time with probability 1 - exp(-2 .5 1 / σ²)."""
    model, exact = BROWNIAN.with_params(sigma), -np.expm1(-1 / sigma**2)
    ends = jb.log_survival(model, [0.0, 1.0], [[0.5], [1.0]], positive)
    np.testing.assert_allclose(np.exp(ends), [1, exact], rtol=1e-6)
    rng, times = np.random.default_rng(0), np.array([0.0, 0.2, 0.3, 0.7, 1.0])
    free = brownian(rng, [0.0], times, 20_000, sigma=sigma)
    line = 0.5 + 0.5 * times[:, None]
    bridges = free - times[:, None] * free[:, -1:] + line
    made = jb.log_survival(model, times, bridges, positive)
    assert made.shape == (20_000, 5) and np.all(made[:, 1:] <= made[:, :-1])
    assert_survives(made[:, -1], exact)


@pytest.mark.parametrize("at", [0.25, 0.5, 0.9])
def test_paths_to_their_first_hit_are_bessel_bridges(at):
    """Given the first hit of 1 at time 1, 1 - X has the law of |three-dimensional bridge|.

    Bridges end slightly below 1, and their weights are the probabilities to stay below it.
    """
    near = 0.01
    bridges = jb.sample_weighted_bridges(
        jax.random.key(0), jb.Diffusion(lambda x, p: 0 * x), [0.0], [1 - near], 1.0,
        num_bridges=20_000, num_steps=50, proposal=jb.Guided(),
    )  # fmt: skip
    stays = jb.log_survival(BROWNIAN, bridges.times, bridges.paths, lambda x: 1 - x[0])[:, -1]
    weights = np.exp(np.asarray(bridges.log_weights + stays, float))
    weights /= weights.sum()
    where = int(np.argmin(np.abs(np.asarray(bridges.times) - at)))
    distance = 1 - np.asarray(bridges.paths[:, where, 0], float)
    # The norm of N((1 - t, 0, 0), t (1 - t) I) is a noncentral chi.
    t = float(bridges.times[where])
    scale = np.sqrt(t * (1 - t))
    law = stats.ncx2(3, (1 - t) ** 2 / scale**2)
    for power, expected in (1, law.expect(np.sqrt)), (2, law.mean()):
        values = (distance / scale) ** power
        mean = weights @ values
        error = np.sqrt(weights**2 @ (values - mean) ** 2)
        assert abs(mean - expected) < 4.5 * error + near**2 / scale**2
        assert error < 0.05 * expected


@pytest.mark.parametrize("drift", [0.0, 0.8])
def test_first_passage_of_a_level(drift):
    """The distribution function of an inverse Gaussian law at every time, whatever the grid."""
    times = np.array([0.0, 0.5, 0.6, 2.0])
    paths = brownian(np.random.default_rng(1), [0.0], times, 20_000, drift=drift)
    made = jb.log_survival(BROWNIAN, times, paths, lambda x: 1 - x[0])
    for i, t in enumerate(times[1:], 1):
        z = np.array([1 - drift * t, -1 - drift * t]) / np.sqrt(t)
        stays = stats.norm.cdf(z[0]) - np.exp(2 * drift) * stats.norm.cdf(z[1])
        assert_survives(made[:, i], stays)


def test_between_two_levels():
    """Series of the survival in (-1, 1); steps that are short beside the width."""
    times = np.linspace(0, 1, 21)
    paths = brownian(np.random.default_rng(2), [0.3], times, 20_000)
    made = jb.log_survival(BROWNIAN, times, paths, lambda x: jnp.stack([1 - x[0], 1 + x[0]]))
    k = np.arange(1, 60)
    modes = np.sin(k * np.pi * 1.3 / 2) * (1 - np.cos(k * np.pi)) * 2 / (k * np.pi)
    assert_survives(made[:, -1], np.sum(modes * np.exp(-((k * np.pi / 2) ** 2) / 2)))


def test_in_a_disc():
    """A curved boundary: the error is of the order of the step."""
    zeros, errors = jn_zeros(0, 40), []
    exact = np.sum(2 / (zeros * j1(zeros)) * np.exp(-(zeros**2) * 0.3 / 2))
    model = jb.Diffusion(lambda x, p: 0 * x, jnp.ones(2))
    for num_steps in (10, 80):
        times = np.linspace(0, 0.3, num_steps + 1)
        paths = brownian(np.random.default_rng(3), [0.0, 0.0], times, 20_000, dim=2)
        made = jb.log_survival(model, times, paths, lambda x: 1 - x @ x)
        errors.append(np.mean(np.exp(made[:, -1])) - exact)
    assert abs(errors[1]) < 0.02 and abs(errors[1]) < 0.5 * abs(errors[0]) + 0.01
    # Without what happens between the points the probability is far too large.
    assert np.mean(np.all(np.sum(paths**2, axis=-1) < 1, axis=1)) - exact > 0.025


def test_noise_that_depends_on_the_state_and_on_time():
    """A geometric Brownian motion below a level, and one whose clock runs faster and faster."""
    times = np.linspace(0, 1, 41)
    logs = brownian(np.random.default_rng(4), [0.0], times, 20_000, sigma=0.5, drift=-0.125)
    model = jb.Diffusion(lambda x, p: 0 * x, lambda x, p: 0.5 * x)
    made = jb.log_survival(model, times, np.exp(logs), lambda x: 1.5 - x[0])
    level = np.log(1.5)
    z = (np.array([level, -level]) + 0.125) / 0.5
    stays = stats.norm.cdf(z[0]) - np.exp(-2 * 0.125 * level / 0.25) * stats.norm.cdf(z[1])
    assert_survives(made[:, -1], stays, 0.002)

    clock = times**2
    paths = brownian(np.random.default_rng(5), [0.0], clock, 20_000)
    sigma = lambda x, p, t: jnp.sqrt(2 * jnp.maximum(t, 1e-9)) * jnp.ones(1)
    made = jb.log_survival(
        jb.Diffusion(lambda x, p: 0 * x, sigma), times, paths, lambda x: 1 - x[0]
    )
    assert_survives(made[:, -1], 2 * stats.norm.cdf(1) - 1, 0.002)


@pytest.mark.parametrize("ends", [(7.0, 8.0, 0.05), (8.0, 8.5, 0.02)])
def test_noise_that_varies_on_the_way_to_the_boundary(ends):
    """The logarithm of a geometric Brownian motion is a Brownian motion, so that this is exact."""
    x, y, duration = ends
    model = jb.Diffusion(lambda x, p: 0 * x, lambda x, p: 0.8 * x)
    log_stays = jb.log_survival(model, [0.0, duration], [[x], [y]], lambda x: 9 - x[0])[1]
    exact = np.log1p(-np.exp(-2 * np.log(9 / x) * np.log(9 / y) / (0.64 * duration)))
    np.testing.assert_allclose(log_stays, exact, rtol=0.03)


def test_two_functions_with_one_boundary():
    """1.5² - |x|² is no distance from the circle, but the same comes out, in all units."""
    planar = jb.Diffusion(lambda x, p: 0 * x, lambda x, p: p * jnp.ones(2), params=1.0)
    times, points = [0.0, 0.1], np.array([[1.2, 0.0], [1.2, 0.1]])
    by_distance = jb.log_survival(planar, times, points, lambda x: 1.5 - jnp.linalg.norm(x))[1]
    for unit in (1.0, 1e-6, 1e6):
        model, squared = planar.with_params(unit), np.float32(2.25 * unit**2)
        by_square = jb.log_survival(model, times, unit * points, lambda x, c=squared: c - x @ x)[1]
        np.testing.assert_allclose(by_square, by_distance, rtol=1e-4)


def test_outside_and_without_noise():
    """Nothing returns; a position moves without noise; all derivatives are finite."""
    path = np.array([[0.5], [-0.1], [0.4]])
    made = jb.log_survival(BROWNIAN, [0.0, 0.1, 0.2], path, positive)
    np.testing.assert_array_equal(made, [0, -np.inf, -np.inf])
    np.testing.assert_array_equal(
        jb.log_survival(BROWNIAN, [0.0, 0.1], -path[:2], positive), [-np.inf, -np.inf]
    )
    oscillator = jb.Diffusion(lambda x, p: jnp.stack([x[1], -x[0]]), [[0.0], [1.0]])
    states = np.array([[0.5, 0.0], [0.1, 3.0]])
    made = jb.log_survival(oscillator, [0.0, 0.1], states, positive)
    np.testing.assert_array_equal(made, [0, 0])
    slope = jax.grad(
        lambda path: jb.log_survival(
            oscillator, [0.0, 2.0], path, lambda x: jnp.stack([x[0], 4 - x[1]])
        )[-1]
    )(jnp.asarray(states))
    assert np.all(np.isfinite(slope)) and np.any(slope != 0)


def test_several_intervals_have_times_of_their_own():
    times = np.array([[0.0, 1.0], [0.0, 2.0]])
    paths = np.broadcast_to([[0.5], [1.0]], (2, 3, 2, 1))
    made = np.exp(jb.log_survival(BROWNIAN, times, paths, positive))[..., -1]
    expected = -np.expm1([-1.0, -0.5])
    np.testing.assert_allclose(made, np.repeat(expected[:, None], 3, axis=1), rtol=1e-6)


def test_refusals():
    with pytest.raises(TypeError, match="`inside` must be a function"):
        jb.log_survival(BROWNIAN, [0.0, 1.0], [[0.5], [1.0]], 1.0)
    with pytest.raises(ValueError, match="`times` must have shape"):
        jb.log_survival(BROWNIAN, [0.0, 1.0, 2.0], [[0.5], [1.0]], positive)
    with pytest.raises(TypeError, match="`inside` must return real numbers"):
        jb.log_survival(BROWNIAN, [0.0, 1.0], [[0.5], [1.0]], lambda x: "in")
