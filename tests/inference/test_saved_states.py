"""States at observations in the draws of `gibbs`, whose law includes that of the parameters, and
leave-one-out densities."""

import arviz
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kalman import exact_step, kalman
from scipy.special import logsumexp

import jaxbridge as jb

KEY, VARIANCE, NOISE, SD = jax.random.key(0), 0.49, 0.09, 0.5
TIMES = [0.5 * np.arange(12), 0.7 * np.arange(6)]
MODEL = jb.Diffusion(lambda x, p: -jnp.exp(p) * x, [np.sqrt(VARIANCE)], params=0.0)
RECORD = {
    "observation": jb.LinearGaussian(covariance=NOISE),
    "initial": jb.GaussianLaw([0.0], [[1.0]]),
    "num_steps": 2,
    "prior": jb.NormalPrior(0.0, SD**2),
}


def readings():
    rng, made = np.random.default_rng(0), []
    for i, times in enumerate(TIMES):
        path = jb.simulate(jax.random.key(i), MODEL, [0.5], times)[0]
        made.append(np.array(path) + 0.3 * rng.normal(size=path.shape))
    made[0][4] = np.nan
    return made


GRID = np.linspace(-2, 2, 81)


def kalman_on_grid(values):
    """Log of prior times likelihood for each θ, and smoothed means and variances of each record."""
    laws, logs = [], []
    for theta in GRID:
        step = exact_step(np.array([[np.exp(theta)]]), np.array([[VARIANCE]]))
        one = [
            kalman(step, t, y, np.eye(1), NOISE * np.eye(1), np.zeros(1), np.eye(1), 1)
            for t, y in zip(TIMES, values, strict=True)
        ]
        laws.append([(each.mean[:, 0], each.covariance[:, 0, 0]) for each in one])
        logs.append(sum(each.log_likelihood for each in one) - theta**2 / (2 * SD**2))
    return np.array(logs), laws


def exact_states(logs, laws):
    """Means and sds of the states of each record."""
    weights = np.exp(logs - max(logs))
    weights /= weights.sum()
    for i in range(len(TIMES)):
        mean, variance = (np.array([law[i][k] for law in laws]) for k in (0, 1))
        total = weights @ mean
        yield total, np.sqrt(weights @ (variance + mean**2) - total**2)


def exact_left_out(logs, values):
    """Log density of each reading given all others."""
    for i, record in enumerate(values):
        for k in np.flatnonzero(~np.isnan(record[:, 0])):
            others = [each.copy() for each in values]
            others[i][k] = np.nan
            yield logsumexp(logs) - logsumexp(kalman_on_grid(others)[0])


@pytest.mark.slow
def test_states_have_the_law_given_all_that_was_seen():
    values = readings()
    made = jb.gibbs(
        KEY, MODEL, TIMES, values, num_iterations=2000, num_chains=2, save_states=True, **RECORD
    )
    logs, laws = kalman_on_grid(values)
    states = np.asarray(made.states, float)
    assert states.shape == (2, 2000, 2, 12, 1) and np.isnan(states[:, :, 1, 6:]).all()
    for i, (mean, sd) in enumerate(exact_states(logs, laws)):
        draws = states[:, :, i, : len(mean), 0]
        size = np.asarray(jb.effective_sample_size(draws, chains=True))
        draws = draws.reshape(-1, len(mean))
        np.testing.assert_array_less(np.abs(draws.mean(0) - mean), 4.5 * sd / np.sqrt(size))
        np.testing.assert_allclose(draws.std(0) / sd, 1, atol=0.1)
    group = made.to_arviz().log_likelihood["observations"]
    assert group.shape == (2, 2000, 17) and np.isfinite(group.values).all()
    assert group.dims[2] == "reading" and list(group.reading.values[[3, 4, -1]]) == [
        "record 0, time 3", "record 0, time 5", "record 1, time 5",
    ]  # fmt: skip
    # Leave-one-out densities by Pareto smoothed importance sampling, without refits.
    left_out = arviz.loo(made.to_arviz(), pointwise=True)
    assert np.max(left_out.pareto_k) < 0.7
    exact = np.array(list(exact_left_out(logs, values)))
    np.testing.assert_allclose(np.asarray(left_out.loo_i), exact, atol=0.03)
    assert made.to_xarray().states.dims == ("chain", "draw", "record", "time", "state")


def test_exact_observations_are_their_states():
    with pytest.raises(ValueError, match="`save_states`: only for records"):
        jb.gibbs(
            KEY, MODEL, TIMES[1], np.ones(6), prior=RECORD["prior"], num_iterations=2,
            save_states=True,
        )  # fmt: skip
