"""Bridges of published studies of learnt bridges, by this package and by a score that is learnt.

An Ornstein–Uhlenbeck and a radial process, whose transition densities are known, and a model of
cells that differentiate (Wang, Zhang, Xu & Wang 2011), whose density a Fokker–Planck equation
gives. The first two are settings of Heng, De Bortoli, Doucet & Thornton (2021); the third has
less noise and more time than theirs, as in later studies (Baker, Schauer & Sommer 2024). The
learnt bridge is that of Heng et al. in small: the score of the time reversal is fitted to
simulated paths, the bridge is run backwards from its end, and each path is weighted by the Euler
scheme's density over that of its own steps.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Float, Key
from scipy import sparse, stats
from scipy.sparse.linalg import splu

import jaxbridge as jb
from jaxbridge.studies.clock import fastest, timed
from jaxbridge.studies.report import Say

from .peers import NOT_INSTALLED, in_r

RADIAL = 4.0  # of dX = (4/X - X) dt + dW, the norm of a process in nine dimensions
CELL_SIGMA, CELL_HALF = 0.1, 2.0**-4
LIBRARY = 'jaxbridge, "auto"'
LEARNT = "learnt score"


class BridgeTask(NamedTuple):
    """A bridge, in how many steps, and log p_T of its end points by a closed form or a grid."""

    name: str
    model: jb.Diffusion
    sigma: float
    start: tuple[float, ...]
    end: tuple[float, ...]
    duration: float
    num_steps: int
    exact: float


class BridgeRow(NamedTuple):
    """One way to one bridge: the effective share of its paths, log p̂_T, its standard error and
    what it is too large by; seconds of training, of the first call and of one more. `why` says why
    there are no numbers."""

    task: str
    way: str
    share: float | None = None
    log_density: float | None = None
    standard_error: float | None = None
    error: float | None = None
    training: float | None = None
    first: float | None = None
    again: float | None = None
    why: str = ""


def ou_log_density(rate: float, start: float, end: float, duration: float) -> float:
    """Of dX = -rate X dt + dW."""
    mean, variance = start * np.exp(-rate * duration), -np.expm1(-2 * rate * duration) / (2 * rate)
    return float(stats.norm.logpdf(end, mean, np.sqrt(variance)))


def radial_log_density(
    start: float, end: float | Float[np.ndarray, " n"], duration: float
) -> Float[np.ndarray, "*n"]:
    """Of dX = (4/X - X) dt + dW: X² is the squared norm of nine Ornstein–Uhlenbeck processes of
    rate one, so that X_T²/v is noncentral χ² with v = (1 - exp(-2T))/2."""
    variance = -np.expm1(-2 * duration) / 2
    noncentrality = start**2 * np.exp(-2 * duration) / variance
    end = np.asarray(end)
    freedom = 2 * RADIAL + 1
    law = stats.ncx2.logpdf(end**2 / variance, freedom, noncentrality)
    return law + np.log(2 * end / variance)


def cell_log_density(
    start: Sequence[float] = (0.1, -0.1),
    end: Sequence[float] = (2.0, -0.1),
    duration: float = 4.0,
    spacing: float = 0.0125,
    drift: Callable[[Any], Any] | None = None,
) -> tuple[float, float]:
    """log p_T of the cells, or with another drift, by the Fokker–Planck equation, and its error:
    grids of the spacing and of twice that, which have both points, extrapolated; the error is
    what this changes."""
    fine, coarse = (
        _on_grid(drift or cell_drift, start, end, duration, h) for h in (spacing, 2 * spacing)
    )
    return fine + (fine - coarse) / 3, abs(fine - coarse) / 3


def _on_grid(
    drift: Callable[[Any], Any],
    start: Sequence[float],
    end: Sequence[float],
    duration: float,
    spacing: float,
) -> float:
    """Central differences, and Crank and Nicolson's steps after four of half the length that are
    implicit, which damp what the point mass at the start has of high frequencies."""
    low, high = -0.6, 2.7
    line = low + spacing * np.arange(round((high - low) / spacing) + 1)
    n, half = len(line), CELL_SIGMA**2 / 2
    at = [round((x - low) / spacing) * n + round((y - low) / spacing) for x, y in (start, end)]
    x, y = (values.ravel() for values in np.meshgrid(line, line, indexing="ij"))
    ones = np.ones(n - 1)
    up, down = (sparse.diags_array(ones, offsets=k) for k in (1, -1))
    eye = sparse.eye_array(n)
    slope, curve = (up - down) / (2 * spacing), (up + down - 2 * eye) / spacing**2
    speed = drift(np.stack([x, y], axis=-1))
    generator = half * (sparse.kron(curve, eye) + sparse.kron(eye, curve))
    generator -= sparse.kron(slope, eye) @ sparse.diags_array(speed[:, 0])
    generator -= sparse.kron(eye, slope) @ sparse.diags_array(speed[:, 1])
    step = 1.6 * spacing
    num_steps = round(duration / step)
    step = duration / num_steps
    identity = sparse.eye_array(n * n)
    # The half steps that are implicit have the same matrix as the others.
    left = splu((identity - step / 2 * generator).tocsc())
    right = (identity + step / 2 * generator).tocsr()
    density = np.zeros(n * n)
    density[at[0]] = 1 / spacing**2
    for _ in range(4):
        density = left.solve(density)
    for _ in range(num_steps - 2):
        density = left.solve(right @ density)
    return float(np.log(density[at[1]]))


def cell_drift(x: Any) -> Any:
    """Of both kinds of cells, over the last axis, which NumPy and JAX both take."""
    powers = x**4
    return powers / (CELL_HALF + powers) + CELL_HALF / (CELL_HALF + powers[..., ::-1]) - x


def _radial_drift(x: Float[Array, " d"], p: Float[Array, ""]) -> Float[Array, " d"]:
    return p / x - x


def _radial_log_stationary(x: Float[Array, " d"], p: Float[Array, ""]) -> Float[Array, ""]:
    constant = jnp.log(2.0) - jax.scipy.special.gammaln(p + 0.5)
    return jnp.sum(2.0 * p * jnp.log(x) - x**2) + constant


def _positive(x: Float[Array, " d"], p: Float[Array, ""]) -> Any:
    return jnp.all(x > 0)


def _cell_model_drift(x: Float[Array, " d"], p: None) -> Float[Array, " d"]:
    return cell_drift(x)


def radial() -> jb.Diffusion:
    """dX = (4/X - X) dt + dW on the half line."""
    return jb.Diffusion(
        _radial_drift,
        None,
        _radial_log_stationary,
        RADIAL,
        reversible=True,
        normalised=True,
        domain=_positive,
    )


def bridge_tasks(quick: bool) -> list[BridgeTask]:
    """Those of the study; quickly, without the cells."""
    ou, norm = jb.ornstein_uhlenbeck([[2.0]]), radial()
    tasks = [
        BridgeTask(
            "OU, 1 to 1", ou, 1.0, (1.0,), (1.0,), 1.0, 50, ou_log_density(2.0, 1.0, 1.0, 1.0)
        ),
        *(
            BridgeTask(
                f"radial, {a:g} to {b:g}",
                norm,
                1.0,
                (a,),
                (b,),
                1.0,
                50,
                float(radial_log_density(a, b, 1.0)),
            )
            for a, b in ((1.5, 1.0), (1.5, 2.5), (3.0, 4.0))
        ),
    ]
    if quick:
        return tasks[:2]
    cells = jb.Diffusion(_cell_model_drift, CELL_SIGMA * jnp.eye(2))
    exact, _ = cell_log_density()
    ends = ((0.1, -0.1), (2.0, -0.1))
    return [*tasks, BridgeTask("cells", cells, CELL_SIGMA, *ends, 4.0, 100, exact)]


def run_bridges(
    key: Key[Array, ""], quick: bool, num_paths: int, num_iterations: int, say: Say
) -> list[BridgeRow]:
    """All ways to all tasks."""
    rows = []
    networks: dict[Any, tuple[Any, float]] = {}
    for task in bridge_tasks(quick):
        say(f"bridges: {task.name}")
        rows += [_library_row(key, task, num_paths)]
        learnt_from = id(task.model), task.start
        if learnt_from not in networks:
            say(f"bridges: {task.name}, learning a score")
            networks[learnt_from] = timed(lambda task=task: learn_score(key, task, num_iterations))
        rows += [_learnt_row(key, task, *networks[learnt_from], num_paths)]
        rows += _r_rows(task, num_paths)
    return rows


def _library_row(key: Key[Array, ""], task: BridgeTask, num_paths: int) -> BridgeRow:
    ends = jnp.array(task.start), jnp.array(task.end), task.duration

    def run():
        options: dict[str, Any] = {"num_steps": task.num_steps, "proposal": "auto"}
        one, other = jax.random.split(key)
        density = jb.transition_log_density(
            one, task.model, *ends, num_proposals=num_paths, **options
        )
        bridges = jb.sample_weighted_bridges(
            other, task.model, *ends, num_bridges=num_paths, **options
        )
        return density, bridges

    (density, bridges), first = timed(run)
    _, again = fastest(run)
    chosen = ""
    if isinstance(bridges.proposal, jb.Choice):
        chosen = bridges.proposal.candidates[int(bridges.proposal.chosen[0])].describe()
    value = float(density.value)
    return BridgeRow(
        task.name,
        f"{LIBRARY}: {chosen}",
        float(bridges.effective_sample_size) / num_paths,
        value,
        float(density.standard_error),
        value - task.exact,
        None,
        first,
        again,
    )


class Score(eqx.Module):
    """∇log p_t(x_0, x), up to σ: a pull to x_0, and what a network adds to it."""

    network: eqx.nn.MLP
    start: Float[Array, " d"]
    sigma: float = eqx.field(static=True)
    duration: float = eqx.field(static=True)

    def __call__(self, t: Float[Array, ""], x: Float[Array, " d"]) -> Float[Array, " d"]:
        angle = t / self.duration * 2.0 ** jnp.arange(4.0)
        seen = jnp.concatenate([x, t[None], jnp.sin(angle), jnp.cos(angle)])
        pull = (self.start - x) / (self.sigma**2 * t)
        return pull + self.network(seen) / self.sigma


def learn_score(
    key: Key[Array, ""],
    task: BridgeTask,
    num_iterations: int = 1_000,
    batch: int = 100,
    rate: float = 0.01,
    average: float = 0.99,
) -> Score:
    """The score of the time reversal, by denoising score matching: two hidden layers of 128, Adam
    at a rate of 0.01, batches of 100 paths of the diffusion, weights averaged over iterations, as
    in Heng et al. (2021)."""
    start = jnp.array(task.start)
    network = eqx.nn.MLP(len(task.start) + 9, len(task.start), 128, 2, jax.nn.silu, key=key)
    score = Score(network, start, task.sigma, task.duration)
    weights, rest = eqx.partition(score.network, eqx.is_array)
    optimiser = optax.adam(rate)
    step = task.duration / task.num_steps
    times = step * jnp.arange(1.0, task.num_steps + 1.0)

    def path(key):
        """Euler's points, and the noise of the steps that led to them."""
        noise = jax.random.normal(key, (task.num_steps, start.size))

        def forward(x, z):
            x = x + step * task.model.drift(x) + task.sigma * step**0.5 * z
            return x, x

        return lax.scan(forward, start, noise)[1], noise

    def loss(weights, key):
        learnt = eqx.tree_at(lambda s: s.network, score, eqx.combine(weights, rest))
        points, noise = jax.vmap(path)(jax.random.split(key, batch))
        found = jax.vmap(jax.vmap(learnt), (None, 0))(times, points)
        gap = task.sigma * found + noise / step**0.5
        return step * jnp.sum(jnp.mean(gap**2, axis=0))

    def iterate(carry, key):
        weights, state, mean = carry
        updates, state = optimiser.update(jax.grad(loss)(weights, key), state, weights)
        weights = eqx.apply_updates(weights, updates)
        mean = jax.tree.map(lambda m, w: average * m + (1.0 - average) * w, mean, weights)
        return (weights, state, mean), None

    @jax.jit
    def train(weights, key):
        keys = jax.random.split(key, num_iterations)
        carry = weights, optimiser.init(weights), weights
        return lax.scan(iterate, carry, keys)[0][2]

    with jax.numpy_dtype_promotion("standard"):  # Adam raises a number to a whole one
        learnt = train(weights, jax.random.fold_in(key, 1))
    return eqx.tree_at(lambda s: s.network, score, eqx.combine(learnt, rest))


