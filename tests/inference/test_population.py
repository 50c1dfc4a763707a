"""Parameters that vary between records: against the posterior in closed form, on a grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb

GAP, NOISE, NUM = 0.4, 0.2, 12
LEVEL = lambda params: params["level"]
MODEL = jb.Diffusion(lambda x, p: p["level"] - x, [0.5], params={"level": 0.0})
OPTIONS = dict(
    observation=jb.LinearGaussian(covariance=NOISE**2), initial=jb.GaussianLaw([0.0], [[1.0]]),
    prior=jb.NormalPrior(0.0, 4.0), num_steps=1,
)  # fmt: skip


def panel():
    """Times and values of records of unequal length, with levels of their own."""
    rng, decay = np.random.default_rng(0), np.exp(-GAP)
    times, values = [], []
    for number in range(NUM):
        level, x, seen = 0.5 + 0.7 * rng.normal(), rng.normal(), []
        for _ in range(12 - number % 3):
            seen.append(x + NOISE * rng.normal())
            x = level + (x - level) * decay + np.sqrt((1 - decay**2) / 8) * rng.normal()
        times.append(GAP * np.arange(len(seen)))
        values.append(np.array(seen)[:, None])
    return times, values


def exact_posterior(times, values):
    """Means and sds of the population's mean and log sd, and the mean of each record's level.

    Given its level m a record is normal with the mean (1 - e^{-t}) m."""
    means, log_sds = np.linspace(-2, 3, 201), np.linspace(-4, 1.5, 201)
    variance, centre = np.exp(2 * log_sds), means[:, None]
    log_posterior = -(centre**2) / 8 + log_sds - variance / 2
    levels = []
    for t, y in zip(times, values, strict=True):
        early, late = np.minimum.outer(t, t), np.maximum.outer(t, t)
        covariance = np.exp(-early - late) + np.exp(early - late) / 8 - np.exp(-early - late) / 8
        a, covariance = 1 - np.exp(-t), covariance + NOISE**2 * np.eye(len(t))
        precision, weighted = a @ np.linalg.solve(covariance, np.stack([a, y[:, 0]], axis=1))
        spread = variance + 1 / precision
        log_posterior = log_posterior - np.log(spread) / 2
        log_posterior -= (weighted / precision - centre) ** 2 / (2 * spread)
        levels.append((centre / variance + weighted) / (1 / variance + precision))
    weights = np.exp(log_posterior - log_posterior.max())
    weights /= weights.sum()
    moments = []
    for grid, mass in ((means, weights.sum(1)), (log_sds, weights.sum(0))):
        moments.append((mass @ grid, np.sqrt(mass @ (grid - mass @ grid) ** 2)))
    return np.array(moments).T, np.array([np.sum(weights * level) for level in levels])


@pytest.mark.slow
def test_posterior_is_that_of_the_grid():
    data = panel()
    (mean, sd), levels = exact_posterior(*data)
    made = jb.gibbs(
        jax.random.key(0), MODEL, *data, **OPTIONS, population=jb.NormalPopulation(LEVEL),
        num_iterations=1000, num_chains=4,
    )  # fmt: skip
    assert made.names == ("level", "log_sd(level)") and made.trustworthy
    error, theta = np.asarray(made.standard_error), np.asarray(made.theta).reshape(-1, 2)
    np.testing.assert_array_less(error, 0.05 * sd)
    np.testing.assert_array_less(np.abs(theta.mean(0) - mean), 5 * error)
    np.testing.assert_allclose(theta.std(0), sd, rtol=0.1)
    of_units = made.unit_params["level"]
    assert of_units.shape == (4, 1000, NUM) and made.params["level"].shape == (4, 1000)
    of_units = np.asarray(of_units).reshape(-1, NUM)
    size = np.asarray(jb.effective_sample_size(np.asarray(made.unit_params["level"]), chains=True))
    error = of_units.std(0) / np.sqrt(size)
    np.testing.assert_array_less(np.abs(of_units.mean(0) - levels), 5 * error)


def test_what_does_not_fit_is_refused():
    times, values = panel()
    with pytest.raises(TypeError, match="`population` must be a `NormalPopulation`"):
        jb.gibbs(jax.random.key(0), MODEL, times, values, **OPTIONS, population=LEVEL)
    one = jb.NormalPopulation(LEVEL)
    with pytest.raises(ValueError, match="there is one record"):
        jb.gibbs(jax.random.key(0), MODEL, times[0], values[0], **OPTIONS, population=one)
    with pytest.raises(ValueError, match="one entry for each of level"):
        two = jb.NormalPopulation(LEVEL, spread=jnp.ones(2))
        jb.gibbs(jax.random.key(0), MODEL, times, values, **OPTIONS, population=two)
    fixed = MODEL.with_params({"level": 0.0, "other": jnp.ones(2)})
    with pytest.raises(ValueError, match=r"are level; it selected other\[0\], other\[1\]"):
        jb.gibbs(
            jax.random.key(0), fixed, times, values, **OPTIONS, where=LEVEL,
            population=jb.NormalPopulation(lambda params: params["other"]),
        )  # fmt: skip
    with pytest.raises(ValueError, match="`spread` must be positive"):
        jb.NormalPopulation(LEVEL, spread=0.0)
