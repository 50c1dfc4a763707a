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
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ..coupling.base import AbstractCoupling
from ..coupling.bridges import sample_bridges
from ..coupling.gamma import Coupling
from ..coupling.meeting import AbstractMeeting, BrownianCrossing
from ..engine.checks import Numbers, cast_floats, check_count, check_key
from ..engine.diagnostics import effective_sample_size
from ..engine.keys import key_for
from ..engine.pareto import is_reliable
from ..exact.chains import sample_exact_bridges
from ..exact.density import check_for_density, transition_log_density
from ..exact.importance import sample_weighted_bridges
from ..models.diffusion import Diffusion, check_diffusion
from ..models.dynamics import is_linear
from ..models.gaussian_bridge import gaussian_bridge
from ..models.grid import stored_steps
from ..models.intervals import as_intervals
from ..models.ornstein_uhlenbeck import OrnsteinUhlenbeckParams, ou_transition
from ..proposals.choice import as_proposal, describe, singles
from ..proposals.coupled import CoupledPairs
from ..proposals.guided import AbstractGuidedProposal
from ..schemes.base import AbstractScheme
from ..schemes.euler import Euler
from ..schemes.gaussian_transition import GaussianTransition
from ..schemes.heun import Heun
from ..schemes.step_density import AbstractStepDensity, ItoTaylorDensity

METHODS = ("approximate", "weights", "pseudo_marginal", "renewal", "crank_nicolson", "density")
_FOR_COUPLINGS, _FOR_GUIDED = ("approximate", "renewal"), ("crank_nicolson",)


class Setting(NamedTuple):
    """One setting of `work_precision`, and what it came to.

    - `method`, `proposal`, `scheme`, `meeting`, `gamma`, `dtype`, `num_steps`: the setting;
        `scheme` is the target density of proposals that are pulled to the end point, and `gamma`
        NaN where there is none.
    - `error`: of the estimate, in standard deviations of the estimated variable (of a density:
        relative), with its `uncertainty`, a standard error.
    - `step_error` with its `step_uncertainty`, `method_error`, `monte_carlo_error`: its parts.
    - `seconds` of a run, and `compile_seconds`, which are apart.
    - `num_simulated`: paths simulated.
    - `effective_samples`: how many independent exact bridges have this Monte Carlo error.
    - `per_second`: those, per second.
    - `num_missing`: bridges that were not found, or whose weights were cut off: the estimate is
        that of the others, or NaN if there are none.
    - `pareto_k`: k̂ of the weights, NaN where there are none. Above 0.7 no figure of the row is to
        be trusted.
    """

    method: str
    proposal: str
    scheme: str
    meeting: str
    gamma: float
    dtype: str
    num_steps: int
    error: float
    uncertainty: float
    step_error: float
    step_uncertainty: float
    method_error: float
    monte_carlo_error: float
    seconds: float
    compile_seconds: float
    num_simulated: int
    effective_samples: float
    per_second: float
    num_missing: int = 0
    pareto_k: float = np.nan

    @property
    def curve(self) -> str:
        """All but the number of steps, in words."""
        words = (self.method, self.proposal, self.scheme, self.meeting, self.dtype)
        return ", ".join(word for word in words if word)

    def seconds_for(self, target: float) -> float:
        """Seconds until the root of the sum of both squared errors is below `target`: the one that
        stays, at its upper end, and the Monte Carlo error of a longer run. Infinite where the
        former is above, be it for its uncertainty alone."""
        stays = self.error + self.uncertainty
        if not stays < target:
            return np.inf
        return 1 / (target**2 - stays**2) / self.per_second


class Order(NamedTuple):
    """The fitted exponent of the step error in the step length, and its standard error, in which
    the error of the reference, common to all points, is not counted; NaN where fewer than two step
    errors can be told from noise."""

    order: float
    error: float


