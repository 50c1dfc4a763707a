"""Estimates of one quantity over bridges: by a setting, in closed form, and by a reference run.

`work_precision` chooses the settings; this module runs and times one of them.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ..coupling import sample_bridges
from ..engine.arguments import as_returned, as_sequence
from ..engine.averages import as_path_function
from ..engine.checks import Numbers, as_floating, as_numbers, cast_floats
from ..engine.diagnostics import effective_sample_size
from ..engine.keys import key_for
from ..exact import (
    extrapolate,
    sample_exact_bridges,
    sample_weighted_bridges,
    transition_log_density,
)
from ..exact.extrapolation import leading_share
from ..models.diffusion import Diffusion
from ..models.gaussian_bridge import gaussian_bridge
from ..models.ornstein_uhlenbeck import OrnsteinUhlenbeckParams, ou_transition
from .settings import Setting

# Methods that combine two grids, and the method that runs on each grid.
EXTRAPOLATED = {"extrapolated_weights": "weights", "extrapolated_density": "density"}


def is_density(method: str) -> bool:
    """Return whether `method` estimates p_T(a, b)."""
    return EXTRAPOLATED.get(method, method) == "density"


class Estimate(NamedTuple):
    """Estimated mean of m variables, with its standard error and their standard deviation.

    `num_simulated` and `num_missing` count paths and unusable bridges. `source` describes the
    origin of a reference.
    """

    mean: Float[np.ndarray, " m"]
    error: Float[np.ndarray, " m"]
    sd: Float[np.ndarray, " m"]
    num_simulated: int = 0
    num_missing: int = 0
    source: str = "exact"

    @property
    def is_random(self) -> np.ndarray:
        """Return which variables vary over bridges: end points, for instance, do not.

        The threshold allows for rounding errors.
        """
        # The largest scale of all variables, because a single one may be zero.
        scale = max(np.abs(self.mean).max(), self.sd.max())
        return self.sd > 1e-6 * scale


class Scene(NamedTuple):
    """The estimated expectation: of `fn` of the bridge at the times `save_at`.

    `is_path` is true if `fn` is the identity.
    """

    model: Diffusion
    start: np.ndarray
    end: np.ndarray
    duration: float
    save_at: np.ndarray
    fn: Callable[[Array], Array]
    is_path: bool

    def interval(self, dtype: str) -> tuple[Any, ...]:
        """Return model, start, end and duration in one precision; float64 needs x64 mode."""
        points = (jnp.asarray(point, dtype) for point in (self.start, self.end))
        return cast_floats(self.model, dtype), *points, jnp.asarray(self.duration, dtype)

    def values(self, paths: Float[Array, "n K d"]) -> Float[np.ndarray, "n m"]:
        """Return `fn` of each path, flattened, in double precision."""
        fn = as_path_function("fn", self.fn, jax.ShapeDtypeStruct(paths.shape[1:], paths.dtype))
        return np.asarray(
            jax.vmap(lambda path: jnp.ravel(as_returned("fn", fn(path))))(paths), float
        )


def check_precisions(scene: Scene, dtypes: Sequence[str]) -> None:
    """Raise `TypeError` if the model's functions cannot be traced in each of these precisions.

    The check precedes all compilation. The reason: JAX caches a NumPy constant inside a derivative
    in the precision of the first trace, and a later trace in the other precision mixes both.
    """

    def evaluate(model: Diffusion, x: Array):
        forward = model.forward(x)
        values = [jax.jacfwd(forward.drift)(x), forward.sigma(x).as_matrix(x.shape[0], x.dtype)]
        if model.has_density:
            values.append(jax.grad(model.log_stationary)(x))
        if model.has_reversal:
            values.append(model.backward(x).drift(x))
        return values

    for dtype in dict.fromkeys(dtypes):
        with jax.enable_x64(dtype == "float64"):
            model, x, *_ = scene.interval(dtype)
            try:
                eqx.filter_eval_shape(eqx.filter_jit(evaluate), model, x)
            except TypeError as error:
                raise TypeError(
                    "the model's functions must work in single and in double precision, because "
                    "the settings and the reference use both; JAX reports the error below. Convert "
                    "constants to the dtype of the point, `jnp.asarray(constant, x.dtype)`, or "
                    f"give them to `Diffusion` in its `params`. ({error})"
                ) from error


class Run(NamedTuple):
    """One setting to run: method, proposal, precision, number of steps and number of bridges."""

    method: str
    proposal: Any
    dtype: str
    num_steps: int
    num_bridges: int

    def result(self, key: Key[Array, ""], scene: Scene) -> Any:
        """Return the result of the library call that this setting stands for."""
        if self.method in EXTRAPOLATED:
            fine = self._replace(method=EXTRAPOLATED[self.method])
            coarse = fine._replace(num_steps=self.num_steps // 2)
            return extrapolate(
                fine.result(key, scene), coarse.result(key_for("coarse", key), scene)
            )
        arguments = (key, *scene.interval(self.dtype))
        proposal, num_steps = cast_floats(self.proposal, self.dtype), self.num_steps
        if self.method == "density":
            size = {"num_proposals": self.num_bridges, "num_steps": num_steps}
            return transition_log_density(*arguments, proposal=proposal, **size)
        size = {"num_bridges": self.num_bridges, "num_steps": num_steps, "save_at": scene.save_at}
        if self.method == "approximate":
            return sample_bridges(*arguments, coupling=proposal.coupling, **size)
        if self.method == "weights":
            return sample_weighted_bridges(*arguments, proposal=proposal, **size)
        chain: Any = self.method
        return sample_exact_bridges(*arguments, proposal=proposal, method=chain, **size)


def _estimate(scene: Scene, method: str, result: Any) -> Estimate:
    """Convert the result of `Run.result` to an `Estimate`, in double precision."""
    if method in EXTRAPOLATED:
        fine, coarse = (
            _estimate(scene, EXTRAPOLATED[method], part) for part in (result.fine, result.coarse)
        )
        # Extrapolation to small steps. The two runs are independent, so squared errors add up.
        share = float(leading_share(result.fine))
        mean = fine.mean + share * (fine.mean - coarse.mean)
        return Estimate(
            mean,
            np.hypot((1 + share) * fine.error, share * coarse.error),
            fine.sd,  # a scale only
            fine.num_simulated + coarse.num_simulated,
            fine.num_missing + coarse.num_missing,
        )
    if method == "density":
        is_usable = np.isfinite(result.value)
        value = np.where(is_usable, np.exp(np.asarray(result.value, float)), np.nan)[None]
        # The standard error of log p̂ is the relative error of p̂, to first order.
        relative = float(result.standard_error)
        simulated, truncated = int(result.num_simulated), int(result.num_truncated)
        return Estimate(value, value * relative, value, simulated, truncated)
    met = np.asarray(result.met)
    # Missing bridges are NaN, so they must not enter the sums.
    values = scene.values(result.paths)[met]
    truncated = np.asarray(getattr(result, "truncated", False))
    missing = int(np.sum(~met | truncated))
    simulated = result.num_proposals if method == "approximate" else result.num_simulated
    if len(values) == 0:
        unknown = np.full(values.shape[1], np.nan)
        return Estimate(unknown, unknown, unknown, int(simulated), missing)
    if method == "weights":
        weights = np.asarray(result.weights, float)[met]
        weights /= weights.sum()
        mean = weights @ values
        # Standard error of a self-normalised estimate, by the delta method.
        deviations = (values - mean) ** 2
        error, sd = np.sqrt(weights**2 @ deviations), np.sqrt(weights @ deviations)
    else:
        mean, sd = values.mean(0), values.std(0)
        # Approximate bridges are independent; the states of a chain are not.
        independent = method == "approximate"
        size = len(values) if independent else np.asarray(effective_sample_size(values), float)
        error = sd / np.sqrt(size)
    return Estimate(mean, error, sd, int(simulated), missing)


def user_estimate(reference: tuple[Numbers, Numbers] | None) -> Estimate | None:
    """Return the user's mean and standard deviation as an `Estimate` without error."""
    if reference is None:
        return None
    if len(as_sequence("reference", reference, "a mean and a standard deviation")) != 2:
        raise ValueError(f"`reference` must be a pair `(mean, sd)`; got {reference}.")
    mean, sd = (np.ravel(np.asarray(as_floating("reference", part))) for part in reference)
    return Estimate(mean, np.zeros_like(mean), sd)


