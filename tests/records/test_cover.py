"""Mixture of normal laws in the place of an initial law, against integrals in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxbridge.records.cover import Cover, covered_start
from jaxbridge.records.observations import Scalars
from jaxbridge.records.tilted_step import Information, NormalStep


@pytest.mark.slow
@pytest.mark.parametrize("d", [1, 2])
def test_shares_are_the_integrals_of_the_parts(d, x64):
    """∫ N(x; m, S) N(y; c·x, ρ) exp(rᵀu - ½ uᵀH u) dx with u = x - ξ, by completing the square."""
    rng = np.random.default_rng(1)
    means, roots = rng.normal(size=(3, d)), np.tril(rng.normal(size=(3, d, d)))
    point, row, r = rng.normal(size=(3, d))
    H = 0.3 * np.eye(d) + np.outer(r, r)
    law = Cover(jnp.log(jnp.array([0.2, 0.5, 0.3])), NormalStep(*map(jnp.asarray, (means, roots))))
    scalars = Scalars(row[None], np.array([0.4 - row @ point]), np.array([0.2]), np.array([True]))
    scalars = jax.tree.map(jnp.asarray, scalars)
    start = covered_start(law, scalars, jnp.asarray(point), Information(*map(jnp.asarray, (r, H))))
    for log_share, share, mean, root in zip(
        start.log_shares, (0.2, 0.5, 0.3), means - point, roots, strict=True
    ):
        S = root @ root.T
        gain = S @ row / (row @ S @ row + 0.2)
        e, C = mean + gain * (0.4 - row @ (mean + point)), S - np.outer(gain, row @ S)
        y = multivariate_normal.logpdf(0.4, row @ (mean + point), row @ S @ row + 0.2)
        b, M = r - H @ e, np.eye(d) + C @ H
        tilted = r @ e - e @ H @ e / 2 + b @ np.linalg.solve(M, C) @ b / 2
        exact = np.log(share) + y + tilted - np.linalg.slogdet(M)[1] / 2
        np.testing.assert_allclose(log_share, exact, rtol=1e-10)
