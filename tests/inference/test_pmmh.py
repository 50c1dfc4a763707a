"""Parameters of σ as well: posteriors by quadrature of exact likelihoods."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_uniform_ranks
from inference_oracles import ou_1d, ou_data, ou_log_likelihood
from studies.rival_posteriors import data_sets, exact_posterior

import jaxbridge as jb
from jaxbridge.inference.parameters import Parameters

TIMES = np.arange(0, 12, 0.5)
DATA = ou_data(7, TIMES, rate=0.8, sigma=0.7)
POSITIVE = lambda unknown: (unknown[0] > 0) & (unknown[1] > 0)
PRIOR = jb.NormalPrior((1.0, 1.0), (0.5, 0.5))
OPTIONS = dict(prior=PRIOR, constraint=POSITIVE, num_steps=8)


def exact_moments():
    rate, sigma = np.meshgrid(np.linspace(0.005, 4, 800), np.linspace(0.3, 2, 600), indexing="ij")
    log_density = ou_log_likelihood(TIMES, DATA, rate, sigma)
    log_density -= (rate - 1) ** 2 + (sigma - 1) ** 2
    weights = np.exp(log_density - log_density.max())
    weights /= weights.sum()
    means = [(weights * each).sum() for each in (rate, sigma)]
    pairs = zip((rate, sigma), means, strict=True)
    return np.array(means), np.sqrt([(weights * (each - m) ** 2).sum() for each, m in pairs])


@pytest.mark.slow
@pytest.mark.optimised
def test_posterior_is_exact():
    made = jb.pmmh(
        jax.random.key(0),
        ou_1d(0.8, 0.7),
        TIMES,
        DATA,
        num_iterations=5_000,
        num_proposals=20,
        num_chains=2,
        proposal=jb.ModifiedDiffusionBridge(jb.ItoTaylorDensity()),
        **OPTIONS,
    )
    draws = np.asarray(made.theta, float).reshape(-1, 2)
    n = np.asarray(made.effective_sample_size)
    mean, sd = exact_moments()
    assert (n > 30).all() and (made.r_hat < 1.1).all()
    assert made.num_without_estimate.sum() == 0
    np.testing.assert_array_less(np.abs(draws.mean(0) - mean) / sd, 5 / np.sqrt(n) + 0.03)
    np.testing.assert_array_less(np.abs(draws.std(0) / sd - 1), 5 / np.sqrt(2 * n) + 0.03)
    assert 0.08 < made.accepted.mean() < 0.5
    assert (made.params[1] > 0).all()


@pytest.mark.slow
def test_goes_on_from_its_state_and_may_start_anywhere():
    options = dict(OPTIONS, num_proposals=5, num_chains=2, proposal=jb.ModifiedDiffusionBridge())
    arguments = (ou_1d(), TIMES, DATA)
    starts = (jnp.array([0.5, 2.0]), jnp.array([0.5, 1.5]))
    made = jb.pmmh(
        jax.random.key(0), *arguments, num_iterations=20, num_warmup=10, init=starts, **options
    )
    assert made.params[0].shape == (2, 20) and made.state.root.shape == (2, 2, 2)
    more = jb.pmmh(
        jax.random.key(1), *arguments, num_iterations=3, num_warmup=0, init=made.state, **options
    )
    np.testing.assert_array_equal(more.state.root, made.state.root)
    assert made.names == ("0", "1") and made.log_likelihood_variance.shape == (2,)


@pytest.mark.slow
def test_going_on_is_one_run():
    """Ten iterations and ten more, by the proposals that "auto" had decided on, are twenty."""
    options = dict(OPTIONS, num_proposals=5, num_chains=2, num_warmup=0)
    arguments = (jax.random.key(3), ou_1d(1.0, 0.8), TIMES[:6], DATA[:6])
    whole = jb.pmmh(*arguments, num_iterations=20, **options)
    first = jb.pmmh(*arguments, num_iterations=10, **options)
    more = jb.pmmh(*arguments, num_iterations=10, init=first.state, **options)
    np.testing.assert_array_equal(
        np.concatenate([first.theta, more.theta], axis=1), np.asarray(whole.theta)
    )
    np.testing.assert_array_equal(more.state.log_likelihood, whole.state.log_likelihood)
    assert more.state.num_done == 20
    (before,), (after,) = first.state.proposals, more.state.proposals
    assert after is before and before.chosen.shape == (5,)
    with pytest.raises(ValueError, match="is for 5 intervals, but the problem has 2"):
        jb.pmmh(
            arguments[0],
            arguments[1],
            np.array([0.0, 0.1, 1.0]),
            DATA[:3],
            num_iterations=1,
            init=first.state,
            **dict(options, num_steps=None, step_size=0.05),
        )


@pytest.mark.slow
def test_the_variance_of_the_estimate_is_that_of_repetitions():
    """By steps so short that θ stays where it is: over a posterior the variance changes by powers
    of ten."""
    bridge = jb.ModifiedDiffusionBridge(jb.ItoTaylorDensity())
    model, options = ou_1d(0.8, 0.7), dict(num_proposals=10, proposal=bridge)
    made = jb.pmmh(
        jax.random.key(0), model, TIMES, DATA, num_iterations=400, num_warmup=0,
        covariance=[1e-10, 1e-10], **options, **OPTIONS,
    )  # fmt: skip
    assert float(jnp.ptp(made.params[0])) < 1e-3 and made.accepted.mean() > 0.8

    def estimate(key):
        return jb.transition_log_density(
            key, model, DATA[:-1], DATA[1:], 0.5, num_steps=8, **options
        ).value.sum()

    repeated = jnp.var(jax.jit(jax.vmap(estimate))(jax.random.split(jax.random.key(1), 2000)))
    # Of 2000 repetitions, and of as many estimates of it as were accepted.
    assert made.log_likelihood_variance.shape == ()
    assert abs(np.log(float(made.log_likelihood_variance / repeated))) < 0.15


def test_unknown_parameters_have_names():
    model = jb.Diffusion(
        lambda x, p: -p["rate"] * x,
        lambda x, p: p["noise"][0],
        params={"rate": 1.0, "noise": jnp.ones(2), "count": jnp.arange(2)},
    )
    assert Parameters(model, None).names == ("noise[0]", "noise[1]", "rate")
    assert Parameters(model, lambda p: p["rate"]).names == ("rate",)
    ou = jb.ornstein_uhlenbeck(jnp.eye(2), sigma=jnp.eye(2))
    names = Parameters(ou, lambda p: (p.sigma, p.B)).names
    assert names == tuple(f"{n}[{i},{j}]" for n in ("sigma", "B") for i in (0, 1) for j in (0, 1))
    assert Parameters(jb.Diffusion(lambda x, p: -p * x, params=1.0), None).names == ("theta",)
    # In the order of the vector.
    parameters = Parameters(model, None)
    picked = parameters.select(jnp.array([1.0, 2.0, 3.0]))
    assert picked["rate"] == 3 and list(picked["noise"]) == [1, 2]


@pytest.mark.slow
def test_what_is_cut_off_is_counted():
    made = jb.pmmh(
        jax.random.key(0),
        ou_1d(),
        TIMES[:5],
        DATA[:5],
        num_iterations=3,
        num_warmup=2,
        num_proposals=4,
        max_trials=1,
        proposal=jb.Coupling(0.0),
        **OPTIONS,
    )
    assert made.num_truncated > 0


@pytest.mark.slow
def test_ranks_of_true_parameters_are_uniform():
    """Simulation-based calibration with an unknown σ."""
    num_sets, num_draws, times = 400, 31, jnp.linspace(0, 4, 9)

    def one_set(key):
        parameter_key, data_key, run_key = jax.random.split(key, 3)

        def again(state):
            key, _ = state
            key, mine = jax.random.split(key)
            return key, 1 + 0.3 * jax.random.normal(mine, (2,))

        start = again((parameter_key, jnp.zeros(2)))
        _, (rate, sigma) = jax.lax.while_loop(lambda s: ~(s[1] > 0.2).all(), again, start)

        def advance(x, key):
            decay = jnp.exp(-rate * 0.5)
            sd = sigma * jnp.sqrt((1 - decay**2) / (2 * rate))
            x = decay * x + sd * jax.random.normal(key, (1,))
            return x, x

        first = jnp.zeros(1)
        _, later = jax.lax.scan(advance, first, jax.random.split(data_key, 8))
        made = jb.pmmh(
            run_key,
            ou_1d(1.0, 1.0),
            times,
            jnp.concatenate([first[None], later]),
            prior=jb.NormalPrior((1.0, 1.0), (0.09, 0.09)),
            constraint=lambda unknown: (unknown[0] > 0.2) & (unknown[1] > 0.2),
            num_iterations=num_draws,
            num_warmup=200,
            thin=25,
            num_proposals=10,
            num_steps=6,
            proposal=jb.ModifiedDiffusionBridge(jb.ItoTaylorDensity()),
        )
        return jnp.array([jnp.sum(made.params[0] < rate), jnp.sum(made.params[1] < sigma)])

    keys = jax.random.split(jax.random.key(0), num_sets)
    ranks = np.asarray(jax.jit(jax.vmap(one_set))(keys))
    assert_uniform_ranks(ranks, num_draws)


@pytest.mark.slow
@pytest.mark.optimised
def test_posterior_where_sigma_varies():
    """σ√x (Cox, Ingersoll & Ross 1985) in raw coordinates, ten steps an interval: the steps are of
    order 2, and what they leave is small and told to be small."""
    data = data_sets(quick=False)[1]
    exact, params = exact_posterior(data), {"rate": 1.0, "sigma": 1.0}
    model = jb.Diffusion(data.drift, data.sigma, params=params, domain=lambda x, p: jnp.all(x > 0))
    made = jb.pmmh(
        jax.random.key(1), model, np.arange(len(data.values)), data.values[:, None],
        prior=jb.NormalPrior(1.0, 1.0), constraint=lambda p: (p["rate"] > 0) & (p["sigma"] > 0),
        num_iterations=700, num_steps=10, num_proposals=30, num_chains=2,
    )  # fmt: skip
    draws = np.asarray(made.theta).reshape(-1, 2)
    off = (draws.mean(axis=0) - exact.mean) / exact.sd
    told, doubt, error = (
        np.asarray(each) / exact.sd
        for each in (made.step_error, made.step_uncertainty, made.standard_error)
    )
    assert made.sigma_varies and np.all(np.abs(told) + doubt < 0.1)
    assert np.all(np.abs(off - told) < 5 * error + doubt + 0.05)
    n = np.asarray(made.effective_sample_size)
    assert np.all(np.abs(np.log(draws.std(axis=0) / exact.sd)) < 5 / np.sqrt(2 * n) + 0.05)
