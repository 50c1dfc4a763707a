"""Coefficients that depend on time: closed forms, and what does not depend on it after all."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import loglog_slope
from scipy.integrate import quad

import jaxbridge as jb
from jaxbridge.schemes import log_halving_of_paths

KEY = jax.random.key(0)
TIMES = 3.0 + np.cumsum(np.random.default_rng(0).uniform(0.05, 0.3, 20))
SEEN, START = jb.LinearGaussian(covariance=0.05), jb.GaussianLaw([0.2], [[0.3]])
RATE, AMPLITUDE, PERIOD, SIGMA = 1.5, 2.0, 0.7, 0.6


def pull(before, t):
    """What the season moves the mean by."""
    season = lambda s: AMPLITUDE * np.sin(2 * np.pi * s / PERIOD)
    return quad(lambda s: RATE * np.exp(-RATE * (t - s)) * season(s), before, t)[0]


def seasonal_kalman(times, values):
    """log p of a seasonal Ornstein-Uhlenbeck process that is seen with noise."""
    mean, variance, log_likelihood = 0.2, 0.3, 0.0
    for i, (t, y) in enumerate(zip(times, values[:, 0], strict=True)):
        if i:
            gap, before = t - times[i - 1], times[i - 1]
            decay = np.exp(-RATE * gap)
            mean = decay * mean + pull(before, t)
            variance = decay**2 * variance + SIGMA**2 * (1 - decay**2) / (2 * RATE)
        if np.isfinite(y):
            total = variance + 0.05
            log_likelihood -= (y - mean) ** 2 / (2 * total) + np.log(2 * np.pi * total) / 2
            mean, variance = mean + variance / total * (y - mean), variance * 0.05 / total
    return log_likelihood


def told(model, values, num_steps, **options):
    options = {
        "observation": SEEN,
        "initial": START,
        "num_particles": 4,
        "num_filters": 2,
        **options,
    }
    return jb.log_likelihood(KEY, model, TIMES, values, num_steps=num_steps, **options)


@pytest.mark.slow
def test_a_seasonal_process_is_kalmans(x64):
    """Of second order, for coefficients are taken in the middle of steps."""
    values = np.sin(2 * TIMES)[:, None]
    values[4] = np.nan
    model = jb.seasonal_ornstein_uhlenbeck(RATE, 0.0, AMPLITUDE, 0.0, PERIOD, SIGMA)
    exact = seasonal_kalman(TIMES, values)
    made = {N: told(model, values, N) for N in (8, 16)}
    errors = {N: float(each.value) - exact for N, each in made.items()}
    assert 1.7 < loglog_slope(1 / np.array(list(errors)), np.abs(list(errors.values()))) < 2.4
    for N in (8, 16):
        assert abs(errors[N] - made[N].step_error) < 0.3 * abs(errors[N])
        assert np.ptp(np.asarray(made[N].log_estimates)) < 1e-9


@pytest.mark.slow
def test_noise_of_observations_may_depend_on_time():
    """Seen well before time 5, and hardly after: as two kinds of rows."""
    model = jb.ornstein_uhlenbeck([[1.0]])
    values = np.sin(2 * TIMES)[:, None]
    of_time = jb.LinearGaussian(covariance=lambda p, t: jnp.where(t < 5, 0.05, 1.5))
    rows = np.where(TIMES[:, None] < 5, [[1, 0]], [[0, 1]])
    two = np.where(rows == 1, values, np.nan)
    apart = jb.LinearGaussian([[1.0], [1.0]], covariance=[0.05, 1.5])
    a = told(model, values, 4, observation=of_time).value
    np.testing.assert_allclose(a, told(model, two, 4, observation=apart).value, rtol=1e-5)
    density = lambda y, x, p, t: jax.scipy.stats.norm.logpdf(
        y[0], x[0], jnp.sqrt(jnp.where(t < 5, 0.05, 1.5))
    )
    other = jb.ObservationDensity(density, guess=of_time)
    np.testing.assert_allclose(a, told(model, values, 4, observation=other).value, rtol=1e-5)


def test_a_time_is_a_third_argument_without_a_default():
    with_default = jb.Diffusion(lambda x, p, scale=2.0: -scale * x)
    assert not with_default.depends_on_time
    np.testing.assert_allclose(with_default.drift([1.0]), [-2.0])
    timed = jb.Diffusion(lambda x, p, t: -t * x, lambda x, p, t: jnp.sqrt(t) * jnp.ones_like(x))
    np.testing.assert_allclose(timed.drift([1.0], 3.0), [-3.0])
    np.testing.assert_allclose(timed.diffusion([1.0], 4.0), [[2.0]])
    both = jb.integrated(timed)
    np.testing.assert_allclose(both.drift([5.0, 1.0], 3.0), [1.0, -3.0])
    np.testing.assert_allclose(both.diffusion([5.0, 1.0], 4.0), [[0.0], [2.0]])


@pytest.mark.slow
def test_what_is_for_constant_coefficients_says_what_to_use_instead():
    model = jb.seasonal_ornstein_uhlenbeck()
    ends = (KEY, model, [0.0], [0.1], 1.0)
    calls = [
        lambda: model.drift([0.0]),
        lambda: jb.transition_log_density(*ends, num_proposals=2, num_steps=4, proposal="auto"),
        lambda: jb.sample_exact_bridges(
            *ends, num_bridges=2, num_steps=4, proposal=jb.ModifiedDiffusionBridge()
        ),
        lambda: jb.path_log_likelihood(model, jnp.arange(3.0), jnp.zeros((3, 1))),
        lambda: jb.sample_bridges(*ends, num_bridges=2, num_steps=4),
    ]
    for call in calls:
        with pytest.raises(ValueError, match=r"depend on time.*`log_likelihood`"):
            call()
    timed = lambda x, p, t: -t * x
    with pytest.raises(ValueError, match="not stationary: leave out `log_stationary`"):
        jb.Diffusion(timed, None, lambda x, p: -x @ x)
    with pytest.raises(ValueError, match="not stationary: leave out `reversible`"):
        jb.Diffusion(timed, reversible=True)
    with pytest.raises(ValueError, match="write the model in its new coordinates"):
        jb.transform(model, jnp.sinh, jnp.arcsinh)
    with pytest.raises(ValueError, match="leave out `proposal`"):
        jb.smooth(
            KEY, model, TIMES, 0 * TIMES[:, None], observation=SEEN, initial=START, proposal="auto"
        )


@pytest.mark.slow
def test_means_of_the_density_of_half_as_many_steps(x64):
    """E[e^D] = 1 for pairs of steps of the chain, where the noise grows with time: D compares the
    laws of steps at three times."""
    model = jb.Diffusion(lambda x, p, t: -x, lambda x, p, t: jnp.exp(t) * jnp.ones(1))
    dynamics_at, density, dt = model.forward_at(jnp.zeros(1)), jb.ItoTaylorDensity(), 0.4
    xi = jax.random.normal(KEY, (40_000, 2, 1))

    def pair(xi):
        law = density.steps_from(dynamics_at(dt / 2), jnp.ones(1)).law(dt)
        middle = law.point(xi[0])
        law = density.steps_from(dynamics_at(3 * dt / 2), middle).law(dt)
        return jnp.stack([jnp.ones(1), middle, law.point(xi[1])])

    times = jnp.broadcast_to(jnp.array([[dt / 2], [3 * dt / 2]]), (2, len(xi)))
    D = log_halving_of_paths(
        density, dynamics_at, jnp.full((2, len(xi)), dt), jax.vmap(pair)(xi), times
    )
    ratios = np.exp(np.asarray(D))
    assert abs(ratios.mean() - 1) < 5 * ratios.std() / np.sqrt(len(xi))
    assert ratios.std() < 0.5


def test_free_paths_are_those_of_the_season():
    """Means at two times against the closed form."""
    model = jb.seasonal_ornstein_uhlenbeck(RATE, 0.0, AMPLITUDE, 0.0, PERIOD, SIGMA)
    times = jnp.array([0.3, 0.5, 0.9])
    paths = jb.simulate(KEY, model, [0.2], times, num_paths=4000, num_steps=20)[..., 0]
    for i, t in [(1, 0.5), (2, 0.9)]:
        mean = 0.2 * np.exp(-RATE * (t - 0.3)) + pull(0.3, t)
        sd = SIGMA * np.sqrt((1 - np.exp(-2 * RATE * (t - 0.3))) / (2 * RATE))
        assert abs(paths[:, i].mean() - mean) < 5 * sd / np.sqrt(4000) + 0.01
        assert abs(paths[:, i].std() / sd - 1) < 5 / np.sqrt(8000)
