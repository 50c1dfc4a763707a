"""Which start law, and which γ? By pilot runs: the one with most effective samples per
simulated path, proposals and trials alike (end of section 3 of the paper: an open question).
And which proposal at all? The one with most effective samples per second (`choose_proposal`).

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
from ..engine.doors import door
from ..engine.keys import key_for
from ..exact import weigh_bridges
from ..models.bridge_problem import BridgeProblem, Intervals, bridge_problem
from ..models.diffusion import Diffusion
from ..models.gaussian_law import GaussianLaw

_SHARES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


# Efficiencies this close are not told apart by a pilot run; of such laws the one closest to ν
# is taken, whose weights are bounded more safely.
_TOLERANCE = 1.1


# Pilot counts that take longer are cut off: the law is not a candidate then.
_PILOT_TRIALS = 1_000


class Pilot(NamedTuple):
    """One pilot run of `tune_coupling`.

    - `gamma`: γ.
    - `fit_share`: λ, the share of the Gaussian fit in the start law.
    - `acceptance`: the share of proposals that met.
    - `trials_per_count`: trials for a hitting count.
    - `efficiency`: effective samples per simulated path, NaN where counts took too long or too few
        pairs met.
    - `coupling`: with this γ and start law.
    """

    gamma: float
    fit_share: float
    acceptance: float
    trials_per_count: float
    efficiency: float
    coupling: Coupling


class Tuning(NamedTuple):
    """What `tune_coupling` returns: the `coupling` with most effective samples per simulated path
    (up to a tenth), and all `pilots`. Printed, it is a table."""

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


@door
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
    """The start law μ with most effective samples per simulated path, between ν and a Gaussian
    fit to the reversed paths' starts. Of laws that come within a tenth of the most, the one closest
    to ν is taken, whose weights are bounded more safely.

    A choice made outside `jit`, of one interval: it looks at numbers.

    **Arguments:** as in `sample_bridges`; `num_pilot` is the number of bridges of the pilot run;
    `for_density` is for transition densities, whose size with ν itself rests on a normalised
    `log_stationary`: where the model is not declared so, only laws with a density of their own are
    tried, from the Gaussian fit to ν on. Where ν has far lighter tails than that, or is bent, their
    weights vary much, and proposals that are pulled to the end point are the better choice.

    **Returns:** `Stationary()` or a `GaussianLaw`; with `for_density` the latter, unless the model
    is declared `normalised`.

    **Raises:** `ValueError` where too few pilot bridges are found, or for arguments that do not
    fit; `TypeError` inside `jit`.

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


@door
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
    """The γ and the start law with most effective samples per simulated path; within a tenth of the
    most, the law closest to ν, as in `fit_start_law`.

    A choice made outside `jit`, of one interval: it looks at numbers.

    **Arguments:** as in `sample_bridges`; `couplings` are the candidates, by default those with
    γ = -1, 0, 0.5 and 0.9, and each is tried with start laws between ν and a Gaussian fit;
    `num_pilot` is the number of bridges of each pilot run; `for_density` as in `fit_start_law`.

    **Returns:** `Tuning`; printed, it is a table.

    **Raises:** as `fit_start_law`.

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
        raise ValueError("`couplings` must have at least one candidate.")
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
    check_key(key)
    if for_density and not model.has_density:
        raise ValueError(
            "densities by couplings need the stationary one, with any start law: give `Diffusion` "
            "a `log_stationary` (up to a constant), or choose a proposal that is pulled to the end "
            "point."
        )
    if not isinstance(coupling, Coupling):
        raise TypeError(
            f"`coupling` must be a `Coupling`, whose start law is chosen; got {coupling!r}."
        )
    if is_traced(key, model, coupling, problem):
        raise TypeError(
            "a start law is chosen by looking at numbers, which `jit` and `vmap` hide: choose it "
            "before, and pass the coupling that has it."
        )
    if problem.batched:
        raise ValueError("a start law is chosen for one interval: `start` of shape (d,).")
    (start,), (end,), (duration,) = problem.intervals
    intervals, num_steps, d = problem.intervals, problem.num_steps, start.shape[0]
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
    if met.sum() < 10 * d:
        return [Pilot(gamma, 0.0, acceptance, np.nan, np.nan, coupling)]
    starts = np.asarray(bridges.reverse_start, float)[met]
    stationary, draws = _stationary_draws(law_key, model, coupling, intervals, num_steps, num_pilot)
    laws: list[AnyStartLaw] = [stationary]
    if model.has_density:
        fits = (_gaussian_fit(draws), _gaussian_fit(starts))
        gaussian: list[AnyStartLaw] = [
            _between(*fits, share, bridges.paths.dtype) for share in _SHARES
        ]
        only_gaussian = for_density and not model.normalised
        laws = gaussian if only_gaussian else [stationary, *gaussian[1:]]
    pilots = []
    for share, law in zip(_SHARES, laws, strict=False):
        weighted = weigh_bridges(weigh_key, model, bridges, start_law=law, max_trials=_PILOT_TRIALS)
        trials = (float(weighted.num_simulated) - float(bridges.num_proposals)) / met.sum()
        usable = np.asarray(weighted.truncated).mean() < 0.01
        efficiency = float(weighted.efficiency) if usable else np.nan
        tuned = eqx.tree_at(lambda c: c.start_law, coupling, law)
        pilots.append(Pilot(gamma, share, acceptance, trials, efficiency, tuned))
    return pilots


def best_pilot(pilots: list[Pilot]) -> Pilot:
    if all(np.isnan(pilot.efficiency) for pilot in pilots):
        raise ValueError(
            "no pilot run succeeded: either the pair hardly ever meets here, or bridges are hardly "
            f"ever hit (met share, trials per count: "
            f"{[(p.acceptance, p.trials_per_count) for p in pilots]}). Lengthen the duration or "
            "choose a smaller `gamma`."
        )
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
    """ν as a start law, with a burn-in where the model needs one, and draws from it."""
    given = coupling.start_law
    law = given if isinstance(given, Stationary) else Stationary()
    if needs_burn_in(law, model):
        _, end, duration = intervals
        burn_in = measure_burn_in(
            key, model, end[0], duration[0], num_steps=num_steps, coupling=coupling
        )
        law = Stationary(burn_in)
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
    """Mean and precision."""
    draws = draws[np.all(np.isfinite(draws), axis=1)]
    return draws.mean(0), np.linalg.inv(np.atleast_2d(np.cov(draws.T)))


def _between(stationary, reverse, share: float, dtype) -> GaussianLaw:
    """The normalised `N_ν^{1-λ} G^λ`."""
    (mean, precision), (other_mean, other_precision) = stationary, reverse
    combined = (1 - share) * precision + share * other_precision
    covariance = np.linalg.inv(combined)
    shift = (1 - share) * precision @ mean + share * other_precision @ other_mean
    covariance = (covariance + covariance.T) / 2
    return GaussianLaw(jnp.asarray(covariance @ shift, dtype), jnp.asarray(covariance, dtype))
