"""Errors at run time, for those who ask for them by `throw=True`.

Inside compiled code what is missing is data: `met`, `truncated`, `num_nonfinite`. Here it is
turned into one error at the end, with a sentence that says what to change.
"""

from collections.abc import Sequence
from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from .checks import all_finite_leaves

_Result = TypeVar("_Result")

_PARAMETERS = "some parameters of the model are not finite: nothing can be simulated with them."
_MISSING = (
    "some bridges were not found within `max_proposals` proposals: allow more, lengthen the "
    "duration or choose a smaller `gamma`; on intervals much shorter than the relaxation time "
    "pairs hardly ever meet: use `ModifiedDiffusionBridge()` or `Guided()` there."
)
_FAILED = (
    "some paths left the finite numbers or the state space, or ended where they have no density, "
    "so that intervals are without bridges: take more steps, transform the coordinates, or check "
    "that the end points lie in the state space."
)
_TRUNCATED = (
    "some weights were cut off by `max_trials`, and what they weigh is hardly ever hit: allow more "
    "trials, or fit a start law by `fit_start_law`. Or the run that replaces a sampler of the "
    "stationary law was cut off, for its burn-in is unknown (infinite in the result, as where "
    "`measure_burn_in` finds none) or longer than 2¹⁸ steps: give `Diffusion` a "
    "`sample_stationary`, or the coupling a `Stationary(burn_in=...)` that is shorter or a start "
    "law with a density."
)
_HEAVY = (
    "some weights have tails so heavy (a Pareto shape k̂ above 0.7) that their mean and its error "
    "cannot be trusted: choose another proposal, take shorter intervals, or use "
    '`method="crank_nicolson"`.'
)
_GROSS = (
    "some step errors are beyond 0.1 and the standard error: take more steps, or for stiff drift "
    "the scheme `SemiImplicit()`."
)


def throw_where_incomplete(
    result: _Result,
    field: str,
    model: PyTree,
    missing: Bool[Array, "..."],
    truncated: Bool[Array, "..."] | None = None,
    *,
    coupled: bool = True,
    heavy: Bool[Array, "..."] | None = None,
    gross: Bool[Array, "..."] | None = None,
) -> _Result:
    """The result, whose `field` raises `RuntimeError` if anything is missing or cut off, if weights
    have `heavy` tails or the step error is `gross`. What is missing has not met if pairs were
    `coupled`."""
    faults = [
        (missing, _MISSING if coupled else _FAILED),
        (truncated, _TRUNCATED),
        (heavy, _HEAVY),
        (gross, _GROSS),
    ]
    return throw_where(result, field, model, faults)


def throw_where(
    result: _Result,
    field: str,
    model: PyTree,
    faults: Sequence[tuple[Bool[Array, "..."] | None, str]],
) -> _Result:
    """The result, whose `field` raises `RuntimeError` where parameters of the model are not finite,
    or with the message of the first of these faults that there is."""
    value = getattr(result, field)
    for bad, message in [(~all_finite_leaves(model), _PARAMETERS), *faults]:
        if bad is not None:
            value = eqx.error_if(value, jnp.any(bad), message)
    return eqx.tree_at(lambda tree: getattr(tree, field), result, value)
