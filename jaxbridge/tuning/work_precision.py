"""What accuracy costs in time, for a model and end points of the user's own.

An expectation over bridges is estimated by many settings: kinds of proposals with their schemes
and meeting rules, numbers of steps, precisions and methods. Each estimate has three errors,
which are told apart:

* the step error, the distance of the setting from its own limit as the steps shrink;
* the error of the method, the distance of that limit from the exact law: zero but for
  approximate bridges, whose law is that of bridges that are hit (Theorem 1);
* the Monte Carlo error, which only more samples reduce.

All are in units of standard deviations of what is estimated, root mean squares over its
entries, so that n independent exact bridges have a Monte Carlo error of n^{-1/2}. The reference
is the closed form where there is one, otherwise a finer and longer run that no setting shares.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ..coupling import Coupling
from ..engine.arguments import as_sequence, check_function
from ..engine.checks import Numbers, as_floating, as_numbers, check_count, check_key
from ..engine.doors import door
from ..engine.keys import key_for
from ..engine.progress import as_meter
from ..models.bridge_problem import bridge_problem
from ..models.diffusion import Diffusion
from ..models.dynamics import is_linear
from ..proposals import AbstractProposal, as_proposal
from ..schemes import Euler, GaussianTransition, Heun
from .measurement import (
    EXTRAPOLATED,
    Estimate,
    Run,
    Scene,
    check_precisions,
    closed_form,
    finest,
    given,
    given_density,
    is_density,
    measure,
)
from .settings import WorkPrecision

_DTYPES = ("float32", "float64")
METHODS = (
    "approximate",
    "weights",
    "pseudo_marginal",
    "renewal",
    "crank_nicolson",
    "density",
    *EXTRAPOLATED,
)


_NOTHING_TO_ESTIMATE = "`fn` at `save_at` is the same for all bridges: nothing to estimate."
_FOR_COUPLINGS, _FOR_GUIDED = ("approximate", "renewal"), ("crank_nicolson",)


@door
def work_precision(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_steps: Sequence[int] = (10, 20, 40, 80),
    proposals: Sequence[Any] | None = None,
    methods: Sequence[str] = ("approximate", "weights"),
    dtypes: Sequence[str] = ("float32",),
    num_bridges: int = 10_000,
    fn: Callable[[Array], Array] | None = None,
    save_at: Numbers | None = None,
    target: float | None = None,
    reference: tuple[Numbers, Numbers] | None = None,
    log_density: Numbers | None = None,
    reference_steps: int | None = None,
    reference_bridges: int | None = None,
    repeats: int = 3,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> WorkPrecision:
    """What accuracy costs in time, for this model and these end points.

    Each setting is compiled: some seconds each, which are reported apart.

    **Arguments:**

    - `key`: a typed key; all settings have it, the reference another.
    - `model`, `start`, `end`, `duration`: one interval, as in `sample_bridges`.
    - `num_steps`: numbers of steps, each with the times `save_at` on its grid.
    - `proposals`: couplings, with their γ, scheme and meeting rule, and proposals that are pulled
        to the end point. By default `Coupling(gamma=0.0)` with `Heun()` and with `Euler()`, and
        for linear drift and constant σ with `GaussianTransition()`.
    - `methods`: "approximate" for couplings; "weights", "pseudo_marginal", "renewal",
        "crank_nicolson" for exact bridges; "density" for p_T(a, b), whose error is relative. Where
        a proposal does not fit a method the pair is left out. "extrapolated_weights" and
        "extrapolated_density" add half as many steps to each number of steps, and combine the two
        (`extrapolate`).
    - `dtypes`: "float32", "float64". The latter needs no configuration, but constants in the
        model's functions must be of the precision of the point, or in `params`: the reference is
        in double precision whatever is asked for here.
    - `num_bridges`: samples of each setting: what their number leaves of uncertainty cannot be
        told from a step error.
    - `fn`: what to estimate, a function of the path at `save_at`, shape (K, d), to an array; by
        default the path itself.
    - `save_at`: times, shape (K,), by default half the duration.
    - `target`: an accuracy in standard deviations, for which the cheapest setting is named.
    - `reference`, `log_density`: the exact mean and standard deviation of `fn`, and log p_T(a, b),
        where you know them. Those of Ornstein–Uhlenbeck processes are known.
    - `reference_steps`, `reference_bridges`: of the reference, where there is no closed form; by
        default four times the most steps, and four times as many bridges.
    - `repeats`: runs of which the median is timed.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.

    **Returns:** `WorkPrecision`, a table when printed.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    **Example:**

    ```python
    result = jb.work_precision(
        key, model, start, end, 1.0, proposals=[jb.Coupling()], num_steps=(4, 8), target=0.05
    )
    print(result)
    result.cheapest()  # or `plot.work_precision(result)`
    ```
    """
    check_key(key)
    problem = bridge_problem(model, start, end, duration, 1)
    if problem.batched:
        raise ValueError("`work_precision` looks at one interval: `start` and `end` of shape (d,).")
    num_steps = as_sequence("num_steps", num_steps, "numbers of steps")
    methods = as_sequence("methods", methods, "methods")
    dtypes = as_sequence("dtypes", dtypes, "dtypes")
    check_function("fn", fn, "(path)", optional=True)
    steps = [check_count("num_steps", n) for n in num_steps]
    for name, count in [("num_bridges", num_bridges), ("repeats", repeats)]:
        check_count(name, count)
    _check_settings(steps, methods, dtypes, target)
    candidates = _candidates(proposals, model, problem.like)
    if save_at is None:
        save_at = [float(problem.intervals.duration[0]) / 2]
        if any(n % 2 for n in steps):
            raise ValueError(
                "`num_steps` must be even where `save_at` is left to its default, half the "
                f"duration; got {tuple(steps)}."
            )
    grids = [*steps, *(n // 2 for n in steps)] if set(methods) & set(EXTRAPOLATED) else steps
    if len(grids) > len(steps) and any(n % 2 for n in steps):
        raise ValueError(f"to extrapolate, `num_steps` must be even; got {tuple(steps)}.")
    for candidate, n in itertools.product(candidates, grids):
        problem.keep(save_at, duration, candidate.fractions(n))
    runs = _runs(methods, candidates, dtypes, steps, num_bridges)
    _check_references(runs, fn, reference, log_density)
    if any(is_density(method) for method in methods):
        for candidate in candidates:
            candidate.check_for_density(model)
    finest_steps, most = reference_steps, reference_bridges
    finest_steps = 4 * max(steps) if finest_steps is None else finest_steps
    most = 4 * num_bridges if most is None else most
    finest_run = Run(
        "weights",
        candidates[0],
        "float64",
        check_count("reference_steps", finest_steps),
        check_count("reference_bridges", most),
    )
    whole = (lambda points: points) if fn is None else fn
    start_point, end_point = (np.asarray(point[0]) for point in problem.intervals[:2])
    length = float(problem.intervals.duration[0])
    times = np.asarray(as_floating("save_at", save_at), float)
    inside = (times > 0) & (times < length)
    if not inside.any() and not all(map(is_density, methods)):
        raise ValueError(_NOTHING_TO_ESTIMATE)
    scene = Scene(model, start_point, end_point, length, times, whole, fn is None)
    given_values = {False: given(reference), True: given_density(log_density)}
    alone = all(m != "approximate" and given_values[is_density(m)] for m in methods)
    check_precisions(scene, dtypes if alone else ("float32", "float64"))
    exact, limits = _references(key_for("reference", key), scene, runs, finest_run, given_values)
    meter = as_meter(progress_meter)
    state = meter.init()
    settings = []
    for done, run in enumerate(runs, 1):
        truth = exact[is_density(run.method)]
        limit = limits[id(run.proposal)] if run.method == "approximate" else truth
        settings.append(measure(key, scene, run, truth, limit, repeats))
        state = meter.step(state, jnp.asarray(done / len(runs)))
    meter.close(state)
    sources = dict.fromkeys(estimate.source for estimate in exact.values())
    return WorkPrecision(tuple(settings), "; ".join(sources), target)


def _runs(
    methods: Sequence[str],
    candidates: Sequence[AbstractProposal],
    dtypes: Sequence[str],
    steps: Sequence[int],
    num_bridges: int,
) -> list[Run]:
    """All settings, but the pairs of a method and a proposal that do not fit."""
    runs = [
        Run(method, candidate, dtype, n, num_bridges)
        for method, candidate in itertools.product(methods, candidates)
        if method not in (_FOR_GUIDED if candidate.coupled else _FOR_COUPLINGS)
        for dtype, n in itertools.product(dtypes, steps)
    ]
    if not runs:
        raise ValueError(f"none of `proposals` fits any of `methods`; got {tuple(methods)}.")
    return runs


def _check_references(
    runs: Sequence[Run], fn: Any, reference: Any, log_density: Numbers | None
) -> None:
    """Raise `ValueError` for arguments that none of the methods uses."""
    of_density = {is_density(run.method) for run in runs}
    of_paths = {"fn": fn, "reference": reference} if of_density == {True} else {}
    of_densities = {"log_density": log_density} if of_density == {False} else {}
    for wanted, values in (("of paths", of_paths), ('"density"', of_densities)):
        names = [f"`{name}`" for name, value in values.items() if value is not None]
        if names:
            raise ValueError(
                f"{' and '.join(names)}: for a method {wanted}, which is not among `methods`. "
                "Leave this out."
            )


def _check_settings(
    steps: Sequence[int], methods: Sequence[str], dtypes: Sequence[str], target: float | None
) -> None:
    if not steps:
        raise ValueError("`num_steps` must have at least one number of steps.")
    if not methods or not all(isinstance(m, str) and m in METHODS for m in methods):
        raise ValueError(f"`methods` must be some of {METHODS}; got {tuple(methods)}.")
    if not dtypes or not all(isinstance(d, str) and d in _DTYPES for d in dtypes):
        raise ValueError(f'`dtypes` must be "float32" or "float64"; got {tuple(dtypes)}.')
    if target is not None and not as_numbers({"target": target})["target"] > 0:
        raise ValueError(f"`target` must be positive; got {target}.")


def _candidates(
    proposals: Sequence[Any] | None, model: Diffusion, like: Float[Array, " d"]
) -> list[AbstractProposal]:
    if proposals is None:
        proposals = [Coupling(scheme=Heun()), Coupling(scheme=Euler())]
        if is_linear(model.forward(like), like):
            proposals.append(Coupling(scheme=GaussianTransition()))
    proposals = as_sequence("proposals", proposals, "proposals")
    candidates = [as_proposal(proposal, model, like, name="proposals") for proposal in proposals]
    if any(len(candidate.singles) > 1 for candidate in candidates):
        raise ValueError('`proposals` must be single ones; "auto" chooses between several.')
    return candidates


def _references(
    key: Key[Array, ""],
    scene: Scene,
    runs: Sequence[Run],
    finest_run: Run,
    known: dict[bool, Estimate | None],
) -> tuple[dict[bool, Estimate], dict[int, Estimate]]:
    """What is exact, of paths and of the density, as far as they are asked for; and the limits of
    approximate bridges, by their proposals. They are made in double precision."""
    num_draws = min(20 * finest_run.num_bridges, 1_000_000)
    with jax.enable_x64(True):
        exact = {
            density: known[density]
            or closed_form(key, scene, density, num_draws)
            or finest(key, scene, finest_run._replace(method=name))
            for name, density in [("weights", False), ("density", True)]
            if density in {is_density(run.method) for run in runs}
        }
        approximate = {id(r.proposal): r.proposal for r in runs if r.method == "approximate"}
        limits = {
            i: finest(key, scene, finest_run._replace(method="approximate", proposal=proposal))
            for i, proposal in approximate.items()
        }
    if not all(np.any(estimate.is_random) for estimate in exact.values()):
        raise ValueError(_NOTHING_TO_ESTIMATE)
    return exact, limits