class WorkPrecision(NamedTuple):
    """What `work_precision` returns.

    - `settings`: a tuple of `Setting`; `pandas.DataFrame(result.settings)` is a table.
    - `reference`: "exact", or how the finest run was made.
    - `target`: the accuracy asked for, or `None`.
    """

    settings: tuple[Setting, ...]
    reference: str
    target: float | None

    def as_dict(self) -> dict[str, np.ndarray]:
        """The table as one array for each column."""
        columns = zip(*self.settings, strict=True)
        return {
            name: np.array(column) for name, column in zip(Setting._fields, columns, strict=True)
        }

    def cheapest(self, target: float | None = None) -> Setting | None:
        """The setting that reaches an accuracy, by default `target`, in the least time; `None`
        where none does, or the uncertainty of their errors is too large to tell."""
        target = self.target if target is None else target
        if target is None:
            raise ValueError("`cheapest` needs a `target`: an error in standard deviations.")
        best = min(self.settings, key=lambda setting: setting.seconds_for(target))
        return best if np.isfinite(best.seconds_for(target)) else None

    def statement(self, target: float | None = None) -> str:
        """What an accuracy costs here, in a sentence."""
        target = self.target if target is None else target
        best = self.cheapest(target)
        if target is None or best is None:
            return (
                f"accuracy {target:g}: none of these settings is seen to reach it; take more "
                "steps, or more bridges"
            )
        seconds = best.seconds_for(target)
        return (
            f"accuracy {target:g} costs {seconds:.2g} s here: {best.curve}, {best.num_steps} steps"
        )

    def orders(self) -> dict[str, Order]:
        """The order of the step error of each curve."""
        return {curve: _fit_order(group) for curve, group in self.curves()}

    def curves(self) -> Iterator[tuple[str, list[Setting]]]:
        """The settings that differ in the number of steps only, by what they share."""
        for curve in dict.fromkeys(setting.curve for setting in self.settings):
            yield curve, [setting for setting in self.settings if setting.curve == curve]

    def __str__(self) -> str:
        head = ("steps", "error", "±", "step", "method", "Monte Carlo", "seconds", "compile")
        row = "{:>8} {:>9} {:>8} {:>9} {:>9} {:>12} {:>9} {:>8} {:>10} {:>10}"
        lines = [row.format(*head, "paths", "eff/s")]
        for curve, group in self.curves():
            order = _fit_order(group)
            fitted = f"   order {order.order:.2f} ± {order.error:.2f}"
            lines.append(curve + ("" if np.isnan(order.order) else fitted))
            for s in group:
                parts = (s.error, s.uncertainty, s.step_error, s.method_error, s.monte_carlo_error)
                errors = (f"{part:.4f}" for part in parts)
                times = (f"{s.seconds:.3f}", f"{s.compile_seconds:.1f}")
                work = (f"{s.num_simulated:,}", f"{s.per_second:,.0f}")
                missing = f"   {s.num_missing:,} missing" if s.num_missing else ""
                if not (np.isnan(s.pareto_k) or is_reliable(jnp.asarray(s.pareto_k))):
                    missing += f"   heavy tails, k = {s.pareto_k:.2f}"
                lines.append(row.format(s.num_steps, *errors, *times, *work) + missing)
        lines.append(f"reference: {self.reference}")
        if self.target is not None:
            lines.append(self.statement())
        return "\n".join(lines)


