"""The model: time reversal, what it recognises, its life as a pytree, its refusals."""

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from helpers import assert_moments

import jaxbridge as jb

SWIRLING_B = np.array([[1.0, 2.0], [-0.5, 1.5]])
SWIRLING_SIGMA = np.array([[1.0, 0.0], [0.4, 0.8]])
MEAN = np.array([0.5, -1.0])
SYMMETRIC_B = np.array([[1.5, 1.0], [1.0, 1.5]])
POINTS = np.random.default_rng(0).standard_normal((20, 2)).astype(np.float32)


def stationary_covariance(B, sigma):
    return scipy.linalg.solve_continuous_lyapunov(B, sigma @ sigma.T)


def ou_by_density(B, mean, sigma):
    """An OU process that knows its stationary density only, not its reversal."""
    precision = np.linalg.inv(stationary_covariance(B, sigma))
    return jb.Diffusion(
        lambda x, p: -p["B"] @ (x - p["mean"]),
        lambda x, p: p["sigma"],
        lambda x, p: -(x - p["mean"]) @ p["precision"] @ (x - p["mean"]) / 2,
        {
            name: jnp.asarray(value, jnp.float32)
            for name, value in [
                ("B", B),
                ("mean", mean),
                ("sigma", sigma),
                ("precision", precision),
            ]
        },
    )


def hyperbolic_by_density(alpha):
    return jb.Diffusion(
        lambda x, p: -p * x / jnp.sqrt(1 + x @ x),
        log_stationary=lambda x, p: -2 * p * jnp.sqrt(1 + x @ x),
        params=alpha,
    )


# With ν the standard normal law, σ = [[1, 0], [s, 1]] and s = sin x₂, V = [[1, s], [s, 1+s²]]:
#   V ∇log ν = -(x₁ + s x₂, s x₁ + (1+s²) x₂),   div V = (∂₂s, ∂₁s + ∂₂s²) = (cos x₂, sin 2x₂).
# Half of their sum is the reversible drift. The rotation κ (x₂, -x₁) is free of divergence and
# orthogonal to ∇ν, so it leaves ν stationary, and time reversal turns it around.
KAPPA = 1.5


def shear_drift(x, p, turn=1):
    s = jnp.sin(x[1])
    flux = jnp.stack(
        [
            -x[0] - s * x[1] + jnp.cos(x[1]),
            -s * x[0] - (1 + s**2) * x[1] + jnp.sin(2 * x[1]),
        ]
    )
    return flux / 2 + turn * p * jnp.stack([x[1], -x[0]])


def shear_sigma(x, p):
    s = jnp.sin(x[1])
    return jnp.stack([jnp.stack([1 + 0 * s, 0 * s]), jnp.stack([s, 1 + 0 * s])])


SHEAR = jb.Diffusion(
    shear_drift,
    shear_sigma,
    lambda x, p: -x @ x / 2,
    KAPPA,
    sample_stationary=lambda key, p: jax.random.normal(key, (2,)),
)

# σ² = 1 + x² and ν ∝ (1+x²)⁻²: σ² (log ν)' + (σ²)' = -4x + 2x = -2x, so -x is reversible.
SPREADING = jb.Diffusion(
    lambda x, p: -x, lambda x, p: jnp.sqrt(1 + x**2), lambda x, p: -2 * jnp.log1p(x[0] ** 2)
)


def reverse_drifts(model, points):
    return jax.jit(jax.vmap(model.reverse_drift))(points)


