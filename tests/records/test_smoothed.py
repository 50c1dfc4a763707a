"""What draws of paths say of themselves."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbridge.records.smooth import Smoothed


def smoothed(paths, stuck=False):
    chains = len(paths)
    flags = jnp.full(chains, stuck)
    return Smoothed(jnp.arange(3.0), paths, jnp.ones((2, 1)), flags, jnp.int32(0), None)


def test_chains_in_two_wells_know_little():
    """The error of the mean of two chains that each stayed in a well is of the size of the gap."""
    paths = 0.1 * jax.random.normal(jax.random.key(0), (4, 500, 3, 1))
    together = smoothed(paths)
    np.testing.assert_allclose(together.standard_error(), 0.1 / np.sqrt(2000), rtol=0.2)
    assert together.trustworthy and not smoothed(paths, stuck=True).trustworthy
    apart = smoothed(paths.at[::2].add(2.0))
    assert (np.asarray(apart.standard_error()) > 0.3).all()
    assert (np.asarray(apart.effective_sample_size()) < 8).all() and not apart.trustworthy


def test_a_point_that_never_moves_is_no_disagreement():
    paths = jax.random.normal(jax.random.key(0), (4, 500, 3, 1)).at[:, :, 0].set(1.0)
    assert smoothed(paths).trustworthy
