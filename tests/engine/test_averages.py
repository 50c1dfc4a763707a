"""Means over bridges, weighted or of a chain."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.engine.averages import evaluate_on_paths, fill_missing_paths, weighted_mean
from jaxbridge.exact.kernels import Chain


def chain_of(paths):
    """A chain with these states, NaN where there was none yet."""
    met = jnp.isfinite(paths[..., 0, 0])
    counts = jnp.zeros(paths.shape[:-3], jnp.int32)
    return Chain(
        times=jnp.arange(paths.shape[-2], dtype=paths.dtype),
        paths=paths,
        accepted=met,
        log_weights=None,
        met=met,
        truncated=None,
        num_simulated=counts,
        num_nonfinite=counts,
        num_truncated=counts,
        proposal=jb.ModifiedDiffusionBridge(),
        pareto_k=None,
        log_halving=jnp.zeros(met.shape, paths.dtype),
        coarse_paths=None,
        step_share=jnp.ones(paths.shape[:-3], paths.dtype),
        num_steps=paths.shape[-2] - 1,
    )


def autoregressions(correlation, shape):
    noise = np.random.default_rng(0).normal(size=shape)
    values = np.empty(shape)
    values[:, 0] = noise[:, 0] / np.sqrt(1 - correlation**2)
    for i in range(1, shape[1]):
        values[:, i] = correlation * values[:, i - 1] + noise[:, i]
    return jnp.asarray(values, jnp.float32)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_standard_error_of_a_chain_covers_its_error(correlation):
    """400 autoregressions with mean zero: the mean's error is σ² / (n (1 - ρ)²), and is told."""
    n = 2_000
    chain = chain_of(autoregressions(correlation, (400, n, 1, 1)))
    mean, error = chain.mean(), chain.standard_error()
    assert mean.shape == error.shape == (400, 1, 1)
    np.testing.assert_allclose(error.mean(), 1 / (1 - correlation) / np.sqrt(n), rtol=0.05)
    assert abs(np.std(mean / error) - 1) < 5 / np.sqrt(2 * 400) + 0.05


def test_a_chain_before_its_first_path():
    paths = np.random.default_rng(0).normal(size=(2, 50, 3, 2)).astype(np.float32)
    paths[0, :7] = np.nan
    paths[1] = np.nan
    chain = chain_of(jnp.asarray(paths))
    np.testing.assert_allclose(chain.mean()[0], paths[0, 7:].mean(0), atol=1e-6)
    assert np.isnan(chain.mean()[1]).all() and np.isnan(chain.standard_error()[1]).all()
    share = chain.mean(lambda path: {"above": path[1, 0] > 0})["above"]
    np.testing.assert_allclose(share[0], np.mean(paths[0, 7:, 1, 0] > 0), atol=1e-6)


def test_standard_error_of_a_late_chain_is_that_of_its_states():
    paths = np.random.default_rng(0).normal(size=(5_000, 1, 1)).astype(np.float32)
    paths[:4_500] = np.nan
    np.testing.assert_allclose(chain_of(jnp.asarray(paths)).standard_error(), 500**-0.5, rtol=0.2)


def test_values_without_weight_may_be_anything():
    paths = jnp.array([1.0, 2.0, -1.0])[:, None, None]
    weighted = jb.WeightedBridges(
        times=jnp.zeros(1),
        paths=paths,
        log_weights=jnp.log(jnp.array([0.5, 0.5, 0.0])),
        met=jnp.ones(3, bool),
        truncated=jnp.zeros(3, bool),
        num_simulated=jnp.int32(3),
        num_nonfinite=jnp.int32(0),
        proposal=jb.ModifiedDiffusionBridge(),
        log_halving=jnp.zeros(3),
        coarse_paths=None,
        step_share=jnp.ones(()),
        num_steps=1,
    )
    log = lambda path: jnp.log(path[0, 0])  # NaN for the last
    np.testing.assert_allclose(weighted.mean(log), np.log(2) / 2, rtol=1e-6)
    # √Σ w² (h - mean)² = √(2 · ¼ · (½ log 2)²)
    np.testing.assert_allclose(weighted.standard_error(log), np.log(2) / np.sqrt(8), rtol=1e-6)


def test_missing_bridges_have_no_weight():
    paths = np.arange(12.0, dtype=np.float32).reshape(3, 2, 2)
    paths[1] = np.nan
    met, weights = jnp.array([True, False, True]), jnp.array([0.25, 0.0, 0.75])
    values = evaluate_on_paths(
        lambda path: path @ path.T, fill_missing_paths(jnp.asarray(paths), met)
    )
    expected = 0.25 * paths[0] @ paths[0].T + 0.75 * paths[2] @ paths[2].T
    np.testing.assert_allclose(weighted_mean(weights, values), expected, rtol=1e-6)
    assert np.isnan(weighted_mean(jnp.zeros(3), values)).all()
