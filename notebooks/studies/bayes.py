"""The paper's Bayesian example (section 4), approximate and exact.

The two-dimensional hyperbolic diffusion with α = 0.8, 1000 unit intervals, a N(1, 1) prior. With
σ = I and drift ∇A the transition density is an expectation over Brownian bridges,

    p_T(a, b) = N(b - a; 0, T I) e^{A(b) - A(a)} E[exp(-½ ∫ (|∇A|² + ΔA) dt)],

which gives the exact posterior by plain Monte Carlo, without any of the methods to be tested. A
second example has 200 observations so far apart that they are nearly independent draws from ν:
there Brownian bridges are useless, and the exact likelihood is that of ν.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float, Key

import jaxbridge as jb
from jaxbridge.studies.clock import fastest, timed
from jaxbridge.studies.report import Say, Study, silent, table

ALPHA = 0.8
PRIOR_MEAN, PRIOR_VARIANCE = 1.0, 1.0
_GRID = np.linspace(0.3, 1.5, 241)
_BRIDGE_STEPS, _BATCH = 50, 50
# Of the chain, before the draws that are used.
_BURN_IN = 100


class Data(NamedTuple):
    """Observations at times 0, T, 2T, ..."""

    times: Float[Array, " points"]
    observations: Float[Array, "points 2"]


class ExactPosterior(NamedTuple):
    """Density on a grid of α, with mean, standard deviation, and the error of the mean."""

    grid: Float[np.ndarray, " m"]
    density: Float[np.ndarray, " m"]
    likelihood: Float[np.ndarray, " m"]
    mean: float
    sd: float
    error: float


class Sampled(NamedTuple):
    """A sampler's draws, how long they took, and how long compilation and the start took; the
    paths of an iteration in the second and the last quarter."""

    name: str
    draws: Float[np.ndarray, " n"]
    effective: float
    seconds: float
    start_seconds: float
    bridges_moved: float
    num_missing: int
    num_simulated: tuple[float, float]


class Example(NamedTuple):
    """One data set with its exact posterior and what samplers make of it."""

    name: str
    num_intervals: int
    duration: float
    exact: ExactPosterior
    sampled: list[Sampled]
    floor: float


def hyperbolic_data(key: Key[Array, ""], num_intervals: int, duration: float) -> Data:
    """From the stationary law on, by diffrax."""
    model = jb.hyperbolic(ALPHA, 2)
    start_key, path_key = jax.random.split(key)
    times = jnp.arange(num_intervals + 1, dtype=jnp.float32) * duration
    start = model.sample_stationary(start_key)
    return Data(times, jb.simulate(path_key, model, start, times, num_paths=1)[0])


def brownian_posterior(key: Key[Array, ""], data: Data, num_bridges: int) -> ExactPosterior:
    """By Monte Carlo over Brownian bridges, the same for all α; the error from two halves."""
    halves = [
        _brownian_log_likelihood(half_key, data, num_bridges // 2)
        for half_key in jax.random.split(key)
    ]
    both = logsumexp(jnp.stack(halves), axis=0) - math.log(2)
    means = [_posterior(np.asarray(half.sum(0), float)).mean for half in halves]
    exact = _posterior(np.asarray(both.sum(0), float))
    return exact._replace(error=abs(means[0] - means[1]) / 2)


@functools.partial(jax.jit, static_argnums=2)
def _brownian_log_likelihood(
    key: Key[Array, ""], data: Data, num_bridges: int
) -> Float[Array, "intervals m"]:
    """log p_T(a, b) for each α on the grid, up to what does not depend on it.

    With A = -αF, F = √(1+|x|²): ∫ |∇A|² = α² I_1 and ∫ ΔA = -α I_2.
    """
    alpha = jnp.asarray(_GRID, jnp.float32)
    start, end = data.observations[:-1], data.observations[1:]
    duration = jnp.diff(data.times)[:, None]
    fractions = jnp.linspace(0, 1, _BRIDGE_STEPS + 1)

    def integrals(key):
        shape = (_BRIDGE_STEPS, _BATCH, *start.shape)
        steps = jax.random.normal(key, shape) * jnp.sqrt(duration / _BRIDGE_STEPS)
        walk = jnp.concatenate([jnp.zeros((1, *shape[1:])), jnp.cumsum(steps, axis=0)])
        t = fractions[:, None, None, None]
        path = start + t * (end - start) + walk - t * walk[-1]
        square = jnp.sum(path**2, axis=-1)
        F = jnp.sqrt(1 + square)
        integrand = jnp.stack([square / F**2, (1 + F**2) / F**3])
        trapezoid = (integrand[:, 1:] + integrand[:, :-1]).sum(1) / 2
        return trapezoid * duration[:, 0] / _BRIDGE_STEPS  # (2, batch, intervals)

    def one_batch(total, key):
        I_1, I_2 = integrals(key)
        exponents = (alpha[:, None, None] * I_2 - alpha[:, None, None] ** 2 * I_1) / 2
        return jnp.logaddexp(total, logsumexp(exponents, axis=1)), None

    total = jnp.full((len(alpha), len(start)), -jnp.inf)
    total, _ = lax.scan(one_batch, total, jax.random.split(key, num_bridges // _BATCH))
    F = jnp.sqrt(1 + jnp.sum(data.observations**2, axis=1))
    return (total - alpha[:, None] * jnp.diff(F)).T - math.log(num_bridges // _BATCH * _BATCH)


def stationary_posterior(data: Data) -> ExactPosterior:
    """As if the observations were independent draws from ν: for intervals so long that the process
    forgets where it started. The spectral gap is α²/2, so what is left is about e^{-α²T/2}."""
    x = data.observations[1:]

    def log_likelihood(alpha):
        return jnp.sum(jax.vmap(jb.hyperbolic(alpha, 2).log_stationary)(x))

    values = lax.map(log_likelihood, jnp.asarray(_GRID, jnp.float32))
    return _posterior(np.asarray(values, float))


def _posterior(log_likelihood: Float[np.ndarray, " m"]) -> ExactPosterior:
    spacing = _GRID[1] - _GRID[0]

    def normalised(log_density):
        density = np.exp(log_density - log_density.max())
        return density / density.sum() / spacing

    log_prior = -((_GRID - PRIOR_MEAN) ** 2) / (2 * PRIOR_VARIANCE)
    density = normalised(log_likelihood + log_prior)
    mean = float((density * _GRID).sum() * spacing)
    sd = float(np.sqrt((density * (_GRID - mean) ** 2).sum() * spacing))
    return ExactPosterior(_GRID, density, normalised(log_likelihood), mean, sd, 0.0)


def run_sampler(
    key: Key[Array, ""], name: str, data: Data, num_iterations: int, **options: Any
) -> Sampled:
    """Gibbs sampling from a prior draw on, in two halves: the second goes on from the state of the
    first, whose time has the compilation in it."""
    drawn = PRIOR_MEAN + math.sqrt(PRIOR_VARIANCE) * jax.random.normal(jax.random.key(1), (20,))
    state: Any = drawn[jnp.argmax(is_ergodic(drawn))]
    prior = jb.NormalPrior(PRIOR_MEAN, PRIOR_VARIANCE)
    halves: list[jb.GibbsPosterior] = []
    seconds = []
    for half_key in jax.random.split(key):
        half, took = timed(
            lambda key=half_key, state=state: jb.gibbs(
                key,
                jb.hyperbolic(1.0, 2),
                data.times,
                data.observations,
                prior=prior,
                constraint=is_ergodic,
                num_iterations=num_iterations // 2,
                init=state,
                **options,
            )
        )
        assert isinstance(half, jb.GibbsPosterior)
        state = half.state
        seconds.append(took)
        halves.append(half)

    def both(leaf: Callable[[jb.GibbsPosterior], Array]) -> Float[np.ndarray, " n"]:
        return np.concatenate([np.asarray(leaf(half), float) for half in halves])

    draws = both(lambda half: half.theta[:, 0])[min(_BURN_IN, num_iterations // 10) :]
    quarter = max(num_iterations // 4, 1)
    work = both(lambda half: half.num_simulated)
    return Sampled(
        name,
        draws,
        float(jb.effective_sample_size(draws)),
        2 * seconds[1],
        seconds[0] - seconds[1],
        float(both(lambda half: half.bridges_moved).mean()),
        int(both(lambda half: half.num_missing).sum()),
        (work[quarter : 2 * quarter].mean(), work[-quarter:].mean()),
    )


def is_ergodic(alpha: Array) -> Array:
    """The hyperbolic diffusion is ergodic for α > 0."""
    return alpha > 0


def time_of_numbers(
    key: Key[Array, ""], num_intervals: int, num_steps: int, num_iterations: int
) -> float:
    """Seconds to draw the normal numbers of one path for each interval in each iteration."""

    @jax.jit
    def draw(key):
        def one(total, key):
            return total + jax.random.normal(key, (num_steps, 2, num_intervals)).sum(), None

        return lax.scan(one, jnp.float32(0), jax.random.split(key, num_iterations))[0]

    return fastest(lambda: draw(key))[1]


SAMPLERS: dict[str, dict[str, Any]] = {
    "approximate, gamma = 0.5, Euler": dict(
        bridges="approximate", proposal=jb.Coupling(0.5, scheme=jb.Euler()), num_steps=50
    ),
    "exact, coupling": dict(proposal=jb.Coupling(0.5), num_steps=50),
    "exact, coupling, N = 12": dict(proposal=jb.Coupling(0.5), num_steps=12),
    'exact, "auto"': dict(proposal="auto", num_steps=50),
    'exact, "auto", N = 12': dict(proposal="auto", num_steps=12),
}


# On data sets after the first, for the shift alone.
_AGAIN = ("approximate, gamma = 0.5, Euler", "exact, coupling, N = 12", 'exact, "auto", N = 12')

# Of distant observations.
DISTANT = {
    "exact, coupling": dict(proposal=jb.Coupling(0.0)),
    'exact, "auto"': dict(proposal="auto"),
}


def run_bayes(
    key: Key[Array, ""],
    scale: float = 1.0,
    num_data_sets: int = 1,
    say: Say = silent,
) -> list[Example]:
    """The paper's example on simulated data sets, with all samplers on the first, and the one of
    distant observations; `scale` shortens the chains, and the data where it is small."""
    num_iterations = max(200, round(5_000 * scale))
    num_intervals = 1_000 if scale > 0.1 else 100
    examples = []
    for i in range(num_data_sets):
        data_key, exact_key, run_key = jax.random.split(jax.random.fold_in(key, i), 3)
        data = hyperbolic_data(data_key, num_intervals, 1.0)
        say("Brownian bridges")
        exact = brownian_posterior(exact_key, data, max(200, round(4_000 * scale)))
        sampled = []
        for name in SAMPLERS if i == 0 else _AGAIN:
            say(f"data set {i + 1}: {name}")
            options = SAMPLERS[name]
            sampled.append(run_sampler(run_key, name, data, num_iterations, **options))
        floor = time_of_numbers(run_key, num_intervals, 50, num_iterations)
        examples.append(Example(f"data set {i + 1}", num_intervals, 1.0, exact, sampled, floor))
    examples.append(_distant(jax.random.fold_in(key, 1_000), num_iterations, scale, say))
    return examples


def _distant(key, num_iterations, scale, say) -> Example:
    """Observations 20 units of time apart."""
    num_intervals, duration, num_steps = (200 if scale > 0.1 else 20), 20.0, 200
    data_key, run_key = jax.random.split(key)
    data = hyperbolic_data(data_key, num_intervals, duration)
    num_iterations = num_iterations // 5
    sampled = []
    for name, options in DISTANT.items():
        say(f"far apart: {name}")
        options = dict(options, num_steps=num_steps)
        sampled.append(run_sampler(run_key, name, data, num_iterations, **options))
    floor = time_of_numbers(run_key, num_intervals, num_steps, num_iterations)
    exact = stationary_posterior(data)
    return Example("far apart", num_intervals, duration, exact, sampled, floor)


def format_bayes(examples: Sequence[Example]) -> str:
    """For each example posterior mean and standard deviation beside the exact ones, and what they
    cost."""
    return "\n\n".join(map(_format_example, examples))


def _format_example(example: Example) -> str:
    exact = example.exact
    titles = ("", "mean", "shift / sd", "sd / exact", "worth", "moved", "seconds", "start")
    rows = [("exact posterior", f"{exact.mean:.4f} +- {exact.error:.4f}", *[""] * 8)]
    for each in example.sampled:
        mean, sd = each.draws.mean(), each.draws.std()
        error = sd / math.sqrt(max(each.effective, 1))
        shift, shift_error = (
            (mean - exact.mean) / exact.sd,
            math.hypot(error, exact.error) / exact.sd,
        )
        rows.append(
            (
                each.name,
                f"{mean:.4f} +- {error:.4f}",
                f"{shift:+.3f} +- {shift_error:.3f}",
                f"{sd / exact.sd:.3f}",
                f"{each.effective:.0f}",
                f"{each.bridges_moved:.2f}",
                f"{each.seconds:.1f}",
                f"{each.start_seconds:.1f}",
                f"{each.seconds / example.floor:.1f}",
                " ".join(f"{paths:6.0f}" for paths in each.num_simulated),
            )
        )
    return (
        f"{example.name}: {example.num_intervals} intervals of {example.duration:g}, "
        f"exact posterior sd {exact.sd:.4f}\n"
        + table((*titles, "/numbers", "paths, 2nd and last"), rows)
    )


BAYES = Study(
    "Bayesian estimation of the hyperbolic diffusion",
    lambda key, quick, say: run_bayes(key, *((0.04, 1) if quick else (1.0, 3)), say),
    format_bayes,
    """\
"shift / sd" is the distance from the exact posterior mean in posterior standard deviations, with
its Monte Carlo error; "worth" is the effective number of draws, "moved" the share of bridges
that an iteration replaces. "seconds" are without "start", the seconds of compilation and of pilot
runs; "/numbers" is in multiples of the time to draw one path's numbers for each interval and
iteration; "paths" are those of an iteration in the second and in the last quarter of the run. The
exact posterior is by Brownian bridges; where observations are far apart, by the stationary law.
Approximate bridges shift the posterior, exact ones do not; with Heun's scheme 12 steps give the
posterior of 50.""",
    lambda figures, examples: figures.bayes(examples[0]),
)
