"""Richardson's extrapolation: two grids, one estimate without the leading discretisation error.

Let E_N be an estimate with N steps of size δ, with an error c δ^p + O(δ^{p+1}). Then

    E_N + (E_N - E_{N/2}) / (2^p - 1)

has an error of O(δ^{p+1}). Densities are combined on the natural scale, where both estimates, and
so their combination, are unbiased up to the discretisation error. The price is variance: for p = 1
it is four times the variance of E_N plus the variance of E_{N/2}.

`step_error` estimates the same error from the paths of one grid, weighted for both step sizes. It
assumes a known density of the steps, which proposals by couplings with a state-dependent σ lack.
Extrapolation assumes the order p only.
"""

from typing import Any, overload

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ..engine.averages import PathFunction
from ..engine.entry import public_entry
from ..engine.verdict import AbstractResult, Fault, Verdict
from ..schemes import StepError, dominates, share_of_known_order, share_of_order, step_faults
from .density import TransitionLogDensity
from .importance import WeightedBridges

_NEGATIVE = (
    "The combination of the two estimates is negative because of their noise, or one of them is "
    "zero. Take more `num_proposals`."
)
_REMAINING = (
    "The discretisation error may still exceed three standard errors and 0.05: half of `removed`, "
    "a bound on it, does. Use more `num_steps` on both grids."
)


class ExtrapolatedLogDensity(AbstractResult):
    """Result of `extrapolate` for two `TransitionLogDensity`.

    - `value`: log of p_N + (p_N - p_{N/2}) / (2^q - 1) for the densities on both grids and steps of
        order q. This combination has an error of higher order. `value` is -inf if noise
        makes it negative or zero.
    - `standard_error`: standard error of `value`, by the delta method; infinite if `value` is -inf.
    - `removed`: the value of the finer grid minus `value`: the estimated discretisation bias of the
        finer grid. Infinite if `value` is -inf.
    - `fine`, `coarse`: the two estimates.
    """

    value: Float[Array, "*I"]
    standard_error: Float[Array, "*I"]
    removed: Float[Array, "*I"]
    fine: TransitionLogDensity
    coarse: TransitionLogDensity

    @property
    def step_error_dominates(self) -> Bool[Array, "*I"]:
        """Return whether half of `removed`, a bound on the remaining error, exceeds three standard
        errors.

        Two grids do not determine the error of the next order; a third grid does.
        """
        return dominates(self._remaining_error, self.standard_error)

    @property
    def verdict(self) -> Verdict:
        """Return the possible faults, as a `Verdict`:

        - the faults of the weights of both estimates, as in `TransitionLogDensity`;
        - a combination that is negative or zero;
        - a bound on the remaining discretisation error, half of `removed`, that exceeds three
            standard errors and 0.05.
        """
        weights = (*self.fine._weight_faults, *self.coarse._weight_faults)
        steps = Verdict(step_faults(self._remaining_error, self.standard_error))
        bound, detail = self._remaining_error.uncertainty, "it is {:.2g}, the standard error {:.2g}"
        remaining = Fault(~steps.trustworthy, _REMAINING, detail, (bound, self.standard_error))
        return Verdict((*weights, Fault(~jnp.isfinite(self.value), _NEGATIVE), remaining))

    @property
    def _remaining_error(self) -> StepError:
        return StepError(jnp.zeros_like(self.removed), jnp.abs(self.removed) / 2)


