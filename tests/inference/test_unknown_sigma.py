"""`gibbs` from exact observations with unknown parameters of σ: a record whose noise is zero."""

import cir
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb
import jaxbridge.inference.gibbs as of_gibbs

LEVEL = 0.5


def square_root():
    """Cox–Ingersoll–Ross, with the logarithms of its rate and of the factor of its σ unknown."""
    return jb.Diffusion(
        lambda x, p: jnp.exp(p["rate"]) * (LEVEL - x),
        lambda x, p: jnp.exp(p["sigma"]) * jnp.sqrt(x),
        params={"rate": 0.0, "sigma": -0.5},
        domain=lambda x, p: jnp.all(x > 0),
    )


def exact_posterior(records):
    """Means and standard deviations, with normal priors N(0, 1) and N(-½, 1), on a grid."""
    rate, sigma = np.linspace(-1.6, 1.6, 121), np.linspace(-1.1, 0.0, 111)
    log_posterior = -(rate[:, None] ** 2) / 2 - (sigma + 0.5) ** 2 / 2
    for x in records:
        log_posterior += np.array(
            [
                [
                    np.sum(cir.log_density((np.exp(r), LEVEL, np.exp(s)), x[:-1], x[1:], 1.0))
                    for s in sigma
                ]
                for r in rate
            ]
        )
    weights = np.exp(log_posterior - log_posterior.max())
    weights /= weights.sum()
    laws = (weights.sum(1), rate), (weights.sum(0), sigma)
    means = np.array([law @ values for law, values in laws])
    return means, np.sqrt([law @ values**2 for law, values in laws] - means**2)


@pytest.mark.slow
def test_posterior_of_two_records_is_exact_and_of_second_order():
    """At five steps of σ(x) over an interval; each record has its own first state."""
    rng = np.random.default_rng(5)
    records = [cir.simulate((1.0, LEVEL, 0.6), np.arange(n), rng)[:, 0] for n in (40.0, 25.0)]
    mean, sd = exact_posterior(records)
    made = jb.gibbs(
        jax.random.key(0), square_root(), [np.arange(len(x)) for x in records],
        [x[:, None] for x in records],
        prior=jb.NormalPrior({"rate": 0.0, "sigma": -0.5}, {"rate": 1.0, "sigma": 1.0}),
        num_steps=5, num_iterations=500, num_chains=2,
    )  # fmt: skip
    theta = np.asarray(made.theta, float).reshape(-1, 2)
    error = np.asarray(made.standard_error) / sd
    assert made.trustworthy and np.all(error < 0.14)
    assert np.all(np.abs(theta.mean(0) - mean) / sd < 4 * error + 0.05)
    assert np.all(np.abs(theta.std(0) / sd - 1) < 0.2)
    assert np.all(np.abs(made.step_error) + 2 * made.step_uncertainty < 0.3 * sd)


@pytest.mark.parametrize("how", [{}, {"proposal": "auto"}, {"init": jnp.float32(1.5)}])
def test_a_known_sigma_that_varies_is_treated_as_an_unknown_one(how, monkeypatch):
    """For its steps are of second order, those of complete paths of first."""
    monkeypatch.setattr(of_gibbs, "sample_records", lambda *arguments: "noise")
    monkeypatch.setattr(of_gibbs, "_run", lambda *arguments: "paths")
    drift = lambda x, p: p * (1 - x)
    varying = jb.Diffusion(drift, lambda x, p: 0.3 * jnp.sqrt(1 + x**2), params=1.0)
    run = lambda model, **how: jb.gibbs(
        jax.random.key(0), model, [0.0, 1.0, 2.0], [1.0, 1.2, 0.9], num_steps=2,
        prior=jb.NormalPrior(1.0, 1.0), **how,
    )  # fmt: skip
    assert run(varying, **how) == "noise"
    assert run(jb.Diffusion(drift, [0.3], params=1.0), **how) == "paths"
    assert run(varying, **how | {"proposal": jb.ModifiedDiffusionBridge()}) == "paths"
