"""Gibbs sampling against posteriors that are known: quadrature of exact likelihoods."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inference_oracles import grid_moments, multivariate_ou, ou_1d, ou_data, ou_log_likelihood

import jaxbridge as jb
from jaxbridge.inference.parameters import as_parameters, theta_of_model
from jaxbridge.inference.priors import as_normal

TIMES = np.concatenate([np.arange(0, 10, 0.5), np.arange(10, 20, 1.0)])
DATA = ou_data(3, TIMES)
RATE = lambda params: params[0]
POSITIVE = lambda rate: rate > 0
PRIOR = jb.NormalPrior(1.0, 1.0)
OPTIONS = dict(prior=PRIOR, where=RATE, constraint=POSITIVE)
TRAPEZOID = jb.ItoTaylorDensity()


def exact_moments(log_prior=lambda rate: -((rate - 1) ** 2) / 2):
    grid = np.linspace(0.001, 4, 4_000)
    return grid_moments(grid, ou_log_likelihood(TIMES, DATA, grid, 1.0) + log_prior(grid))


def assert_posterior(draws, mean, sd, allowance=0.02):
    """Mean and standard deviation within five Monte Carlo errors, and the step error."""
    draws = np.asarray(draws, float)
    n = float(jnp.sum(jnp.atleast_1d(jb.effective_sample_size(jnp.asarray(draws, jnp.float32)))))
    assert n > 200
    assert abs(draws.mean() - mean) < (5 / np.sqrt(n) + allowance) * sd
    assert abs(draws.std() / sd - 1) < 5 / np.sqrt(2 * n) + allowance


SLOW = pytest.mark.slow
PROPOSALS = {
    "bridge": (jb.ModifiedDiffusionBridge(TRAPEZOID), None),
    "renewal": (jb.Coupling(0.5), None),
    "auto": ("auto", None),
}


@pytest.mark.parametrize(
    "name", ["bridge", *(pytest.param(n, marks=SLOW) for n in ("renewal", "auto"))]
)
def test_posterior_is_exact(name):
    proposal, method = PROPOSALS[name]
    made = jb.gibbs(
        jax.random.key(0),
        ou_1d(),
        TIMES,
        DATA,
        num_iterations=4_000,
        num_steps=15,
        proposal=proposal,
        method=method,
        **OPTIONS,
    )
    assert made.exact_parameters and made.num_missing.sum() == 0
    assert made.params[0].shape == (4_000,) and (made.params[1] == 1).all()
    assert_posterior(made.params[0][100:], *exact_moments())


@SLOW
def test_approximate_bridges_shift_the_posterior():
    """The very gates of the exact sampler, which must fail here."""
    times = np.arange(0, 60, 1.0)
    data = ou_data(5, times)
    grid = np.linspace(0.001, 4, 4_000)
    mean, sd = grid_moments(grid, ou_log_likelihood(times, data, grid, 1.0) - (grid - 1) ** 2 / 2)
    made = jb.gibbs(
        jax.random.key(0),
        ou_1d(),
        times,
        data,
        num_iterations=2_000,
        num_steps=15,
        proposal=jb.Coupling(-1.0),
        bridges="approximate",
        **OPTIONS,
    )
    shift = (made.params[0][100:].mean() - mean) / sd
    assert shift > 0.2


@SLOW
def test_other_priors_and_kernels_have_their_posteriors():
    """A prior that is not normal calls for Metropolis–Hastings; so does a kernel of the user's."""
    import blackjax

    log_prior = lambda rate: jnp.where(rate > 0, 2 * jnp.log(jnp.abs(rate)) - 3 * rate, -jnp.inf)
    moments = exact_moments(lambda rate: 2 * np.log(rate) - 3 * rate)
    options = dict(OPTIONS, prior=log_prior, num_iterations=4_000, num_steps=15)
    options["proposal"] = jb.ModifiedDiffusionBridge(TRAPEZOID)
    kernels = [None, lambda f: blackjax.mala(f, 0.05)]
    for kernel, key in zip(kernels, jax.random.split(jax.random.key(1), 2), strict=True):
        made = jb.gibbs(key, ou_1d(), TIMES, DATA, parameter_kernel=kernel, **options)
        assert not made.exact_parameters
        assert 0.3 < made.parameters_moved.mean() < 1
        assert_posterior(made.params[0][100:], *moments)


@pytest.mark.slow
def test_newton_steps_are_exact_draws_where_these_exist():
    """A normal prior, given as a function, for a quadratic log likelihood."""
    log_prior = lambda rate: -((rate - 1) ** 2) / 2
    made = jb.gibbs(
        jax.random.key(0),
        ou_1d(),
        TIMES,
        DATA,
        num_iterations=4_000,
        num_steps=15,
        proposal=jb.ModifiedDiffusionBridge(TRAPEZOID),
        **dict(OPTIONS, prior=log_prior),
    )
    assert not made.exact_parameters
    assert_posterior(made.params[0][100:], *exact_moments())


