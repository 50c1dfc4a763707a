"""Weights correct approximate bridges to the exact law."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    PAPER_CASES,
    assert_weighted_moments,
    exact_case,
    exact_cases,
    paper_model,
)

import jaxbridge as jb

CASES = exact_cases()


def weighted_bridges(case, num_bridges, seed=0, **options):
    bridges = jb.sample_bridges(
        jax.random.key(seed),
        case.model,
        case.start,
        case.end,
        case.duration,
        num_bridges=num_bridges,
        num_steps=case.num_steps,
        coupling=case.coupling,
    )
    return jb.weigh_bridges(jax.random.key(seed), case.model, bridges, **options)


@pytest.mark.slow
def test_weighted_midpoints_have_the_exact_law():
    """Of bridges that were made before."""
    case = CASES["unlikely, gamma 0.5"]()
    weighted = weighted_bridges(case, 30_000)
    middle = case.middle(weighted.paths)
    size = assert_weighted_moments(middle, weighted.weights, case.mean, case.covariance)
    assert size == pytest.approx(float(weighted.effective_sample_size), rel=1e-3)
    assert size > 800 and not weighted.truncated.any()


@pytest.mark.slow
def test_two_exact_transitions_are_as_good_as_many():
    """The law half way, from two steps of length ½."""
    case = exact_case(paper_model(), *PAPER_CASES["unlikely"], 1.0, 0.5)
    weighted = jb.sample_weighted_bridges(
        jax.random.key(0),
        case.model,
        case.start,
        case.end,
        1.0,
        num_bridges=30_000,
        num_steps=2,
        proposal=jb.Coupling(0.5, scheme=jb.GaussianTransition()),
    )
    middle = np.asarray(weighted.paths[:, 1])
    assert assert_weighted_moments(middle, weighted.weights, case.mean, case.covariance) > 6_000


@pytest.mark.slow
def test_unweighted_and_published_midpoints_fail_the_same_test():
    case = exact_case(paper_model(), *PAPER_CASES["very unlikely"], 1.0, 0.5)
    raw = weighted_bridges(case, 10_000)
    with pytest.raises(AssertionError):
        assert_weighted_moments(case.middle(raw.paths), np.ones(10_000), case.mean, case.covariance)
    published = weighted_bridges(case._replace(start_law=jb.Reversed()), 10_000)
    with pytest.raises(AssertionError):
        assert_weighted_moments(
            case.middle(published.paths), published.weights, case.mean, case.covariance
        )


@pytest.mark.slow
def test_random_gamma_and_more_counts_keep_the_law():
    """The associated diffusions draw their own γ."""
    case = exact_case(
        paper_model(),
        *PAPER_CASES["unlikely"],
        1.0,
        lambda key: jax.random.uniform(key, minval=-0.9, maxval=0.95),
    )
    weighted = weighted_bridges(case, 20_000, num_counts=3)
    assert_weighted_moments(
        case.middle(weighted.paths), weighted.weights, case.mean, case.covariance
    )


@pytest.mark.slow
def test_several_intervals_are_weighed_as_one_by_one():
    model, durations = paper_model(), jnp.array([1.0, 1.5])
    starts, ends = jnp.array([[0.3, 0.1], [0.785, 0.785]]), jnp.array([[0.0, 0.5], [1.0, 1.0]])
    bridges = jb.sample_bridges(
        jax.random.key(0), model, starts, ends, durations, num_bridges=4_000, num_steps=30
    )
    weighted = jb.weigh_bridges(jax.random.key(1), model, bridges)
    assert weighted.log_weights.shape == (2, 4_000) and weighted.num_simulated.shape == (2,)
    mean = weighted.mean(lambda path: {"middle": path[15]})["middle"]
    error = weighted.standard_error(lambda path: path[15])
    for i in range(2):
        law = jb.gaussian_bridge(model, starts[i], ends[i], durations[i], [durations[i] / 2])
        np.testing.assert_array_less(np.abs(mean[i] - law.mean[0]), 5 * np.asarray(error[i]))
        assert_weighted_moments(
            weighted.paths[i, :, 15], weighted.weights[i], law.mean[0], law.covariance[0]
        )
    resampled = weighted.resample(jax.random.key(2), 500)
    assert resampled.shape == (2, 500, 31, 2)


@pytest.mark.slow
def test_means_errors_and_resampling_follow_the_weights():
    weighted = weighted_bridges(exact_case(paper_model(), [0.0, 0.0], [0.5, 0.0], 1.0, 0.5), 200)
    weights, paths = np.asarray(weighted.weights, float), np.asarray(weighted.paths, float)
    np.testing.assert_allclose(weights.sum(), 1, rtol=1e-5)
    expected = np.tensordot(weights, paths, 1)
    np.testing.assert_allclose(weighted.mean(), expected, atol=1e-5)
    error = np.sqrt(np.tensordot(weights**2, (paths - expected) ** 2, 1))
    np.testing.assert_allclose(weighted.standard_error(), error, atol=1e-5)
    copies = np.asarray(weighted.resample(jax.random.key(0), 1000))
    for i in range(200):  # systematic: each path n w times, up to one
        count = (copies[:, 20] == np.float32(paths[i, 20])).all(axis=-1).sum()
        assert abs(count - 1000 * weights[i]) < 1 + 1e-3


@pytest.mark.slow
def test_missing_bridges_weigh_nothing():
    model = paper_model()
    bridges = jb.sample_bridges(
        jax.random.key(0), model, [0.0, 0.0], [0.5, 0.0], 1.0, num_bridges=50, max_proposals=40
    )
    assert 0 < bridges.met.sum() < 50
    weighted = jb.weigh_bridges(jax.random.key(1), model, bridges)
    assert (weighted.log_weights[~bridges.met] == -jnp.inf).all()
    assert np.isfinite(weighted.mean()).all()
    assert np.isfinite(weighted.resample(jax.random.key(0), 100)).all()
    none = jb.sample_bridges(
        jax.random.key(0), model, [0.0, 0.0], [9.0, 0.0], 0.01, num_bridges=5, max_proposals=7
    )
    weighted = jb.weigh_bridges(jax.random.key(1), model, none)
    assert weighted.effective_sample_size == 0 and not weighted.met.any()


@pytest.mark.parametrize(
    "mean, covariance", [([40.0, 40.0], 0.01), ([0.0, 0.0], 1e-4), ([5.0, -5.0], 0.2)]
)
@pytest.mark.slow
def test_a_law_that_does_not_cover_is_flagged_and_finite(mean, covariance):
    law = jb.GaussianLaw(mean, covariance * jnp.eye(2))
    case = exact_case(paper_model(), [2.0, -2.0], [3.0, -3.0], 1.0, 0.5, law)
    weighted = weighted_bridges(case, 500, max_trials=50)
    assert np.isfinite(weighted.log_weights).all()
    # Either the counts are cut off, or a few starts have all the weight.
    assert weighted.truncated.mean() > 0.05 or weighted.effective_sample_size < 50