@pytest.mark.parametrize("B", [SYMMETRIC_B, SWIRLING_B], ids=["symmetric", "swirling"])
@pytest.mark.parametrize("sigma", [np.eye(2), SWIRLING_SIGMA], ids=["identity", "full"])
def test_the_reversed_ou_process_has_the_matrix_of_theory(B, sigma):
    covariance = stationary_covariance(B, sigma)
    reverse_B = covariance @ B.T @ np.linalg.inv(covariance)
    exact = -(POINTS - MEAN) @ reverse_B.T
    tolerance = {"rtol": 1e-5, "atol": 1e-5}
    by_density = ou_by_density(B, MEAN, sigma)
    np.testing.assert_allclose(reverse_drifts(by_density, POINTS), exact, **tolerance)
    closed_form = jb.ornstein_uhlenbeck(*(jnp.asarray(a, jnp.float32) for a in (B, MEAN, sigma)))
    np.testing.assert_allclose(reverse_drifts(closed_form, POINTS), exact, **tolerance)


@pytest.mark.parametrize("d", [1, 2, 5])
def test_the_hyperbolic_diffusion_is_its_own_reversal(d):
    points = np.random.default_rng(d).standard_normal((20, d)).astype(np.float32)
    model = hyperbolic_by_density(0.8)
    exact = -0.8 * points / np.sqrt(1 + np.sum(points**2, axis=1, keepdims=True))
    np.testing.assert_allclose(reverse_drifts(model, points), exact, atol=1e-5)


def test_the_reversal_of_a_full_state_dependent_sigma():
    exact = jax.vmap(lambda x: shear_drift(x, KAPPA, turn=-1))(POINTS)
    np.testing.assert_allclose(reverse_drifts(SHEAR, POINTS), exact, rtol=1e-5, atol=1e-5)


def test_the_reversal_of_a_state_dependent_sigma_in_one_dimension():
    points = POINTS.reshape(-1, 1)
    np.testing.assert_allclose(reverse_drifts(SPREADING, points), -points, rtol=1e-5, atol=1e-5)


def test_in_five_dimensions_a_diagonal_sigma_may_vary(x64):
    # σ_i² = 1 + x_i² each, ν a product: the one-dimensional reversal in every coordinate.
    model = jb.Diffusion(
        lambda x, p: -x + p @ x,
        lambda x, p: jnp.sqrt(1 + x**2),
        lambda x, p: -2 * jnp.sum(jnp.log1p(x**2)),
        np.diag(np.ones(4), 1),
    )
    points = np.random.default_rng(0).standard_normal((20, 5))
    exact = -points - points @ np.diag(np.ones(4), 1).T
    np.testing.assert_allclose(reverse_drifts(model, points), exact, atol=1e-12)


def test_the_reversibility_residual_vanishes_for_reversible_models_only():
    residual = lambda model, points=POINTS: np.asarray(
        model.reversibility_residual(jnp.asarray(points))
    )
    for model in [ou_by_density(SYMMETRIC_B, MEAN, np.eye(2)), hyperbolic_by_density(0.8)]:
        np.testing.assert_allclose(residual(model), 0, atol=1e-5)
    np.testing.assert_allclose(residual(SPREADING, POINTS[:, :1]), 0, atol=1e-5)
    turning = KAPPA * np.stack([POINTS[:, 1], -POINTS[:, 0]], axis=1)
    np.testing.assert_allclose(residual(SHEAR), turning, rtol=1e-5, atol=1e-5)
    swirling = ou_by_density(SWIRLING_B, MEAN, np.eye(2))
    assert np.abs(residual(swirling)).max() > 0.1


def test_a_declared_reversible_model_is_believed():
    model = jb.Diffusion(lambda x, p: -(x**3), reversible=True)
    np.testing.assert_array_equal(model.reverse_drift(jnp.array([2.0])), [-8.0])


def test_a_given_reverse_drift_is_used():
    model = jb.Diffusion(lambda x, p: -x, params=3.0, reverse_drift=lambda x, p: p * x)
    np.testing.assert_array_equal(model.reverse_drift(jnp.array([2.0])), [6.0])


def lagged_pair(model, key):
    """(X_0, X_lag) of stationary paths, or of those of its reversal."""
    paths = jb.simulate(key, model, None, LAG_TIMES, num_paths=20_000, num_steps=10)
    return np.asarray(paths)


