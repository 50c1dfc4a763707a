"""Couplings of two copies of a diffusion, and the approximate bridges built from them.

A coupling drives a second copy X' of the diffusion by the noise of the first copy X, or X by the
noise of X' (`base`, `gamma`):

    dW' = {I - (1-γ)Π} O dW + √(1-γ²) u dU,    Π = uuᵀ.

Here u points along σ(x')⁻¹(x - x'), and the rotation O aligns σ(x) with σ(x') (`rotation`). By
default the triangular root of V = σσᵀ drives the pair, and no rotation is needed.

A bridge from a to b is proposed in four steps:

- Simulate X backwards in time from b, and X' forwards from a; `pair` makes one step of both.
- Decide in each step whether the two meet (`meeting`).
- Join the paths: Z is X' before the meeting and X after it (`join`).
- Reject the proposals whose pair does not meet (`bridges`).

The accepted paths have the density f_br(z) π(z) / π. In it f_br is the density of the exact bridge,
π(z) the probability that the diffusion associated with z hits z (`associated`), and π the
normaliser. Four modules serve the estimation of π(z):

- `hitting` counts the associated diffusions up to a hit.
- `start_laws` holds the laws of their initial state: the stationary density ν, or another law.
- `burn_in` measures the time after which a run nearly has the law ν, for a ν without sampler.
- `smoothed_draws` builds a start law with a density from draws of ν.

`nearest_law` gives the step density nearest to a coupling. `effects` returns a table of the effects
that the program of a model and a coupling simulates, with reasons.
"""

# Names for the packages that build on this one.
from .associated import run_associated as run_associated
from .base import AbstractCoupling as AbstractCoupling
from .bridges import (
    Bridges as Bridges,
    Joined as Joined,
    find_bridges as find_bridges,
    sample_bridges as sample_bridges,
)
from .burn_in import (
    measure_burn_in as measure_burn_in,
    with_start_law as with_start_law,
)
from .gamma import (
    Coupling as Coupling,
    describe_coupling as describe_coupling,
    ingredients as ingredients,
    most_accurate as most_accurate,
)
from .hitting import (
    HittingCounts as HittingCounts,
    bridge_durations as bridge_durations,
    check_max_trials as check_max_trials,
    count_hits as count_hits,
    count_hits_of_bridges as count_hits_of_bridges,
    coupling_of_bridges as coupling_of_bridges,
    default_lanes as default_lanes,
    hitting_counts as hitting_counts,
    search_for_hits as search_for_hits,
)
from .join import Inputs as Inputs
from .nearest_law import step_law_of as step_law_of
from .start_laws import (
    AnyStartLaw as AnyStartLaw,
    Reversed as Reversed,
    Stationary as Stationary,
    draw_starts as draw_starts,
    log_ratio as log_ratio,
    needs_burn_in as needs_burn_in,
    run_is_cut as run_is_cut,
)
