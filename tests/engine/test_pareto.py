"""The Pareto shape of the largest weights, against ArviZ's, and where there is nothing to fit."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbridge.engine import pareto

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import arviz


pareto_k = jax.jit(pareto.pareto_k)


def pareto_weights(seed, shape, size):
    """Logarithms of 1 + generalised Pareto numbers."""
    draws = np.random.default_rng(seed).exponential(size=size)
    return np.log1p(np.expm1(shape * draws) / shape)


def by_arviz(log_weights):
    """By its first versions, or by the later ones, which take the negative."""
    if hasattr(arviz, "psislw"):
        return arviz.psislw(log_weights.copy())[1]
    from arviz_stats.base import array_stats

    return array_stats.psislw(-log_weights)[1]


def of_weights(weights):
    with np.errstate(divide="ignore"):
        return float(pareto_k(jnp.asarray(np.log(np.asarray(weights, float)), jnp.float32)))


# Where 3√n is a whole number: versions of ArviZ round it differently.
@pytest.mark.parametrize("n", [30, 225, 2025])
@pytest.mark.parametrize("shape", [-0.3, 0.2, 0.5, 0.9, 1.2])
def test_agrees_with_arviz(shape, n, precision):
    log_weights = pareto_weights(0, shape, (30, n)).astype(precision)
    expected = by_arviz(log_weights.astype(float))
    made = pareto_k(jnp.asarray(log_weights))
    assert made.dtype == precision
    np.testing.assert_allclose(made, expected, atol=3e-3 if precision == "float32" else 1e-10)


@pytest.mark.parametrize("shape", [-0.3, 0.2, 0.5, 0.9, 1.2])
def test_finds_the_shape(shape):
    made = pareto_k(jnp.asarray(pareto_weights(1, shape, (100, 5000)), jnp.float32))
    # The prior draws by 10 in 223.
    expected = (213 * shape + 10 * 0.5) / 223
    assert abs(jnp.mean(made) - expected) < 5 * jnp.std(made) / 10 + 0.05
    assert jnp.std(made) < 0.2


def test_constants_zeros_and_axes_do_not_matter():
    log_weights = pareto_weights(2, 0.6, (2, 3, 400)).astype(np.float32)
    expected = pareto_k(jnp.asarray(log_weights))
    assert expected.shape == (2, 3)
    shuffled = np.random.default_rng(0).permuted(log_weights, axis=-1)
    np.testing.assert_allclose(pareto_k(jnp.asarray(shuffled)), expected, atol=1e-5)
    np.testing.assert_allclose(pareto_k(jnp.asarray(log_weights + 16)), expected, atol=5e-3)
    np.testing.assert_allclose(jax.jit(jax.vmap(pareto_k))(log_weights), expected, atol=1e-5)
    # With half of the weights zero those of the tail, and their threshold, stay.
    padded = np.concatenate([np.sort(log_weights)[..., 100:], np.full((2, 3, 100), -np.inf)], -1)
    np.testing.assert_allclose(pareto_k(jnp.asarray(padded, jnp.float32)), expected, atol=1e-5)


def test_more_zeros_than_fit_beside_the_tail():
    """Then the threshold is zero, as ArviZ has it."""
    positive = pareto_weights(3, 0.8, (10, 60))
    with_zeros = lambda n, zero: np.append(positive, np.full((10, n - 60), zero), axis=1)
    expected = by_arviz(with_zeros(400, -1e5))  # whose tail has 60
    log_weights = with_zeros(1000, -np.inf)
    np.testing.assert_allclose(pareto_k(jnp.asarray(log_weights, jnp.float32)), expected, atol=0.01)


def test_equal_weights_are_bounded():
    noise = np.random.default_rng(0).normal(size=1000)
    assert of_weights(np.ones(1000)) == -np.inf
    assert of_weights(np.ones(10)) == -np.inf
    assert of_weights(np.exp(1e-5 * noise)) == -np.inf
    assert of_weights(noise > 0) == -np.inf
    assert -0.3 < of_weights(np.exp(1e-2 * noise)) < 0.3


@pytest.mark.parametrize(
    "weights",
    [
        np.zeros(0),
        np.ones(4),
        np.linspace(0.5, 1, 24),
        np.zeros(1000),
        np.arange(1000) < 4,
        np.where(np.arange(1000) == 7, np.nan, 1.0),
        np.where(np.arange(1000) == 7, np.inf, 1.0),
        np.where(np.arange(1000) == 7, 1e25, 1.0),
    ],
    ids=[
        "none",
        "four",
        "24",
        "all zero",
        "four not zero",
        "NaN",
        "infinite",
        "all but one vanish",
    ],
)
def test_nothing_to_judge_by(weights):
    assert of_weights(weights) == np.inf


@pytest.mark.parametrize("probability", [0.05, 0.3, 0.7, 0.95, 0.997])
@pytest.mark.parametrize("repeats", [1, 4, 20])
def test_mean_counts_have_ties_and_light_tails(probability, repeats):
    counts = np.random.default_rng(0).geometric(probability, size=(1000, repeats)).mean(1)
    for weights in (counts, 1 / counts):
        for rounding in (0, 1e-7):
            noise = rounding * np.random.default_rng(1).uniform(-1, 1, size=1000)
            assert of_weights(weights * (1 + noise)) < 0.5


def test_few_large_weights_above_ties():
    weights = np.ones(1000)
    weights[:3] = 2
    assert of_weights(weights) < 0.5
    weights[:3] = 1000
    assert of_weights(weights) > 1
    weights[:30] = 1000
    assert of_weights(weights) > 1


@pytest.mark.parametrize("spread", [5.0, 20.0, 100.0, 1e4])
def test_enormous_spreads(spread):
    log_weights = spread * np.random.default_rng(0).normal(size=(20, 1000))
    made = pareto_k(jnp.asarray(log_weights, jnp.float32))
    assert not jnp.isnan(made).any() and (made > 1).all()


def test_no_derivative():
    gradient = jax.grad(lambda x: pareto_k(x))(jnp.linspace(0.0, 1.0, 100))
    np.testing.assert_array_equal(gradient, 0)


def test_few_weights_are_trusted_with_lighter_tails_only():
    assert pareto.largest_reliable_k(10) == 0
    np.testing.assert_allclose(pareto.largest_reliable_k(100), 0.5)
    assert pareto.largest_reliable_k(10**4) == pareto.largest_reliable_k(10**6) == 0.7
