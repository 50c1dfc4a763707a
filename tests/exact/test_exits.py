"""Probabilities of exits, frequent and rare, against closed forms and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.linalg import solve_banded

import jaxbridge as jb

BROWNIAN = jb.Diffusion(lambda x, p: p * jnp.ones(1), jnp.ones(1), params=0.0)


@jax.jit
def passages(key, drift, level):
    """Exits of a Brownian motion below a level, within one unit of time."""
    return jb.sample_exits(
        key, BROWNIAN.with_params(drift), [0.0], 1.0, lambda x: level - x[0], num_steps=40
    )


def survival(drift, variance, low, high, start, duration):
    """Probability to stay between two levels, by Crank–Nicolson with absorbing ends."""
    n, num = 4001, 2000
    x = np.linspace(low, high, n)
    h, dt = x[1] - x[0], duration / num
    D, a = variance(x) / 2 / h**2, drift(x) / 2 / h
    lower, upper, f = (D - a)[1:-1], (D + a)[1:-1], np.ones(n - 2)
    matrix = np.zeros((3, n - 2))
    matrix[0, 1:], matrix[1], matrix[2, :-1] = (
        -dt / 2 * upper[:-1],
        1 + dt * D[1:-1],
        -dt / 2 * lower[1:],
    )
    for _ in range(num):
        padded = np.concatenate([[0], f, [0]])
        right = f + dt / 2 * (lower * padded[:-2] - 2 * D[1:-1] * f + upper * padded[2:])
        f = solve_banded((1, 1), matrix, right)
    return np.interp(start, x[1:-1], f)


def assert_agrees(exits, probability, allowance=0.0):
    error = float(exits.standard_error)
    assert exits.trustworthy, exits.why()
    assert abs(exits.log_probability - np.log(probability)) < 4.5 * error + allowance
    assert error < 0.4


@pytest.mark.slow
@pytest.mark.parametrize(("drift", "level"), [(0.0, 1.0), (0.0, 5.0), (-1.0, 4.0), (0.5, 2.0)])
def test_first_passage_of_a_brownian_motion(drift, level):
    """With any number of steps; 6e-7 for the second. Given the passage X_1 has a known mean."""
    exits = passages(jax.random.key(0), drift, level)
    beyond = stats.norm.sf(level - drift)
    returned = np.exp(2 * drift * level) * stats.norm.sf(level + drift)
    assert_agrees(exits, beyond + returned)
    # X_1 of those that end beyond the level, and by reflection of those that do not.
    ends = lambda path: path[-1, 0]
    density = stats.norm.pdf(level - drift)
    mean = beyond * drift + density + returned * (2 * level + drift)
    mean -= np.exp(2 * drift * level) * stats.norm.pdf(level + drift)
    mean /= beyond + returned
    assert abs(exits.mean(ends) - mean) < 5 * exits.standard_error_of(ends) < 0.5
    # All paths that count have a point after their exit, and half of all count.
    index = np.asarray(exits.exit_index)
    np.testing.assert_array_equal(index <= 40, exits.exited)
    assert np.all(exits.exited.mean(axis=1) > 0.5) and index.min() >= 1


@pytest.mark.slow
@pytest.mark.parametrize("width", [1.5, 3.0])
def test_exits_of_an_ornstein_uhlenbeck_process(width):
    """From an interval around its mean, by either end; 2e-7 for the wider one."""
    model = jb.ornstein_uhlenbeck([[1.0]], sigma=[[0.8]])
    inside = lambda x: jnp.stack([width - x[0], width + 0.3 + x[0]])
    exits = jb.sample_exits(jax.random.key(1), model, [0.2], 2.0, inside, num_steps=80)
    stays = survival(lambda x: -x, lambda x: 0.64 + 0 * x, -width - 0.3, width, 0.2, 2.0)
    assert_agrees(exits, 1 - stays, 0.03)


def growing(rate, sigma, num_steps, num_runs=16):
    """Exits of a geometric Brownian motion beyond 9, and their exact probability."""
    model = jb.Diffusion(lambda x, p: rate * x, lambda x, p: sigma * x)
    exits = jb.sample_exits(
        jax.random.key(2), model, [1.0], 1.0, lambda x: 9 - x[0],
        num_steps=num_steps, num_runs=num_runs,
    )  # fmt: skip
    mu, distance = rate - sigma**2 / 2, np.log(9)
    z = np.array([distance - mu, distance + mu]) / sigma
    probability = stats.norm.sf(z[0]) + np.exp(2 * mu * distance / sigma**2) * stats.norm.sf(z[1])
    return exits, probability


@pytest.mark.slow
def test_noise_that_grows_with_the_state():
    """σ is nine times as large at the boundary as at the start; 1e-5 for the second."""
    exits, probability = growing(0.5, 0.8, 16, 32)
    error = float(exits.standard_error)
    assert abs(exits.log_probability - np.log(probability)) < 4.5 * error + 0.02 < 0.16
    exits, probability = growing(0.0, 0.5, 100)
    assert_agrees(exits, probability, 0.05)


@pytest.mark.slow
def test_the_error_of_long_steps_is_told():
    """In an Ornstein-Uhlenbeck process, whose steps are exact, but not its exits between them."""
    model = jb.ornstein_uhlenbeck([[1.0]], sigma=[[0.8]])
    stays = survival(lambda x: -x, lambda x: 0.64 + 0 * x, -8.0, 1.5, 0.2, 2.0)

    def exits(num_steps):
        return jb.sample_exits(
            jax.random.key(1), model, [0.2], 2.0, lambda x: 1.5 - x[0],
            num_steps=num_steps, num_runs=64,
        )  # fmt: skip

    long, short = exits(4), exits(16)
    error = long.log_probability - np.log(1 - stays)
    assert error > 4.5 * long.standard_error and not long.trustworthy
    assert "discretisation error (`step_error`) exceeds" in long.why()
    assert abs(long.step_error - error) < 4.5 * long.step_uncertainty + 0.5 * error
    assert_agrees(short, 1 - stays, 0.02)
    unknown = jb.sample_exits(
        jax.random.key(1), model, [0.2], 2.0, lambda x: 1.5 - x[0], num_steps=1, num_paths=50
    )
    assert jnp.isnan(unknown.step_error) and "is unknown" in unknown.why()


@pytest.mark.slow
def test_a_region_that_is_no_distance():
    """1.5² - x² in few steps, in all units; the centre of the strip is a critical point."""
    n = np.arange(1, 400, 2)
    terms = 4 / (n * np.pi) * np.sin(n * np.pi / 2) * np.exp(-((n * np.pi / 3) ** 2) / 2)
    free = jb.Diffusion(lambda x, p: 0 * x, lambda x, p: p * jnp.ones(1), params=1.0)

    @jax.jit
    def exits(unit):
        inside = lambda x: 2.25 * unit**2 - x @ x
        model = free.with_params(unit)
        return jb.sample_exits(jax.random.key(0), model, [0.0], 1.0, inside, num_steps=4)

    for unit in (1.0, 1e-6, 1e6):
        assert_agrees(exits(unit), 1 - np.sum(terms), 0.02)


@pytest.mark.slow
def test_noise_that_turns_within_a_step():
    """With σ = 1 + .9 sin 25x, 20 steps and ten give the same wrong log p, -.2 for -18."""
    model = jb.Diffusion(lambda x, p: 0 * x, lambda x, p: 1 + 0.9 * jnp.sin(25 * x))
    exits = jb.sample_exits(
        jax.random.key(0), model, [0.0], 1.0, lambda x: 2 - x[0], num_steps=20, num_paths=100
    )
    assert jnp.isnan(exits.step_error) and "σ" in exits.why()


@pytest.mark.slow
def test_a_rate_is_one_over_the_mean_passage_time():
    """Over a barrier of six times the temperature, against quadrature."""
    heat, start, end = 0.25, -1.0, 0.6
    potential = lambda x: 1.5 * (x * x - 1) ** 2
    model = jb.Diffusion(
        lambda x, p: -jax.vmap(jax.grad(potential))(x), jnp.full(1, np.sqrt(2 * heat))
    )
    exits = jb.sample_exits(
        jax.random.key(3), model, [start], 3.0, lambda x: end - x[0], num_steps=150
    )
    y = np.linspace(-3, end, 20_001)
    inner = np.cumsum(np.exp(-potential(y) / heat)) * (y[1] - y[0])
    passage = np.sum((np.exp(potential(y) / heat) * inner)[y >= start]) * (y[1] - y[0]) / heat
    rate, error = exits.rate(after=1.0)
    assert exits.trustworthy and error < 0.1 * rate
    assert abs(rate - 1 / passage) < 4.5 * error + 0.02 / passage
    with pytest.raises(ValueError, match="`after` must be in"):
        exits.rate(after=3.0)


@pytest.mark.slow
def test_what_never_leaves_and_what_is_outside():
    """Without noise and without drift nothing leaves; who starts outside has left."""
    small = {"num_paths": 8, "num_runs": 2, "num_steps": 3, "density": jb.EulerDensity()}
    still = jb.Diffusion(lambda x, p: 0 * x, lambda x, p: 0 * x)

    @jax.jit
    def exits(level):
        return jb.sample_exits(
            jax.random.key(0), still, [0.0], 1.0, lambda x: level - x[0], **small
        )

    never, before = exits(1.0), exits(-1.0)
    assert never.log_probability == -np.inf and not never.trustworthy
    assert "Some run ended" in never.why() and not never.exited.any()
    assert before.log_probability == 0 and before.exited.all() and before.trustworthy
    assert before.paths.shape == (2, 8, 4, 1) and before.mean().shape == (4, 1)
    single = jb.sample_exits(
        jax.random.key(0), still, [0.0], 1.0, lambda x: -1 - x[0], **small | {"num_runs": 1}
    )
    assert single.standard_error == np.inf and not single.trustworthy


def test_paths_that_were_lost_and_replaced_are_told():
    """Those that explode come no nearer to the exit, so that hardly one of them is left at last."""
    model = jb.Diffusion(lambda x, p: 50 * jnp.maximum(x, 0) ** 3, jnp.ones(1))
    exits = jb.sample_exits(
        jax.random.key(0), model, [0.0], 1.0, lambda x: x[0] + 1.5,
        num_paths=40, num_runs=2, num_steps=20,
    )  # fmt: skip
    left = jnp.sum(~jnp.all(jnp.isfinite(exits.paths), axis=(2, 3)))
    assert exits.num_nonfinite > left and "not finite" in exits.why()


def test_refusals():
    with pytest.raises(ValueError, match="`start` must have shape"):
        jb.sample_exits(jax.random.key(0), BROWNIAN, [[0.0]], 1.0, lambda x: x[0])
    with pytest.raises(TypeError, match="`inside` must be a function"):
        jb.sample_exits(jax.random.key(0), BROWNIAN, [0.0], 1.0, 2.0)
    with pytest.raises(ValueError, match="`num_paths`"):
        jb.sample_exits(jax.random.key(0), BROWNIAN, [0.0], 1.0, lambda x: x[0], num_paths=1)
    seasonal = jb.Diffusion(lambda x, p, t: t - x, jnp.ones(1))
    with pytest.raises(ValueError, match="depend on time"):
        jb.sample_exits(jax.random.key(0), seasonal, [0.0], 1.0, lambda x: x[0])
