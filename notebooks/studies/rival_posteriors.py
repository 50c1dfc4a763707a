"""Posteriors from exact observations at unit intervals, by this package and by numpyro.

An Ornstein–Uhlenbeck process whose rate is unknown, and Cox, Ingersoll and Ross's whose rate and σ
are, both with transition densities in closed form, so that the posterior is known on a grid.
numpyro's `EulerMaruyama` takes the step between two observations for normal, which it is not where
observations are far apart; with latent points between them it is, nearly, and NUTS has those
to move too.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key
from scipy import special, stats

import jaxbridge as jb
from jaxbridge.studies.clock import timed, timed_once_compiled
from jaxbridge.studies.report import Say

from .peers import where_installed

NUM_STEPS = 10
_LEVEL = 0.5
# Normal priors, restricted to what is above zero.
_PRIOR_MEAN, _PRIOR_SD = 1.0, 1.0


class Data(NamedTuple):
    """Observations at 0, 1, 2, ... of a process in one dimension; the names of what is unknown; the
    functions of the diffusion, of a point and those; log p_1(x, y | unknown); a grid."""

    name: str
    unknown: tuple[str, ...]
    drift: Callable[[Any, Any], Any]
    sigma: Callable[[Any, Any], Any]
    log_density: Callable[..., Any]
    positive: bool
    values: Float[np.ndarray, " n"]
    grid: tuple[Float[np.ndarray, " k"], ...]


class Posterior(NamedTuple):
    """Mean and standard deviation of each of the unknown."""

    mean: Float[np.ndarray, " p"]
    sd: Float[np.ndarray, " p"]


class PosteriorRow(NamedTuple):
    """One way to the posterior of one parameter: how far its mean is off, in exact posterior
    standard deviations, with a standard error; the standard deviation over the exact one; how many
    independent draws the chain is worth; seconds of the first call and of one more. `why` says why
    there are no numbers."""

    data: str
    way: str
    parameter: str
    shift: float | None = None
    shift_error: float | None = None
    sd_ratio: float | None = None
    worth: float | None = None
    first: float | None = None
    again: float | None = None
    why: str = ""


def _ou_drift(x: Any, p: Any) -> Any:
    return -p["rate"] * x


def _ou_sigma(x: Any, p: Any) -> Any:
    return jnp.ones_like(x)


def ou_log_density(x: Any, y: Any, rate: Any) -> Any:
    """log p_1(x, y) of dX = -rate X dt + dW."""
    variance = -np.expm1(-2 * rate) / (2 * rate)
    return stats.norm.logpdf(y, x * np.exp(-rate), np.sqrt(variance))


def _cir_drift(x: Any, p: Any) -> Any:
    return p["rate"] * (_LEVEL - x)


def _cir_sigma(x: Any, p: Any) -> Any:
    return p["sigma"] * jnp.sqrt(x)


def cir_log_density(x: Any, y: Any, rate: Any, sigma: Any) -> Any:
    """log p_1(x, y) of dX = rate (0.5 - X) dt + sigma √X dW: Y over `scale` is noncentral χ²,
    through Bessel's function scaled by its exponential."""
    scale = -(sigma**2) * np.expm1(-rate) / (4 * rate)
    order = 2 * rate * _LEVEL / sigma**2 - 1
    noncentrality, end = x * np.exp(-rate) / scale, y / scale
    bessel = np.log(special.ive(order, np.sqrt(end * noncentrality)))
    gap = (np.sqrt(end) - np.sqrt(noncentrality)) ** 2 / 2
    return order / 2 * np.log(end / noncentrality) - gap + bessel - np.log(2 * scale)


def data_sets(quick: bool) -> list[Data]:
    """Those of the study, simulated exactly; quickly, the first, and less of it."""
    rng, n = np.random.default_rng(4), 30 if quick else 100
    rate, x = 0.8, [0.0]
    for _ in range(n):
        x.append(rng.normal(x[-1] * np.exp(-rate), np.sqrt(-np.expm1(-2 * rate) / (2 * rate))))
    ou = Data("OU", ("rate",), _ou_drift, _ou_sigma, ou_log_density, False, np.array(x),
              (np.linspace(0.01, 4, 2_000),))  # fmt: skip
    rate, sigma, x = 1.0, 0.6, [_LEVEL]
    scale = -(sigma**2) * np.expm1(-rate) / (4 * rate)
    for _ in range(n):
        noncentrality = x[-1] * np.exp(-rate) / scale
        x.append(scale * rng.noncentral_chisquare(4 * rate * _LEVEL / sigma**2, noncentrality))
    cir = Data("CIR", ("rate", "sigma"), _cir_drift, _cir_sigma, cir_log_density, True, np.array(x),
               (np.linspace(0.2, 3.5, 250), np.linspace(0.3, 1.2, 200)))  # fmt: skip
    return [ou] if quick else [ou, cir]


def exact_posterior(data: Data) -> Posterior:
    """By sums over the grid."""
    axes = np.meshgrid(*data.grid, indexing="ij")
    x, y = data.values[:-1], data.values[1:]
    log = np.zeros(axes[0].shape)
    for one, other in zip(x, y, strict=True):
        log += data.log_density(one, other, *axes)
    log += sum(stats.norm.logpdf(axis, _PRIOR_MEAN, _PRIOR_SD) for axis in axes)
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    mean = np.array([np.sum(weights * axis) for axis in axes])
    variance = [np.sum(weights * (axis - m) ** 2) for axis, m in zip(axes, mean, strict=True)]
    return Posterior(mean, np.sqrt(np.array(variance)))


