"""Where associated diffusions start, and how long a run replaces a sampler."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NON_REVERSIBLE, assert_moments, paper_model

import jaxbridge as jb
from jaxbridge.start_laws import as_start_law, draw_starts


def starts(law, model, end, duration=1.0, num_steps=40, n=20_000):
    end = jnp.asarray(end)
    lanes = jnp.broadcast_to(end[:, None], (len(end), n))
    keys = jax.random.split(jax.random.key(0), n)
    dt = jnp.full(n, duration / num_steps)
    draw = jax.jit(
        lambda keys: draw_starts(law, model.prepared(), jb.Heun(), keys, lanes, dt, num_steps)
    )
    return draw(keys).T


def without_sampler(model):
    """The same diffusion, whose stationary law is known as a density only."""
    return jb.Diffusion(
        lambda x, p: model.with_params(p).drift(x),
        None,
        lambda x, p: model.with_params(p).log_stationary(x),
        model.params,
    )


@pytest.mark.slow
def test_reversed_is_the_law_of_the_reversed_diffusion():
    """For a process that is not reversible, whose reversal is known in closed form."""
    model, end = jb.ornstein_uhlenbeck(NON_REVERSIBLE), jnp.array([1.0, -0.5])
    covariance = jb.ou_stationary(model).covariance
    reverse = jb.ornstein_uhlenbeck(covariance @ NON_REVERSIBLE.T @ jnp.linalg.inv(covariance))
    exact = jb.ou_transition(reverse, end, 1.0)
    drawn = starts(jb.Reversed(), model, end)
    assert_moments(drawn, exact.mean, exact.covariance, mean_allowance=0.002)


@pytest.mark.slow
def test_a_run_replaces_the_sampler_from_far_away():
    model = jb.ornstein_uhlenbeck(NON_REVERSIBLE)
    end = jnp.array([6.0, -6.0])
    blind = without_sampler(model)
    burn_in = jb.measure_burn_in(jax.random.key(1), blind, end, 1.0, num_steps=40)
    # The slowest rate is 3/4: the start, ten standard deviations out, must be forgotten.
    assert 8 <= burn_in <= 100
    exact = jb.ou_stationary(model)
    drawn = starts(jb.Stationary(burn_in), blind, end)
    assert_moments(drawn, exact.mean, exact.covariance, mean_allowance=0.002)
    with pytest.raises(AssertionError):  # one unit of time is not enough
        assert_moments(starts(jb.Stationary(1.0), blind, end), exact.mean, exact.covariance)


@pytest.mark.slow
def test_burn_in_does_not_depend_on_the_duration_much():
    """Short intervals must not pass for mixing: what spreads little also joins little."""
    model = without_sampler(jb.ornstein_uhlenbeck(np.eye(1)))
    times = [
        float(jb.measure_burn_in(jax.random.key(0), model, [0.0], duration, num_steps=10))
        for duration in (0.05, 0.5, 5.0)
    ]
    assert min(times) > 6 and max(times) <= 40, times


@pytest.mark.slow
def test_any_law_with_a_density_and_a_sampler_serves():
    """A module, a plain object and a `GaussianLaw` of the same law give the same starts."""

    class Module(eqx.Module):
        centre: jax.Array

        def sample(self, key, model):
            return self.centre + jax.random.normal(key, (2,))

        def log_density(self, x):
            return -(x - self.centre) @ (x - self.centre) / 2 - jnp.log(2 * jnp.pi)

    class Plain:
        def sample(self, key, model):
            return jnp.array([0.5, 0.1]) + jax.random.normal(key, (2,))

        def log_density(self, x):
            return Module(jnp.array([0.5, 0.1])).log_density(x)

    model = paper_model()

    @jax.jit
    def weights(key, centre):
        laws = [Module(centre), Plain(), jb.GaussianLaw(centre, jnp.eye(2))]
        results = []
        for law in laws:
            coupling = jb.Coupling(0.5, start_law=law)
            bridges = jb.sample_bridges(
                key, model, [0.0, 0.0], [0.5, 0.0], 1.0, num_bridges=20, coupling=coupling
            )
            results.append(jb.weigh_bridges(key, model, bridges))
        return results

    first, *others = weights(jax.random.key(0), jnp.array([0.5, 0.1]))
    for other in others:
        np.testing.assert_allclose(first.log_weights, other.log_weights, atol=1e-4)


@pytest.mark.slow
def test_run_for_a_sampler_depends_on_its_own_interval_only():
    """Intervals of other step lengths beside it change nothing, nor does the number of lanes."""
    model = without_sampler(paper_model())
    starts, ends = jnp.zeros((2, 2)), jnp.full((2, 2), 0.3)
    law = jb.Stationary(1.5)
    bridges = jb.sample_bridges(
        jax.random.key(0),
        model,
        starts,
        ends,
        jnp.array([1.0, 0.2]),
        num_bridges=4,
        num_steps=10,
        coupling=jb.Coupling(0.5, start_law=law),
    )
    counts = [
        jb.hitting_counts(jax.random.key(1), model, bridges, 4, batch_size=size) for size in (1, 64)
    ]
    np.testing.assert_array_equal(counts[0].counts, counts[1].counts)


def test_gaussian_law_is_normalised_and_sampled():
    law = jb.GaussianLaw([1.0, -2.0, 0.5], [[2.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 0.5]])
    draws = jax.vmap(law.sample)(jax.random.split(jax.random.key(0), 20_000))
    assert_moments(draws, law.mean, law.covariance)
    expected = jax.scipy.stats.multivariate_normal.logpdf(draws[:50], law.mean, law.covariance)
    np.testing.assert_allclose(jax.vmap(law.log_density)(draws[:50]), expected, atol=1e-4)


def test_pairs_that_explode_have_not_met():
    """Explicit steps of a quartic well that are far too long: nothing stays finite."""
    quartic = jb.Diffusion(lambda x, p: -2 * x**3, None, lambda x, p: -jnp.sum(x**4))
    with pytest.raises(ValueError, match="have not all met"):
        jb.measure_burn_in(jax.random.key(0), quartic, [3.0], 20.0, num_steps=10)
    # In steps of a third some pairs explode, and are left out of those that must meet.
    seldom = jb.measure_burn_in(jax.random.key(0), quartic, [0.5], 20.0, num_steps=60)
    assert 20.0 < seldom < 200.0


def test_errors_say_what_to_change(unchecked):
    with pytest.raises(TypeError, match="`start_law` must be"):
        as_start_law(3.0)
    with pytest.raises(TypeError, match="not a class"):
        jb.Coupling(0.5, start_law=jb.Reversed)
    with pytest.raises(ValueError, match="positive time"):
        jb.Stationary(-1.0)
    with pytest.raises(ValueError, match="must have shape"):
        jb.GaussianLaw([0.0, 0.0], jnp.eye(3))
    with pytest.raises(ValueError, match="positive definite"):
        jb.GaussianLaw([0.0, 0.0], [[1.0, 2.0], [2.0, 1.0]])
    with pytest.raises(ValueError, match="positive definite"):
        jb.Coupling(start_law=jb.GaussianLaw([0.0, 0.0], [[1.0, 1.0], [1.0, 1.0]]))
    bridges = jb.sample_bridges(jax.random.key(0), paper_model(), [0.0, 0.0], [0.5, 0.0], 1.0)
    with pytest.raises(ValueError, match=r"must give points of shape \(2,\)"):
        law = jb.GaussianLaw([0.0], [[1.0]])
        jb.hitting_counts(jax.random.key(0), paper_model(), bridges, start_law=law)
