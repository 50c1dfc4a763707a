"""Pictures show what they say."""

import matplotlib

matplotlib.use("Agg")

import jax
import matplotlib.dates as mdates
import matplotlib.pyplot
import numpy as np
import pytest
import scipy.stats
from helpers import paper_model

import jaxbridge as jb
from jaxbridge import plot
from jaxbridge.studies import figures as study_figures


def test_qq_of_the_exact_law_lies_on_the_diagonal():
    quantiles = 2 + 3 * scipy.stats.norm.ppf((np.arange(20_000) + 0.5) / 20_000)
    ax = plot.qq({"exact draws": quantiles}, 2.0, 3.0)
    x, y = (values[2:-2] for values in ax.lines[1].get_data())  # tails are interpolated
    np.testing.assert_allclose(x, y, atol=0.02)
    _, shifted = plot.qq({"shifted": quantiles + 1}, 2.0, 3.0).lines[1].get_data()
    np.testing.assert_allclose(shifted[2:-2] - x, 1, atol=0.02)


def test_posteriors_and_traces_show_every_sampler():
    draws = {name: np.random.default_rng(0).normal(size=200) for name in ("one", "two")}
    grid = np.linspace(-3, 3, 50)
    ax = plot.posterior(draws, grid, {"exact": np.exp(-(grid**2) / 2)}, label="α")
    labels = {text.get_text() for text in ax.get_legend().get_texts()}
    assert labels == {"one", "two", "exact"} and ax.get_xlabel() == "α"
    ax = plot.trace(draws, level=0.0)
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), draws["one"])


def test_several_chains_are_one_sampler():
    chains = {"one": np.random.default_rng(0).normal(size=(2, 100)), "two": np.ones(50)}
    ax = plot.trace(chains)
    for line, values in zip(ax.lines, [*chains["one"], chains["two"]], strict=True):
        np.testing.assert_array_equal(line.get_ydata(), values)
    assert len(ax.get_legend().get_texts()) == 2
    histogram = plot.posterior(chains, np.ones(2), {}, bins=7).patches[0].get_xy()
    area = np.trapezoid(histogram[:, 1], histogram[:, 0])
    assert len(np.unique(histogram[:, 0])) == 8 and abs(area - 1) < 1e-6


def test_paths_in_space_go_up_from_start_to_end():
    times, paths = np.linspace(0, 2, 5), np.random.default_rng(0).normal(size=(4, 5, 2))
    paths[0] = np.nan  # not found
    ax = plot.paths_in_space(times, paths, num_paths=2)
    lines = [np.stack(line.get_data_3d(), -1) for line in ax.lines]
    for line, path in zip(lines[:2], paths[1:3], strict=True):
        np.testing.assert_array_equal(line, np.column_stack([path, times]))
    np.testing.assert_array_equal(lines[2], [[*paths[1, 0], 0.0]])
    np.testing.assert_array_equal(lines[3], [[*paths[1, -1], 2.0]])


def test_paths_in_the_plane_have_no_time():
    paths = np.random.default_rng(0).normal(size=(4, 5, 2))
    ax = plot.paths_in_space(None, paths, num_paths=2)
    lines = [np.stack(line.get_data(), -1) for line in ax.lines]
    for line, path in zip(lines, [*paths[:2], paths[0, :1], paths[0, -1:]], strict=True):
        np.testing.assert_array_equal(line, path)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$X^{(1)}$", "$X^{(2)}$")


def test_true_paths_are_lines_and_axes_are_those_of_the_state():
    times, values = np.linspace(0, 1, 3), np.random.default_rng(0).normal(size=(101, 3, 2))
    truth = np.linspace(0, 1, 5), np.arange(5.0)
    ax = plot.bridge_fan(times, values[..., :1], num_paths=0, truth=truth)
    (line,) = (line for line in ax.lines if line.get_label() == "truth")
    np.testing.assert_array_equal(line.get_data(), truth)
    assert ax.get_ylabel() == "$X_t$"
    assert plot.bridge_fan(times, values, coordinate=1).get_ylabel() == "$X^{(2)}_t$"


def test_bands_are_quantiles_of_the_bridges_that_were_found():
    times, values = np.linspace(0, 1, 3), np.random.default_rng(0).normal(size=(101, 3, 2))
    values[5] = np.nan
    ax = plot.bridge_fan(times, values, coordinate=1, num_paths=0)
    expected = np.quantile(np.delete(values, 5, axis=0)[..., 1], 0.5, axis=0)
    median = next(line for line in ax.lines if line.get_label() == "median")
    np.testing.assert_allclose(median.get_ydata(), expected)
    assert {text.get_text() for text in ax.get_legend().get_texts()} == {"90 %", "50 %", "median"}


