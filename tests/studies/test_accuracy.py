"""The study of accuracy: its process with a full σ(x), and what it prints."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_work_precision import made_up, table

import jaxbridge as jb
from jaxbridge.studies import figures as study_figures
from jaxbridge.studies.accuracy import (
    EffectCost,
    curves,
    format_accuracy,
    format_effects,
    format_sigmas,
    sinh_model,
    time_of_step,
    write_accuracy_figures,
)
from jaxbridge.studies.paper import study_model


@pytest.mark.slow
def test_the_process_in_other_coordinates_is_reversible_too(x64):
    """α = ½(V ∇log ν + div V) holds drift, σ and ν to one another."""
    model, *_ = sinh_model()
    points = jax.random.normal(jax.random.key(0), (20, 2), jnp.float64)
    np.testing.assert_allclose(model.reversibility_residual(points), 0, atol=1e-6)
    assert jb.effects(model).solves.simulated


@pytest.mark.slow
def test_its_bridge_is_that_of_the_gaussian_one():
    _, start, end, (mean, sd) = sinh_model()
    ends = ([0.785, 0.785], [1.091, 1.091])
    exact = jb.gaussian_bridge(study_model(), *ends, 1.0, times=[0.5])
    mixing = np.array([[1.0, 0.5], [-0.5, 1.0]])
    draws = np.sinh(np.asarray(exact.sample(jax.random.key(0), 400_000)[:, 0], float)) @ mixing.T
    assert (np.abs(draws.mean(0) - mean) < 5 * sd / np.sqrt(400_000)).all()
    assert (np.abs(draws.std(0) / sd - 1) < 0.02).all()
    np.testing.assert_allclose(start, mixing @ np.sinh(ends[0]), rtol=1e-6)
    np.testing.assert_allclose(end, mixing @ np.sinh(ends[1]), rtol=1e-6)


def test_tables_and_figures_render(tmp_path):
    one = table(made_up(10, 0.08, 10.0), made_up(80, 0.01, 2.0), target=0.03)
    euler = [s._replace(scheme="Euler", error=3 * s.error) for s in one.settings]
    results = {f"order of {curve.name}": one for curve in curves()}
    results |= {"the paper's process": table(*one.settings, *euler), "a full σ(x)": one}
    text = format_accuracy(results)
    assert "Heun with 10 steps: error 0.0800" in text and "accuracy 0.1 costs" in text
    assert "crossing, Heun" in text and "none of these settings" in text
    costs = [EffectCost("one", 10.0), EffectCost("two", 25.0)]
    assert "25" in format_effects(costs) and "2.5" in format_sigmas([(2, 10.0, 25.0)])
    assert all(path.exists() for path in write_accuracy_figures(results, costs, tmp_path))
    assert len(study_figures.effect_costs(costs).patches) == 2


@pytest.mark.slow
def test_a_step_takes_some_time():
    model = jb.hyperbolic(0.8, 2)
    assert 0 < time_of_step(jax.random.key(0), model, jb.Coupling(-1.0), 100, 2, False) < 1e6
