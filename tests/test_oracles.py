"""The oracles of other tests, against closed forms and each other."""

import cir
import fokker_planck
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import random_models
from scipy import integrate
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.stats import multivariate_normal


def ou_bridge(B, V, start, end, duration):
    """log p, and the mean and sd at T/2, of dX = -BX dt + dW with variance V."""
    stationary = solve_continuous_lyapunov(B, V)

    def transition(time):
        flow = expm(-B * time)
        return flow, stationary - flow @ stationary @ flow.T

    flow, covariance = transition(duration)
    log_density = multivariate_normal(flow @ start, covariance).logpdf(end)
    flow, covariance = transition(duration / 2)
    gain = covariance @ flow.T @ np.linalg.inv(flow @ covariance @ flow.T + covariance)
    mean = flow @ start
    mean = mean + gain @ (end - flow @ mean)
    return log_density, mean, np.sqrt(np.diag(covariance - gain @ flow @ covariance))


@pytest.mark.parametrize(
    "B, V, start, end, duration, num_nodes",
    [
        ([[0.8]], [[1.44]], [-0.5], [1.5], 1.0, 200),
        ([[0.8]], [[1.44]], [-0.5], [-0.5], 0.1, 200),
        ([[1.5, 1.0], [1.0, 1.5]], np.eye(2), [0.5, 0.3], [-0.5, 0.6], 1.0, 40),
        ([[1.0, 1.5], [-1.0, 0.5]], [[1, 0.3], [0.3, 0.8]], [0.5, 0.3], [-0.5, 0.6], 1.5, 40),
        ([[1.0, 6.28], [-6.28, 1.0]], np.eye(2), [0.5, 0.3], [-0.5, 0.6], 2.0, 90),
    ],
    ids=["one dimension", "short", "reversible", "not reversible", "rotating fast"],
)
def test_fokker_planck_of_gaussians(B, V, start, end, duration, num_nodes):
    B, V, start, end = (np.array(x, float) for x in (B, V, start, end))
    made = fokker_planck.solve(
        lambda x: -x @ B.T,
        lambda x: np.broadcast_to(V, (len(x), *V.shape)),
        start,
        end,
        duration,
        [(-5.0, 5.0)] * len(start),
        num_nodes,
    )
    log_density, mean, sd = ou_bridge(B, V, start, end, duration)
    assert abs(made.log_density - log_density) < 2e-5 + 3 * made.log_density_error < 5e-3
    assert np.all(np.abs(made.mean - mean) < 2e-5 + 3 * made.mean_error.max())
    assert np.all(np.abs(made.sd - sd) < 2e-5 + 3 * made.sd_error.max())
    assert max(made.mean_error.max(), made.sd_error.max()) < 2e-3


def test_fokker_planck_of_a_square_root_process():
    """A σ that depends on x: (Cox, Ingersoll & Ross) on a part of the half line."""
    made = fokker_planck.solve(
        lambda x: cir.TRUTH[0] * (cir.TRUTH[1] - x),
        lambda x: cir.TRUTH[2] ** 2 * x[:, :, None],
        [0.5],
        [0.9],
        0.7,
        [(0.02, 4.0)],
        400,
    )
    assert abs(made.log_density - cir.log_density(cir.TRUTH, 0.5, 0.9, 0.7)) < 1e-3
    x = np.linspace(0.001, 4, 4001)
    halves = [cir.log_density(cir.TRUTH, 0.5, x, 0.35), cir.log_density(cir.TRUTH, x, 0.9, 0.35)]
    density = np.exp(sum(halves))
    mean = (x * density).sum() / density.sum()
    np.testing.assert_allclose(made.mean, mean, atol=1e-3)


@pytest.mark.slow
def test_muller_brown():
    """In the direction with the smaller error on a grid; the other way by reversibility."""
    ahead, back = fokker_planck.muller_brown(), fokker_planck.muller_brown(backwards=True)
    made = fokker_planck.solve_model(
        back.model, back.start, back.end, back.duration, fokker_planck.MULLER_BROWN_BOX, 121
    )
    assert abs(made.log_density - back.log_density) < 1e-3
    np.testing.assert_allclose(made.mean, back.mean, atol=5e-4)
    np.testing.assert_allclose(made.sd, back.sd, atol=5e-4)
    energies = [
        float(fokker_planck.muller_brown_log_density(jnp.asarray(x), None))
        for x in (ahead.start, ahead.end)
    ]
    change = energies[1] - energies[0]
    np.testing.assert_allclose(ahead.log_density - back.log_density, change, atol=1e-3)


