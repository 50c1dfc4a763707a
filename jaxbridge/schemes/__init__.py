"""Numerical schemes, densities of one step, and discretisation errors.

The main functions of a scheme (`base`) are, with noise ΔW ~ N(0, δ I):

- `step` computes the next point, x' = step(x, ΔW);
- `noise` inverts the step, ΔW = noise(x, x');
- `frame` returns the direction and the length of σ(x')⁻¹(x - x') for a coupled pair
  (`relative_frame`).

The schemes are:

- `euler` and `milstein`;
- `heun`, of weak order 2 for constant σ;
- `semi_implicit`, for stiff drift;
- `gaussian_transition`, exact for linear drift and constant σ;
- `heun_or_euler`, the default, which selects by the model.

`fit` checks that scheme, model and end points fit together.

A step density (`step_density`) is a normal law N(μ(x), δ σ S σᵀ) of one step. It is singular if
noise does not enter all coordinates (`step_law`). The sum Σ log q(x_i, x_{i+1}) is the
log-likelihood of a path (`path_likelihood`).

Two methods estimate the discretisation error. `halving` compares N with N/2 steps on the same
paths, and `step_error` derives the error from this comparison. `coarse_grids` compares estimates on
coarser grids.
"""

# The names that other folders import from this one.
from .base import (
    AbstractScheme as AbstractScheme,
    fitted_in_lanes as fitted_in_lanes,
    steps_in_lanes as steps_in_lanes,
)
from .coarse_grids import (
    LEAST_UNCERTAINTY as LEAST_UNCERTAINTY,
    error_of_grids as error_of_grids,
    num_coarse_grids as num_coarse_grids,
    num_splits as num_splits,
    remaining_after_splits as remaining_after_splits,
    share_of_grid as share_of_grid,
)
from .euler import Euler as Euler
from .fit import check_model as check_model
from .gaussian_transition import GaussianTransition as GaussianTransition
from .halving import (
    log_halving_of_all_steps as log_halving_of_all_steps,
    log_halving_of_pair as log_halving_of_pair,
    log_halving_of_paths as log_halving_of_paths,
    num_looked as num_looked,
)
from .heun import Heun as Heun
from .heun_or_euler import (
    HeunOrEuler as HeunOrEuler,
    scheme_for as scheme_for,
)
from .path_likelihood import (
    Form as Form,
    density_of_form as density_of_form,
    forms_of_targets as forms_of_targets,
    log_likelihood_of_steps as log_likelihood_of_steps,
    log_likelihoods as log_likelihoods,
)
from .relative_frame import (
    Frame as Frame,
    frame as frame,
)
from .step_density import (
    AbstractStepDensity as AbstractStepDensity,
    EulerDensity as EulerDensity,
    HypoellipticDensity as HypoellipticDensity,
    ItoTaylorDensity as ItoTaylorDensity,
    LinearDensity as LinearDensity,
    LocalLinearDensity as LocalLinearDensity,
    QuadraticDensity as QuadraticDensity,
    check_step_density as check_step_density,
    known_transition as known_transition,
    most_accurate_density as most_accurate_density,
    with_transition as with_transition,
)
from .step_error import (
    MOST_TOO_LONG as MOST_TOO_LONG,
    UNKNOWN_SHARE as UNKNOWN_SHARE,
    StepError as StepError,
    dominates as dominates,
    error_of_coupled_grids as error_of_coupled_grids,
    error_of_log_mean as error_of_log_mean,
    error_of_mean as error_of_mean,
    guessed as guessed,
    relative_change as relative_change,
    root_mean_square_in_sds as root_mean_square_in_sds,
    share_in_regime as share_in_regime,
    share_of_known_order as share_of_known_order,
    share_of_order as share_of_order,
    share_of_pairs as share_of_pairs,
    step_faults as step_faults,
    unknown_where as unknown_where,
    with_rounding as with_rounding,
)
from .step_law import (
    DegenerateLaw as DegenerateLaw,
    StepLaw as StepLaw,
    solve_root as solve_root,
)
