"""Bridges whose law is known, of every kind: weighted proposals have it, and then so has what is
made of the weights. That the entry points make this of them is tested with one case each, beside
what else is said of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_chain_moments, assert_weighted_moments, exact_cases, slow_cases

import jaxbridge as jb
from jaxbridge.exact.log_means import log_mean_and_error
from jaxbridge.exact.pseudo_marginal import accept_reject

CASES = exact_cases()


@pytest.mark.parametrize("name", slow_cases(CASES, {"one dimension"}))
@pytest.mark.optimised
def test_weighted_proposals_have_the_exact_law(name):
    """One proposal each, of weight zero where it is no bridge: the mean weight is the density. The
    weighted mid-points have the law of the bridge's, and so has the chain that accepts one after
    the other with the ratio of the weights."""
    case = CASES[name]()
    weighted = jb.sample_weighted_bridges(
        jax.random.key(1), case.model, case.start, case.end, case.duration,
        num_bridges=20_000, num_steps=case.num_steps,
        proposal=case.coupling, save_at=[case.duration / 2], max_proposals=1,
    )  # fmt: skip
    assert not weighted.truncated.any()
    log_mean, error, _ = (leaf[0] for leaf in log_mean_and_error(weighted.log_weights[None]))
    assert error < 0.05
    assert abs(log_mean - case.log_density) < 5 * error + case.allowance

    found = np.asarray(weighted.met)
    middle = np.asarray(jax.vmap(case.to_gaussian)(weighted.paths[found, 0]))
    log_weights = weighted.log_weights[found]
    size = assert_weighted_moments(middle, np.exp(log_weights), case.mean, case.covariance)
    assert size == pytest.approx(float(weighted.effective_sample_size), rel=1e-3)
    assert size > 400
    assert case.start_law is None or np.ptp(log_weights) > 0

    uniform = jax.random.uniform(jax.random.key(2), (1, len(log_weights) - 1))
    row, accepted = accept_reject(log_weights[None], uniform)
    assert 0.02 < jnp.mean(accepted) < 0.95
    np.testing.assert_array_equal(np.diff(row[0]) != 0, accepted[0, 1:])
    assert_chain_moments(middle[np.asarray(row[0])], case.mean, case.covariance)
