"""Couplings: marginal and joint laws of the two noises, rotation, user-written couplings."""

import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_moments, paper_model, slow_beyond

import jaxbridge as jb
from jaxbridge.coupling.base import AbstractCoupling
from jaxbridge.coupling.rotation import polar_rotation, published_rotation
from jaxbridge.models.sigma import Full
from jaxbridge.schemes.relative_frame import frame

# The example of the documentation, as it is printed there.
_EXAMPLE = re.search(r"```python\n(.*?)```", inspect.cleandoc(AbstractCoupling.__doc__), re.DOTALL)
_NAMES: dict = {}
exec(_EXAMPLE[1], _NAMES)
SynchronousThenReflection = _NAMES["SynchronousThenReflection"]


COUPLINGS = [jb.Coupling(g) for g in (-1.0, -0.5, 0.0, 0.5, 0.99)]
COUPLINGS += [SynchronousThenReflection(), SynchronousThenReflection(distance=10.0)]


def random_frame(d):
    keys = jax.random.split(jax.random.key(d), 3)
    sigma = Full(jax.random.normal(keys[0], (d, d)) + 2 * jnp.eye(d))
    return frame(sigma, *jax.random.normal(keys[1], (2, d)))


@pytest.mark.parametrize("d", slow_beyond(1, [2, 1, 5]))
@pytest.mark.parametrize("coupling", COUPLINGS)
def test_both_maps_read_one_joint_law(coupling, d, x64):
    """Each map is linear in Gaussian noise, so its Jacobians tell its law: the noise made is
    standard, and E[dW dW'ᵀ] is the same from either side."""
    seen = random_frame(d)
    zero = jnp.zeros(d)

    def jacobians(noise_map):
        if not coupling.independent_noise:
            return jax.jacfwd(lambda w: noise_map(seen, w, None))(zero), jnp.zeros((d, 1))
        given, independent = jax.jacfwd(lambda w, u: noise_map(seen, w, u), (0, 1))(
            zero, jnp.asarray(0.0)
        )
        return given, independent[:, None]

    driven, driven_own = jacobians(coupling.driven_noise)
    driving, driving_own = jacobians(coupling.driving_noise)
    np.testing.assert_allclose(driven @ driven.T + driven_own @ driven_own.T, np.eye(d), atol=1e-12)
    np.testing.assert_allclose(
        driving @ driving.T + driving_own @ driving_own.T, np.eye(d), atol=1e-12
    )
    np.testing.assert_allclose(driven.T, driving, atol=1e-12)
    # The gap moves along u only, with the variance that the meeting rule is told.
    along_u = 2 - 2 * seen.u @ driven @ seen.u
    np.testing.assert_allclose(along_u, coupling.gap_variance(seen), atol=1e-12)
    across = np.eye(d) - np.outer(seen.u, seen.u)
    np.testing.assert_allclose(across @ driven, across, atol=1e-12)


def test_gamma_zero_is_independence_in_one_dimension():
    seen = random_frame(1)
    coupling = jb.Coupling(0.0)
    dw, du = jnp.array([0.7]), jnp.asarray(0.2)
    np.testing.assert_allclose(coupling.driven_noise(seen, dw, du), seen.u * du, atol=1e-7)


def test_u_is_seen_through_sigma_of_the_driven():
    sigma = Full(jnp.array([[1.0, 0.5], [0.0, 2.0]]))
    x, driven = jnp.array([1.0, 2.0]), jnp.array([0.5, -1.0])
    seen = frame(sigma, x, driven)
    np.testing.assert_allclose(sigma.mv(seen.u) * seen.gap, x - driven, rtol=1e-6)
    np.testing.assert_allclose(jnp.linalg.norm(seen.u), 1, rtol=1e-6)


def rotating_model():
    """dX = -½ L Lᵀ X dt + L R(x) dW: the rotation R(x) leaves the law alone."""
    lower = jnp.array([[1.0, 0.0], [0.6, 0.8]])

    def sigma(x, p):
        angle = 1.5 * x[0] - x[1]
        c, s = jnp.cos(angle), jnp.sin(angle)
        return lower @ jnp.array([[c, -s], [s, c]])

    return jb.Diffusion(
        lambda x, p: -lower @ lower.T @ x / 2, sigma, lambda x, p: -x @ x / 2, reversible=True
    )


def acceptance(model, rotation, num_bridges=10_000):
    """The acceptance probability and its standard error."""
    bridges = jb.sample_bridges(
        jax.random.key(0),
        model,
        [1.0, 0.0],
        [-1.0, 0.0],
        2.0,
        num_bridges=num_bridges,
        num_steps=40,
        coupling=jb.Coupling(0.0, rotation=rotation),
        save_at=[0.0],
    )
    share = num_bridges / float(bridges.num_proposals)
    return share, share * np.sqrt((1 - share) / num_bridges)


@pytest.mark.slow
def test_the_right_rotation_meets_more_often_and_the_printed_one_less():
    model = rotating_model()
    right, none, printed = (
        acceptance(model, rotation) for rotation in (None, jb.no_rotation, published_rotation)
    )
    assert right[0] - none[0] > 5 * np.hypot(right[1], none[1])
    assert none[0] - printed[0] > 5 * np.hypot(none[1], printed[1])


def test_rotation_aligns_the_two_coefficients(x64):
    model = rotating_model()
    x, driven = jnp.array([0.4, 0.1]), jnp.array([-0.3, 0.9])
    sigma, driven_sigma = model.diffusion(x), model.diffusion(driven)
    np.testing.assert_allclose(
        driven_sigma @ polar_rotation(sigma, driven_sigma), sigma, atol=1e-12
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "coupling",
    [
        SynchronousThenReflection(),
        jb.Coupling(lambda key: jax.random.uniform(key, minval=-1.0, maxval=0.5)),
    ],
    ids=["synchronous then reflection", "random gamma"],
)
def test_other_couplings_make_bridges_too(coupling):
    """On a long interval nearly every pair meets, so any coupling gives the exact law."""
    model = paper_model()
    bridges = jb.sample_bridges(
        jax.random.key(3),
        model,
        [0.5, 0.0],
        [0.0, 0.5],
        6.0,
        num_bridges=10_000,
        num_steps=150,
        coupling=coupling,
        save_at=[0.0, 3.0, 6.0],
    )
    exact = jb.gaussian_bridge(model, [0.5, 0.0], [0.0, 0.5], 6.0, [3.0])
    assert_moments(bridges.paths[:, 1], exact.mean[0], exact.covariance[0])


@pytest.mark.slow
@pytest.mark.parametrize("gamma", [1.0, 1.5, -1.1])
def test_gamma_out_of_its_range_where_it_cannot_be_seen(gamma):
    """From a law, or traced: then no pair meets, and all are counted."""
    model = paper_model()

    def run(coupling):
        return jb.sample_bridges(
            jax.random.key(0), model, [0.0, 0.0], [0.3, 0.1], 1.0,
            num_steps=10, coupling=coupling, max_proposals=20,
        )  # fmt: skip

    for bridges in (
        run(jb.Coupling(lambda key: jnp.asarray(gamma))),
        jax.jit(lambda gamma: run(jb.Coupling(gamma)))(gamma),
    ):
        assert not bridges.met.any() and bridges.num_nonfinite == bridges.num_proposals
