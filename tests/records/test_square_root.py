"""Noisy records of a square-root process, whose exact laws are integrals over known transitions:
steps of weak order 2 where σ varies, for likelihoods, smoothed paths and posteriors."""

import cir
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import jaxbridge as jb
from jaxbridge.records import (
    as_record_problems,
    guided,
    knots_and_log_weight,
    noise_and_log_weight,
    path_and_log_weight,
)
from jaxbridge.records.guided_record import path_of_knots

PARAMS, START = np.array([1.2, 0.5, 0.6]), 0.5


def record(gap, sd, num=12, seed=3):
    """Times, observations, and the exact log likelihood given X_0 = `START`."""
    rng, x, states = np.random.default_rng(seed), START, []
    for _ in range(num):
        scale, freedom, noncentrality = cir.transition(PARAMS, x, gap)
        x = scale * rng.noncentral_chisquare(freedom, noncentrality)
        states.append(x)
    values = np.array(states) + sd * rng.normal(size=num)
    if sd == 0:
        before = np.array([START, *states[:-1]])
        return values, float(np.sum(cir.log_density(PARAMS, before, np.array(states), gap)))
    return values, likelihood_by_quadrature(PARAMS, values, gap, sd)


def filtered_by_quadrature(params, values, gap, sd, num):
    """The grid, its widths, the transition densities, and the laws of states times likelihoods."""
    grid = np.linspace(0, 1, num + 1)[1:] ** 2 * 4.0
    width = np.gradient(grid)
    kernel = np.exp(cir.log_density(params, grid[:, None], grid, gap))
    laws = [np.exp(cir.log_density(params, START, grid, gap)) * norm.pdf(values[0], grid, sd)]
    for value in values[1:]:
        laws.append((laws[-1] * width) @ kernel * norm.pdf(value, grid, sd))
    return grid, width, kernel, laws


def likelihood_by_quadrature(params, values, gap, sd, num=1000):
    _, width, _, laws = filtered_by_quadrature(params, values, gap, sd, num)
    return float(np.log(laws[-1] @ width))


def arguments(values, gap, sd, num_steps):
    times = gap * np.arange(1, len(values) + 1)
    options = {
        "observation": jb.LinearGaussian(covariance=sd**2),
        "initial": [START],
        "initial_time": 0.0,
        "num_steps": num_steps,
    }
    return (cir.model(PARAMS), times, values[:, None]), options


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gap", "sd", "num_steps"),
    [(2.0, 0.3, 10), (0.5, 0.0, 10)],
)
def test_likelihood_is_of_second_order(gap, sd, num_steps):
    """Within errors of the exact value, and nearer than by the Euler scheme."""
    values, exact = record(gap, sd)
    positional, options = arguments(values, gap, sd, num_steps)
    size = {"num_particles": 1000, "num_filters": 8}
    made, euler = (
        jb.log_likelihood(jax.random.key(1), *positional, **options, **size, density=density)
        for density in (None, jb.EulerDensity())
    )
    error = float(made.value) - exact
    noise = 5 * np.hypot(made.standard_error, made.step_uncertainty)
    assert abs(error - float(made.step_error)) < noise + abs(error) / 3
    noise = 5 * float(np.hypot(made.standard_error, euler.standard_error))
    assert abs(error) < abs(float(euler.value) - exact) / 3 + noise
    assert int(made.num_nonfinite) <= int(euler.num_nonfinite)


@pytest.mark.slow
def test_weights_of_innovations_have_the_likelihood_as_mean():
    """The path as a function of noise has the weight that the filter's particles have."""
    gap, sd = 1.0, 0.1
    values, exact = record(gap, sd, num=3)
    positional, options = arguments(values, gap, sd, 10)
    paths = jb.innovations(*positional, **options)
    xi = jax.random.normal(jax.random.key(0), (20_000, paths.size))
    weight = lambda noise: paths.log_weight(positional[0].params, noise)
    log_weights = np.asarray(jax.jit(jax.vmap(weight))(xi), float)
    assert np.isfinite(log_weights).mean() > 0.999
    weights = np.exp(np.where(np.isfinite(log_weights), log_weights, -np.inf) - exact)
    error = weights.std() / np.sqrt(len(weights))
    assert error < 0.02 and abs(weights.mean() - 1) < 5 * error + 0.01


