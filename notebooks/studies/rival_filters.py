"""Particle filters of records that were seen with noise and in part, each with as many particles.

Three records: a rotating Ornstein–Uhlenbeck process of which one coordinate is seen, whose
likelihood Kalman's filter has; a double well, whose likelihood a filter on a grid has; and prey and
predators (Lotka and Volterra's reactions by the chemical Langevin equation; Golightly & Wilkinson
2008) of which the prey is seen. The peers, particles (Chopin & Papaspiliopoulos 2020) and cuthbert,
are frameworks: what moves particles is the user's. Here that is Euler's scheme (bootstrap), or the
same steps bent towards the next observation (guided; Golightly & Wilkinson 2008; Whitaker,
Golightly, Boys & Sherlock 2017), once for NumPy and JAX.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key
from scipy import linalg, stats

import jaxbridge as jb
from jaxbridge.studies.clock import fastest, timed
from jaxbridge.studies.report import Say

from .peers import where_installed

NUM_STEPS = 10
LIBRARY = "jaxbridge, `log_likelihood`"
KALMAN = "Kalman filter, by hand in NumPy"
_ROTATION = np.array([[1.0, 1.5], [-1.0, 0.5]])
_RATES = 0.5, 0.0025, 0.3
_WELL_SIGMA = 0.7
_LINEAR = "OU, one of two observed"


class Record(NamedTuple):
    """A record of the first coordinate, with noise of standard deviation `noise`, at equal gaps
    from a known start; the functions of its diffusion, over the last axes, for NumPy and JAX; and
    log p(y), where it is known."""

    name: str
    drift: Callable[[Any], Any]
    variance: Callable[[Any], Any]
    constant: bool
    start: tuple[float, ...]
    gap: float
    noise: float
    values: Float[np.ndarray, " n"]
    exact: float | None


class FilterRow(NamedTuple):
    """One filter of one record: log p̂(y) of the mean over repeats and its standard error, what it
    is too large by, the standard deviation of one log p̂, seconds of the first call and of one
    filter. `why` says why there are no numbers."""

    record: str
    way: str
    log_likelihood: float | None = None
    standard_error: float | None = None
    error: float | None = None
    sd: float | None = None
    first: float | None = None
    seconds: float | None = None
    why: str = ""


def _ou_drift(x: Any) -> Any:
    return -x @ x.__array_namespace__().asarray(_ROTATION.T, dtype=x.dtype)


def _unit_variance(x: Any) -> Any:
    return x.__array_namespace__().eye(2, dtype=x.dtype)


def _well_drift(x: Any) -> Any:
    return 2.0 * (x - x**3)


def _well_variance(x: Any) -> Any:
    return x.__array_namespace__().full((1, 1), _WELL_SIGMA**2, dtype=x.dtype)


def _hazards(x: Any) -> tuple[Any, Any, Any]:
    """Births of prey, predation, deaths of predators; never below a number that keeps variances
    positive."""
    xp = x.__array_namespace__()
    prey, predators = (xp.clip(x[..., i], 1e-3, None) for i in range(2))
    return _RATES[0] * prey, _RATES[1] * prey * predators, _RATES[2] * predators


def _predation_drift(x: Any) -> Any:
    born, eaten, dead = _hazards(x)
    return x.__array_namespace__().stack([born - eaten, eaten - dead], axis=-1)


def _predation_variance(x: Any) -> Any:
    xp = x.__array_namespace__()
    born, eaten, dead = _hazards(x)
    rows = [[born + eaten, -eaten], [-eaten, eaten + dead]]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def records(quick: bool) -> list[Record]:
    """Those of the study, simulated in a hundred Euler steps a gap; quickly, the first."""
    scenes = [
        Record(_LINEAR, _ou_drift, _unit_variance, True, (0.0, 0.0), 0.5, 0.1,
               np.empty(50), None),
        Record("double well", _well_drift, _well_variance, True, (1.0,), 0.5, 0.1,
               np.empty(50), None),
        Record("prey and predators", _predation_drift, _predation_variance, False, (71.0, 79.0),
               1.0, 5.0, np.empty(40), None),
    ]  # fmt: skip
    scenes = [_simulated(scene) for scene in scenes[: 1 if quick else 3]]
    exact = (kalman_log_likelihood, well_log_likelihood)
    known = [s._replace(exact=f(s)) for s, f in zip(scenes, exact, strict=False)]
    return known + scenes[len(known) :]


def _simulated(record: Record, seed: int = 2) -> Record:
    rng, x, steps = np.random.default_rng(seed), np.array(record.start), 100
    values = np.empty(len(record.values))
    for i in range(len(values)):
        for _ in range(steps):
            x = euler_step(record, x, record.gap / steps, rng.normal(size=x.shape))
        values[i] = x[0] + record.noise * rng.normal()
    return record._replace(values=values)


def lower_root(variance: Any) -> Any:
    """Cholesky's root by hand, over the last axes: batched LAPACK has no place in a loop."""
    xp = variance.__array_namespace__()
    first = xp.sqrt(variance[..., 0, 0])
    if variance.shape[-1] == 1:
        return first[..., None, None]
    below = variance[..., 1, 0] / first
    rows = [[first, 0 * first], [below, xp.sqrt(variance[..., 1, 1] - below**2)]]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def _times(root: Any, z: Any) -> Any:
    return (root @ z[..., None])[..., 0]


