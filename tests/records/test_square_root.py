"""Noisy records of a square-root process, whose exact likelihood is a product of integrals over its
known transitions: steps of weak order 2 where σ varies."""

import cir
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow_beyond
from scipy.stats import norm

import jaxbridge as jb

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
    grid = np.linspace(0, 1, 1001)[1:] ** 2 * 4.0
    width = np.gradient(grid)
    kernel = np.exp(cir.log_density(PARAMS, grid[:, None], grid, gap))
    law = np.exp(cir.log_density(PARAMS, START, grid, gap)) * norm.pdf(values[0], grid, sd)
    for value in values[1:]:
        law = (law * width) @ kernel * norm.pdf(value, grid, sd)
    return values, float(np.log(law @ width))


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
    slow_beyond(1, [(2.0, 0.3, 10), (0.5, 0.02, 10), (1.0, 0.1, 20), (0.5, 0.0, 10)]),
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


def test_weight_is_the_density_of_a_path_by_hand():
    """One step: N(z; 0, I) / N(ζ; 0, I) / det ℛ times g(y| x'), and Euler's x' beside."""
    positional, options = arguments(np.array([0.7]), 0.3, 0.2, 1)
    paths = jb.innovations(*positional, **options)
    rate, level, sigma = PARAMS
    dt, zeta = 0.3, jnp.array([0.4, -0.8])  # of the fixed start, and of the step
    path = np.asarray(paths.path(positional[0].params, zeta), float)[:, 0]
    # n of x' = μ + √δ b n + ½ δ b b' (n² - S), with S = 1 + ½ δM + δ²M²/12 in closed form
    drift, b, slope = rate * (level - START), sigma * np.sqrt(START), sigma / (2 * np.sqrt(START))
    mean = START + drift * dt - rate * drift * dt**2 / 2
    M = sigma**2 * drift / b**2 - 2 * rate - slope**2
    S = 1 + dt / 2 * M + dt**2 * M**2 / 12
    roots = np.roots([dt * b * slope / 2, np.sqrt(dt) * b, mean - path[1] - dt * b * slope * S / 2])
    log_weight = float(paths.log_weight(positional[0].params, zeta))
    seen = norm.logpdf(0.7, path[1], 0.2)
    # The law of n that the step has is normal, and ζ is affine in n: N(n; 0, S) |dn / dζ|.
    eps = 1e-3
    there = float(np.asarray(paths.path(positional[0].params, zeta.at[1].add(eps)))[1, 0])
    near = np.roots([dt * b * slope / 2, np.sqrt(dt) * b, mean - there - dt * b * slope * S / 2])
    candidates = [
        norm.logpdf(n, 0, np.sqrt(S)) + np.log(abs(m - n) / eps) - norm.logpdf(-0.8) + seen
        for n, m in zip(np.sort(roots), np.sort(near), strict=True)
    ]
    assert min(abs(log_weight - c) for c in candidates) < 5e-3


@pytest.mark.slow
def test_records_of_unequal_length_have_the_sum_of_their_likelihoods():
    """The shorter one is filled with steps of no length, which move nothing."""
    model = jb.Diffusion(lambda x, p: -p * x, lambda x, p: 0.3 * jnp.sqrt(1 + x**2), params=0.8)
    observed = [np.array([0.1, 0.3, 0.2, -0.1, 0.2]), np.array([0.2, 0.4, 0.1])]
    times = [np.arange(1.0, 1 + len(values)) for values in observed]
    options = dict(
        observation=jb.LinearGaussian(covariance=0.04), initial=[0.2], initial_time=0.0,
        num_steps=4, num_particles=200,
    )  # fmt: skip
    key = jax.random.key(0)
    alone = [
        jb.log_likelihood(key, model, t, values[:, None], **options)
        for t, values in zip(times, observed, strict=True)
    ]
    both = jb.log_likelihood(key, model, times, [v[:, None] for v in observed], **options)
    error = np.sqrt(sum(float(one.standard_error) ** 2 for one in (*alone, both)))
    assert int(both.num_nonfinite) == 0
    assert abs(float(both.value) - sum(float(one.value) for one in alone)) < 5 * error + 1e-3


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
