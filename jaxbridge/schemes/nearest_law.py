"""Choice of the step density nearest to a scheme, for the estimate of its discretisation error."""

from ..models.dynamics import Dynamics
from .base import AbstractScheme
from .gaussian_transition import GaussianTransition
from .heun import Heun
from .heun_or_euler import scheme_for
from .step_density import AbstractStepDensity, EulerDensity, ItoTaylorDensity, LinearDensity
from .step_error import UNKNOWN_SHARE, share_of_order


def step_law_of(scheme: AbstractScheme, dynamics: Dynamics) -> tuple[AbstractStepDensity, float]:
    """Return the step density nearest to a scheme, and the share for its discretisation error.

    The share is the discretisation error of the scheme relative to the change by half as many
    steps, computed with that density. It is `UNKNOWN_SHARE` (infinite) for a state-dependent σ,
    because the change then says little about the error of the scheme.

    Unknown schemes count as schemes of first order, so their error is overestimated rather than
    underestimated. So does `SemiImplicit`, whose mean has second order for linear drift only.
    """
    scheme = scheme_for(scheme, dynamics)
    if isinstance(scheme, GaussianTransition):
        return LinearDensity(), 0.0
    if isinstance(scheme, Heun) and not dynamics.sigma_varies:
        return ItoTaylorDensity(), share_of_order(ItoTaylorDensity.order)
    if dynamics.sigma_varies:
        # A reversed path has σ at the other ends of its steps. In experiments the error of its
        # weights was between zero and seven times the change with this law.
        return EulerDensity(), UNKNOWN_SHARE
    return EulerDensity(), share_of_order(EulerDensity.order)
