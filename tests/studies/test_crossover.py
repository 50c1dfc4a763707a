"""The study of proposals over durations: its processes, and what it prints."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats
from studies import figures
from studies.crossover import (
    Rate,
    crossover_table,
    double_well,
    processes,
    share_of_best,
)


@pytest.mark.slow
def test_double_well_is_normalised_reversible_and_sampled():
    model = double_well(1.7)

    def nu(x):
        return float(jnp.exp(model.log_stationary(jnp.array([x, 0.3]))))

    margin = float(jnp.sqrt(1.7 / jnp.pi) * jnp.exp(-1.7 * 0.3**2))  # of x_2, a normal law
    mass, _ = integrate.quad(nu, -3, 3, limit=100)
    assert abs(mass / margin - 1) < 1e-3
    points = jax.random.normal(jax.random.key(0), (20, 2))
    np.testing.assert_allclose(model.reversibility_residual(points), 0, atol=1e-4)
    draws = jax.jit(jax.vmap(model.prepared().sample_stationary))(
        jax.random.split(jax.random.key(1), 20_000)
    )
    grid = np.linspace(-3, 3, 601)
    density = np.exp(-1.7 * (grid**2 - 1) ** 2)
    cumulated = integrate.cumulative_trapezoid(density, grid, initial=0)
    distance = stats.kstest(
        np.asarray(draws[:, 0]), lambda x: np.interp(x, grid, cumulated / cumulated[-1])
    )
    assert distance.statistic < 1.95 / np.sqrt(20_000)  # 0.1 % of such tests exceed it
    assert abs(float(draws[:, 1].std()) * np.sqrt(3.4) - 1) < 5 / np.sqrt(40_000)


def rates():
    """A made-up study of two durations."""
    names = [
        ("ModifiedDiffusionBridge", 8e5, 2e3),
        ("Coupling(0)", 10.0, 5e3),
        ('"auto"', 6e5, 4e3),
    ]
    return [
        Rate("double well", t, name, value, 0.5, 0.1, -1.0, 0.01, "Coupling(0)")
        for name, *values in names
        for t, value in zip((0.05, 20.0), values, strict=True)
    ]


def test_table_and_figure_show_the_share_of_the_best():
    assert share_of_best(rates(), 0.05) == 0.75 and share_of_best(rates(), 20.0) == 0.8
    titles, (*_, shares, taken) = crossover_table(rates())
    assert titles == ("process", "proposal", "T = 0.05", "T = 20")
    assert shares == ("double well", "auto / best", "0.75", "0.80")
    assert taken == ("double well", "auto selected", "C(0)", "C(0)")
    (ax,) = figures.crossover(rates(), 5.0).axes
    assert ax.get_title() == "double well" and len(ax.get_lines()) == 3
    assert len({process.name for process in processes()}) == 3
