"""Ctrl-C ends a compiled loop that reports its progress, and no other."""

import os
import signal
import socket
import threading
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.engine import interrupt
from jaxbridge.engine.progress import metered_scan, metered_stages, metered_while_loop
from jaxbridge.proposals import guided

QUIET = diffrax.TextProgressMeter(2.0)  # the share never grows by so much
MATRIX = jnp.eye(200)


def power(x):
    return MATRIX @ x @ MATRIX


def scan(length, meter):
    return metered_scan(lambda x, _: (power(x), None), MATRIX, jnp.arange(length), meter)[0]


def stages(length, meter):
    begin = lambda x, i: (x, None)
    step = lambda context, x, i: (power(x), i)
    return metered_stages(begin, step, MATRIX, (length // 4, length), 1, meter)[0]


def while_loop(length, meter):
    step = lambda carry: (power(carry[0]), carry[1] + 1)
    progress = lambda carry: carry[1] / length
    carry = MATRIX, jnp.int32(0)
    return metered_while_loop(lambda carry: carry[1] < length, step, carry, progress, meter)[0]


@pytest.fixture
def default_handler():
    """Processes that run tests for others may ignore the signal."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("loop", [scan, stages, while_loop])
def test_ctrl_c_ends_a_loop_with_a_meter(loop, default_handler):
    program = jax.jit(lambda length: loop(length, QUIET), static_argnums=0)
    program = program.lower(1_000_000).compile()  # minutes of work
    timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt), interrupt.listening():
        timer.start()
        jax.block_until_ready(program())
    assert time.monotonic() - begin < 5


def test_looks_are_rare(monkeypatch, default_handler):
    """They cost nothing that counts, however short the steps are."""
    looks, look = [], interrupt._Listener.look
    monkeypatch.setattr(
        interrupt._Listener, "look", lambda self, step: looks.append(step) or look(self, step)
    )
    fast = lambda x, _: (x + 1, None)
    program = jax.jit(lambda x: metered_scan(fast, x, jnp.arange(1_000_000), QUIET)[0])
    with interrupt.listening():
        assert program(0) == 1_000_000
    assert 2 <= len(looks) < 40 and looks == sorted(looks)


def test_handlers_of_the_caller_stay_in_charge(default_handler):
    """And those of an event loop hear of signals again, once the call is over."""
    heard = []
    signal.signal(signal.SIGINT, lambda *_: heard.append(True))
    with interrupt.listening():
        assert interrupt._listener is None
    signal.signal(signal.SIGINT, signal.default_int_handler)
    before = signal.set_wakeup_fd(-1)
    signal.set_wakeup_fd(before)
    with interrupt.listening(), interrupt.listening():
        assert interrupt._listener is not None
    assert interrupt._listener is None and signal.set_wakeup_fd(before) == before


@pytest.fixture
def sockets():
    """A pair of connected sockets, to read from and to write to."""
    reader, writer = socket.socketpair()
    with reader, writer:
        for end in (reader, writer):
            end.setblocking(False)
        yield reader, writer


def test_all_loops_of_an_interrupted_call_end(sockets):
    """Whichever loop reads the signal first, for instance that of another thread."""
    reader, writer = sockets
    listener = interrupt._Listener(reader, -1)
    assert listener.look(0) > 0
    writer.send(bytes([signal.SIGINT]))
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            listener.look(0)


def test_signals_are_passed_on(default_handler, sockets):
    """To the file in which an event loop waits for them."""
    reader, writer = sockets
    before = signal.set_wakeup_fd(writer.fileno())
    with pytest.raises(KeyboardInterrupt), interrupt.listening():
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)
    assert signal.set_wakeup_fd(before) == writer.fileno()
    assert signal.SIGINT in reader.recv(16)


def test_a_metered_run_of_guided_paths_has_several_blocks(monkeypatch):
    """Progress is reported between them; their number changes results by rounding only."""
    monkeypatch.setattr(guided, "_STEPS_BETWEEN_REPORTS", 200)
    model = jb.ornstein_uhlenbeck(jnp.eye(1))
    run = lambda meter: jb.sample_weighted_bridges(
        jax.random.key(0), model, [0.0], [0.5], 1.0, num_bridges=300, num_steps=5,
        proposal=jb.ModifiedDiffusionBridge(), progress_meter=meter, save_at=[0.2],
    )  # fmt: skip
    made = run(Recorder())
    jax.effects_barrier()
    assert len(TOLD) > 3 and TOLD[-1] == 1
    np.testing.assert_allclose(made.paths, run(None).paths, atol=1e-6)


TOLD = []


class Recorder(diffrax.AbstractProgressMeter):
    """Keeps what it is told in a list."""

    def init(self):
        return jnp.zeros(())

    def step(self, state, progress):
        jax.debug.callback(lambda progress: TOLD.append(float(progress)), progress)
        return state

    def close(self, state):
        pass


def test_only_meters_look():
    """In threads there is no listener, and the loop runs to its end."""
    primitives = str(jax.make_jaxpr(lambda x: scan(3, None))(0.0))
    assert "callback" not in primitives
    results = []
    thread = threading.Thread(target=lambda: results.append(scan(10, QUIET)))
    thread.start()
    thread.join()
    assert results[0].shape == MATRIX.shape


def test_transformed_loops():
    """They look as well; the numbers are those without a meter."""
    step = lambda x, _: (jnp.sin(x), x)
    one = lambda x, meter: metered_scan(step, x, jnp.arange(5), meter)[0]
    x = jnp.arange(3.0)
    for transformed in (jax.vmap(one, (0, None)), jax.vmap(jax.grad(one), (0, None))):
        assert jnp.array_equal(transformed(x, QUIET), transformed(x, None))
