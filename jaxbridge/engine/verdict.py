"""Verdict on a result: whether it is trustworthy, and the reasons if it is not.

Inside compiled code, a fault is data: a truncated weight, a discretisation error above the standard
error, chains that disagree. Each result collects its faults in one `Verdict`. It provides
`trustworthy` (an array), `why()` (sentences with remedies) and, for `throw=True`, an error at run
time.
"""

import math
from abc import abstractmethod
from functools import reduce
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from .checks import all_finite_leaves, is_traced
from .labelled import dataset
from .pareto import FEWEST_EFFECTIVE, is_reliable, largest_reliable_k_of

_NO_FAULT = "No fault was found."
_PARAMETERS = "Some parameters of the model are not finite, so simulation is impossible."
_NOT_FINITE = (
    "The result or its error is not finite, and no other fault was found: a point, an observation "
    "or a parameter exceeds the range of the floating-point numbers. Use other units, or double "
    "precision."
)
_MISSING = (
    "Bridges are missing: no pair met within the allowed number of proposals. Use more "
    "`{argument}`, or a smaller `gamma`. On intervals much shorter than the relaxation time, pairs "
    "hardly ever meet: use `ModifiedDiffusionBridge()` or `Guided()` there. If transitions are "
    "rare, as between wells, use `ModifiedDiffusionBridge()` or, for state dimension d, "
    "`Guided(np.zeros((d, d)))`: its paths follow the model's drift and a pull towards the end "
    "point. For densities a start law near the end point also helps "
    "(`fit_start_law(..., for_density=True)`)."
)
_FAILED = (
    "Some intervals have no bridges: paths left the finite numbers or the state space, or their "
    "last step has no density. Use more steps, transform the coordinates, or check that the end "
    "points lie in the state space."
)
_TRUNCATED = (
    "Some weights were truncated by `max_trials`, because their paths are hardly ever hit. Allow "
    "more trials, or fit a start law by `fit_start_law`. The cause may also be the run that "
    "replaces a sampler of the stationary law: its burn-in is unknown (infinite in the result, as "
    "when `measure_burn_in` finds none) or longer than 2¹⁸ steps. Then pass `sample_stationary` "
    "to `Diffusion`, or pass the coupling a shorter `Stationary(burn_in=...)` or a start law with "
    "a density."
)
_LIGHTER = (
    'Choose another proposal, more proposals, shorter intervals, or `method="crank_nicolson"`.'
)
_HEAVY = (
    "The weights have tails so heavy that their mean and its error cannot be trusted: the Pareto "
    f"shape k̂ is above its bound. {_LIGHTER}"
)
_FEW = (
    "A few weights determine the mean, so it and its error cannot be trusted: the effective sample "
    f"size is below {FEWEST_EFFECTIVE}. {_LIGHTER}"
)
_HEAVY_IN_SUM = (
    "In too many intervals the weights have heavy tails or small effective sample sizes, so their "
    f"sum and its error cannot be trusted. {_LIGHTER}"
)
_LOST = (
    "Too many simulated paths left the state space or the finite numbers (`num_nonfinite`): more "
    "than 5 % if weights are equal, fewer otherwise. Their mass is missing, so densities are too "
    "small and bridges avoid the boundary. Use more steps, or coordinates in which steps cannot "
    "leave. Neither helps if the diffusion attains its boundary (such as dX = κ(θ - X) dt + "
    "σ√X dW with 2κθ < σ²): no proposal of this package has paths that touch it."
)
# A larger share of missing mass is a fault.
_MOST_MISSING = 0.05
# Assumed inequality of weights, n Σw² / (Σw)², if it is unknown, as for the states of a chain.
_INEQUALITY = 2.5

# Fewest effective weights of an interval in a sum over intervals.
_FEWEST_IN_SUM = 5


class Fault(eqx.Module):
    """One reason not to trust a result.

    - `present`: whether the fault is present, shape (), or (I,) with one entry for each interval.
    - `sentence`: the fault and its remedy.
    - `detail`, `values`: a format string and the numbers that it prints, each of the shape of
        `present`. `why()` appends them to the sentence.
    """

    present: Bool[Array, "*I"]
    sentence: str = eqx.field(static=True)
    detail: str = eqx.field(static=True, default="")
    values: tuple[Array, ...] = ()

    def in_any(self) -> "Fault":
        """Return the fault of all entries together, with the numbers of its first entry."""
        first = jnp.argmax(self.present.ravel())
        values = tuple(value.ravel()[first] for value in self.values)
        return Fault(jnp.any(self.present), self.sentence, self.detail, values)


