"""Chains that hardly move, and the size of the first moves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbridge.inference.parameter_walk import adapt_covariance
from jaxbridge.inference.pmmh import PMMHPosterior
from jaxbridge.inference.posterior import check_likelihood_was_found


def posterior(accepted, variance=1.0, in_part=1.0):
    """Of two chains: each takes a normal draw where it accepts."""
    accepted = jnp.asarray(accepted)
    which = np.maximum.accumulate(np.where(accepted, np.arange(accepted.shape[1]), 0), axis=1)
    theta = jnp.take_along_axis(jax.random.normal(jax.random.key(0), accepted.shape), which, 1)
    log_likelihood, none = jnp.zeros(accepted.shape), jnp.zeros(2, jnp.int32)
    return PMMHPosterior(
        params=theta, theta=theta[..., None], names=("a",), log_likelihood=log_likelihood,
        log_likelihood_variance=jnp.full(2, variance), variance_in_part=jnp.full(2, in_part),
        log_step_error=1e-3 * theta, sigma_varies=False, accepted=accepted,
        num_without_estimate=none, num_truncated=none, state=none,
    )  # fmt: skip


def test_a_chain_that_never_moves_is_worth_nothing():
    accepted = np.random.default_rng(0).random((2, 400)) < 0.5
    moving = posterior(accepted)
    assert moving.trustworthy and not np.any(moving.stuck)
    accepted[1] = False
    made = posterior(accepted)
    assert made.stuck.tolist() == [False, True] and not made.trustworthy
    assert made.effective_sample_size == 0 and np.all(made.standard_error == np.inf)
    assert "never moved" in made.why()


def test_few_draws_are_not_trusted():
    """Of three draws there is no R̂, and the verdict says so."""
    made = posterior(np.ones((2, 3), bool))
    assert np.isnan(made.r_hat).all() and made.effective_sample_size == 2
    assert not made.trustworthy and "R̂" in made.why() and "3 draws" in str(made)


def test_a_walk_that_is_hardly_ever_accepted_is_not_trusted():
    accepted = np.arange(4000) % 25 == np.zeros((2, 1))
    made = posterior(accepted)
    assert "less than 5 %" in made.why() and not made.trustworthy
    assert posterior(np.arange(4000) % 10 == np.zeros((2, 1))).trustworthy


def test_estimates_that_are_noisy_in_a_tail_are_told():
    accepted = np.ones((2, 400), bool)
    assert posterior(accepted).trustworthy
    made = posterior(accepted, in_part=7.0)
    assert "may have missed a tail" in made.why() and not made.trustworthy


def test_a_start_of_no_likelihood_is_refused():
    check_likelihood_was_found(jnp.array([False, False]))
    with pytest.raises(ValueError, match=r"none of the moves found a positive one \(chain 1 of 2"):
        check_likelihood_was_found(jnp.array([False, True]))


@pytest.mark.parametrize("scale", [300.0, 1e-3])
def test_the_size_of_moves_is_found_early(scale):
    """Of a normal law with sd 1 and first moves of this size, after 100 iterations: by the
    covariance alone it is still 94 for 300, and 0.07 for 1e-3."""

    @jax.jit
    def run(key):
        def step(state, i):
            x, root = state
            walk_key, accept_key = jax.random.split(jax.random.fold_in(key, i))
            noise = jax.random.normal(walk_key, (1,))
            new = x + root @ noise
            rate = jnp.minimum(1, jnp.exp(jnp.sum(x**2 - new**2) / 2))
            x = jnp.where(jax.random.uniform(accept_key) < rate, new, x)
            return (x, adapt_covariance(root, noise, rate, i, jnp.asarray(True))), None

        init = jnp.zeros(1), scale * jnp.eye(1)
        return jax.lax.scan(step, init, jnp.arange(1, 101))[0][1]

    roots = [float(run(jax.random.key(i))[0, 0]) for i in range(10)]
    assert 1 < np.median(roots) < 15 and max(roots) < 40