@pytest.mark.slow
def test_chains_start_where_they_are_told_and_go_on():
    options = dict(OPTIONS, num_steps=10, proposal=jb.ModifiedDiffusionBridge(), num_chains=3)
    starts = jnp.array([0.3, 1.0, 3.0])
    arguments = (ou_1d(), TIMES, DATA)
    made = jb.gibbs(
        jax.random.key(0), *arguments, num_iterations=300, init=starts, thin=2, **options
    )
    assert made.params[0].shape == (3, 300) and made.theta.shape == (3, 300, 1)
    assert made.num_simulated.shape == (3, 300)
    assert made.r_hat.shape == (1,) and made.r_hat[0] < 1.05
    assert 100 < made.effective_sample_size[0] <= 900 * 2.5
    more = jb.gibbs(jax.random.key(1), *arguments, num_iterations=5, init=made.state, **options)
    assert more.state.theta.shape == (3, 1)
    # The first θ depends on the paths it starts from, not on where chains began.
    again = jb.gibbs(jax.random.key(1), *arguments, num_iterations=5, init=made.state, **options)
    np.testing.assert_array_equal(more.theta, again.theta)


@pytest.mark.slow
def test_two_halves_with_one_key_are_the_whole():
    run = functools.partial(
        jb.gibbs, jax.random.key(0), ou_1d(), TIMES, DATA, num_steps=5, num_chains=2, thin=2,
        proposal=jb.ModifiedDiffusionBridge(), **OPTIONS,
    )  # fmt: skip
    whole, first = run(num_iterations=8), run(num_iterations=4)
    rest = run(num_iterations=4, init=first.state)
    both = np.concatenate([first.theta, rest.theta], axis=1)
    np.testing.assert_allclose(both, whole.theta, rtol=1e-6)
    assert (rest.state.num_done == 8).all()


@pytest.mark.slow
def test_intervals_of_many_lengths():
    """No step is longer than asked, in however few programs (`tests/inference/test_data.py`)."""
    times = np.array([0.0, 0.1, 0.2, 1.2, 5.2, 5.3, 6.3, 7.3])
    made = jb.gibbs(
        jax.random.key(0),
        ou_1d(),
        times,
        ou_data(0, times),
        num_iterations=5,
        step_size=0.1,
        **OPTIONS,
    )
    assert max(block.num_steps for block in made.completion.blocks) == 40
    durations = np.diff(times)
    for block in made.completion.blocks:
        assert (durations[np.asarray(block.index)] / block.num_steps < 0.1001).all()


@pytest.mark.slow
def test_four_unknown_drifts_of_a_rotating_process():
    """Given the paths B is normal with the moments of least squares, where steps are Euler's; B may
    be any stable matrix."""
    model, times, data = multivariate_ou()
    stable = lambda B: (jnp.trace(B) > 0) & (B[0, 0] * B[1, 1] > B[0, 1] * B[1, 0])
    made = jb.gibbs(
        jax.random.key(0),
        model,
        times,
        data,
        prior=jb.NormalPrior(jnp.zeros(4), jnp.eye(4)),
        num_iterations=200,
        num_steps=10,
        where=lambda params: params.B,
        constraint=stable,
        proposal=jb.ModifiedDiffusionBridge(jb.EulerDensity()),
    )
    assert made.exact_parameters and made.params.B.shape == (200, 2, 2)
    assert bool(jax.vmap(stable)(made.params.B).all())
    assert (made.params.sigma == model.params.sigma).all()


@pytest.mark.slow
def test_arviz_takes_the_draws():
    arviz = pytest.importorskip("arviz")
    made = jb.gibbs(
        jax.random.key(0),
        ou_1d(),
        TIMES,
        DATA,
        num_iterations=10,
        num_steps=5,
        proposal=jb.ModifiedDiffusionBridge(),
        **OPTIONS,
    )
    data = made.to_arviz()
    assert set(data.posterior.data_vars) == {"0", "1"}
    assert arviz.summary(data, var_names=["0"]).shape[0] == 1
    moved = np.asarray(data.sample_stats["parameters_moved"])
    np.testing.assert_array_equal(moved, np.asarray(made.parameters_moved)[None])
    assert "bridges_moved" in data.sample_stats and "names" not in data.sample_stats


@pytest.mark.slow
def test_parameters_in_which_the_drift_is_not_linear():
    """Rate e^θ: the information at θ is not that at θ', and Metropolis–Hastings must know."""
    model = jb.Diffusion(
        lambda x, p: -jnp.exp(p) * x,
        None,
        lambda x, p: -jnp.exp(p) * jnp.sum(x * x),
        0.0,
        reversible=True,
    )
    made = jb.gibbs(
        jax.random.key(0),
        model,
        TIMES[:9],
        DATA[:9],
        prior=jb.NormalPrior(0.0, 1.0),
        num_iterations=6_000,
        num_steps=15,
        proposal=jb.ModifiedDiffusionBridge(TRAPEZOID),
    )
    grid = np.linspace(-5, 4, 4_000)
    log_density = ou_log_likelihood(TIMES[:9], DATA[:9], np.exp(grid), 1.0) - grid**2 / 2
    assert not made.exact_parameters and 0.3 < made.parameters_moved.mean() < 1
    assert_posterior(made.params[100:], *grid_moments(grid, log_density))


