"""Hitting counts are geometric, with the right probability."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import PAPER_B, PAPER_CASES, paper_model
from reference import hitting_frequency

import jaxbridge as jb

LAW = jb.GaussianLaw([0.2, -0.1], [[0.5, -0.3], [-0.3, 0.4]])


def some_bridges(num_bridges=3, num_steps=30, coupling=None, ends=PAPER_CASES["unlikely"]):
    coupling = jb.Coupling(0.5, scheme=jb.Euler()) if coupling is None else coupling
    return jb.sample_bridges(
        jax.random.key(0),
        paper_model(),
        *ends,
        1.0,
        num_bridges=num_bridges,
        num_steps=num_steps,
        coupling=coupling,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "law", [pytest.param(jb.Stationary(), marks=pytest.mark.slow), LAW], ids=["nu", "mu"]
)
def test_probabilities_are_those_of_an_independent_simulation(law):
    """Against NumPy, path by path; the paths differ a lot in how often they are hit."""
    model, bridges = paper_model(), some_bridges(6)
    counts = jb.hitting_counts(jax.random.key(1), model, bridges, num_counts=4_000, start_law=law)
    gaussian = jb.ou_stationary(model) if isinstance(law, jb.Stationary) else law
    rng, n = np.random.default_rng(0), 20_000
    mean, covariance = np.asarray(gaussian.mean), np.asarray(gaussian.covariance)
    for i in range(6):
        starts = rng.multivariate_normal(mean, covariance, n)
        path = np.asarray(bridges.paths[i], float)
        frequency = hitting_frequency(rng, PAPER_B, path, 1 / 30, 0.5, starts)
        error = np.hypot(counts.standard_error[i], np.sqrt(frequency * (1 - frequency) / n))
        assert abs(counts.probability[i] - frequency) < 5 * error
    assert np.ptp(counts.probability) > 0.1


@pytest.mark.slow
def test_counts_are_geometric_and_independent():
    counts = jb.hitting_counts(jax.random.key(1), paper_model(), some_bridges(1), num_counts=8_000)
    values = np.asarray(counts.counts[0], float)
    assert values.min() == 1 and values.sum() == int(counts.num_trials[0])
    p, n = float(counts.probability[0]), len(values)
    for k in (1, 2, 3, 5):
        expected = p * (1 - p) ** (k - 1)
        error = np.sqrt(expected * (1 - expected) / n)
        assert abs((values == k).mean() - expected) < 5 * error
    deviations = values - values.mean()
    assert abs((deviations[1:] * deviations[:-1]).mean()) < 5 * values.var() / np.sqrt(n)


def synthetic(counts, truncated=None):
    counts = jnp.asarray(counts)
    trials = jnp.sum(jnp.maximum(counts, 0), axis=1)
    truncated = jnp.zeros(len(counts), bool) if truncated is None else truncated
    start = jnp.zeros((len(counts), 2))
    return jb.HittingCounts(counts, truncated, trials, jnp.zeros_like(trials), start)


@pytest.mark.parametrize("probability", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("num_counts", [1, 2, 5, 50])
def test_estimates_from_counts_are_unbiased(probability, num_counts):
    n = 20_000
    drawn = np.random.default_rng(0).geometric(probability, size=(n, num_counts))
    counts = synthetic(drawn)
    for estimate, exact in [(counts.probability, probability), (counts.mean, 1 / probability)]:
        values = np.asarray(estimate, float)
        assert abs(values.mean() - exact) <= 5 * values.std() / np.sqrt(n) + 1e-6
    if num_counts == 50:
        stated, spread = float(jnp.mean(counts.standard_error)), jnp.std(counts.probability)
        assert stated == pytest.approx(1 / 50 if probability == 1 else float(spread), rel=0.1)


@pytest.mark.parametrize("probability", [0.99, 0.999])
def test_counts_that_are_all_one_have_an_error(probability):
    """Where hardly any trial misses, the estimate is still as far off as the error says."""
    drawn = np.random.default_rng(0).geometric(probability, size=(20_000, 20))
    counts = synthetic(drawn)
    all_one = (drawn == 1).all(1)
    assert 0.5 < all_one.mean() < 1
    error = np.asarray(counts.standard_error)
    np.testing.assert_allclose(error[all_one], 1 / 20, rtol=0.1)
    assert (abs(np.asarray(counts.probability) - probability) < 5 * error).mean() > 0.9999


def test_trials_that_ran_out_without_a_hit_tell_nothing():
    counts = jb.HittingCounts(
        jnp.array([[-1, -1, -1], [1, 1, -1], [-1, -1, -1]]),
        jnp.array([True, True, False]),
        jnp.array([64, 64, 0]),  # the last bridge is missing
        jnp.zeros(3, int),
        jnp.zeros((3, 2)),
    )
    np.testing.assert_array_equal(counts.standard_error, np.inf)


@pytest.mark.slow
def test_start_of_a_hit_follows_its_law():
    """x_0 of the trial that hit has a density ∝ μ(x) h(z|x): with γ = -1 and the reflection of
    a one-dimensional Brownian-like pair, starts close to the path's own start hit more often."""
    bridges = some_bridges(1, ends=([1.0, 1.0], [0.0, 0.0]))
    counts = jb.hitting_counts(jax.random.key(2), paper_model(), bridges)
    repeated = eqx_repeat(bridges, 4_000)
    starts = jb.hitting_counts(jax.random.key(2), paper_model(), repeated).start
    distance = jnp.linalg.norm(starts - jnp.array([1.0, 1.0]), axis=1)
    draws = jax.vmap(paper_model().sample_stationary)(jax.random.split(jax.random.key(3), 4_000))
    unconditional = jnp.linalg.norm(draws - jnp.array([1.0, 1.0]), axis=1)
    assert distance.mean() < unconditional.mean() - 0.1
    assert counts.start.shape == (1, 2)


