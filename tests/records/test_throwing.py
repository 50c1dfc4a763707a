"""What is not to be trusted is an error for those who ask for it, and says what to change."""

import jax
import jax.numpy as jnp
import pytest
from test_smoothed import smoothed

import jaxbridge as jb
from jaxbridge.engine.verdict import throw_where_untrustworthy
from jaxbridge.records.log_likelihood import LogLikelihood

MODEL = jb.Diffusion(lambda x, p: -p * x, params=1.0)


def likelihood(error=0.1, sizes=50.0, k=0.4, step_error=0.0, doubt=0.01):
    value, filters = jnp.array(-3.0), jnp.full(4, -3.0)
    of_each = jnp.full(5, sizes), jnp.full(5, k)
    told = map(jnp.array, (step_error, doubt, 0.0))
    return LogLikelihood(value, jnp.array(error), filters, *of_each, 4000, jnp.int32(0), *told)


@pytest.mark.parametrize(
    "changed, message",
    [
        (dict(sizes=0.0), "No particle explains"),
        (dict(sizes=4.0), "num_particles"),
        (dict(error=0.6), "num_particles"),
        (dict(error=jnp.inf), "num_particles"),
        (dict(k=0.9), "heavy tails"),
        (dict(step_error=0.2), "num_steps"),
        (dict(step_error=jnp.nan, doubt=jnp.nan), "num_steps"),
        (dict(doubt=jnp.inf), "num_steps"),
    ],
)
def test_likelihoods(changed, message):
    made = likelihood(**changed)
    assert not made.trustworthy and message in made.why()
    with pytest.raises(Exception, match=message):
        throw_where_untrustworthy(made, "value", MODEL)


def draws(apart=0.0, **options):
    paths = jax.random.normal(jax.random.key(0), (4, 100, 3, 1)).at[::2].add(apart)
    return smoothed(paths, **options)


@pytest.mark.parametrize(
    "changed, message",
    [
        (dict(stuck=True), "never moved"),
        (dict(num_truncated=2), "truncated"),
        (dict(apart=3.0), "Chains disagree"),
    ],
)
def test_smoothed_paths(changed, message):
    made = draws(**changed)
    assert not made.trustworthy and message in made.why()
    with pytest.raises(Exception, match=message):
        throw_where_untrustworthy(made, "_paths", MODEL)


def test_what_is_trusted_is_not_thrown():
    assert throw_where_untrustworthy(likelihood(), "value", MODEL).value == -3
    made = draws()
    assert jnp.all(throw_where_untrustworthy(made, "_paths", MODEL).paths == made.paths)
    with pytest.raises(Exception, match="not finite"):
        throw_where_untrustworthy(made, "_paths", MODEL.with_params(jnp.nan))