class _Estimate(NamedTuple):
    """The mean of m variables, its standard error and their standard deviation, from simulated
    paths, or another source in words."""

    mean: Float[np.ndarray, " m"]
    error: Float[np.ndarray, " m"]
    sd: Float[np.ndarray, " m"]
    num_simulated: int = 0
    num_missing: int = 0
    source: str = "exact"

    @property
    def is_random(self) -> np.ndarray:
        """Not the same for all bridges, as end points are, up to rounding."""
        scale = max(np.abs(self.mean).max(), self.sd.max())
        return self.sd > 1e-6 * scale


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
        a proposal does not fit a method the pair is left out.
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
    check_diffusion(model)
    intervals, batched, several_durations = as_intervals(start, end, duration)
    if batched or several_durations:
        raise ValueError("`work_precision` looks at one interval: `start` and `end` of shape (d,).")
    steps = [check_count("num_steps", n) for n in num_steps]
    for name, count in [("num_bridges", num_bridges), ("repeats", repeats)]:
        check_count(name, count)
    if not steps:
        raise ValueError("`num_steps` must have at least one number of steps.")
    unknown = [method for method in methods if method not in METHODS]
    if unknown or not methods:
        raise ValueError(f"`methods` must be some of {METHODS}; got {tuple(methods)}.")
    if any(dtype not in ("float32", "float64") for dtype in dtypes) or not dtypes:
        raise ValueError(f'`dtypes` must be "float32" or "float64"; got {tuple(dtypes)}.')
    if target is not None and not target > 0:
        raise ValueError(f"`target` must be positive; got {target}.")
    like = intervals.start[0]
    if proposals is None:
        proposals = [Coupling(scheme=Heun()), Coupling(scheme=Euler())]
        if is_linear(model.forward(like), like):
            proposals.append(Coupling(scheme=GaussianTransition()))
    candidates = [as_proposal(proposal, model, like) for proposal in proposals]
    if any(len(singles(candidate)) > 1 for candidate in candidates):
        raise ValueError('`proposals` must be single ones; "auto" chooses between several.')
    if save_at is None:
        save_at = [float(intervals.duration[0]) / 2]
        if any(n % 2 for n in steps):
            raise ValueError(
                "`num_steps` must be even where `save_at` is left to its default, half the "
                f"duration; got {tuple(steps)}."
            )
    for candidate, n in itertools.product(candidates, steps):
        stored_steps(save_at, duration, candidate.fractions(n))
    scene = _Scene(
        model,
        np.asarray(intervals.start[0]),
        np.asarray(intervals.end[0]),
        float(intervals.duration[0]),
        np.asarray(save_at, float),
        (lambda points: points) if fn is None else fn,
        fn is None,
    )
    runs = [
        (method, i, dtype, n)
        for method, (i, candidate) in itertools.product(methods, enumerate(candidates))
        if _fits(method, candidate)
        for dtype, n in itertools.product(dtypes, steps)
    ]
    if not runs:
        raise ValueError(f"none of `proposals` fits any of `methods`; got {tuple(methods)}.")
    if "density" in methods:
        for candidate in candidates:
            check_for_density(candidate, model)
    finest = (
        4 * max(steps)
        if reference_steps is None
        else check_count("reference_steps", reference_steps)
    )
    most = (
        4 * num_bridges
        if reference_bridges is None
        else check_count("reference_bridges", reference_bridges)
    )
    known = {True: log_density is not None, False: reference is not None}
    alone = "approximate" not in methods and all(known[m == "density"] for m in methods)
    _check_precisions(scene, dtypes if alone else ("float32", "float64"))
    fine_key = key_for("reference", key)
    with jax.enable_x64(True):  # references are made in double precision
        exact = {
            density: _given(reference, log_density, density)
            or _closed_form(fine_key, scene, density, min(20 * most, 1_000_000))
            or _finest(fine_key, scene, name, candidates[0], finest, most)
            for name, density in [("weights", False), ("density", True)]
            if density in {method == "density" for method, *_ in runs}
        }
        limits = {
            i: _finest(fine_key, scene, "approximate", candidates[i], finest, most)
            for i in {i for method, i, *_ in runs if method == "approximate"}
        }
    if not all(np.any(estimate.is_random) for estimate in exact.values()):
        raise ValueError("`fn` at `save_at` is the same for all bridges: nothing to estimate.")
    meter = diffrax.NoProgressMeter() if progress_meter is None else progress_meter
    state = meter.init()
    settings = []
    for done, (method, i, dtype, n) in enumerate(runs, 1):
        truth = exact[method == "density"]
        limit = limits[i] if method == "approximate" else truth
        arguments = (method, candidates[i], dtype, n, num_bridges)
        settings.append(_measure(key, scene, truth, limit, *arguments, repeats))
        state = meter.step(state, jnp.asarray(done / len(runs)))
    meter.close(state)
    sources = dict.fromkeys(estimate.source for estimate in exact.values())
    return WorkPrecision(tuple(settings), "; ".join(sources), target)


