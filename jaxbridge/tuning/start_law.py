"""Choice of γ and of the start law μ of a coupling, by pilot runs.

The criterion is the number of effective samples per simulated path, where proposals and trials both
count as simulated paths. The end of section 3 of the paper leaves this choice open.

The candidates lie between two laws. The stationary law ν is the best one for likely end points. The
other law, G, is a Gaussian fit to the time-0 values of the reversed paths that met. Associated
diffusions that start from G hit an unlikely bridge far more often. With N_ν the Gaussian fit to ν,
the candidates are

    μ ∝ N_ν^{1-λ} G^λ,

and λ = 0 stands for ν itself. G uses only the paths that met: a fit to all reversed paths is worse
if few pairs meet.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ..coupling import (
    AnyStartLaw,
    Coupling,
    Stationary,
    draw_starts,
    measure_burn_in,
    needs_burn_in,
    sample_bridges,
)
from ..engine.arguments import as_sequence, check_instance
from ..engine.batch_size import most_lanes
from ..engine.checks import Numbers, check_count, check_key, is_traced
from ..engine.compiled import compiled
from ..engine.entry import public_entry
from ..engine.keys import key_for
from ..exact import weigh_bridges
from ..models.bridge_problem import BridgeProblem, Intervals, bridge_problem
from ..models.diffusion import Diffusion
from ..models.gaussian_law import GaussianLaw

_SHARES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


# A pilot run cannot distinguish efficiencies within this factor. Among such laws we choose the one
# closest to ν, because the ratio μ/ν in its weights is bounded more safely.
_TOLERANCE = 1.1


# Maximum of trials per pilot count. A law that needs more for over 1 % of the bridges is rejected.
_PILOT_TRIALS = 1_000
# Largest share of a density that may come from points outside of the pilot's starts, the number of
# draws that measure it, the fewest of them that must be effective, and the number of reductions of
# the standard deviations, by a fifth each.
_MOST_OUTSIDE = 0.01
_NUM_MEASURED = 4_000
_FEWEST_MEASURED = 400
_MOST_REDUCTIONS = 6


class Pilot(NamedTuple):
    """One pilot run of `tune_coupling`.

    - `gamma`: γ.
    - `fit_share`: λ, the share of the Gaussian fit in the start law; 0 is the stationary law.
    - `acceptance`: fraction of proposed pairs that met.
    - `trials_per_count`: mean number of trials per hitting count.
    - `efficiency`: effective samples per simulated path. NaN if too many counts were truncated or
        too few pairs met.
    - `coupling`: the coupling with this γ and start law.
    """

    gamma: float
    fit_share: float
    acceptance: float
    trials_per_count: float
    efficiency: float
    coupling: Coupling


class Tuning(NamedTuple):
    """Result of `tune_coupling`, which prints as a table.

    - `coupling`: the chosen coupling. Its effective samples per simulated path are within 10 % of
        the best pilot run.
    - `pilots`: list of all pilot runs, each a `Pilot`.
    """

    coupling: Coupling
    pilots: list[Pilot]

    def __str__(self) -> str:
        lines = ["  gamma  share of fit  met share  trials per count  efficiency"]
        for p in self.pilots:
            chosen = "  <- chosen" if p.coupling is self.coupling else ""
            lines.append(
                f"{p.gamma:7.3g}  {p.fit_share:12.1f}  {p.acceptance:9.1%}  "
                f"{p.trials_per_count:16.1f}  {p.efficiency:10.4f}{chosen}"
            )
        return "\n".join(lines)


@public_entry
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
    for_density: bool = False,
) -> AnyStartLaw:
    """Choose the start law μ of a coupling for one interval.

    The candidates lie between the stationary law ν and a Gaussian fit to the time-0 values of the
    reversed paths that met. The criterion is the number of effective samples per simulated path in
    a pilot run. Among laws within 10 % of the best, the one closest to ν is chosen, because the
    ratio μ/ν in its weights is bounded more safely. Without a stationary density, ν is the only
    candidate. Call this function outside `jit`.

    **Arguments:** as in `sample_bridges`, and:

    - `num_pilot`: number of bridges in the pilot run, at least 20 d.
    - `for_density`: true if the coupling is for transition densities. With the start law ν a
        density needs a normalised `log_stationary`. So if the model is not declared `normalised`,
        only Gaussian laws are tried. Their weights vary much if ν is far from Gaussian (much
        lighter tails, or curved contours); then use a guided proposal.

    **Returns:** `Stationary()` or a `GaussianLaw`. With `for_density` it is a `GaussianLaw`, unless
    the model is declared `normalised`.

    **Raises:** `ValueError` and `TypeError` for invalid arguments; `ValueError` if too few pilot
    bridges are found or hit; `TypeError` inside `jit`.

    **Example:**

    ```python
    law = jb.fit_start_law(key, model, start, end, 1.0, coupling=jb.Coupling(0.5))
    coupling = jb.Coupling(0.5, start_law=law)
    ```
    """
    coupling = Coupling() if coupling is None else coupling
    problem = bridge_problem(model, start, end, duration, num_steps)
    pilots = coupling_pilots(key, model, problem, coupling, num_pilot, for_density)
    return best_pilot(pilots).coupling.start_law


@public_entry
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
    for_density: bool = False,
) -> Tuning:
    """Choose γ and the start law of a coupling for one interval.

    The criterion is the number of effective samples per simulated path in pilot runs. Among
    candidates within 10 % of the best, the law closest to ν is chosen, as in `fit_start_law`. Call
    this function outside `jit`.

    **Arguments:** as in `sample_bridges`, and:

    - `couplings`: candidates, by default those with γ = -1, 0, 0.5 and 0.9. Each is tried with
        several start laws between ν and a Gaussian fit.
    - `num_pilot`: number of bridges in each pilot run, at least 20 d.
    - `for_density`: as in `fit_start_law`.

    **Returns:** `Tuning`, which prints as a table.

    **Raises:** the same errors as `fit_start_law`.

    **Example:**

    ```python
    couplings = [jb.Coupling(-1.0), jb.Coupling(0.5)]
    tuning = jb.tune_coupling(key, model, start, end, 1.0, couplings=couplings, num_pilot=500)
    print(tuning)
    chain = jb.sample_exact_bridges(key, model, start, end, 1.0, proposal=tuning.coupling)
    ```
    """
    if couplings is None:
        couplings = [Coupling(gamma) for gamma in (-1.0, 0.0, 0.5, 0.9)]
    couplings = as_sequence("couplings", couplings, "couplings")
    if not couplings:
        raise ValueError("`couplings` must contain at least one candidate; got none.")
    for coupling in couplings:
        check_instance("couplings", coupling, Coupling, "a sequence of `Coupling`s")
    problem = bridge_problem(model, start, end, duration, num_steps)
    runs = (
        coupling_pilots(key, model, problem, coupling, num_pilot, for_density)
        for coupling in couplings
    )
    pilots = list(itertools.chain.from_iterable(runs))
    return Tuning(best_pilot(pilots).coupling, pilots)


def coupling_pilots(
    key: Key[Array, ""],
    model: Diffusion,
    problem: BridgeProblem,
    coupling: Coupling,
    num_pilot: int,
    for_density: bool,
) -> list[Pilot]:
    """Run one pilot per start law for this coupling; all use the same bridges.

    If too few pairs met, return a single pilot with an efficiency of NaN.

    **Raises:** `ValueError` and `TypeError` for invalid arguments; `TypeError` inside `jit`.
    """
    check_key(key)
    if for_density and not model.has_density:
        raise ValueError(
            "transition densities by couplings need the stationary density, whatever the start "
            "law, but this model has none. Pass `log_stationary` (up to a constant) to "
            "`Diffusion`, or use a guided proposal."
        )
    if not isinstance(coupling, Coupling):
        raise TypeError(
            f"`coupling` must be a `Coupling`, because its start law is replaced; got {coupling!r}."
        )
    if is_traced(key, model, coupling, problem):
        raise TypeError(
            "a start law is chosen by the numbers of a pilot run, so it cannot be chosen inside "
            "`jit` or `vmap`: choose it before, and pass the coupling with this start law."
        )
    if problem.batched:
        raise ValueError(
            "a start law is chosen for one interval: pass `start` and `end` of shape (d,), and "
            f"`duration` of shape (); got {len(problem.intervals.duration)} intervals in an axis."
        )
    (start,), (end,), (duration,) = problem.intervals
    intervals, num_steps, d = problem.intervals, problem.num_steps, start.shape[0]
    # Twice the number of pairs that the fit below needs, because some pairs do not meet.
    num_pilot = check_count("num_pilot", num_pilot, 20 * d)
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
    gamma, met = float(np.asarray(coupling.gamma)), np.asarray(bridges.met)
    acceptance = met.sum() / float(bridges.num_proposals)
    # A fit of mean and covariance needs several draws per dimension.
    if met.sum() < 10 * d:
        return [Pilot(gamma, 0.0, acceptance, np.nan, np.nan, coupling)]
    starts = np.asarray(bridges.reverse_start, float)[met]
    stationary, draws = _stationary_draws(law_key, model, coupling, intervals, num_steps, num_pilot)
    laws: list[AnyStartLaw] = [stationary]
    if model.has_density:
        fits = (_gaussian_fit(draws), _gaussian_fit(starts))
        gaussian: list[AnyStartLaw] = [
            _within(starts, _geometric_mean(*fits, share, bridges.paths.dtype), *fits)
            for share in _SHARES
        ]
        # A density needs a normalised μ, and ν is normalised only if the model says so.
        only_gaussian = for_density and not model.normalised
        laws = gaussian if only_gaussian else [stationary, *gaussian[1:]]
    pilots = []
    # The same key for all laws: common random numbers make the efficiencies comparable.
    for share, law in zip(_SHARES, laws, strict=False):
        weighted = weigh_bridges(weigh_key, model, bridges, start_law=law, max_trials=_PILOT_TRIALS)
        trials = (float(weighted.num_simulated) - float(bridges.num_proposals)) / met.sum()
        # Truncated counts are too small, so the efficiency would be too large.
        usable = np.asarray(weighted.truncated).mean() < 0.01
        efficiency = float(weighted.efficiency) if usable else np.nan
        tuned = eqx.tree_at(lambda c: c.start_law, coupling, law)
        pilots.append(Pilot(gamma, share, acceptance, trials, efficiency, tuned))
    return pilots


def best_pilot(pilots: list[Pilot]) -> Pilot:
    """Return the pilot closest to ν among those whose efficiency is within 10 % of the largest.

    **Raises:** `ValueError` if no pilot run succeeded.
    """
    if all(np.isnan(pilot.efficiency) for pilot in pilots):
        raise ValueError(
            "no pilot run succeeded, because pairs rarely meet or bridges are rarely hit; got "
            f"(fraction met, trials per count) = "
            f"{[(p.acceptance, p.trials_per_count) for p in pilots]}. Lengthen the duration or "
            "choose a smaller `gamma`."
        )
    # NaN marks pilot runs that failed; comparisons with NaN below are false.
    best = np.nanmax([pilot.efficiency for pilot in pilots])
    near_best = [pilot for pilot in pilots if pilot.efficiency > best / _TOLERANCE]
    return min(near_best, key=lambda pilot: (pilot.fit_share, -pilot.efficiency))


def _stationary_draws(
    key: Key[Array, ""],
    model: Diffusion,
    coupling: Coupling,
    intervals: Intervals,
    num_steps: int,
    num_draws: int,
) -> tuple[Stationary, Float[np.ndarray, "n d"]]:
    """Return ν as a start law, with a burn-in if the model needs one, and draws from ν."""
    current_law = coupling.start_law
    law = current_law if isinstance(current_law, Stationary) else Stationary()
    if needs_burn_in(law, model):
        _, end, duration = intervals
        burn_in = measure_burn_in(
            key, model, end[0], duration[0], num_steps=num_steps, coupling=coupling
        )
        law = Stationary(burn_in)
    # One batch only, because each draw may need a burn-in.
    num_draws = min(num_draws, most_lanes(intervals.end.shape[1]))
    keys = jax.random.split(key_for("stationary draws", key), num_draws)
    draws = _draw_stationary(law, model, coupling.scheme, keys, intervals, num_steps)
    return law, np.asarray(draws, float).T


@compiled
def _draw_stationary(law, model, scheme, keys, intervals, num_steps):
    _, end, duration = intervals
    lanes = jnp.broadcast_to(end.T, (end.shape[1], len(keys)))
    dt = jnp.broadcast_to(duration / num_steps, len(keys))
    return draw_starts(law, model.prepared(), scheme, keys, lanes, dt, num_steps)


def _gaussian_fit(
    draws: Float[np.ndarray, "n d"],
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d d"]]:
    """Return mean and precision matrix of the finite draws."""
    draws = draws[np.all(np.isfinite(draws), axis=1)]
    return draws.mean(0), np.linalg.inv(np.atleast_2d(np.cov(draws.T)))


def _within(starts: Float[np.ndarray, "n d"], law: GaussianLaw, stationary, reverse) -> GaussianLaw:
    """Return the law, with a smaller covariance if it reaches beyond the starts of the pilot run.

    If ν has lighter tails than a normal law μ, paths that start in the tails of μ are rare and have
    huge weights. Neither the pilot run nor k̂ shows these weights. The part of a density that comes
    from the start x is in proportion to μ(x) p_T(x, b), and p_T(x, b) to G(x)/ν(x). `stationary`
    and `reverse` are the pairs (mean, precision) of ν and G. The covariance shrinks until at most
    about 1 % of the density comes from points outside of the box of the pilot's starts.
    """
    starts = starts[np.all(np.isfinite(starts), axis=1)]
    n, d = starts.shape
    axes = np.linalg.cholesky(reverse[1])
    low, high = (starts @ axes).min(0), (starts @ axes).max(0)
    mean, covariance = np.asarray(law.mean, float), np.asarray(law.covariance, float)
    normal = np.random.default_rng(0).standard_normal((_NUM_MEASURED, d))
    # Of n new starts about 2 d are outside of the box of the old ones.
    allowed = max(_MOST_OUTSIDE, 4 * d / n)
    for scale in 0.8 ** np.arange(_MOST_REDUCTIONS):
        points = mean + scale * normal @ np.linalg.cholesky(covariance).T
        log_p = _log_normal(points, *reverse) - _log_normal(points, *stationary)
        added = np.exp(log_p - log_p.max())
        # In many dimensions, or for short durations, a few points have all the weight.
        if added.sum() ** 2 < _FEWEST_MEASURED * (added @ added):
            break
        outside = np.any((points @ axes < low) | (points @ axes > high), axis=1)
        if added @ outside <= allowed * added.sum():
            return GaussianLaw(law.mean, law.covariance * scale**2)
    return law


def _log_normal(points, mean, precision) -> Float[np.ndarray, " n"]:
    """Return the log densities at the points, up to a constant."""
    return -np.einsum("ni,ij,nj->n", points - mean, precision, points - mean) / 2


def _geometric_mean(stationary, reverse, share: float, dtype) -> GaussianLaw:
    """Return the normalised law `N_ν^{1-λ} G^λ`, from two pairs (mean, precision) and λ.

    A product of Gaussian powers is Gaussian: precisions and precision-weighted means add up.
    """
    (mean, precision), (other_mean, other_precision) = stationary, reverse
    combined = (1 - share) * precision + share * other_precision
    covariance = np.linalg.inv(combined)
    shift = (1 - share) * precision @ mean + share * other_precision @ other_mean
    # Rounding errors make the inverse slightly asymmetric.
    covariance = (covariance + covariance.T) / 2
    return GaussianLaw(jnp.asarray(covariance @ shift, dtype), jnp.asarray(covariance, dtype))
