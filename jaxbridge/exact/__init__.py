"""What is made of weights, on any proposal: bridges of the exact law (`exact_bridges`),

    E_bridge[h] = E[w h(path)] / E[w],    p_T(a, b) = E[w],

by importance sampling (`importance`) and by Markov chains (`chains`), which are kernels as well
(`kernels`): `pseudo_marginal`, `renewal` and `crank_nicolson`, a method a module. Transition
densities are means of weights (`density`), and `expectation` has derivatives that are right. Two
grids make one estimate without their leading step error (`extrapolation`).
"""

# What the folders above use of this one.
from .chains import sample_exact_bridges as sample_exact_bridges
from .density import (
    estimate_log_density as estimate_log_density,
    log_mean_and_error as log_mean_and_error,
    transition_log_density as transition_log_density,
)
from .exact_bridges import AbstractExactBridges as AbstractExactBridges
from .extrapolation import extrapolate as extrapolate
from .importance import (
    WeightedBridges as WeightedBridges,
    sample_weighted_bridges as sample_weighted_bridges,
    weigh_bridges as weigh_bridges,
)
from .kernels import (
    Chain as Chain,
    acceptance_rate as acceptance_rate,
)
from .renewal import (
    first_paths as first_paths,
    propose_paths as propose_paths,
    renew as renew,
)