@pytest.mark.parametrize(
    "random",
    [
        pytest.param(m, id=m.name, marks=[] if i == 11 else pytest.mark.slow)
        for i, m in enumerate(random_models.random_models())
    ],
)
def test_random_models_are_what_they_say(random, x64):
    model = jax.tree.map(lambda x: x.astype(float), random.model)
    x, params = jnp.asarray(random.start, float), model.params
    sigma = model.diffusion(x)
    if "identity" in random.name:
        expected = np.eye(len(x))
    elif "constant" in random.name:
        expected = params.variance
    else:
        expected = random_models._varying(x, params)
    np.testing.assert_allclose(sigma @ sigma.T, expected, atol=1e-6)
    assert model.reversible == random.name.endswith("reversible")
    # ν is stationary: div(αν - ½ div(νV)) = 0.

    def density(y):
        return jnp.exp(random_models.log_density(y, params))

    def flux(y):
        def weighted(z):
            root = model.diffusion(z)
            return density(z) * root @ root.T

        return model.drift(y) * density(y) - jnp.einsum("ijj->i", jax.jacfwd(weighted)(y)) / 2

    assert abs(jnp.trace(jax.jacfwd(flux)(x))) < 1e-5 * density(x)


@pytest.mark.slow
@pytest.mark.parametrize("name", random_models.EXACT)
def test_numbers_of_random_models(name):
    made = random_models.solve(random_models.named(name))
    log_density, mean = random_models.EXACT[name]
    assert abs(made.log_density - log_density) < 1e-4
    np.testing.assert_allclose(made.mean, mean, atol=1e-4)


@pytest.mark.parametrize("gap", [1e-6, 0.01, 0.5, 4.0])
def test_cox_ingersoll_ross_transitions(gap):
    """The formula against SciPy's law, and that it integrates to one with the right mean."""
    rate, level, sigma = cir.TRUTH
    start = 0.3
    sd = sigma * np.sqrt(start * min(gap, 1))
    ends = np.clip(start + sd * np.linspace(-3, 3, 7), 1e-3, None)
    expected = cir.ncx2_log_density(cir.TRUTH, start, ends, gap)
    np.testing.assert_allclose(cir.log_density(cir.TRUTH, start, ends, gap), expected, atol=1e-8)
    density = lambda x: np.exp(cir.log_density(cir.TRUTH, start, x, gap))
    low, high = max(0.0, start - 10 * sd), start + 15 * sd
    mass, _ = integrate.quad(density, low, high, points=[start], limit=200)
    mean, _ = integrate.quad(lambda x: x * density(x), low, high, points=[start], limit=200)
    assert abs(mass - 1) < 1e-6
    np.testing.assert_allclose(mean, level + (start - level) * np.exp(-rate * gap), rtol=1e-5)


def test_cox_ingersoll_ross_data_and_fit():
    times, observations = cir.data()
    gaps = np.diff(times)
    assert observations.shape == (301, 1) and 0.05 <= gaps.min() < gaps.max() <= 4
    fit = cir.fit(times, observations)
    np.testing.assert_array_less(np.abs(fit.params - cir.TRUTH), 3 * fit.sd)
    assert fit.log_likelihood > cir.log_likelihood(cir.TRUTH, times, observations)
    # A maximum, and of that curvature.
    for k in range(3):
        step = 0.3 * fit.sd[k] * np.eye(3)[k]
        values = [cir.log_likelihood(fit.params + s, times, observations) for s in (-step, step)]
        curvature = (2 * fit.log_likelihood - sum(values)) / np.sum(step) ** 2
        assert abs(values[1] - values[0]) < 0.05
        np.testing.assert_allclose(curvature, np.linalg.inv(fit.covariance)[k, k], rtol=0.05)


def test_cox_ingersoll_ross_ridge():
    times, observations = cir.data()
    params, values = cir.ridge(times, observations)
    np.testing.assert_allclose(
        2 * params[:, 0] * params[:, 1] / params[:, 2] ** 2, [2.0, 1.6, 1.3, 1.0, 0.8]
    )
    assert np.all(np.diff(values) < 0)


def test_cox_ingersoll_ross_simulator():
    rate, level, sigma = cir.TRUTH
    times = np.arange(20_001) * 3.0
    x = cir.simulate(cir.TRUTH, times, np.random.default_rng(0))[:, 0]
    variance = sigma**2 * level / (2 * rate)
    assert abs(x.mean() - level) < 5 * np.sqrt(1.1 * variance / len(x))
    np.testing.assert_allclose(x.var(), variance, rtol=0.05)
    centred = x - level
    correlation = np.mean(centred[1:] * centred[:-1]) / variance
    assert abs(correlation - np.exp(-3 * rate)) < 0.04


def test_cox_ingersoll_ross_models():
    model, logarithm, root = cir.model(), cir.in_logarithms(), cir.in_roots()
    x = jnp.array([0.3])
    np.testing.assert_allclose(model.drift(x), 0.2, rtol=1e-6)
    np.testing.assert_allclose(model.diffusion(x), [[0.6 * np.sqrt(0.3)]], rtol=1e-6)
    # Itô: d log X = (κ(θ-x)/x - σ²/2x) dt + σ/√x dW.
    np.testing.assert_allclose(
        logarithm.model.drift(jnp.log(x)), [0.2 / 0.3 - 0.18 / 0.3], rtol=1e-4
    )
    np.testing.assert_allclose(root.model.diffusion(root.forward(x)), [[1.0]], rtol=1e-5)
    np.testing.assert_allclose(
        root.forward(x), [2 / 0.6 * (np.sqrt(0.3) - np.sqrt(0.5))], rtol=1e-4
    )
