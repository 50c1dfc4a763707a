"""Forecasts against Kalman's filter, and their ranks as tests of a model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxbridge as jb

P, N, GAP, NOISE = 2000, 40, 0.3, 0.1
KEY = jax.random.key(1)
OU = jb.ornstein_uhlenbeck([[1.0]])
TIMES = GAP * np.arange(N)
DECAY, SPREAD = np.exp(-GAP), (1 - np.exp(-2 * GAP)) / 2


def readings(noise, n=N, seed=0):
    rng, x, made = np.random.default_rng(seed), 0.0, []
    for k in range(n):
        scale = np.sqrt(SPREAD if k else 0.5)
        x = DECAY * x * (k > 0) + scale * rng.normal()
        made.append(x + np.sqrt(noise) * rng.normal())
    return np.array(made)


def kalman(y, noise, num_later):
    """Means and variances of the readings, given those before them; later ones have no readings."""
    mean, variance, laws = 0.0, 0.5, []
    for k in range(len(y) + num_later):
        if k:
            mean, variance = DECAY * mean, DECAY**2 * variance + SPREAD
        laws.append((mean, variance + noise))
        if k < len(y) and not np.isnan(y[k]):
            gain = variance / (variance + noise)
            mean, variance = mean + gain * (y[k] - mean), variance * (1 - gain)
    return np.array(laws)


def forecast(y, noise, at=(), **options):
    return jb.forecast(
        jax.random.key(1), OU, TIMES, y, observation=jb.LinearGaussian(covariance=noise),
        num_steps=1, num_particles=P, at=at, **options,
    )  # fmt: skip


@pytest.fixture(scope="module")
def noisy():
    y = readings(NOISE)
    y[7] = np.nan
    later = TIMES[-1] + GAP * np.arange(1, 4)
    return y, forecast(y, NOISE, later), kalman(y, NOISE, 3)


def test_ranks_and_scores_are_kalmans(noisy):
    y, made, laws = noisy
    mean, sd = laws[:N, 0], np.sqrt(laws[:N, 1])
    z = (y - mean) / sd
    assert made.trustworthy and np.isnan(made.uniforms[7, 0]) and np.isnan(made.log_scores[7])
    # The draws at a reading are worth as many as the particles of the reading before.
    error = 0.5 / np.sqrt(np.minimum(np.append(P, made.effective_sample_size[:-1]), P))
    assert np.nanmax(np.abs(made.uniforms[:, 0] - stats.norm.cdf(z)) / error) < 5
    exact = np.nansum(stats.norm.logpdf(y, mean, sd))
    noise = np.sqrt(np.sum(1 / made.effective_sample_size))
    assert abs(np.nansum(made.log_scores) - exact) < 5 * noise
    crps = sd * (z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - 1 / np.sqrt(np.pi))
    np.testing.assert_allclose(made.crps[:, 0], crps, atol=0.12 * sd.max())
    assert abs(np.nanmean(made.crps[:, 0] - crps)) < 0.02
    np.testing.assert_allclose(made.residuals, stats.norm.ppf(made.uniforms), atol=1e-4)


def test_later_draws_have_kalmans_law_and_are_paths(noisy):
    _, made, laws = noisy
    later, exact = np.asarray(made.readings[:, N:, 0]), laws[N:]
    assert np.all(np.abs(later.mean(0) - exact[:, 0]) < 5 * np.sqrt(exact[:, 1] / 500))
    assert np.all(np.abs(later.var(0) / exact[:, 1] - 1) < 5 * np.sqrt(2 / 500))
    states = np.asarray(made.states[:, N:, 0])
    steps = states[:, 1:] - DECAY * states[:, :-1]
    assert np.all(np.abs(steps.var(0) / SPREAD - 1) < 5 * np.sqrt(2 / P))
    np.testing.assert_allclose(made.times[N:], TIMES[-1] + GAP * np.arange(1, 4), rtol=1e-6)


@pytest.mark.slow
def test_scores_add_up_to_the_log_likelihood():
    observation = jb.NegativeBinomialCounts(size=3.0)
    y = np.array([1.0, 0.0, 2.0, np.nan, 3.0, 1.0, 0.0, 1.0])
    options = dict(observation=observation, num_steps=2)
    made = jb.forecast(jax.random.key(0), OU, TIMES[:8], y, num_particles=4000, **options)
    other = jb.log_likelihood(jax.random.key(1), OU, TIMES[:8], y, num_particles=400, **options)
    assert made.trustworthy and made.readings.shape == (4000, 8, 1)
    noise = np.hypot(other.standard_error, np.sqrt(np.sum(1 / made.effective_sample_size)))
    assert abs(np.nansum(made.log_scores) - other.value) < 5 * noise


@pytest.mark.slow
def test_the_error_of_long_steps_is_told():
    """Euler steps of an Ornstein-Uhlenbeck process have normal laws, which are known."""
    later, start = np.arange(1, 4), 2.0

    def made(num_steps):
        return jb.forecast(
            KEY, OU, [0.0], [start], observation=jb.LinearGaussian(covariance=0.0), at=later,
            num_steps=num_steps, num_particles=4000, density=jb.EulerDensity(),
        )  # fmt: skip

    def error(num_steps):
        dt, exact = 1 / num_steps, np.exp(-later)
        decay = (1 - dt) ** (num_steps * later)
        sd = np.sqrt((1 - exact**2) / 2)
        simulated = np.sqrt(dt * (1 - decay**2) / (1 - (1 - dt) ** 2))
        return np.sqrt(np.max((start * (decay - exact) / sd) ** 2 + np.log(simulated / sd) ** 2))

    long, short = made(4), made(32)
    assert not long.trustworthy and "(`step_error`) exceeds" in long.why()
    assert abs(long.step_error - error(4)) < 0.5 * error(4) and error(4) > 0.1
    assert short.trustworthy
    assert abs(short.step_error - error(32)) < 2 * short.step_uncertainty < 0.1
    assert jnp.isnan(made(1).step_error) and "is unknown" in made(1).why()


def test_lost_coarse_paths_have_an_unknown_error():
    """Of a cubic drift far away, where steps of twice the size explode."""
    cubic = jb.Diffusion(lambda x, p: x - x**3, [[0.5]])
    made = jb.forecast(
        KEY, cubic, [0.0], [np.nan], observation=jb.LinearGaussian(covariance=0.1),
        initial=[3.0], at=[1.0, 2.0], num_steps=16, num_particles=100,
    )  # fmt: skip
    assert np.all(np.isfinite(made.states)) and jnp.isnan(made.step_error)
    assert not made.trustworthy


def test_an_exact_first_reading_of_a_law_that_is_not_normal():
    log_nu = lambda x, p: (2 / 0.49) * jnp.sum(x**2 / 2 - x**4 / 4)
    model = jb.Diffusion(lambda x, p: x - x**3, lambda x, p: 0.7 * jnp.ones(1), log_nu)
    made = jb.forecast(
        jax.random.key(0), model, TIMES[:3], [1.0, 0.8, 0.9], num_particles=4000,
        observation=jb.LinearGaussian(covariance=0.0),
    )  # fmt: skip
    np.testing.assert_allclose(made.filtered[:, 0], 1, atol=1e-5)
    nodes = np.linspace(-4, 4, 4001)
    weights = np.exp((2 / 0.49) * (nodes**2 / 2 - nodes**4 / 4))
    exact = np.log(np.interp(1.0, nodes, weights) / (weights.sum() * (nodes[1] - nodes[0])))
    # log ν of the model is not normalised: the score is, up to its constant.
    constant = np.log(weights.sum() * (nodes[1] - nodes[0]))
    assert abs(made.log_scores[0] - constant - exact) < 0.05


@pytest.mark.slow
def test_particles_that_leave_the_state_space_are_a_fault():
    model = jb.Diffusion(
        lambda x, p: 0.3 - x, lambda x, p: jnp.sqrt(x), domain=lambda x, p: x[0] > 0
    )
    made = jb.forecast(
        jax.random.key(0), model, TIMES[:5], [0.3, 0.2, 0.1, 0.1, 0.2], initial=[0.3],
        observation=jb.LinearGaussian(covariance=0.01),
    )  # fmt: skip
    assert np.isfinite(made.crps).all() and np.isfinite(made.residuals).all()
    assert "left the state space" in made.why()


@pytest.mark.slow
def test_exact_readings():
    """Each rank is that in the transition from the reading before."""
    y = readings(0.0)
    made = forecast(y, 0.0)
    exact = stats.norm.cdf((y[1:] - DECAY * y[:-1]) / np.sqrt(SPREAD))
    assert np.max(np.abs(made.uniforms[1:, 0] - exact)) < 5 * 0.5 / np.sqrt(P)
    laws = kalman(y, 1e-12, 0)
    score = stats.norm.logpdf(y, laws[:, 0], np.sqrt(laws[:, 1]))
    np.testing.assert_allclose(made.log_scores, score, atol=1e-3)  # one step: without noise
    np.testing.assert_allclose(made.filtered[:, :, 0], np.tile(y, (P, 1)), atol=1e-5)


def with_ranks(uniforms):
    fields = [jnp.zeros(1)] * 4, [jnp.zeros(len(uniforms))] * 5
    return jb.Forecast(*fields[0], jnp.asarray(uniforms), *fields[1])


@pytest.mark.slow
def test_both_tests_have_uniform_p_values_and_find_what_they_should():
    rng = np.random.default_rng(0)
    p_values = [with_ranks(rng.uniform(size=(150, 20))) for _ in range(10)]
    for name in ("p_uniform", "p_independent"):
        p = np.concatenate([getattr(one, name) for one in p_values])
        assert stats.kstest(p, "uniform").pvalue > 1e-4
    z = rng.normal(size=(150, 50))
    wide = with_ranks(stats.norm.cdf(1.5 * z))
    assert np.mean(wide.p_uniform < 0.05) > 0.9 and np.mean(wide.p_independent < 0.05) < 0.3
    moving = with_ranks(stats.norm.cdf((z[1:] + z[:-1]) / np.sqrt(2)))
    assert np.mean(moving.p_independent < 0.05) > 0.9


@pytest.mark.slow
def test_missing_readings_do_not_count():
    u = np.random.default_rng(1).uniform(size=(100, 1))
    gaps = np.full((130, 1), np.nan)
    gaps[:100] = u
    alternate = np.full((200, 1), np.nan)
    alternate[::2] = u
    for other in (gaps, alternate):
        for name in ("p_uniform", "p_independent"):
            made, exact = (getattr(with_ranks(ranks), name) for ranks in (other, u))
            np.testing.assert_allclose(made, exact, rtol=1e-4)
    few = np.full((60, 1), np.nan)
    few[:8] = u[:8]
    assert np.isfinite(with_ranks(few).p_independent)


WELLS = jb.Diffusion(
    lambda x, p: p[0] * x - p[2] * x**3,
    lambda x, p: p[1] * jnp.ones(1),
    params=jnp.array([1.0, 0.7, 1.0]),
)


@pytest.mark.slow
@pytest.mark.optimised
def test_ranks_are_uniform_under_the_model_and_find_what_is_wrong():
    """Records of 200 readings in two wells, with three later times: p-values, bands, and power."""
    n, number = 200, 100
    times = GAP * np.arange(n + 3)

    def record(key, heavy):
        path_key, noise_key = jax.random.split(key)
        path = jb.simulate(path_key, WELLS, [1.0], times, num_steps=10)[0]
        normal = jax.random.normal(noise_key, path.shape)
        return path + 0.2 * (jax.random.t(noise_key, 2.0, path.shape) if heavy else normal)

    @jax.jit
    def check(key, y, params):
        made = jb.forecast(
            key, WELLS.with_params(params), times[:n], y[:n], num_particles=500, num_steps=4,
            observation=jb.LinearGaussian(covariance=0.04), at=times[n:],
            initial=jb.GaussianLaw([1.0], [[0.1]]),
        )  # fmt: skip
        bands = jnp.quantile(made.readings[:, n:, 0], jnp.array([0.025, 0.25, 0.75, 0.975]), axis=0)
        later = y[n:, 0]
        inside = [
            (later > low) & (later < high) for low, high in zip(bands, bands[::-1], strict=True)
        ]
        return made.p_uniform[0], made.p_independent[0], inside[0], inside[1]

    def checked(params, heavy=False):
        records = jax.vmap(lambda key: record(key, heavy))(
            jax.random.split(jax.random.key(7), number)
        )
        keys = jax.random.split(jax.random.key(11), number)
        check_one = lambda arguments: check(*arguments, jnp.asarray(params))
        return [np.asarray(part) for part in jax.lax.map(check_one, (keys, records), batch_size=25)]

    right = [1.0, 0.7, 1.0]
    uniform, independent, wide, narrow = checked(right)
    for p in (uniform, independent):
        assert stats.kstest(p, "uniform").pvalue > 1e-3
    assert abs(wide.mean() - 0.95) < 0.05 and abs(narrow.mean() - 0.5) < 0.1
    for params, heavy in (([-2.0, 0.7, 0.0], False), ([1.0, 1.0, 1.0], False), (right, True)):
        uniform, *_ = checked(params, heavy)
        assert np.mean(uniform < 0.05) > 0.9, (params, heavy)


def test_large_counts_can_be_drawn():
    draws = jb.PoissonCounts([[1.0], [1.0]]).sample(jax.random.key(0), jnp.array([22.0]))
    assert np.all(np.abs(draws / np.exp(22) - 1) < 1e-3)
    assert np.isnan(jb.PoissonCounts().sample(jax.random.key(0), jnp.array([np.nan]))).all()


def test_refusals():
    exact = jb.LinearGaussian(covariance=0.1)
    for at in ([10.0, 9.0], [0.1]):
        with pytest.raises(ValueError, match="`at` must increase"):
            jb.forecast(jax.random.key(0), OU, TIMES[:3], np.zeros(3), observation=exact, at=at)
    seen = jb.ObservationDensity(
        lambda y, x, p: -((y - x) @ (y - x)), jb.LinearGaussian([[1.0]], 0.5)
    )
    with pytest.raises(TypeError, match="pass `sample`"):
        jb.forecast(jax.random.key(0), OU, TIMES[:3], np.zeros(3), observation=seen)
    with pytest.raises(ValueError, match="takes one record"):
        jb.forecast(
            jax.random.key(0), OU, [TIMES[:3]] * 2, [np.zeros(3)] * 2,
            observation=jb.LinearGaussian(covariance=0.1),
        )  # fmt: skip


@pytest.mark.parametrize(
    "model, law",
    [
        (jb.PoissonCounts(), stats.poisson(np.exp(0.7))),
        (jb.PoissonCounts(link="identity"), stats.poisson(0.7)),
        (jb.NegativeBinomialCounts(size=3.0), stats.nbinom(3, 3 / (3 + np.exp(0.7)))),
        (jb.StudentT(scale=0.5, df=3.0), stats.t(3, 0.7, 0.5)),
        (jb.LogNormal(scale=0.3), stats.lognorm(0.3, scale=np.exp(0.7))),
        (jb.LinearGaussian([[1.0]], 0.25, offset=0.2), stats.norm(0.9, 0.5)),
        (
            jb.ObservationDensity(
                lambda y, x, p: 0.0,
                jb.LinearGaussian([[1.0]], 1.0),
                sample=lambda key, x, p: x + jax.random.exponential(key, (1,)),
            ),
            stats.expon(0.7),
        ),
    ],
)
def test_samples_have_their_law(model, law):
    keys = jax.random.split(jax.random.key(0), 4000)
    draws = np.asarray(jax.vmap(lambda key: model.sample(key, jnp.array([0.7])))(keys))[:, 0]
    values = np.quantile(draws, [0.05, 0.3, 0.5, 0.8, 0.95])
    np.testing.assert_allclose(
        [np.mean(draws <= value) for value in values], law.cdf(values), atol=5 * 0.5 / np.sqrt(4000)
    )


def test_samples_beyond_limits_and_rounded():
    keys = jax.random.split(jax.random.key(0), 4000)
    of = lambda model: np.asarray(jax.vmap(lambda key: model.sample(key, jnp.array([0.7])))(keys))
    censored = of(jb.Censored(scale=0.5, lower=0.5, upper=1.5))
    assert abs(np.mean(censored == 0.5) - stats.norm.cdf(-0.4)) < 0.04
    assert abs(np.mean(censored == 1.5) - stats.norm.sf(1.6)) < 0.03
    rounded = of(jb.Rounded(scale=0.5, width=1.0))
    assert abs(np.mean(rounded == 1) - (stats.norm.cdf(1.6) - stats.norm.cdf(-0.4))) < 0.04


@pytest.mark.slow
def test_appended_readings_continue_the_record(noisy):
    """In two parts as in one: scores and laws are Kalman's, and no program depends on the past."""
    y, _, laws = noisy
    options = dict(observation=jb.LinearGaussian(covariance=NOISE), num_steps=1)
    first = jb.forecast(
        jax.random.key(1), OU, TIMES[:30], y[:30], num_particles=P, at=TIMES[30:33], **options
    )
    later = jb.forecast(jax.random.key(2), OU, TIMES[30:], y[30:], after=first, **options)
    assert later.states.shape == (P, N - 30, 1) and later.trustworthy
    np.testing.assert_allclose(later.times, TIMES[30:], rtol=1e-6)
    mean, sd = laws[30:N, 0], np.sqrt(laws[30:N, 1])
    exact = stats.norm.logpdf(y[30:], mean, sd)
    np.testing.assert_allclose(later.log_scores, exact, atol=0.15)
    error = 5 * sd / np.sqrt(np.append(P / 4, later.effective_sample_size[:-1]))
    np.testing.assert_array_less(np.abs(later.readings[..., 0].mean(0) - mean), error)