class Verdict(eqx.Module):
    """All faults for which a result was examined, present or not."""

    faults: tuple[Fault, ...]

    @property
    def trustworthy(self) -> Bool[Array, "*I"]:
        """Return whether no fault is present, shape () or (I,)."""
        return ~reduce(jnp.logical_or, (fault.present for fault in self.faults))

    def with_finite(self, *numbers: Float[Array, "*shape"]) -> "Verdict":
        """Add the fault that one of the numbers is not finite although no other fault is present.

        The first axes of the numbers are those of `trustworthy`.
        """
        sound = self.trustworthy
        finite = [
            jnp.all(jnp.isfinite(each), axis=tuple(range(sound.ndim, each.ndim)))
            for each in numbers
        ]
        return Verdict((*self.faults, Fault(sound & ~reduce(jnp.logical_and, finite), _NOT_FINITE)))

    def why(self) -> str:
        """Return one line for each fault that is present, or "No fault was found."

        **Raises:** `TypeError` inside `jit`, where the values are traced.
        """
        if is_traced(self):
            raise TypeError(
                "`why()` returns a string, which compiled code cannot: return the result from "
                "`jit` and call `why()` there, or use `trustworthy` inside."
            )
        faults = [_described(fault) for fault in self.faults if np.any(fault.present)]
        return "\n".join(faults) if faults else _NO_FAULT


class AbstractResult(eqx.Module):
    """Result of an estimation, with a verdict on its numbers and their errors."""

    @property
    @abstractmethod
    def verdict(self) -> Verdict:
        """Return all faults for which this result is examined."""

    @property
    def trustworthy(self) -> Bool[Array, "*I"]:
        """Return whether the numbers and their reported errors can be trusted, shape () or (I,).

        They can if no fault of `verdict` is present.
        """
        return self.verdict.trustworthy

    def why(self) -> str:
        """Return why the result is not trustworthy: one line for each fault, with its remedy.

        Without a fault, return "No fault was found."

        **Raises:** `TypeError` inside `jit`, where the values are traced.
        """
        return self.verdict.why()

    def to_xarray(self) -> Any:
        """Return all arrays of this result with names of their axes, as an `xarray.Dataset`.

        Axes are named "interval", "chain", "draw", "time", "state", "parameter" and so on. Times
        and names of parameters are coordinates. Attributes are numbers of the result, and `why()`.
        `to_netcdf` of the dataset saves it. This needs the package xarray.

        **Raises:** `TypeError` inside `jit`, where the values are traced.

        **Example:**

        ```python
        bridges.to_xarray().paths.mean("draw").to_netcdf("means.nc")
        ```
        """
        return dataset(self)


_Result = TypeVar("_Result", bound=AbstractResult)


def throw_where_untrustworthy(result: _Result, field: str, model: PyTree) -> _Result:
    """Return the result; its `field` raises `RuntimeError` at run time if a fault is present.

    The message is the sentence of the first fault. Parameters of the model that are not finite
    count as a fault.
    """
    value = getattr(result, field)
    parameters = Fault(~all_finite_leaves(model), _PARAMETERS)
    for fault in (parameters, *result.verdict.faults):
        value = eqx.error_if(value, jnp.any(fault.present), fault.sentence)
    return eqx.tree_at(lambda tree: getattr(tree, field), result, value)


def missing_bridges(
    missing: Bool[Array, "*I"], coupled: bool = True, argument: str = "max_proposals"
) -> Fault:
    """Return the `Fault` that reports missing bridges, present where `missing` is true.

    Its sentence states the cause. If `coupled`, no pair met within the number of proposals that
    `argument` sets; otherwise paths failed.
    """
    return Fault(missing, _MISSING.format(argument=argument) if coupled else _FAILED)


def truncated_weights(truncated: Bool[Array, "*I"]) -> Fault:
    """Return the fault of weights that a bound on the number of trials truncated."""
    return Fault(truncated, _TRUNCATED)


