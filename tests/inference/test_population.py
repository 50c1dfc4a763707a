"""Parameters that vary between records: against the posterior in closed form, on a grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.inference.parameters import Parameters
from jaxbridge.inference.population import as_population

GAP, NOISE, NUM = 0.4, 0.2, 12
LEVEL = lambda params: params["level"]
MODEL = jb.Diffusion(
    lambda x, p: jnp.exp(p["log_rate"]) * (p["level"] - x), [0.5],
    params={"level": 0.0, "log_rate": 0.0},
)  # fmt: skip
OPTIONS = dict(
    observation=jb.LinearGaussian(covariance=NOISE**2), initial=jb.GaussianLaw([0.0], [[1.0]]),
    prior=jb.NormalPrior({"level": 0.0, "log_rate": 0.0}, {"level": 4.0, "log_rate": 0.25}),
    num_steps=1,
)  # fmt: skip


def panel():
    """Times and values of records of unequal length, with levels of their own and the rate one."""
    rng, decay = np.random.default_rng(0), np.exp(-GAP)
    times, values = [], []
    for number in range(NUM):
        level, x, seen = 0.5 + 1.2 * rng.normal(), rng.normal(), []
        for _ in range(12 - number % 3):
            seen.append(x + NOISE * rng.normal())
            x = level + (x - level) * decay + np.sqrt((1 - decay**2) / 8) * rng.normal()
        times.append(GAP * np.arange(len(seen)))
        values.append(np.array(seen)[:, None])
    return times, values


def exact_posterior(times, values):
    """Means and sds of (level, log_rate, log_sd), and the mean of each record's level.

    Given its level m and the rate a record is normal with the mean (1 - e^{-rate t}) m."""
    grids = np.linspace(-2, 3, 81), np.linspace(-1.8, 1.5, 67), np.linspace(-2.5, 1.5, 81)
    centre, log_sd = grids[0][:, None], grids[2]
    variance = np.exp(2 * log_sd)
    log_posterior = np.zeros((81, 67, 81))
    levels = np.zeros((NUM, 81, 67, 81))
    for i, log_rate in enumerate(grids[1]):
        rate, logs = np.exp(log_rate), -(centre**2) / 8 + log_sd - variance / 2 - 2 * log_rate**2
        for number, (t, y) in enumerate(zip(times, values, strict=True)):
            ages = rate * t
            early, late = np.minimum.outer(ages, ages), np.maximum.outer(ages, ages)
            both = np.exp(-early - late)
            covariance = both + (np.exp(early - late) - both) / (8 * rate)
            covariance += NOISE**2 * np.eye(len(t))
            a, y = 1 - np.exp(-ages), y[:, 0]
            solved = np.linalg.solve(covariance, np.stack([a, y], axis=1))
            precision, weighted = a @ solved
            logs = logs - np.linalg.slogdet(covariance)[1] / 2 - y @ solved[:, 1] / 2
            logs += weighted**2 / precision / 2 - np.log(precision) / 2
            spread = variance + 1 / precision
            logs = logs - np.log(spread) / 2
            logs -= (weighted / precision - centre) ** 2 / (2 * spread)
            shrunk = (centre / variance + weighted) / (1 / variance + precision)
            levels[number, :, i] = shrunk
        log_posterior[:, i] = logs
    weights = np.exp(log_posterior - log_posterior.max())
    weights /= weights.sum()
    moments = []
    for axis, grid in enumerate(grids):
        mass = weights.sum(tuple(other for other in range(3) if other != axis))
        moments.append((mass @ grid, np.sqrt(mass @ (grid - mass @ grid) ** 2)))
    return np.array(moments).T, np.tensordot(levels, weights, 3)


@pytest.mark.slow
def test_posterior_is_that_of_the_grid():
    data = panel()
    (mean, sd), levels = exact_posterior(*data)
    made = jb.gibbs(
        jax.random.key(0), MODEL, *data, **OPTIONS, population=jb.NormalPopulation(LEVEL),
        num_iterations=1000, num_chains=4,
    )  # fmt: skip
    assert made.names == ("level", "log_rate", "log_sd(level)") and made.trustworthy
    error, theta = np.asarray(made.standard_error), np.asarray(made.theta).reshape(-1, 3)
    np.testing.assert_array_less(error, 0.13 * sd)
    np.testing.assert_array_less(np.abs(theta.mean(0) - mean), 5 * error)
    np.testing.assert_allclose(theta.std(0), sd, rtol=0.2)
    of_units = made.unit_params["level"]
    assert of_units.shape == (4, 1000, NUM) and made.params["level"].shape == (4, 1000)
    size = np.asarray(jb.effective_sample_size(np.asarray(of_units), chains=True))
    of_units = np.asarray(of_units).reshape(-1, NUM)
    error = of_units.std(0) / np.sqrt(size)
    np.testing.assert_array_less(np.abs(of_units.mean(0) - levels), 5 * error)
    draws = made.to_arviz().posterior
    assert "log_sd(level)" in draws
    assert made.to_xarray()["unit_params.level"].dims == ("chain", "draw", "record")
    np.testing.assert_array_equal(draws["unit_params.level"].values.reshape(-1, NUM), of_units)


def test_entries_of_arrays_may_vary():
    params = {"B": jnp.eye(2), "rates": jnp.ones(3), "count": 3}
    parameters = Parameters(jb.Diffusion(lambda x, p: -x, params=params), None)
    varies = lambda per_unit: (
        as_population(jb.NormalPopulation(per_unit), parameters, jnp.sum, 2).varies
    )
    assert varies(lambda p: p["B"][0]) == (0, 1)
    assert varies(lambda p: (p["B"][:, 1], p["rates"][2])) == (1, 3, 6)
    for wrong in (lambda p: (p["rates"], p["rates"][0]), lambda p: p["count"]):
        with pytest.raises(ValueError, match="each at most once; it selected"):
            varies(wrong)


def test_each_spread_moves_alone_between_moves_of_theta():
    parameters = Parameters(
        jb.Diffusion(lambda x, p: -x, params={"a": 0.0, "b": 0.0, "c": 0.0}), None
    )
    turns = lambda population: [
        list(map(int, as_population(population, parameters, jnp.sum, 2).moves(jnp.int32(i))))
        for i in range(4)
    ]
    theta, first, second = [1, 1, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]
    assert turns(jb.NormalPopulation(lambda p: (p["a"], p["c"]))) == [theta, first, theta, second]
    assert turns(None) == 4 * [[1, 1, 1]]


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
    fixed = MODEL.with_params({"level": 0.0, "log_rate": 0.0, "other": jnp.ones(2)})
    with pytest.raises(ValueError, match=r"unknown, level, .* it selected other\[0\], other\[1\]"):
        jb.gibbs(
            jax.random.key(0), fixed, times, values, where=LEVEL,
            **OPTIONS | {"prior": jb.NormalPrior(0.0, 1.0)},
            population=jb.NormalPopulation(lambda params: params["other"]),
        )  # fmt: skip
    with pytest.raises(ValueError, match="`spread` must be positive and finite"):
        jb.NormalPopulation(LEVEL, spread=0.0)
