"""Metered loops are the loops of `lax`, and tell the share that is done."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbridge.engine.progress import metered_scan, metered_while_loop


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


@pytest.mark.parametrize("loop", [scan, while_loop])
def test_metered_loops(loop):
    told = []
    assert jax.jit(lambda: loop(None))() == 6
    assert jax.jit(lambda: loop(Recorder(told)))() == 6
    jax.effects_barrier()
    np.testing.assert_allclose(told, [0.25, 0.5, 0.75, 1])
