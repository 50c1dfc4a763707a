"""Probabilities of rare events, by this package and by plain simulation.

The events are the passage of a Brownian motion over a level, an Ornstein–Uhlenbeck process that
ends in a small set, and the transition of a particle between two wells. The first two have
probabilities in closed form; that of the third is the solution of the backward equation. Simulation
is that which a user would write: Euler steps in NumPy, and a count.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key
from scipy import sparse, stats
from scipy.sparse.linalg import splu

import jaxbridge as jb
from jaxbridge.studies.clock import fastest, timed
from jaxbridge.studies.report import Say

NUM_STEPS = 100
_WELL_SIGMA, _BEYOND = 0.5, 0.5
_END, _WIDTH = 2.5, 0.1


class Event(NamedTuple):
    """An event of a path in one dimension over one unit of time.

    - `run`: the estimate of this package for a key.
    - `drift`, `sigma`, `start`: the diffusion; σ is a number.
    - `occurs`: whether the event occurs, for paths of shape (steps + 1, paths).
    - `log_probability`: the exact one.
    """

    name: str
    way: str
    run: Callable[[Any], Any]
    drift: Callable[[Any], Any]
    sigma: float
    start: float
    occurs: Callable[[Any], Any]
    log_probability: float


class EventRow(NamedTuple):
    """Log of one estimated probability, its standard error and its error, and seconds.

    - `worth`: number of independent paths with the event that have the same relative error.
    - `why`: why there are no numbers.
    """

    event: str
    way: str
    log_probability: float | None = None
    standard_error: float | None = None
    error: float | None = None
    worth: float | None = None
    first: float | None = None
    again: float | None = None
    why: str = ""


def _well_drift(x: Any) -> Any:
    return 4.0 * (x - x**3)


def transition_log_probability() -> float:
    """Return that of a transition from -1 to `_BEYOND`, from two grids, extrapolated."""
    fine, coarse = (_transition(n) for n in (4_000, 2_000))
    return float(np.log(fine + (fine - coarse) / 3))


def _transition(n: int) -> float:
    """Solve the backward equation by Crank and Nicolson, after four short implicit steps."""
    x = np.linspace(-3.0, _BEYOND, n + 1)[1:]
    h, half = x[1] - x[0], _WELL_SIGMA**2 / 2
    up, down = half / h**2 + _well_drift(x) / (2 * h), half / h**2 - _well_drift(x) / (2 * h)
    # The last point absorbs; nothing comes as far as the first.
    up[-1] = down[-1] = 0.0
    generator = sparse.diags([down[1:], -up - down, up[:-1]], [-1, 0, 1]).tocsc()  # pyright: ignore
    eye = sparse.eye(len(x)).tocsc()
    u, step = np.zeros(len(x)), 1.0 / n
    u[-1] = 1.0
    implicit = splu(eye - step / 4 * generator)
    for _ in range(4):
        u = implicit.solve(u)
    trapezoid = splu(eye - step / 2 * generator)
    for _ in range(n - 1):
        u = trapezoid.solve(u + step / 2 * (generator @ u))
    return float(np.interp(-1.0, x, u))


def events(quick: bool) -> list[Event]:
    """Return the events of the study; with `quick` only the first."""
    brownian = jb.Diffusion(lambda x, p: jnp.zeros(1), [1.0])
    ou, well = jb.ornstein_uhlenbeck([[1.0]]), jb.Diffusion(lambda x, p: _well_drift(x), [0.5])

    def passage(level: float) -> Event:
        def run(key: Any) -> Any:
            inside = lambda x: level - x[0]
            return jb.sample_exits(key, brownian, [0.0], 1.0, inside, num_steps=NUM_STEPS)

        exact = np.log(2) + stats.norm.logsf(level)
        passes = lambda paths: paths.max(axis=0) > level
        name, way = f"passage of {level:g}", "jaxbridge, `sample_exits`"
        return Event(name, way, run, np.zeros_like, 1.0, 0.0, passes, float(exact))

    if quick:
        return [passage(2.0)]
    sd = np.sqrt((1 - np.exp(-2.0)) / 2)
    ends = np.diff(stats.norm.cdf([_END - _WIDTH, _END + _WIDTH], scale=sd))[0]
    near = lambda path: _WIDTH - abs(path[-1, 0] - _END)

    def end_in_set(key: Any) -> Any:
        return jb.sample_events(key, ou, [0.0], 1.0, near, num_steps=NUM_STEPS)

    def transition(key: Any) -> Any:
        inside = lambda x: _BEYOND - x[0]
        return jb.sample_exits(key, well, [-1.0], 1.0, inside, num_steps=NUM_STEPS)

    return [
        passage(2.0),
        passage(5.0),
        Event(
            "end in a set",
            "jaxbridge, `sample_events`",
            end_in_set,
            np.negative,
            1.0,
            0.0,
            lambda paths: np.abs(paths[-1] - _END) < _WIDTH,
            float(np.log(ends)),
        ),
        Event(
            "transition between wells",
            "jaxbridge, `sample_exits`",
            transition,
            _well_drift,
            _WELL_SIGMA,
            -1.0,
            lambda paths: paths.max(axis=0) > _BEYOND,
            transition_log_probability(),
        ),
    ]


def run_events(key: Key[Array, ""], quick: bool, num_paths: int, say: Say) -> list[EventRow]:
    """Estimate the probability of each event in both ways."""
    rows = []
    for event in events(quick):
        say(f"events: {event.name}")
        rows += [_library_row(key, event), _simulation_row(event, num_paths)]
    return rows


def _library_row(key: Key[Array, ""], event: Event) -> EventRow:
    run = jax.jit(event.run)
    made, first = timed(lambda: run(key))
    _, again = fastest(lambda: run(key))
    return _row(event, event.way, made.log_probability, made.standard_error, (first, again))


def _simulation_row(event: Event, num_paths: int) -> EventRow:
    """Count the event in Euler paths."""
    rng, step = np.random.default_rng(0), 1.0 / NUM_STEPS

    def run() -> Float[np.ndarray, " paths"]:
        paths = np.empty((NUM_STEPS + 1, num_paths))
        paths[0] = event.start
        for x, new in itertools.pairwise(paths):
            noise = event.sigma * np.sqrt(step) * rng.normal(size=num_paths)
            new[:] = x + step * event.drift(x) + noise
        return event.occurs(paths)

    occurred, seconds = timed(run)
    way, number = f"simulation, {num_paths:,} paths", int(occurred.sum())
    if not number:
        return EventRow(event.name, way, worth=0.0, first=seconds, again=seconds,
                        why="no path has the event")  # fmt: skip
    share = number / num_paths
    error = np.sqrt((1 - share) / number)
    return _row(event, way, np.log(share), error, (seconds, seconds))


def _row(event: Event, way: str, log: Any, error: Any, seconds: tuple[float, float]) -> EventRow:
    log, error = float(log), float(error)
    # The relative variance of a share of n hits is (1 - p) / n.
    worth = (1 - np.exp(event.log_probability)) / error**2
    return EventRow(event.name, way, log, error, log - event.log_probability, worth, *seconds)