def _log_normal(gap: Any, root: Any) -> Any:
    """log N(gap; 0, root rootᵀ), but for the constant of π, which cancels where it is used."""
    xp = gap.__array_namespace__()
    z = gap[..., 0] / root[..., 0, 0]
    log = -(z**2) / 2 - xp.log(root[..., 0, 0])
    if gap.shape[-1] == 1:
        return log
    z = (gap[..., 1] - root[..., 1, 0] * z) / root[..., 1, 1]
    return log - z**2 / 2 - xp.log(root[..., 1, 1])


def euler_step(record: Record, x: Any, step: float, normal: Any) -> Any:
    """One of Euler's steps."""
    return x + step * record.drift(x) + step**0.5 * _times(lower_root(record.variance(x)), normal)


def guided_step(record: Record, x: Any, y: Any, left: Any, step: float, normal: Any) -> Any:
    """One of Euler's steps, given y as if drift and variance stayed as they are for the time that
    is `left` until then; and the log of Euler's density over that of this step."""
    drift, variance = record.drift(x), record.variance(x)
    toward = variance[..., :, 0]
    gain = toward / (variance[..., 0, 0] * left + record.noise**2)[..., None]
    miss = y - x[..., 0] - left * drift[..., 0]
    mean = step * (drift + gain * miss[..., None])
    bent = variance - step * gain[..., :, None] * toward[..., None, :]
    root, bent_root = step**0.5 * lower_root(variance), step**0.5 * lower_root(bent)
    moved = mean + _times(bent_root, normal)
    log_ratio = _log_normal(moved - step * drift, root) - _log_normal(moved - mean, bent_root)
    return x + moved, log_ratio


def kalman_log_likelihood(record: Record) -> float:
    """Of the rotating process, with exact transitions."""
    d = len(record.start)
    transition = linalg.expm(-_ROTATION * record.gap)
    # V solves B V + V Bᵀ = I; what a gap adds is V less what is left of it.
    stationary = linalg.solve_continuous_lyapunov(_ROTATION, np.eye(d))
    added = stationary - transition @ stationary @ transition.T
    mean, covariance, log = np.array(record.start), np.zeros((d, d)), 0.0
    for y in record.values:
        mean = transition @ mean
        covariance = transition @ covariance @ transition.T + added
        variance = covariance[0, 0] + record.noise**2
        log += float(stats.norm.logpdf(y, mean[0], np.sqrt(variance)))
        gain = covariance[:, 0] / variance
        mean = mean + gain * (y - mean[0])
        covariance = covariance - np.outer(gain, covariance[0])
    return log


