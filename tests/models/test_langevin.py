"""Ready models against exact laws: quadrature, SciPy's Bessel functions, Fokker–Planck."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.special
import scipy.stats
from helpers import assert_moments, slow_beyond

import jaxbridge as jb


@jax.jit
def stationary_samples(model):
    return jax.vmap(model.sample_stationary)(jax.random.split(jax.random.key(0), 20_000))


@jax.jit
def log_densities(model, points):
    return jax.vmap(model.log_stationary)(points)


def radial_cdf(alpha, dim):
    """That of |X|, whose density is proportional to r^{dim-1} exp(-2α √(1+r²))."""
    r = np.linspace(0, 40 * dim / alpha, 200_001)
    density = r ** (dim - 1) * np.exp(-2 * alpha * (np.sqrt(1 + r**2) - 1))
    mass = scipy.integrate.cumulative_simpson(density, x=r, initial=0)
    return lambda radius: np.interp(radius, r, mass / mass[-1])


# The Kolmogorov distance passed with the probability of five standard deviations, 5.7e-7.
KOLMOGOROV_GATE = np.sqrt(-np.log(5.7e-7 / 2) / 2)


@pytest.mark.parametrize("dim", slow_beyond(1, [2, 1, 5]))
def test_the_hyperbolic_sampler_is_exact(dim):
    for alpha in [0.3, 2.0]:
        samples = np.asarray(stationary_samples(jb.hyperbolic(alpha, dim)))
        radius = np.linalg.norm(samples, axis=1)
        gate = KOLMOGOROV_GATE / np.sqrt(len(radius))
        assert scipy.stats.kstest(radius, radial_cdf(alpha, dim)).statistic < gate
        # Another law fails.
        assert scipy.stats.kstest(radius, radial_cdf(1.1 * alpha, dim)).statistic > gate
        # The direction is uniform on the sphere, near the origin and far from it. (Its second
        # moments vary less than those of the normal law by which the gates are set.)
        direction = samples / radius[:, None]
        for part in [radius < np.median(radius), radius >= np.median(radius)]:
            assert_moments(direction[part], np.zeros(dim), np.eye(dim) / dim)


def test_the_hyperbolic_sampler_follows_the_precision_of_alpha(precision):
    sample = jax.jit(lambda model: model.sample_stationary(jax.random.key(0)))
    point = sample(jb.hyperbolic(jnp.asarray(0.8, precision), 2))
    assert point.dtype == precision
    assert np.all(np.isfinite(point))


@pytest.mark.slow
def test_a_whole_number_alpha_is_a_number_like_any_other():
    whole, floating = jb.hyperbolic(1, 2), jb.hyperbolic(1.0, 2)
    x, key = jnp.ones(2), jax.random.key(0)
    np.testing.assert_array_equal(whole.log_stationary(x), floating.log_stationary(x))
    np.testing.assert_array_equal(whole.sample_stationary(key), floating.sample_stationary(key))


def log_normaliser(alpha, dim):
    """Of exp(-2α √(1+|x|²)): 2 K_{(d+1)/2}(2α) (π/α)^{(d-1)/2}."""
    order = (dim + 1) / 2
    log_bessel = np.log(scipy.special.kve(order, 2 * alpha)) - 2 * alpha
    return np.log(2) + log_bessel + (dim - 1) / 2 * np.log(np.pi / alpha)


@pytest.mark.parametrize("dim", [1, 2, 3, 7])
def test_the_hyperbolic_density_has_the_constant_of_the_bessel_function(dim, precision):
    tolerance = {"float32": 2e-5, "float64": 1e-12}[precision]
    points = jnp.asarray(np.random.default_rng(dim).standard_normal((5, dim)), precision)
    for alpha in [0.01, 0.3, 0.8, 5.0, 60.0]:
        exact = -2 * alpha * np.sqrt(1 + np.sum(np.square(points, dtype=float), axis=1))
        exact -= log_normaliser(alpha, dim)
        values = log_densities(jb.hyperbolic(jnp.asarray(alpha, precision), dim), points)
        assert values.dtype == precision
        np.testing.assert_allclose(values, exact, rtol=tolerance, atol=10 * tolerance)


def test_the_hyperbolic_density_integrates_to_one(x64):
    for alpha in [0.3, 0.8, 4.0]:
        r = np.linspace(0, 40 / alpha, 20_001)
        line = np.exp(log_densities(jb.hyperbolic(alpha, 1), r[:, None]))
        np.testing.assert_allclose(2 * scipy.integrate.simpson(line, x=r), 1, rtol=1e-9)
        ray = np.exp(log_densities(jb.hyperbolic(alpha, 2), np.stack([r, 0 * r], axis=1)))
        np.testing.assert_allclose(scipy.integrate.simpson(2 * np.pi * r * ray, x=r), 1, rtol=1e-9)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_the_score_of_the_hyperbolic_density_is_right(dim, x64):
    # An unnormalised density has this derivative wrong, and with it every estimate of α.
    x, step = np.ones(dim), 1e-5
    score = jax.jit(jax.grad(lambda alpha: jb.hyperbolic(alpha, dim).log_stationary(jnp.ones(dim))))
    exact = lambda alpha: -2 * alpha * np.sqrt(1 + x @ x) - log_normaliser(alpha, dim)
    for alpha in [0.1, 0.8, 5.0]:
        slope = (exact(alpha + step) - exact(alpha - step)) / (2 * step)
        np.testing.assert_allclose(score(alpha), slope, rtol=1e-7, atol=1e-7)


def test_the_hyperbolic_drift_is_half_the_gradient_of_its_log_density():
    model = jb.hyperbolic(0.8, 3)
    points = jnp.asarray(np.random.default_rng(0).standard_normal((10, 3)), jnp.float32)
    np.testing.assert_allclose(model.reversibility_residual(points), 0, atol=1e-6)
    np.testing.assert_allclose(model.drift(points[0]), model.reverse_drift(points[0]))


def test_the_langevin_drift_is_half_the_gradient():
    model = jb.langevin(lambda x, p: -p * (x @ x - 1) ** 2, params=1.5)
    x = jnp.array([0.5, -2.0])
    np.testing.assert_allclose(model.drift(x), -3 * x * (x @ x - 1), rtol=1e-6)
    np.testing.assert_array_equal(model.reverse_drift(x), model.drift(x))
    np.testing.assert_array_equal(model.diffusion(x), np.eye(2))


# A stationary density that is not normal, and matrix fields that vary in every entry.


def log_density(x, p):
    return -p["scale"] * jnp.log1p(x @ x) - jnp.sum(x**2) / 2 + jnp.sin(x[0]) * x[-1] / 3


def root(x, p):
    d = x.shape[0]
    lower = jnp.tril(jnp.sin(x[:, None] + 2 * x[None, :] * jnp.arange(1.0, d + 1)[:, None]) / 3)
    return lower - jnp.diag(jnp.diag(lower)) + jnp.diag(1 + p["spread"] * jnp.cos(x) ** 2)


def V_full(x, p):
    return root(x, p) @ root(x, p).T


def V_diagonal(x, p):
    return 1 + p["spread"] * jnp.cos(x + jnp.roll(x, 1)) ** 2


def Q(x, p):
    field = jnp.cos(x[:, None] * jnp.arange(1.0, x.shape[0] + 1)) * x[None, :]
    return p["swirl"] * (field - field.T)


def Q_reversed(x, p):
    return -Q(x, p)


PARAMS = {"scale": 0.7, "spread": 0.5, "swirl": 0.6}
MATRIX_FIELDS = pytest.mark.parametrize(
    "V, Q",
    [(None, Q), (V_full, None), (V_diagonal, Q), (V_full, Q)],
    ids=["Q", "V", "diagonal V, Q", "V, Q"],
)


def points_of(dim):
    return np.random.default_rng(dim).standard_normal((10, dim))


def fokker_planck_residual(model, x):
    """div(αν) - ½ Σ_ij ∂_i∂_j (V_ij ν) at x, by automatic differentiation."""

    def V_nu(y):
        sigma = model.diffusion(y)
        return sigma @ sigma.T * jnp.exp(model.log_stationary(y))

    drift_nu = lambda y: model.drift(y) * jnp.exp(model.log_stationary(y))
    transport = jnp.trace(jax.jacfwd(drift_nu)(x))
    return transport - jnp.einsum("ijij", jax.jacfwd(jax.jacfwd(V_nu))(x)) / 2


@pytest.mark.slow
@MATRIX_FIELDS
@pytest.mark.parametrize("dim", slow_beyond(1, [2, 3]))
def test_the_density_of_the_recipe_is_stationary(V, Q, dim, x64):
    residual = jax.jit(jax.vmap(fokker_planck_residual, (None, 0)))
    model = jb.stationary_diffusion(log_density, V, Q, PARAMS)
    np.testing.assert_allclose(residual(model, points_of(dim)), 0, atol=1e-12)


def test_a_wrong_drift_is_not_stationary(x64):
    model = jb.stationary_diffusion(log_density, V_full, Q, PARAMS)
    wrong = jb.Diffusion(
        lambda x, p: model.drift(x) + 0.01 * x, lambda x, p: model.diffusion(x), log_density, PARAMS
    )
    residual = jax.jit(jax.vmap(lambda x: fokker_planck_residual(wrong, x)))(points_of(2))
    assert np.abs(residual).max() > 1e-4


@MATRIX_FIELDS
@pytest.mark.parametrize("dim", slow_beyond(1, [2, 3]))
def test_the_reversal_of_the_recipe_turns_Q_around(V, Q, dim, x64):
    model = jb.stationary_diffusion(log_density, V, Q, PARAMS)
    turned = jb.stationary_diffusion(log_density, V, None if Q is None else Q_reversed, PARAMS)
    by_density = jb.Diffusion(model._drift, model._diffusion, log_density, PARAMS)
    drifts = lambda x: [
        model.drift(x),
        model.reverse_drift(x),
        by_density.reverse_drift(x),
        turned.drift(x),
    ]
    forward, closed_form, by_autodiff, exact = jax.jit(jax.vmap(drifts))(points_of(dim))
    np.testing.assert_allclose(closed_form, exact, atol=1e-12)
    np.testing.assert_allclose(by_autodiff, exact, atol=1e-12)
    assert model.reversible == (Q is None)
    assert (np.abs(forward - exact).max() > 0.1) == (Q is not None)


@pytest.mark.parametrize("V", [V_full, V_diagonal])
def test_sigma_is_a_root_of_V(V, x64):
    model = jb.stationary_diffusion(log_density, V, params=PARAMS)
    for x in points_of(3)[:3]:
        sigma, exact = np.asarray(model.diffusion(jnp.asarray(x))), np.asarray(V(x, PARAMS))
        exact = np.diag(exact) if exact.ndim == 1 else exact
        np.testing.assert_allclose(sigma @ sigma.T, exact, rtol=1e-12)


def test_a_constant_V_is_recognised():
    model = jb.stationary_diffusion(
        lambda x, p: -x @ x / 2, V=lambda x, p: p, params=jnp.array([[2.0, 1.0], [1.0, 2.0]])
    )
    assert not model.forward(jnp.ones(2)).sigma_varies
    np.testing.assert_allclose(model.drift(jnp.array([1.0, 0.0])), [-1, -0.5])


def test_a_temperature_sets_the_clock():
    """In a quadratic potential the Langevin diffusion is an Ornstein–Uhlenbeck process, whose
    transition is known; without a temperature it is slower by 2kT."""
    rate, heat, points = 1.3, 0.15, np.linspace(-1, 1, 5)[:, None]
    log_density = lambda x, kT: -rate * x @ x / (2 * kT) - jnp.log(2 * jnp.pi * kT / rate) / 2
    exact = jb.ornstein_uhlenbeck([[rate]], sigma=[[float(np.sqrt(2 * heat))]])
    of_params = jb.langevin(log_density, heat, temperature=lambda kT: kT, normalised=True)
    of_number = jb.langevin(log_density, heat, temperature=heat, normalised=True)
    slow = jb.langevin(log_density, heat)
    for x in points:
        for model in (of_params, of_number):
            np.testing.assert_allclose(model.drift(x), exact.drift(x), rtol=1e-5)
            np.testing.assert_allclose(model.reverse_drift(x), exact.drift(x), rtol=1e-5)
            np.testing.assert_allclose(model.diffusion(x), exact.diffusion(x), rtol=1e-5)
            np.testing.assert_allclose(model.log_stationary(x), exact.log_stationary(x), rtol=1e-4)
        np.testing.assert_allclose(2 * heat * slow.drift(x), exact.drift(x), rtol=1e-5)
    assert np.abs(of_params.reversibility_residual(points)).max() < 1e-5
    assert not of_params.sigma_varies(jnp.zeros(1))
    hotter = of_params.with_params(2 * heat)
    np.testing.assert_allclose(hotter.diffusion(points[0]) ** 2, 4 * heat, rtol=1e-5)


@pytest.mark.slow
def test_transitions_of_a_double_well_at_a_temperature():
    """Against the chain of a fine grid of points with the rates of -∇V and √(2kT)."""
    heat, start, end, duration = 0.3, -0.6, 0.8, 1.5
    potential = lambda x: (x @ x - 1) ** 2
    nodes = np.linspace(-3, 3, 1201)
    h, V = nodes[1] - nodes[0], (nodes**2 - 1) ** 2
    leaves = np.zeros(len(nodes))
    leaves[:-1] += heat / h**2 * np.exp(-np.diff(V) / (2 * heat))
    leaves[1:] += heat / h**2 * np.exp(np.diff(V) / (2 * heat))
    # The rates are reversible, so e^{V/2kT} makes them symmetric.
    symmetric = np.full(len(nodes) - 1, heat / h**2)
    rates, modes = scipy.linalg.eigh_tridiagonal(-leaves, symmetric)
    i, j = (np.flatnonzero(np.isclose(nodes, x))[0] for x in (start, end))
    law = (modes[i] * modes[j]) @ np.exp(duration * rates)
    expected = np.log(law / h) - (V[j] - V[i]) / (2 * heat)
    mass = scipy.integrate.quad(lambda x: np.exp(-((x**2 - 1) ** 2) / heat), -4, 4)[0]
    model = jb.langevin(
        lambda x, kT: -potential(x) / kT - float(np.log(mass)),
        heat,
        temperature=lambda kT: kT,
        normalised=True,
    )
    estimate = jb.transition_log_density(
        jax.random.key(0), model, [start], [end], duration,
        num_proposals=40_000, num_steps=60, proposal=jb.Coupling(0.0),
    )  # fmt: skip
    assert abs(estimate.value - expected) < 5 * estimate.standard_error + 0.01
    assert estimate.standard_error < 0.03
