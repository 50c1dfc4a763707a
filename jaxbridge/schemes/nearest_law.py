"""The normal law of a step that comes nearest to that of a scheme, for its step error."""

from ..models.dynamics import Dynamics
from .base import AbstractScheme
from .euler import Euler
from .gaussian_transition import GaussianTransition
from .heun import Heun
from .heun_or_euler import scheme_for
from .milstein import Milstein
from .step_density import AbstractStepDensity, EulerDensity, ItoTaylorDensity
from .step_error import share_of_order


def step_law_of(scheme: AbstractScheme, dynamics: Dynamics) -> tuple[AbstractStepDensity, float]:
    """The normal law of a step that comes nearest to that of the scheme, and the step error of the
    scheme as a share of what half as many steps change with that law.

    A scheme of which nothing is known, and `SemiImplicit`, whose mean is of second order for linear
    drift only, is taken to be of first order: its error is then told too large rather than too
    small.
    """
    scheme = scheme_for(scheme, dynamics)
    if isinstance(scheme, GaussianTransition):
        return EulerDensity(), 0.0  # there is no step error
    if isinstance(scheme, Heun) and not dynamics.sigma_varies:
        return ItoTaylorDensity(), share_of_order(ItoTaylorDensity.order)
    if dynamics.sigma_varies and not isinstance(scheme, Euler | Milstein):
        # Of first order like Euler's, and two to four times as large where it was measured.
        return EulerDensity(), 3 * share_of_order(EulerDensity.order)
    return EulerDensity(), share_of_order(EulerDensity.order)
