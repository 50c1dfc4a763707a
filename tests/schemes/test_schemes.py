"""Schemes: their inverses recover the noise, and they converge at their orders."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import loglog_slope, paper_model, swirl, unswirl, warped_model
from scipy.interpolate import CubicSpline

import jaxbridge as jb

SCHEMES = {
    "Euler": jb.Euler(),
    "Milstein": jb.Milstein(),
    "Heun": jb.Heun(),
    "SemiImplicit": jb.SemiImplicit(),
}


def diagonal_model():
    return jb.Diffusion(lambda x, p: -x, lambda x, p: jnp.sqrt(1 + x**2))


def full_model():
    return warped_model(paper_model(), swirl, unswirl)


def recovery_error(scheme, model, steps, num_points=200):
    """For each step size, the largest error of the recovered noise over random points."""
    x_key, w_key = jax.random.split(jax.random.key(0))
    x = jax.random.normal(x_key, (num_points, 2))
    normal = jax.random.normal(w_key, (num_points, 2))

    @jax.jit
    def error(dt):
        dynamics = model.forward(x[0])

        def at_point(x, dw):
            x_next = scheme.step(dynamics, x, dt, dw)
            return jnp.abs(scheme.noise(dynamics, x, x_next, dt) - dw).max()

        return jax.vmap(at_point)(x, jnp.sqrt(dt) * normal).max()

    return [float(error(jnp.asarray(dt))) for dt in steps]


@pytest.mark.parametrize("name", ["Euler", "Milstein", "SemiImplicit"])
def test_inverse_is_exact(name, x64):
    assert max(recovery_error(SCHEMES[name], diagonal_model(), [0.01])) < 1e-13
    if name != "Milstein":
        assert max(recovery_error(SCHEMES[name], full_model(), [0.01])) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make_model", "order"), [(full_model, 1.5), (diagonal_model, 1.5), (paper_model, 2.5)]
)
def test_heun_inverse_order(make_model, order, x64):
    steps = 2.0 ** -np.arange(8, 15)
    errors = recovery_error(jb.Heun(), make_model(), steps)
    assert loglog_slope(steps, errors) == pytest.approx(order, abs=0.15)


def milstein_noise(x_next, slope, dt=0.01, dtype=None):
    """Of the step from 0 to `x_next`, without drift, with σ = 1 + slope · x."""
    model = jb.Diffusion(lambda x, p: jnp.zeros_like(x), lambda x, p: 1 + p * x, params=slope)
    x = jnp.zeros(1, dtype)
    noise = jb.Milstein().noise(model.forward(x), x, x_next[None], jnp.asarray(dt, dtype))
    return noise[0]


@pytest.mark.parametrize("slope", [3.0, -0.5, 1e-3, 1e-12])
def test_milstein_past_the_fold_is_the_fold(slope, precision):
    """The increment whose step comes nearest, found by search; it does not depend on how far
    past the fold the point is, and has derivatives."""
    dtype, dt = jnp.dtype(precision), 0.01
    fold = (-1 / slope - slope * dt) / 2  # the point that ΔW = -1/∂σ leads to
    for distance in (1.001, 1.5, 40.0):
        point = jnp.asarray(distance * (fold if abs(slope) < 1 else fold - 1 / slope), dtype)
        noise = milstein_noise(point, slope, dt, dtype)
        trial = np.linspace(-3, 3, 60_001) / abs(slope)
        misses = abs(trial + slope * (trial**2 - dt) / 2 - float(point))
        np.testing.assert_allclose(noise, trial[np.argmin(misses)], rtol=1e-3)
        np.testing.assert_allclose(noise, -1 / slope, rtol=1e-6)
        slopes = jax.grad(milstein_noise, (0, 1, 2))(point, jnp.asarray(slope, dtype), dt, dtype)
        np.testing.assert_allclose(slopes, [0, 1 / slope**2, 0], rtol=1e-5)


def test_milstein_is_continuous_at_the_fold(precision):
    dtype, slope, dt = jnp.dtype(precision), 3.0, 0.01
    fold = (-1 / slope - slope * dt) / 2
    points = jnp.asarray(fold, dtype) + jnp.linspace(-1, 1, 2001).astype(dtype) * 1e-5
    noise = jax.vmap(lambda x: milstein_noise(x, slope, dt, dtype))(points)
    assert (jnp.diff(noise) >= -1e-6).all()  # it does not jump back, and rises like a root
    expected = (-1 + np.sqrt(np.maximum(2 * slope * (np.asarray(points, float) - fold), 0))) / slope
    np.testing.assert_allclose(noise, expected, atol=1e-3 if dtype == "float32" else 1e-8)
    slopes = jax.vmap(jax.grad(lambda x: milstein_noise(x, slope, dt, dtype)))(points)
    assert jnp.isfinite(slopes).all()


@pytest.mark.parametrize("slope", [0.0, 1e-30, -1e-20])
def test_milstein_noise_of_a_tiny_slope_is_that_of_euler(slope):
    """Branches that are not taken leave no trace in derivatives."""
    value, slopes = jax.value_and_grad(milstein_noise, (0, 1))(jnp.array(0.3), jnp.array(slope))
    np.testing.assert_allclose(value, 0.3, rtol=1e-6)
    np.testing.assert_allclose(slopes, [1, (0.01 - 0.3**2) / 2], rtol=1e-5)


def strong_errors(scheme, model, exact, step_counts, num_paths=2000, finest=1024):
    """Root mean square distance at time 1 between scheme and `exact(x0, brownian path)`."""
    dw = jax.random.normal(jax.random.key(1), (num_paths, finest, 2)) / np.sqrt(finest)
    x0 = jnp.ones(2)
    dynamics = model.forward(x0)

    def run(dw):
        dt = jnp.asarray(1 / len(dw))
        return jax.lax.scan(lambda x, w: (scheme.step(dynamics, x, dt, w), None), x0, dw)[0]

    reference = jax.jit(jax.vmap(lambda dw: exact(x0, dw)))(dw)
    errors = []
    for count in step_counts:
        coarse = dw.reshape(num_paths, count, finest // count, 2).sum(2)
        difference = jax.jit(jax.vmap(run))(coarse) - reference
        errors.append(float(jnp.sqrt(jnp.mean(difference**2))))
    return errors


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "order"), [("Euler", 0.5), ("Milstein", 1.0), ("Heun", 1.0), ("SemiImplicit", 0.5)]
)
def test_strong_order_multiplicative_noise(name, order, x64):
    """Geometric Brownian motion, solved by exp((a - b²/2)t + b W_t)."""
    a, b = -0.5, 0.8
    model = jb.Diffusion(lambda x, p: a * x, lambda x, p: b * x)

    def exact(x0, dw):
        return x0 * jnp.exp(a - b**2 / 2 + b * dw.sum(0))

    counts = np.array([8, 16, 32, 64, 128])
    errors = strong_errors(SCHEMES[name], model, exact, counts)
    assert loglog_slope(1 / counts, errors) == pytest.approx(order, abs=0.15)


def test_strong_order_of_euler_with_additive_noise(x64):
    model = paper_model()

    def exact(x0, dw):  # on the finest grid, far below the errors measured
        dynamics, dt = model.forward(x0), jnp.asarray(1 / len(dw))
        return jax.lax.scan(lambda x, w: (jb.Heun().step(dynamics, x, dt, w), None), x0, dw)[0]

    counts = np.array([8, 16, 32, 64])
    errors = strong_errors(jb.Euler(), model, exact, counts)
    assert loglog_slope(1 / counts, errors) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(("name", "order"), [("Euler", 1.0), ("Heun", 2.0), ("SemiImplicit", 1.0)])
def test_weak_order_with_additive_noise(name, order, x64):
    """E[X_1²] for the hyperbolic diffusion in one dimension, without Monte Carlo: the
    backward recursion u(x) = E[u(step(x, W))] by quadrature on a grid."""
    grid = np.linspace(-9, 9, 1201)
    nodes, weights = np.polynomial.hermite_e.hermegauss(24)
    weights = weights / weights.sum()
    dynamics = jb.hyperbolic(1.5, 1).forward(jnp.zeros(1))
    step = jax.jit(
        jax.vmap(
            jax.vmap(lambda x, dt, w: SCHEMES[name].step(dynamics, x, dt, w), (0, None, None)),
            (None, None, 0),
        )
    )

    def expectation(num_steps):
        dt = 1 / num_steps
        noise = jnp.asarray(np.sqrt(dt) * nodes)[:, None]
        reached = np.asarray(step(jnp.asarray(grid)[:, None], jnp.asarray(dt), noise))[..., 0]
        values = grid**2
        for _ in range(num_steps):
            values = weights @ CubicSpline(grid, values)(reached)
        return CubicSpline(grid, values)(1.0)

    counts = np.array([8, 16, 32, 64]) if name == "SemiImplicit" else np.array([2, 4, 8, 16])
    reference = expectation(1024 if name == "SemiImplicit" else 256)
    errors = [abs(expectation(count) - reference) for count in counts]
    assert loglog_slope(1 / counts, errors) == pytest.approx(order, abs=0.25)


def test_semi_implicit_steps_keep_the_stationary_law_of_a_stiff_linear_drift(x64):
    """C Γ Cᵀ + R Rᵀ δ = Γ, with a step 500 times as long as the shortest relaxation time."""
    model = jb.ornstein_uhlenbeck([[500.0, 30.0], [-1.0, 0.5]], sigma=[[1.0, 0.4], [-0.2, 0.7]])
    x, dt = jnp.zeros(2), jnp.asarray(1.0)
    dynamics = model.forward(x)
    scheme = jb.SemiImplicit()
    C = jax.jacfwd(lambda x: scheme.step(dynamics, x, dt, jnp.zeros(2)))(x)
    R = jax.jacfwd(lambda dw: scheme.step(dynamics, x, dt, dw))(jnp.zeros(2))
    covariance = jb.ou_stationary(model).covariance
    np.testing.assert_allclose(C @ covariance @ C.T + R @ R.T * dt, covariance, atol=1e-10)


def test_semi_implicit_steps_come_back_from_far_out():
    """From 10⁶ with α = -x³: an explicit step of 0.1 leads to -10¹⁷."""
    dynamics = jb.Diffusion(lambda x, p: -(x**3)).forward(jnp.zeros(1))
    x = jnp.array([1e6])
    for _ in range(20):
        x = jb.SemiImplicit().step(dynamics, x, jnp.asarray(0.1), jnp.zeros(1))
    assert abs(float(x[0])) < 5


# Exact transitions


def test_exact_transitions_have_the_law_of_the_process(precision):
    model = jb.ornstein_uhlenbeck(
        [[1.0, 1.5], [-1.0, 0.5]], mean=[0.3, -0.2], sigma=[[1.0, 0.4], [-0.2, 0.7]]
    )
    x, dt = jnp.array([0.5, -1.0]), jnp.asarray(0.4)
    forward = model.forward(x)
    scheme = jb.GaussianTransition().fitted(forward, x, dt)
    law = jb.ou_transition(model, x, dt)
    tolerance = dict(rtol=1e-5 if precision == "float32" else 1e-12)
    np.testing.assert_allclose(scheme.step(forward, x, dt, jnp.zeros(2)), law.mean, **tolerance)
    root = jax.jacfwd(lambda dw: scheme.step(forward, x, dt, dw))(jnp.zeros(2))
    np.testing.assert_allclose(root @ root.T * dt, law.covariance, **tolerance)
    dw = jnp.array([0.3, -0.8])
    x_next = jb.GaussianTransition().step(forward, x, dt, dw)
    np.testing.assert_allclose(scheme.noise(forward, x, x_next, dt), dw, rtol=1e-4)


def test_exact_transitions_tend_to_euler():
    """The root of the covariance is the one near σ, so that noise means the same to couplings."""
    model = jb.ornstein_uhlenbeck([[1.0, 1.5], [-1.0, 0.5]], sigma=[[0.0, 0.4], [-0.7, 0.1]])
    x, dt = jnp.array([0.5, -1.0]), jnp.asarray(1e-3)
    forward, dw = model.forward(x), jnp.array([0.02, -0.03])
    exact = jb.GaussianTransition().step(forward, x, dt, dw)
    np.testing.assert_allclose(exact, jb.Euler().step(forward, x, dt, dw), atol=1e-4)


@pytest.mark.parametrize("scene", ["constant", "varies", "linear"])
def test_the_default_scheme_is_the_one_that_the_scene_calls_for(scene, x64):
    """Heun's for a constant σ, Euler's for one that depends on the state, the exact transition for
    linear drift."""
    models = {"constant": jb.hyperbolic(1.0, 2), "varies": full_model(), "linear": paper_model()}
    model = models[scene]
    x, dw, dt = jnp.array([0.3, -0.4]), jnp.array([0.05, 0.1]), jnp.asarray(0.02)
    dynamics = model.forward(x)
    schemes = {"constant": jb.Heun(), "varies": jb.Euler(), "linear": jb.GaussianTransition()}
    expected = schemes[scene]
    assert jb.Coupling().scheme == jb.HeunOrEuler()
    fitted = jb.HeunOrEuler().fitted(dynamics, x, dt)
    assert eqx.tree_equal(fitted, expected.fitted(dynamics, x, dt))
    x_next = expected.step(dynamics, x, dt, dw)
    for scheme in (jb.HeunOrEuler(), expected):
        np.testing.assert_array_equal(scheme.step(dynamics, x, dt, dw), x_next)
        np.testing.assert_array_equal(
            scheme.noise(dynamics, x, x_next, dt), expected.noise(dynamics, x, x_next, dt)
        )
        frame = scheme.frame(dynamics, x, x_next, dt)
        np.testing.assert_array_equal(frame.u, expected.frame(dynamics, x, x_next, dt).u)
    assert jb.effects(model, at=x).corrector.simulated == (scene == "constant")
    assert not jb.effects(model, at=x).stratonovich.simulated
