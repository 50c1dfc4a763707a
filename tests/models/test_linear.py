"""Transitions of linear diffusions against SciPy's matrix exponential and quadrature."""

import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest
import scipy.linalg

from jaxbridge.models.linear import linear_transition

CASES = {
    "stable": [[-1.0, 0.4], [-0.3, -0.5]],
    "turning": [[-0.1, 20.0], [-20.0, -0.1]],
    "singular": [[0.0, 1.0], [0.0, 0.0]],
    "still": [[0.0, 0.0], [0.0, 0.0]],
    "stiff": [[-0.5, 0.0], [1.0, -500.0]],
}
V = np.array([[1.0, 0.3], [0.3, 2.0]])


def by_quadrature(A, t):
    """e^{tA}, and both integrals by Gauss' rule on many short pieces."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    edges = np.linspace(0, t, 201)
    half = np.diff(edges)[:, None] / 2
    times, weights = ((edges[:-1, None] + half * (1 + nodes)).ravel(), (half * weights).ravel())
    flows = scipy.linalg.expm(A * times[:, None, None])
    integral = np.einsum("t,tij->ij", weights, flows)
    covariance = np.einsum("t,tij,jk,tlk->il", weights, flows, V, flows)
    return scipy.linalg.expm(A * t), integral, covariance


@pytest.mark.parametrize("t", [1e-3, 1.0])
@pytest.mark.parametrize("case", CASES)
def test_transition_is_that_of_quadrature(case, t, x64):
    A = np.array(CASES[case])
    moments = linear_transition(jnp.asarray(A), jnp.asarray(V), jnp.asarray(t))
    for found, exact in zip(moments, by_quadrature(A, t), strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-11, atol=1e-13)


def test_float32_keeps_its_digits():
    A = np.array(CASES["stable"], np.float32)
    for t in (1e-4, 1.0, 50.0):
        found = linear_transition(jnp.asarray(A), jnp.asarray(V, jnp.float32), jnp.asarray(t))
        for one, exact in zip(found, by_quadrature(A.astype(float), t), strict=True):
            np.testing.assert_allclose(one, exact, rtol=3e-6, atol=1e-9)


def test_long_times_tend_to_the_stationary_covariance(x64):
    A = np.array(CASES["stable"])
    found = linear_transition(jnp.asarray(A), jnp.asarray(V), jnp.asarray(1e6))
    stationary = scipy.linalg.solve_continuous_lyapunov(A, -V)
    np.testing.assert_allclose(found.covariance, stationary, rtol=1e-12)
    np.testing.assert_allclose(found.decay, 0, atol=1e-12)
    np.testing.assert_allclose(found.integral, np.linalg.inv(-A), rtol=1e-12)


@pytest.mark.slow
def test_derivatives_in_both_modes(x64):
    A, t = jnp.array(CASES["stable"]), jnp.asarray(0.7)

    def total(A, t):
        moments = linear_transition(jnp.asarray(A), jnp.asarray(V), jnp.asarray(t))
        return sum(jnp.sum(jnp.sin(moment)) for moment in moments)

    jax.test_util.check_grads(total, (A, t), order=1, modes=("fwd", "rev"))


def test_one_compiled_program_serves_a_batch(x64):
    times = jnp.array([1e-3, 0.5, 30.0])
    A = jnp.array(CASES["turning"])
    batched = jax.vmap(lambda t: linear_transition(A, jnp.asarray(V), t))(times)
    for i, t in enumerate(times):
        single = linear_transition(A, jnp.asarray(V), t)
        for one, many in zip(single, batched, strict=True):
            np.testing.assert_allclose(one, many[i])


def test_infinite_numbers_come_to_an_end():
    A = jnp.array([[jnp.inf, 0.0], [0.0, -1.0]])
    found = linear_transition(A, jnp.asarray(V, jnp.float32), jnp.asarray(1.0))
    assert not jnp.isfinite(found.covariance).all()
