"""States that move with the bridges on both sides: against Gaussian conditioning, and against
Kolmogorov's equation where the diffusion may have gone several ways."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NON_REVERSIBLE
from scipy.linalg import expm, solve_continuous_lyapunov

import jaxbridge as jb

KEY = jax.random.key(0)


def conditioned(B, matrix, variance, times, values, at):
    """Means and sds at the times `at` of the stationary process dX = -BX dt + dW, of which
    `matrix` X + noise was seen."""
    S = solve_continuous_lyapunov(B, np.eye(len(B)))

    def covariance(s, t):
        return expm(-B * (s - t)) @ S if s >= t else S @ expm(-B * (t - s)).T

    def block(first, second):
        return np.block([[covariance(s, t) for t in second] for s in first])

    seen = np.isfinite(values).all(1)
    L = np.kron(np.eye(seen.sum()), matrix)
    among = L @ block(times[seen], times[seen]) @ L.T + variance * np.eye(len(L))
    gain = np.linalg.solve(among, L @ block(times[seen], at)).T
    mean = gain @ values[seen].ravel()
    left = block(at, at) - gain @ L @ block(times[seen], at)
    return mean.reshape(len(at), -1), np.sqrt(np.diag(left)).reshape(len(at), -1)


def assert_agrees(made, mean, sd):
    """Means and squares within 4.5 standard errors, at all points of the grid."""
    assert not made.stuck.any() and made.num_truncated == 0
    for power, exact in ((1, mean), (2, mean**2 + sd**2)):
        fn = lambda path, power=power: path**power
        error = np.asarray(made.standard_error(fn))
        assert (error < 0.06).all()
        np.testing.assert_array_less(np.abs(made.mean(fn) - exact), 4.5 * error)


TIMES = np.array([0.0, 1.5, 2.5, 5.0, 7.0])


@pytest.mark.slow
def test_states_stay_in_the_state_space():
    """The last one as well, of which no bridge begins; and what was seen is a function of the
    parameters as they are, not as they were prepared."""
    model = jb.Diffusion(
        lambda x, p: p[0] - x, params={"level": 0.2, "noise": 1.0}, domain=lambda x, p: x[0] > p[1],
        prepare=lambda params: (params["level"], -0.1 + 0 * params["noise"]),
        sample_stationary=lambda key, p: 0.2 + jax.random.normal(key, (1,)) / jnp.sqrt(2),
    )  # fmt: skip
    seen = jb.ObservationDensity(
        lambda y, x, params: -((y[0] - x[0]) ** 2) / params["noise"], jb.LinearGaussian(None, 0.5)
    )
    made = jb.smooth(
        KEY, model, [0.0, 0.5, 1.0], np.full((3, 1), -0.5), observation=seen, num_steps=2,
        initial=lambda params: [params["level"]], num_draws=100, num_warmup=20, num_chains=2,
        num_proposals=2, proposal=jb.ModifiedDiffusionBridge(),
    )  # fmt: skip
    assert np.all(made.paths > -0.1) and not np.any(made.stuck)


@pytest.mark.slow
def test_part_of_a_process_that_turns():
    B, matrix = NON_REVERSIBLE, np.array([[1.0, -0.5]])
    values = np.array([[0.8], [-0.5], [np.nan], [1.2], [0.1]])
    made = jb.smooth(
        KEY, jb.ornstein_uhlenbeck(B), TIMES, values,
        observation=jb.LinearGaussian(matrix, covariance=0.2),
        num_steps=20, num_draws=500, num_warmup=100, proposal=jb.Coupling(0.5),
    )  # fmt: skip
    exact = conditioned(B, matrix, 0.2, TIMES, values, np.asarray(made.times, float))
    assert_agrees(made, *exact)
    # The steps of bridges of linear models are exact, too.
    assert np.all(made.step_error() == 0)
