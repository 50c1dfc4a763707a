"""What is told of the step error of a record's likelihood, against exact Kalman filters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow_beyond
from kalman import euler_step, kalman
from linear_records import LinearRecord, four, plane

import jaxbridge as jb
from jaxbridge.schemes import error_of_grids, num_coarse_grids, share_of_grid
from jaxbridge.schemes.coarse_grids import steps_of_grid


def line() -> LinearRecord:
    """An Ornstein–Uhlenbeck process, not seen once."""
    values = np.random.default_rng(5).normal(size=(30, 1))
    values[7] = np.nan
    one = np.eye(1)
    return LinearRecord(
        one, one, 0.4 * np.arange(30), values, one, 0.09 * one, np.zeros(1), one / 2
    )


RECORDS = {"plane": plane, "exact part": lambda: plane(exact_part=True), "line": line, "four": four}
DENSITIES = {"euler": jb.EulerDensity(), "ito_taylor": jb.ItoTaylorDensity()}


def ito_taylor_step(A, V):
    """Of second order: N(x + βδ + ½δ² Lβ, δI + ½δ²(A + Aᵀ) + ⅓δ³ AAᵀ) for σ = I."""
    d, sigma = len(A), np.linalg.cholesky(V)
    slope = -np.linalg.solve(sigma, A @ sigma)

    def step(dt):
        mean = np.eye(d) - A * dt + A @ A * dt**2 / 2
        spread = np.eye(d) * dt + (slope + slope.T) * dt**2 / 2 + slope @ slope.T * dt**3 / 3
        return mean, sigma @ spread @ sigma.T

    return step


def of_grid(record, law, num_steps, level):
    """log p of the chain on a grid, by Kalman's filter with all steps of an interval as one."""
    one = law(record.A, record.sigma @ record.sigma.T)

    def step(dt):
        decay, spread = np.eye(len(record.A)), np.zeros_like(record.A)
        for parts in steps_of_grid(num_steps * (1.0,), level):
            mine, noise = one(dt / num_steps * parts)
            decay, spread = mine @ decay, mine @ spread @ mine.T + noise
        return decay, spread

    seen = (record.times, record.values, record.matrix, record.noise)
    return kalman(step, *seen, record.mean, record.covariance, 1).log_likelihood


@pytest.mark.parametrize("name", RECORDS)
@pytest.mark.parametrize("order", [1, 2], ids=DENSITIES)
def test_what_is_told_covers_the_error(name, order, x64):
    """No error is beyond what is told and twice its uncertainty; and what is told itself is off by
    no more, but where two orders cancel. Of second order it is known well."""
    record, law = RECORDS[name](), [euler_step, ito_taylor_step][order - 1]
    exact = record.kalman(1, exact=True).log_likelihood
    for num_steps in (2, 3, 4, 5, 6, 7, 10, 20, 40):
        levels = range(1 + num_coarse_grids(num_steps))
        values = np.array([of_grid(record, law, num_steps, level) for level in levels])
        made = error_of_grids(jnp.array(values), jnp.zeros(len(values)), order, num_steps * (1,))
        true, told, doubt = values[0] - exact, float(made.value), float(made.uncertainty)
        assert abs(true) <= abs(told) + 2 * doubt
        if order == 2 or name in ("line", "exact part"):
            assert abs(told - true) < 2 * doubt
        if order == 2 and num_steps >= 3:
            assert doubt < 0.6 * abs(told)
        if name == "line" and num_steps >= 4:
            assert doubt < 0.4 * abs(told)


CASES = [("plane", "euler", 10), ("exact part", "ito_taylor", 10)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "density", "num_steps"), slow_beyond(1, CASES))
def test_filters_tell_it(name, density, num_steps, x64):
    """All weights are equal, so that nothing hides it."""
    record = RECORDS[name]()
    made = jb.log_likelihood(
        jax.random.key(0), *record.arguments, **record.options, num_steps=num_steps,
        num_particles=2, num_filters=2, density=DENSITIES[density],
    )  # fmt: skip
    law = {"euler": euler_step, "ito_taylor": ito_taylor_step}[density]
    levels = range(1 + num_coarse_grids(num_steps))
    values = jnp.array([of_grid(record, law, num_steps, level) for level in levels])
    order = DENSITIES[density].order
    wanted = error_of_grids(values, jnp.zeros(len(values)), order, num_steps * (1,))
    np.testing.assert_allclose(made.value, values[0], rtol=1e-9)
    np.testing.assert_allclose(made.step_error, wanted.value, rtol=1e-6)
    np.testing.assert_allclose(made.step_uncertainty, wanted.uncertainty, rtol=1e-5)