LAG_TIMES = np.array([0.0, 0.4], np.float32)


def reversal_of(model):
    return jb.Diffusion(
        lambda x, m: m.reverse_drift(x),
        lambda x, m: m.diffusion(x),
        params=model,
        sample_stationary=lambda key, m: m.sample_stationary(key),
    )


@pytest.mark.slow
def test_the_reversed_ou_process_retraces_stationary_paths():
    covariance = stationary_covariance(SWIRLING_B, SWIRLING_SIGMA)
    lagged = covariance @ scipy.linalg.expm(-LAG_TIMES[1] * SWIRLING_B).T  # Cov(X_0, X_t)
    joint = np.block([[covariance, lagged], [lagged.T, covariance]])
    mean = np.tile(MEAN, 2)
    model = jb.ornstein_uhlenbeck(SWIRLING_B, MEAN, SWIRLING_SIGMA)
    forward = lagged_pair(model, jax.random.key(0))
    backward = lagged_pair(reversal_of(model), jax.random.key(1))
    in_time, retraced = forward.reshape(-1, 4), backward[:, ::-1].reshape(-1, 4)
    assert_moments(in_time, mean, joint)
    assert_moments(retraced, mean, joint)
    # A model that is not reversed at all would fail: its lagged moments are not symmetric.
    with pytest.raises(AssertionError):
        assert_moments(forward[:, ::-1].reshape(-1, 4), mean, joint)


@pytest.mark.slow
def test_the_reversal_of_a_state_dependent_sigma_retraces_stationary_paths():
    def moments(early, late):
        """E f(early) g(late) with standard errors, for several f and g."""
        features = lambda x: np.concatenate([x, np.sin(2 * x), x**2], axis=1)
        products = features(early)[:, :, None] * features(late)[:, None, :]
        return products.mean(0), products.std(0) / np.sqrt(len(products))

    def largest_z(early_and_late, other):
        (first, first_error), (second, second_error) = moments(*early_and_late), moments(*other)
        return np.max(np.abs(first - second) / np.hypot(first_error, second_error))

    forward = lagged_pair(SHEAR, jax.random.key(2))
    backward = lagged_pair(reversal_of(SHEAR), jax.random.key(3))
    retraced = backward[:, 1], backward[:, 0]
    assert largest_z((forward[:, 0], forward[:, 1]), retraced) < 5
    # Without reversal the same paths are far away.
    assert largest_z((forward[:, 1], forward[:, 0]), retraced) > 10


@pytest.mark.parametrize(
    "sigma",
    [
        lambda x, p: p,
        lambda x, p: 2 * jnp.eye(x.shape[0], dtype=x.dtype),
        lambda x, p: jnp.full_like(x, 2),
        lambda x, p: jnp.where(p > 0, p, jnp.ones(x.shape)),
    ],
)
def test_a_sigma_that_ignores_the_point_is_constant(sigma):
    model = jb.Diffusion(lambda x, p: -x, sigma, params=jnp.array([1.0, 2.0]))
    x = jnp.ones(2)
    assert not model.forward(x).sigma_varies
    matrix = model.diffusion(x)
    np.testing.assert_array_equal(matrix, model.diffusion(5 * x))
    assert matrix.shape == (2, 2)


@pytest.mark.parametrize(
    "sigma",
    [
        lambda x, p: 1 + x**2,
        lambda x, p: p * (1 + x[0] ** 2),
        lambda x, p: jnp.diag(jnp.exp(x)),
        lambda x, p: jax.lax.cond(x[0] > 0, lambda: p, lambda: 2 * p),
        lambda x, p: jax.jit(lambda y: p * jnp.cosh(y))(x),
        lambda x, p: jax.lax.fori_loop(0, 2, lambda i, s: s + x**2, p),
    ],
)
def test_a_sigma_that_uses_the_point_varies(sigma):
    model = jb.Diffusion(lambda x, p: -x, sigma, params=jnp.array([1.0, 2.0]))
    assert model.forward(jnp.ones(2)).sigma_varies
    assert np.any(model.diffusion(jnp.ones(2)) != model.diffusion(-2 * jnp.ones(2)))


