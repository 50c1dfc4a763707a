"""The regression of the paper's section 3.2."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import PAPER_CASES, paper_model

import jaxbridge as jb
from jaxbridge.tuning.hitting_variation import _regress


def test_regression_separates_the_variance_of_probabilities_from_that_of_counts():
    """Geometric counts with known probabilities: V(1/π) and E[(1-π)/π²] are known."""
    rng, n, sizes = np.random.default_rng(0), 40_000, np.array([5, 10, 20, 40])
    probability = rng.choice([0.2, 0.5, 0.8], size=n)
    rho = np.cumsum(rng.geometric(probability[:, None], size=(n, 40)), axis=1)[:, sizes - 1] / sizes
    values = jnp.asarray(rho), jnp.ones(n)
    variances, intercept, slope, mean, ratio = _regress(*values, sizes)
    inverse = 1 / np.array([0.2, 0.5, 0.8])
    noise = np.mean((1 - 1 / inverse) * inverse**2)
    np.testing.assert_allclose(variances, inverse.var() + noise / sizes, rtol=0.03)
    np.testing.assert_allclose(intercept, inverse.var(), rtol=0.03)
    np.testing.assert_allclose(slope, noise, rtol=0.06)
    np.testing.assert_allclose(mean, inverse.mean(), rtol=0.01)
    np.testing.assert_allclose(ratio, inverse.std() / inverse.mean(), rtol=0.03)


@pytest.mark.parametrize(
    "name, gamma, paper",
    [("very unlikely", 0.5, 0.06), pytest.param("unlikely", 0.9, 0.16, marks=pytest.mark.slow)],
)
@pytest.mark.slow
def test_paper_figures_with_its_own_settings(name, gamma, paper):
    """Section 3.2, with the printed start law; its figures have an error of their own."""
    model, key = paper_model(), jax.random.key
    bridges = jb.sample_bridges(
        key(0),
        model,
        *PAPER_CASES[name],
        1.0,
        num_bridges=400,
        coupling=jb.Coupling.as_published(gamma),
    )
    weighted = jb.weigh_bridges(key(1), model, bridges)
    published = jb.hitting_variation(key(2), model, weighted, (20, 40, 80))
    assert published.num_truncated == 0
    assert abs(published.ratio - paper) < 5 * published.ratio_error + 0.03
