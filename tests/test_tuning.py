"""Pilot runs find start laws and couplings that are better, and know when they are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import PAPER_CASES, paper_model

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


def test_errors_say_what_to_change():
    model = paper_model()
    with pytest.raises(TypeError, match="which `jit` and `vmap` hide"):
        jax.jit(lambda a: jb.fit_start_law(jax.random.key(0), model, a, a, 1.0))(jnp.zeros(2))
    with pytest.raises(ValueError, match="one interval"):
        jb.fit_start_law(
            jax.random.key(0), model, jnp.zeros((2, 2)), jnp.zeros((2, 2)), 1.0, num_pilot=40
        )


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
