"""Meeting rules, against the law of the first passage of Brownian motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import jaxbridge as jb
from jaxbridge.meeting import PairStep, frame

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
