"""Maximum likelihood where σ is unknown, against the maximum of closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import count_compilations
from inference_oracles import maximum_of, ou_1d, ou_data, ou_log_likelihood
from scipy import stats

import jaxbridge as jb
from jaxbridge.inference import simulated_likelihood
from jaxbridge.inference.data import as_problem
from jaxbridge.inference.parameters import as_parameters
from jaxbridge.proposals.auto import Budget, guided_candidates

POSITIVE = lambda params: jnp.all(jnp.stack(params) > 0)
BRIDGE = jb.ModifiedDiffusionBridge(jb.ItoTaylorDensity())
SHORT = dict(num_iterations=20, num_bridges=20, num_steps=10, proposal=BRIDGE, constraint=POSITIVE)


def estimate(*arguments, **options):
    with jax.numpy_dtype_promotion("standard"):  # optax raises a float to a whole number
        return jb.maximum_likelihood(*arguments, **options)


@functools.cache
def ou_problem():
    """Observations at irregular times, and what the exact likelihood says."""
    times = np.cumsum(np.r_[0, np.tile([0.3, 0.5, 1.0, 0.4], 25)])
    data = ou_data(1, times, 0.8, 0.7)
    exact = maximum_of(lambda p: ou_log_likelihood(times, data, *p), (0.8, 0.7))
    return times, data, *exact


def check_maximum(made, exact, sd):
    """Estimates and standard errors as they should be, and the Monte Carlo error small."""
    assert made.newton and made.num_missing == 0 and made.score.num_missing == 0
    error = np.stack(made.monte_carlo_errors)
    assert (error > 0).all() and (error < 0.07 * sd).all()
    np.testing.assert_array_less(np.abs(made.theta - exact), 0.2 * sd)
    np.testing.assert_allclose(np.stack(made.standard_errors), sd, rtol=0.08)
    np.testing.assert_allclose(np.stack(made.params), made.theta)
    assert np.abs(made.score.gradient * sd).max() < 0.05


@pytest.mark.slow
def test_steps_of_one_size():
    """Intervals of several numbers of steps, and the best proposal for each."""
    times, data, exact, sd = ou_problem()
    options = dict(SHORT, num_steps=None, step_size=0.1, num_bridges=100, proposal="auto")
    made = estimate(jax.random.key(0), ou_1d(), times, data, **options)
    check_maximum(made, exact, sd)


@pytest.mark.slow
def test_monte_carlo_errors_and_bias():
    """With few paths, over many keys: the errors are as large as is said, and there is less bias
    than without a correction."""
    times, data, exact, sd = ou_problem()
    parameters, blocks, theta = few(times, data, 20, ou_1d())
    made = [
        simulated_likelihood.newton_ascent(key, parameters, blocks, theta[None], 6)
        for key in jax.random.split(jax.random.key(0), 60)
    ]
    assert all(bool(each.found) for each in made)
    errors = (np.stack([each.theta for each in made]) - exact) / sd
    inverses = [np.linalg.inv(each.simulated.information) for each in made]
    covariances = [
        inverse @ each.simulated.covariance @ inverse
        for inverse, each in zip(inverses, made, strict=True)
    ]
    said = np.sqrt(np.diagonal(np.mean(covariances, axis=0))) / sd
    np.testing.assert_allclose(errors.std(axis=0), said, rtol=0.3)
    # Without the correction the rate is a tenth of a standard error too small.
    assert (np.abs(errors.mean(axis=0)) < 2.5 * said / np.sqrt(60) + 0.01).all()


def few(times, data, num_steps, model):
    """The unknown parameters, blocks and θ, as the search has them."""
    key = jax.random.key(0)
    parameters = as_parameters(model, None, POSITIVE)
    problem = as_problem(key, parameters, times, data, num_steps, None)
    blocks = simulated_likelihood.differentiable_blocks(key, model, problem, BRIDGE)
    return parameters, blocks, problem.theta


@pytest.mark.slow
def test_noise_that_varies_with_the_state():
    """Cox, Ingersoll & Ross (1985), all three parameters unknown, in logarithms."""
    duration, truth = 0.25, (1.0, 1.0, 0.5)

    def law(p, x):
        rate, mean, noise = p
        scale = 4 * rate / (noise**2 * (1 - np.exp(-rate * duration)))
        return scale, 4 * rate * mean / noise**2, scale * x * np.exp(-rate * duration)

    rng, x = np.random.default_rng(0), [1.0]
    for _ in range(150):
        scale, *rest = law(truth, x[-1])
        x.append(rng.noncentral_chisquare(*rest) / scale)
    x = np.array(x)

    def log_likelihood(p):
        scale, *rest = law(p, x[:-1])
        return np.sum(stats.ncx2.logpdf(x[1:] * scale, *rest) + np.log(scale))

    exact, sd = maximum_of(log_likelihood, truth)
    cir = jb.Diffusion(
        lambda x, p: p[0] * (p[1] - x), lambda x, p: p[2] * jnp.sqrt(x), params=(0.6, 1.5, 0.8)
    )
    model = jb.transform(cir, jnp.log, jnp.exp).model
    times, data = duration * np.arange(151), np.log(x)[:, None]
    options = dict(SHORT, num_steps=16, num_bridges=50, proposal="auto")
    check_maximum(estimate(jax.random.key(0), model, times, data, **options), exact, sd)


@pytest.mark.slow
def test_derivatives_are_those_of_the_value(x64):
    times, data, *_ = ou_problem()
    parameters, blocks, theta = few(times[:5], data[:5], 5, ou_1d(4.0))

    @jax.jit
    def at(theta):
        return simulated_likelihood.simulated(jax.random.key(1), parameters, blocks, theta, 4)

    h = 1e-5
    beside = [(at(theta + h * axis), at(theta - h * axis)) for axis in jnp.eye(2)]
    gradient = [(up.value - down.value) / 2 / h for up, down in beside]
    information = [(down.gradient - up.gradient) / 2 / h for up, down in beside]
    made = at(theta)
    np.testing.assert_allclose(made.gradient, jnp.stack(gradient), rtol=1e-6)
    np.testing.assert_allclose(made.information, jnp.stack(information), rtol=1e-6)
    assert made.effective_sample_size.min() < 3.95  # so that the correction counts


def test_lost_paths_have_no_weight_and_no_derivative():
    """Not even where the others' weights are so small that a lost one's would overflow."""
    log_weights = jnp.array([[-1000.0, -1001.0, 0.0], [0.0, 0.0, 0.0]])
    found = jnp.array([[True, True, False], [False, False, False]])

    def value(shift):
        return jnp.sum(simulated_likelihood._log_densities(log_weights + shift, found))

    made, slopes = jax.value_and_grad(value)(jnp.zeros_like(log_weights))
    weights = np.exp([0.0, -1.0, -np.inf])
    variance = ((weights**2).sum() / weights.sum() ** 2 - 1 / 3) * 3 / 2
    np.testing.assert_allclose(made, np.log(weights.mean()) - 1000 + variance / 2, rtol=1e-6)
    assert (slopes[0, :2] > 0).all() and (slopes[0, 2] == 0) and (slopes[1] == 0).all()


def test_steps_lead_uphill_whatever_the_curvature():
    gradient = jnp.array([1.0, -2.0])
    definite = jnp.array([[2.0, 0.3], [0.3, 400.0]])
    step = simulated_likelihood.ascent_direction(gradient, definite)
    np.testing.assert_allclose(step, np.linalg.solve(definite, gradient), rtol=1e-4)
    for information in (-definite, jnp.diag(jnp.array([3.0, -1.0])), jnp.zeros((2, 2))):
        assert gradient @ simulated_likelihood.ascent_direction(gradient, information) > 0


@pytest.mark.slow
def test_a_maximum_that_is_not_allowed_is_not_found():
    """Nor is the model simulated there; and numbers that change compile nothing anew."""
    times, data, exact, _ = ou_problem()
    constraint = lambda params: (params[0] > 0) & (params[1] > 1.2)
    options = dict(SHORT, constraint=constraint)
    arguments = (times[:31], data[:31])
    model = ou_1d(0.9, 1.3)
    made = estimate(jax.random.key(0), model, *arguments, **options)
    assert not made.newton and 1.2 < made.theta[1] < 1.3 and exact[1] < 1
    assert np.isfinite(made.theta).all() and (made.iterates[:, 1] > 1.2).all()
    other = model.with_params((1.0, 1.4))
    with count_compilations() as compiled:
        estimate(jax.random.key(1), other, *arguments, **options)
    assert not compiled


@pytest.mark.slow
def test_a_choice_is_made_once_or_kept(unchecked):
    """ "auto" comes to one proposal for all intervals of a number of steps; a choice that the user
    has made is kept."""
    times, data, *_ = ou_problem()
    model, key = ou_1d(), jax.random.key(0)
    problem = as_problem(key, as_parameters(model, None), times[:5], data[:5], 5, None)
    auto = simulated_likelihood.as_differentiable(key, "auto", problem, Budget())
    (block,) = simulated_likelihood.differentiable_blocks(key, model, problem, auto)
    assert isinstance(block.proposal, jb.Guided | jb.ModifiedDiffusionBridge)
    candidates = guided_candidates()
    made = jb.choose_proposal(
        key, model, *problem.intervals, candidates=candidates, num_steps=5, num_pilot=32
    )
    blocks = simulated_likelihood.differentiable_blocks(key, model, problem, made)
    assert len(blocks) == len(made.used)
    for block in blocks:
        for i in block.index.tolist():
            assert block.proposal is made.candidates[int(made.chosen[i])]
    assert sorted(i for block in blocks for i in block.index.tolist()) == [0, 1, 2, 3]