def well_log_likelihood(record: Record) -> float:
    """Of the double well, on a grid and on one of half the spacing, extrapolated."""
    fine, coarse = (_on_grid(record, n) for n in (601, 301))
    return fine + (fine - coarse) / 3


def _on_grid(record: Record, n: int) -> float:
    line = np.linspace(-3, 3, n)
    h = line[1] - line[0]
    half = _WELL_SIGMA**2 / 2
    drift = _well_drift(line)
    generator = np.diag(half / h**2 - drift[1:] / (2 * h), 1)
    generator += np.diag(half / h**2 + drift[:-1] / (2 * h), -1)
    generator -= np.diag(np.full(n, 2 * half / h**2))
    over_gap = linalg.expm(generator * record.gap)
    density = np.zeros(n)
    density[np.argmin(np.abs(line - record.start[0]))] = 1 / h
    log = 0.0
    for y in record.values:
        density = (over_gap @ density) * stats.norm.pdf(y, line, record.noise)
        mass = h * density.sum()
        log += float(np.log(mass))
        density /= mass
    return log


def run_filters(
    key: Key[Array, ""], quick: bool, num_particles: int, num_filters: int, say: Say
) -> list[FilterRow]:
    """All filters of all records."""
    rows = []
    for record in records(quick):
        say(f"filters: {record.name}, here")
        rows.append(_library_row(key, record, num_particles, num_filters))
        if record.name == _LINEAR:
            value, seconds = timed(functools.partial(kalman_log_likelihood, record))
            rows.append(FilterRow(record.name, KALMAN, value, 0.0, 0.0, 0.0, seconds, seconds))
        for modules, run in (
            (("cuthbert.filtering", "cuthbert.smc.particle_filter",
              "cuthbertlib.resampling.systematic", "cuthbertlib.resampling.adaptive"), _cuthbert),
            (("particles",), _particles),
        ):  # fmt: skip
            peer = modules[0].split(".")[0]
            say(f"filters: {record.name}, {peer}")
            run = functools.partial(run, key, record, num_particles, num_filters)
            missing = lambda why, record=record, peer=peer: [FilterRow(record.name, peer, why=why)]
            rows += where_installed(modules, run, missing)
    return rows


def row_of(record: Record, way: str, logs: Any, first: float, seconds: float) -> FilterRow:
    """The mean of estimates that are unbiased on the natural scale, and their spread."""
    logs = np.asarray(logs, float)
    top = logs.max()
    weights = np.exp(logs - top)
    value = float(top + np.log(weights.mean()))
    error = float(weights.std(ddof=1) / np.sqrt(len(logs)) / weights.mean())
    gap = None if record.exact is None else value - record.exact
    return FilterRow(
        record.name, way, value, error, gap, float(logs.std(ddof=1)), first, seconds / len(logs)
    )


def library_model(record: Record) -> jb.Diffusion:
    """The diffusion of a record, as this package takes it."""
    if record.constant:
        d = len(record.start)
        sigma = np.asarray(lower_root(record.variance(np.zeros(d))))
        return jb.Diffusion(lambda x, p: record.drift(x), sigma)
    return jb.Diffusion(lambda x, p: record.drift(x), lambda x, p: lower_root(record.variance(x)))


def _library_row(
    key: Key[Array, ""], record: Record, num_particles: int, num_filters: int
) -> FilterRow:
    model = library_model(record)
    seen = jb.LinearGaussian(np.eye(len(record.start))[:1], covariance=record.noise**2)
    times = record.gap * np.arange(1, len(record.values) + 1)

    def run():
        return jb.log_likelihood(
            key,
            model,
            times,
            record.values[:, None],
            observation=seen,
            initial=jnp.array(record.start),
            initial_time=0.0,
            num_particles=num_particles,
            num_filters=num_filters,
            num_steps=NUM_STEPS,
        )

    made, first = timed(run)
    _, again = fastest(run)
    return row_of(record, LIBRARY, made.log_estimates, first, again)