def test_constant_sigmas_given_as_arrays():
    x = jnp.ones(2)
    for sigma, dense in [
        (None, np.eye(2)),
        ([2, 3], np.diag([2, 3])),
        (np.array([[2.0, 1.0], [0.0, 1.0]]), [[2, 1], [0, 1]]),
    ]:
        model = jb.Diffusion(lambda x, p: -x, sigma)
        np.testing.assert_array_equal(model.diffusion(x), dense)
        assert not model.forward(x).sigma_varies


def test_functions_may_return_numpy_arrays(unchecked):
    model = jb.Diffusion(lambda x, p: np.array([1.0, 2.0]), lambda x, p: np.array([3.0, 4.0]))
    np.testing.assert_array_equal(model.drift(jnp.ones(2)), [1, 2])
    np.testing.assert_array_equal(model.diffusion(jnp.ones(2)), np.diag([3, 4]))


@pytest.mark.parametrize("name", ["drift", "diffusion", "reverse_drift", "log_stationary"])
def test_points_of_whole_numbers_mean_the_same_as_floating_ones(name, unchecked):
    function = getattr(jb.ornstein_uhlenbeck(SWIRLING_B, sigma=[0.5, 0.25]), name)
    with jax.numpy_dtype_promotion("standard"):
        np.testing.assert_allclose(function(jnp.array([1, 2])), function(jnp.array([1.0, 2.0])))


def test_with_params_changes_the_parameters_only():
    model = hyperbolic_by_density(0.8)
    other = model.with_params(1.6)
    x = jnp.array([1.0, 2.0])
    np.testing.assert_allclose(other.drift(x), 2 * model.drift(x), rtol=1e-6)
    np.testing.assert_allclose(other.log_stationary(x), 2 * model.log_stationary(x), rtol=1e-6)
    assert jax.tree.structure(other) == jax.tree.structure(model)


def test_with_params_may_give_parameters_where_there_were_none():
    model = jb.Diffusion(lambda x, p: -x if p is None else -p * x)
    np.testing.assert_array_equal(model.with_params(2.0).drift(jnp.ones(2)), [-2, -2])


def test_prepare_replaces_the_parameters():
    model = jb.Diffusion(
        lambda x, p: -p["squared"] * x, params=3.0, prepare=lambda p: {"squared": p**2}
    )
    np.testing.assert_array_equal(model.drift(jnp.ones(2)), [-9, -9])
    np.testing.assert_array_equal(model.with_params(1.0).drift(jnp.ones(2)), [-1, -1])


def test_models_pass_through_jit_vmap_and_grad():
    x = jnp.array([1.0, 2.0])
    alphas = jnp.array([0.5, 1.0, 2.0])
    exact = -alphas[:, None] * x / np.sqrt(6)
    drift = lambda model: model.drift(x)
    base = jb.hyperbolic(0.8, dim=2)
    np.testing.assert_allclose(jax.jit(drift)(base), -0.8 * x / np.sqrt(6), rtol=1e-6)
    over_params = jax.vmap(lambda alpha: base.with_params(alpha).drift(x))(alphas)
    np.testing.assert_allclose(over_params, exact, rtol=1e-6)
    models = jax.vmap(lambda alpha: jb.hyperbolic(alpha, dim=2))(alphas)
    np.testing.assert_allclose(jax.vmap(drift)(models), exact, rtol=1e-6)
    gradient = jax.grad(lambda model: model.drift(x)[1])(base)
    assert jax.tree.structure(gradient) == jax.tree.structure(base)
    np.testing.assert_allclose(gradient.params, -2 / np.sqrt(6), rtol=1e-6)


