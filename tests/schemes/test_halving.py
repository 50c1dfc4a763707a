"""What half as many steps would have given: E[w e^D h] is their estimate."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FULL_SIGMA, NON_REVERSIBLE, slow_beyond
from scipy.stats import multivariate_normal
from test_step_density import EXPANSIONS, FROM, TO, log_density_of_chain, quadrature

import jaxbridge as jb
from jaxbridge.models.bridge_problem import Intervals
from jaxbridge.proposals.guided import noise_of, path_of
from jaxbridge.schemes.halving import log_halving_of_paths, num_looked

WELL = jb.Diffusion(lambda x, p: 1.2 * (x - x**3))
VARYING = jb.Diffusion(lambda x, p: -0.8 * x, lambda x, p: 1 + 0.3 * jnp.tanh(x))


def weighted_paths(model, start, end, num_bridges, num_steps, density, key=0, **options):
    return jb.sample_weighted_bridges(
        jax.random.key(key), model, start, end, 1.0, num_bridges=num_bridges, num_steps=num_steps,
        proposal=jb.Guided(density=density, **options),
    )  # fmt: skip


@pytest.mark.parametrize("density", slow_beyond(1, EXPANSIONS.values()), ids=EXPANSIONS)
def test_linear_drift_is_known(density, x64):
    """Every D is log [q_2δ / n_2] of the points two steps apart, n_2 being two steps of the
    chain; and e^D has the quotient of the two closed forms as its mean."""
    B, num_steps = NON_REVERSIBLE, 8
    model = jb.ornstein_uhlenbeck(B, [0.1, 0.1], FULL_SIGMA)
    weighted = weighted_paths(model, FROM, TO, 64_000, num_steps, density)
    assert jnp.ptp(weighted.log_weights) < 1e-9
    known = ~np.isnan(weighted.log_halving)
    assert known.sum() == num_looked(64_000, False) == 2_000  # the first ones of each block
    D = np.asarray(weighted.log_halving)[known]

    F, V = jnp.asarray(-B), jnp.asarray(FULL_SIGMA @ FULL_SIGMA.T)
    once, twice = (density.linear_step(F, V, jnp.asarray(k / num_steps)) for k in (1, 2))
    decay, covariance = np.asarray(once.decay), np.asarray(once.covariance)
    covariance = decay @ covariance @ decay.T + covariance
    expected = np.zeros(10)
    for i, path in enumerate(np.asarray(weighted.paths[known][:10]) - 0.1):
        for x, x_next in zip(path[:-2:2], path[2::2], strict=True):
            expected[i] += multivariate_normal(twice.decay @ x, twice.covariance).logpdf(x_next)
            expected[i] -= multivariate_normal(decay @ decay @ x, covariance).logpdf(x_next)
    np.testing.assert_allclose(D[:10], expected, atol=1e-9)

    case = (density, B, FULL_SIGMA, FROM, TO, 1.0)
    fine, coarse = (log_density_of_chain(*case, n, centre=0.1) for n in (num_steps, num_steps // 2))
    ratio = np.exp(D - (coarse - fine))
    assert abs(ratio.mean() - 1) < 5 * ratio.std() / np.sqrt(len(ratio)) < 0.1


CASES = {
    "well, euler": (WELL, jb.EulerDensity(), 0.3),
    "well, ito_taylor": (WELL, jb.ItoTaylorDensity(), 0.3),
    "varying, euler": (VARYING, jb.EulerDensity(), 0.6),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", slow_beyond(1, CASES))
@pytest.mark.parametrize("refinement", slow_beyond(1, [1.0, 1.5]))
def test_mean_is_that_of_half_as_many_steps(case, refinement):
    """Of the weight, and of the mid-point, against paths of half as many steps."""
    model, density, spread = CASES[case]
    start, end = [-0.3], [1.0]
    size = 40_000 if model is VARYING else 320_000
    fine, coarse = (
        weighted_paths(model, start, end, size, n, density, n, refinement=refinement)
        for n in (16, 8)
    )
    known = ~np.isnan(fine.log_halving)
    D, log_w = np.asarray(fine.log_halving)[known], np.asarray(fine.log_weights)[known]
    assert np.cov(D, aweights=np.exp(log_w)) < spread**2
    w, other = np.exp(log_w + D), np.exp(np.asarray(coarse.log_weights))
    error = np.hypot(w.std() / np.sqrt(len(w)), other.std() / np.sqrt(size))
    assert abs(w.mean() - other.mean()) < 5 * error < 0.1 * w.mean()
    x, y = np.asarray(fine.paths[known, 8, 0]), np.asarray(coarse.paths[:, 4, 0])
    mean, other_mean = np.average(x, weights=w), np.average(y, weights=other)
    error = np.linalg.norm(w * (x - mean)) / w.sum()
    error = np.hypot(error, np.linalg.norm(other * (y - other_mean)) / other.sum())
    assert abs(mean - other_mean) < 5 * error < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_factor_is_that_of_quadrature(case, x64):
    """The weighted mean of e^D, which is the quotient of the densities of the two chains."""
    model, density, _ = case
    nodes = np.linspace(-5, 5, 401) if model is VARYING else np.linspace(-3.5, 3.5, 351)
    fine, coarse = (quadrature(density, model, [-0.3], [1.0], 1.0, n, nodes) for n in (16, 8))
    weighted = weighted_paths(model, [-0.3], [1.0], 160_000, 16, density)
    paths = weighted.paths  # of all of them, where the sampler looks at a part
    dt = jnp.broadcast_to(jnp.diff(weighted.times)[:, None], (16, len(paths)))
    log_halving = eqx.filter_jit(log_halving_of_paths)
    D = np.asarray(log_halving(density, model.forward(paths[0, 0]), dt, paths))
    w = np.exp(np.asarray(weighted.log_weights))
    w, factor = w / w.sum(), np.exp(D - (coarse - fine))
    error = np.linalg.norm(w * (factor - w @ factor))
    assert abs(w @ factor - 1) < 5 * error < 0.04


@pytest.mark.slow
@pytest.mark.parametrize("density", slow_beyond(1, EXPANSIONS.values()), ids=EXPANSIONS)
@pytest.mark.parametrize("num_steps", slow_beyond(1, [7, 2, 1]))
def test_one_d_for_each_path(density, num_steps, x64):
    """The loop that draws, the maps between noise and paths, and `log_halving_of_paths` agree; of
    an odd number of steps the rest counts for all, and of one step nothing is known."""
    model = jb.Diffusion(lambda x, p: -x + jnp.sin(x[::-1]))
    proposal = jb.Guided(density=density, refinement=1.5)
    weighted = jb.sample_weighted_bridges(
        jax.random.key(0), model, FROM, TO, 1.0, num_bridges=20, num_steps=num_steps,
        proposal=proposal,
    )  # fmt: skip
    paths = weighted.paths
    start, end, ones = paths[:, 0], paths[:, -1], jnp.ones(20)
    dt = jnp.broadcast_to(jnp.diff(weighted.times)[:, None], (num_steps, 20))
    dynamics, intervals = model.forward(start[0]), Intervals(start, end, ones)
    made = [log_halving_of_paths(density, dynamics, dt, paths)]
    noise, _, D = jax.jit(lambda x: noise_of(proposal, dynamics, intervals, x))(paths)
    made += [
        D,
        jax.jit(lambda x: path_of(proposal, dynamics, intervals, x, x.shape[1] + 1).log_change)(
            noise
        ),
    ]
    for D in made:
        np.testing.assert_allclose(D, weighted.log_halving, atol=1e-9)
    assert np.isnan(weighted.log_halving).all() == (num_steps == 1)
    if num_steps == 7:
        even = log_halving_of_paths(density, dynamics, dt[:6], paths[:, :7])
        np.testing.assert_allclose(made[0], even * 7 / 6, atol=1e-9)
