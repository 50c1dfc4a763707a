"""Seconds to the first result: each entry point called in a process of its own.

Nearly all of a first call is compilation, so it is timed with and without the programs that an
earlier process left on disk (`JAX_COMPILATION_CACHE_DIR`). The memory maps that it leaves behind
are counted as well, for a process may have no more than so many (`vm.max_map_count` on Linux).
"""

import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxbridge as jb
from jaxbridge.engine.memory_maps import count_maps
from jaxbridge.studies.clock import timed
from jaxbridge.studies.paper import study_model
from jaxbridge.studies.report import Say, Table, silent


class FirstCall(NamedTuple):
    """The first call of an entry point in a process, and the second, in seconds; the first in a
    process that found its programs on disk; programs compiled; memory maps left behind."""

    what: str
    first: float
    again: float
    from_disk: float
    programs: int
    maps: int


def _normal(key, theta):
    return jax.random.normal(key, (2,)) / jnp.sqrt(2 * theta)


@functools.cache
def _full_sigma() -> jb.Diffusion:
    """An Ornstein–Uhlenbeck process seen through a bijection of the plane."""
    return jb.transform(
        study_model(),
        lambda x: jnp.array([x[0], x[1] + jnp.sin(x[0])]),
        lambda y: jnp.array([y[0], y[1] - jnp.sin(y[0])]),
    ).model


def _interval(model: jb.Diffusion) -> tuple[Any, ...]:
    return jax.random.key(0), model, [0.0, 0.0], [0.3, -0.2], 1.0


def _weights(model: jb.Diffusion, proposal: Any) -> Any:
    return jb.sample_weighted_bridges(*_interval(model), num_bridges=1_000, proposal=proposal)


def _chain(method: Any, proposal: Any) -> Any:
    interval = _interval(study_model())
    return jb.sample_exact_bridges(*interval, num_bridges=1_000, method=method, proposal=proposal)


def _density() -> Any:
    return jb.transition_log_density(*_interval(study_model()), proposal="auto")


def _gibbs() -> Any:
    """200 intervals, 500 iterations."""
    times, values = _seen(-np.eye(2), np.arange(201) * 0.5)
    return jb.gibbs(
        jax.random.key(0),
        _pulled(),
        times,
        values,
        prior=jb.NormalPrior(1.0, 1.0),
        num_iterations=500,
        num_steps=10,
        proposal="auto",
    )


@functools.cache
def _pulled() -> jb.Diffusion:
    return jb.Diffusion(
        lambda x, theta: -theta * x,
        log_stationary=lambda x, theta: -theta * x @ x,
        sample_stationary=_normal,
        params=1.0,
        reversible=True,
    )


@functools.cache
def _record() -> dict[str, Any]:
    """A coordinate of two, seen fifty times with noise; its rate, σ and noise are parameters."""
    model = jb.Diffusion(
        lambda x, p: jnp.stack([x[1] - x[0], -x[0] - jnp.exp(p[0]) * x[1]]),
        lambda x, p: jnp.exp(p[1]) * jnp.eye(2, dtype=x.dtype),
        params=jnp.array([0.0, 0.0, -1.0]),
    )
    times, values = _seen(np.array([[-1.0, 1.0], [-1.0, -1.0]]), np.arange(1, 51) * 0.4)
    noise = 0.4 * np.random.default_rng(2).standard_normal((50, 1))
    return {
        "model": model,
        "times": times,
        "observations": values[:, :1] + noise,
        "observation": jb.LinearGaussian([[1.0, 0.0]], lambda p: jnp.exp(2 * p[2])),
        "initial": jb.GaussianLaw([0.0, 0.0], jnp.eye(2)),
        "num_steps": 5,
    }