class ExtrapolatedBridges(AbstractResult):
    """Result of `extrapolate` for two `WeightedBridges`, `fine` and `coarse`: combined means."""

    fine: WeightedBridges
    coarse: WeightedBridges

    def mean(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the mean of `fn(path)` over exact bridges, up to a discretisation error of higher
        order.

        `fn` must return the same shapes for paths of both grids: store both at the same times
        (`save_at`).
        """
        return self._combined(fn, self.fine.mean(fn), self.coarse.mean(fn), _richardson)

    def standard_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the standard error of `mean(fn)`, entry by entry."""
        errors = self.fine.standard_error(fn), self.coarse.standard_error(fn)
        return self._combined(fn, *errors, _richardson_error)

    def removed(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the mean of the finer grid minus `mean(fn)`: the estimated bias of that grid."""
        return jax.tree.map(jnp.subtract, self.fine.mean(fn), self.mean(fn))

    @property
    def verdict(self) -> Verdict:
        """Return the faults of the weights of both results, as a `Verdict`.

        It does not include the discretisation error: compare half of `removed(fn)` with the
        standard error.
        """
        verdict = Verdict((*self.fine._weight_faults, *self.coarse._weight_faults))
        return verdict.with_finite(self.fine.mean(), self.coarse.mean())

    def _combined(self, fn, fine, coarse, combine):
        share = leading_share(self.fine)

        def combine_entries(fine_entry, coarse_entry):
            if fine_entry.shape != coarse_entry.shape:
                raise ValueError(
                    "`fn` must return the same shapes for paths of both grids; got "
                    f"{fine_entry.shape} and {coarse_entry.shape}. Store both at the same times "
                    "(`save_at`)."
                )
            # Each interval has one share; add axes so that it broadcasts over the entries.
            factor = share.reshape(*share.shape, *[1] * (fine_entry.ndim - share.ndim))
            return combine(factor, fine_entry, coarse_entry)

        return jax.tree.map(combine_entries, fine, coarse)


@overload
def extrapolate(
    fine: TransitionLogDensity, coarse: TransitionLogDensity
) -> ExtrapolatedLogDensity: ...
@overload
def extrapolate(fine: WeightedBridges, coarse: WeightedBridges) -> ExtrapolatedBridges: ...
@public_entry
def extrapolate(fine: Any, coarse: Any):
    """Combine two estimates into one without the leading discretisation error (Richardson).

    It is useful where the discretisation error exceeds the standard error. One example is couplings
    with a state-dependent σ, whose schemes are all of first order.

    **Arguments:**

    - `fine`, `coarse`: two results of `transition_log_density`, or two results of
        `sample_weighted_bridges` or `weigh_bridges`. They must differ in two things only: `coarse`
        has half as many steps, and another key. Both need the same single proposal.

    **Returns:** `ExtrapolatedLogDensity`, with `value` and `standard_error`, or
    `ExtrapolatedBridges`, with `mean(fn)` and `standard_error(fn)`.

    **Raises:** `TypeError` for other results. `ValueError` if `coarse` does not have half as many
    steps, or if the proposals differ or are a choice between several, because discretisation errors
    of different proposals do not cancel. Types and static settings of the proposals are compared,
    but not numbers such as γ.

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
        "`fine` and `coarse` must both be results of `transition_log_density`, or both results of "
        "`sample_weighted_bridges` or `weigh_bridges`; got "
        f"{type(fine).__name__} and {type(coarse).__name__}."
    )


def _check_pair(fine: Any, coarse: Any) -> None:
    """Raise `ValueError` if the numbers of steps or the proposals do not fit together."""
    if fine.num_steps != 2 * coarse.num_steps:
        raise ValueError(
            f"`coarse` must have half as many steps as `fine`; got {fine.num_steps} steps "
            f"(`fine`) and {coarse.num_steps} steps (`coarse`)."
        )
    # The structure includes the types and static settings of a proposal, the description its γ.
    # Other numbers, such as a burn-in, may depend on the number of steps.
    both = [
        (jax.tree.structure(estimate.proposal), estimate.proposal.describe())
        for estimate in (fine, coarse)
    ]
    if both[0] != both[1] or len(fine.proposal.singles) > 1:
        raise ValueError(
            "`fine` and `coarse` must come from the same single proposal, because "
            "the discretisation errors of different ones do not cancel; "
            f"got {fine.proposal.describe()} and {coarse.proposal.describe()}."
        )


def leading_share(fine: TransitionLogDensity | WeightedBridges) -> Float[Array, "*I"]:
    """Return (2^p - 1)⁻¹ with the order p of the leading error of a single proposal.

    For guided proposals p is the order of the target, also if steps are too long for an estimate of
    the error. For couplings an unknown share counts as that of p = 1.
    """
    target = fine.proposal.singles[0].target
    share = share_of_known_order(fine.step_share)
    return share if target is None else jnp.full_like(share, share_of_order(target.order))


def _log_density(fine: TransitionLogDensity, coarse: TransitionLogDensity):
    """Return the combination of two log densities.

    It is computed relative to the density of the finer grid, so that no digits are lost.
    """
    share = leading_share(fine)
    is_finite = jnp.isfinite(fine.value) & (coarse.value < jnp.inf)
    ratio = jnp.where(
        is_finite, jnp.exp(coarse.value - jnp.where(is_finite, fine.value, 0)), jnp.inf
    )
    combined = _richardson(share, 1.0, ratio)
    # The safe value 1 keeps derivatives and logs finite where the combination is not positive.
    positive = is_finite & (combined > 0)
    safe = jnp.where(positive, combined, 1)
    # The log of an estimate that is zero has an infinite error, but the estimate itself has none.
    coarse_error = jnp.where(ratio > 0, ratio * coarse.standard_error, 0)
    error = _richardson_error(share, fine.standard_error, coarse_error) / safe
    return ExtrapolatedLogDensity(
        jnp.where(positive, fine.value + jnp.log(safe), -jnp.inf),
        jnp.where(positive, error, jnp.inf),
        jnp.where(positive, -jnp.log(safe), jnp.inf),
        fine,
        coarse,
    )


def _richardson(share, fine, coarse):
    """Return fine + (fine - coarse) / (2^p - 1), where `share` is 1 / (2^p - 1)."""
    return fine + share * (fine - coarse)


def _richardson_error(share, fine, coarse):
    """Return the standard error of the combination of two independent estimates."""
    # The combination is (1 + share) · fine - share · coarse.
    return jnp.hypot((1 + share) * fine, share * coarse)
