"""Parameters of σ as well: posteriors by quadrature of exact likelihoods."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inference_oracles import ou_1d, ou_data, ou_log_likelihood

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
