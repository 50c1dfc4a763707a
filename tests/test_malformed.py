"""What is malformed is refused by every public function, before anything is compiled, with a
sentence that names the argument."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import paper_model

import jaxbridge as jb
from jaxbridge.inference.data import as_observations

KEY, A, B = jax.random.key(0), [0.0, 0.0], [1.0, 0.0]
LAW = jb.GaussianLaw([0.0, 0.0], jnp.eye(2))
MODEL = jb.hyperbolic(0.8, 2)
TIMES, POINTS = [0.0, 1.0, 2.0], [[0.0, 0.0], [0.5, 0.2], [0.1, 0.3]]
PRIOR = jb.NormalPrior(1.0, 1.0)


def refused(call, *arguments):
    with pytest.raises((ValueError, TypeError)) as caught:
        call(*arguments)
    message = str(caught.value)
    assert "`" in message and "Tracer" not in message
    return message


# Functions of a key, a model and an interval.

OF_AN_INTERVAL = {
    "sample_bridges": jb.sample_bridges,
    "sample_weighted_bridges": jb.sample_weighted_bridges,
    "sample_exact_bridges": jb.sample_exact_bridges,
    "transition_log_density": lambda *a: jb.transition_log_density(
        *a, proposal=jb.Coupling(start_law=LAW)
    ),
    "gaussian_bridge": lambda key, *a: jb.gaussian_bridge(*a, times=[0.5]),
    "work_precision": jb.work_precision,
    "fit_start_law": jb.fit_start_law,
    "tune_coupling": jb.tune_coupling,
    "choose_proposal": jb.choose_proposal,
    "pseudo_marginal": lambda key, *a: jb.pseudo_marginal(*a).init(key),
    "renewal": lambda key, *a: jb.renewal(*a).init(key),
    "crank_nicolson": lambda key, *a: jb.crank_nicolson(*a).init(key),
}

INTERVALS = {
    "a point of another dimension": (paper_model, [0.0], B, 1.0),
    "points in a cube": (paper_model, [[[0.0, 0.0]]], B, 1.0),
    "a point that is missing": (paper_model, [np.nan, 0.0], B, 1.0),
    "a point in words": (paper_model, "here", B, 1.0),
    "complex numbers": (paper_model, [1j, 0.0], B, 1.0),
    "no time at all": (paper_model, A, B, 0.0),
    "time that runs backwards": (paper_model, A, B, -1.0),
    "a model that is none": (lambda: 3.0, A, B, 1.0),
}


@pytest.mark.parametrize("malformed", INTERVALS)
@pytest.mark.parametrize("name", OF_AN_INTERVAL)
def test_intervals(name, malformed, unchecked):
    model, *rest = INTERVALS[malformed]
    refused(OF_AN_INTERVAL[name], KEY, model(), *rest)


# Functions of a model and observations.

OF_OBSERVATIONS = {
    "gibbs": lambda *a: jb.gibbs(KEY, *a, prior=PRIOR),
    "pmmh": lambda *a: jb.pmmh(KEY, *a, prior=PRIOR),
    "score": lambda *a: jb.score(KEY, *a),
    "maximum_likelihood": lambda *a: jb.maximum_likelihood(KEY, *a),
    "path_log_likelihood": jb.path_log_likelihood,
}

OBSERVATIONS = {
    "one time less than points": (MODEL, [0.0, 1.0], POINTS),
    "times that do not increase": (MODEL, [0.0, 1.0, 1.0], POINTS),
    "a time that is missing": (MODEL, [0.0, np.nan, 2.0], POINTS),
    "times in words": (MODEL, "often", POINTS),
    "a point alone": (MODEL, [0.0], [[0.0, 0.0]]),
    "points without coordinates": (MODEL, TIMES, [0.0, 0.5, 0.1]),
    "points in words": (MODEL, TIMES, "there"),
    "complex numbers": (MODEL, TIMES, [[1j, 0.0]] * 3),
    "a point that is missing": (MODEL, TIMES, [[0.0, 0.0], [np.nan, 0.2], [0.1, 0.3]]),
    "a model that is none": ("model", TIMES, POINTS),
}


@pytest.mark.parametrize("malformed", OBSERVATIONS)
@pytest.mark.parametrize("name", OF_OBSERVATIONS)
def test_observations(name, malformed, unchecked):
    if (name, malformed) == ("path_log_likelihood", "a point that is missing"):
        pytest.skip("a likelihood of NaN is data: bridges that were not found are NaN")
    refused(OF_OBSERVATIONS[name], *OBSERVATIONS[malformed])


@pytest.mark.parametrize(
    ("times", "points", "sentence"),
    [
        (
            TIMES,
            np.ma.masked_invalid([[0.0, 0.0], [np.nan, np.nan], [0.1, 0.3]]),
            r"`observations\[1\]` is masked but .* the whole row with its time",
        ),
        (
            TIMES,
            np.ma.masked_invalid([[0.0, 0.0], [0.5, 0.2], [0.1, np.nan]]),
            r"`observations\[2\]` is masked, in coordinate 1, but .* the whole row",
        ),
        (
            np.ma.masked_equal(TIMES, 1.0),
            POINTS,
            r"`times\[1\]` is masked but observations must be complete",
        ),
        (
            TIMES,
            [[0.0, 0.0], [0.5, np.nan], [0.1, 0.3]],
            r"`observations\[1\]` = .* for coordinate 1, but .* leave out this row, with its time",
        ),
        (
            TIMES,
            [[0.0, 0.0], [0.5, 0.2], [np.nan, np.nan]],
            r"`observations\[2\]` = .* is not finite: leave out observations that are missing",
        ),
    ],
)
def test_what_is_missing_is_named(times, points, sentence, unchecked):
    with pytest.raises(ValueError, match=sentence):
        as_observations(MODEL, times, points)


def test_masked_arrays_without_anything_masked_are_arrays():
    masked = as_observations(MODEL, np.ma.masked_less(TIMES, -1), np.ma.masked_invalid(POINTS))
    plain = as_observations(MODEL, TIMES, POINTS)
    jax.tree.map(np.testing.assert_array_equal, masked, plain)


# Counts, and functions of what others return.


@pytest.mark.parametrize("count", [0, -1, 2.5, True])
def test_counts(count, unchecked):
    ends = (KEY, paper_model(), A, B, 1.0)
    for call, argument in [
        (lambda: jb.sample_bridges(*ends, num_bridges=count), "num_bridges"),
        (lambda: jb.sample_bridges(*ends, num_bridges=1, num_steps=count), "num_steps"),
        (lambda: jb.sample_bridges(*ends, num_bridges=1, max_proposals=count), "max_proposals"),
        (lambda: jb.sample_bridges(*ends, num_bridges=1, batch_size=count), "batch_size"),
        (lambda: jb.sample_weighted_bridges(*ends, num_bridges=count), "num_bridges"),
        (lambda: jb.sample_exact_bridges(*ends, num_bridges=count), "num_bridges"),
        (lambda: jb.transition_log_density(*ends, num_proposals=count), "num_proposals"),
        (lambda: jb.gibbs(KEY, MODEL, TIMES, POINTS, prior=PRIOR, num_iterations=count), "num_it"),
        (lambda: jb.gibbs(KEY, MODEL, TIMES, POINTS, prior=PRIOR, thin=count), "thin"),
        (lambda: jb.pmmh(KEY, MODEL, TIMES, POINTS, prior=PRIOR, num_iterations=count), "num_it"),
        (lambda: jb.pmmh(KEY, MODEL, TIMES, POINTS, prior=PRIOR, num_proposals=count), "num_pr"),
        (lambda: jb.score(KEY, MODEL, TIMES, POINTS, num_bridges=count), "num_bridges"),
        (lambda: jb.maximum_likelihood(KEY, MODEL, TIMES, POINTS, num_bridges=count), "num_br"),
        (lambda: jb.simulate(KEY, MODEL, A, TIMES, num_paths=count), "num_paths"),
        (lambda: jb.measure_burn_in(KEY, MODEL, A, 1.0, num_steps=count), "num_steps"),
    ]:
        assert f"`{argument}" in refused(call)


def test_results_of_another_kind(unchecked):
    for call in (
        lambda: jb.weigh_bridges(KEY, MODEL, [0.0, 1.0]),
        lambda: jb.hitting_counts(KEY, MODEL, 3.0),
        lambda: jb.hitting_variation(KEY, MODEL, 3.0),
        lambda: jb.expectation(lambda path: path, 3.0, MODEL),
        lambda: jb.effective_sample_size("many"),
        lambda: jb.potential_scale_reduction("many"),
    ):
        refused(call)


def test_what_models_are_made_of(unchecked):
    for call in (
        lambda: jb.Diffusion(3.0),
        lambda: jb.Diffusion(lambda x, p: -x, jnp.ones((2, 3))),
        lambda: jb.Diffusion(lambda x, p: -x, jnp.zeros((2, 2))),
        lambda: jb.langevin(3.0),
        lambda: jb.stationary_diffusion(3.0),
        lambda: jb.hyperbolic(0.8, 0),
        lambda: jb.hyperbolic("steep", 2),
        lambda: jb.ornstein_uhlenbeck("steep"),
        lambda: jb.ornstein_uhlenbeck([[1.0, 0.0]]),
        lambda: jb.ornstein_uhlenbeck([[-1.0]]),
        lambda: jb.Coupling(1.0),
        lambda: jb.Coupling(np.nan),
        lambda: jb.Coupling("none"),
        lambda: jb.Coupling(0.0, scheme="Heun"),
        lambda: jb.Coupling(0.0, meeting="crossing"),
        lambda: jb.SignTest(-1.0),
        lambda: jb.GaussianLaw([0.0, 0.0], -jnp.eye(2)),
        lambda: jb.GaussianLaw([0.0], jnp.eye(2)),
        lambda: jb.gibbs(KEY, MODEL, TIMES, POINTS, prior=jb.NormalPrior(0.0, -1.0)),
        lambda: jb.gibbs(KEY, MODEL, TIMES, POINTS, prior="flat"),
        lambda: jb.Guided("sideways"),
        lambda: jb.ModifiedDiffusionBridge(density="exact"),
        lambda: jb.simulate(KEY, MODEL, A, [1.0, 0.0]),
        lambda: jb.simulate(KEY, paper_model(), [0.0], TIMES),
        lambda: jb.measure_burn_in(KEY, MODEL, A, -1.0),
        lambda: jb.effects(3.0),
    ):
        refused(call)


def test_keys(unchecked):
    for key in (0, None, jnp.zeros(2, jnp.uint32)):
        for call in (
            lambda key=key: jb.sample_bridges(key, MODEL, A, B, 1.0, num_bridges=1),
            lambda key=key: jb.transition_log_density(key, MODEL, A, B, 1.0),
            lambda key=key: jb.gibbs(key, MODEL, TIMES, POINTS, prior=PRIOR),
            lambda key=key: jb.pmmh(key, MODEL, TIMES, POINTS, prior=PRIOR),
            lambda key=key: jb.simulate(key, MODEL, A, TIMES),
        ):
            assert "`key`" in refused(call)
