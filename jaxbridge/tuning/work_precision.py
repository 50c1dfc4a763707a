"""Error against computing time, for the user's model and end points.

`work_precision` estimates one expectation over bridges by many settings. A setting combines a
proposal (with its scheme and meeting rule), a number of steps, a precision and a method. The error
of each estimate has three parts, which are reported separately:

* discretisation error: distance from the limit of the same setting for small steps;
* method error: distance of that limit from the exact law. It is zero except for approximate
  bridges, which have the law of bridges that are hit (Theorem 1);
* Monte Carlo error: standard error, which only more samples reduce.

The unit is the standard deviation of the estimated variable. For several variables the error is the
root mean square. Hence n independent exact bridges have a Monte Carlo error of n^{-1/2}. The
reference is given by the user, or a closed form if there is one. Otherwise it is a separate run
with more steps and more bridges.
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
from ..engine.entry import public_entry
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
    is_density,
    measure,
    user_density,
    user_estimate,
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


_NOTHING_TO_ESTIMATE = (
    "`fn` at `save_at` has the same value for all bridges, so there is nothing to estimate: choose "
    "times inside the interval, or another `fn`."
)
_FOR_COUPLINGS, _FOR_GUIDED = ("approximate", "renewal"), ("crank_nicolson",)


@public_entry
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
    """Measure error and computing time of many settings, for one model and one interval.

    Each setting is compiled separately, which takes some seconds; compile times are reported in
    their own column.

    **Arguments:**

    - `key`: typed key. All settings use it; the reference uses another.
    - `model`, `start`, `end`, `duration`: one interval, as in `sample_bridges`.
    - `num_steps`: numbers of steps. The times `save_at` must be on each grid; without `save_at` the
        numbers must be even. Extrapolation requires even numbers, and times that are also on the
        grids of half as many steps.
    - `proposals`: couplings (with γ, scheme and meeting rule) and guided proposals. By default
        `Coupling(gamma=0.0)` with `Heun()` and with `Euler()`, and also with `GaussianTransition()`
        for linear drift and constant σ.
    - `methods`: any of the following. Pairs of a method and a proposal that do not fit are left
        out.
        - "approximate": approximate bridges, for couplings;
        - "weights", "pseudo_marginal", "renewal", "crank_nicolson": exact bridges. "renewal" is for
            couplings, "crank_nicolson" for guided proposals;
        - "density": p_T(a, b), with relative errors;
        - "extrapolated_weights", "extrapolated_density": results on N and N/2 steps, combined by
            `extrapolate`.
    - `dtypes`: "float32", "float64". Double precision needs no configuration of JAX, but the
        model's functions must work in both precisions, because the reference is in double
        precision. (If you pass all references and omit "approximate", they need to work only in
        these `dtypes`.) Convert constants to the dtype of the point, or put them in `params`.
    - `num_bridges`: samples per setting. Discretisation errors below the Monte Carlo error are not
        detected.
    - `fn`: the estimated function, from the path at `save_at`, shape (K, d), to an array. By
        default the path itself.
    - `save_at`: times, shape (K,), by default half the duration.
    - `target`: required accuracy in standard deviations. The printed table then ends with the
        cheapest setting that reaches it.
    - `reference`, `log_density`: the exact mean and standard deviation of `fn` as a pair, and
        log p_T(a, b), if you know them. For Ornstein–Uhlenbeck processes they are computed.
    - `reference_steps`, `reference_bridges`: size of reference runs, for exact values without a
        closed form and for the limits of approximate bridges. By default four times the largest
        number of steps, and 4 × `num_bridges`.
    - `repeats`: number of timed runs; their median is reported.
    - `progress_meter`: a progress meter of diffrax, for instance `diffrax.TextProgressMeter()`.

    **Returns:** `WorkPrecision`, which prints as a table.

    **Raises:** `ValueError` and `TypeError` for invalid arguments; `ValueError` if a reference run
    finds no bridges; `TypeError` if the model does not work in the required precisions.

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
    # A single step here: the grids of the settings are checked below.
    problem = bridge_problem(model, start, end, duration, 1)
    if problem.batched:
        raise ValueError(
            "`work_precision` takes one interval: pass `start` and `end` of shape (d,), and "
            f"`duration` of shape (); got {len(problem.intervals.duration)} intervals in an axis."
        )
    num_steps = as_sequence("num_steps", num_steps, "numbers of steps")
    methods = as_sequence("methods", methods, "methods")
    dtypes = as_sequence("dtypes", dtypes, "dtypes")
    check_function("fn", fn, "(path)", optional=True)
    steps = [check_count("num_steps", n) for n in num_steps]
    for name, count in [("num_bridges", num_bridges), ("repeats", repeats)]:
        check_count(name, count)
    _check_settings(steps, methods, dtypes, target)
    of_paths = _candidates(proposals, model, problem.like, False)
    of_densities = _candidates(proposals, model, problem.like, True)
    if save_at is None:
        save_at = [float(problem.intervals.duration[0]) / 2]
        if any(n % 2 for n in steps):
            raise ValueError(
                "`num_steps` must be even if `save_at` is omitted, because its default is half the "
                f"duration; got {tuple(steps)}."
            )
    grids = [*steps, *(n // 2 for n in steps)] if set(methods) & set(EXTRAPOLATED) else steps
    if len(grids) > len(steps) and any(n % 2 for n in steps):
        raise ValueError(f"`num_steps` must be even for extrapolation; got {tuple(steps)}.")
    # Raise if a time of `save_at` is missing on some grid.
    for candidate, n in itertools.product(of_paths, grids):
        problem.keep(save_at, duration, candidate.fractions(n))
    runs = _runs(methods, of_paths, of_densities, dtypes, steps, num_bridges)
    _check_references(runs, fn, reference, log_density)
    if any(is_density(method) for method in methods):
        for candidate in of_densities:
            candidate.check_for_density(model)
    finest_steps, num_reference = reference_steps, reference_bridges
    finest_steps = 4 * max(steps) if finest_steps is None else finest_steps
    num_reference = 4 * num_bridges if num_reference is None else num_reference
    finest_run = Run(
        "weights",
        of_paths[0],
        "float64",
        check_count("reference_steps", finest_steps),
        check_count("reference_bridges", num_reference),
    )
    function = (lambda points: points) if fn is None else fn
    start_point, end_point = (np.asarray(point[0]) for point in problem.intervals[:2])
    length = float(problem.intervals.duration[0])
    times = np.asarray(as_floating("save_at", save_at), float)
    # End points are the same for all bridges.
    inside = (times > 0) & (times < length)
    if not inside.any() and not all(map(is_density, methods)):
        raise ValueError(_NOTHING_TO_ESTIMATE)
    scene = Scene(model, start_point, end_point, length, times, function, fn is None)
    given_values = {False: user_estimate(reference), True: user_density(log_density)}
    # Without a reference run in double precision the model must work in the given dtypes only.
    needs_no_run = all(m != "approximate" and given_values[is_density(m)] for m in methods)
    check_precisions(scene, dtypes if needs_no_run else ("float32", "float64"))
    exact, limits = _references(key_for("reference", key), scene, runs, finest_run, given_values)
    meter = as_meter(progress_meter)
    state = meter.init()
    settings = []
    for num_finished, run in enumerate(runs, 1):
        truth = exact[is_density(run.method)]
        # Approximate bridges converge to a law of their own, not to the exact one.
        limit = limits[id(run.proposal)] if run.method == "approximate" else truth
        # The same key for all settings reduces the noise of comparisons.
        settings.append(measure(key, scene, run, truth, limit, repeats))
        state = meter.step(state, jnp.asarray(num_finished / len(runs)))
    meter.close(state)
    sources = dict.fromkeys(estimate.source for estimate in exact.values())
    return WorkPrecision(tuple(settings), "; ".join(sources), target)


def _runs(
    methods: Sequence[str],
    of_paths: Sequence[AbstractProposal],
    of_densities: Sequence[AbstractProposal],
    dtypes: Sequence[str],
    steps: Sequence[int],
    num_bridges: int,
) -> list[Run]:
    """Return all settings, without the pairs of a method and a proposal that do not fit."""
    runs = [
        Run(method, candidate, dtype, n, num_bridges)
        for method in methods
        for candidate in (of_densities if is_density(method) else of_paths)
        if method not in (_FOR_GUIDED if candidate.coupled else _FOR_COUPLINGS)
        for dtype, n in itertools.product(dtypes, steps)
    ]
    if not runs:
        raise ValueError(
            f"none of `proposals` fits any of `methods`; got the methods {tuple(methods)}. "
            'Add a coupling, such as `Coupling(0.5)`, for "approximate" and "renewal", or a guided '
            'proposal, such as `Guided()`, for "crank_nicolson".'
        )
    return runs


def _check_references(
    runs: Sequence[Run], fn: Any, reference: Any, log_density: Numbers | None
) -> None:
    """Raise `ValueError` for arguments that none of the methods uses."""
    of_density = {is_density(run.method) for run in runs}
    # The options that the methods in use ignore.
    of_paths = {"fn": fn, "reference": reference} if of_density == {True} else {}
    of_densities = {"log_density": log_density} if of_density == {False} else {}
    for kind, values in (("of paths", of_paths), ('"density"', of_densities)):
        names = [f"`{name}`" for name, value in values.items() if value is not None]
        if names:
            raise ValueError(
                f"{' and '.join(names)}: for a method {kind}, which is not among `methods`. Omit "
                "the option, or add such a method."
            )


def _check_settings(
    steps: Sequence[int], methods: Sequence[str], dtypes: Sequence[str], target: float | None
) -> None:
    if not steps:
        raise ValueError("`num_steps` must contain at least one number of steps; got none.")
    if not methods or not all(isinstance(m, str) and m in METHODS for m in methods):
        raise ValueError(f"`methods` must be names among {METHODS}; got {tuple(methods)}.")
    if not dtypes or not all(isinstance(d, str) and d in _DTYPES for d in dtypes):
        raise ValueError(f'`dtypes` must be "float32" or "float64" or both; got {tuple(dtypes)}.')
    if target is not None and not as_numbers({"target": target})["target"] > 0:
        raise ValueError(f"`target` must be positive; got {target}.")


def _candidates(
    proposals: Sequence[Any] | None, model: Diffusion, like: Float[Array, " d"], for_density: bool
) -> list[AbstractProposal]:
    if proposals is None:
        proposals = [Coupling(scheme=Heun()), Coupling(scheme=Euler())]
        if is_linear(model.forward(like), like):
            proposals.append(Coupling(scheme=GaussianTransition()))
    proposals = as_sequence("proposals", proposals, "proposals")
    candidates = [
        as_proposal(
            proposal, model, like, name="proposals", for_density=for_density, normal_steps=False
        )
        for proposal in proposals
    ]
    if any(len(candidate.singles) > 1 for candidate in candidates):
        raise ValueError(
            '`proposals` must be single proposals; "auto" and a result of `choose_proposal` stand '
            "for several. Pass the candidates instead."
        )
    return candidates


def _references(
    key: Key[Array, ""],
    scene: Scene,
    runs: Sequence[Run],
    finest_run: Run,
    user_values: dict[bool, Estimate | None],
) -> tuple[dict[bool, Estimate], dict[int, Estimate]]:
    """Estimate the references in double precision.

    Return two dictionaries. The first has the exact values of the methods in `runs`: for paths
    (key False) and for the density (key True). The second has the limits of approximate bridges, by
    the `id` of their proposals.
    """
    # More draws than those of the settings, so that the error of the reference is negligible.
    num_draws = min(20 * finest_run.num_bridges, 1_000_000)
    with jax.enable_x64(True):
        exact = {
            density: user_values[density]
            or closed_form(key, scene, density, num_draws)
            or finest(key, scene, finest_run._replace(method=name))
            for name, density in [("weights", False), ("density", True)]
            if density in {is_density(run.method) for run in runs}
        }
        # By `id`, because proposals contain arrays, which have no hash.
        approximate = {id(r.proposal): r.proposal for r in runs if r.method == "approximate"}
        limits = {
            i: finest(key, scene, finest_run._replace(method="approximate", proposal=proposal))
            for i, proposal in approximate.items()
        }
    if not all(np.any(estimate.is_random) for estimate in exact.values()):
        raise ValueError(_NOTHING_TO_ESTIMATE)
    return exact, limits
