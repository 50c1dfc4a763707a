"""Pilot runs find start laws and couplings that are better, and know when they are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fokker_planck import solve_model
from helpers import PAPER_CASES, paper_model
from scipy.integrate import quad

import jaxbridge as jb

VERY_UNLIKELY = PAPER_CASES["very unlikely"]


def efficiency(ends, law, num_bridges=20_000):
    """Effective samples per simulated path, on a sample of its own."""
    model = paper_model()
    bridges = jb.sample_bridges(
        jax.random.key(7),
        model,
        *ends,
        1.0,
        num_bridges=num_bridges,
        num_steps=40,
        coupling=jb.Coupling(0.5),
    )
    return float(jb.weigh_bridges(jax.random.key(8), model, bridges, start_law=law).efficiency)


def fitted(ends):
    return jb.fit_start_law(
        jax.random.key(0), paper_model(), *ends, 1.0, num_steps=40, coupling=jb.Coupling(0.5)
    )


@pytest.mark.slow
def test_fitted_law_is_eight_times_better_on_a_very_unlikely_bridge():
    law = fitted(VERY_UNLIKELY)
    assert isinstance(law, jb.GaussianLaw)
    ratio = efficiency(VERY_UNLIKELY, law) / efficiency(VERY_UNLIKELY, jb.Stationary(), 5_000)
    assert ratio > 8


@pytest.mark.slow
def test_law_stays_close_to_the_stationary_one_where_that_is_best():
    ends = ([0.0, 0.0], [2.0, -2.0])
    law = fitted(ends)
    assert efficiency(ends, law) > 0.95 * efficiency(ends, jb.Stationary())
    if isinstance(law, jb.GaussianLaw):
        stationary = jb.ou_stationary(paper_model())
        sd = jnp.sqrt(jnp.diag(stationary.covariance))
        assert (jnp.abs(law.mean - stationary.mean) < 0.5 * sd).all()
        assert (jnp.diag(law.covariance) > 0.5 * sd**2).all()


@pytest.mark.slow
def test_tuning_chooses_the_best_pilot_and_prints_all():
    couplings = [jb.Coupling(0.0), jb.Coupling(0.9)]
    tuning = jb.tune_coupling(
        jax.random.key(0),
        paper_model(),
        *VERY_UNLIKELY,
        1.0,
        num_steps=40,
        couplings=couplings,
        num_pilot=500,
    )
    best = max(pilot.efficiency for pilot in tuning.pilots)
    chosen = [p for p in tuning.pilots if p.coupling is tuning.coupling]
    assert len(tuning.pilots) == 12 and len(chosen) == 1
    assert chosen[0].efficiency > best / 1.11 and chosen[0].fit_share > 0
    lines = str(tuning).splitlines()
    assert len(lines) == 13 and sum("chosen" in line for line in lines) == 1
    assert {pilot.gamma for pilot in tuning.pilots} == {0.0, np.float32(0.9)}


@pytest.mark.slow
def test_model_without_a_density_or_a_sampler():
    """Then ν, by a run, is the only law there is."""
    model = jb.Diffusion(lambda x, p: -x, reversible=True)
    law = jb.fit_start_law(jax.random.key(0), model, [0.5], [0.2], 1.0, num_steps=10, num_pilot=100)
    assert isinstance(law, jb.Stationary) and law.burn_in > 2


@pytest.mark.slow
def test_a_law_for_densities_does_not_rest_on_the_normaliser():
    """The same process with a constant of 7 in log ν, where ν itself would be the best law."""
    ends = ([0.0], [0.3])
    model = jb.Diffusion(
        lambda x, p: -x,
        None,
        lambda x, p: 7 - x @ x,
        reversible=True,
        sample_stationary=lambda key, p: jax.random.normal(key, (1,)) / jnp.sqrt(2.0),
    )
    options = dict(num_steps=20, num_pilot=300)
    assert isinstance(
        jb.fit_start_law(jax.random.key(0), model, *ends, 1.0, **options), jb.Stationary
    )
    law = jb.fit_start_law(jax.random.key(0), model, *ends, 1.0, for_density=True, **options)
    tuning = jb.tune_coupling(
        jax.random.key(0), model, *ends, 1.0, couplings=[jb.Coupling(0.0)], for_density=True,
        **options,
    )  # fmt: skip
    exact = jb.ou_transition(jb.ornstein_uhlenbeck([[1.0]]), jnp.array(ends[0]), 1.0)
    exact = float(exact.log_density(jnp.array(ends[1])))
    for coupling in (jb.Coupling(0.0, start_law=law), tuning.coupling):
        assert isinstance(coupling.start_law, jb.GaussianLaw)
        estimate = jb.transition_log_density(
            jax.random.key(1), model, *ends, 1.0, num_proposals=10_000, num_steps=20,
            proposal=coupling,
        )  # fmt: skip
        error = float(estimate.standard_error)
        assert error < 0.05
        assert abs(float(estimate.value) - exact) < 5 * error + 0.01
    declared = jb.fit_start_law(
        jax.random.key(0), jb.ornstein_uhlenbeck([[1.0]]), *ends, 1.0, for_density=True, **options
    )
    assert isinstance(declared, jb.Stationary)


@pytest.mark.slow
def test_a_choice_for_densities_may_be_used_for_them():
    """Over many changes of well, where only couplings serve, and these must have a law with a
    density."""
    model = jb.langevin(lambda x, p: 7 - 2.5 * jnp.sum((x**2 - 1) ** 2))
    ends = ([-1.0], [1.0], 60.0)
    choice = jb.choose_proposal(jax.random.key(0), model, *ends, num_steps=600, for_density=True)
    coupled = [each.coupling for each in choice.candidates if isinstance(each, jb.CoupledPairs)]
    assert len(coupled) == 1 and isinstance(coupled[0].start_law, jb.GaussianLaw)
    estimate = jb.transition_log_density(
        jax.random.key(1), model, *ends, num_steps=600, num_proposals=1_000, proposal=choice
    )
    # After so many relaxation times, of 5.4 by Kramers' formula, the density is the stationary one.
    constant, _ = quad(lambda x: np.exp(-2.5 * (x**2 - 1) ** 2), -4, 4)
    error = float(estimate.standard_error)
    assert error < 0.1
    assert abs(float(estimate.value) + np.log(constant)) < 5 * error + 0.02


@pytest.mark.slow
def test_pilot_runs_that_find_nothing_are_refused():
    with pytest.raises(ValueError, match="no pilot run succeeded"):
        jb.fit_start_law(
            jax.random.key(0),
            paper_model(),
            [0.0, 0.0],
            [3.0, 0.0],
            0.01,
            num_pilot=40,
            num_steps=5,
        )


@pytest.mark.slow
def test_fitted_laws_stay_where_paths_start():
    """A double well, whose ν has lighter tails than any normal law. A normal law as wide as ν has a
    tenth of its mass where no path starts, so densities would be too small by as much."""
    model = jb.Diffusion(
        lambda x, p: x - x**3, [[0.5]], log_stationary=lambda x, p: 4 * x[0] ** 2 - 2 * x[0] ** 4
    )
    exact = solve_model(model, [-1.0], [1.0], 5.0, [(-3.0, 3.0)], 201).log_density
    z = []
    for key in jax.random.split(jax.random.key(0), 8):
        arguments = (key, model, [-1.0], [1.0], 5.0)
        law = jb.fit_start_law(*arguments, num_steps=100, for_density=True)
        made = jb.transition_log_density(
            *arguments,
            num_steps=100,
            num_proposals=10_000,
            proposal=jb.Coupling(0.0, start_law=law),
        )
        z.append((float(made.value) - exact) / float(made.standard_error))
    # The error of the steps is about a quarter of a standard error.
    assert abs(np.mean(z)) < 4 / np.sqrt(8) + 0.25 and np.sqrt(np.mean(np.square(z))) < 2
