"""Choice of the step density nearest to a scheme, for the estimate of its discretisation error."""

from ..models.dynamics import Dynamics
from .base import AbstractScheme
from .gaussian_transition import GaussianTransition
from .heun import Heun
from .heun_or_euler import scheme_for
from .step_density import AbstractStepDensity, EulerDensity, ItoTaylorDensity
from .step_error import UNKNOWN_SHARE, share_of_order


def step_law_of(scheme: AbstractScheme, dynamics: Dynamics) -> tuple[AbstractStepDensity, float]:
    """The normal law of a step that comes nearest to that of the scheme, and the step error of the
    scheme as a share of what half as many steps change with that law: infinite where that says
    little of it, as where σ varies and what is estimated is not a law of normal steps.

    A scheme of which nothing is known, and `SemiImplicit`, whose mean is of second order for linear
    drift only, is taken to be of first order: its error is then told too large rather than too
    small.
    """
    scheme = scheme_for(scheme, dynamics)
    if isinstance(scheme, GaussianTransition):
        return EulerDensity(), 0.0  # there is no step error
    if isinstance(scheme, Heun) and not dynamics.sigma_varies:
        return ItoTaylorDensity(), share_of_order(ItoTaylorDensity.order)
    if dynamics.sigma_varies:
        # A reversed path has σ at the other ends of its steps, and what its weights are off by was
        # anything from nothing to seven times what this law tells.
        return EulerDensity(), UNKNOWN_SHARE
    return EulerDensity(), share_of_order(EulerDensity.order)