def _cuthbert(
    key: Key[Array, ""],
    record: Record,
    num_particles: int,
    num_filters: int,
    filtering: Any,
    particle_filter: Any,
    systematic: Any,
    adaptive: Any,
) -> list[FilterRow]:
    """A particle is a point, and what its last steps weigh."""
    step, values = record.gap / NUM_STEPS, jnp.asarray(record.values, float)
    left = record.gap - step * jnp.arange(float(NUM_STEPS))
    start = jnp.array(record.start)
    resampling = adaptive.ess_decorator(systematic.resampling, 0.5)

    def bootstrap(x, y, left, normal):
        return euler_step(record, x, step, normal), jnp.zeros(())

    def guided(x, y, left, normal):
        return guided_step(record, x, y, left, step, normal)

    rows = []
    for way, move in (("bootstrap", bootstrap), ("guided", guided)):

        def propagate(key, particle, y, move=move):
            noise = jax.random.normal(key, (NUM_STEPS, start.size))

            def forward(x, given):
                return move(x, y, *given)

            x, ratios = lax.scan(forward, particle[0], (left, noise))
            return x, jnp.sum(ratios)

        def log_potential(before, particle, y):
            x, ratio = particle
            return ratio + jax.scipy.stats.norm.logpdf(y, x[0], record.noise)

        made = particle_filter.build_filter(
            lambda key: (start, jnp.zeros(())),
            propagate,
            log_potential,
            num_particles,
            resampling,
        )

        @jax.jit
        def run(keys, made=made):
            def one(key):
                first, second = jax.random.split(key)
                states = filtering.filter(made, values, made.init_prepare(key=first), key=second)
                return states.log_normalizing_constant[-1]

            return jax.vmap(one)(keys)

        keys = jax.random.split(key, num_filters)
        logs, first = timed(lambda run=run, keys=keys: run(keys))
        _, again = fastest(lambda run=run, keys=keys: run(keys))
        rows.append(row_of(record, f"cuthbert, {way}", logs, first, again))
    return rows


def _particles(
    key: Key[Array, ""], record: Record, num_particles: int, num_filters: int, particles: Any
) -> list[FilterRow]:
    """The last column of a particle is what its last steps weigh. It draws from NumPy's own
    generator, which is put back."""
    step, d = record.gap / NUM_STEPS, len(record.start)

    class Path(particles.FeynmanKac):
        def __init__(self, guided: bool):
            super().__init__(len(record.values))
            self.guided = guided

        def M0(self, N):
            return self.M(0, np.tile([*record.start, 0.0], (N, 1)))

        def M(self, t, xp):
            x, log = xp[:, :d], np.zeros(len(xp))
            for k in range(NUM_STEPS):
                normal = np.random.normal(size=x.shape)  # noqa: NPY002
                if self.guided:
                    left = np.asarray(record.gap - step * k)
                    x, ratio = guided_step(record, x, record.values[t], left, step, normal)
                    log += ratio
                else:
                    x = euler_step(record, x, step, normal)
            return np.column_stack([x, log])

        def logG(self, t, xp, x):
            return x[:, d] + stats.norm.logpdf(record.values[t], x[:, 0], record.noise)

    def run(path):
        made = particles.SMC(fk=path, N=num_particles)
        made.run()
        return made.logLt

    rows, state = [], np.random.get_state()  # noqa: NPY002
    np.random.seed(int(jax.random.randint(key, (), 0, 2**31 - 1)))  # noqa: NPY002
    for way, is_guided in (("bootstrap", False), ("guided", True)):
        path = Path(is_guided)
        _, first = timed(lambda path=path: run(path))
        logs, seconds = timed(lambda path=path: [run(path) for _ in range(num_filters)])
        rows.append(row_of(record, f"particles, {way}", logs, first, seconds))
    np.random.set_state(state)  # noqa: NPY002
    return rows
