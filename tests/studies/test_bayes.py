"""The paper's Bayesian example: its oracle, its table and figures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies import bayes, figures
from studies.bayes import (
    brownian_posterior,
    format_bayes,
    hyperbolic_data,
    run_bayes,
    stationary_posterior,
)

import jaxbridge as jb


@pytest.mark.slow
def test_brownian_bridges_give_the_likelihood_of_the_trapezoid_rule():
    """The same posterior from `transition_log_density` with modified diffusion bridges."""
    data = hyperbolic_data(jax.random.key(0), 20, 1.0)
    exact = brownian_posterior(jax.random.key(1), data, 4_000)
    grid = jnp.linspace(0.3, 1.5, 13)

    def log_likelihood(alpha):
        estimate = jb.transition_log_density(
            jax.random.key(2),
            jb.hyperbolic(alpha, 2),
            data.observations[:-1],
            data.observations[1:],
            1.0,
            num_proposals=2_000,
            num_steps=20,
            proposal=jb.ModifiedDiffusionBridge(jb.ItoTaylorDensity()),
        )
        return jnp.sum(estimate.value)

    values = np.asarray(jax.lax.map(log_likelihood, grid), float)
    ours = np.log(np.interp(grid, exact.grid, exact.likelihood))
    difference = (ours - values) - (ours - values).mean()
    assert np.abs(difference).max() < 0.05
    assert exact.error < 0.1 * exact.sd


@pytest.mark.slow
def test_distant_observations_are_draws_from_the_stationary_law():
    data = hyperbolic_data(jax.random.key(0), 200, 20.0)
    exact = stationary_posterior(data)
    assert abs(exact.mean - 0.8) < 5 * exact.sd and 0.02 < exact.sd < 0.1


@pytest.mark.slow
def test_study_runs_and_renders(tmp_path, monkeypatch):
    """With one of its samplers, for each takes long to compile."""
    name = "exact, coupling"
    monkeypatch.setattr(bayes, "SAMPLERS", {name: bayes.SAMPLERS[name]})
    monkeypatch.setattr(bayes, "_AGAIN", (name,))
    monkeypatch.delitem(bayes.DISTANT, 'exact, "auto"')
    examples = run_bayes(jax.random.key(0), 0.04)
    text = format_bayes(examples)
    assert "exact, coupling" in text and "far apart" in text
    drawn = figures.bayes(examples[0])
    assert list(drawn) == ["bayes_posterior.png", "bayes_trace.png"]
    for name, figure in drawn.items():
        figure.savefig(tmp_path / name)
