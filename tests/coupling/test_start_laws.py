"""Where associated diffusions start, and how long a run replaces a sampler."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NON_REVERSIBLE, assert_moments, paper_model, without_sampler

import jaxbridge as jb
from jaxbridge.coupling import burn_in, start_laws
from jaxbridge.coupling.start_laws import draw_starts


def starts(law, model, end, duration=1.0, num_steps=40, n=20_000):
    end = jnp.asarray(end)
    lanes = jnp.broadcast_to(end[:, None], (len(end), n))
    keys = jax.random.split(jax.random.key(0), n)
    dt = jnp.full(n, duration / num_steps)
    draw = jax.jit(
        lambda keys: draw_starts(law, model.prepared(), jb.Heun(), keys, lanes, dt, num_steps)
    )
    return draw(keys).T


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
    measured = jb.measure_burn_in(jax.random.key(1), blind, end, 1.0, num_steps=40)
    # The slowest rate is 3/4: the start, ten standard deviations out, must be forgotten.
    assert 8 <= measured <= 100
    exact = jb.ou_stationary(model)
    drawn = starts(jb.Stationary(measured), blind, end)
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
    """A plain object and a `GaussianLaw` of the same law give the same starts."""

    class Plain:
        centre = np.array([0.5, 0.1], np.float32)

        def sample(self, key, model):
            return self.centre + jax.random.normal(key, (2,))

        def log_density(self, x):
            return -(x - self.centre) @ (x - self.centre) / 2 - jnp.log(2 * jnp.pi)

    model = paper_model()

    @jax.jit
    def weights(key, centre):
        laws = [Plain(), jb.GaussianLaw(centre, jnp.eye(2))]
        results = []
        for law in laws:
            coupling = jb.Coupling(0.5, start_law=law)
            bridges = jb.sample_bridges(
                key, model, [0.0, 0.0], [0.5, 0.0], 1.0, num_bridges=20, coupling=coupling
            )
            results.append(jb.weigh_bridges(key, model, bridges))
        return results

    first, other = weights(jax.random.key(0), jnp.array([0.5, 0.1]))
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


@pytest.mark.slow
def test_pairs_that_explode_have_not_met():
    """Explicit steps of a quartic well that are far too long: nothing stays finite."""
    quartic = jb.Diffusion(lambda x, p: -2 * x**3, None, lambda x, p: -jnp.sum(x**4))
    with pytest.raises(ValueError, match=r"have not all met.*`SemiImplicit\(\)`"):
        jb.measure_burn_in(jax.random.key(0), quartic, [3.0], 20.0, num_steps=10)
    # In steps of a third some pairs explode, and are left out of those that must meet.
    seldom = jb.measure_burn_in(jax.random.key(0), quartic, [0.5], 20.0, num_steps=60)
    assert 20.0 < seldom < 200.0


@pytest.fixture
def short_runs(monkeypatch):
    """Runs of 256 steps at most, so that a test need not wait for a run that is too short."""
    for module in (start_laws, burn_in):
        monkeypatch.setattr(module, "MOST_STEPS", 2**8)


def slow_model(with_density=False):
    """An Ornstein–Uhlenbeck process that takes hundreds of units of time to forget, N(0, 50), known
    to be reversible, or by its density."""
    log_nu = slow_log_nu if with_density else None
    return jb.Diffusion(slow_drift, None, log_nu, reversible=True, normalised=with_density)


def slow_drift(x, p):
    return -0.01 * x


def slow_log_nu(x, p):
    return jnp.sum(-0.01 * x**2 - jnp.log(100 * jnp.pi) / 2)


LAWS = {
    "unknown": (jb.Stationary(), False),
    "too long": (jb.Stationary(1e4), False),
    "known": (jb.Stationary(32.0), True),  # the longest run
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_counts_and_weights_from_a_run_that_was_cut_are_marked(name, short_runs):
    """Whether it was measured in vain or given too long, 32 units of time are not enough."""
    law, trusted = LAWS[name]
    key, model, ends = jax.random.key(0), slow_model(), ([0.0], [0.3], 1.0)
    coupling = jb.Coupling(0.0, start_law=law)
    bridges = jb.sample_bridges(key, model, *ends, num_bridges=4, num_steps=8, coupling=coupling)
    assert bridges.met.all()
    weighted = jb.weigh_bridges(key, model, bridges)
    assert (weighted.truncated != trusted).all() and np.isfinite(weighted.log_weights).all()
    assert bool(np.isinf(weighted.coupling.start_law.burn_in)) == (law.burn_in is None)
    counts = jb.hitting_counts(key, model, bridges, 3)
    assert (counts.counts > 0).all() and (counts.truncated != trusted).all()
    trials = np.asarray(counts.num_trials)  # as many hits as were wanted, marked or not
    np.testing.assert_allclose(counts.probability, 2 / (trials - 1), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_densities_and_chains_from_a_run_that_was_cut_are_marked(name, short_runs):
    law, trusted = LAWS[name]
    key, ends = jax.random.key(0), ([0.0], [0.3], 1.0)
    options = dict(num_steps=8, proposal=jb.Coupling(0.0, start_law=law))
    if law.burn_in is not None:
        model = slow_model(with_density=True)
        density = jb.transition_log_density(key, model, *ends, num_proposals=20, **options)
        assert density.num_truncated == (0 if trusted else density.num_met)
    model = slow_model()
    chain = jb.sample_exact_bridges(key, model, *ends, num_bridges=4, method="renewal", **options)
    assert (chain.num_truncated == 0) == trusted


@pytest.mark.slow
def test_a_density_is_exact_though_no_burn_in_is_found(short_runs):
    """The draws of the start law are from a run that has forgotten nothing."""
    model, (a, b, duration) = slow_model(with_density=True), ([0.0], [0.3], 1.0)
    estimate = jb.transition_log_density(
        jax.random.key(0), model, a, b, duration, num_proposals=20_000, proposal=jb.Coupling(0.0)
    )
    variance = 50 * (1 - np.exp(-0.02 * duration))
    exact = -0.5 * (0.3**2 / variance + np.log(2 * np.pi * variance))
    assert estimate.trustworthy and estimate.num_truncated == 0
    assert abs(estimate.value - exact) < 4.5 * estimate.standard_error < 0.1