class _Scene(NamedTuple):
    """What is estimated."""

    model: Diffusion
    start: np.ndarray
    end: np.ndarray
    duration: float
    save_at: np.ndarray
    fn: Callable[[Array], Array]
    is_path: bool

    def interval(self, dtype: str) -> tuple[Any, ...]:
        """The model and the interval in one precision; x64 must be enabled for float64."""
        points = (jnp.asarray(point, dtype) for point in (self.start, self.end))
        return cast_floats(self.model, dtype), *points, jnp.asarray(self.duration, dtype)

    def values(self, paths: Float[Array, "n K d"]) -> Float[np.ndarray, "n m"]:
        """`fn` of each path."""
        return np.asarray(jax.vmap(lambda path: jnp.ravel(self.fn(path)))(paths), float)


def _check_precisions(scene: _Scene, dtypes: Sequence[str]) -> None:
    """Raise `TypeError` where the model's functions cannot be traced in all of these, before
    anything is compiled: JAX remembers the precision in which it first saw a NumPy constant inside
    a derivative, and then mixes that with another."""

    def look(model: Diffusion, x: Array):
        forward = model.forward(x)
        seen = [jax.jacfwd(forward.drift)(x), forward.sigma(x).as_matrix(x.shape[0], x.dtype)]
        if model.has_density:
            seen.append(jax.grad(model.log_stationary)(x))
        if model.has_reversal:
            seen.append(model.backward(x).drift(x))
        return seen

    for dtype in dict.fromkeys(dtypes):
        with jax.enable_x64(dtype == "float64"):
            model, x, *_ = scene.interval(dtype)
            try:
                eqx.filter_eval_shape(eqx.filter_jit(look), model, x)
            except TypeError as error:
                raise TypeError(
                    "the model's functions do not serve in single and in double precision, in "
                    "which settings and the reference are run: take constants to the precision of "
                    "the point, `jnp.asarray(constant, x.dtype)`, or give them to `Diffusion` "
                    f"among its `params`. ({error})"
                ) from error


def _run(
    key: Key[Array, ""],
    scene: _Scene,
    method: str,
    candidate: Any,
    dtype: str,
    num_steps: int,
    num_bridges: int,
) -> Any:
    """The result of the call that is timed."""
    arguments = (key, *scene.interval(dtype))
    candidate = cast_floats(candidate, dtype)
    if method == "density":
        return transition_log_density(
            *arguments, num_proposals=num_bridges, num_steps=num_steps, proposal=candidate
        )
    options = {"num_bridges": num_bridges, "num_steps": num_steps, "save_at": scene.save_at}
    if method == "approximate":
        return sample_bridges(*arguments, coupling=candidate.coupling, **options)
    if method == "weights":
        return sample_weighted_bridges(*arguments, proposal=candidate, **options)
    chain: Any = method
    return sample_exact_bridges(*arguments, proposal=candidate, method=chain, **options)