def test_the_gradient_reaches_a_constant_sigma():
    model = jb.Diffusion(lambda x, p: -x, np.diag([2.0, 3.0]))
    gradient = jax.grad(lambda m: jnp.sum(m.diffusion(jnp.ones(2)) ** 2))(model)
    assert [leaf.shape for leaf in jax.tree.leaves(gradient)] == [(2, 2)]
    np.testing.assert_allclose(jax.tree.leaves(gradient)[0], np.diag([4.0, 6.0]))


@pytest.mark.parametrize(
    "factory",
    [
        lambda value: jb.hyperbolic(value, dim=2),
        lambda value: jb.ornstein_uhlenbeck(value * SYMMETRIC_B, sigma=value * np.eye(2)),
        lambda value: jb.langevin(quartic, params=value),
        lambda value: jb.stationary_diffusion(quartic, V=spread, params=value),
    ],
)
def test_models_made_twice_compile_once(factory):
    drift = jax.jit(lambda model: model.drift(jnp.ones(2)))
    first, second = drift(factory(1.0)), drift(factory(2.0))
    assert drift._cache_size() == 1
    assert np.any(first != second)
    assert jax.tree.structure(factory(1.0)) == jax.tree.structure(factory(2.0))


def quartic(x, p):
    return -p * jnp.sum(x**4)


def spread(x, p):
    return p * (1 + x**2)


def test_a_drift_is_traced_once_for_all_parameters():
    traces = []

    def drift(x, p):
        traces.append(x)
        return -p * x

    call = eqx.filter_jit(lambda model, x: model.drift(x))
    for value in [1.0, 2.0, 3.0]:
        call(jb.Diffusion(drift, params=value), value * jnp.ones(2))
    assert len(traces) == 1


def primitives(jaxpr, inside=None, found=False):
    """The names of all primitives, or of those inside the loops named `inside`."""
    names = set()
    for equation in jaxpr.eqns:
        if inside is None or found:
            names.add(equation.primitive.name)
        for inner in jax.extend.core.jaxprs_in_params(equation.params):
            here = found or equation.primitive.name == inside
            names |= primitives(inner, inside, here)
    return names


def test_prepare_runs_outside_every_loop():
    def prepare(rate):
        return jnp.linalg.inv(rate * jnp.eye(2))  # by LAPACK, which must not be in a loop

    model = jb.Diffusion(
        lambda x, p: -p @ x, None, lambda x, p: -x @ p @ x, 1.0, reversible=True, prepare=prepare
    )
    jaxpr = jax.make_jaxpr(
        lambda key: jb.sample_bridges(key, model, [0.0, 0.0], [0.1, 0.0], 1.0).paths
    )(jax.random.key(0))
    assert "lu" in primitives(jaxpr.jaxpr)
    assert "scan" in primitives(jaxpr.jaxpr, inside="while")
    assert "lu" not in primitives(jaxpr.jaxpr, inside="while")


@pytest.mark.parametrize(
    "make",
    [jb.hyperbolic, lambda _, d: jb.ornstein_uhlenbeck(jnp.eye(d, dtype=jnp.float32))],
    ids=["hyperbolic", "Ornstein-Uhlenbeck"],
)
@pytest.mark.parametrize("d", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_single_precision_serves_where_double_is_on(make, d):
    """No constant of a model is a NumPy number, which would not be promoted, or promote."""
    model, point = make(0.8, d), jnp.ones(d, jnp.float32)
    with jax.enable_x64(True):
        law, key = model.log_stationary(point), jax.random.key(0)
        assert law.dtype == model.drift(point).dtype == jnp.float32
        assert model.sample_stationary(key).dtype == jnp.float32
        normal = jb.GaussianLaw(jnp.zeros_like(point), jnp.eye(len(point), dtype=jnp.float32))
        assert normal.log_density(point).dtype == jnp.float32