@pytest.mark.slow
def test_the_likelihood_is_that_of_the_target_of_the_bridges():
    """With weights that are exact for the Euler scheme on a coarse grid, the posterior is that of
    the Euler scheme, not a mixture of two."""
    times = np.arange(0.0, 40.0)
    data, steps = ou_data(2, times), 3
    made = jb.gibbs(
        jax.random.key(0),
        ou_1d(),
        times,
        data,
        num_iterations=12_000,
        num_steps=steps,
        proposal=jb.ModifiedDiffusionBridge(jb.EulerDensity()),
        **OPTIONS,
    )
    grid = np.linspace(0.01, 2.9, 3_000)
    decay = 1 - grid[:, None] / steps  # of one Euler step
    variance = sum(decay ** (2 * i) for i in range(steps)) / steps
    residual = data[1:, 0] - decay**steps * data[:-1, 0]
    log_density = -(residual**2 / variance + np.log(variance)).sum(1) / 2 - (grid - 1) ** 2 / 2
    assert_posterior(made.params[0][100:], *grid_moments(grid, log_density), allowance=0)


@pytest.mark.slow
def test_the_step_error_of_a_posterior_is_told():
    """By what half as many steps change, which has a closed form. The mean
    of D alone would tell the wrong sign."""
    density = jb.EulerDensity()
    times, num_steps = np.arange(200.0), 10
    data, grid = ou_data(2, times), np.linspace(0.3, 1.8, 4_000)

    def mean_of_posterior(num_steps):
        dt, second = 1 / num_steps, density.order == 2
        decay = 1 - grid[:, None] * dt + (grid[:, None] * dt) ** 2 / 2 * second
        spread = dt * (1 + second * (-grid[:, None] * dt + (grid[:, None] * dt) ** 2 / 3))
        variance = spread * sum(decay ** (2 * i) for i in range(num_steps))
        residual = data[1:, 0] - decay**num_steps * data[:-1, 0]
        log_density = -(residual**2 / variance + np.log(variance)).sum(1) / 2 - (grid - 1) ** 2 / 2
        return grid_moments(grid, log_density)[0]

    change = mean_of_posterior(num_steps // 2) - mean_of_posterior(num_steps)
    made = jb.gibbs(
        jax.random.key(0),
        ou_1d(),
        times,
        data,
        num_iterations=1_500,
        num_steps=num_steps,
        num_chains=16,
        proposal=jb.ModifiedDiffusionBridge(density),
        **OPTIONS,
    )
    wanted, noise = change / (2**density.order - 1), float(made.step_uncertainty[0])
    assert noise < 0.3 * abs(wanted)
    assert abs(float(made.step_error[0]) - wanted) < 5 * noise


@pytest.mark.slow
def test_what_is_cut_off_is_counted():
    made = jb.gibbs(
        jax.random.key(0),
        ou_1d(),
        TIMES,
        DATA,
        num_iterations=5,
        num_steps=5,
        proposal=jb.Coupling(0.0),
        method="pseudo_marginal",
        max_trials=1,
        **OPTIONS,
    )
    assert made.num_truncated.shape == (5,) and made.num_truncated.sum() > 0


@pytest.mark.slow
def test_a_state_must_fit_the_observations(unchecked):
    options = dict(OPTIONS, num_iterations=2, proposal=jb.ModifiedDiffusionBridge())
    key = jax.random.key(0)
    state = jb.gibbs(key, ou_1d(), TIMES[:5], DATA[:5], num_steps=4, **options).state
    for times, data, num_steps, message in [
        (TIMES[:5], DATA[:5], 5, "paths of shapes"),
        (TIMES[:6], DATA[:6], 4, "paths of shapes"),
        (TIMES[:5], DATA[1:6], 4, "is a state of other data"),
    ]:
        with pytest.raises(ValueError, match=message):
            jb.gibbs(key, ou_1d(), times, data, num_steps=num_steps, init=state, **options)


def test_a_prior_may_have_the_shape_of_the_parameters():
    model = multivariate_ou()[0]
    parameters = as_parameters(model, lambda p: p.B)
    theta = theta_of_model(parameters, jnp.dtype("float32"))
    variance = jnp.array([[1.0, 2.0], [3.0, 4.0]])
    prior = as_normal(jb.NormalPrior(jnp.eye(2), variance), parameters, theta)
    np.testing.assert_allclose(prior.mean, [1, 0, 0, 1])
    np.testing.assert_allclose(prior.precision @ np.diag([1.0, 2.0, 3.0, 4.0]), np.eye(4))


@pytest.mark.slow
def test_a_choice_made_before_serves_for_intervals_of_other_lengths():
    intervals = (DATA[:-1], DATA[1:], np.diff(TIMES))
    choice = jb.choose_proposal(jax.random.key(0), ou_1d(), *intervals, num_steps=8)
    made = jb.gibbs(
        jax.random.key(1),
        ou_1d(),
        TIMES,
        DATA,
        proposal=choice,
        step_size=0.1,
        num_iterations=2,
        **OPTIONS,
    )
    assert np.isfinite(made.theta).all() and made.num_missing.sum() == 0
