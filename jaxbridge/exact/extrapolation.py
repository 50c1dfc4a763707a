"""Richardson's extrapolation: two estimates, on N and on N/2 steps, without their leading error.

Where an estimate E_N of something has an error c δ^p + O(δ^{p+1}) from its steps δ,

    E_N + (E_N - E_{N/2}) / (2^p - 1)

has one of O(δ^{p+1}) only. For densities this is done on the natural scale, on which both are
unbiased but for their steps, and so is their combination. The price is noise: for p = 1 it has
four times the variance of E_N, and that of E_{N/2}.

`step_error` tells the same from the paths of one grid, which are a sample for both step laws; but
what it knows of is the law of normal steps, of which a coupling's is not the same function. Here
nothing is assumed but the order.
"""

from typing import Any, overload

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ..engine.averages import PathFunction
from ..engine.doors import door
from ..engine.verdict import AbstractResult, Fault, Verdict
from ..schemes import StepError, dominates, share_of_known_order, step_fault
from .density import TransitionLogDensity
from .importance import WeightedBridges

_NEGATIVE = (
    "Noise made the combination of the two estimates negative, or one of them is zero. Take more "
    "`num_proposals`."
)


class ExtrapolatedLogDensity(AbstractResult):
    """What `extrapolate` makes of two `TransitionLogDensity`.

    - `value`: the log of the combination, unbiased on the natural scale but for an error of higher
        order; -inf where noise made it negative.
    - `standard_error`: that of `value`, by the delta method.
    - `removed`: what `value` is smaller by than that of the finer grid.
    - `fine`, `coarse`: the two.
    """

    value: Float[Array, "*I"]
    standard_error: Float[Array, "*I"]
    removed: Float[Array, "*I"]
    fine: TransitionLogDensity
    coarse: TransitionLogDensity

    @property
    def step_error_dominates(self) -> Bool[Array, "*I"]:
        """Whether half of what was removed, taken for a bound of what is left, is beyond three
        standard errors. Of the next order two grids tell nothing: a third does."""
        return dominates(self._left, self.standard_error)

    @property
    def verdict(self) -> Verdict:
        """Return the faults of both estimates, as in `TransitionLogDensity`, but for their step
        errors; of these, the fault of what is left."""
        weights = (*self.fine._weight_faults, *self.coarse._weight_faults)
        left = step_fault(self._left, self.standard_error)
        return Verdict((*weights, Fault(~jnp.isfinite(self.value), _NEGATIVE), left))

    @property
    def _left(self) -> StepError:
        return StepError(jnp.zeros_like(self.removed), jnp.abs(self.removed) / 2)


class ExtrapolatedBridges(AbstractResult):
    """What `extrapolate` makes of two `WeightedBridges`, `fine` and `coarse`: their means,
    combined."""

    fine: WeightedBridges
    coarse: WeightedBridges

    def mean(self, fn: PathFunction = lambda path: path) -> PyTree:
        """The mean of `fn(path)` over exact bridges, but for an error of higher order in the steps.
        `fn` must return the same shapes for paths of both grids: keep both `save_at` some
        times."""
        return self._combined(fn, self.fine.mean(fn), self.coarse.mean(fn), _richardson)

    def standard_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """That of `mean(fn)`, entry by entry."""
        errors = self.fine.standard_error(fn), self.coarse.standard_error(fn)
        return self._combined(fn, *errors, _richardson_error)

    def removed(self, fn: PathFunction = lambda path: path) -> PyTree:
        """What `mean(fn)` is smaller by than that of the finer grid."""
        return jax.tree.map(jnp.subtract, self.fine.mean(fn), self.mean(fn))

    @property
    def verdict(self) -> Verdict:
        """Return the faults of the weights of both. Of the step error only `removed(fn)` tells:
        compare half of it with the standard error."""
        verdict = Verdict((*self.fine._weight_faults, *self.coarse._weight_faults))
        return verdict.with_finite(self.fine.mean(), self.coarse.mean())

    def _combined(self, fn, fine, coarse, combine):
        share = share_of_known_order(self.fine.step_share)

        def of_entry(one, other):
            if one.shape != other.shape:
                raise ValueError(
                    "`fn` must return the same shapes for paths of both grids, but it returned "
                    f"{one.shape} and {other.shape}: keep both at the same times, `save_at=`."
                )
            each = share.reshape(*share.shape, *[1] * (one.ndim - share.ndim))
            return combine(each, one, other)

        return jax.tree.map(of_entry, fine, coarse)


