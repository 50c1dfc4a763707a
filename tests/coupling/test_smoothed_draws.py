"""The start law of models without a sampler: a density, its sampler, and what rests on it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import paper_model, slow_beyond, without_sampler

import jaxbridge as jb
from jaxbridge.coupling.smoothed_draws import smoothed_draws
from jaxbridge.engine.averages import effective_size

KEY = jax.random.key(7)
PULLED = jb.langevin(lambda x, p: -x @ x)
WELLS = jb.langevin(lambda x, p: -8 * jnp.sum((x**2 - 1) ** 2))


def with_share(law, share):
    return eqx.tree_at(lambda law: law.share, law, jnp.float32(share))


def sampled(law, key, num):
    return jax.vmap(lambda key: law.sample(key, PULLED))(jax.random.split(key, num))


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_its_density_is_that_of_its_draws_and_integrates_to_one(share):
    """In one dimension, against the histogram of many draws, by quadrature."""
    law = smoothed_draws(KEY, jax.random.normal(jax.random.key(0), (64, 1)), jnp.zeros(1), PULLED)
    law = with_share(law, share)
    edges = jnp.linspace(-6.0, 6.0, 2_401)
    density = jnp.exp(jax.vmap(law.log_density)((edges[1:, None] + edges[:-1, None]) / 2))
    mass = np.asarray(density) * 0.005
    assert mass.sum() == pytest.approx(1, abs=1e-4)
    draws = jax.vmap(lambda key: law.sample(key, PULLED))(
        jax.random.split(jax.random.key(1), 40_000)
    )
    bins = mass.reshape(48, -1).sum(axis=1)
    counts, _ = np.histogram(np.asarray(draws)[:, 0], np.asarray(edges[::50]))
    error = np.sqrt(40_000 * bins * (1 - bins))
    assert np.all(np.abs(counts - 40_000 * bins) <= 5 * error + 3)


@pytest.mark.slow
def test_its_ellipse_is_normalised_in_more_dimensions():
    """By importance sampling from a normal law of twice the covariance, in three dimensions."""
    root = jnp.array([[1.0, 0, 0], [0.8, 0.5, 0], [-0.3, 0.2, 2.0]])
    points = jax.random.normal(jax.random.key(0), (64, 3)) @ root.T
    law = with_share(smoothed_draws(KEY, points, jnp.zeros(3), PULLED), 1.0)
    wide = jb.GaussianLaw(law.mean, 2 * law.root @ law.root.T)
    x = jax.vmap(wide.sample)(jax.random.split(jax.random.key(1), 40_000))
    ratio = jnp.exp(jax.vmap(law.log_density)(x) - jax.vmap(wide.log_density)(x))
    error = jnp.std(ratio) / jnp.sqrt(40_000)
    assert abs(float(jnp.mean(ratio)) - 1) < 5 * error < 0.05
    draws = jax.vmap(lambda key: law.sample(key, PULLED))(
        jax.random.split(jax.random.key(2), 20_000)
    )
    np.testing.assert_allclose(jnp.cov(draws.T), law.root @ law.root.T, atol=0.2)


@pytest.mark.slow
def test_one_mode_is_an_ellipse_and_two_are_kernels():
    normal = jax.random.normal(jax.random.key(0), (512, 6)) / jnp.sqrt(2)
    assert smoothed_draws(KEY, normal, jnp.zeros(6), PULLED).share == 1
    side = jnp.sign(jax.random.normal(jax.random.key(1), (512, 1)))
    wells = side + 0.17 * jax.random.normal(jax.random.key(2), (512, 1))
    assert smoothed_draws(KEY, wells, jnp.zeros(1), WELLS).share == 0


@pytest.mark.slow
def test_draws_that_are_not_finite_or_all_the_same_make_a_law():
    points = jnp.full((512, 2), jnp.nan)
    law = smoothed_draws(KEY, points, jnp.array([3.0, -1.0]), PULLED)
    assert jnp.isfinite(law.log_density(jnp.array([3.0, -1.0])))
    assert jnp.all(jnp.isfinite(law.sample(jax.random.key(0), PULLED)))


@pytest.mark.slow
def test_weights_have_no_tails_where_the_density_falls_off_fast():
    """Two wells with quartic walls: the effective share of weights μ/ν, under many draws of ν and
    under those of μ, which see what of it lies in the walls."""
    model = jb.langevin(lambda x, p: -1.5 * (x[0] ** 2 - 1) ** 2 - x[1] ** 2)
    grid = np.linspace(-3, 3, 2_001)
    mass = np.exp(-1.5 * (grid**2 - 1) ** 2)
    rng = np.random.default_rng(0)
    first = rng.choice(grid, 20_512, p=mass / mass.sum())
    nu = jnp.asarray(np.stack([first, rng.normal(size=20_512) / 2**0.5], 1), jnp.float32)
    law = smoothed_draws(KEY, nu[:512], nu[0], model)

    def ratio(x):
        return jnp.exp(jax.vmap(law.log_density)(x) - jax.vmap(model.log_stationary)(x))

    weights = ratio(nu[512:])
    assert effective_size(weights / jnp.sum(weights)) > 0.6 * 20_000
    mu = ratio(sampled(law, jax.random.key(1), 20_000))
    assert 1 / (jnp.mean(mu) * jnp.mean(1 / mu)) > 0.6


INTERVAL = ([0.0, 0.0], [0.5, -0.5], 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("share", slow_beyond(1, [0.0, 1.0]))
def test_bridges_are_exact_though_the_draws_are_not_of_the_stationary_law(share):
    """Any draws will do: these have half the spread, and lie to one side."""
    model = paper_model()
    points = jnp.array([0.3, 0.1]) + 0.35 * jax.random.normal(jax.random.key(0), (512, 2))
    law = smoothed_draws(KEY, points, jnp.zeros(2), model)
    exact = jb.gaussian_bridge(model, *INTERVAL, [0.5])
    coupling = jb.Coupling(0.5, start_law=with_share(law, share))
    options = dict(num_bridges=4_000, save_at=[0.5], proposal=coupling)
    weighted = jb.sample_weighted_bridges(jax.random.key(1), model, *INTERVAL, **options)
    error = weighted.standard_error()[0]
    assert jnp.all(jnp.abs(weighted.mean()[0] - exact.mean[0]) < 4.5 * error + 2e-3)
    assert jnp.all(error < 0.05)


@pytest.mark.slow
def test_a_model_without_a_sampler_is_nearly_as_efficient_as_one_with():
    """Effective bridges per simulated path, and the density, for which μ brings its own size."""
    model, found = paper_model(), []
    for each in (model, without_sampler(model, reversible=True)):
        made = jb.sample_weighted_bridges(
            jax.random.key(0), each, *INTERVAL, num_bridges=1_500, proposal=jb.Coupling(0.5)
        )
        found.append(float(made.efficiency))
        assert not jnp.any(made.truncated)
    assert found[1] > 0.6 * found[0]