@eqx.filter_jit
def learnt_bridges(
    key: Key[Array, ""], score: Score, task: BridgeTask, num_paths: int
) -> tuple[Float[Array, "n N+1 d"], Float[Array, " n"]]:
    """Paths from the end backwards by the score, and the logs of their weights: unbiased for the
    transition density of the Euler scheme's chain. The variance of a step is cut by what is left of
    the time, as of a bridge."""
    step = task.duration / task.num_steps
    start, end = jnp.array(task.start), jnp.array(task.end)
    variance = task.sigma**2 * step

    def log_normal(gap, variance):
        return -jnp.sum(gap**2 / variance + jnp.log(2.0 * jnp.pi * variance)) / 2.0

    def backward(x, step_and_noise):
        m, noise = step_and_noise
        t = step * m
        mean = x + step * (task.sigma**2 * score(t, x) - task.model.drift(x))
        cut = variance * (m - 1.0) / m
        before = jnp.where(m > 1.0, mean + jnp.sqrt(cut) * noise, start)
        proposed = jnp.where(m > 1.0, log_normal(before - mean, jnp.maximum(cut, 1e-12)), 0.0)
        gained = log_normal(x - before - step * task.model.drift(before), variance) - proposed
        return before, (before, gained)

    def one(key):
        noise = jax.random.normal(key, (task.num_steps, start.size))
        _, (points, gained) = lax.scan(
            backward, end, (jnp.arange(float(task.num_steps), 0.0, -1.0), noise)
        )
        return jnp.concatenate([end[None], points])[::-1], jnp.sum(gained)

    return jax.vmap(one)(jax.random.split(key, num_paths))


