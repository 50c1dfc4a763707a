"""Other coordinates, against diffusions on a half line and an interval with known transitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import count_compilations, swirl, unswirl, warped_model
from jax.scipy.special import logit
from scipy.stats import ncx2

import jaxbridge as jb

RATE, MEAN, NOISE = 1.0, 0.5, 0.6


def cir_log_stationary(x, p):
    """The Gamma density of the stationary law, normalised."""
    rate, mean, noise = p
    shape, scale = 2 * rate * mean / noise**2, noise**2 / (2 * rate)
    log_density = (shape - 1) * jnp.log(x) - x / scale
    return jnp.sum(log_density - jax.scipy.special.gammaln(shape) - shape * jnp.log(scale))


def cir_drift(x, p):
    return p[0] * (p[1] - x)


def cir_sigma(x, p):
    return p[2] * jnp.sqrt(x)


def cir_sampler(key, p):
    rate, mean, noise = p
    draw = jax.random.gamma(key, 2 * rate * mean / noise**2, (1,))
    return draw * noise**2 / (2 * rate)


def positive(x, p):
    return jnp.all(x > 0)


def cir(**options):
    """dX = (0.5 - X) dt + 0.6 √X dW (Cox, Ingersoll & Ross 1985)."""
    options = dict(reversible=True, normalised=True, sample_stationary=cir_sampler) | options
    return jb.Diffusion(cir_drift, cir_sigma, cir_log_stationary, (RATE, MEAN, NOISE), **options)


def cir_density(x, y, t):
    """p_t(x, y) by the non-central χ² law."""
    c = 2 * RATE / (NOISE**2 * (1 - np.exp(-RATE * t)))
    freedom = 4 * RATE * MEAN / NOISE**2
    return 2 * c * ncx2.pdf(2 * c * y, freedom, 2 * c * x * np.exp(-RATE * t))


def test_coefficients_follow_from_itos_formula(x64):
    logarithm = jb.transform(cir(), jnp.log, jnp.exp).model
    for y in (-1.3, 0.2):
        x = np.exp(y)
        drift = (RATE * (MEAN - x) - NOISE**2 / 2) / x
        np.testing.assert_allclose(logarithm.drift([y]), [drift], rtol=1e-10)
        np.testing.assert_allclose(logarithm.diffusion([y]), [[NOISE / np.sqrt(x)]], rtol=1e-10)
    residual = logarithm.reversibility_residual(np.array([[-1.0], [0.3]]))
    np.testing.assert_allclose(residual, 0, atol=1e-9)
    grid = jnp.linspace(-12, 3, 4001)[:, None]
    density = np.exp(np.asarray(jax.vmap(logarithm.log_stationary)(grid)))
    assert density.sum() * 15 / 4000 == pytest.approx(1, abs=1e-6)


@pytest.mark.slow
def test_a_planar_model_is_that_of_the_closed_form(x64):
    ou = jb.ornstein_uhlenbeck([[1.0, 1.5], [-1.0, 0.5]], sigma=[[1.0, 0.4], [-0.2, 0.7]])
    ours, theirs = jb.transform(ou, swirl, unswirl).model, warped_model(ou, swirl, unswirl)
    x = jnp.array([0.4, -0.9])
    np.testing.assert_allclose(ours.drift(x), theirs.drift(x), rtol=1e-8)
    np.testing.assert_allclose(ours.diffusion(x), theirs.diffusion(x), rtol=1e-8)
    np.testing.assert_allclose(ours.reverse_drift(x), theirs.reverse_drift(x), rtol=1e-7)
    key = jax.random.key(0)
    np.testing.assert_allclose(ours.sample_stationary(key), swirl(ou.sample_stationary(key)))


@pytest.mark.slow
def test_a_reversal_that_was_given_comes_along(x64):
    """dX = -(I + J) X dt + dW turns, and backwards the other way: known by its two drifts alone,
    it has the reversal that the stationary density of the transformed process gives."""
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
    drifts = [lambda x, p, s=sign: -x + s * turn @ x for sign in (-1, 1)]
    known = jb.Diffusion(drifts[0], reverse_drift=drifts[1])
    by_density = jb.Diffusion(drifts[0], None, lambda x, p: -x @ x)
    x = jnp.array([0.4, -0.9])
    ours, theirs = (jb.transform(m, swirl, unswirl).model for m in (known, by_density))
    np.testing.assert_allclose(ours.reverse_drift(x), theirs.reverse_drift(x), rtol=1e-8)
    assert abs(ours.reverse_drift(x) - ours.drift(x)).max() > 0.5


def test_a_constant_sigma_that_was_given_as_an_array_comes_along(x64):
    model = jb.Diffusion(lambda x, p: -x, 0.5 * np.eye(2), lambda x, p: -4 * x @ x)
    scaled = jb.transform(model, lambda x: 2 * x, lambda y: y / 2).model
    np.testing.assert_allclose(scaled.diffusion([1.0, 2.0]), np.eye(2))
    assert not jb.effects(scaled).solves.simulated


@pytest.mark.slow
def test_bridges_of_cir_have_the_exact_law():
    """Transition density and the law half way, near the boundary, from paths in log x."""
    start, end, duration = 0.15, 0.3, 1.0
    logarithm = jb.transform(cir(), jnp.log, jnp.exp)
    points = jnp.log(jnp.array([start])), jnp.log(jnp.array([end]))
    options = dict(num_steps=80, proposal=jb.ModifiedDiffusionBridge())
    estimate = jb.transition_log_density(
        jax.random.key(0), logarithm.model, *points, duration, num_proposals=40_000, **options
    )
    value = float(estimate.value + logarithm.log_jacobian([end]))
    exact = np.log(cir_density(start, end, duration))
    assert estimate.standard_error < 0.02
    assert abs(value - exact) < 5 * float(estimate.standard_error) + 0.02  # the step error
    weighted = logarithm.back(
        jb.sample_weighted_bridges(
            jax.random.key(1), logarithm.model, *points, duration, num_bridges=10_000, **options
        )
    )
    met = np.asarray(weighted.met)  # Euler steps may overflow next to the boundary
    paths, weights = np.asarray(weighted.paths)[met, :, 0], np.asarray(weighted.weights)[met]
    assert met.mean() > 0.99 and (paths > 0).all()
    np.testing.assert_allclose(paths[:, -1], end, rtol=1e-5)
    grid = np.linspace(1e-4, 5, 20_000)
    density = cir_density(start, grid, duration / 2) * cir_density(grid, end, duration / 2)
    mean = (density * grid).sum() / density.sum()
    sd = np.sqrt((density * (grid - mean) ** 2).sum() / density.sum())
    found = (weights * paths[:, 40]).sum() / weights.sum()
    size = weights.sum() ** 2 / (weights**2).sum()
    assert abs(found - mean) / sd < 5 / np.sqrt(size) + 0.02


def jacobi():
    """dX = (½ - X) dt + 0.4 √(X(1-X)) dW on the unit interval, with a Beta law."""
    return jb.Diffusion(
        lambda x, p: 0.5 - x,
        lambda x, p: 0.4 * jnp.sqrt(x * (1 - x)),
        lambda x, p: jnp.sum((1 / 0.4**2 - 1) * jnp.log(x * (1 - x))),
        reversible=True,
    )


def test_jacobians_at_one_point_and_many():
    logarithm = jb.transform(cir(), jnp.log, jnp.exp)
    points = np.array([[[0.5], [2.0]], [[1.0], [4.0]]], np.float32)
    np.testing.assert_allclose(logarithm.log_jacobian(points), -np.log(points[..., 0]), rtol=1e-6)
    np.testing.assert_allclose(logarithm.log_jacobian([0.5]), np.log(2), rtol=1e-6)


def test_maps_take_one_point_and_many():
    """Of a map that mixes coordinates, batches of any shape are the points one by one."""
    ou = jb.ornstein_uhlenbeck(np.eye(2))
    turned = jb.transform(ou, swirl, unswirl)
    points = jax.random.normal(jax.random.key(0), (3, 4, 2))
    for function, alone in [(turned.forward, swirl), (turned.inverse, unswirl)]:
        expected = np.array([[alone(x) for x in row] for row in points])
        np.testing.assert_allclose(function(points), expected, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(function(points[0]), expected[0], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(function(points[0, 0]), expected[0, 0], rtol=1e-5, atol=1e-6)
        assert function(points[:0]).shape == (0, 4, 2)
    np.testing.assert_allclose(turned.inverse(turned.forward(points)), points, atol=1e-5)
    logarithm = jb.transform(cir(), jnp.log, jnp.exp)
    np.testing.assert_allclose(logarithm.forward([[0.5], [2]]), np.log([[0.5], [2]]), rtol=1e-6)


def test_maps_are_pytrees_that_compile_once():
    run = jax.jit(lambda moved, x: moved.forward(x))
    points = jnp.ones((5, 1))
    run(jb.transform(cir(), jnp.log, jnp.exp), points)
    with count_compilations() as compiled:
        run(jb.transform(cir().with_params((1.0, 0.4, 0.5)), jnp.log, jnp.exp), points)
    assert not compiled


def growth():
    """dX = X(1 - X) dt + 0.7 X dW, of geometric type, with a Gamma law."""
    return jb.Diffusion(
        lambda x, p: x * (1 - x),
        lambda x, p: 0.7 * x,
        lambda x, p: jnp.sum((2 / 0.7**2 - 2) * jnp.log(x) - 2 * x / 0.7**2),
        reversible=True,
    )


@pytest.mark.slow
def test_intervals_and_half_lines_become_lines(x64):
    points = np.array([[-2.0], [0.3], [4.0]])
    for model, forward, inverse in [
        (jacobi(), logit, jax.nn.sigmoid),
        (growth(), jnp.log, jnp.exp),
    ]:
        line = jb.transform(model, forward, inverse).model
        np.testing.assert_allclose(line.reversibility_residual(points), 0, atol=1e-8)
    np.testing.assert_allclose(line.diffusion([0.3]), [[0.7]])


@pytest.mark.slow
def test_paths_that_leave_the_state_space_are_misses_and_counted():
    """In the original coordinates, near the boundary: what is left are bridges inside."""
    options = dict(num_bridges=500, num_steps=20, coupling=jb.Coupling(0.0, scheme=jb.Euler()))
    model = cir(domain=positive)
    bridges = jb.sample_bridges(jax.random.key(0), model, [0.02], [0.05], 1.0, **options)
    assert bridges.met.all() and bridges.num_nonfinite > 10
    assert (np.asarray(bridges.paths) > 0).all()
    guided = jb.transition_log_density(
        jax.random.key(0),
        model,
        [0.02],
        [0.05],
        1.0,
        num_proposals=2000,
        num_steps=20,
        proposal=jb.ModifiedDiffusionBridge(jb.EulerDensity()),
    )
    assert guided.num_nonfinite > 10 and np.isfinite(guided.value)


@pytest.mark.slow
def test_a_domain_is_told_from_no_domain():
    """An Ornstein–Uhlenbeck process knows no boundary, unless it is told so."""
    options = dict(num_bridges=200, num_steps=20)
    inside = jb.Diffusion(
        lambda x, p: -x, None, lambda x, p: -x @ x, reversible=True, domain=positive
    )
    ends = ([0.1], [0.1], 1.0)
    held = jb.sample_bridges(jax.random.key(0), inside, *ends, **options)
    free = jb.sample_bridges(jax.random.key(0), jb.ornstein_uhlenbeck([[1.0]]), *ends, **options)
    assert (np.asarray(held.paths)[np.asarray(held.met)] > 0).all()
    assert (np.asarray(free.paths) < 0).any() and free.num_nonfinite == 0


def test_the_same_functions_compile_once():
    def run(mean):
        model = cir().with_params((RATE, mean, NOISE))
        logarithm = jb.transform(model, jnp.log, jnp.exp)
        return jb.sample_bridges(
            jax.random.key(0), logarithm.model, [-0.5], [-0.4], 1.0, num_bridges=10, num_steps=5
        )

    run(0.5)
    with count_compilations() as compiled:
        run(0.6)
    assert not compiled
