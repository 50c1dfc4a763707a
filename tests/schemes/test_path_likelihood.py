"""Path likelihoods: the paper's H and B, closed forms of Ornstein–Uhlenbeck processes, batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import jaxbridge as jb
from jaxbridge.schemes.path_likelihood import forms_of

B = np.array([[1.2, 0.7], [-0.4, 0.9]])
SIGMA = np.array([[0.8, 0.2], [0.0, 1.1]])


def rotating():
    return jb.ornstein_uhlenbeck(jnp.asarray(B), sigma=jnp.asarray(SIGMA))


def reversible():
    """The same law of α for both forms of a gradient drift."""
    matrix = jnp.asarray(B + B.T)
    return jb.Diffusion(
        lambda x, p: -p @ x, None, lambda x, p: -x @ (p @ x), params=matrix, reversible=True
    )


def stationary_paths(model, num_paths, num_steps, step):
    """Exact paths of an Ornstein–Uhlenbeck process at times 0, δ, 2δ, ..."""
    keys = jax.random.split(jax.random.key(1), num_paths)
    x = jax.vmap(model.sample_stationary)(keys)

    def advance(x, key):
        law = jb.ou_transition(model, jnp.zeros(2), step)
        decay = jax.jacfwd(lambda y: jb.ou_transition(model, y, step).mean)(jnp.zeros(2))
        noise = jax.vmap(lambda key: jb.GaussianLaw(jnp.zeros(2), law.covariance).sample(key))
        x = law.mean + x @ decay.T + noise(jax.random.split(key, num_paths))
        return x, x

    _, later = jax.lax.scan(advance, x, jax.random.split(jax.random.key(2), num_steps))
    return jnp.concatenate([x[None], later]).swapaxes(0, 1)


def exact_log_likelihood(model, paths, step):
    """Σ log p_δ(x, x') - log N(x'; x, V δ)."""
    covariance = model.diffusion(jnp.zeros(2)) @ model.diffusion(jnp.zeros(2)).T * step

    def of_step(x, x_next):
        free = jb.GaussianLaw(x, covariance).log_density(x_next)
        return jb.ou_transition(model, x, step).log_density(x_next) - free

    return jnp.sum(jax.vmap(jax.vmap(of_step))(paths[:, :-1], paths[:, 1:]), axis=1)


@pytest.mark.slow
def test_derivatives_are_the_papers_H_and_B(precision):
    """Equation (likelihood): log L = α H_T - ½ α² B_T, for any d."""
    for d in (1, 2):
        times = np.sort(np.random.default_rng(d).uniform(0, 2, 40))
        path = np.cumsum(np.random.default_rng(0).normal(size=(40, d)) * 0.3, axis=0)
        F = np.sqrt(1 + (path**2).sum(1))
        square = F**2 - 1
        rate = (d + (d - 1) * square) / 2 / F**3  # for d = 2 this is (1 + ½|x|²)/(1 + |x|²)^{3/2}
        H = F[0] - F[-1] + np.trapezoid(rate, times)
        integral_B = np.trapezoid(square / F**2, times)

        def log_likelihood(alpha, times=times, path=path, d=d):
            return jb.path_log_likelihood(jb.hyperbolic(alpha, d), times, path)

        value = log_likelihood(1.3)
        tolerance = 1e-5 if precision == "float32" else 1e-12
        np.testing.assert_allclose(value, 1.3 * H - 1.3**2 / 2 * integral_B, rtol=tolerance * 10)
        slope = jax.grad(log_likelihood)(0.5)
        np.testing.assert_allclose(slope, H - 0.5 * integral_B, rtol=tolerance * 10)
        np.testing.assert_allclose(jax.hessian(log_likelihood)(0.7), -integral_B, rtol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize(
    "form, curl, order",
    [
        ("girsanov", True, 0.5),
        ("ito_taylor", True, 0.5),
        ("ito_taylor", False, 1.0),
        ("ito", False, 1.5),
    ],
)
def test_forms_converge_to_the_density_of_the_points(x64, form, curl, order):
    """Root mean square errors: √δ where Lévy's area or the points between are called for, δ and
    δ^{3/2} otherwise. Densities that integrate to one have a mean of one, relative to the exact
    density of the points, whose mean log is minus half the variance."""
    exact = rotating() if curl else jb.ornstein_uhlenbeck(reversible().params)
    model = rotating() if curl else reversible()
    errors = []
    for num_steps in (8, 32):
        step = 1 / num_steps
        paths = stationary_paths(exact, 4_000, num_steps, step)
        times = jnp.linspace(0, 1, num_steps + 1)
        error = jb.path_log_likelihood(model, times, paths, form=form)
        errors.append(error - exact_log_likelihood(exact, paths, step))
    rms = [float(jnp.sqrt(jnp.mean(error**2))) for error in errors]
    assert np.log(rms[0] / rms[1]) / np.log(4) > order - 0.15
    if form != "ito":
        for error in errors:
            ratio = jnp.exp(error)
            assert abs(ratio.mean() - 1) < 5 * ratio.std() / np.sqrt(4_000)
    if form == "ito":
        assert abs(errors[1].mean()) < 5 * errors[1].std() / np.sqrt(4_000) + 0.01
    if form != "girsanov":
        assert rms[1] < (0.4 if curl else 0.1)


def test_euler_density_is_a_product_of_normal_densities(x64):
    sigma = lambda x, p: jnp.array([[p[1], 0.1 * x[0]], [0.0, 1.0 + x[1] ** 2]])
    model = jb.Diffusion(lambda x, p: -p[0] * x, sigma, params=jnp.array([0.7, 1.3]))
    times = np.array([0.0, 0.1, 0.15, 0.4])
    path = np.random.default_rng(0).normal(size=(4, 2))
    expected = 0.0
    for x, x_next, dt in zip(path, path[1:], np.diff(times), strict=False):
        root = np.asarray(model.diffusion(x))
        mean = x + np.asarray(model.drift(x)) * dt
        expected += multivariate_normal(mean, root @ root.T * dt).logpdf(x_next)
    value = jb.path_log_likelihood(model, times, path, form="euler")
    np.testing.assert_allclose(value, expected, rtol=1e-10)

    def without_drift(theta):
        free = jb.Diffusion(lambda x, p: 0 * x, sigma, params=model.params)
        return jb.path_log_likelihood(free, times, path, form="euler") + jb.path_log_likelihood(
            model.with_params(theta), times, path
        )

    np.testing.assert_allclose(without_drift(model.params), value, rtol=1e-10)


@pytest.mark.slow
def test_batches_are_single_paths():
    model = rotating()
    paths = jax.random.normal(jax.random.key(0), (3, 4, 6, 2))
    times = jnp.cumsum(jax.random.uniform(jax.random.key(1), (3, 6)) + 0.1, axis=1)
    together = jb.path_log_likelihood(model, times, paths)
    assert together.shape == (3, 4)
    one = jb.path_log_likelihood(model, times[1], paths[1, 2])
    np.testing.assert_allclose(together[1, 2], one, rtol=1e-4)
    np.testing.assert_allclose(
        jb.path_log_likelihood(model, times[1], paths[1]), together[1], rtol=1e-4
    )

    def of_drift(B, form=None):
        moved = model.with_params(model.params._replace(B=B))
        return jb.path_log_likelihood(moved, times, paths, form=form)

    scores = jax.jacfwd(of_drift)(model.params.B)
    assert scores.shape == (3, 4, 2, 2) and jnp.isfinite(scores).all()


def test_sigma_has_a_derivative_in_the_euler_form_only():
    """Given a path σ is known; relative to the law of σW the likelihood says nothing of it."""
    times, path = jnp.linspace(0, 1, 11), jax.random.normal(jax.random.key(0), (11, 1))

    def of_sigma(sigma, form):
        model = jb.Diffusion(lambda x, p: -x, lambda x, p: p * jnp.ones(1), params=sigma)
        return jb.path_log_likelihood(model, times, path, form=form)

    assert jnp.isfinite(jax.grad(of_sigma)(1.0, "euler"))
    for form in (None, "girsanov", "ito_taylor"):
        with pytest.raises(TypeError, match="σ depends on parameters"):
            jax.grad(of_sigma)(1.0, form)


def test_long_ago_is_no_zero_of_time(unchecked):
    """Days since 1970: steps of 0.01 are lost in float32, not in NumPy's float64."""
    days = 20_000 + 0.01 * np.arange(6)
    path = np.random.default_rng(0).normal(size=(6, 2))
    expected = jb.path_log_likelihood(rotating(), days - 20_000, path)
    np.testing.assert_allclose(jb.path_log_likelihood(rotating(), days, path), expected, rtol=1e-3)


def test_most_accurate_form_is_the_default():
    x = jnp.zeros(2)
    assert forms_of(jb.hyperbolic(1.0, 2), x)[0] == "ito"
    assert forms_of(rotating(), x)[0] == "ito_taylor"
    varying = jb.Diffusion(lambda x, p: -x, lambda x, p: 1 + x**2)
    assert forms_of(varying, x) == ("girsanov",)
