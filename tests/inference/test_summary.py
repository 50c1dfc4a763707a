"""The table of a posterior."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inference_oracles import ou_1d, ou_data

import jaxbridge as jb

TIMES = np.arange(0, 6, 0.5)


@pytest.fixture(scope="module")
def posterior():
    return jb.pmmh(
        jax.random.key(0), ou_1d(0.8, 0.7), TIMES, ou_data(7, TIMES, rate=0.8, sigma=0.7),
        prior=jb.NormalPrior((1.0, 1.0), (0.5, 0.5)), constraint=lambda p: (p[0] > 0) & (p[1] > 0),
        num_steps=2, num_iterations=40, num_chains=2, num_proposals=4,
        proposal=jb.ModifiedDiffusionBridge(),
    )  # fmt: skip


@pytest.mark.slow
def test_numbers_are_those_of_the_draws(posterior):
    table, draws = posterior.summary(), np.asarray(posterior.theta, float).reshape(-1, 2)
    np.testing.assert_allclose(table.mean, draws.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(table.sd, draws.std(axis=0), rtol=1e-6)
    np.testing.assert_allclose(table.low, np.quantile(draws, 0.025, axis=0), rtol=1e-6)
    np.testing.assert_allclose(table.high, np.quantile(draws, 0.975, axis=0), rtol=1e-6)
    for name in ("standard_error", "step_error", "r_hat", "effective_sample_size"):
        np.testing.assert_allclose(getattr(table, name), getattr(posterior, name))
    assert table.names == posterior.names and table.verdict == posterior.why()


def test_the_table_is_printed(posterior):
    title, head, *rows = str(posterior).splitlines()
    assert title == "PMMHPosterior: 2 chains of 40 draws" and "97.5 %" in head
    assert [row.split()[0] for row in rows[:2]] == list(posterior.names)
    assert len({len(row) for row in (head, *rows[:2])}) == 1
    assert "\n".join(rows[2:]) == posterior.why()
    assert f"{float(posterior.theta[..., 0].mean()):.3g}" in rows[0].split()
    page = posterior.summary()._repr_html_()
    assert page.count("<tr>") == 3 and page.count("<td>") == 18


def test_names_are_escaped(posterior):
    table = posterior.summary()._replace(names=("<b>", "b"), verdict="a < b")
    assert "<b>" not in table._repr_html_() and "a &lt; b" in table._repr_html_()


def test_there_are_no_numbers_inside_jit(posterior):
    with pytest.raises(TypeError, match="outside"):
        jax.jit(lambda made: made.summary().mean)(posterior)
    seen = []
    jax.jit(lambda made: seen.append(str(made)) or jnp.sum(made.theta))(posterior)
    assert seen[0].startswith("PMMHPosterior(")