@pytest.mark.slow
def test_short_gaps_after_a_large_time():
    """Brownian motion, read exactly: the variance of the next reading is the gap."""
    line, begin = jb.Diffusion(lambda x, p: 0 * x), 1e5 + 0.3
    exact = {"observation": jb.LinearGaussian(covariance=0.0), "num_steps": 1}
    first = jb.forecast(KEY, line, begin + np.arange(3), np.zeros(3), initial=[0.0], **exact)
    later = jb.forecast(KEY, line, [begin + 2.01, begin + 3], np.zeros(2), after=first, **exact)
    np.testing.assert_allclose(later.states[:, 0].var(), 0.01, rtol=0.3)


@pytest.mark.slow
def test_jumps_and_transformations_of_a_continued_forecast():
    """Jumps of the past are left out; inside `jit` the time of the last reading is given."""
    doses, options = jb.Jumps([0.5, 1.0, 1.5], [9.0, 2.0, 3.0]), {"num_steps": 1}
    options["observation"] = jb.LinearGaussian(covariance=NOISE)
    first = jb.forecast(KEY, OU, [0.0, 1.0], [0.1, 3.2], jumps=doses, **options)

    def mean(after, **time):
        made = jb.forecast(KEY, OU, [2.0], [np.nan], after=after, jumps=doses, **options, **time)
        return made.states[:, 0, 0].mean()

    start = first.filtered[:, 1, 0].mean() + 2.0
    exact = start * np.exp(-1.0) + 3 * np.exp(-0.5)
    assert abs(mean(first) - exact) < 0.1
    inside = jax.jit(lambda after: mean(after, initial_time=1.0))(first)
    np.testing.assert_allclose(inside, mean(first), rtol=1e-5)
    with pytest.raises(ValueError, match="pass the time of its last reading"):
        jax.jit(mean)(first)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"initial": [0.0]}, "omit `initial`"),
        ({"num_particles": 5}, "omit `initial`"),
        ({"times": TIMES[:3]}, "must begin after the last reading"),
        ({"after": 3.0}, "a result of `forecast`"),
    ],
)
def test_what_cannot_be_appended(noisy, change, words):
    y, made, _ = noisy
    arguments = {"times": TIMES[-1] + GAP * np.arange(1, 4), "after": made} | change
    with pytest.raises((ValueError, TypeError), match=words):
        jb.forecast(
            KEY, OU, observations=y[:3], observation=jb.LinearGaussian(covariance=NOISE),
            num_steps=1, **arguments,
        )  # fmt: skip