def noise_by_hand(x, x_next, dt, is_last):
    """Both n of x' = μ + √δ b n + ½ δ b b' (n² - S), or the one of x' = μ + √δ b n, in units of √S,
    with S = 1 + ½ δM + δ²M²/12 in closed form."""
    rate, level, sigma = PARAMS
    drift, b, slope = rate * (level - x), sigma * np.sqrt(x), sigma / (2 * np.sqrt(x))
    mean = x + drift * dt - rate * drift * dt**2 / 2
    M = sigma**2 * drift / b**2 - 2 * rate - slope**2
    S = 1 + dt / 2 * M + dt**2 * M**2 / 12
    if is_last:
        return [(x_next - mean) / (b * np.sqrt(dt * S))]
    bent = dt * b * slope / 2
    return np.sort(np.roots([bent, np.sqrt(dt) * b, mean - x_next - bent * S])) / np.sqrt(S)


@pytest.mark.slow
def test_weight_is_the_density_of_a_path_by_hand(x64):
    """N(z; 0, I) / N(ζ; 0, I) / det ℛ times g(y| x'): of one step, which is split three times, so
    that three are quadratic in their noise z and the last one is not."""
    gap, sd, eps = 0.3, 0.2, 1e-5
    positional, options = arguments(np.array([0.7]), gap, sd, 1)
    paths = jb.innovations(*positional, **options)
    zeta = np.array([0.4, -0.8, 0.5, 0.3, -0.2])  # of the fixed start, and of the steps
    run = lambda zeta: paths._run(positional[0].params, jnp.array(zeta))[0][0]
    path_of = lambda zeta: np.asarray(run(zeta))[:, 0]  # with the points of the splits
    assert len(paths.times) == len(paths.path(positional[0].params, jnp.array(zeta))) == 2
    path, lengths = path_of(zeta), gap * np.array([0.5, 0.25, 0.125, 0.125])
    log_weight = norm.logpdf(0.7, path[-1], sd)
    for i, dt in enumerate(lengths):
        nudged = path_of(zeta + eps * np.eye(5)[i + 1])
        ends = path[i + 1], nudged[i + 1]
        here, there = (noise_by_hand(path[i], end, dt, i == 3) for end in ends)
        z, slope = min(
            ((z, (w - z) / eps) for z, w in zip(here, there, strict=True)),
            key=lambda pair: abs(pair[0]),
        )  # the other root is far out
        log_weight += norm.logpdf(z) + np.log(abs(slope)) - norm.logpdf(zeta[i + 1])
    made = float(paths.log_weight(positional[0].params, jnp.array(zeta)))
    np.testing.assert_allclose(made, log_weight, atol=1e-4)


def turning(x, p):
    return jnp.array([[1 + 0.3 * jnp.sin(x[1]), 0.2 * x[0]], [0.1 * x[1], jnp.exp(0.2 * x[0])]])


@pytest.mark.slow
def test_knots_determine_the_noise_and_the_path(x64):
    """A path alone does not: two values of the noise of a step may lead to one point."""
    plane = jb.Diffusion(lambda x, p: -x + 0.1 * jnp.roll(x, 1) ** 2, turning)
    options = {"initial": jb.GaussianLaw([0.0, 0.2], 0.1 * np.eye(2)), "num_steps": 3}
    seen = np.array([[0.1, 0.3], [0.4, np.nan], [-0.2, 0.1]])
    gaussian = jb.LinearGaussian(covariance=0.04 * np.eye(2))
    problem = as_record_problems(plane, [0.0, 0.4, 1.0], seen, gaussian, **options).problem(0)
    points = jnp.full((problem.num_segments * problem.num_steps + 1, 2), 0.1)
    xi = jax.random.normal(jax.random.key(2), points.shape)

    @jax.jit
    def there_and_back(xi):
        guide = guided(problem, plane, points)
        path, log_weight = path_and_log_weight(problem, plane, guide, xi)
        knots, _ = knots_and_log_weight(problem, plane, guide, xi)
        again = noise_and_log_weight(jax.random.key(3), problem, plane, guide, knots)
        return path, log_weight, knots, path_of_knots(problem, plane, knots), *again

    path, log_weight, knots, same_path, same_xi, same_log_weight = there_and_back(xi)
    assert np.max(np.abs(knots - path)) > 0.01
    same_ends = np.arange(len(path)) % problem.num_steps == 0
    np.testing.assert_allclose(knots[same_ends], path[same_ends], rtol=1e-12)
    np.testing.assert_allclose(same_path, path, atol=1e-12)
    np.testing.assert_allclose(same_xi, xi, atol=1e-9)
    np.testing.assert_allclose(same_log_weight, log_weight, atol=1e-9)


