"""Can a result be trusted, and if not, why?

Inside compiled code a fault is data: a weight that was cut off, a step error beyond the standard
error, chains that disagree. Each result collects its faults in one `Verdict`, and from that follow
`trustworthy` (an array), `why()` (sentences with remedies) and, for `throw=True`, an error at run
time.
"""

import math
from abc import abstractmethod
from functools import reduce
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from .checks import all_finite_leaves, is_traced
from .pareto import is_reliable

_NO_FAULT = "No fault was found."
_PARAMETERS = "Some parameters of the model are not finite: nothing can be simulated with them."
_NOT_FINITE = (
    "The result, or its error, is not a finite number, though nothing else is wrong: a point, an "
    "observation or a parameter is beyond what the precision of the numbers allows. Measure in "
    "other units, or compute in double precision."
)
_MISSING = (
    "Some bridges were not found within `max_proposals` proposals. Allow more, lengthen the "
    "duration or choose a smaller `gamma`; on intervals much shorter than the relaxation time "
    "pairs hardly ever meet: use `ModifiedDiffusionBridge()` or `Guided()` there."
)
_FAILED = (
    "Some paths left the finite numbers or the state space, or ended where they have no density, "
    "so that intervals are without bridges. Take more steps, transform the coordinates, or check "
    "that the end points lie in the state space."
)
_TRUNCATED = (
    "Some weights were cut off by `max_trials`, because their paths are hardly ever hit. Allow "
    "more trials, or fit a start law by `fit_start_law`. The cause may also be the run that "
    "replaces a sampler of the stationary law, where its burn-in is unknown (infinite in the "
    "result, as where `measure_burn_in` finds none) or longer than 2¹⁸ steps: give `Diffusion` a "
    "`sample_stationary`, or the coupling a shorter `Stationary(burn_in=...)` or a start law with "
    "a density."
)
_HEAVY = (
    "Some weights have tails so heavy (a Pareto shape k̂ above 0.7, or 0.6 where weights are very "
    "unequal, or 1 where they are nearly equal; or fewer than 20 effective weights) that their "
    "mean and its error cannot be trusted. Choose another proposal, more "
    'proposals, shorter intervals, or `method="crank_nicolson"`.'
)
_LOST = (
    "Many simulated paths left the state space or the finite numbers (`num_nonfinite`): 5 % if "
    "weights are equal, fewer if not. Their mass is missing, so densities are too small and "
    "bridges keep away from the boundary. Take more steps, or coordinates in which steps cannot "
    "leave. Where the diffusion attains its boundary (of dX = κ(θ - X) dt + σ√X dW where "
    "2κθ < σ²) neither is a remedy: no proposal of this package has paths that touch it."
)
# A larger share of missing mass is a fault.
_MOST_MISSING = 0.05
# Σw² n / (Σw)² where it is not known, as of the states of a chain.
_INEQUALITY = 2.5

_FEWEST_IN_SUM = 5


class Fault(eqx.Module):
    """One reason not to trust a result.

    - `present`: whether it applies, shape (), or (I,) with one entry for each interval.
    - `sentence`: the fault and its remedy.
    """

    present: Bool[Array, "*I"]
    sentence: str = eqx.field(static=True)


class Verdict(eqx.Module):
    """All faults that a result was examined for, present or not."""

    faults: tuple[Fault, ...]

    @property
    def trustworthy(self) -> Bool[Array, "*I"]:
        """Return whether no fault is present, shape () or (I,)."""
        return ~reduce(jnp.logical_or, (fault.present for fault in self.faults))

    def with_finite(self, *numbers: Float[Array, "*shape"]) -> "Verdict":
        """Return the same faults, and the fault that one of the numbers is not finite though no
        other fault is present. Their first axes are those of `trustworthy`."""
        sound = self.trustworthy
        finite = [
            jnp.all(jnp.isfinite(each), axis=tuple(range(sound.ndim, each.ndim)))
            for each in numbers
        ]
        return Verdict((*self.faults, Fault(sound & ~reduce(jnp.logical_and, finite), _NOT_FINITE)))

    def why(self) -> str:
        """Return a sentence for each fault that is present, one a line.

        **Raises:** `TypeError` inside `jit`, where the numbers are not known yet.
        """
        if is_traced(self):
            raise TypeError(
                "`why()` returns a string, which compiled code cannot: return the result from "
                "`jit` and call `why()` there, or use `trustworthy` inside."
            )
        faults = [_located(fault) for fault in self.faults if np.any(fault.present)]
        return "\n".join(faults) if faults else _NO_FAULT


