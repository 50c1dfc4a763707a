"""Records whose state jumps at known times, against Kalman filters that jump."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear_records import plane
from scipy import stats

import jaxbridge as jb

KEY = jax.random.key(0)
# Jumps at the first reading, at another one, between two, and at the end, where they do nothing.
INPUTS = np.array([[1.0, -0.5], [0.3, 2.0], [-1.5, 1.0], [9.0, 9.0]])


def with_jumps(record):
    """The jumps, and the same record with a missing reading and rows of jumps at all times."""
    t = record.times
    at = np.array([t[0], t[2], 0.3 * t[4] + 0.7 * t[5], t[-1]])
    whole = record._replace(
        times=np.insert(t, 5, at[2]), values=np.insert(record.values, 5, np.nan, axis=0)
    )
    rows = np.zeros((len(whole.times), 2))
    rows[[0, 2, 5, -1]] = INPUTS
    return at, whole, rows


RECORD = plane(10)
AT, WHOLE, ROWS = with_jumps(RECORD)
EXACT = WHOLE.kalman(1, exact=True, jumps=ROWS).log_likelihood


@pytest.mark.slow
def test_the_likelihood_is_kalmans():
    """By particles, and by any noise: all weights are equal."""
    jumps = jb.Jumps(AT, INPUTS)
    few = dict(num_particles=4, num_filters=2, num_steps=2)
    made = jb.log_likelihood(KEY, *RECORD.arguments, **RECORD.options, **few, jumps=jumps)
    assert abs(made.value - EXACT) < 1e-4 * abs(EXACT)
    assert made.effective_sample_size.shape == RECORD.times.shape  # not where it only jumps
    assert abs(EXACT - RECORD.kalman(1, exact=True).log_likelihood) > 1  # without jumps


@pytest.fixture(scope="module")
def paths():
    return jb.smooth(
        KEY,
        *RECORD.arguments,
        **RECORD.options,
        num_steps=4,
        num_draws=300,
        num_warmup=30,
        jumps=jb.Jumps(AT, INPUTS),
        density=jb.EulerDensity(),
    )


@pytest.mark.slow
def test_smoothed_paths_are_kalmans(paths):
    """The path at a jump is the state before it; blocks of both cuts have their jumps."""
    euler = WHOLE.kalman(4, jumps=ROWS)
    assert np.all(paths.accepted > 0.99)  # guiding is exact here
    error = np.asarray(paths.standard_error())
    grid = np.interp(np.arange(41) / 4, np.arange(11), WHOLE.times)
    np.testing.assert_allclose(paths.times, grid, rtol=1e-5)
    np.testing.assert_array_less(np.abs(paths.mean() - euler.mean), 5 * error + 1e-5)
    sd = np.sqrt(np.diagonal(euler.covariance, axis1=1, axis2=2))
    draws = np.asarray(paths.paths).reshape(-1, 41, 2)
    np.testing.assert_allclose(draws.std(0), sd, rtol=0.15)


@pytest.mark.slow
def test_the_step_error_of_a_mean_is_told(paths):
    """Pairs of steps begin after the jump: else their noise would contain it."""
    euler, exact = WHOLE.kalman(4, jumps=ROWS), WHOLE.kalman(4, exact=True, jumps=ROWS)
    true = euler.mean - exact.mean
    gap = np.abs(paths.step_error() - true)
    assert np.median(gap) < 0.5 * np.median(np.abs(true))
    np.testing.assert_array_less(gap, 0.5 * np.abs(true) + 5 * paths.step_uncertainty())


@pytest.mark.slow
def test_each_record_has_its_jumps():
    """Of several records, one without: the likelihoods multiply; splits pad the shorter ones."""
    t = RECORD.times
    both = dict(num_particles=4, num_filters=2, num_steps=2, **RECORD.options)
    made = jb.log_likelihood(
        KEY,
        RECORD.model,
        [t, t[:6], t],
        [RECORD.values, RECORD.values[:6], RECORD.values],
        **both,
        jumps=[jb.Jumps(AT, INPUTS), None, jb.Jumps(AT[1:2], INPUTS[1:2])],
    )
    short = RECORD._replace(times=t[:6], values=RECORD.values[:6])
    rows = np.zeros((10, 2))
    rows[2] = INPUTS[1]
    exact = EXACT + short.kalman(1, exact=True).log_likelihood
    exact += RECORD.kalman(1, exact=True, jumps=rows).log_likelihood
    assert abs(made.value - exact) < 2e-4 * abs(exact)


def growth(x, params):
    return params["rate"] * x


GROWTH = jb.Diffusion(
    growth, lambda x, p: p["s"] * x, params={"rate": 0.4, "s": 0.2}, domain=lambda x, p: x[0] > 0
)


@pytest.mark.slow
def test_harvests_of_a_geometric_brownian_motion():
    """Exact readings; each harvest leaves a part: the ratios of readings are log-normal."""
    times, y = np.arange(6.0), np.array([1.0, 1.4, 0.9, 1.1, 0.8, 1.3])
    leave, at = np.array([0.5, 0.8, 0.3]), [1.0, 2.4, 4.0]
    made = jb.log_likelihood(
        KEY,
        GROWTH,
        times,
        y,
        observation=jb.LinearGaussian(covariance=0.0),
        initial=y[:1],
        num_particles=500,
        jumps=jb.Jumps(at, leave, lambda x, u, p: u * x),
    )
    shift = np.log([1.0, leave[0], leave[1], 1.0, leave[2]])
    change = np.diff(np.log(y)) - shift - (0.4 - 0.02)
    exact = np.sum(stats.norm.logpdf(change, 0, 0.2) - np.log(y[1:]))
    assert made.trustworthy
    told = 4.5 * made.standard_error + abs(made.step_error) + made.step_uncertainty
    assert abs(made.value - exact) < told + 0.01


@pytest.mark.slow
def test_a_forecast_jumps():
    """Doses before the last reading and after it."""
    times, doses = np.arange(4.0), jb.Jumps([1.5, 4.5], [2.0, -3.0])
    made = jb.forecast(
        KEY,
        jb.ornstein_uhlenbeck([[1.0]]),
        times,
        [0.3, 0.1, 1.4, 0.2],
        observation=jb.LinearGaussian(covariance=0.1),
        at=[4.0, 5.0],
        num_particles=2000,
        jumps=doses,
    )
    decay, spread = np.exp(-1), (1 - np.exp(-2)) / 2
    mean, variance, means = 0.0, 0.5, []
    for k, y in enumerate([0.3, 0.1, 1.4, 0.2, np.nan, np.nan]):
        if k:
            dose = {2: 2.0, 5: -3.0}.get(k, 0.0)
            mean, variance = decay * mean + dose * np.exp(-0.5), decay**2 * variance + spread
        means.append(mean)
        if np.isfinite(y):
            gain = variance / (variance + 0.1)
            mean, variance = mean + gain * (y - mean), variance * (1 - gain)
    np.testing.assert_allclose(made.states[..., 0].mean(0), means, atol=0.08)


@pytest.mark.slow
def test_a_posterior_of_doses():
    """Elimination rate and absorbed part of three doses, by `gibbs`, against a grid."""
    rng, times = np.random.default_rng(3), 0.5 * np.arange(1, 17)
    doses = jb.Jumps([0.0, 2.2, 5.0], [5.0, 5.0, 5.0], lambda x, u, p: x + jnp.exp(p["part"]) * u)

    def level(rate, part):
        """Means and covariance of readings: a linear model without feedback of noise."""
        amount = sum(
            np.where(times > at, 5.0 * part * np.exp(-rate * (times - at)), 0)
            for at in (0.0, 2.2, 5.0)
        )
        lag = np.abs(times[:, None] - times)
        first = np.minimum(times[:, None], times)
        covariance = 0.3**2 * np.exp(-rate * lag) * (1 - np.exp(-2 * rate * first)) / (2 * rate)
        return amount, covariance + 0.2**2 * np.eye(16)

    mean, covariance = level(0.8, 0.6)
    y = rng.multivariate_normal(mean, covariance)
    model = jb.Diffusion(
        lambda x, p: -jnp.exp(p["rate"]) * x,
        jnp.asarray([0.3]),
        params={"rate": np.log(0.5), "part": np.log(0.5)},
    )
    posterior = jb.gibbs(
        KEY,
        model,
        times,
        y,
        observation=jb.LinearGaussian(covariance=0.04),
        initial=[0.0],
        initial_time=0.0,
        prior=jb.NormalPrior({"rate": 0.0, "part": 0.0}, {"rate": 1.0, "part": 1.0}),
        num_iterations=1000,
        num_warmup=500,
        num_steps=2,
        jumps=doses,
        save_states=True,
    )
    # At the 16 times of the readings, without one for the earlier `initial_time`.
    smoothed = posterior.states[:, 0, :, 0].mean(0)
    assert smoothed.shape == (16,) and np.sqrt(np.mean((smoothed - y) ** 2)) < 0.25
    rates, parts = np.linspace(-1.2, 0.8, 120), np.linspace(-1.4, 0.4, 120)
    logs = np.array(
        [
            [
                stats.multivariate_normal(*level(np.exp(r), np.exp(f))).logpdf(y)
                - (r**2 + f**2) / 2
                for f in parts
            ]
            for r in rates
        ]
    )
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    draws = np.asarray(posterior.theta).reshape(-1, 2)
    names = posterior.names
    for name, values, axis in (("rate", rates, 1), ("part", parts, 0)):
        w = weights.sum(axis)
        exact = w @ values
        sd = np.sqrt(w @ (values - exact) ** 2)
        which = next(i for i, entry in enumerate(names) if name in entry)
        size = float(np.min(np.asarray(posterior.effective_sample_size)))
        assert abs(draws[:, which].mean() - exact) < 5 * sd / np.sqrt(size) + 0.01 * sd
        assert abs(draws[:, which].std() / sd - 1) < 0.15
    assert posterior.trustworthy


@pytest.mark.parametrize(
    ("jumps", "words"),
    [
        (jb.Jumps([-1.0], INPUTS[:1]), "must not begin before"),
        (jb.Jumps([1.0], [1.0]), "shape (J, 2)"),
        ([None], "Got 1 entries, 0 of them"),
        ([1.0], "must be a `Jumps`"),
        ("doses", "must be a sequence of a `Jumps`"),
    ],
)
def test_refusals(jumps, words):
    with pytest.raises((ValueError, TypeError)) as error:
        jb.innovations(*RECORD.arguments, **RECORD.options, num_steps=1, jumps=jumps)
    assert words in str(error.value)


def test_bridges_of_a_proposal_have_no_jumps():
    with pytest.raises(ValueError, match="leave out `jumps`"):
        jb.smooth(
            KEY,
            *RECORD.arguments,
            **RECORD.options,
            proposal=jb.Guided(),
            jumps=jb.Jumps(AT, INPUTS),
        )


def test_exact_observations_name_the_way():
    with pytest.raises(ValueError, match="`jumps`"):
        jb.gibbs(
            KEY,
            RECORD.model,
            RECORD.times,
            np.nan_to_num(RECORD.values),
            where=lambda p: p.B,
            prior=jb.NormalPrior(1.0, 1.0),
            jumps=jb.Jumps(AT, INPUTS),
        )
