"""Bridges with the exact law, from the weights w of any proposal:

    E_bridge[h] = E[w h(path)] / E[w],    p_T(a, b) = E[w].

- `exact_bridges` is the base class of results: means over exact bridges, and their errors.
- `importance` weights independent bridges (importance sampling).
- `chains` runs Markov chains of bridges. Their kernels are `pseudo_marginal`, `renewal` and
    `crank_nicolson`, one module each, with common parts in `kernels`.
- `density` estimates transition densities, as means of weights.
- `log_means` has the errors of logs of means.
- `exits` estimates probabilities of exits from a region.
- `expectation` estimates means over bridges, with correct derivatives.
- `extrapolation` combines two grids into an estimate without the leading discretisation error.
"""

# Names for the packages that build on this one.
from .chains import sample_exact_bridges as sample_exact_bridges
from .density import (
    estimate_log_density as estimate_log_density,
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
    Kernel as Kernel,
    acceptance_rate as acceptance_rate,
)
from .log_means import (
    log_mean_and_error as log_mean_and_error,
    log_mean_of_runs as log_mean_of_runs,
)
from .renewal import (
    first_paths as first_paths,
    propose_paths as propose_paths,
    renew as renew,
)
