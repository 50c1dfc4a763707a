"""Schemes: their inverses recover the noise, and they converge at their orders."""

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


@pytest.mark.parametrize(
    ("make_model", "order"), [(full_model, 1.5), (diagonal_model, 1.5), (paper_model, 2.5)]
)
def test_heun_inverse_order(make_model, order, x64):
    steps = 2.0 ** -np.arange(8, 15)
    errors = recovery_error(jb.Heun(), make_model(), steps)
    assert loglog_slope(steps, errors) == pytest.approx(order, abs=0.15)


def test_milstein_past_the_fold_is_finite():
    dynamics = jb.Diffusion(lambda x, p: -x, lambda x, p: jnp.exp(x)).forward(jnp.zeros(1))
    far_below = jnp.array([-5.0])  # no increment takes 0 there in one step
    noise = jb.Milstein().noise(dynamics, jnp.zeros(1), far_below, jnp.asarray(0.01))
    assert jnp.isfinite(noise).all()


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


def test_milstein_refuses_full_noise():
    model = jb.Diffusion(lambda x, p: -x, lambda x, p: jnp.diag(1 + x**2))
    with pytest.raises(ValueError, match="scalar or diagonal noise"):
        jb.Milstein().step(model.forward(jnp.ones(2)), jnp.ones(2), jnp.asarray(0.1), jnp.ones(2))


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


@pytest.mark.parametrize(
    "model",
    [jb.hyperbolic(0.8, 2), jb.Diffusion(lambda x, p: -x, lambda x, p: 1 + x**2, reversible=True)],
)
def test_exact_transitions_need_a_linear_drift_and_a_constant_sigma(model):
    with pytest.raises(ValueError, match="`GaussianTransition` is for linear drift"):
        jb.GaussianTransition().step(
            model.forward(jnp.ones(2)), jnp.ones(2), jnp.asarray(0.1), jnp.ones(2)
        )
