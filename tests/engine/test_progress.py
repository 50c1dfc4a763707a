"""Metered loops are the loops of `lax`, and tell the share that is done."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbridge.engine.progress import metered_scan, metered_stages, metered_while_loop


class Recorder(diffrax.AbstractProgressMeter):
    """Keeps what it is told in its state, and in a list once closed."""

    told: list

    def init(self):
        return jnp.zeros(4), jnp.int32(0)

    def step(self, state, progress):
        values, i = state
        return values.at[i].set(progress), i + 1

    def close(self, state):
        jax.debug.callback(lambda values: self.told.extend(values.tolist()), state[0])


def scan(meter):
    return metered_scan(lambda total, x: (total + x, total), 0, jnp.arange(4), meter)[0]


def while_loop(meter):
    step, progress = lambda i: i + 2, lambda i: i / 8
    return metered_while_loop(lambda i: i < 8, step, jnp.int32(0), progress, meter) - 2


def in_stages(meter):
    begin, step = lambda total, i: (total, i), lambda first, total, i: (total + i, total)
    return metered_stages(begin, step, jnp.int32(0), [1, 3, 4], 2, meter)[0]


@pytest.mark.parametrize("loop", [scan, while_loop, in_stages])
def test_metered_loops(loop):
    told = []
    assert jax.jit(lambda: loop(None))() == 6
    assert jax.jit(lambda: loop(Recorder(told)))() == 6
    jax.effects_barrier()
    np.testing.assert_allclose(told, [0.25, 0.5, 0.75, 1])


def test_stages_keep_the_last_and_know_where_they_began():
    begin = lambda state, i: (state + 100, i)
    step = lambda first, state, i: (state + 1, (state, first, i))
    run = jax.jit(lambda: metered_stages(begin, step, jnp.int32(0), [2, 5], 4, None))
    state, (before, first, number) = run()
    assert state == 205
    np.testing.assert_array_equal(number, [1, 2, 3, 4])
    np.testing.assert_array_equal(first, [0, 2, 2, 2])
    np.testing.assert_array_equal(before, [101, 202, 203, 204])
