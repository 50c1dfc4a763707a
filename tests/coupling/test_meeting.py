"""Meeting rules, against the law of the first passage of Brownian motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_moments
from scipy.stats import norm

import jaxbridge as jb
from jaxbridge.coupling import step_law_of
from jaxbridge.coupling.meeting import PairStep
from jaxbridge.coupling.pair import relative_frame
from jaxbridge.schemes import UNKNOWN_SHARE
from jaxbridge.schemes.relative_frame import frame

NUM = 200_000
DT = 0.02


def frequency(rule, gamma, gap, sigma=None):
    """How often one driftless step from a gap is called a meeting, and its standard error."""
    model = jb.Diffusion(lambda x, p: 0 * x, sigma)
    dynamics = model.forward(jnp.zeros(2))
    coupling = jb.Coupling(gamma)
    x, driven = jnp.array([0.3, 0.4]) * gap / 0.5 + 1.0, jnp.ones(2)

    @jax.jit
    @jax.vmap
    def met(key):
        keys = jax.random.split(key, 3)
        dw = np.sqrt(DT) * jax.random.normal(keys[0], (2,))
        du = np.sqrt(DT) * jax.random.normal(keys[1]) if coupling.independent_noise else None
        seen = frame(dynamics.sigma(driven), x, driven)
        step = PairStep(
            seen,
            x,
            x + dynamics.sigma(x).mv(dw),
            driven,
            driven + dynamics.sigma(driven).mv(coupling.driven_noise(seen, dw, du)),
            jnp.asarray(DT),
            coupling.gap_variance(seen),
        )
        uniform = jax.random.uniform(keys[2]) if rule.draws_uniform else None
        return rule.met(step, dynamics, uniform)

    share = float(met(jax.random.split(jax.random.key(0), NUM)).mean())
    return share, np.sqrt(share * (1 - share) / NUM)


@pytest.mark.parametrize("gamma", [-1.0, 0.0, 0.5, 0.9])
@pytest.mark.parametrize("gap", [0.02, 0.2])
def test_brownian_crossing_has_the_law_of_first_passage(gamma, gap):
    """P(the gap reaches 0 before δ) = 2Φ(-ω/√(sδ)), s = 2(1-γ); for γ = -1 this is
    2Φ(-ω/(2√δ)), twice the lower bound of the paper's section 2.5."""
    share, error = frequency(jb.BrownianCrossing(), gamma, gap)
    expected = 2 * norm.cdf(-gap / np.sqrt(2 * (1 - gamma) * DT))
    assert abs(share - expected) < 5 * error + 1e-6


def test_crossing_is_measured_in_units_of_sigma():
    share, error = frequency(jb.BrownianCrossing(), -1.0, 0.2, np.eye(2) * 0.5)
    assert abs(share - 2 * norm.cdf(-0.4 / (2 * np.sqrt(DT)))) < 5 * error


@pytest.mark.parametrize("rule", [jb.SignTest(), jb.ReflectionPlane()])
def test_sign_and_plane_see_half_of_the_meetings(rule):
    share, error = frequency(rule, -1.0, 0.2)
    assert abs(share - norm.cdf(-0.2 / (2 * np.sqrt(DT)))) < 5 * error


def test_sign_test_looks_within_its_radius_only():
    assert frequency(jb.SignTest(0.3), -1.0, 0.2)[0] == frequency(jb.SignTest(), -1.0, 0.2)[0]
    assert frequency(jb.SignTest(0.1), -1.0, 0.2)[0] == 0


@pytest.mark.parametrize("rule", [jb.BrownianCrossing(), jb.SignTest(), jb.ReflectionPlane()])
def test_equal_states_have_met(rule):
    assert frequency(rule, -1.0, 0.0)[0] == 1


def test_frame_is_finite_and_differentiable_at_meeting():
    sigma = jb.Diffusion(lambda x, p: x).forward(jnp.zeros(2)).sigma(jnp.zeros(2))
    seen = frame(sigma, jnp.ones(2), jnp.ones(2))
    assert seen.gap == 0 and (seen.u == 0).all()
    derivative = jax.jacrev(lambda x: frame(sigma, x, jnp.ones(2)).u)(jnp.ones(2))
    assert jnp.isfinite(derivative).all()


class CrossingSeenBefore(jb.AbstractMeeting):
    """The crossing of the gap as it is before the drift of the step."""

    draws_uniform = True
    looks_ahead = False

    def met(self, step, forward, uniform):
        return jb.BrownianCrossing().met(step, forward, uniform)


TURNING = jb.ornstein_uhlenbeck([[1.0, 1.5], [-1.0, 0.5]], sigma=[[1.0, 0.4], [-0.2, 0.7]])


