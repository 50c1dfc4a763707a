"""Noise that reaches only a part of the state: linear models against Kalman's filter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import loglog_slope
from kalman import euler_step, exact_step, kalman

import jaxbridge as jb
from jaxbridge.engine.linalg import semidefinite_factor

KEY = jax.random.key(0)


def ito_taylor_step(A, V):
    """Of dX = -A X dt + noise of covariance V, as the expansion of second order makes it."""
    F = -A

    def step(dt):
        flow = F @ V
        spread = dt * V + dt**2 / 2 * (flow + flow.T) + dt**3 / 3 * flow @ F.T
        return np.eye(len(A)) + dt * F + dt**2 / 2 * F @ F, spread

    return step


class Case:
    """A linear model with noise in its second coordinate, of which the first is seen."""

    def __init__(self, A, model, noise, num=25):
        rng = np.random.default_rng(0)
        self.A, self.model = np.asarray(A), model
        self.V = np.diag([0.0, 0.8**2])
        self.mean, self.covariance = np.array([0.5, -0.2]), np.array([[0.4, 0.1], [0.1, 0.3]])
        self.times = np.cumsum(rng.uniform(0.1, 0.4, num))
        step, state = (
            exact_step(self.A, self.V),
            rng.multivariate_normal(self.mean, self.covariance),
        )
        values = []
        for gap in np.diff(self.times, prepend=self.times[0]):
            decay, spread = step(round(gap, 12))
            state = rng.multivariate_normal(decay @ state, spread)
            values.append(state[:1] + noise * rng.normal(size=1))
        self.values = np.array(values)
        self.values[3] = self.values[8] = np.nan
        self.noise = np.array([[noise**2]])
        self.matrix = np.array([[1.0, 0.0]])

    @property
    def arguments(self):
        return self.model, self.times, self.values

    @property
    def options(self):
        return {
            "observation": jb.LinearGaussian(self.matrix, self.noise),
            "initial": jb.GaussianLaw(self.mean, self.covariance),
        }

    def kalman(self, num_steps, of=exact_step, values=None, matrix=None, noise=None):
        seen = self.values if values is None else values
        matrix = self.matrix if matrix is None else matrix
        noise = self.noise if noise is None else noise
        law = self.mean, self.covariance
        return kalman(of(self.A, self.V), self.times, seen, matrix, noise, *law, num_steps)


def integral(noise):
    return Case([[0.0, -1.0], [0.0, 1.5]], integral_model(), noise)


def oscillator(noise):
    return Case([[0.0, -1.0], [4.0, 0.5]], oscillator_model(), noise)


# One model for all tests, which then share its programs. It is made in the precision of a test.
def integral_model():
    return jb.integrated(jb.ornstein_uhlenbeck([[1.5]], sigma=[[0.8]]))


def oscillator_model():
    return jb.Diffusion(oscillator_drift, [[0.0], [0.8]])


def oscillator_drift(x, p):
    return jnp.stack([x[1], -4.0 * x[0] - 0.5 * x[1]])


@pytest.mark.slow
@pytest.mark.parametrize(
    "case, noise",
    [(oscillator, 3e-4), (oscillator, 0.3), (oscillator, 0.03), (integral, 0.3), (integral, 3e-4)],
)
def test_the_filter_is_kalmans(case, noise, x64):
    """Steps of a linear model have no discretisation error."""
    case = case(noise)
    size = {"num_steps": 3, "num_particles": 4, "num_filters": 2}
    made = jb.log_likelihood(KEY, *case.arguments, **case.options, **size)
    exact = case.kalman(1).log_likelihood
    assert abs(made.value - exact) < 1e-6 * max(abs(exact), 1)
    assert made.step_error == made.step_uncertainty == 0


@pytest.mark.slow
@pytest.mark.parametrize(("case", "noise"), [(oscillator, 3e-4), (integral, 0.3)])
def test_the_filter_of_ito_taylor_steps(case, noise, x64):
    """Of the steps as they are, to many digits; and of the model, up to the step error told."""
    case = case(noise)
    size = {"num_steps": 10, "num_particles": 4, "num_filters": 2}
    law = {"density": jb.ItoTaylorDensity()}
    made = jb.log_likelihood(KEY, *case.arguments, **case.options, **size, **law)
    chain = case.kalman(10, ito_taylor_step).log_likelihood
    assert abs(made.value - chain) < 1e-6 * max(abs(chain), 1)
    true = float(made.value) - case.kalman(1).log_likelihood
    assert abs(true) < abs(made.step_error) + 2 * made.step_uncertainty + 1e-3
    assert abs(made.step_error) < 5 * abs(true) + 1e-3


@pytest.mark.slow
def test_the_filter_in_single_precision():
    case = integral(3e-4)
    made = jb.log_likelihood(
        KEY, *case.arguments, **case.options, num_steps=10, num_particles=4, num_filters=2
    )
    exact = case.kalman(1).log_likelihood
    assert abs(made.value - exact) < 1e-3 * max(abs(exact), 1)


@pytest.mark.slow
def test_orders_of_the_steps(x64):
    """The expansion is of second order, Euler's scheme of first, where noise comes by the drift."""
    case, sizes = oscillator(0.1), np.array([16, 32, 64])
    exact = case.kalman(1).log_likelihood

    def slope(step):
        errors = [case.kalman(N, step).log_likelihood - exact for N in sizes]
        return loglog_slope(1 / sizes, np.abs(errors))

    assert 1.9 < slope(ito_taylor_step) < 2.1
    assert 0.75 < slope(euler_step) < 1.1