@overload
def extrapolate(
    fine: TransitionLogDensity, coarse: TransitionLogDensity
) -> ExtrapolatedLogDensity: ...
@overload
def extrapolate(fine: WeightedBridges, coarse: WeightedBridges) -> ExtrapolatedBridges: ...
@door
def extrapolate(fine: Any, coarse: Any):
    """Two estimates without the leading error of their steps: Richardson's extrapolation.

    Worth its noise where steps, not draws, decide the error, as for a σ that depends on the state,
    for which all schemes are of first order.

    **Arguments:**

    - `fine`, `coarse`: two results of `transition_log_density`, or two of
        `sample_weighted_bridges` or `weigh_bridges`, that differ in two things only: `coarse` has
        half as many steps, and a key of its own.

    **Returns:** `ExtrapolatedLogDensity`, with `value` and `standard_error`, or
    `ExtrapolatedBridges`, with `mean(fn)` and `standard_error(fn)`.

    **Raises:** `TypeError` for other results; `ValueError` where `coarse` has not half as many
    steps, or the two come of different proposals, whose errors do not cancel.

    **Example:**

    ```python
    fine, coarse = (
        jb.transition_log_density(key, model, start, end, 1.0, num_steps=n, proposal=jb.Guided())
        for key, n in zip(jax.random.split(key), (20, 10))
    )
    jb.extrapolate(fine, coarse).value
    ```
    """
    if isinstance(fine, TransitionLogDensity) and isinstance(coarse, TransitionLogDensity):
        _check_pair(fine, coarse)
        return _log_density(fine, coarse)
    if isinstance(fine, WeightedBridges) and isinstance(coarse, WeightedBridges):
        _check_pair(fine, coarse)
        return ExtrapolatedBridges(fine, coarse)
    raise TypeError(
        "`fine` and `coarse` must both be what `transition_log_density` returned, or both what "
        "`sample_weighted_bridges` or `weigh_bridges` did; got "
        f"{type(fine).__name__} and {type(coarse).__name__}."
    )


def _check_pair(fine: Any, coarse: Any) -> None:
    if fine.num_steps != 2 * coarse.num_steps:
        raise ValueError(
            f"`coarse` must have half as many steps as `fine`; got {fine.num_steps} and "
            f"{coarse.num_steps}."
        )
    structures = [jax.tree.structure(one.proposal) for one in (fine, coarse)]
    if structures[0] != structures[1] or len(fine.proposal.singles) > 1:
        raise ValueError(
            "`fine` and `coarse` must come of the same single proposal, for the step errors of two "
            "do not cancel: "
            f"got {fine.proposal.describe()} and {coarse.proposal.describe()}."
        )


def _log_density(fine: TransitionLogDensity, coarse: TransitionLogDensity):
    """Both relative to the finer, which keeps their digits."""
    share = share_of_known_order(fine.step_share)
    known = jnp.isfinite(fine.value) & (coarse.value < jnp.inf)
    ratio = jnp.where(known, jnp.exp(coarse.value - jnp.where(known, fine.value, 0)), jnp.inf)
    combined = _richardson(share, 1.0, ratio)
    positive = known & (combined > 0)
    safe = jnp.where(positive, combined, 1)
    coarse_error = jnp.where(
        ratio > 0, ratio * coarse.standard_error, 0
    )  # zero has no relative one
    error = _richardson_error(share, fine.standard_error, coarse_error) / safe
    return ExtrapolatedLogDensity(
        jnp.where(positive, fine.value + jnp.log(safe), -jnp.inf),
        jnp.where(positive, error, jnp.inf),
        jnp.where(positive, -jnp.log(safe), jnp.inf),
        fine,
        coarse,
    )


def _richardson(share, fine, coarse):
    return fine + share * (fine - coarse)


def _richardson_error(share, fine, coarse):
    """Of independent estimates."""
    return jnp.hypot((1 + share) * fine, share * coarse)
