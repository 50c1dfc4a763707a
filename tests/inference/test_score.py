"""Fisher's identity and Louis's formula against derivatives of the closed form."""

import cir
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inference_oracles import multivariate_ou, ou_transitions_log_density

import jaxbridge as jb

DRIFT = lambda params: params.B


def exact_derivatives():
    model, times, observations = multivariate_ou()

    def log_likelihood(b):
        params = model.params._replace(B=b.reshape(2, 2))
        return ou_transitions_log_density(model.with_params(params), times, observations)

    b = model.params.B.reshape(-1)
    return jax.jit(jax.grad(log_likelihood))(b), -jax.jit(jax.hessian(log_likelihood))(b)


@pytest.mark.slow
def test_score_and_information_are_derivatives_of_the_closed_form():
    gradient, information = exact_derivatives()
    made = jb.score(
        jax.random.key(0),
        *multivariate_ou(),
        num_bridges=4_000,
        num_steps=20,
        proposal=jb.Coupling(0.0),
        where=DRIFT,
    )
    error = np.sqrt(np.diagonal(made.covariance))
    # The step error is of second order: about 0.002 of the drift's scale, in 30 intervals.
    np.testing.assert_array_less(np.abs(made.gradient - gradient), 5 * error + 0.02)
    np.testing.assert_allclose(made.value, made.gradient.reshape(2, 2))
    np.testing.assert_allclose(made.information, information, atol=0.04 * information.max())
    assert made.num_missing == 0 and (made.effective_sample_size > 500).all()
    assert (error < 0.3).all()  # small beside the gradient itself
    assert np.abs(gradient).max() > 1


@pytest.mark.slow
def test_intervals_may_have_numbers_of_steps_of_their_own():
    model, times, observations = multivariate_ou()
    keep = np.array([0, 1, 2, 5, 6, 10, 11, 12])
    options = dict(num_bridges=2_000, proposal=jb.Guided(), where=DRIFT)
    data = times[keep], observations[keep]
    one = jb.score(jax.random.key(0), model, *data, num_steps=40, **options)
    two = jb.score(jax.random.key(1), model, *data, step_size=0.05, **options)
    error = np.sqrt(np.diagonal(one.covariance + two.covariance))
    np.testing.assert_array_less(np.abs(one.gradient - two.gradient), 5 * error + 0.1)
    assert two.effective_sample_size.shape == (7,)


@pytest.mark.slow
def test_lost_paths_are_told():
    """Cox, Ingersoll and Ross's process whose paths attain zero: the mass of those that touch it is
    missing, in scores, in maxima of likelihoods by bridges and in posteriors by either sampler."""
    model = jb.Diffusion(
        lambda x, p: p - x, lambda x, p: jnp.sqrt(x), domain=lambda x, p: x[0] > 0,
        params=jnp.float32(0.1),
    )  # fmt: skip
    data = np.arange(3) * 1.0, np.array([0.05, 0.01, 0.02])[:, None]
    options = {"proposal": jb.ModifiedDiffusionBridge(), "num_steps": 20}
    key, prior = jax.random.key(0), jb.NormalPrior(0.1, 0.01)
    made = jb.score(key, model, *data, num_bridges=400, **options)
    assert made.counts.nonfinite.sum() > 40 and not made.trustworthy
    allowed = lambda a: a > 0
    chains = [
        getattr(jb, method)(
            key, model, *data, prior=prior, constraint=allowed, num_iterations=200, **options
        )
        for method in ("gibbs", "pmmh")
    ]
    for result in (made, *chains):
        assert "2κθ < σ²" in result.why() and not result.trustworthy


@pytest.mark.optimised
@pytest.mark.slow
def test_score_with_a_state_dependent_sigma_is_of_second_order():
    """Cox, Ingersoll and Ross's process, whose score is known, with all parameters unknown and ten
    steps per unit interval."""
    at, h, times = np.array([1.1, 0.55, 0.62]), 1e-5, np.arange(31.0)
    model = jb.Diffusion(
        lambda x, p: p[0] * (p[1] - x), lambda x, p: p[2] * jnp.sqrt(x),
        domain=lambda x, p: x[0] > 0, params=tuple(at.tolist()),
    )  # fmt: skip

    data = cir.simulate(at, times, np.random.default_rng(2))
    ups, downs = (
        np.array([cir.log_likelihood(at + sign * row, times, data) for row in h * np.eye(3)])
        for sign in (1, -1)
    )
    made = jb.score(
        jax.random.key(2), model, times, data, num_bridges=1_000, num_steps=10, proposal=jb.Guided()
    )
    sd = np.sqrt(np.abs(np.diagonal(made.information)))
    error = np.abs(made.gradient - (ups - downs) / (2 * h)) / sd
    reported = 4 * np.sqrt(np.diagonal(made.covariance)) + np.abs(made.step_error)
    assert (error < reported / sd + 0.02).all() and (error < 0.2).all()
