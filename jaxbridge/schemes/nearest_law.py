"""The normal law of a step that comes nearest to that of a scheme, for its step error."""

from ..models.dynamics import Dynamics
from .base import AbstractScheme
from .euler import Euler
from .gaussian_transition import GaussianTransition
from .milstein import Milstein
from .step_density import AbstractStepDensity, EulerDensity, ItoTaylorDensity
from .step_error import share_of_order


def step_law_of(scheme: AbstractScheme, dynamics: Dynamics) -> tuple[AbstractStepDensity, float]:
    """The normal law of a step that comes nearest to that of the scheme, and the step error of the
    scheme as a share of what half as many steps change with that law."""
    if isinstance(scheme, GaussianTransition):
        return EulerDensity(), 0.0  # there is no step error
    if isinstance(scheme, Euler | Milstein):
        return EulerDensity(), share_of_order(EulerDensity.order)
    if dynamics.sigma_varies:
        # Of first order like Euler's, and two to four times as large where it was measured.
        return EulerDensity(), 3 * share_of_order(EulerDensity.order)
    return ItoTaylorDensity(), share_of_order(ItoTaylorDensity.order)
