"""The Ornstein–Uhlenbeck process and its bridges against dense Gaussian conditioning.

The oracles are NumPy and SciPy in double precision: Γ_t by the eigenvectors of B (itself checked
by quadrature), the bridge by conditioning the joint normal law of all times on the last.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.stats
from helpers import assert_moments

import jaxbridge as jb


def rotation(d):
    return np.linalg.qr(np.random.default_rng(d).standard_normal((d, d)))[0]


def five_dimensional():
    rng = np.random.default_rng(5)
    B = rng.standard_normal((5, 5)) + 3 * np.eye(5)
    return B, rng.standard_normal(5), np.tril(rng.standard_normal((5, 5)), -1) / 2 + np.eye(5)


PROCESSES = {  # B, mean, σ
    "scalar": (np.array([[0.7]]), np.array([0.3]), np.array([[1.4]])),
    "reversible": (np.array([[1.5, 1.0], [1.0, 1.5]]), np.zeros(2), np.eye(2)),
    "swirling": (
        np.array([[1.0, 2.0], [-0.5, 1.5]]),
        np.array([0.5, -1.0]),
        np.array([[1.0, 0.0], [0.4, 0.8]]),
    ),
    "stiff": (rotation(2) @ np.diag([0.5, 500.0]) @ rotation(2).T, np.ones(2), np.eye(2)),
    "five-dimensional": five_dimensional(),
}
process = pytest.mark.parametrize("name", PROCESSES)
TOLERANCE = {"float32": 2e-4, "float64": 1e-9}
LONG = 1e3  # for the stationary law


def make(name, precision="float64"):
    return jb.ornstein_uhlenbeck(*(jnp.asarray(a, precision) for a in PROCESSES[name]))


def covariance_after(name, t):
    """Γ_t, from B = U Λ U⁻¹: (U⁻¹ V U⁻*)_ij (1 - e^{-(λ_i + λ̄_j) t}) / (λ_i + λ̄_j)."""
    B, _, sigma = PROCESSES[name]
    values, vectors = np.linalg.eig(B)
    inverse = np.linalg.inv(vectors)
    rates = values[:, None] + values.conj()
    middle = inverse @ (sigma @ sigma.T) @ inverse.conj().T * -np.expm1(-rates * t) / rates
    return (vectors @ middle @ vectors.conj().T).real


def assert_same_normal_law(covariance, exact, tolerance):
    """Equal in units of the standard deviations of the exact law, in every direction."""
    whiten = np.linalg.inv(np.linalg.cholesky(exact))
    deviation = whiten @ (np.asarray(covariance, float) - exact) @ whiten.T
    np.testing.assert_allclose(deviation, 0, atol=tolerance)


exact_bridge = eqx.filter_jit(jb.gaussian_bridge)
many_transitions = eqx.filter_jit(jax.vmap(jb.ou_transition, (None, None, 0)))


@process
@pytest.mark.parametrize("t", [1e-2, 1.0])
def test_the_oracle_agrees_with_quadrature(name, t):
    B, _, sigma = PROCESSES[name]

    def integrand(s):
        root = scipy.linalg.expm(-s * B) @ sigma
        return root @ root.T

    exact, _ = scipy.integrate.quad_vec(integrand, 0, t, epsrel=1e-11, epsabs=1e-14)
    assert_same_normal_law(covariance_after(name, t), exact, 1e-8)


@process
def test_the_stationary_covariance_solves_the_lyapunov_equation(name, precision):
    B, mean, sigma = PROCESSES[name]
    law = jb.ou_stationary(make(name, precision))
    covariance = np.asarray(law.covariance, float)
    assert law.covariance.dtype == precision
    np.testing.assert_allclose(law.mean, mean, rtol=1e-6)
    np.testing.assert_allclose(
        B @ covariance + covariance @ B.T,
        sigma @ sigma.T,
        atol=TOLERANCE[precision] * np.abs(B).max(),
    )
    exact = scipy.linalg.solve_continuous_lyapunov(B, sigma @ sigma.T)
    assert_same_normal_law(covariance, exact, TOLERANCE[precision])


@process
def test_transition_laws_of_short_and_long_durations(name, precision):
    B, mean, _ = PROCESSES[name]
    durations, start = [1e-4, 3e-3, 0.1, 0.5, 1.0, 100.0], mean + np.arange(1.0, len(B) + 1)
    model = make(name, precision)
    laws = many_transitions(model, jnp.asarray(start, precision), jnp.asarray(durations, precision))
    assert laws.covariance.dtype == precision
    for t, law_mean, law_covariance in zip(durations, *laws, strict=True):
        exact = mean + scipy.linalg.expm(-t * B) @ (start - mean)
        np.testing.assert_allclose(law_mean, exact, atol=TOLERANCE[precision])
        assert_same_normal_law(law_covariance, covariance_after(name, t), TOLERANCE[precision])


def test_a_very_long_duration_gives_the_stationary_law():
    # ‖tB‖ is far beyond what the exponential of a matrix can scale and square.
    model = make("stiff", "float32")
    law, stationary = jb.ou_transition(model, jnp.zeros(2), 1e4), jb.ou_stationary(model)
    # Each doubling doubles the rounding error of e^{-tB}, until its slowest rate has decayed:
    # the ratio of the two rates, 1000, times the unit roundoff.
    rounding = 2 * 1000 * np.finfo(np.float32).eps
    np.testing.assert_allclose(law.mean, stationary.mean, rtol=rounding)
    np.testing.assert_allclose(law.covariance, stationary.covariance, rtol=rounding)


@process
def test_transitions_satisfy_chapman_and_kolmogorov(name, x64):
    B, mean, _ = PROCESSES[name]
    model, start = make(name), jnp.asarray(mean + 1)
    means, covariances = many_transitions(model, start, jnp.array([0.3, 0.5, 0.8]))
    decay = scipy.linalg.expm(-0.5 * B)
    np.testing.assert_allclose(means[2], mean + decay @ (means[0] - mean), atol=1e-12)
    np.testing.assert_allclose(
        covariances[2], decay @ covariances[0] @ decay.T + covariances[1], atol=1e-12
    )


def test_the_log_density_is_normalised(x64):
    law = jb.ou_transition(make("swirling"), jnp.array([1.0, 2.0]), 0.5)
    x = jnp.array([0.3, 0.1])
    exact = scipy.stats.multivariate_normal(law.mean, law.covariance).logpdf(x)
    np.testing.assert_allclose(law.log_density(x), exact, rtol=1e-12)


@process
def test_the_log_stationary_density_is_normalised(name, x64):
    _, mean, _ = PROCESSES[name]
    model, x = make(name), jnp.asarray(mean + 0.5)
    stationary = scipy.stats.multivariate_normal(mean, covariance_after(name, LONG))
    np.testing.assert_allclose(model.log_stationary(x), stationary.logpdf(x), rtol=1e-9)


@pytest.mark.slow
def test_the_transition_density_is_differentiable_in_the_parameters(x64):
    step, x = 1e-5, jnp.array([0.3, 0.1])

    @jax.jit
    def log_density(scale, t):
        B, mean, sigma = PROCESSES["swirling"]
        model = jb.ornstein_uhlenbeck(scale * B, scale * mean, scale * sigma)
        return jb.ou_transition(model, jnp.zeros(2), t).log_density(x)

    gradient = jax.jit(jax.grad(log_density, argnums=(0, 1)))
    for t in [0.01, 5.0]:
        in_scale = log_density(1 + step, t) - log_density(1 - step, t)
        in_time = log_density(1.0, t * (1 + step)) - log_density(1.0, t * (1 - step))
        exact = in_scale / (2 * step), in_time / (2 * step * t)
        np.testing.assert_allclose(gradient(1.0, t), exact, rtol=1e-6, atol=1e-8)


def test_stationary_samples_have_the_stationary_law():
    model = make("swirling", "float32")
    keys = jax.random.split(jax.random.key(0), 20_000)
    samples = jax.jit(jax.vmap(model.sample_stationary))(keys)
    _, mean, _ = PROCESSES["swirling"]
    exact = covariance_after("swirling", LONG)
    assert_moments(samples, mean, exact)
    with pytest.raises(AssertionError):
        assert_moments(samples, mean, covariance_after("swirling", 1.0))


def dense_bridge(name, start, end, duration, times):
    """Mean (K·d,) and covariance (K·d, K·d) of the bridge at all times together."""
    B, mean, _ = PROCESSES[name]
    grid, d = [*times, duration], len(B)
    centre = np.concatenate([mean + scipy.linalg.expm(-t * B) @ (start - mean) for t in grid])
    joint = np.zeros((len(grid) * d, len(grid) * d))
    for i, s in enumerate(grid):
        for j, t in enumerate(grid):
            lagged = covariance_after(name, min(s, t))  # Cov(X_s, X_t) = Γ_s e^{-(t-s)Bᵀ}, s ≤ t
            if s <= t:
                lagged = lagged @ scipy.linalg.expm(-(t - s) * B).T
            else:
                lagged = scipy.linalg.expm(-(s - t) * B) @ lagged
            joint[i * d : (i + 1) * d, j * d : (j + 1) * d] = lagged
    inner, cross, last = joint[:-d, :-d], joint[:-d, -d:], joint[-d:, -d:]
    gain = np.linalg.solve(last, cross.T).T
    return centre[:-d] + gain @ (end - centre[-d:]), inner - gain @ cross.T


def end_points(name):
    _, mean, _ = PROCESSES[name]
    steps = np.arange(len(mean))
    return mean + 1 - 0.5 * steps, mean + 0.3 * steps


TIMES, DURATION = [0.02, 0.4, 0.9], 1.2


@process
def test_bridge_moments_are_those_of_dense_conditioning(name, precision):
    start, end = end_points(name)
    mean, covariance = dense_bridge(name, start, end, DURATION, TIMES)
    bridge = exact_bridge(
        make(name, precision), *(jnp.asarray(a, precision) for a in (start, end, DURATION, TIMES))
    )
    assert bridge.mean.dtype == bridge.covariance.dtype == precision
    d = len(start)
    np.testing.assert_allclose(bridge.times, TIMES, rtol=1e-6)
    np.testing.assert_allclose(bridge.mean, mean.reshape(3, d), atol=TOLERANCE[precision])
    for k in range(3):
        block = slice(k * d, (k + 1) * d)
        assert_same_normal_law(
            bridge.covariance[k], covariance[block, block], 5 * TOLERANCE[precision]
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["swirling", "five-dimensional"])
def test_bridge_samples_have_the_joint_law_of_all_times(name):
    start, end = end_points(name)
    samples = eqx.filter_jit(
        lambda model: jb.gaussian_bridge(model, start, end, DURATION, TIMES).sample(
            jax.random.key(0), 20_000
        )
    )(make(name, "float32"))
    assert samples.shape == (20_000, 3, len(start))
    mean, covariance = dense_bridge(name, start, end, DURATION, TIMES)
    flat = samples.reshape(20_000, -1)
    assert_moments(flat, mean, covariance)
    # The bridge of another mean-reversion fails.
    other = dense_bridge(name, start, end, 1.5 * DURATION, TIMES)
    with pytest.raises(AssertionError):
        assert_moments(flat, *other)


def test_bridge_samples_are_tied_at_both_ends():
    start, end = end_points("swirling")
    times = [0.0, 0.5, 0.5, DURATION]
    bridge = jb.gaussian_bridge(make("swirling", "float32"), start, end, DURATION, times)
    samples = bridge.sample(jax.random.key(0), 100)
    np.testing.assert_allclose(bridge.mean[jnp.array([0, 3])], [start, end], atol=1e-5)
    np.testing.assert_allclose(bridge.covariance[jnp.array([0, 3])], 0, atol=1e-5)
    np.testing.assert_allclose(samples[:, 0], np.broadcast_to(start, (100, 2)), atol=1e-5)
    np.testing.assert_allclose(samples[:, 3], np.broadcast_to(end, (100, 2)), atol=1e-5)
    np.testing.assert_array_equal(samples[:, 1], samples[:, 2])


def test_the_bridge_passes_through_vmap_and_jit():
    model, (start, end) = make("swirling", "float32"), end_points("swirling")

    @jax.jit
    @jax.vmap
    def middles(duration):
        bridge = jb.gaussian_bridge(model, start, end, duration, jnp.array([0.5]) * duration)
        return bridge.mean[0], bridge.sample(jax.random.key(0), 3)[:, 0]

    means, samples = middles(jnp.array([0.5, 1.0]))
    assert samples.shape == (2, 3, 2)
    for duration, mean in zip([0.5, 1.0], means, strict=True):
        exact, _ = dense_bridge("swirling", start, end, duration, [duration / 2])
        np.testing.assert_allclose(mean, exact, atol=1e-5)


def test_a_changed_sigma_changes_the_process_and_its_law_together():
    # Noise is the identity by default; `with_params` may give another one.
    B, mean, sigma = (jnp.asarray(a, jnp.float32) for a in PROCESSES["swirling"])
    params = jb.OrnsteinUhlenbeckParams(B, mean, sigma)
    changed = jb.ornstein_uhlenbeck(B).with_params(params)
    np.testing.assert_allclose(changed.diffusion(mean), sigma)
    back = changed.with_params(params._replace(sigma=None))
    np.testing.assert_allclose(back.diffusion(mean), np.eye(2))


def test_a_diagonal_sigma_is_the_dense_one(x64):
    B, mean, _ = PROCESSES["swirling"]
    diagonal = jb.ornstein_uhlenbeck(B, mean, [0.5, 2.0])
    dense = jb.ornstein_uhlenbeck(B, mean, np.diag([0.5, 2.0]))
    for ours, exact in zip(jb.ou_stationary(diagonal), jb.ou_stationary(dense), strict=True):
        np.testing.assert_allclose(ours, exact, rtol=1e-12)


@pytest.mark.parametrize("simple_in", ["noise", "space"])
def test_nearly_singular_noise_leaves_a_stationary_law(simple_in):
    """In single precision, where V = σσᵀ is barely regular: B is simple in σ⁻¹x, with huge entries
    in x, or simple in x, with huge entries in σ⁻¹x."""
    sigma, simple = np.array([[1.0, 0.0], [0.9999, 0.0014]]), np.array([[1.0, 2.0], [-0.5, 1.5]])
    B = sigma @ simple @ np.linalg.inv(sigma) if simple_in == "noise" else simple
    model = jb.ornstein_uhlenbeck(jnp.asarray(B, jnp.float32), sigma=sigma)
    covariance = (
        sigma @ scipy.linalg.solve_continuous_lyapunov(simple, np.eye(2)) @ sigma.T
        if simple_in == "noise"
        else scipy.linalg.solve_continuous_lyapunov(B, sigma @ sigma.T)
    )
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    keys = jax.random.split(jax.random.key(0), 5_000)
    samples = np.asarray(jax.jit(jax.vmap(model.sample_stationary))(keys), float) @ whiten.T
    # σ has condition number 1,400, by which the rounding of B counts.
    assert_moments(samples, np.zeros(2), np.eye(2))
    x = np.linalg.inv(whiten) @ [0.6, -0.5]
    exact = scipy.stats.multivariate_normal(np.zeros(2), covariance).logpdf(x)
    assert abs(float(model.log_stationary(jnp.asarray(x, jnp.float32))) - exact) < 0.05
