"""Which start law, and which γ? By pilot runs: the one with most effective samples per
simulated path, proposals and trials alike (end of section 3 of the paper: an open question).

Start laws are sought between ν, the best one for likely end points, and the Gaussian fit G to
the starts X*_T of the reversed paths that met, which hits an unlikely bridge far more often:
`μ ∝ N_ν^{1-λ} G^λ` with N_ν the Gaussian fit to ν, and λ = 0 standing for ν itself. (A fit to
all starts, met or not, is worse where few pairs meet.)
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from .arrays import Numbers, is_traced
from .bridges import Bridges, check_key, sample_bridges
from .burn_in import measure_burn_in
from .coupling import Coupling
from .diffusion import Diffusion, check_diffusion
from .gaussian import GaussianLaw
from .intervals import check_count
from .start_laws import AnyStartLaw, Stationary, draw_starts
from .weighted import weigh_bridges

_WEIGHTS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
# Efficiencies this close are not told apart by a pilot run; of such laws the one closest to ν
# is taken, whose weights are bounded more safely.
_TOLERANCE = 1.1
# Pilot counts that take longer are cut off: the law is not a candidate then.
_PILOT_TRIALS = 1_000


class Pilot(NamedTuple):
    """One pilot run: γ; λ, the weight of the Gaussian fit in the start law; the share of
    proposals that met; trials for a hitting count; effective samples per simulated path, nan
    where counts took too long; and the coupling."""

    gamma: float
    weight: float
    acceptance: float
    trials_per_count: float
    efficiency: float
    coupling: Coupling


class Tuning(NamedTuple):
    """The `coupling` with most effective samples per simulated path, and all `pilots`."""

    coupling: Coupling
    pilots: list[Pilot]

    def __str__(self) -> str:
        lines = ["  gamma  weight of fit  met share  trials per count  efficiency"]
        for p in self.pilots:
            chosen = "  <- chosen" if p.coupling is self.coupling else ""
            lines.append(
                f"{p.gamma:7.3g}  {p.weight:13.1f}  {p.acceptance:9.1%}  "
                f"{p.trials_per_count:16.1f}  {p.efficiency:10.4f}{chosen}"
            )
        return "\n".join(lines)


def fit_start_law(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_steps: int = 50,
    coupling: Coupling | None = None,
    num_pilot: int = 2000,
) -> AnyStartLaw:
    """The start law μ with most effective samples per simulated path, between ν and a Gaussian
    fit to the reversed paths' starts.

    A choice made outside `jit`, of one interval: it looks at numbers.

    **Arguments:** as in `sample_bridges`; `num_pilot` is the number of bridges of the pilot run.

    **Returns:** `Stationary()` or a `GaussianLaw`.

    **Raises:** `ValueError` where too few pilot bridges are found, or for arguments that do not
    fit; `TypeError` inside `jit`.

    !!! example

        ```python
        law = jb.fit_start_law(jax.random.key(0), model, a, b, 1.0, coupling=jb.Coupling(0.5))
        coupling = jb.Coupling(0.5, start_law=law)
        ```
    """
    coupling = Coupling() if coupling is None else coupling
    pilots = _pilots(key, model, start, end, duration, num_steps, coupling, num_pilot)
    return _best(pilots).coupling.start_law


def tune_coupling(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_steps: int = 50,
    couplings: Sequence[Coupling] | None = None,
    num_pilot: int = 2000,
) -> Tuning:
    """The γ and the start law with most effective samples per simulated path.

    A choice made outside `jit`, of one interval: it looks at numbers.

    **Arguments:** as in `sample_bridges`; `couplings` are the candidates, by default those with
    γ = -1, 0, 0.5 and 0.9, and each is tried with start laws between ν and a Gaussian fit;
    `num_pilot` is the number of bridges of each pilot run.

    **Returns:** `Tuning`; printed, it is a table.

    **Raises:** as `fit_start_law`.

    !!! example

        ```python
        tuning = jb.tune_coupling(jax.random.key(0), model, a, b, 1.0)
        print(tuning)
        chain = jb.sample_exact_bridges(key, model, a, b, 1.0, proposal=tuning.coupling)
        ```
    """
    if couplings is None:
        couplings = [Coupling(gamma) for gamma in (-1.0, 0.0, 0.5, 0.9)]
    runs = (
        _pilots(key, model, start, end, duration, num_steps, coupling, num_pilot)
        for coupling in couplings
    )
    pilots = list(itertools.chain.from_iterable(runs))
    return Tuning(_best(pilots).coupling, pilots)


def _pilots(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    num_steps: int,
    coupling: Coupling,
    num_pilot: int,
) -> list[Pilot]:
    check_key(key)
    check_diffusion(model)
    num_pilot = check_count("num_pilot", num_pilot, 10)
    if is_traced(key, model, coupling, start, end, duration):
        raise TypeError(
            "a start law is chosen by looking at numbers, which `jit` and `vmap` hide: choose it "
            "before, and pass the coupling that has it."
        )
    bridge_key, law_key, weigh_key = jax.random.split(key, 3)
    bridges = sample_bridges(
        bridge_key,
        model,
        start,
        end,
        duration,
        num_bridges=num_pilot,
        num_steps=num_steps,
        coupling=coupling,
    )
    if bridges.paths.ndim != 3:
        raise ValueError("a start law is chosen for one interval: `start` of shape (d,).")
    met, d = np.asarray(bridges.met), bridges.paths.shape[-1]
    if met.sum() < 10 * d:
        raise ValueError(
            f"only {met.sum()} of {num_pilot} pilot bridges were found: the pair hardly ever "
            "meets here. Lengthen the duration or choose a smaller `gamma`."
        )
    starts = np.asarray(bridges.reverse_start, float)[met]
    stationary, draws = _stationary_draws(law_key, model, coupling, bridges, num_pilot)
    laws: list[AnyStartLaw] = [stationary]
    if model.has_density:
        fits = (_gaussian_fit(draws), _gaussian_fit(starts))
        dtype = bridges.paths.dtype
        laws += [_between(*fits, weight, dtype) for weight in _WEIGHTS[1:]]
    pilots = []
    for weight, law in zip(_WEIGHTS, laws, strict=False):
        weighted = weigh_bridges(weigh_key, model, bridges, start_law=law, max_trials=_PILOT_TRIALS)
        acceptance = met.sum() / float(bridges.num_proposals)
        trials = (float(weighted.num_simulated) - float(bridges.num_proposals)) / met.sum()
        usable = np.asarray(weighted.truncated).mean() < 0.01
        efficiency = float(weighted.efficiency) if usable else np.nan
        gamma = float(np.asarray(coupling.gamma))
        tuned = eqx.tree_at(lambda c: c.start_law, coupling, law)
        pilots.append(Pilot(gamma, weight, acceptance, trials, efficiency, tuned))
    return pilots


def _best(pilots: list[Pilot]) -> Pilot:
    if all(np.isnan(pilot.efficiency) for pilot in pilots):
        raise ValueError(
            "hitting counts took too long with every start law that was tried: these bridges "
            "are hardly ever hit. Lengthen the duration or choose a smaller `gamma`."
        )
    best = np.nanmax([pilot.efficiency for pilot in pilots])
    near_best = [pilot for pilot in pilots if pilot.efficiency > best / _TOLERANCE]
    return min(near_best, key=lambda pilot: (pilot.weight, -pilot.efficiency))


def _stationary_draws(
    key: Key[Array, ""], model: Diffusion, coupling: Coupling, bridges: Bridges, num_draws: int
) -> tuple[Stationary, Float[np.ndarray, "n d"]]:
    """ν as a start law, with a burn-in where the model needs one, and draws from it."""
    law, end, duration = Stationary(), bridges.paths[0, -1], bridges.times[-1]
    keys = jax.random.split(key, num_draws)
    if not model.has_sampler:
        end = jnp.where(jnp.isfinite(end), end, 0)
        burn_in = measure_burn_in(
            key, model, end, duration, num_steps=bridges.num_steps, coupling=coupling
        )
        law = Stationary(burn_in)
    lanes = jnp.broadcast_to(end[:, None], (len(end), num_draws))
    dt = jnp.full(num_draws, duration / bridges.num_steps, end.dtype)
    draws = jax.jit(
        lambda keys: draw_starts(
            law, model.prepared(), coupling.scheme, keys, lanes, dt, bridges.num_steps
        )
    )(keys)
    return law, np.asarray(draws, float).T


def _gaussian_fit(
    draws: Float[np.ndarray, "n d"],
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d d"]]:
    """Mean and precision."""
    draws = draws[np.all(np.isfinite(draws), axis=1)]
    return draws.mean(0), np.linalg.inv(np.atleast_2d(np.cov(draws.T)))


def _between(stationary, reverse, weight: float, dtype) -> GaussianLaw:
    """The normalised `N_ν^{1-λ} G^λ`."""
    (mean, precision), (other_mean, other_precision) = stationary, reverse
    combined = (1 - weight) * precision + weight * other_precision
    covariance = np.linalg.inv(combined)
    shift = (1 - weight) * precision @ mean + weight * other_precision @ other_mean
    covariance = (covariance + covariance.T) / 2
    return GaussianLaw(jnp.asarray(covariance @ shift, dtype), jnp.asarray(covariance, dtype))
