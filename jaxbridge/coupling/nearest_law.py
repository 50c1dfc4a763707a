"""Choice of the step density nearest to a coupling, for its discretisation error."""

from jaxtyping import Array, Float

from ..models.diffusion import Diffusion
from ..schemes import (
    UNKNOWN_SHARE,
    AbstractStepDensity,
    EulerDensity,
    GaussianTransition,
    Heun,
    ItoTaylorDensity,
    LinearDensity,
    scheme_for,
    share_of_order,
)
from .base import AbstractCoupling
from .meeting import BrownianCrossing


def step_law_of(
    coupling: AbstractCoupling, model: Diffusion, like: Float[Array, " d"]
) -> tuple[AbstractStepDensity, float]:
    """Return the step density nearest to a coupling, and the share for its discretisation error.

    Half as many steps change the estimate; this change is computed with the step density. The share
    is the discretisation error of the scheme divided by the change. It is `UNKNOWN_SHARE`
    (infinite) for a state-dependent σ and for meeting rules other than `BrownianCrossing`, because
    the change then has little information about the error.

    Unknown schemes count as schemes of first order, so their error is overestimated rather than
    underestimated. So does `SemiImplicit`, whose mean has second order for linear drift only.
    """
    if not isinstance(coupling.meeting, BrownianCrossing):
        # Meetings that the rule overlooks have an error of order 1/2, which steps do not show.
        return EulerDensity(), UNKNOWN_SHARE
    dynamics = model.forward(like)
    # The default scheme may recognise a linear drift in one direction of time only.
    schemes = [scheme_for(coupling.scheme, each, like) for each in (dynamics, model.backward(like))]
    if all(isinstance(each, GaussianTransition) for each in schemes):
        return LinearDensity(), 0.0
    of_second_order = all(isinstance(each, GaussianTransition | Heun) for each in schemes)
    if of_second_order and not dynamics.sigma_varies:
        return ItoTaylorDensity(), share_of_order(ItoTaylorDensity.order)
    if dynamics.sigma_varies:
        # A reversed path has σ at the other ends of its steps. In experiments the error of its
        # weights was between zero and seven times the change with this law.
        return EulerDensity(), UNKNOWN_SHARE
    return EulerDensity(), share_of_order(EulerDensity.order)