def test_bands_of_weighted_bridges():
    times, values = np.linspace(0, 1, 3), np.arange(101.0).repeat(3).reshape(101, 3, 1)
    weights = np.zeros(101)
    weights[40:51] = 1 / 11
    ax = plot.bridge_fan(times, values, weights=weights, num_paths=2)
    median = next(line for line in ax.lines if line.get_label() == "median")
    np.testing.assert_allclose(median.get_ydata(), 45)
    drawn = [line.get_ydata()[0] for line in ax.lines if line is not median]
    assert all(40 <= value <= 50 for value in drawn) and len(drawn) == 2


def test_dates_have_an_axis_of_dates():
    dates = np.datetime64("2024-03-01") + np.arange(3).astype("timedelta64[D]")
    values = np.random.default_rng(0).normal(size=(101, 3, 1))
    ax = plot.bridge_fan(dates, values, data=(dates, np.array([0.1, np.nan, 0.2])))
    np.testing.assert_array_equal(ax.get_xlim(), mdates.date2num(dates[[0, -1]]))


def test_data_are_drawn_with_their_noise():
    times, values = np.linspace(0, 1, 3), np.random.default_rng(0).normal(size=(101, 3, 1))
    chains = np.stack([values, values])
    data = (np.array([0.0, 0.5, 1.0]), np.array([0.2, np.nan, -0.3]))
    ax = plot.bridge_fan(times, chains, num_paths=0, data=data, data_sd=np.array([0.1, 0.1, 0.2]))
    points, _, (bars,) = ax.containers[0]
    np.testing.assert_array_equal(points.get_data(), data)
    reach = [bar[:, 1].tolist() for bar in bars.get_segments() if np.size(bar) == 4]
    np.testing.assert_allclose(reach, [[0.0, 0.4], [-0.7, 0.1]], atol=1e-12)
    exact = plot.bridge_fan(times, values, num_paths=0, data=data)
    assert not exact.containers[0].has_yerr
    medians = [next(line for line in a.lines if line.get_label() == "median") for a in (ax, exact)]
    np.testing.assert_allclose(*(line.get_ydata() for line in medians))


def test_bridges_not_found_are_left_out():
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(400, 2))
    half = np.concatenate([draws, np.full((400, 2), np.nan)])
    for draw in (
        lambda sample: plot.qq({"sample": sample[:, 0]}, 0.0, 1.0),
        lambda sample: plot.copula_levels({"sample": sample}, np.eye(2)),
    ):
        with_missing, without = draw(half), draw(draws)
        for one, other in zip(with_missing.lines, without.lines, strict=True):
            np.testing.assert_array_equal(one.get_data(), other.get_data())
        for one, other in zip(with_missing.collections, without.collections, strict=True):
            paths = (one.get_paths(), other.get_paths())
            assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(*paths, strict=True))


def test_axes_that_are_given_are_used_and_returned():
    _, ax = matplotlib.pyplot.subplots()
    draws = np.random.default_rng(0).normal(size=(50, 2))
    assert plot.qq({"draws": draws[:, 0]}, 0.0, 1.0, ax) is ax
    assert plot.copula_levels({"draws": draws}, np.eye(2), ax=ax) is ax
    assert plot.trace({"draws": draws[:, 0]}, ax=ax) is ax
    assert plot.posterior({"draws": draws[:, 0]}, np.ones(2), {}, ax=ax) is ax
    assert plot.bridge_fan(np.arange(2.0), draws[:, :, None], ax) is ax


@pytest.mark.slow
def test_figures_render(tmp_path):
    model, ends = paper_model(), ([0.0, 0.0], [1.0, 1.0])
    bridges = jb.sample_bridges(jax.random.key(0), model, *ends, 2.0, num_bridges=200)
    exact = jb.gaussian_bridge(model, *ends, 2.0, bridges.times)
    overview = study_figures.bridges_overview(bridges, exact)
    # In both coordinates the dashed exact median starts and ends where the bridges do.
    for coordinate, ax in enumerate(overview.axes[1:]):
        median = next(line for line in ax.lines if line.get_label() == "exact").get_ydata()
        np.testing.assert_allclose(median[[0, -1]], [0.0, 1.0], atol=1e-5)
        assert ax.get_ylabel() == f"$X^{{({coordinate + 1})}}_t$"
    law = jb.GaussianLaw(exact.mean[25], exact.covariance[25])
    panels = study_figures.margins_and_copula(
        {"bridges": np.asarray(bridges.paths[:, 25])}, law, "title"
    )
    for name, figure in [("overview", overview), ("panels", panels)]:
        figure.savefig(tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
