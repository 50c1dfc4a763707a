"""The study of exact bridges: its tables and pictures, on made-up results."""

import matplotlib

matplotlib.use("agg")

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.studies import figures
from jaxbridge.studies.exact import (
    COST,
    EXACT,
    VARIATION,
    Cost,
    ExactResult,
    Floor,
    Variation,
    _judge,
    format_cost,
    format_exact,
    format_variation,
    slope,
)

LAW = jb.GaussianLaw([1.0, -1.0], [[4.0, 1.0], [1.0, 1.0]])


def made_up_variation(ratio):
    number = jnp.asarray(ratio)
    counts = jnp.array([5, 10])
    return jb.HittingVariation(
        counts,
        counts.astype(float),
        number,
        number,
        number,
        number,
        number,
        number / 4,
        jnp.array(0),
    )


def made_up_results():
    samples = np.random.default_rng(0).multivariate_normal([1, -1], LAW.covariance, 2_000)
    pair = np.array([0.01, -0.02])
    bridges = ("(0.785, 0.785) -> (1.091, 1.091)", "(2, -2) -> (3, -3)")
    results = [
        ExactResult(
            bridge, method, 2_000, samples, LAW, pair, abs(pair), pair, 900.0, 4.2, 0.5, "44"
        )
        for bridge in bridges
        for method in ("pseudo-marginal", "renewal")
    ]
    variation = [
        Variation(bridge, gamma, made_up_variation(0.4), made_up_variation(0.1))
        for bridge in bridges
        for gamma in (0.0, 0.5)
    ]
    return results, variation, [Cost(t, 1e-4 * t**0.9, 0.9) for t in (1.0, 10.0, 100.0)]


def test_tables_are_aligned_and_say_everything():
    results, variation, costs = made_up_results()
    *table, grows = format_cost(costs).splitlines()
    assert "grow as T to the power 0.90" in grows
    for lines, rows in [
        (format_exact(results).splitlines(), 4),
        (format_variation(variation).splitlines(), 4),
        (table, 3),
    ]:
        assert len(lines) == 2 + rows
        assert len(set(map(len, lines))) == 1
    assert "the chain takes 2.0 times that" in EXACT.tables((results, Floor(10**8, 0.25)))
    assert "+0.0100 +- 0.0100" in format_exact(results)
    assert "0.400 +- 0.100" in format_variation(variation)


def test_slope_is_that_of_the_long_durations():
    costs = [Cost(t, 2e-4 * t**0.95 * (10 if t < 10 else 1), 1.0) for t in (1.0, 10, 30, 100)]
    assert slope(costs) == pytest.approx(0.95)


def test_weighted_and_chain_samples_are_judged_alike():
    """Draws of a wider law, weighted to the exact one, and draws of the exact law itself."""
    rng, n = np.random.default_rng(1), 40_000
    exact = rng.multivariate_normal(LAW.mean, LAW.covariance, n)
    wide = rng.multivariate_normal(LAW.mean, 1.5 * np.asarray(LAW.covariance), n)
    deviation = wide - np.asarray(LAW.mean)
    square = np.einsum("ni,ij,nj->n", deviation, np.linalg.inv(LAW.covariance), deviation)
    weights = np.exp(-square / 2 * (1 - 1 / 1.5))
    weights /= weights.sum()
    for samples, given in [(exact, None), (wide, weights)]:
        drawn, fit, error, effective = _judge(samples, given, LAW)
        assert drawn.shape == (n, 2) and 0.4 * n < effective < 1.2 * n
        assert (np.abs(fit.mean_bias) < 5 * error).all() and (error < 0.01).all()
        assert (np.abs(fit.sd_bias) < 0.03).all() and (fit.ks_distance < 0.015).all()


def test_pictures_are_drawn(tmp_path):
    results, variation, costs = made_up_results()
    pictures = EXACT.draw(figures, (results, Floor(10**8, 0.25)))
    assert list(pictures) == ["exact_unlikely.png", "exact_very_unlikely.png"]
    pictures |= VARIATION.draw(figures, variation) | COST.draw(figures, costs)
    assert list(pictures)[2:] == ["variation.png", "cost.png"]
    for name, figure in pictures.items():
        figure.savefig(tmp_path / name)
        picture = plt.imread(tmp_path / name)
        assert picture.shape[0] > 200 and np.ptp(picture[..., :3]) > 0.5
