"""The study of section 3, at a small size."""

import jax
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.studies.paper import CASES, chance, compare, format_table, run_study


def test_comparison_finds_the_bias_put_in():
    law = jb.GaussianLaw(np.array([1.0, -1.0]), np.array([[4.0, 1.0], [1.0, 1.0]]))
    rng = np.random.default_rng(1)
    draws = rng.multivariate_normal([1.2, -1.0], [[4.0, 1.0], [1.0, 1.21]], size=100_000)
    fit, due = compare(draws, law), chance(100_000)
    np.testing.assert_allclose(fit.mean_bias, [0.1, 0.0], atol=5.5 * due.mean_error)
    np.testing.assert_allclose(fit.sd_bias, [0.0, 0.1], atol=5.5 * due.sd_error)
    assert fit.ks_distance[0] > due.ks_critical


@pytest.mark.slow
def test_study_reproduces_the_law_of_the_likely_bridge():
    started = []
    (default, published) = run_study(jax.random.key(0), 2_000, CASES[:1], started.append)
    assert [what[:5] for what in started] == ["compi", "[1/2]", "[2/2]"]
    due = chance(2_000)
    assert (np.abs(default.fit.mean_bias) < 5 * due.mean_error).all()
    assert (np.abs(default.fit.sd_bias) < 5 * due.sd_error).all()
    assert default.acceptance > 0.95 > published.acceptance  # the sign test overlooks half
    table = format_table([default, published])
    assert "as published" in table and max(map(len, table.splitlines())) <= 120


def test_cases_are_those_of_the_paper():
    assert [(case.name, case.gamma) for case in CASES] == [
        ("likely", -1.0),
        *(("unlikely", gamma) for gamma in (0.0, 0.5, 0.9, 0.95)),
        *(("very unlikely", gamma) for gamma in (0.5, 0.9, 0.99)),
    ]
