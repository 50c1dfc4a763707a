"""Transition densities against the closed form."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    PAPER_CASES,
    count_compilations,
    exact_cases,
    paper_model,
)

import jaxbridge as jb

CASES = exact_cases()


@pytest.mark.slow
def test_density_is_that_of_the_closed_form():
    case = CASES["unlikely, gamma 0.5"]()
    estimate = jb.transition_log_density(
        jax.random.key(1),
        case.model,
        case.start,
        case.end,
        case.duration,
        num_proposals=50_000,
        num_steps=case.num_steps,
        proposal=case.coupling,
    )
    error = float(estimate.standard_error)
    assert error < 0.03 and estimate.num_truncated == 0
    assert abs(float(estimate.value) - case.log_density) < 5 * error + case.allowance


@pytest.mark.slow
@pytest.mark.parametrize(
    ("num_steps", "gamma", "reversible"),
    [(1, 0.5, False), (2, -1.0, True)],
)
def test_exact_transitions_leave_no_step_error(num_steps, gamma, reversible):
    """One step is as good as many, with no allowance."""
    model, (start, end) = paper_model(), PAPER_CASES["unlikely"]
    if not reversible:
        model = jb.ornstein_uhlenbeck([[1.0, 1.5], [-1.0, 0.5]], sigma=[[1.0, 0.4], [-0.2, 0.7]])
    estimate = jb.transition_log_density(
        jax.random.key(1),
        model,
        start,
        end,
        1.0,
        num_proposals=100_000,
        num_steps=num_steps,
        proposal=jb.Coupling(gamma, scheme=jb.GaussianTransition()),
    )
    exact = jb.ou_transition(model, jnp.asarray(start), 1.0).log_density(jnp.asarray(end))
    assert estimate.standard_error < 0.012
    assert abs(float(estimate.value - exact)) < 5 * float(estimate.standard_error)


@pytest.mark.slow
def test_published_start_law_fails():
    """Theorem 1 as printed starts the associated diffusion from p*_T(b, ·), which finds the
    bridge far too easily: 0.02 of the density remains."""
    ends = PAPER_CASES["very unlikely"]
    model = paper_model()
    coupling = jb.Coupling(0.5, start_law=jb.Reversed())
    estimate = jb.transition_log_density(
        jax.random.key(1), model, *ends, 1.0, num_proposals=20_000, num_steps=40, proposal=coupling
    )
    exact = jb.ou_transition(model, jnp.asarray(ends[0]), 1.0).log_density(jnp.asarray(ends[1]))
    ratio = float(jnp.exp(estimate.value - exact))
    assert estimate.standard_error < 0.02
    assert 0.015 < ratio < 0.03  # nowhere near 1, within 5 standard errors and 3 %
    assert ratio + 5 * ratio * float(estimate.standard_error) + 0.03 < 1


@pytest.mark.slow
def test_standard_error_is_that_of_repetitions_and_the_estimate_unbiased():
    model, ends = paper_model(), PAPER_CASES["unlikely"]
    estimates = jax.jit(
        jax.vmap(
            lambda key: jb.transition_log_density(
                key, model, *ends, 1.0, num_proposals=400, num_steps=20, proposal=jb.Coupling(0.5)
            )
        )
    )(jax.random.split(jax.random.key(0), 400))
    exact = jb.ou_transition(model, jnp.asarray(ends[0]), 1.0).log_density(jnp.asarray(ends[1]))
    ratio = np.exp(np.asarray(estimates.value, float) - float(exact))
    error = ratio.std() / np.sqrt(len(ratio))
    assert abs(ratio.mean() - 1) < 5 * error + 0.015  # the allowance is for the step
    spread, stated = ratio.std(), np.median(np.asarray(estimates.standard_error))
    assert abs(stated / spread - 1) < 5 / np.sqrt(2 * len(ratio)) + 0.05


@pytest.mark.slow
def test_normaliser_of_the_stationary_density_cancels_where_the_start_law_has_one():
    ends = ([0.3, 0.1], [-0.2, 0.4])
    law = jb.GaussianLaw([0.0, 0.0], 0.5 * jnp.eye(2))

    def estimate(shift):
        model = jb.langevin(lambda x, p: p - 1.5 * x @ x, shift)
        return jb.transition_log_density(
            jax.random.key(0),
            model,
            *ends,
            1.0,
            num_proposals=20_000,
            proposal=jb.Coupling(0.3, start_law=law),
        )

    first, second = estimate(0.0), estimate(7.0)
    np.testing.assert_allclose(first.value, second.value, atol=1e-4)
    exact = jb.ou_transition(jb.ornstein_uhlenbeck(1.5 * jnp.eye(2)), jnp.asarray(ends[0]), 1.0)
    exact = float(exact.log_density(jnp.asarray(ends[1])))
    assert abs(float(first.value) - exact) < 5 * float(first.standard_error) + 0.01


@pytest.mark.slow
def test_thousands_of_pairs_at_once_without_compiling_again():
    model = paper_model()
    rng = np.random.default_rng(0)
    starts, ends = rng.normal(size=(2, 1000, 2)).astype(np.float32) * 0.6
    durations = rng.uniform(0.5, 2.0, 1000).astype(np.float32)

    def run(seed, durations):
        return jb.transition_log_density(
            jax.random.key(seed),
            model,
            starts,
            ends,
            durations,
            num_proposals=100,
            num_steps=20,
            proposal=jb.Coupling(0.5),
            max_trials=50_000 + seed,
        )

    estimates = run(0, durations)
    exact = jax.vmap(lambda a, b, t: jb.ou_transition(model, a, t).log_density(b))(
        starts, ends, durations
    )
    assert estimates.value.shape == (1000,)
    ratio = np.exp(np.asarray(estimates.value - exact, float))
    # Unbiased for each pair, so on average over pairs: a mean of 1,000 ratios.
    assert abs(ratio.mean() - 1) < 5 * ratio.std() / np.sqrt(1000) + 0.015
    with count_compilations() as compiled:
        jax.block_until_ready(run(1, durations + 0.1))
    assert len(compiled) == 0


@pytest.mark.slow
def test_nothing_met_is_minus_infinity_and_said():
    estimate = jb.transition_log_density(
        jax.random.key(0), paper_model(), [0.0, 0.0], [5.0, 5.0], 0.01, num_proposals=50
    )
    assert estimate.value == -jnp.inf and estimate.standard_error == jnp.inf
    assert estimate.num_met == 0 and estimate.effective_sample_size == 0


@pytest.mark.slow
def test_a_law_that_nothing_hits_from_is_flagged():
    law = jb.GaussianLaw([30.0, -30.0], 0.01 * jnp.eye(2))
    estimate = jb.transition_log_density(
        jax.random.key(0),
        paper_model(),
        [0.0, 0.0],
        [0.5, 0.0],
        1.0,
        num_proposals=50,
        proposal=jb.Coupling(0.5, start_law=law),
        max_trials=200,
    )
    assert estimate.num_truncated == estimate.num_met > 0
    # The estimate is too small by an unknown factor, which no standard error tells.
    assert np.isfinite(estimate.value) and estimate.standard_error == np.inf


@pytest.mark.slow
def test_an_error_is_not_stated_where_weights_were_cut_off():
    """Of two intervals only the one whose bridges are hard to hit."""
    estimate = jb.transition_log_density(
        jax.random.key(0),
        paper_model(),
        [[0.0, 0.0], [2.0, -2.0]],
        [[0.0, 0.0], [3.0, -3.0]],
        1.0,
        num_proposals=100,
        num_steps=10,
        proposal=jb.Coupling(0.5),
        max_trials=60,
    )
    assert estimate.num_truncated[0] == 0 < estimate.num_truncated[1]
    assert np.isfinite(estimate.standard_error[0]) and estimate.standard_error[1] == np.inf


@pytest.mark.slow
def test_what_the_refusal_recommends_is_right():
    """The remedies on a model whose `log_stationary` has a constant of 7 in it."""
    ends = ([0.2], [0.5], 1.0)
    model = jb.langevin(lambda x, p: 7 - x @ x)
    declared = jb.langevin(lambda x, p: -x @ x - jnp.log(jnp.pi) / 2, normalised=True)
    exact = jb.ou_transition(jb.ornstein_uhlenbeck([[1.0]]), jnp.array([0.2]), 1.0)
    exact = float(exact.log_density(jnp.array([0.5])))
    law = jb.GaussianLaw([0.0], [[0.5]])
    for case, proposal in [
        (declared, None),
        (model, None),  # which has no sampler, and so a start law with a density
        (model, jb.Coupling(0.0, start_law=law)),
        (model, "auto"),
    ]:
        estimate = jb.transition_log_density(
            jax.random.key(0), case, *ends, num_proposals=10_000, num_steps=20, proposal=proposal
        )
        error = float(estimate.standard_error)
        assert error < 0.03
        assert abs(float(estimate.value) - exact) < 5 * error + 0.005


@pytest.mark.slow
@pytest.mark.optimised
def test_rounding_of_very_many_steps_is_told():
    """In single precision 100,000 steps put log p off by 0.005, which no other error tells: all
    weights of a linear process are equal."""
    model, N = jb.ornstein_uhlenbeck([[1.0]]), 100_000
    made = jb.transition_log_density(
        jax.random.key(0),
        model,
        [0.0],
        [1.0],
        1.0,
        num_proposals=8,
        num_steps=N,
        proposal=jb.Guided(),
    )
    variance = (1 - math.exp(-2)) / 2
    exact = -0.5 / variance - math.log(2 * math.pi * variance) / 2
    off = abs(made.value - exact)
    assert off > 3 * made.standard_error and off > 10 * abs(made.step_error)  # but for rounding
    assert off < 2 * made.step_uncertainty < 0.02
    assert made.step_error_dominates
