"""Derivatives of expectations over bridges, against those of Gaussian bridges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inference_oracles import multivariate_ou

import jaxbridge as jb
from jaxbridge.schemes.path_likelihood import forms_of_targets

ENDS = ([0.5, -0.3], [1.0, 0.8], 1.0)


def exact_mean(B):
    model = multivariate_ou()[0]
    model = model.with_params(model.params._replace(B=B))
    return jb.gaussian_bridge(model, *ENDS, times=[0.5]).mean[0]


@pytest.fixture(scope="module")
def bridges():
    model = multivariate_ou()[0]
    return jb.sample_weighted_bridges(
        jax.random.key(0),
        model,
        *ENDS,
        num_bridges=40_000,
        num_steps=20,
        proposal=jb.Guided(density=jb.ItoTaylorDensity()),
    )


def of_drift(bridges, fn):
    model = multivariate_ou()[0]
    return lambda B: jb.expectation(fn, bridges, model.with_params(model.params._replace(B=B)))


@pytest.mark.slow
def test_derivative_is_that_of_the_expectation(bridges):
    """Cov(h, ∇ log f) to five standard errors, about √(V(h) V(∇ log f) / n)."""
    B = multivariate_ou()[0].params.B
    middle = lambda path: path[10]
    forward = jax.jit(jax.jacfwd(of_drift(bridges, middle)))(B)
    exact = jax.jit(jax.jacfwd(exact_mean))(B)
    model = multivariate_ou()[0]

    def scores(B):
        at_B = model.with_params(model.params._replace(B=B))
        return jb.path_log_likelihood(at_B, bridges.times, bridges.paths)

    score = jax.jacfwd(scores)(B)
    spread = np.std(np.asarray(bridges.paths[:, 10]), axis=0)[:, None, None] * np.std(score, axis=0)
    error = 1.5 * spread / np.sqrt(40_000)
    np.testing.assert_array_less(np.abs(forward - exact), 5 * error + 0.001)
    assert np.abs(exact).max() > 0.05 and error.max() < 0.003
    reverse = jax.jit(jax.jacrev(of_drift(bridges, middle)))(B)
    np.testing.assert_allclose(reverse, forward, atol=1e-4)
    np.testing.assert_allclose(of_drift(bridges, middle)(B), bridges.mean(middle), atol=1e-5)


@pytest.mark.slow
def test_derivative_of_the_paths_is_not():
    """The pathwise derivative of accepted bridges leaves out that other bridges are accepted."""
    model = multivariate_ou()[0]

    def pathwise(B):
        made = jb.sample_bridges(
            jax.random.key(1),
            model.with_params(model.params._replace(B=B)),
            *ENDS,
            num_bridges=2_000,
            num_steps=20,
            coupling=jb.Coupling(0.0),
        )
        return jnp.mean(made.paths[:, 10], axis=0)

    B = model.params.B
    naive, exact = (jax.jit(jax.jacfwd(mean))(B) for mean in (pathwise, exact_mean))
    assert np.abs(naive - exact).max() > 0.05


@pytest.mark.slow
def test_function_may_depend_on_parameters(bridges):
    B = multivariate_ou()[0].params.B

    def scaled(B):
        return of_drift(bridges, lambda path: B[0, 0] * path[10])(B)

    plain = of_drift(bridges, lambda path: path[10])
    expected = B[0, 0] * jax.jacfwd(plain)(B)
    expected = expected.at[:, 0, 0].add(plain(B))
    np.testing.assert_allclose(jax.jacfwd(scaled)(B), expected, atol=1e-4)


@pytest.mark.slow
def test_chains_and_several_intervals():
    model = multivariate_ou()[0]
    starts = jnp.array([ENDS[0], [0.0, 0.0]])
    options = dict(num_steps=10, proposal=jb.Guided())
    chain = jb.sample_exact_bridges(
        jax.random.key(0), model, starts, ENDS[1], 1.0, num_bridges=50, **options
    )
    value = jb.expectation(lambda path: path[5], chain, model)
    np.testing.assert_allclose(value, chain.paths[:, :, 5].mean(1), atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "density", [jb.EulerDensity(), jb.ItoTaylorDensity()], ids=["euler", "ito_taylor"]
)
def test_on_a_grid_with_short_last_steps(density):
    """Steps that rounding of the times in float32 would have spoilt; the derivative is that of the
    weighted mean with its paths and weights, up to the error of both."""
    model, *_ = multivariate_ou()
    proposal = jb.ModifiedDiffusionBridge(density, refinement=4.0)
    middle = lambda path: path[20]

    def made_at(B):
        return jb.sample_weighted_bridges(
            jax.random.key(0),
            model.with_params(model.params._replace(B=B)),
            *ENDS,
            num_bridges=4_000,
            num_steps=50,
            proposal=proposal,
        )

    bridges = made_at(model.params.B)
    gradient = jax.jacfwd(of_drift(bridges, middle))(model.params.B)
    direct = jax.jacfwd(lambda B: made_at(B).mean(middle))(model.params.B)
    # Both are unbiased for the derivative, with noise √(V(h) V(∇ log f) / n), about .005.
    np.testing.assert_allclose(gradient, direct, atol=5 * 0.005)
    assert np.abs(direct).max() > 0.05
    form = "girsanov" if isinstance(density, jb.EulerDensity) else "ito_taylor"
    targets = [single.target for single in bridges.proposal.singles]
    assert forms_of_targets(targets, model, bridges.paths[0, 0])[0] == form
