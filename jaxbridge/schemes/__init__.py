"""One step, x' = step(x, ΔW) with ΔW ~ N(0, δ I): made, inverted, and its density.

A scheme (`base`) makes the step, says which noise made it, ΔW = noise(x, x'), and how a pair of
points lies for that noise, by the direction u and the length of σ(x')⁻¹(x - x') (`relative_frame`).
Schemes are `euler` and `milstein`, `heun` of second order for constant σ, `semi_implicit` for stiff
drift, and for a linear one its own transition (`gaussian_transition`); whether scheme, model and
points fit is checked (`fit`); by default it is the one that the scene calls for
(`heun_or_euler`). The density of a step (`step_density`), a normal law N(μ(x), δ σ S σᵀ), which is
singular where noise does not reach the whole state (`step_law`), makes the likelihood of a path,
Σ log q(x_i, x_{i+1}) (`path_likelihood`). The same of every other point says what half as many
steps would give (`halving`), and so how far N steps are from the limit (`step_error`); or estimates
on coarser and coarser grids do (`coarse_grids`).
"""

# What the folders above use of this one.
from .base import (
    AbstractScheme as AbstractScheme,
    fitted_in_lanes as fitted_in_lanes,
    steps_in_lanes as steps_in_lanes,
)
from .coarse_grids import (
    error_of_grids as error_of_grids,
    num_coarse_grids as num_coarse_grids,
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
from .nearest_law import step_law_of as step_law_of
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
    check_step_density as check_step_density,
    most_accurate_density as most_accurate_density,
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
    step_fault as step_fault,
    unknown_where as unknown_where,
    with_rounding as with_rounding,
)
from .step_law import (
    DegenerateLaw as DegenerateLaw,
    StepLaw as StepLaw,
    solve_root as solve_root,
)
