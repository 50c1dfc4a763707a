"""Proposals: the driven path has the law of the diffusion, and pairs are joined as the paper
says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_moments, paper_model, slow_beyond, swirl, unswirl, warped_model

import jaxbridge as jb
from jaxbridge.coupling.join import Inputs, propose
from jaxbridge.models.bridge_problem import Intervals

NUM_STEPS = 40
NON_REVERSIBLE = np.array([[1.0, 1.5], [-1.0, 0.5]])


def make(model, coupling, start, end, duration, num_lanes, num_steps=NUM_STEPS, rho=None, seed=0):
    """`num_lanes` proposals; `end` is one point, or one for each lane; `rho` joins all of the
    pairs at one step."""

    @jax.jit
    def run(key):
        points = [jnp.broadcast_to(jnp.asarray(point), (num_lanes, 2)).T for point in (start, end)]
        intervals = Intervals(*points, jnp.full(num_lanes, duration))
        return propose(
            Inputs(model, coupling, intervals),
            jax.random.split(key, num_lanes),
            num_steps,
            meeting_step=None if rho is None else jnp.full(num_lanes, rho, jnp.int32),
        )

    return run(jax.random.key(seed))


@pytest.mark.slow
@pytest.mark.parametrize("gamma", slow_beyond(1, [0.5, -1.0]))
@pytest.mark.parametrize("scheme", slow_beyond(1, [jb.Heun(), jb.Euler()]))
def test_driven_path_is_the_forward_diffusion(gamma, scheme):
    """X' alone, never joined and averaged over X_T ~ ν, has the transition law of the diffusion
    from its start, although its noise was recovered from a reversed path. With the negative of
    the reversed noise in its place the drift would be wrong."""
    model = jb.ornstein_uhlenbeck(NON_REVERSIBLE)
    start, n = jnp.array([1.0, -0.5]), 40_000
    steps = 200 if isinstance(scheme, jb.Euler) else NUM_STEPS
    ends = jax.vmap(model.sample_stationary)(jax.random.split(jax.random.key(9), n))
    coupling = jb.Coupling(gamma, scheme=scheme)
    made = make(model, coupling, start, ends, 1.0, n, steps, rho=steps + 1)
    exact = jb.ou_transition(model, start, 1.0)
    # The allowances are for the step errors, δ ‖B²‖ / 2 and (δ ‖B‖)² / 6.
    allowance = 0.01 if isinstance(scheme, jb.Euler) else 0.001
    assert_moments(made.paths[-1].T, exact.mean, exact.covariance, mean_allowance=allowance)


@pytest.mark.slow
def test_replays_join_where_they_are_told():
    model, coupling = paper_model(), jb.Coupling(0.5)
    arguments = (model, coupling, [0.5, 0.5], [0.0, 1.0], 1.0, 500)
    joined = make(*arguments)
    reverse_path = make(*arguments, rho=1).paths
    driven_path = make(*arguments, rho=NUM_STEPS + 1).paths
    steps = np.arange(NUM_STEPS + 1)[:, None, None]
    expected = np.where(steps >= np.asarray(joined.meeting_step), reverse_path, driven_path)
    np.testing.assert_allclose(joined.paths, expected, atol=1e-5)
    met = np.asarray(joined.meeting_step) <= NUM_STEPS
    assert 0.5 < met.mean() < 1
    assert (np.asarray(joined.paths)[0].T == np.float32([0.5, 0.5])).all()
    assert (np.asarray(joined.paths)[-1].T[met] == np.float32([0.0, 1.0])).all()


@pytest.mark.slow
def test_meeting_step_is_the_first_sign_change():
    """σ = I and the sign test, recomputed in NumPy from the two unjoined paths."""
    model = paper_model()
    coupling = jb.Coupling(-1.0, jb.SignTest(), jb.Euler())
    arguments = (model, coupling, [0.5, 0.5], [0.0, 1.0], 1.0, 500)
    x = np.asarray(make(*arguments, rho=1).paths)[1:]  # X_1, ..., X_N
    driven = np.asarray(make(*arguments, rho=NUM_STEPS + 1).paths)[1:]
    difference = x - driven
    crossed = (difference[:-1] * difference[1:]).sum(1) < 0
    expected = np.where(crossed.any(0), crossed.argmax(0) + 2, NUM_STEPS + 1)
    found = np.asarray(make(*arguments).meeting_step)
    later = found > 1  # meetings in the first step involve X_0, which is not kept
    assert later.mean() > 0.9
    np.testing.assert_array_equal(found[later], expected[later])


@pytest.mark.slow
def test_stored_steps_are_those_of_the_whole_path():
    model = paper_model()
    keys = jax.random.split(jax.random.key(0), 50)
    lanes = lambda value: jnp.full((2, 50), value)
    for num_steps in (20, 130):
        stored = np.array([0, 3, num_steps // 2, num_steps])
        intervals = Intervals(lanes(0.2), lanes(-0.1), jnp.full(50, 0.02 * num_steps))
        arguments = (Inputs(model, jb.Coupling(), intervals), keys, num_steps)
        whole = propose(*arguments)
        some = propose(*arguments, jnp.asarray(stored))
        np.testing.assert_allclose(some.paths, whole.paths[stored], atol=1e-6)


def test_exploding_lanes_are_told_apart():
    """x - x³ in one Euler step of length 1 from far out overflows within a few steps."""
    model = jb.langevin(lambda x, p: x @ x - (x @ x) ** 2 / 2)
    coupling = jb.Coupling(0.0, scheme=jb.Euler())
    made = make(model, coupling, [30.0, 0.0], [0.0, 0.0], 20.0, 50, 20)
    assert not made.finite.any()
    assert (np.asarray(made.meeting_step) == 21).all()


@pytest.mark.slow
@pytest.mark.optimised
def test_state_dependent_noise_is_recovered_and_coupled():
    """The driven path of an Ornstein–Uhlenbeck process in swirled coordinates, unswirled,
    averaged over the stationary law of the end point."""
    inner = jb.ornstein_uhlenbeck(NON_REVERSIBLE)
    model = warped_model(inner, swirl, unswirl)
    n, steps, start = 20_000, 60, jnp.array([0.8, -0.3])
    ends = jax.vmap(inner.sample_stationary)(jax.random.split(jax.random.key(5), n))
    ends = jax.vmap(swirl)(ends)
    made = make(model, jb.Coupling(0.3), swirl(start), ends, 1.0, n, steps, rho=steps + 1)
    exact = jb.ou_transition(inner, start, 1.0)
    y = jax.vmap(unswirl)(made.paths[-1].T)
    assert_moments(y, exact.mean, exact.covariance, mean_allowance=0.02)
