"""Bridges from a to b by coupling: two diffusions that meet are one from then on.

A coupling drives X' by the noise of X, and X by that of X' (`base`; `gamma`),

    dW' = {I - (1-γ)Π} O dW + √(1-γ²) u dU,    Π = uuᵀ,

with u along σ(x')⁻¹(x - x') and O a `rotation` that aligns σ(x) and σ(x'), which by default the
triangular root of V = σσᵀ makes unnecessary, until a rule says that they have met (`meeting`): one
step of a `pair`. With X run back from b and X' from a, joined where they meet, Z = X' before and X
after is a proposed bridge (`join`), and those that met are kept (`bridges`). They have the density
f_br(z) π(z) / π, π(z) the probability that the diffusion associated with z (`associated`)
hits z; it starts from ν or another law (`start_laws`), for a ν without sampler from draws of it
(`smoothed_draws`), taken when the past is forgotten (`burn_in`). How many it takes to hit is
counted (`hitting`). `effects` is a table of what such a program simulates, and why.
"""

# What the folders above use of this one.
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
    described as described,
    ingredients as ingredients,
    most_accurate as most_accurate,
)
from .hitting import (
    HittingCounts as HittingCounts,
    check_max_trials as check_max_trials,
    count_hits as count_hits,
    counts_of as counts_of,
    coupling_of as coupling_of,
    default_lanes as default_lanes,
    durations_of as durations_of,
    hitting_counts as hitting_counts,
    search_for_hits as search_for_hits,
)
from .join import Inputs as Inputs
from .start_laws import (
    AnyStartLaw as AnyStartLaw,
    Reversed as Reversed,
    Stationary as Stationary,
    draw_starts as draw_starts,
    log_ratio as log_ratio,
    needs_burn_in as needs_burn_in,
    run_is_cut as run_is_cut,
)