def _estimate(scene: _Scene, method: str, result: Any) -> _Estimate:
    """Means and their errors, in double precision, from what a run returned."""
    if method == "density":
        found = np.isfinite(result.value)
        value = np.where(found, np.exp(np.asarray(result.value, float)), np.nan)[None]
        relative = float(result.standard_error)
        simulated, truncated = int(result.num_simulated), int(result.num_truncated)
        return _Estimate(value, value * relative, value, simulated, truncated)
    met = np.asarray(result.met)
    values = scene.values(result.paths)[met]
    truncated = np.asarray(getattr(result, "truncated", False))
    missing = int(np.sum(~met | truncated))
    simulated = result.num_proposals if method == "approximate" else result.num_simulated
    if len(values) == 0:
        unknown = np.full(values.shape[1], np.nan)
        return _Estimate(unknown, unknown, unknown, int(simulated), missing)
    if method == "weights":
        weights = np.asarray(result.weights, float)[met]
        weights /= weights.sum()
        mean = weights @ values
        deviations = (values - mean) ** 2
        error, sd = np.sqrt(weights**2 @ deviations), np.sqrt(weights @ deviations)
    else:
        mean, sd = values.mean(0), values.std(0)
        independent = method == "approximate"
        size = len(values) if independent else np.asarray(effective_sample_size(values), float)
        error = sd / np.sqrt(size)
    return _Estimate(mean, error, sd, int(simulated), missing)


def _given(
    reference: tuple[Numbers, Numbers] | None, log_density: Numbers | None, density: bool
) -> _Estimate | None:
    """What the user knows."""
    if density:
        if log_density is None:
            return None
        value = np.exp(np.ravel(np.asarray(log_density, float)))
        return _Estimate(value, np.zeros_like(value), value)
    if reference is None:
        return None
    mean, sd = (np.ravel(np.asarray(part, float)) for part in reference)
    return _Estimate(mean, np.zeros_like(mean), sd)


def _closed_form(
    key: Key[Array, ""], scene: _Scene, density: bool, num_draws: int
) -> _Estimate | None:
    """The exact values for an Ornstein–Uhlenbeck process, of which only a function of the user's
    own needs draws."""
    if not isinstance(scene.model.params, OrnsteinUhlenbeckParams):
        return None
    model, start, end, duration = scene.interval("float64")
    if density:
        value = np.exp(np.asarray(ou_transition(model, start, duration).log_density(end)))[None]
        return _Estimate(value, np.zeros(1), value)
    bridge = gaussian_bridge(model, start, end, duration, scene.save_at)
    if not scene.is_path:
        values = scene.values(bridge.sample(key, num_draws))
        mean, sd = values.mean(0), values.std(0)
        words = f"{num_draws:,} draws of the exact law"
        return _Estimate(mean, sd / np.sqrt(num_draws), sd, source=words)
    mean = np.asarray(bridge.mean, float).ravel()
    sd = np.sqrt(np.diagonal(np.asarray(bridge.covariance), axis1=1, axis2=2)).ravel()
    return _Estimate(mean, np.zeros_like(mean), sd)


