"""Simulation-based calibration of a sampler of posteriors (Talts, Betancourt, Simpson, Vehtari &
Gelman 2018).

If parameters are drawn from the prior, and a record given them, the rank of the parameters among
the draws of their posterior is uniform.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from ..engine.arguments import check_instance, shown
from ..engine.checks import Numbers, check_count, check_key
from ..engine.diagnostics import p_uniform
from ..engine.entry import public_entry
from ..engine.progress import metered
from ..engine.verdict import AbstractResult, Fault, Verdict
from ..models.diffusion import Diffusion
from ..models.jumps import Jumps
from ..records import AbstractObservation, Initial, simulate_observations
from ..records.record import as_rows
from .parameters import Constraint, as_parameters
from .priors import NormalPrior, as_normal

_MOST_UNTRUSTED = 0.1
_UNTRUSTED = (
    "More than 10 % of the posteriors are not `trustworthy`, so that ranks may show faults of the "
    "sampler in place of faults of the model. Use longer chains; `why()` of a posterior names its "
    "fault."
)
_MOST_LOST = 0.01
_LOST = (
    "More than 1 % of the simulated records left the state space or the finite numbers, and have "
    "no ranks, so that the others are a selection. Use more `num_steps`, or coordinates without a "
    "boundary (`transform`)."
)
# Number of attempts to draw parameters that satisfy the constraint.
_MOST_ATTEMPTS = 1000


class Calibration(AbstractResult):
    """Result of `simulation_based_calibration`, of S simulated records and p parameters.

    - `names`: names of the parameters.
    - `truth`: parameters of each record, draws of the prior, shape (S, p).
    - `uniforms`: rank of the truth among draws of the posterior, in (0, 1), shape (S, p). NaN for a
        simulated record that left the state space.
    - `effective_sample_size`: that of each posterior, shape (S, p). Draws are thinned to about this
        number before ranks are taken.
    - `trusted`: whether each posterior is `trustworthy`, shape (S,).
    """

    truth: Float[Array, "S p"]
    uniforms: Float[Array, "S p"]
    effective_sample_size: Float[Array, "S p"]
    trusted: Bool[Array, " S"]
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def p_uniform(self) -> Float[Array, " p"]:
        """Return the p-value of Neyman's smooth test (1937) that `uniforms` are uniform.

        Shape (p,). A small value means wrong posteriors: biased, too narrow or too wide.
        """
        return p_uniform(self.uniforms)

    @property
    def verdict(self) -> Verdict:
        """Return the possible faults: many posteriors that are not `trustworthy`, or lost records.

        A small `p_uniform` is a result, and no fault.
        """
        lost = jnp.isnan(self.uniforms[:, 0])
        untrusted = jnp.mean(~self.trusted & ~lost) > _MOST_UNTRUSTED
        faults = Fault(untrusted, _UNTRUSTED), Fault(jnp.mean(lost) > _MOST_LOST, _LOST)
        return Verdict(faults)


@public_entry
def simulation_based_calibration(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    sampler: Callable[..., Any],
    *,
    prior: NormalPrior,
    observation: AbstractObservation,
    initial: Initial = None,
    where: Callable[[PyTree], PyTree] | None = None,
    constraint: Constraint | None = None,
    jumps: Jumps | None = None,
    num_simulations: int = 100,
    num_steps: int = 40,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> Calibration:
    """Check a sampler on records that are simulated from the prior and the model.

    Every record needs a run of the sampler, so this takes as long as `num_simulations` runs. All
    runs share their compiled programs.

    **Arguments:**

    - `key`: a typed key.
    - `model`, `times`, `observation`, `initial`, `where`, `constraint`, `jumps`: as in `gibbs`, for
        one record. The observation model must have `sample`.
    - `observations`: the record. Simulated ones have its shape and its missing values; other values
        do not matter.
    - `sampler`: `gibbs` or `pmmh`, usually with options: `functools.partial(jb.gibbs,
        num_iterations=1000)`. It is called as `sampler(key, model, times, observations, prior=...,
        observation=..., initial=..., where=...)`, with `constraint` and `jumps` if these are given.
        Any function of these arguments will do that returns an object with `theta` (n, p) or
        (chains, n, p), `effective_sample_size` and `trustworthy`.
    - `prior`: a `NormalPrior`, cut off where `constraint` is false.
    - `num_simulations`: S.
    - `num_steps`: number of steps between two times in the simulation. More than in the sampler
        shows the discretisation error of the latter, too.
    - `progress_meter`: a progress meter of diffrax, for instance `diffrax.TextProgressMeter()`.

    **Returns:** `Calibration`.

    **Raises:** `ValueError` and `TypeError` for invalid arguments, and if hardly any draw of the
    prior satisfies `constraint`.

    **Example:**

    ```python
    import functools

    made = jb.simulation_based_calibration(
        key, model, times, observations, functools.partial(jb.gibbs, num_iterations=300),
        prior=jb.NormalPrior(model.params.B, 0.01), where=lambda p: p.B,
        observation=jb.LinearGaussian(covariance=0.1), num_simulations=5,
    )  # fmt: skip
    made.p_uniform  # small if posteriors are wrong
    ```

    **Source:** Talts et al. (2018).
    """
    check_key(key)
    if not callable(sampler) or isinstance(sampler, type):
        raise TypeError(
            "`sampler` must be a function such as `functools.partial(jb.gibbs, "
            f"num_iterations=1000)`; got {shown(sampler)}."
        )
    check_instance("prior", prior, NormalPrior, "a `NormalPrior`, from which parameters are drawn")
    num_simulations = check_count("num_simulations", num_simulations, 2)
    parameters = as_parameters(model, where, constraint, prior)
    is_read = np.isfinite(np.asarray(as_rows(observations)))
    like = parameters.vector(parameters.params)
    law = as_normal(prior, parameters, like)
    root = np.linalg.cholesky(np.linalg.inv(np.asarray(law.precision, float)))
    options: dict[str, Any] = {"observation": observation, "initial": initial}
    if jumps is not None:
        options["jumps"] = jumps
    given = options | {"prior": prior, "where": where}
    if constraint is not None:
        given["constraint"] = constraint

    def one(number: int):
        its_key = jax.random.fold_in(key, number)
        prior_key, record_key, run_key, rank_key = jax.random.split(its_key, 4)
        truth = _draw(prior_key, parameters, law.mean, root)
        record = simulate_observations(
            record_key,
            parameters.bind(truth),
            times,
            observations,
            num_steps=num_steps,
            **options,
        )
        if np.any(np.isnan(record[is_read])):
            unknown = np.full(len(truth), np.nan)
            return truth, unknown, unknown, False
        posterior = sampler(run_key, model, times, record, **given)
        draws = np.asarray(posterior.theta).reshape(-1, len(truth))
        sizes = np.asarray(posterior.effective_sample_size)
        ranks = _ranks(rank_key, np.asarray(truth), draws, sizes)
        return truth, ranks, sizes, np.all(np.asarray(posterior.trustworthy))

    results = [one(number) for number in metered(range(num_simulations), progress_meter)]
    truth, uniforms, sizes, trusted = map(jnp.array, zip(*results, strict=True))
    return Calibration(truth, uniforms, sizes, trusted, parameters.names)


def _draw(key, parameters, mean: Float[Array, " p"], root: np.ndarray) -> Float[Array, " p"]:
    """Draw θ from the prior, given the constraint."""
    for attempt in range(_MOST_ATTEMPTS):
        noise = jax.random.normal(jax.random.fold_in(key, attempt), mean.shape, mean.dtype)
        theta = mean + jnp.asarray(root, mean.dtype) @ noise
        if parameters.allowed(theta):
            return theta
    raise ValueError(
        f"none of {_MOST_ATTEMPTS:,} draws of `prior` satisfies `constraint`: pass a prior with "
        "more mass where the constraint holds."
    )


def _ranks(key, truth: np.ndarray, draws: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the rank of each parameter among draws that are nearly independent, in (0, 1)."""
    position = np.asarray(jax.random.uniform(key, truth.shape))
    ranks = np.empty(len(truth))
    for i, size in enumerate(sizes):
        number = int(np.clip(size if np.isfinite(size) else 1, 1, len(draws)))
        some = draws[np.linspace(0, len(draws) - 1, number).round().astype(int), i]
        ranks[i] = (np.sum(some < truth[i]) + position[i]) / (number + 1)
    return ranks