@pytest.mark.slow
@pytest.mark.optimised
def test_smoothed_states_are_of_second_order():
    """Means in exact standard deviations; with normal steps they are off by .05 to .15."""
    gap, sd, num_steps = 1.0, 0.3, 5
    values, _ = record(gap, sd)
    mean, deviation = smoothed_by_quadrature(values, gap, sd)
    positional, options = arguments(values, gap, sd, num_steps)
    at = lambda value: np.asarray(value, float)[num_steps::num_steps, 0]  # without points of splits

    def error_and_noise(density):
        size = {"num_draws": 1000, "num_chains": 4}
        made = jb.smooth(jax.random.key(0), *positional, **options, **size, density=density)
        off = (at(made.mean()) - mean) / deviation
        return made, off, at(made.standard_error()) / deviation

    made, off, noise = error_and_noise(None)
    told, doubt = (at(value) / deviation for value in (made.step_error(), made.step_uncertainty()))
    assert made.trustworthy
    assert np.all(np.abs(off) < 5 * noise + 2 * np.abs(told) + 0.01)
    assert np.all(np.abs(told) < 0.1) and np.all(doubt < 0.1)
    rms = lambda value: np.sqrt(np.mean(value**2))
    assert rms(off) < 0.02 + 1.5 * rms(noise)
    # Euler steps are not good enough.
    assert rms(error_and_noise(jb.EulerDensity())[1]) > 0.05


def smoothed_by_quadrature(values, gap, sd):
    """Means and standard deviations of the states given all observations."""
    grid, width, kernel, laws = filtered_by_quadrature(PARAMS, values, gap, sd, 800)
    after, moments = np.ones_like(grid), []
    for law, value in zip(laws[::-1], values[::-1], strict=True):
        weights = law * after * width
        mean = weights @ grid / weights.sum()
        moments.append((mean, np.sqrt(weights @ (grid - mean) ** 2 / weights.sum())))
        after = kernel @ (norm.pdf(value, grid, sd) * after * width)
        after /= after.max()
    return np.array(moments[::-1]).T


@pytest.mark.slow
def test_posterior_of_gibbs_is_of_second_order():
    """Of the rate, at five steps a gap: beside the exact posterior on a grid."""
    gap, sd = 0.5, 0.1
    values, _ = record(gap, sd, num=40, seed=7)
    rates = np.exp(np.linspace(-2.2, 1.8, 81))
    params = [(rate, *PARAMS[1:]) for rate in rates]
    likelihood = [likelihood_by_quadrature(one, values, gap, sd, 400) for one in params]
    log_posterior = np.array(likelihood) - np.log(rates) ** 2 / 2 / 0.8**2
    weights = np.exp(log_posterior - log_posterior.max())
    mean = weights @ np.log(rates) / weights.sum()
    deviation = np.sqrt(weights @ (np.log(rates) - mean) ** 2 / weights.sum())
    (_, times, observed), options = arguments(values, gap, sd, 5)
    _, level, sigma = PARAMS
    model = jb.Diffusion(
        lambda x, p: jnp.exp(p) * (level - x),
        lambda x, p: sigma * jnp.sqrt(x),
        params=0.0,
        domain=lambda x, p: jnp.all(x > 0),
    )
    made = jb.gibbs(
        jax.random.key(0), model, times, observed, prior=jb.NormalPrior(0.0, 0.8), **options,
        num_iterations=400, num_chains=2,
    )  # fmt: skip
    theta = np.asarray(made.theta, float).reshape(-1)
    error = float(made.standard_error[0]) / deviation
    assert made.trustworthy and error < 0.1
    assert abs(theta.mean() - mean) / deviation < 5 * error + 0.05
    assert abs(theta.std() / deviation - 1) < 0.14
    assert abs(float(made.step_error[0])) < 0.1 * deviation


@pytest.mark.slow
def test_a_relaxation_time_of_half_a_step():
    """κδ = 2 in a coordinate of constant noise, beside a geometric Brownian motion."""
    rate, sigma = 16.0, 0.3
    model = jb.Diffusion(
        lambda x, p: jnp.stack([-rate * x[0], 0.1 * x[1]]),
        lambda x, p: jnp.stack([jnp.ones_like(x[0]), sigma * x[1]]),
    )
    exact = norm.logpdf(0.1, 0.05 * np.exp(-rate), np.sqrt(-np.expm1(-2 * rate) / (2 * rate)))
    exact += norm.logpdf(np.log(1.2), 0.1 - sigma**2 / 2, sigma) - np.log(1.2)
    made = jb.transition_log_density(
        jax.random.key(0), model, [0.05, 1.0], [0.1, 1.2], 1.0,
        num_proposals=4000, num_steps=8, proposal=jb.Guided(),
    )  # fmt: skip
    assert int(made.num_nonfinite) == 0 and abs(float(made.value) - exact) < 0.3
