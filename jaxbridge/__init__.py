"""Diffusion bridges by coupling, in JAX.

Data flows one way: a model (`diffusion`, `models`, `gaussian`) and a scheme (`schemes`) make
steps; a coupling (`coupling`) with a meeting rule (`meeting`) makes pairs of paths and joins them
(`proposals`); a search (`search`), on one device or several (`devices`), keeps the pairs that met
(`bridges`). The diffusion associated with a bridge (`associated`), started from some law
(`start_laws`, `burn_in`), hits it or not (`hitting`), which makes a weight (`coupled_pairs`).
Proposals that are pulled to the end point (`guided`) have a weight made of the densities of their
steps (`step_density`), and pilot runs choose (`choice`, `tuning`). On weighted proposals
(`weighted`) are built importance sampling (`importance`), transition densities (`transition`) and
Markov chains (`chains`, one method a module), with `diagnostics` on top; what was not found
raises an error where that is asked for (`throwing`). The likelihood of a path (`likelihood`) and
what is not known (`unknowns`, `observations`, `problem`) make inference: bridges complete the
observations (`parts`, `completion`), and parameters follow from complete paths
(`parameter_steps`), in turn (`gibbs`), or from densities (`pmmh`), or as maximum likelihood
estimates (`score`, `maximum_likelihood`); `expectation` has derivatives that are right. What a
program simulates is decided in one table (`decisions`, `scene`), and its loops run over many
lanes of small points (`lanes`, `noise`). Other coordinates are for state spaces with a boundary
(`transform`), or for a σ of one (`lamperti`). Exact
laws stand beside (`gaussian`, `linear`), what accuracy costs above (`work_precision`), and the
studies above all (`study`, `exact_study`, `accuracy_study`, `bayes_study`, `crossover_study`,
`benchmark`), with their pictures (`plot`, `study_figures`). References to equations and sections
are to Bladt, Finch & Sørensen, *Simulation of multivariate diffusion bridges*.
"""

from .bridges import Bridges as Bridges, sample_bridges as sample_bridges
from .burn_in import measure_burn_in as measure_burn_in
from .chains import sample_exact_bridges as sample_exact_bridges
from .choice import Choice as Choice
from .coupled_pairs import CoupledPairs as CoupledPairs
from .coupling import (
    AbstractCoupling as AbstractCoupling,
    Coupling as Coupling,
    no_rotation as no_rotation,
    polar_rotation as polar_rotation,
    published_rotation as published_rotation,
)
from .crank_nicolson_chain import crank_nicolson as crank_nicolson
from .diagnostics import (
    HittingVariation as HittingVariation,
    effective_sample_size as effective_sample_size,
    hitting_variation as hitting_variation,
    potential_scale_reduction as potential_scale_reduction,
)
from .diffusion import Diffusion as Diffusion
from .expectation import expectation as expectation
from .gaussian import (
    GaussianBridge as GaussianBridge,
    GaussianLaw as GaussianLaw,
    OrnsteinUhlenbeckParams as OrnsteinUhlenbeckParams,
    gaussian_bridge as gaussian_bridge,
    ornstein_uhlenbeck as ornstein_uhlenbeck,
    ou_stationary as ou_stationary,
    ou_transition as ou_transition,
)
from .gibbs import (
    GibbsPosterior as GibbsPosterior,
    GibbsState as GibbsState,
    gibbs as gibbs,
)
from .guided import (
    AbstractGuidedProposal as AbstractGuidedProposal,
    Guided as Guided,
    ModifiedDiffusionBridge as ModifiedDiffusionBridge,
    NoiseLaw as NoiseLaw,
    ResidualBridge as ResidualBridge,
    Step as Step,
)
from .hitting import HittingCounts as HittingCounts, hitting_counts as hitting_counts
from .importance import (
    WeightedBridges as WeightedBridges,
    sample_weighted_bridges as sample_weighted_bridges,
    weigh_bridges as weigh_bridges,
)
from .kernels import Chain as Chain, Kernel as Kernel
from .lamperti import lamperti as lamperti
from .likelihood import path_log_likelihood as path_log_likelihood
from .maximum_likelihood import (
    MaximumLikelihood as MaximumLikelihood,
    maximum_likelihood as maximum_likelihood,
)
from .meeting import (
    AbstractMeeting as AbstractMeeting,
    BrownianCrossing as BrownianCrossing,
    Frame as Frame,
    PairStep as PairStep,
    ReflectionPlane as ReflectionPlane,
    SignTest as SignTest,
)
from .models import (
    hyperbolic as hyperbolic,
    langevin as langevin,
    stationary_diffusion as stationary_diffusion,
)
from .pmmh import PMMHPosterior as PMMHPosterior, PMMHState as PMMHState, pmmh as pmmh
from .posterior import AbstractPosterior as AbstractPosterior
from .pseudo_marginal_chain import pseudo_marginal as pseudo_marginal
from .renewal_chain import renewal as renewal
from .scene import effects as effects
from .schemes import (
    AbstractScheme as AbstractScheme,
    Euler as Euler,
    GaussianTransition as GaussianTransition,
    Heun as Heun,
    Milstein as Milstein,
    SemiImplicit as SemiImplicit,
)
from .score import Score as Score, score as score
from .simulate import simulate as simulate
from .start_laws import (
    Reversed as Reversed,
    StartLaw as StartLaw,
    Stationary as Stationary,
)
from .step_density import (
    AbstractStepDensity as AbstractStepDensity,
    EulerDensity as EulerDensity,
    TrapezoidDensity as TrapezoidDensity,
)
from .transform import Transformed as Transformed, transform as transform
from .transition import (
    TransitionLogDensity as TransitionLogDensity,
    transition_log_density as transition_log_density,
)
from .tuning import (
    Pilot as Pilot,
    Tuning as Tuning,
    choose_proposal as choose_proposal,
    fit_start_law as fit_start_law,
    tune_coupling as tune_coupling,
)
from .unknowns import NormalPrior as NormalPrior
from .weighted import AbstractWeightedProposal as AbstractWeightedProposal
from .work_precision import (
    Setting as Setting,
    WorkPrecision as WorkPrecision,
    work_precision as work_precision,
)
