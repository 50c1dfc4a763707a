"""What holds for every stable Ornstein–Uhlenbeck process."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

import jaxbridge as jb


def number(low, high):
    return st.floats(low, high, allow_nan=False, width=32)


RATES = st.tuples(number(0.5, 2.0), number(0.5, 2.0), number(-2.0, 2.0))
POINTS = st.tuples(number(-1.0, 1.0), number(-1.0, 1.0))
SCENE = dict(
    rates=RATES,
    start=POINTS,
    end=POINTS,
    duration=number(0.5, 3.0),
    gamma=number(-0.875, 0.875),
)


def process(rates):
    """B = ((p, r), (-r, q)), whose eigenvalues have positive real parts: only numbers change."""
    p, q, r = rates
    return jb.ornstein_uhlenbeck(jnp.array([[p, r], [-r, q]], jnp.float32))


def arguments(start, end, duration):
    return jnp.array(start, jnp.float32), jnp.array(end, jnp.float32), jnp.float32(duration)


@pytest.mark.slow
@settings(max_examples=25, deadline=None, derandomize=True)
@given(**SCENE)
def test_bridges_join_their_ends(rates, start, end, duration, gamma):
    ends = arguments(start, end, duration)
    bridges = jb.sample_bridges(
        jax.random.key(0),
        process(rates),
        *ends,
        num_bridges=20,
        num_steps=15,
        coupling=jb.Coupling(gamma),
        max_proposals=5_000,
    )
    paths = np.asarray(bridges.paths)[np.asarray(bridges.met)]
    assert np.isfinite(paths).all() and bridges.num_nonfinite == 0
    assert (paths[:, 0] == np.asarray(ends[0])).all() and (
        paths[:, -1] == np.asarray(ends[1])
    ).all()
    assert np.isnan(np.asarray(bridges.paths)[~np.asarray(bridges.met)]).all()


@pytest.mark.slow
@settings(max_examples=8, deadline=None, derandomize=True)
@given(**SCENE)
def test_densities_and_means_are_those_of_the_closed_form(rates, start, end, duration, gamma):
    """Exact transitions leave no step error: six standard errors, and nothing else."""
    ends, model = arguments(start, end, duration), process(rates)
    proposal = jb.Coupling(gamma, scheme=jb.GaussianTransition())
    estimate = jb.transition_log_density(
        jax.random.key(0), model, *ends, num_proposals=6_000, num_steps=4, proposal=proposal
    )
    assume(float(estimate.effective_sample_size) > 300)
    exact = jb.ou_transition(model, ends[0], ends[2]).log_density(ends[1])
    error = float(estimate.standard_error)
    assert abs(np.expm1(float(estimate.value - exact))) < 6 * error
    weighted = jb.sample_weighted_bridges(
        jax.random.key(1), model, *ends, num_bridges=3_000, num_steps=4, proposal=proposal
    )
    size = float(weighted.effective_sample_size)
    assume(size > 300)
    # Half way, in standard deviations.
    law = jb.gaussian_bridge(model, *ends, times=[0.5 * duration])
    bias = (weighted.mean()[2] - law.mean[0]) / jnp.sqrt(jnp.diagonal(law.covariance[0]))
    assert float(jnp.abs(bias).max()) < 6 / np.sqrt(size)