SCALE = lambda position: 1 + jnp.tanh(position) / 2
SPEEDS = {  # other coordinates of the speed, in which σ depends on the position, or on the speed
    "position": (lambda x: x[1] * SCALE(x[0]), lambda y: y[1] / SCALE(y[0])),
    "speed": (lambda x: 2 * jnp.sinh(x[1] / 2), lambda y: 2 * jnp.arcsinh(y[1] / 2)),
}


@pytest.mark.slow
@pytest.mark.parametrize("of, most", [("position", 0.02), ("speed", 0.06)])
def test_where_sigma_depends_on_the_state(of, most, x64):
    """The likelihood is that of other coordinates, in which the model is linear. Second order where
    noise does not change σ at once."""
    case, start = oscillator(0.1), np.array([0.5, -0.2])
    speed, back = SPEEDS[of]
    there = lambda x: jnp.stack([x[0], speed(x)])
    moved = jb.transform(case.model, there, lambda y: jnp.stack([y[0], back(y)])).model
    times, values = 0.5 * np.arange(9), np.full((9, 1), np.nan)
    law, step = (start, np.zeros((2, 2))), exact_step(case.A, case.V)
    rng, state = np.random.default_rng(0), start
    for i in range(1, 9):
        decay, spread = step(0.5)
        state = rng.multivariate_normal(decay @ state, spread)
        values[i] = state[0] + 0.1 * rng.normal()
    exact = kalman(step, times, values, case.matrix, case.noise, *law, 1).log_likelihood
    options = {
        "observation": jb.LinearGaussian(case.matrix, case.noise),
        "initial": there(jnp.asarray(start)),
        "num_particles": 1000,
        "num_filters": 8,
    }
    made = jb.log_likelihood(KEY, moved, times, values, num_steps=8, **options)
    assert abs(made.value - exact) < most + 5 * made.standard_error
    assert made.standard_error < most


@pytest.mark.slow
def test_smoothed_paths_are_those_of_rauch_tung_and_striebel(x64):
    case = oscillator(3e-4)
    made = jb.smooth(
        KEY, *case.arguments, **case.options, num_steps=4, num_draws=500, num_warmup=50, throw=True
    )
    exact = case.kalman(4)
    sd = np.sqrt(np.diagonal(exact.covariance, axis1=1, axis2=2))
    square = lambda path: (path - exact.mean.astype(path.dtype)) ** 2
    for value, known in [((), exact.mean), ((square,), sd**2)]:
        z = (np.asarray(made.mean(*value)) - known) / np.asarray(made.standard_error(*value))
        assert np.max(np.abs(z)) < 4.5 and np.std(z) < 1.5
    assert np.all(made.accepted[made.accepted > 0] > 0.99)  # guiding is exact here
    assert np.all(np.isfinite(made.step_error()))


@pytest.mark.slow
def test_a_state_that_is_seen_exactly(x64):
    """The last step moves position and velocity both, so that both may be known there; Euler's
    leaves the position where it was, which is then told."""
    case = oscillator(0.0)
    rng = np.random.default_rng(1)
    values = np.nan_to_num(case.values[:6]) * [1.0, 0.0] + rng.normal(size=(6, 2)) * [0.01, 0.3]
    values[0] = np.nan
    times, complete = case.times[:6], jb.LinearGaussian(covariance=0.0)
    options = {**case.options, "observation": complete, "num_steps": 4}
    arguments = (KEY, case.model, times, values)
    made = jb.log_likelihood(*arguments, **options, num_particles=4, num_filters=2)
    law = case.mean, case.covariance
    seen = times, values, np.eye(2), np.zeros((2, 2))
    exact = kalman(exact_step(case.A, case.V), *seen, *law, 4).log_likelihood
    assert abs(made.value - exact) < 1e-5 * abs(exact)
    of = jb.innovations(*arguments[1:], **options)
    path = of.path(case.model.params, jax.random.normal(KEY, (of.size,)))
    np.testing.assert_allclose(path[4::4], values[1:])