def _finest(
    key: Key[Array, ""],
    scene: _Scene,
    method: str,
    candidate: Any,
    num_steps: int,
    num_bridges: int,
) -> _Estimate:
    """A fine run by the best scheme there is; to its error belongs what half the steps change."""
    limit = _at_its_best(candidate, scene)

    def run(key, num_steps):
        result = _run(key, scene, method, limit, "float64", num_steps, num_bridges)
        return _estimate(scene, method, result)

    fine, coarse = run(key, num_steps), run(jax.random.fold_in(key, 1), max(num_steps // 2, 1))
    if not np.all(np.isfinite(fine.mean) & np.isfinite(coarse.mean)):
        raise ValueError(
            f"the reference, {describe(limit)} in {num_steps} steps, found no bridges: choose "
            "other `proposals`, or pass what is known as `reference`."
        )
    chance = fine.error**2 + coarse.error**2
    changed = np.maximum((fine.mean - coarse.mean) ** 2 - chance, 0)
    words = f"{describe(limit)}, {method}, {num_steps} steps, {num_bridges:,} bridges"
    return fine._replace(error=np.sqrt(fine.error**2 + changed), source=words)


def _at_its_best(candidate: Any, scene: _Scene) -> Any:
    """The same proposal with the best scheme there is for it."""

    def is_leaf(node):
        return isinstance(node, AbstractMeeting | AbstractScheme | AbstractStepDensity)

    if isinstance(candidate, CoupledPairs):
        return eqx.tree_at(
            lambda pairs: (pairs.coupling.meeting, pairs.coupling.scheme),
            candidate,
            (BrownianCrossing(), Heun()),
            is_leaf=is_leaf,
        )
    if scene.model.forward(jnp.asarray(scene.start)).sigma_varies:
        return candidate
    return eqx.tree_at(lambda p: p.density, candidate, ItoTaylorDensity(), is_leaf=is_leaf)


def _measure(
    key: Key[Array, ""],
    scene: _Scene,
    exact: _Estimate,
    limit: _Estimate,
    method: str,
    candidate: Any,
    dtype: str,
    num_steps: int,
    num_bridges: int,
    repeats: int,
) -> Setting:
    """Run one setting, time it and compare."""
    with jax.enable_x64(dtype == "float64"):

        def run():
            begin = time.perf_counter()
            arguments = (key, scene, method, candidate, dtype, num_steps, num_bridges)
            result = jax.block_until_ready(_run(*arguments))
            return result, time.perf_counter() - begin

        result, first = run()
        seconds = float(np.median([run()[1] for _ in range(repeats)]))
        found = _estimate(scene, method, result)
        shape = getattr(result, "pareto_k", None)

    def size(difference):
        ratio = difference[exact.is_random] / exact.sd[exact.is_random]
        return float(np.sqrt(np.mean(ratio**2)))

    monte_carlo = size(found.error)
    effective = monte_carlo**-2 if monte_carlo > 0 else np.nan
    scheme, meeting, gamma = _describe_parts(candidate)
    return Setting(
        method,
        describe(candidate),
        scheme,
        meeting,
        gamma,
        dtype,
        num_steps,
        size(found.mean - exact.mean),
        size(np.hypot(found.error, exact.error)),
        size(found.mean - limit.mean),
        size(np.hypot(found.error, limit.error)),
        size(limit.mean - exact.mean),
        monte_carlo,
        seconds,
        max(first - seconds, 0.0),
        found.num_simulated,
        effective,
        effective / seconds,
        found.num_missing,
        np.nan if shape is None else float(shape),
    )


def _fits(method: str, candidate: Any) -> bool:
    coupled = isinstance(candidate, CoupledPairs)
    return method not in (_FOR_GUIDED if coupled else _FOR_COUPLINGS)


def _describe_parts(candidate: Any) -> tuple[str, str, float]:
    """Scheme, meeting rule and γ of a proposal."""
    if isinstance(candidate, CoupledPairs):
        coupling: AbstractCoupling = candidate.coupling
        gamma = float(coupling.gamma) if isinstance(coupling, Coupling) else np.nan
        radius = getattr(coupling.meeting, "radius", None)
        meeting = type(coupling.meeting).__name__
        meeting += "" if radius is None else f"({float(radius):g})"
        return type(coupling.scheme).__name__, meeting, gamma
    assert isinstance(candidate, AbstractGuidedProposal)
    return type(candidate.density).__name__, "", np.nan


def _fit_order(group: Sequence[Setting]) -> Order:
    """Least squares of log step error against log number of steps, weighted by how well each is
    known; those within two standard errors of zero are left out."""
    known = [s for s in group if s.step_error > 2 * s.step_uncertainty]
    if len({s.num_steps for s in known}) < 2:
        return Order(np.nan, np.nan)
    x = -np.log([s.num_steps for s in known])
    y = np.log([s.step_error for s in known])
    weight = np.array([(s.step_error / s.step_uncertainty) ** 2 for s in known])
    centred = x - np.average(x, weights=weight)
    spread = weight @ centred**2
    return Order(float(weight * centred @ y / spread), float(spread**-0.5))