def user_density(log_density: Numbers | None) -> Estimate | None:
    """Return the user's density as an `Estimate` without error."""
    if log_density is None:
        return None
    value = np.exp(np.asarray(as_numbers({"log_density": log_density})["log_density"]))[None]
    return Estimate(value, np.zeros_like(value), value)


def closed_form(
    key: Key[Array, ""], scene: Scene, density: bool, num_draws: int
) -> Estimate | None:
    """Return the exact values for an Ornstein–Uhlenbeck process, `None` for other models.

    An `fn` of the user needs `num_draws` draws of the exact bridge; the path itself and the density
    need none.
    """
    if not isinstance(scene.model.params, OrnsteinUhlenbeckParams):
        return None
    model, start, end, duration = scene.interval("float64")
    if density:
        value = np.exp(np.asarray(ou_transition(model, start, duration).log_density(end)))[None]
        return Estimate(value, np.zeros(1), value)
    bridge = gaussian_bridge(model, start, end, duration, scene.save_at)
    if not scene.is_path:
        values = scene.values(bridge.sample(key, num_draws))
        mean, sd = values.mean(0), values.std(0)
        words = f"{num_draws:,} draws of the exact law"
        return Estimate(mean, sd / np.sqrt(num_draws), sd, source=words)
    mean = np.asarray(bridge.mean, float).ravel()
    sd = np.sqrt(np.diagonal(np.asarray(bridge.covariance), axis1=1, axis2=2)).ravel()
    return Estimate(mean, np.zeros_like(mean), sd)