def lost_paths(
    num_lost: Int[Array, "*I"],
    num_simulated: Int[Array, "*I"],
    effective: Float[Array, "*I"] | None = None,
    number: Int[Array, "*I"] | None = None,
) -> Fault:
    """Return the fault of paths that left the state space or the finite numbers.

    It is present if the mass that may be missing exceeds both 5 % and the relative standard error.
    `number` is the number of positive weights.

    The weight of a lost path is unknown. It is taken as Σw²/Σw, the mean weight of a path of the
    target, which is number/effective times the mean positive weight. With equal weights, a share q
    of lost paths is a share q of the mass. If a few weights have most of the mass, lost paths may
    be among them.
    """
    share = num_lost / jnp.maximum(num_simulated, 1)
    if effective is None or number is None:
        return lost_share(share)
    size = jnp.maximum(effective, 1)
    missing = share.astype(size.dtype) * jnp.maximum(number.astype(size.dtype) / size, 1)
    return Fault(is_too_much_missing(missing, 1 / jnp.sqrt(size)), _LOST)


def is_too_much_missing(
    missing: Float[Array, "*I"], standard_error: Float[Array, "*I"]
) -> Bool[Array, "*I"]:
    """Return whether missing mass, relative to the whole, exceeds 5 % and the standard error."""
    return missing > jnp.maximum(_MOST_MISSING, standard_error)


def lost_share(share: Float[Array, "*I"]) -> Fault:
    """Return the fault of a share of lost paths whose weights are not known to be equal."""
    return Fault(share > _MOST_MISSING / _INEQUALITY, _LOST)


@jax.jit  # outside of other programs, one program for all operations
def heavy_tails(
    k: Float[Array, "*I"],
    effective: Float[Array, "*I"] | None = None,
    number: Int[Array, "*I"] | None = None,
) -> tuple[Fault, ...]:
    """Return the faults of weights whose mean is determined by a few large ones.

    They follow from the Pareto shape, the effective sample size and the number of positive weights
    (see `is_reliable`). Without an effective sample size, the shape alone decides.
    """
    most = jnp.broadcast_to(largest_reliable_k_of(k, effective, number), k.shape)
    detail, values = "k̂ is {:.2f}, and its bound {:.2f} for these weights", (k, most)
    if effective is None:
        return (Fault(~(k < most), _HEAVY, detail, values),)
    detail, values = f"{detail}; the effective sample size is {{:,.0f}}", (*values, effective)
    if number is not None:
        detail, values = f"{detail} of {{:,}}", (*values, number)
    few = ~(effective >= FEWEST_EFFECTIVE)
    return (
        Fault(few, _FEW, detail, values),
        Fault(~few & ~(k < most), _HEAVY, detail, values),
    )


def heavy_tails_in_sum(
    k: Float[Array, " I"], effective: Float[Array, " I"], number: Int[Array, " I"]
) -> Fault:
    """Return the fault of a sum over intervals, each with its own weights.

    Among many intervals, some look unreliable by chance. Each of them adds an error of its own
    size, while the statistical error of the sum grows as √I. Up to √I / 4 of them are therefore
    harmless, if all intervals have at least five effective weights. `number` counts the positive
    weights of each.
    """
    unreliable = jnp.sum(~is_reliable(k, effective, number))
    most = math.isqrt(k.size) // 4
    hopeless = jnp.any(~(effective >= _FEWEST_IN_SUM))
    detail = (
        f"{{}} of {k.size} intervals have a k̂ above its bound or an effective sample size below "
        f"{FEWEST_EFFECTIVE} (at most {most} may), and the smallest effective sample size is "
        f"{{:,.1f}} (at least {_FEWEST_IN_SUM})"
    )
    values = unreliable, jnp.min(effective, initial=math.inf)
    return Fault((unreliable > most) | hopeless, _HEAVY_IN_SUM, detail, values)


def _described(fault: Fault) -> str:
    """Return the sentence with the numbers of the first affected interval.

    If there are several intervals, it begins with the affected ones.
    """
    present, *values = map(np.asarray, jax.device_get((fault.present, *fault.values)))
    first = tuple(np.argwhere(present)[0].tolist())
    numbers = fault.detail.format(*(value[first].item() for value in values))
    if present.ndim == 0:
        return fault.sentence + (f" Here {numbers}." if numbers else "")
    place, number = list(first), np.count_nonzero(present)
    numbers = f" In {place}, {numbers}." if numbers else ""
    return f"In {number} of {present.size} (first {place}): {fault.sentence}{numbers}"
