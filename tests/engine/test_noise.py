"""`noisy_scan` is a plain loop, whatever the number of chunks it is cut into."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow_beyond

from jaxbridge.engine.noise import Store, noisy_scan, noisy_scan_until

LANES = 3


def draw(key, k):
    return jax.random.normal(key, (k,))


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("num_steps", slow_beyond(3, [1, 65, 150, 5, 64, 128]))
def test_scan_equals_a_loop_over_the_noise_it_reports(num_steps, reverse):
    keys = jax.random.split(jax.random.key(0), LANES)
    xs = jnp.arange(num_steps, dtype=jnp.float32)
    stored = np.unique([0, num_steps // 2, num_steps - 1])
    slots = jnp.full(num_steps, len(stored)).at[stored].set(jnp.arange(len(stored)))

    def step(carry, inputs):
        noise, x = inputs
        carry = 0.5 * carry + noise + x
        return carry, (carry, noise)

    init = jnp.ones(LANES)
    carry, (path, noise) = noisy_scan(step, init, keys, draw, xs, num_steps, reverse=reverse)
    expected, state = np.empty((num_steps, LANES)), np.ones(LANES)
    for i in reversed(range(num_steps)) if reverse else range(num_steps):
        state = 0.5 * state + np.asarray(noise[i]) + i
        expected[i] = state
    np.testing.assert_allclose(path, expected, rtol=1e-5)
    np.testing.assert_allclose(carry, state, rtol=1e-5)
    assert len(np.unique(noise)) == noise.size  # no number is used twice

    def only_path(carry, inputs):
        carry, (path, _) = step(carry, inputs)
        return carry, path

    store = Store(slots, jnp.zeros((len(stored) + 1, LANES)))
    _, rows = noisy_scan(only_path, init, keys, draw, xs, num_steps, reverse=reverse, store=store)
    np.testing.assert_array_equal(rows[:-1], path[stored])


def test_numbers_of_a_lane_do_not_depend_on_its_neighbours():
    keys = jax.random.split(jax.random.key(0), LANES)

    def noise(keys):
        init = jnp.zeros(len(keys))
        step = lambda carry, inputs: (carry, inputs[0])
        return noisy_scan(step, init, keys, draw, jnp.arange(100), 100)[1]

    np.testing.assert_array_equal(noise(keys)[:, 1:2], noise(keys[1:2]))


@pytest.mark.parametrize("num_steps", [5, 150])
def test_scan_ends_with_the_chunk_in_which_all_lanes_are_over(num_steps):
    keys = jax.random.split(jax.random.key(0), LANES)
    counted = lambda over: noisy_scan_until(
        over, lambda i, inputs: (i + 1, None), jnp.zeros(LANES), keys, draw, None, num_steps
    )
    np.testing.assert_array_equal(counted(lambda i: i < 0), num_steps)
    np.testing.assert_array_equal(counted(lambda i: i >= 3), min(num_steps, 50))
