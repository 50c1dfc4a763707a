"""The study beside other packages: closed forms, what is missing, and what is stored."""

import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate
from studies import figures, rival_bridges, rival_events, rival_filters, rival_posteriors
from studies.peers import NOT_INSTALLED, in_r, where_installed
from studies.rivals import (
    Rivals,
    Sizes,
    as_page,
    in_plain_characters,
    load_rivals,
    rivals_files,
)

NOTEBOOKS = pathlib.Path(__file__).parents[2] / "notebooks"


def silent(_):
    pass


@pytest.mark.parametrize("start", [1.5, 3.0])
def test_the_radial_density_is_a_density_and_solves_chapman_and_kolmogorov(start):
    density = lambda x, y, t: np.exp(rival_bridges.radial_log_density(x, y, t))
    mass, _ = integrate.quad(lambda y: density(start, y, 1.0), 0, 10)
    assert abs(mass - 1) < 1e-6
    via, _ = integrate.quad(lambda z: density(start, z, 0.4) * density(z, 2.5, 0.6), 1e-6, 10)
    assert abs(via / density(start, 2.5, 1.0) - 1) < 1e-6
    # Itô's formula: E X² has the slope 9 - 2 E X², which tells the drift.
    square, _ = integrate.quad(lambda y: y**2 * density(start, y, 1.0), 0, 10)
    assert abs(square - (4.5 + (start**2 - 4.5) * np.exp(-2.0))) < 1e-6


def test_the_other_densities_integrate_to_one():
    law = lambda y: np.exp(rival_bridges.ou_log_density(2.0, 1.0, y, 1.0))
    assert abs(integrate.quad(law, -6, 6)[0] - 1) < 1e-6
    law = lambda y: np.exp(rival_posteriors.ou_log_density(0.7, y, 0.8))
    assert abs(integrate.quad(law, -6, 8)[0] - 1) < 1e-6
    law = lambda y: np.exp(rival_posteriors.cir_log_density(0.3, y, 1.0, 0.6))
    assert abs(integrate.quad(law, 0, 8)[0] - 1) < 1e-6
    mean, _ = integrate.quad(lambda y: y * law(y), 0, 8)
    assert abs(mean - (0.5 + (0.3 - 0.5) * np.exp(-1.0))) < 1e-6


@pytest.mark.slow
def test_the_grid_finds_a_normal_law():
    """Of the cells' equation with a drift that is linear."""
    end, left = (1.0, 0.9), np.exp(-3.0)
    value, error = rival_bridges.cell_log_density((0.1, -0.1), end, 3.0, 0.0125, lambda x: 1.0 - x)
    gap = np.array(end) - 1 + left * np.array([0.9, 1.1])
    variance = 0.1**2 * (1 - left**2) / 2
    normal = -(gap @ gap) / (2 * variance) - np.log(2 * np.pi * variance)
    assert error < 1e-3 and abs(value - normal) < error


def test_likelihoods_of_records_agree_with_one_another():
    """Kalman's filter and that on a grid, of the same linear process."""
    record = rival_filters.records(quick=True)[0]
    assert record.exact == rival_filters.kalman_log_likelihood(record)
    assert np.isfinite(record.exact) and record.values.shape == (50,)


