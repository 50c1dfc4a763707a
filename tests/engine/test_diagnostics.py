"""Effective sample sizes, and whether chains agree."""

import blackjax.diagnostics
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.engine.diagnostics import effective_size_of_chains


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_effective_sample_size_of_an_autoregression(correlation):
    n, rng = 40_000, np.random.default_rng(0)
    noise = rng.normal(size=(n, 2))
    values = np.empty((n, 2))
    values[0] = noise[0] / np.sqrt(1 - correlation**2)
    for i in range(1, n):
        values[i] = correlation * values[i - 1] + noise[i]
    size = jb.effective_sample_size(values)
    exact = n * (1 - correlation) / (1 + correlation)
    np.testing.assert_allclose(size, exact, rtol=0.15)
    other = blackjax.diagnostics.effective_sample_size(jnp.asarray(values)[None])
    np.testing.assert_allclose(size, other, rtol=0.05)


def test_chains_that_agree_have_r_hat_near_one():
    draws = np.random.default_rng(0).normal(size=(4, 500, 2))
    made = jb.potential_scale_reduction(draws)
    halves = jnp.asarray(np.concatenate([draws[:, :250], draws[:, 250:]]))
    np.testing.assert_allclose(
        made, blackjax.diagnostics.potential_scale_reduction(halves), rtol=1e-3
    )
    assert (made < 1.02).all()
    draws[0, :, 1] += 1
    apart = jb.potential_scale_reduction(draws)
    assert apart[0] < 1.02 and apart[1] > 1.05


def test_chains_that_do_not_move():
    for value in (0.0, 0.1, 3.3, 1e6):  # some means of equal numbers differ from them by rounding
        draws = np.full((4, 100), value)
        assert jb.effective_sample_size(draws[0]) == 1
        assert jb.effective_sample_size(draws, chains=True) == 4
        assert np.isnan(jb.potential_scale_reduction(draws))
    assert np.isnan(jb.effective_sample_size(np.full(100, np.nan)))


@pytest.mark.slow
def test_chains_that_disagree_are_worth_few_draws():
    """In two wells, two draws and not four thousand; where they agree, as those of the library
    that counts alike, and what each is worth by itself."""
    rng = np.random.default_rng(0)
    noise, draws = rng.normal(size=(4, 2000)), np.zeros((4, 2000))
    for i in range(1, 2000):
        draws[:, i] = 0.7 * draws[:, i - 1] + noise[:, i]
    together = jnp.asarray(draws, jnp.float32)
    made = jb.effective_sample_size(together, chains=True)
    np.testing.assert_array_equal(made, effective_size_of_chains(together))
    np.testing.assert_allclose(made, 8000 * 0.3 / 1.7, rtol=0.15)
    other = blackjax.diagnostics.effective_sample_size(together)
    np.testing.assert_allclose(made, other, rtol=0.05)
    alone = sum(jb.effective_sample_size(chain) for chain in together)
    np.testing.assert_allclose(made, alone, rtol=0.1)
    apart = together.at[::2].add(10)
    assert effective_size_of_chains(apart) < 8
    np.testing.assert_allclose(
        effective_size_of_chains(together[:1]), jb.effective_sample_size(together[0])
    )
    assert effective_size_of_chains(jnp.ones((3, 10))) == 3