def test_sigma_of_more_columns_than_rows_is_a_root_of_its_square():
    """Three reactions of two species, as in the chemical Langevin equation."""
    drift = lambda x, p: -x
    wide = lambda x, p: jnp.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0]]) * jnp.sqrt(1 + x[0] ** 2)
    model, x = jb.Diffusion(drift, wide), jnp.array([0.5, -0.2])
    sigma = model.diffusion(x)
    assert sigma.shape == (2, 2)
    np.testing.assert_allclose(sigma @ sigma.T, wide(x, None) @ wide(x, None).T, rtol=1e-5)
    fixed = jb.Diffusion(drift, wide(jnp.zeros(2), None))
    sigma = fixed.diffusion(x)
    np.testing.assert_allclose(sigma @ sigma.T, [[2.0, -1.0], [-1.0, 2.0]], rtol=1e-5)
    assert fixed.sigma_is_invertible(x) and model.sigma_is_invertible(x)


def test_what_rests_on_an_inverse_of_sigma_says_what_to_use_instead():
    model = jb.fitzhugh_nagumo()
    assert not model.sigma_is_invertible(jnp.zeros(2))
    ends = (KEY, model, [0.0, 0.0], [0.1, 0.0], 1.0)
    for proposal in (jb.Guided(), jb.ModifiedDiffusionBridge(), jb.ResidualBridge(), "auto"):
        with pytest.raises(ValueError, match=r"fewer columns than rows.*`log_likelihood`"):
            jb.transition_log_density(*ends, num_proposals=2, num_steps=4, proposal=proposal)
    for call in (jb.score, jb.pmmh, jb.gibbs, jb.maximum_likelihood):
        prior = {} if call in (jb.score, jb.maximum_likelihood) else {"prior": lambda p: 0.0}
        with pytest.raises(ValueError, match="fewer columns than rows"):
            call(KEY, model, jnp.arange(3.0), jnp.zeros((3, 2)), **prior)
    with pytest.raises(ValueError, match="fewer columns than rows"):
        jb.sample_bridges(*ends, num_bridges=2, num_steps=4)
    with pytest.raises(ValueError, match="fewer columns than rows"):
        jb.path_log_likelihood(model, jnp.arange(3.0), jnp.zeros((3, 2)))
    known = jb.underdamped_langevin(lambda q, p: q @ q / 2)
    with pytest.raises(ValueError, match="fewer columns than rows"):
        jb.sample_bridges(KEY, known, *ends[2:], num_bridges=2, num_steps=4)


def test_a_transformed_model_has_as_many_columns(x64):
    """Y = sinh(X) seen through arcsinh is X seen."""
    case = oscillator(0.1)
    moved = jb.transform(case.model, jnp.sinh, jnp.arcsinh).model
    assert moved.diffusion(jnp.ones(2)).shape == (2, 1)
    y = jnp.array([0.3, -0.4])
    by_hand = jnp.cosh(jnp.arcsinh(y))[:, None] * case.model.diffusion(jnp.arcsinh(y))
    np.testing.assert_allclose(moved.diffusion(y), by_hand)


@pytest.mark.slow
def test_doubt_where_noise_is_led_on_by_the_state():
    """dX = Y + p Y^2: what the drift leads the noise on by, 1 + 2 p Y, is constant for p = 0."""
    drift = lambda x, p: jnp.stack([x[1] + p * x[1] ** 2, -x[1] - (1 - p) * x[0] ** 3])
    for p, known in [(0.0, True), (1.0, False)]:
        model = jb.Diffusion(drift, [[0.0], [0.8]], params=p)
        made = jb.smooth(
            KEY, model, [0.0, 0.5, 1.0], np.array([[0.1], [0.3], [0.2]]), num_steps=4,
            observation=jb.LinearGaussian([[1.0, 0.0]], 0.1), initial=[0.0, 0.0],
            num_draws=20, num_warmup=4, num_chains=2,
        )  # fmt: skip
        told, doubt = np.abs(made.step_error()[1:]), np.asarray(made.step_uncertainty()[1:])
        assert np.any(doubt < told) == known  # else all of it is in doubt, or nothing is known


def test_a_factor_of_many_rows_is_that_of_few(x64):
    """In a loop, beyond sixteen rows, of which some depend on others or are zero."""
    matrix = np.random.default_rng(0).normal(size=(20, 15))
    matrix[3] = 0
    matrix[7] = matrix[2] - matrix[5]
    L = semidefinite_factor(jnp.asarray(matrix))
    np.testing.assert_allclose(L @ L.T, matrix @ matrix.T, atol=1e-10)
    assert L[3, 3] == L[7, 7] == 0 and np.allclose(np.triu(L, 1), 0)
    few = semidefinite_factor(jnp.asarray(matrix[:10]))
    np.testing.assert_allclose(L[:10, :10], few, atol=1e-10)