def _seen(drift: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """dX = BX dt + dW from 0, in Euler steps of NumPy's: data are at hand before a first call
    begins."""
    rng, step, x = np.random.default_rng(1), 0.02, np.zeros(2)
    values = []
    for duration in np.diff(times, prepend=0.0):
        for _ in range(round(duration / step)):
            x = x + step * drift @ x + step**0.5 * rng.standard_normal(2)
        values.append(x)
    return times, np.stack(values)


def _of_record(method: Callable[..., Any], **options: Any) -> Any:
    return method(jax.random.key(0), **_record(), **options)


def _posterior(method: Callable[..., Any]) -> Any:
    prior = jb.NormalPrior(3 * [0.0], 3 * [1.0])
    return _of_record(method, prior=prior, num_iterations=500)


ENTRIES: Mapping[str, Callable[[], Any]] = {
    "`sample_bridges`": lambda: jb.sample_bridges(*_interval(study_model()), num_bridges=1_000),
    "weights, coupling": lambda: _weights(study_model(), jb.Coupling(0.5)),
    'weights, "auto"': lambda: _weights(study_model(), "auto"),
    "chain, pseudo-marginal": lambda: _chain("pseudo_marginal", jb.Coupling(0.5)),
    "chain, renewal": lambda: _chain("renewal", jb.Coupling(0.5)),
    'chain, "auto"': lambda: _chain("pseudo_marginal", "auto"),
    'density, "auto"': _density,
    "full σ(x): weights, coupling": lambda: _weights(_full_sigma(), jb.Coupling(0.5)),
    'full σ(x): weights, "auto"': lambda: _weights(_full_sigma(), "auto"),
    'gibbs, "auto"': _gibbs,
    "a record: `log_likelihood`": lambda: _of_record(jb.log_likelihood),
    "a record: `gibbs`": lambda: _posterior(jb.gibbs),
    "a record: `pmmh`": lambda: _posterior(jb.pmmh),
    "a record: `maximum_likelihood`": lambda: _of_record(jb.maximum_likelihood),
}


def run_first_calls(entries: Sequence[str] = tuple(ENTRIES), say: Say = silent) -> list[FirstCall]:
    """Each in fresh processes: without programs on disk, and with those that one left."""
    rows = []
    for what in entries:
        say(f"first call of {what}")
        with tempfile.TemporaryDirectory() as folder:
            alone = _in_process(what, None)
            _in_process(what, folder)
            from_disk = _in_process(what, folder)
        rows.append(
            FirstCall(
                what,
                alone["first"],
                alone["again"],
                from_disk["first"],
                int(alone["programs"]),
                int(alone["maps"]),
            )
        )
    return rows


def first_calls_table(rows: Sequence[FirstCall]) -> Table:
    """Seconds, programs and maps."""
    titles = ("call", "first, s", "second, s", "first, from disk, s", "programs", "memory maps")
    return titles, [
        (
            r.what,
            f"{r.first:.1f}",
            f"{r.again:.3f}",
            f"{r.from_disk:.1f}",
            f"{r.programs}",
            f"{r.maps}",
        )
        for r in rows
    ]


def _in_process(what: str, cache: str | None) -> dict[str, float]:
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    here = str(Path(__file__).parents[1])
    paths = filter(None, [here, environment.get("PYTHONPATH")])
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    if cache is not None:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
        }
    command = [sys.executable, "-m", __name__, what]
    made = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(made.stdout.splitlines()[-1])


def _measure(what: str) -> dict[str, float]:
    """In this process, which has compiled nothing but a trifle."""
    compiled = []

    def listen(event, *_, **__):
        if event.endswith("backend_compile_duration"):
            compiled.append(event)

    jax.block_until_ready(jnp.sum(jax.random.normal(jax.random.key(0), (3,))))
    jax.monitoring.register_event_duration_secs_listener(listen)
    before = count_maps()
    _, first = timed(ENTRIES[what])
    programs, maps = len(compiled), count_maps() - before
    _, again = timed(ENTRIES[what])
    return {"first": first, "again": again, "programs": programs, "maps": maps}


if __name__ == "__main__":
    print(json.dumps(_measure(sys.argv[1])))
