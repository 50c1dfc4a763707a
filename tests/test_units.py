"""Results do not depend on the units of the state and of time, but for powers of two: Y = cX with
time τ = kt has the drift c b(Y/c) / k and the matrix c σ(Y/c) / √k."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.coupling.smoothed_draws import smoothed_draws

KEY = jax.random.key(0)
UNITS = [(2.0**40, 1.0), (2.0**-40, 1.0), (1.0, 4.0**16), (1.0, 4.0**-16)]


def in_units(drift, sigma):
    """A model with the coefficients of X, in units that are parameters."""
    return lambda c, k: jb.Diffusion(
        lambda y, p: p["c"] * drift(y / p["c"], p["rate"]) / p["k"],
        lambda y, p: p["c"] * sigma(y / p["c"]) / jnp.sqrt(p["k"]),
        params={"rate": 1.0, "c": c, "k": k},
    )


TURN = jnp.array([[0.5, 0.0], [0.2, 0.4]])
MODELS = {
    "oscillator": in_units(
        lambda x, a: a * jnp.stack([x[1] - x[0], -x[0] - x[1] ** 3]), lambda x: TURN
    ),
    "turned": in_units(lambda x, a: -a * x, lambda x: TURN * (1 + 0.3 * jnp.tanh(x[0]))),
}


def data(c, k):
    states = (1.0 + 0.3 * np.sin(np.arange(6.0)))[:, None] * np.ones(2)
    return np.arange(6) * 0.5 * k, states * c


def density(model, times, states, c):
    made = jb.transition_log_density(
        KEY, model, states[0], states[1], times[1], num_proposals=100, num_steps=8,
        proposal=jb.Guided(),
    )  # fmt: skip
    return made.value + 2 * np.log(c), made.standard_error, made.step_error


def record(states, c):
    first = jb.GaussianLaw(states[0], 0.01 * c**2 * np.eye(2))
    seen = jb.LinearGaussian([[1.0, 0.0]], covariance=0.01 * c**2)
    return {"observation": seen, "initial": first, "num_steps": 4}


def likelihood(model, times, states, c):
    made = jb.log_likelihood(
        KEY, model, times, states[:, :1], num_particles=40, num_filters=4, **record(states, c)
    )
    return made.value + len(times) * np.log(c), made.standard_error, made.step_error


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "name"),
    [
        (density, "oscillator"),
        (density, "turned"),
        (likelihood, "oscillator"),
    ],
)
def test_results_in_other_units(function, name):
    def run(c, k):
        times, states = data(c, k)
        return function(MODELS[name](c, k), times, states, c)

    exact = run(1.0, 1.0)
    for c, k in UNITS:
        for one, other in zip(exact, run(c, k), strict=True):
            np.testing.assert_allclose(one, other, rtol=0.01, atol=1e-3, err_msg=f"{c:g}, {k:g}")


@pytest.mark.slow
def test_start_laws_in_other_units():
    """Kernels on draws that are as small as the unit is."""
    draws = np.asarray(jax.random.normal(KEY, (50, 2)))
    points = draws[:5] + 0.1

    def log_densities(c):
        model = jb.ornstein_uhlenbeck(np.eye(2), sigma=np.sqrt(2) * c * np.eye(2))
        law = smoothed_draws(KEY, draws * c, jnp.zeros(2), model)
        return jax.vmap(law.log_density)(points * c) + 2 * np.log(c)

    np.testing.assert_allclose(log_densities(2.0**-40), log_densities(1.0), rtol=1e-3)