def eqx_repeat(bridges, num):
    """The first bridge, `num` times."""
    fields = {
        name: jnp.repeat(getattr(bridges, name)[:1], num, axis=0)
        for name in ("paths", "met", "meeting_step", "reverse_start")
    }
    return jb.Bridges(
        times=bridges.times,
        num_proposals=bridges.num_proposals,
        num_nonfinite=bridges.num_nonfinite,
        coupling=bridges.coupling,
        num_steps=bridges.num_steps,
        **fields,
    )


@pytest.mark.slow
def test_results_do_not_depend_on_lanes_and_paths_stop_when_they_have_hit():
    """200 steps make four chunks, of which most trials need one or two."""
    bridges = some_bridges(40, num_steps=200)
    arguments = (jax.random.key(1), paper_model(), bridges, 5)
    many = jb.hitting_counts(*arguments)
    few = jb.hitting_counts(*arguments, batch_size=7)
    np.testing.assert_array_equal(many.counts, few.counts)
    np.testing.assert_allclose(many.start, few.start, atol=1e-6)


@pytest.mark.slow
def test_bounds_are_kept_and_flagged():
    bridges = some_bridges(20)
    far = jb.GaussianLaw([50.0, 50.0], 0.01 * jnp.eye(2))
    counts = jb.hitting_counts(
        jax.random.key(1), paper_model(), bridges, 3, start_law=far, max_trials=64
    )
    assert counts.truncated.all() and (counts.counts == -1).all()
    assert (counts.num_trials == 64).all()
    assert (counts.mean == 64).all() and (counts.probability == 0).all()
    some = jb.hitting_counts(jax.random.key(1), paper_model(), bridges, 30, max_trials=64)
    assert 0 < some.truncated.sum() < 20
    cut = np.asarray(some.truncated)
    hits = (np.asarray(some.counts) > 0).sum(1)
    assert (hits[~cut] == 30).all() and (hits[cut] < 30).all()
    assert (np.asarray(some.num_trials)[cut] == 64).all()
    assert np.isfinite(some.mean).all() and np.isfinite(some.probability).all()


@pytest.mark.slow
def test_missing_bridges_are_not_tried():
    bridges = jb.sample_bridges(
        jax.random.key(0), paper_model(), [0.0, 0.0], [9.0, 0.0], 0.01, max_proposals=3
    )
    counts = jb.hitting_counts(jax.random.key(1), paper_model(), bridges)
    assert counts.num_trials[0] == 0 and not counts.truncated[0]
    assert np.isnan(counts.mean[0]) and np.isnan(counts.probability[0])


@pytest.mark.slow
def test_weights_and_counts_from_one_key_are_independent():
    """A bridge's weight is the mean of counts of its own."""
    model, bridges, key = paper_model(), some_bridges(200), jax.random.key(0)
    weights = np.exp(np.asarray(jb.weigh_bridges(key, model, bridges).log_weights))
    counts = np.asarray(jb.hitting_counts(key, model, bridges).mean)
    assert (np.round(weights / weights.min()) != counts).mean() > 0.3


@pytest.mark.slow
def test_exploding_paths_do_not_hit_and_are_counted():
    """x - x³ in an Euler step from very far out overflows at once."""
    model = jb.langevin(lambda x, p: x @ x - (x @ x) ** 2 / 2)
    bridges = jb.sample_bridges(
        jax.random.key(0),
        model,
        [1.0, 0.0],
        [1.0, 0.0],
        2.0,
        num_bridges=5,
        num_steps=40,
        coupling=jb.Coupling(0.0, scheme=jb.Euler()),
    )
    law = jb.GaussianLaw([1e20, 0.0], jnp.eye(2))
    counts = jb.hitting_counts(jax.random.key(1), model, bridges, start_law=law, max_trials=10)
    assert (counts.num_nonfinite == 10).all() and counts.truncated.all()
