"""Coordinates in which σ is one, against closed forms of the Cox–Ingersoll–Ross process."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import count_compilations
from test_transform import MEAN, NOISE, RATE, cir, cir_density

import jaxbridge as jb
from jaxbridge.inference.data import as_problem
from jaxbridge.inference.parameters import as_parameters

AT = 0.5


def root(x, noise=NOISE):
    return 2 * (np.sqrt(x) - np.sqrt(AT)) / noise


@pytest.mark.slow
def test_coordinates_are_those_of_the_closed_form(precision):
    dtype = jnp.dtype(precision)
    tolerance = 1e-7 if dtype == "float64" else 2e-6
    moved = jb.lamperti(cir(), at=AT, reach=8.0)
    for x in (0.002, 0.05, 0.5, 0.6, 4.0):
        point = jnp.array([x], dtype)
        y = moved.forward(point)
        np.testing.assert_allclose(y, [root(x)], atol=tolerance)
        np.testing.assert_allclose(moved.inverse(y), point, rtol=10 * tolerance)
        drift = RATE * (MEAN - x) / (NOISE * np.sqrt(x)) - NOISE / (4 * np.sqrt(x))
        np.testing.assert_allclose(moved.model.drift(y), [drift], rtol=30 * tolerance, atol=1e-6)
        expected = -np.log(NOISE * np.sqrt(x))
        np.testing.assert_allclose(moved.log_jacobian(point), expected, rtol=1e-5)
    assert not np.isfinite(moved.forward(jnp.array([-0.1], dtype))).any()
    assert not np.isfinite(moved.model.drift(jnp.array([root(0.0) - 0.1], dtype))).any()
    assert not np.isfinite(moved.model.drift(jnp.array([8.1], dtype))).any()


@pytest.mark.slow
def test_the_reversal_follows_from_the_density(x64):
    """α* = ∇log ν_Y - α is the drift itself, through the derivative of the table."""
    moved = jb.lamperti(cir(), at=AT, reach=8.0).model
    residual = moved.reversibility_residual(jnp.linspace(-1.8, 4, 30)[:, None])
    np.testing.assert_allclose(residual, 0, atol=1e-4)
    draws = jax.vmap(moved.sample_stationary)(jax.random.split(jax.random.key(0), 4000))
    values = jb.lamperti(cir(), at=AT, reach=8.0).inverse
    mean = float(jnp.mean(jax.vmap(values)(draws)))
    assert abs(mean - MEAN) < 5 * NOISE * np.sqrt(MEAN / (2 * RATE) / 4000)


@pytest.mark.slow
def test_densities_are_those_of_cir():
    """What needs a constant σ serves."""
    start, end, proposal = 0.15, 0.3, jb.ModifiedDiffusionBridge(jb.ItoTaylorDensity())
    moved = jb.lamperti(cir(), at=AT, reach=8.0)
    assert not jb.effects(moved.model).solves.simulated  # σ is the identity
    estimate = jb.transition_log_density(
        jax.random.key(0),
        moved.model,
        moved.forward(jnp.array([start])),
        moved.forward(jnp.array([end])),
        1.0,
        num_proposals=15_000,
        num_steps=40,
        proposal=proposal,
    )
    value, error = float(estimate.value + moved.log_jacobian([end])), estimate.standard_error
    assert error < 0.03 and estimate.num_nonfinite < 150
    assert abs(value - np.log(cir_density(start, end, 1.0))) < 5 * float(error) + 0.005
    # In the coordinates of X again.
    bridges = jb.sample_weighted_bridges(
        jax.random.key(1),
        moved.model,
        moved.forward(jnp.array([start])),
        moved.forward(jnp.array([end])),
        1.0,
        num_bridges=100,
        num_steps=40,
        proposal=proposal,
    )
    paths = np.asarray(moved.back(bridges).paths)[np.asarray(bridges.met)]
    np.testing.assert_allclose(paths[:, [0, -1], 0], np.tile([start, end], (len(paths), 1)), 1e-5)


@pytest.mark.slow
def test_parameters_of_sigma_may_change_and_have_derivatives(x64):
    moved = jb.lamperti(cir(), at=AT, reach=8.0).model

    def drift(noise):
        return moved.with_params((RATE, MEAN, noise)).drift(jnp.array([0.3]))[0]

    def exact(noise):
        x = (jnp.sqrt(AT) + 0.15 * noise) ** 2
        return RATE * (MEAN - x) / (noise * jnp.sqrt(x)) - noise / (4 * jnp.sqrt(x))

    jitted = jax.jit(drift)
    np.testing.assert_allclose(jitted(0.6), exact(0.6), rtol=1e-6)
    with count_compilations() as compiled:
        np.testing.assert_allclose(jitted(0.9), exact(0.9), rtol=1e-6)
        jb.lamperti(cir().with_params((RATE, 0.4, 0.7)), at=AT, reach=8.0)
    assert not compiled
    slope = jax.grad(exact)(0.6)
    np.testing.assert_allclose(jax.jvp(drift, (0.6,), (1.0,))[1], slope, rtol=1e-5)
    np.testing.assert_allclose(jax.grad(drift)(0.6), slope, rtol=1e-5)


@pytest.mark.slow
def test_maps_take_many_points():
    moved = jb.lamperti(cir(), at=AT, reach=8.0)
    points = np.linspace(0.05, 2, 12).reshape(3, 4, 1).astype(np.float32)
    mapped = moved.forward(points)
    np.testing.assert_allclose(mapped, root(points), atol=2e-6)
    np.testing.assert_allclose(moved.inverse(mapped), points, rtol=2e-5)
    np.testing.assert_allclose(moved.forward(points[0, 0]), root(points[0, 0]), atol=2e-6)


TIMES = np.arange(4.0)
OBSERVATIONS = np.array([[0.3], [0.5], [0.4], [0.6]], np.float32)
PRIOR = jb.NormalPrior(1.0, 1.0)
INFERENCE = {
    "gibbs": lambda *a, **o: jb.gibbs(*a, prior=PRIOR, num_iterations=2, **o),
    "pmmh": lambda *a, **o: jb.pmmh(*a, prior=PRIOR, num_iterations=2, **o),
    "score": jb.score,
    "maximum_likelihood": lambda *a, **o: jb.maximum_likelihood(*a, num_iterations=2, **o),
}


def shifted(model):
    """Other coordinates than those that depend on parameters, which then do so as well."""
    moved = jb.transform(model, lambda y: 1 + y, lambda z: z - 1)
    return moved.model, moved.forward


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "where"), [*((name, None) for name in INFERENCE), ("gibbs", lambda p: p[2])]
)
def test_unknown_parameters_of_sigma_are_refused(name, where):
    """The coordinates would move with them, and the observations would not."""
    moved = jb.lamperti(cir(), at=AT, reach=8.0)
    points = moved.forward(OBSERVATIONS)
    further, forward = shifted(moved.model)
    twice = jb.lamperti(moved.model, at=0.0, reach=6.0)
    for model, data in [
        (moved.model, points),
        (moved.model.with_params((1.0, 0.6, 0.5)), points),
        (further, forward(points)),
        (twice.model, points),
    ]:
        with pytest.raises(
            ValueError, match=r"coordinates of `lamperti` depend.*original.*`where="
        ):
            INFERENCE[name](jax.random.key(0), model, TIMES, data, where=where, num_steps=4)


@pytest.mark.slow
def test_unknown_parameters_of_the_drift_are_not_refused():
    moved = jb.lamperti(cir(), at=AT, reach=8.0)
    points = moved.forward(OBSERVATIONS)
    further, forward = shifted(moved.model)
    prepared = jb.Diffusion(  # the parameters of σ reach it by `prepare`
        lambda x, p: p["rate"] * (0.5 - x),
        lambda x, p: p["noise"] * jnp.sqrt(x),
        params=(1.0, 0.36),
        prepare=lambda p: dict(rate=p[0], noise=jnp.sqrt(p[1])),
    )
    prepared = jb.lamperti(prepared, at=AT, reach=8.0)
    for model, data in [
        (moved.model, points),
        (further, forward(points)),
        (prepared.model, prepared.forward(OBSERVATIONS)),
    ]:
        arguments = (TIMES, data, 4, None)
        problem = as_problem(jax.random.key(0), as_parameters(model, lambda p: p[0]), *arguments)
        assert not problem.sigma_is_unknown and problem.theta.shape == (1,)
        with pytest.raises(ValueError, match="coordinates of `lamperti` depend"):
            as_problem(jax.random.key(0), as_parameters(model, lambda p: p[1:]), *arguments)
