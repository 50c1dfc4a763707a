"""The study of accuracy: its process with a full σ(x), and what it prints."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies import figures
from studies.accuracy import (
    ACCURACY,
    EffectCost,
    curves,
    sigma_table,
    sinh_model,
    time_of_step,
)

import jaxbridge as jb
from jaxbridge.studies.paper import study_model


@pytest.mark.slow
def test_the_process_in_other_coordinates_is_reversible_too(x64):
    """α = ½(V ∇log ν + div V) holds drift, σ and ν to one another."""
    model, *_ = sinh_model()
    points = jax.random.normal(jax.random.key(0), (20, 2), jnp.float64)
    np.testing.assert_allclose(model.reversibility_residual(points), 0, atol=1e-6)
    sigma = np.asarray(jax.vmap(lambda x: model.forward(x).sigma(x).as_matrix(2, x.dtype))(points))
    covariance = sigma @ sigma.mT
    assert np.ptp(covariance[:, 0, 1]) > 1  # full, and of the state


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


def made_up(num_steps, error, per_second):
    words = ("weights", "Coupling(0)", "Heun", "BrownianCrossing", 0.0, "float32", num_steps)
    errors = (error, 1e-4, error, 1e-4, 0.0, 1e-4)
    return jb.Setting(*words, *errors, 1.0, 2.0, 100, per_second, per_second)


def test_tables_and_figures_render(tmp_path):
    heun = made_up(10, 0.08, 10.0), made_up(80, 0.01, 2.0)
    euler = tuple(s._replace(scheme="Euler", error=3 * s.error) for s in heun)
    one = jb.WorkPrecision(heun, "exact", 0.03)
    results = {f"order of {curve.name}": one for curve in curves()}
    results["the paper's process"] = jb.WorkPrecision(heun + euler, "exact", None)
    results["a full σ(x)"] = one
    costs = [EffectCost("one", 10.0), EffectCost("two", 25.0)]
    text = ACCURACY.tables((results, costs))
    assert "Heun with 10 steps: error 0.0800" in text and "accuracy 0.1 costs" in text
    assert "crossing, Heun" in text and "none of these settings" in text
    assert text.splitlines()[-1].split() == ["two", "25"]
    assert sigma_table([(2, 10.0, 25.0)])[1] == [("2", "10", "25", "2.5")]
    drawn = ACCURACY.draw(figures, (results, costs))
    assert list(drawn) == ["accuracy.png", "effects.png"]
    assert len(drawn["effects.png"].axes[0].patches) == 2
    for name, figure in drawn.items():
        figure.savefig(tmp_path / name)


@pytest.mark.slow
def test_a_step_takes_some_time():
    model = jb.hyperbolic(0.8, 2)
    assert 0 < time_of_step(jax.random.key(0), model, jb.Coupling(-1.0), 100, 2, False) < 1e6