def joined_steps(meeting, scheme, gamma, dt=0.5, num=200_000):
    """Points after one long step of a pair, joined if they met; and how many were."""
    x, driven, dt = jnp.array([0.5, 0.1]), jnp.array([-0.1, -0.4]), jnp.asarray(dt)
    dynamics, coupling = TURNING.forward(x), jb.Coupling(gamma, meeting=meeting, scheme=scheme)
    fitted = scheme.fitted(dynamics, x, dt)

    @jax.jit
    @jax.vmap
    def joined(key):
        keys = jax.random.split(key, 3)
        dw = jnp.sqrt(dt) * jax.random.normal(keys[0], (2,))
        du = jnp.sqrt(dt) * jax.random.normal(keys[1]) if coupling.independent_noise else None
        x_next = fitted.step(dynamics, x, dt, dw)
        seen = relative_frame(coupling, fitted, dynamics, x, driven, dt)
        driven_next = fitted.step(dynamics, driven, dt, coupling.driven_noise(seen, dw, du))
        pair = PairStep(seen, x, x_next, driven, driven_next, dt, coupling.gap_variance(seen))
        met = meeting.met(pair, dynamics, jax.random.uniform(keys[2]))
        return jnp.where(met, x_next, driven_next), met

    points, met = joined(jax.random.split(jax.random.key(0), num))
    return driven, np.asarray(points, float), float(met.mean())


def bias_of_heun(meeting, dt):
    """Of the mean of a joined step, in multiples of √δ."""
    driven, points, _ = joined_steps(meeting, jb.Heun(), 0.0, dt, 400_000)
    B = np.asarray(TURNING.params.B)
    mean = driven - B @ driven * dt + B @ B @ driven * dt**2 / 2
    return np.linalg.norm(points.mean(0) - mean) / np.sqrt(dt)


@pytest.mark.slow
def test_heun_sees_the_pair_after_half_its_drift():
    """What a meeting costs shrinks much faster than with the pair as it is before."""
    ours, before = (
        [bias_of_heun(meeting, dt) for dt in (0.4, 0.2)]
        for meeting in (jb.BrownianCrossing(), CrossingSeenBefore())
    )
    error = 5 / np.sqrt(400_000)
    assert ours[0] < before[0] / 2 and ours[1] < before[1] / 3 + error
    assert ours[1] < ours[0] / 2 + error


def assert_is_euler_step(driven, points, dt=0.5):
    B, sigma = np.asarray(TURNING.params.B), np.asarray(TURNING.params.sigma)
    assert_moments(points, driven - B @ driven * dt, sigma @ sigma.T * dt)


@pytest.mark.slow
@pytest.mark.parametrize(
    "gamma", [0.0, *(pytest.param(g, marks=pytest.mark.slow) for g in (-1.0, 0.7))]
)
def test_joined_steps_are_steps_of_the_scheme(gamma):
    """However long they are: a meeting has no error of its own where σ is constant."""
    driven, points, share = joined_steps(jb.BrownianCrossing(), jb.Euler(), gamma)
    assert 0.05 < share < 0.95
    assert_is_euler_step(driven, points)
    driven, points, share = joined_steps(jb.BrownianCrossing(), jb.GaussianTransition(), gamma)
    assert 0.05 < share < 0.95
    law = jb.ou_transition(TURNING, driven, 0.5)
    assert_moments(points, law.mean, law.covariance)
    driven, points, share = joined_steps(jb.BrownianCrossing(), jb.SemiImplicit(), gamma)
    B, sigma = np.asarray(TURNING.params.B), np.asarray(TURNING.params.sigma)
    implicit = np.linalg.inv(np.eye(2) + 0.25 * B)
    root = implicit @ sigma
    assert_moments(points, driven - implicit @ B @ driven * 0.5, root @ root.T * 0.5)


@pytest.mark.parametrize("meeting", [CrossingSeenBefore(), jb.SignTest()])
def test_joined_steps_of_a_pair_seen_before_its_drift_are_not(meeting):
    driven, points, _ = joined_steps(meeting, jb.Euler(), 0.0)
    with pytest.raises(AssertionError):
        assert_is_euler_step(driven, points)


@pytest.mark.parametrize("meeting", [jb.SignTest(), jb.SignTest(0.5), jb.ReflectionPlane()])
def test_rules_that_overlook_meetings_have_an_unknown_error(meeting):
    """Their densities are too small by a tenth and more in ten steps, and steps do not show it."""
    model, like = jb.ornstein_uhlenbeck(jnp.eye(2)), jnp.zeros(2)
    gamma = -1.0 if isinstance(meeting, jb.ReflectionPlane) else 0.0
    assert step_law_of(jb.Coupling(gamma, meeting), model, like)[1] == UNKNOWN_SHARE
    density, share = step_law_of(jb.Coupling(gamma), model, like)
    assert density.is_exact and share == 0