@pytest.mark.slow
def test_smoothed_paths_tell_it():
    """Means and squares at the times of observations: what half as many steps change, by exact
    smoothers of both grids."""
    record, num_steps = plane(), 4
    made = jb.smooth(
        jax.random.key(0), *record.arguments, **record.options, num_steps=num_steps,
        num_draws=4000, num_warmup=20, density=jb.EulerDensity(),
    )  # fmt: skip

    def moment(power, n):
        one = record.kalman(n)
        variance = np.diagonal(one.covariance[::n], 0, 1, 2)
        return one.mean[::n] ** power + (power - 1) * variance

    for power in (1, 2):
        fn = lambda path, power=power: path[::num_steps] ** power
        told, doubt = np.asarray(made.step_error(fn)), np.asarray(made.step_uncertainty(fn))
        true = moment(power, num_steps) - moment(power, 200)
        # Its leading term, and what Monte Carlo leaves of it.
        np.testing.assert_array_less(np.abs(told - true), 4.5 * doubt + 0.5 * np.abs(true).max())
        assert np.max(np.abs(told) / doubt) > 10
        # To second order in what they change.
        change = moment(power, 2) - moment(power, 4)
        allowance = 4.5 * doubt + 0.15 * np.abs(change).max()
        np.testing.assert_array_less(np.abs(told - change), allowance)


def smoothed_of_steps(num_steps, density=None):
    """Paths of a model whose σ varies."""
    varying = jb.Diffusion(lambda x, p: -x, lambda x, p: 1 + 0.3 * jnp.sin(x))
    return jb.smooth(
        jax.random.key(0), varying, [0.0, 0.5], [[0.3], [0.1]], num_steps=num_steps,
        observation=jb.LinearGaussian(covariance=0.1), initial=[0.3],
        num_draws=6, num_warmup=0, num_chains=2, density=density,
    )  # fmt: skip


@pytest.mark.slow
def test_where_sigma_varies_all_of_the_step_error_is_in_doubt():
    made = smoothed_of_steps(2)
    told, doubt = np.abs(made.step_error()), np.asarray(made.step_uncertainty())
    assert np.isfinite(told).all() and np.all(doubt >= told) and np.max(told) > 0


@pytest.mark.slow
def test_of_smoothed_paths_of_one_step_nothing_is_known():
    """But a step of second order is split."""
    assert np.isfinite(smoothed_of_steps(1).step_error()).all()
    made = smoothed_of_steps(1, jb.EulerDensity())
    assert np.isnan(made.step_error()).all() and np.isnan(made.step_uncertainty()).all()


# Sums of orders 1 and 2 of steps of length 1/N.
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("num_steps", [3, 4, 5, 10, 21])
@pytest.mark.parametrize("next_order", [-3.0, 0.5, 4.0])
def test_two_orders_are_covered(order, num_steps, next_order, x64):
    def value(level):
        longest = 2**level
        steps = np.array([num_steps % longest] + [longest] * (num_steps // longest)) / num_steps
        return np.sum(steps ** (order + 1) + next_order * steps ** (order + 2))

    made = error_of_grids(
        jnp.array([value(level) for level in range(3)]), jnp.zeros(3), order, num_steps * (1,)
    )
    assert abs(made.value - value(0)) <= 2 * made.uncertainty
    exact = share_of_grid(order, num_steps * (1,)) * (value(1) - value(0))
    np.testing.assert_allclose(made.value, exact)
    if next_order == 0.5 and num_steps == 21:
        assert made.uncertainty < 0.3 * abs(made.value)


def test_what_disagrees_is_unknown():
    """Changes that go to and fro, or grow, or that no grid has; noise alone is no change."""
    told = lambda values, noise=0.0, num_steps=8: error_of_grids(
        jnp.array(values), jnp.full(len(values), noise), 1, num_steps * (1,)
    )
    for values in ([0, 1, -1.0], [0, 2, 3.0], [0, 1, -jnp.inf], [0, 1, jnp.nan]):
        assert told(values).uncertainty == jnp.inf
    noisy = told([0, 0.1, 0.05], 0.1)
    assert 0.14 < noisy.uncertainty < 0.2
    assert told([0, 1, 3.0], jnp.inf).uncertainty == jnp.inf
    assert told([0, 0, 0.0]) == (0, 0)
    assert told([0, 1.0], num_steps=2) == (1, 1)
    assert np.isnan(told([0.0], num_steps=1)).all()


def test_an_odd_number_of_steps():
    """One of them has no other, and changes nothing."""
    assert share_of_grid(1, 3 * (1,)) == 3 / 2 and share_of_grid(1, 5 * (1,)) == 5 / 4
    assert share_of_grid(2, 4 * (1,)) == 1 / 3 and share_of_grid(1, 4 * (1,)) == 1


def test_steps_of_different_lengths():
    """Pairs are joined from the last step on, and the share follows from all lengths."""
    lengths = (1.0, 1.0, 0.5, 0.25, 0.25)
    assert steps_of_grid(lengths, 1) == [1.0, 1.5, 0.5]
    assert steps_of_grid(lengths, 2) == [1.0, 2.0]
    fine, coarse = 2 + 0.5**3 + 2 * 0.25**3, 1 + 1.5**3 + 0.5**3
    np.testing.assert_allclose(share_of_grid(2, lengths), fine / (coarse - fine))