def run_posteriors(
    key: Key[Array, ""], quick: bool, num_draws: int, say: Say
) -> list[PosteriorRow]:
    """All ways to all posteriors."""
    rows = []
    for data in data_sets(quick):
        exact = exact_posterior(data)
        say(f"posteriors: {data.name}, here")
        rows += _library_rows(key, data, exact, num_draws)
        for way, latent in (("one step", 0), (f"{NUM_STEPS} steps", NUM_STEPS - 1)):
            say(f"posteriors: {data.name}, numpyro, {way}")
            name = f"numpyro, {way}"
            run = functools.partial(_numpyro, key, data, exact, num_draws, latent, name)
            missing = lambda why, data=data, name=name: [
                PosteriorRow(data.name, name, parameter, why=why) for parameter in data.unknown
            ]
            modules = "numpyro", "numpyro.distributions", "numpyro.infer", "numpyro.diagnostics"
            rows += where_installed(modules, run, missing)
    return rows


def _rows(
    data: Data,
    way: str,
    exact: Posterior,
    draws: Float[np.ndarray, "n p"],
    worth: Any,
    seconds: tuple[float, float],
) -> list[PosteriorRow]:
    """Of draws, and how many independent ones they are worth."""
    rows = []
    for i, name in enumerate(data.unknown):
        sd = float(draws[:, i].std(ddof=1))
        shift = float(draws[:, i].mean() - exact.mean[i]) / float(exact.sd[i])
        ratio, many = sd / float(exact.sd[i]), float(np.ravel(worth)[i])
        error = ratio / float(np.sqrt(many))
        rows.append(PosteriorRow(data.name, way, name, shift, error, ratio, many, *seconds))
    return rows


def _allowed(params: Any) -> Any:
    return jnp.all(jnp.stack([value > 0 for value in jax.tree.leaves(params)]))


def _inside(x: Float[Array, " d"], p: Any) -> Any:
    return jnp.all(x > 0)


def _library_rows(
    key: Key[Array, ""], data: Data, exact: Posterior, num_draws: int
) -> list[PosteriorRow]:
    """Sample by `gibbs`, and by `pmmh` if σ is unknown."""
    params = {name: 1.0 for name in data.unknown}
    domain = _inside if data.positive else None
    sigma = data.sigma if "sigma" in data.unknown else None
    model = jb.Diffusion(data.drift, sigma, params=params, domain=domain)
    times, values = np.arange(len(data.values)), data.values[:, None]
    common: dict[str, Any] = {
        "prior": jb.NormalPrior(_PRIOR_MEAN, _PRIOR_SD**2),
        "constraint": _allowed,
        "num_iterations": num_draws,
    }

    def gibbs(number):
        here = jax.random.fold_in(key, number)
        return jb.gibbs(here, model, times, values, num_steps=NUM_STEPS, **common)

    def pmmh(number):
        return jb.pmmh(
            jax.random.fold_in(key, number),
            model,
            times,
            values,
            num_proposals=30,
            num_steps=NUM_STEPS,
            proposal=jb.ModifiedDiffusionBridge(),
            **common,
        )

    ways: dict[str, Callable[[int], Any]] = {f"jaxbridge, `gibbs`, {NUM_STEPS} steps": gibbs}
    if sigma is not None:
        ways[f"jaxbridge, `pmmh`, {NUM_STEPS} steps"] = pmmh
    rows = []
    for way, run in ways.items():
        made, first = timed(lambda run=run: run(0))
        again = timed_once_compiled(lambda run=run: run(1))[1]
        draws, worth = np.asarray(made.theta, float), made.effective_sample_size
        rows += _rows(data, way, exact, draws, worth, (first, again))
    return rows


def _numpyro(
    key: Key[Array, ""],
    data: Data,
    exact: Posterior,
    num_draws: int,
    latent: int,
    way: str,
    numpyro: Any,
    dist: Any,
    infer: Any,
    diagnostics: Any,
) -> list[PosteriorRow]:
    """NUTS on `EulerMaruyama`, with so many `latent` points between two observations."""
    n = len(data.values) - 1
    times = jnp.linspace(0.0, float(n), n * (latent + 1) + 1)
    seen = jnp.asarray(data.values, float)
    # Between observations x and y latent points start on the straight line.
    share = jnp.arange(1.0, latent + 1.0) / (latent + 1.0)
    line = seen[:-1, None] + share * (seen[1:] - seen[:-1])[:, None]
    support = dist.constraints.positive if data.positive else dist.constraints.real

    def model():
        positive = lambda: dist.TruncatedNormal(_PRIOR_MEAN, _PRIOR_SD, low=0.0)
        params = {name: numpyro.sample(name, positive()) for name in data.unknown}
        path = seen
        if latent:
            free = numpyro.sample("latent", dist.ImproperUniform(support, (), line.shape))
            inner = jnp.concatenate([seen[:-1, None], free], axis=1).ravel()
            path = jnp.concatenate([inner, seen[-1:]])
        steps = lambda x, t: (data.drift(x, params), data.sigma(x, params))
        law = dist.EulerMaruyama(times, steps, dist.Normal(seen[0], 1.0))
        numpyro.factor("path", law.log_prob(path))

    init = {name: 1.0 for name in data.unknown} | ({"latent": line} if latent else {})
    sampler = infer.NUTS(model, init_strategy=infer.init_to_value(values=init))
    chain = infer.MCMC(
        sampler, num_warmup=num_draws // 2, num_samples=num_draws, progress_bar=False
    )

    def run(number):
        chain.run(jax.random.fold_in(key, number))
        return chain.get_samples()

    made, first = timed(lambda: run(0))
    again = timed_once_compiled(lambda: run(1))[1]
    draws = np.stack([np.asarray(made[name], float) for name in data.unknown], axis=1)
    worth = [diagnostics.effective_sample_size(draws[None, :, i]) for i in range(draws.shape[1])]
    return _rows(data, way, exact, draws, worth, (first, again))
