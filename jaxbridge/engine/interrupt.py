"""Ctrl-C inside of compiled loops that report their progress.

Python handles a signal only between two instructions of its main thread, and the main thread waits
until a compiled program ends. A loop with a progress meter therefore checks for Ctrl-C itself,
about four times per second: it calls a function on the host, which reads the file of arrived
signals (`signal.set_wakeup_fd`). The function raises an exception there, so the program ends with
an error, and Python raises `KeyboardInterrupt` in the main thread.
"""

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int, PyTree

_SECONDS_BETWEEN_LOOKS = 0.25
_NEVER = np.iinfo(np.int32).max


class _Listener:
    """Signals that arrive during one call, and the pace of its loop."""

    def __init__(self, signals: socket.socket, before: int):
        self.signals, self.before = signals, before
        self.is_interrupted, self.time, self.step = False, time.monotonic(), 0

    def hear(self) -> bool:
        """Return whether Ctrl-C has arrived; pass signals on to the caller's own file of them."""
        with contextlib.suppress(OSError):  # no signals, or a file that takes none
            arrived = self.signals.recv(4096)
            self.is_interrupted |= signal.SIGINT in arrived
            if self.before >= 0:
                os.write(self.before, arrived)
        return self.is_interrupted

    def look(self, step: int) -> int:
        """Return the step of the next check, or raise `KeyboardInterrupt` after Ctrl-C."""
        if self.hear():
            raise KeyboardInterrupt
        now = time.monotonic()
        # Each loop of a call counts its steps from zero.
        num_steps = max(step - self.step, 1)
        pace = num_steps / max(now - self.time, 1e-6)
        self.time, self.step = now, step
        # The pace may change, so it waits for at most ten times as many steps as before.
        wait = min(int(_SECONDS_BETWEEN_LOOKS * pace), 10 * num_steps)
        return min(step + max(wait, 1), _NEVER)


_listener: _Listener | None = None


class _Watch(NamedTuple):
    """State of an `InterruptibleMeter`.

    - `inner`: state of the caller's meter.
    - `step`, `look_at`: numbers of this step, and of the step of the next check for Ctrl-C.
    """

    inner: PyTree
    step: Int[Array, ""]
    look_at: Int[Array, ""]


@contextlib.contextmanager
def listening() -> Iterator[None]:
    """Let loops with an `InterruptibleMeter` end after Ctrl-C.

    It has no effect outside of the main thread, which alone receives signals. It also has none if
    the caller has another handler of the signal.
    """
    global _listener
    is_main = threading.current_thread() is threading.main_thread()
    is_default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if _listener is not None or not (is_main and is_default):
        yield
        return
    reader, writer = socket.socketpair()
    with reader, writer:
        for end in (reader, writer):
            end.setblocking(False)
        before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        _listener = listener = _Listener(reader, before)
        try:
            yield
        finally:
            _listener = None
            signal.set_wakeup_fd(before)
            listener.hear()


class InterruptibleMeter(diffrax.AbstractProgressMeter):
    """Progress meter of the caller that also checks for Ctrl-C at some of the steps."""

    meter: diffrax.AbstractProgressMeter

    def init(self) -> _Watch:
        return _Watch(self.meter.init(), jnp.int32(0), jnp.int32(0))

    def step(self, state: _Watch, progress: float | Array | np.ndarray) -> _Watch:
        # A pure callback, because `cond` under `vmap` takes no other.
        result = jax.ShapeDtypeStruct((), jnp.int32)
        look = lambda: jax.pure_callback(_look, result, state.step, vmap_method="sequential")
        look_at = lax.cond(state.step >= state.look_at, look, lambda: state.look_at)
        return _Watch(self.meter.step(state.inner, progress), state.step + 1, look_at)

    def close(self, state: _Watch) -> None:
        self.meter.close(state.inner)
        # The compiler removes pure callbacks whose result no one reads.
        jax.debug.callback(lambda look_at: None, state.look_at)


def _look(step: Int[Array | np.ndarray, ""]) -> np.int32:
    # Without listener, the program runs elsewhere, for instance in another thread.
    return np.int32(_NEVER if _listener is None else _listener.look(int(step)))