def finest(key: Key[Array, ""], scene: Scene, run: Run) -> Estimate:
    """Return the reference: a run with many steps by the most accurate scheme of its proposal.

    Its error includes the change from half as many steps, as a bound of the discretisation error.

    **Raises:** `ValueError` if a run found no bridges.
    """
    # The limit does not depend on the scheme, so the most accurate one serves for all settings.
    model, like, *_ = scene.interval("float64")
    best = run.proposal.most_accurate(model, like)
    limit = run._replace(proposal=best)
    half = limit._replace(num_steps=max(run.num_steps // 2, 1))
    fine = _estimate(scene, run.method, limit.result(key, scene))
    coarse = _estimate(scene, run.method, half.result(jax.random.fold_in(key, 1), scene))
    words = limit.proposal.describe()
    if not np.all(np.isfinite(fine.mean) & np.isfinite(coarse.mean)):
        raise ValueError(
            f"the reference runs ({words}, {run.num_steps} and {half.num_steps} steps) gave a mean "
            "that is not finite: no bridges were found, or `fn` is not finite. Choose other "
            "`proposals`, check `fn`, or pass known values as `reference` or `log_density`."
        )
    # The squared difference minus its expectation under pure Monte Carlo noise.
    noise = fine.error**2 + coarse.error**2
    squared_change = np.maximum((fine.mean - coarse.mean) ** 2 - noise, 0)
    words += f", {run.method}, {run.num_steps} steps, {run.num_bridges:,} bridges"
    return fine._replace(error=np.sqrt(fine.error**2 + squared_change), source=words)


def measure(
    key: Key[Array, ""], scene: Scene, run: Run, exact: Estimate, limit: Estimate, repeats: int
) -> Setting:
    """Run and time one setting, and compare its estimate with the exact value and its limit."""

    def timed():
        begin = time.perf_counter()
        result = jax.block_until_ready(run.result(key, scene))
        return result, time.perf_counter() - begin

    with jax.enable_x64(run.dtype == "float64"):
        # The first run compiles.
        result, first = timed()
        seconds = float(np.median([timed()[1] for _ in range(repeats)]))
        estimate = _estimate(scene, run.method, result)
        shape = getattr(getattr(result, "fine", result), "pareto_k", None)

    def rms(difference):
        """Return the root mean square in standard deviations of the estimated variables."""
        ratio = difference[exact.is_random] / exact.sd[exact.is_random]
        return float(np.sqrt(np.mean(ratio**2)))

    monte_carlo = rms(estimate.error)
    effective = monte_carlo**-2 if monte_carlo > 0 else np.nan
    scheme, meeting, gamma = run.proposal.ingredients()
    return Setting(
        run.method,
        run.proposal.describe(),
        scheme,
        meeting,
        gamma,
        run.dtype,
        run.num_steps,
        # Each uncertainty includes the error of the value to compare with.
        rms(estimate.mean - exact.mean),
        rms(np.hypot(estimate.error, exact.error)),
        rms(estimate.mean - limit.mean),
        rms(np.hypot(estimate.error, limit.error)),
        rms(limit.mean - exact.mean),
        monte_carlo,
        seconds,
        max(first - seconds, 0.0),  # noise of the clock may exceed the compile time
        estimate.num_simulated,
        effective,
        effective / seconds,
        estimate.num_missing,
        np.nan if shape is None else float(shape),
    )
