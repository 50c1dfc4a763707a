"""Densities of steps: the order of the error that they add up to along a path."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from helpers import FULL_SIGMA, NON_REVERSIBLE, loglog_slope, paper_model

import jaxbridge as jb


@pytest.mark.slow
@pytest.mark.parametrize("reversible", [False, True])
def test_trapezoid_density_is_of_second_order(reversible, x64):
    """log p̂ against the closed form, for a drift that is a gradient and for one with a curl and
    a full σ; each error is far beyond its standard error."""
    model, ends = paper_model(), (jnp.array([0.785, 0.785]), jnp.array([-0.2, 0.4]))
    if not reversible:
        model = jb.ornstein_uhlenbeck(2 * NON_REVERSIBLE, [0.2, -0.1], FULL_SIGMA)
    exact = float(jb.ou_transition(model, ends[0], 1.0).log_density(ends[1]))
    sizes, errors = np.array([4, 8, 16]), []
    for num_steps in sizes:
        estimate = jb.transition_log_density(
            jax.random.key(0),
            model,
            *ends,
            1.0,
            num_proposals=400_000,
            num_steps=int(num_steps),
            proposal=jb.Guided(density=jb.ItoTaylorDensity()),
        )
        errors.append(float(estimate.value) - exact)
        assert estimate.standard_error < 0.002
        if num_steps < 16:
            assert abs(errors[-1]) > 4 * float(estimate.standard_error)
    assert abs(loglog_slope(1 / sizes, np.abs(errors)) - 2) < 0.3


@pytest.mark.slow
def test_curl_is_called_for():
    """Without the term of Lévy's area the error is of first order."""
    model = jb.ornstein_uhlenbeck([[0.5, 3.0], [-3.0, 0.5]])
    ends = jnp.array([0.5, 0.0]), jnp.array([-0.3, 0.3])
    exact = float(jb.ou_transition(model, ends[0], 1.0).log_density(ends[1]))
    estimate = jb.transition_log_density(
        jax.random.key(0), model, *ends, 1.0, num_proposals=50_000, num_steps=40,
        proposal=jb.Guided(density=jb.ItoTaylorDensity()),
    )  # fmt: skip
    # Without it log p̂ lacks δ T |Ω|²/12 and, with E ΔwΔwᵀ = δ I, δ T |Ω|²/6; here |Ω|² = 18.
    lacking = 18 / 40 / 12 + 18 / 40 / 6
    assert abs(float(estimate.value) - exact) < 5 * float(estimate.standard_error) + lacking / 10


def test_nonlinear_drift_by_quadrature(x64):
    """A double well in one dimension: the chain of trapezoid densities against e^{-TH}, H being
    the Schrödinger operator of the process, without any Monte Carlo."""
    model = jb.Diffusion(lambda x, p: 1.2 * (x - x**3))
    grid = np.linspace(-3.5, 3.5, 1401)
    width, start, end, duration = grid[1] - grid[0], 640, 900, 1.0

    def beta(x):
        return 1.2 * (x - x**3)

    potential = (beta(grid) ** 2 + 1.2 * (1 - 3 * grid**2)) / 2
    diagonal, off = potential + 1 / width**2, np.full(len(grid) - 1, -0.5 / width**2)
    energies, states = scipy.linalg.eigh_tridiagonal(diagonal, off)
    A = 1.2 * (grid**2 / 2 - grid**4 / 4)
    kernel = (states[start] * np.exp(-duration * energies)) @ states[end] / width
    exact = np.log(kernel) + A[end] - A[start]

    density, dynamics = jb.ItoTaylorDensity(), model.forward(jnp.zeros(1))
    sizes, errors = np.array([10, 20, 40]), []
    for num_steps in sizes:
        dt = jnp.asarray(duration / num_steps)

        def log_step(x, y, dt=dt):
            seen, seen_next = density.look(dynamics, x), density.look(dynamics, y)
            euler = jb.GaussianLaw(x + dynamics.drift(x) * dt, jnp.eye(1) * dt).log_density(y)
            return euler + density.log_ratio(dynamics, x, y, seen, seen_next, dt)

        points = jnp.asarray(grid)[:, None]
        step = jax.jit(jax.vmap(jax.vmap(log_step, (None, 0)), (0, None)))(points, points)
        step = np.exp(np.asarray(step))
        forward = step[start]
        for _ in range(num_steps - 1):
            forward = forward @ step * width
        errors.append(np.log(forward[end]) - exact)
    assert abs(loglog_slope(1 / sizes, np.abs(errors)) - 2) < 0.25
    assert abs(errors[-1]) < 0.01


def test_linear_step_in_one_dimension_against_the_exact_density(x64):
    """One step of dX = -βX dt + dW: the error of its log density, averaged over where it leads."""
    model = jb.ornstein_uhlenbeck([[0.8]])
    x, nodes = jnp.array([0.6]), np.polynomial.hermite_e.hermegauss(40)
    density, dynamics = jb.ItoTaylorDensity(), model.forward(jnp.zeros(1))
    sizes, errors = np.array([0.2, 0.1, 0.05]), []
    for dt in sizes:
        law = jb.ou_transition(model, x, dt)
        points = law.mean + jnp.sqrt(law.covariance[0, 0]) * jnp.asarray(nodes[0])[:, None]

        def error(y, dt=dt, law=law):
            seen, seen_next = density.look(dynamics, x), density.look(dynamics, y)
            ratio = density.log_ratio(dynamics, x, y, seen, seen_next, jnp.asarray(dt))
            euler = jb.GaussianLaw(x + dynamics.drift(x) * dt, jnp.eye(1) * dt).log_density(y)
            return ratio + euler - law.log_density(y)

        values = np.asarray(jax.vmap(error)(points))
        errors.append(np.expm1(values) @ nodes[1] / nodes[1].sum())
    # O(δ³) on average in each step, so O(δ²) along a path.
    assert abs(loglog_slope(sizes, np.abs(errors)) - 3) < 0.25


def test_state_dependent_sigma_is_refused():
    model = jb.Diffusion(lambda x, p: -x, lambda x, p: 1 + 0.1 * x**2)
    with pytest.raises(ValueError, match="is for constant σ"):
        jb.sample_weighted_bridges(
            jax.random.key(0), model, [0.3], [0.1], 1.0, num_bridges=2,
            proposal=jb.ModifiedDiffusionBridge(jb.ItoTaylorDensity()),
        )  # fmt: skip
