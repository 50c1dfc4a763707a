"""The kernel of paths given a record leaves their exact law invariant."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from kalman import exact_step, kalman

import jaxbridge as jb

TIMES, NOISE = 0.4 * np.arange(9), 0.04
MODEL = jb.Diffusion(lambda x, p: -p * x + 0 * x**3, [0.7], params=1.2)  # linear, but not in form
RECORD = {
    "observation": jb.LinearGaussian(covariance=NOISE),
    "initial": jb.GaussianLaw([0.0], [[1.0]]),
    "num_steps": 4,
}
VALUES = np.array([0.3, np.nan, 0.9, 0.1, -0.4, np.nan, np.nan, 0.8, 0.2])[:, None]
KEY = jax.random.key(0)


@pytest.mark.slow
@pytest.mark.parametrize("guide_path", [None, np.zeros((33, 1))])
def test_paths_have_the_law_given_the_record(guide_path):
    kernel = jb.smoothing_kernel(MODEL, TIMES, VALUES, guide_path=guide_path, **RECORD)

    def step(state, key):
        state, info = kernel.step(key, state)
        return state, (state.position[::4, 0], info.accepted)

    init = kernel.init(None, KEY)
    _, (draws, accepted) = jax.jit(lambda: lax.scan(step, init, jax.random.split(KEY, 1600)))()
    draws, accepted = np.asarray(draws[100:], float), accepted[100:]
    one = exact_step(np.array([[1.2]]), np.array([[0.49]]))
    matrices = np.eye(1), NOISE * np.eye(1), np.zeros(1), np.eye(1)
    exact = kalman(one, TIMES, VALUES, *matrices, 1)
    sd = np.sqrt(exact.covariance[:, 0, 0])
    size = np.asarray(jb.effective_sample_size(draws))
    assert np.all(np.abs(draws.mean(0) - exact.mean[:, 0]) < 4.5 * sd / np.sqrt(size) + 0.01 * sd)
    np.testing.assert_allclose(draws.std(0) / sd, 1, atol=0.1)
    assert np.min(size) > 150 and accepted.any(0).all()


def test_a_path_goes_on_and_others_are_refused():
    kernel = jb.smoothing_kernel(MODEL, TIMES, VALUES, guide_path=np.zeros((33, 1)), **RECORD)
    path = jnp.zeros((33, 1))
    np.testing.assert_array_equal(kernel.init(path, KEY).position, path)
    with pytest.raises(ValueError, match=r"`position` must be a path .* \(33, 1\); got"):
        kernel.init(path[1:], KEY)
    with pytest.raises(ValueError, match="takes one record"):
        jb.smoothing_kernel(MODEL, [TIMES, TIMES], [VALUES, VALUES], **RECORD)
