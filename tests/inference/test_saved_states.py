"""States at observations in the draws of `gibbs`: their law includes that of the parameters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kalman import exact_step, kalman
from scipy import stats

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


def exact_states(values):
    """Means and sds of the states of each record, on a grid of θ."""
    grid, laws, logs = np.linspace(-2, 2, 81), [], []
    for theta in grid:
        step = exact_step(np.array([[np.exp(theta)]]), np.array([[VARIANCE]]))
        one = [
            kalman(step, t, y, np.eye(1), NOISE * np.eye(1), np.zeros(1), np.eye(1), 1)
            for t, y in zip(TIMES, values, strict=True)
        ]
        laws.append([(each.mean[:, 0], each.covariance[:, 0, 0]) for each in one])
        logs.append(sum(each.log_likelihood for each in one) - theta**2 / (2 * SD**2))
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    for i in range(len(TIMES)):
        mean, variance = (np.array([law[i][k] for law in laws]) for k in (0, 1))
        total = weights @ mean
        yield total, np.sqrt(weights @ (variance + mean**2) - total**2)


@pytest.mark.slow
def test_states_have_the_law_given_all_that_was_seen():
    values = readings()
    made = jb.gibbs(
        KEY, MODEL, TIMES, values, num_iterations=2000, num_chains=2, save_states=True, **RECORD
    )
    states, logs = np.asarray(made.states, float), np.asarray(made.log_densities)
    assert states.shape == (2, 2000, 2, 12, 1) and np.isnan(states[:, :, 1, 6:]).all()
    for i, (mean, sd) in enumerate(exact_states(values)):
        draws = states[:, :, i, : len(mean), 0]
        size = np.asarray(jb.effective_sample_size(draws, chains=True))
        draws = draws.reshape(-1, len(mean))
        np.testing.assert_array_less(np.abs(draws.mean(0) - mean), 4.5 * sd / np.sqrt(size))
        np.testing.assert_allclose(draws.std(0) / sd, 1, atol=0.1)
        expected = stats.norm.logpdf(values[i][:, 0], draws, np.sqrt(NOISE))
        of_record = logs[:, :, i, : len(mean)].reshape(-1, len(mean))
        np.testing.assert_allclose(of_record, expected, atol=1e-4)
    group = made.to_arviz().log_likelihood["observations"]
    assert group.shape == (2, 2000, 17) and np.isfinite(group.values).all()
    assert group.dims[2] == "reading" and list(group.reading.values[[3, 4, -1]]) == [
        "record 0, time 3", "record 0, time 5", "record 1, time 5",
    ]  # fmt: skip
    assert made.to_xarray().states.dims == ("chain", "draw", "record", "time", "state")


def test_exact_observations_are_their_states():
    with pytest.raises(ValueError, match="`save_states`: only for records"):
        jb.gibbs(
            KEY, MODEL, TIMES[1], np.ones(6), prior=RECORD["prior"], num_iterations=2,
            save_states=True,
        )  # fmt: skip