def _learnt_row(
    key: Key[Array, ""], task: BridgeTask, score: Score, training: float, num_paths: int
) -> BridgeRow:
    run = lambda: learnt_bridges(key, score, task, num_paths)
    (_, logs), first = timed(run)
    _, again = fastest(run)
    logs = np.asarray(logs, float)
    logs = np.where(np.isfinite(logs), logs, -np.inf)
    weights = np.exp(logs - logs.max())
    mean = weights.mean()
    value = float(np.log(mean) + logs.max())
    error = float(weights.std(ddof=1) / np.sqrt(num_paths) / mean)
    share = float(weights.sum() ** 2 / (weights**2).sum() / num_paths)
    return BridgeRow(
        task.name, LEARNT, share, value, error, value - task.exact, training, first, again
    )


# In R a second call costs as much as a first. What is approximate has no weights, and so neither an
# effective share nor a density: the mean half way is all that is compared.
_DBRIDGE = """
suppressMessages(library(sde)); set.seed(0)
took <- system.time(x <- replicate({n}, as.numeric(
  DBridge(x=1, y=1, t0=0, T=1, N={steps}, drift=expression(-2*x), sigma=expression(1))
)[{half}]))
cat("seconds", took[["elapsed"]], "\\nmean", mean(x), "\\nsd", sd(x), "\\n")
"""
_BRIDGESDE = """
suppressMessages(library(Sim.DiffProc)); set.seed(0)
took <- system.time(made <- bridgesde1d(drift=expression(-2*x), diffusion=expression(1),
  x0=1, y=1, t0=0, T=1, N={steps}, M={n}))
x <- made$X[{half},]
cat("seconds", took[["elapsed"]], "\\nmean", mean(x), "\\nsd", sd(x), "\\n")
"""


def _r_rows(task: BridgeTask, num_paths: int) -> list[BridgeRow]:
    """Of the Ornstein–Uhlenbeck process, for which both were made."""
    if not task.name.startswith("OU"):
        return []
    numbers = {"n": num_paths, "steps": task.num_steps, "half": task.num_steps // 2 + 1}
    scripts = {
        "sde (R), DBridge": ("sde", _DBRIDGE),
        "Sim.DiffProc (R), bridgesde1d": ("Sim.DiffProc", _BRIDGESDE),
    }
    rows = []
    for way, (package, script) in scripts.items():
        made = in_r(package, script.format(**numbers))
        if made is None:
            rows.append(BridgeRow(task.name, way, why=NOT_INSTALLED))
            continue
        gap = made["mean"] - 1 / np.cosh(1.0)  # the exact mean of the bridge from 1 to 1 half way
        why = f"error of the mean half way {gap:+.3f} ± {made['sd'] / np.sqrt(num_paths):.3f}"
        rows.append(BridgeRow(task.name, way, first=made["seconds"], again=None, why=why))
    return rows