class AbstractResult(eqx.Module):
    """Result of an estimation, with a verdict on whether its numbers and errors can be trusted."""

    @property
    @abstractmethod
    def verdict(self) -> Verdict:
        """Return all faults that this result is examined for."""

    @property
    def trustworthy(self) -> Bool[Array, "*I"]:
        """Return whether the numbers, with the errors that they report, can be trusted: no fault
        of `verdict` is present."""
        return self.verdict.trustworthy

    def why(self) -> str:
        """Return why the result is not trustworthy: each fault with its remedy, one a line.

        **Raises:** `TypeError` inside `jit`, where the numbers are not known yet.
        """
        return self.verdict.why()


_Result = TypeVar("_Result", bound=AbstractResult)


def throw_where_untrustworthy(result: _Result, field: str, model: PyTree) -> _Result:
    """Return the result, whose `field` raises `RuntimeError` at run time if parameters of the model
    are not finite or a fault of the verdict is present, with the sentence of the first."""
    value = getattr(result, field)
    parameters = Fault(~all_finite_leaves(model), _PARAMETERS)
    for fault in (parameters, *result.verdict.faults):
        value = eqx.error_if(value, jnp.any(fault.present), fault.sentence)
    return eqx.tree_at(lambda tree: getattr(tree, field), result, value)


def missing_bridges(missing: Bool[Array, "*I"], coupled: bool = True) -> Fault:
    """Return the fault of bridges that were not found: pairs that did not meet if `coupled`, else
    paths that failed."""
    return Fault(missing, _MISSING if coupled else _FAILED)


def truncated_weights(truncated: Bool[Array, "*I"]) -> Fault:
    """Return the fault of weights that a bound on the work cut off."""
    return Fault(truncated, _TRUNCATED)


def lost_paths(
    num_lost: Int[Array, "*I"],
    num_simulated: Int[Array, "*I"],
    effective: Float[Array, "*I"] | None = None,
    number: Int[Array, "*I"] | None = None,
) -> Fault:
    """Return the fault of paths that left the state space or the finite numbers: the mass that may
    be missing is beyond 5 % and beyond the standard error.

    A lost path would have had any weight. It counts with Σw²/Σw, the mean weight of a path of the
    target, which is number/effective times the mean of the weights above zero: where weights are
    equal a share q of lost paths is a share q of the mass, and where a few have most of it the lost
    ones may be among them.
    """
    share = num_lost / jnp.maximum(num_simulated, 1)
    if effective is None or number is None:
        return lost_share(share)
    size = jnp.maximum(effective, 1)
    missing = share.astype(size.dtype) * jnp.maximum(number.astype(size.dtype) / size, 1)
    return Fault(missing > jnp.maximum(_MOST_MISSING, 1 / jnp.sqrt(size)), _LOST)


def lost_share(share: Float[Array, "*I"]) -> Fault:
    """Return the fault of a share of lost paths whose weights are not known to be equal."""
    return Fault(share > _MOST_MISSING / _INEQUALITY, _LOST)


def heavy_tails(
    k: Float[Array, "*I"],
    effective: Float[Array, "*I"] | float,
    number: Int[Array, "*I"] | None = None,
) -> Fault:
    """Return the fault of weights whose mean a few large ones decide, by their Pareto shape, their
    effective number and the number of those above zero."""
    return Fault(~is_reliable(k, effective, number), _HEAVY)


def heavy_tails_in_sum(k: Float[Array, " I"], effective: Float[Array, " I"]) -> Fault:
    """Return the fault of a sum over intervals, each with weights of its own.

    Of many intervals some look unreliable by chance, and each adds an error of its own size, while
    the statistical error of the sum grows as √I: up to √I / 4 of them do not matter, if none has
    fewer than five effective weights.
    """
    unreliable = jnp.sum(~is_reliable(k, effective))
    hopeless = jnp.any(~(effective >= _FEWEST_IN_SUM))
    return Fault((unreliable > math.isqrt(k.size) // 4) | hopeless, _HEAVY)


def _located(fault: Fault) -> str:
    """Return the sentence, with the intervals that it applies to if there are several."""
    present = np.asarray(jax.device_get(fault.present))
    if present.ndim == 0:
        return fault.sentence
    number, first = np.count_nonzero(present), np.argwhere(present)[0].tolist()
    return f"In {number} of {present.size} (first {first}): {fault.sentence}"