def test_guided_steps_are_weighted_by_the_ratio_of_densities():
    """Of one step to an observation: the mean of weighted densities is the closed form's."""
    record = rival_filters.records(quick=True)[0]
    rng, step, y = np.random.default_rng(0), 0.05, 0.6
    x = np.tile([0.3, -0.2], (20_000, 1))
    normal = rng.normal(size=x.shape)
    moved, log = rival_filters.guided_step(record, x, y, np.asarray(step), step, normal)
    seen = np.exp(log - (y - moved[:, 0]) ** 2 / (2 * record.noise**2))
    seen /= np.sqrt(2 * np.pi) * record.noise
    mean = 0.3 + step * record.drift(x)[0, 0]
    variance = step + record.noise**2
    exact = np.exp(-((y - mean) ** 2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    # One step is guided exactly: all weights are equal.
    np.testing.assert_allclose(seen, exact, rtol=1e-6)


def test_the_exact_posterior_is_a_law():
    """And does not depend on the grid."""
    (data,) = rival_posteriors.data_sets(quick=True)
    wide = rival_posteriors.exact_posterior(data)
    fine = rival_posteriors.exact_posterior(data._replace(grid=(np.linspace(0.01, 4, 4_000),)))
    np.testing.assert_allclose(wide.mean, fine.mean, rtol=1e-4)
    np.testing.assert_allclose(wide.sd, fine.sd, rtol=1e-4)
    assert 0.3 < wide.mean[0] < 2 and 0 < wide.sd[0] < 1


def test_what_is_missing_has_a_row_that_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "numpyro", None)  # as if it were not installed
    monkeypatch.setitem(sys.modules, "particles", None)
    for module in ("cuthbert", "cuthbert.filtering"):
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr(rival_filters, "_library_row", lambda *_: rival_filters.FilterRow("", ""))
    monkeypatch.setattr(rival_posteriors, "_library_rows", lambda *_: [])
    key = jax.random.key(0)
    _, _, *filters = rival_filters.run_filters(key, True, 2, 2, silent)
    assert [(r.way, r.why) for r in filters] == [
        ("cuthbert", NOT_INSTALLED),
        ("particles", NOT_INSTALLED),
    ]
    posteriors = rival_posteriors.run_posteriors(key, True, 10, silent)
    assert len(posteriors) == 2 and all(r.why == NOT_INSTALLED for r in posteriors)
    monkeypatch.setenv("PATH", "")  # no Rscript
    assert in_r("sde", "") is None
    shown = in_plain_characters(made_up()._replace(filters=filters, posteriors=posteriors))
    assert shown.count(NOT_INSTALLED) == 5
    assert where_installed(["json"], lambda found: [found.dumps(1)], lambda why: [why]) == ["1"]


def made_up():
    return Rivals(
        "cpu",
        "x, 2 cores",
        (0.1, 1.5),
        {"jax": "0.10"},
        "2026-01-01",
        Sizes(),
        [
            rival_bridges.BridgeRow("OU", "here", 0.5, -1.0, 0.01, 0.02, None, 3.0, 0.2),
            rival_bridges.BridgeRow("OU", "sde (R)", why=NOT_INSTALLED),
        ],
        [rival_filters.FilterRow("OU", "here", -50.0, 0.1, 0.05, 0.4, 3.0, 0.01)],
        [rival_posteriors.PosteriorRow("OU", "here", "rate", 0.05, 0.02, 1.0, 900.0, 9.0, 3.0)],
        [
            rival_events.EventRow("passage", "here", -3.0, 0.1, 0.02, 95.0, 4.0, 0.5),
            rival_events.EventRow("passage", "simulation", worth=0.0, again=1.0, why="none"),
        ],
    )


def test_results_survive_their_file_and_the_page_has_their_tables(tmp_path):
    for name, text in rivals_files(made_up()).items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    assert load_rivals(tmp_path / "rivals.json") == made_up()
    page = (tmp_path / "rivals.md").read_text(encoding="utf-8")
    for row in (
        "| OU | here | 0.500 | +0.020 ± 0.010 |  | 3.0 | 0.200 |",
        "|  | sde (R) | not installed |",
        "| OU | here | -50.00 ± 0.10 | +0.05 | 0.4 | 10 | 1.6 | 3.0 |",
        "| OU | here | rate | +0.050 ± 0.020 | 1.00 | 900 | 9.0 | 3.0 | 300 |",
        "| passage | here | -3.00 ± 0.10 | +0.02 | 95 | 4.0 | 0.5 | 190 |",
        "|  | simulation | none |  | 0 |  | 1.0 | 0 |",
    ):
        assert row in page


def test_the_page_is_that_of_the_stored_run():
    stored = load_rivals(NOTEBOOKS / "rivals.json")
    assert (NOTEBOOKS / "rivals.md").read_text(encoding="utf-8") == as_page(stored)


def test_the_chart_names_what_there_is():
    figure = figures.how_to_choose()
    (ax,) = figure.axes
    assert any("gibbs" in text.get_text() for text in ax.texts)


def test_the_probability_of_a_transition_is_that_of_the_equation():
    """A finer grid, without extrapolation, gives the same."""
    value = rival_events.transition_log_probability()
    fine = rival_events._transition(6_000)
    assert abs(np.log(fine) - value) < 1e-4


@pytest.mark.slow
@pytest.mark.optimised
def test_a_learnt_score_gives_the_density():
    """Of the Ornstein–Uhlenbeck bridge, after a short training; the step error of Euler's chain is
    in its own closed form."""
    task = rival_bridges.bridge_tasks(quick=True)[0]
    score = rival_bridges.learn_score(jax.random.key(0), task, num_iterations=200)
    paths, logs = rival_bridges.learnt_bridges(jax.random.key(1), score, task, 2_000)
    np.testing.assert_allclose(paths[:, 0], 1.0)
    np.testing.assert_allclose(paths[:, -1], 1.0)
    step, n = task.duration / task.num_steps, task.num_steps
    shrink = 1 - 2 * step
    variance = step * (1 - shrink ** (2 * n)) / (1 - shrink**2)
    exact = -((1 - shrink**n) ** 2) / (2 * variance) - np.log(2 * np.pi * variance) / 2
    weights = np.exp(np.asarray(logs, float))
    error = weights.std() / weights.mean() / np.sqrt(len(weights))
    assert abs(np.log(weights.mean()) - exact) < 5 * error and error < 0.1
    assert jnp.isfinite(logs).all()
