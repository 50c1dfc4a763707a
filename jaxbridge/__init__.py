"""Diffusion bridges and inference for stochastic differential equations from discrete data, in JAX.

A *bridge* is a path of a diffusion between two given points. The library samples bridges, estimates
transition densities and likelihoods, and infers parameters from exact or noisy observations.

Each folder imports only from folders above it in this list. The docstring of a folder begins with
its mathematics.

- `engine`: batches, noise, compilation and checks of arguments. It contains nothing about
  diffusions.
- `models`: diffusions, their time reversal, and ready models.
- `schemes`: numerical schemes, step densities, path likelihoods and discretisation errors.
- `coupling`: pairs of paths that meet, approximate bridges and hitting counts.
- `proposals`: paths with unbiased weights, by couplings or by guided proposals.
- `exact`: importance sampling, Markov chains and transition densities from weights.
- `records`: noisy, partial or missing observations: log-likelihoods, smoothed paths, innovations.
- `tuning`: choices by pilot runs, and error against computing time.
- `inference`: parameters from observations.
- `plot`, `studies`: pictures; the study of the paper.

References to equations and sections are to Bladt, Finch & Sørensen, *Simulation of multivariate
diffusion bridges*. Equations are cited by their labels in its source.

All examples in docstrings assume these lines:

```python
import jax
import jax.numpy as jnp
import jaxbridge as jb

key = jax.random.key(0)
model = jb.ornstein_uhlenbeck(jnp.array([[1.5, 1.0], [1.0, 1.5]]))
start, end = jnp.array([0.0, 0.0]), jnp.array([1.0, 0.0])
bridges = jb.sample_bridges(key, model, start, end, 1.0, num_bridges=100)

times = jnp.array([0.0, 0.5, 1.5, 2.0])
observations = jnp.array([[0.0, 0.0], [0.5, -0.3], [0.2, 0.4], [-0.3, 0.6]])
```
"""

from importlib import metadata as _metadata

from .coupling.base import AbstractCoupling
from .coupling.bridges import Bridges, sample_bridges
from .coupling.burn_in import measure_burn_in
from .coupling.effects import effects
from .coupling.gamma import Coupling
from .coupling.hitting import HittingCounts, hitting_counts
from .coupling.meeting import AbstractMeeting, BrownianCrossing, PairStep, ReflectionPlane, SignTest
from .coupling.rotation import no_rotation, polar_rotation, published_rotation
from .coupling.start_laws import (
    Reversed,
    StartLaw,
    Stationary,
)
from .engine.diagnostics import effective_sample_size, potential_scale_reduction
from .engine.pareto import pareto_k
from .exact.chains import sample_exact_bridges
from .exact.crank_nicolson import crank_nicolson
from .exact.density import (
    TransitionLogDensity,
    transition_log_density,
)
from .exact.events import Events, sample_events
from .exact.exits import Exits, sample_exits
from .exact.expectation import expectation
from .exact.extrapolation import ExtrapolatedBridges, ExtrapolatedLogDensity, extrapolate
from .exact.importance import (
    WeightedBridges,
    sample_weighted_bridges,
    weigh_bridges,
)
from .exact.kernels import Chain, Kernel
from .exact.pseudo_marginal import pseudo_marginal
from .exact.renewal import renewal
from .inference.calibration import Calibration, simulation_based_calibration
from .inference.gibbs import (
    GibbsPosterior,
    GibbsState,
    gibbs,
)
from .inference.maximum_likelihood import (
    MaximumLikelihood,
    maximum_likelihood,
)
from .inference.pmmh import PMMHPosterior, PMMHState, pmmh
from .inference.population import NormalPopulation
from .inference.posterior import AbstractPosterior
from .inference.priors import NormalPrior
from .inference.record_gibbs import RecordPosterior, RecordState
from .inference.record_maximum import RecordMaximumLikelihood
from .inference.score import Score, score
from .inference.summary import PosteriorSummary
from .models.diffusion import Diffusion
from .models.fitzhugh_nagumo import FitzHughNagumoParams, fitzhugh_nagumo
from .models.gaussian_bridge import GaussianBridge, gaussian_bridge
from .models.gaussian_law import GaussianLaw
from .models.hyperbolic import hyperbolic
from .models.integrated import integrated
from .models.jumps import Jumps
from .models.lamperti import lamperti
from .models.langevin import langevin, stationary_diffusion
from .models.ornstein_uhlenbeck import (
    OrnsteinUhlenbeckParams,
    ornstein_uhlenbeck,
    ou_stationary,
    ou_transition,
)
from .models.seasonal import SeasonalParams, seasonal_ornstein_uhlenbeck
from .models.simulate import simulate
from .models.transform import Transformed, transform
from .models.underdamped_langevin import UnderdampedLangevinParams, underdamped_langevin
from .models.windings import windings
from .proposals.base import AbstractWeightedProposal
from .proposals.choice import Choice
from .proposals.coupled import CoupledPairs
from .proposals.guided import AbstractGuidedProposal, Step
from .proposals.linear_guide import Guided
from .proposals.modified_bridge import ModifiedDiffusionBridge
from .proposals.residual_bridge import ResidualBridge
from .records.forecast import Forecast, forecast
from .records.innovations import Innovations, innovations
from .records.log_likelihood import LogLikelihood, log_likelihood
from .records.observations import (
    AbstractComponents,
    AbstractObservation,
    Censored,
    LinearGaussian,
    LogNormal,
    NegativeBinomialCounts,
    ObservationDensity,
    PoissonCounts,
    Quantity,
    Rounded,
    StudentT,
)
from .records.simulated import simulate_observations
from .records.smooth import Smoothed, smooth
from .records.smoothing_kernel import smoothing_kernel
from .schemes.base import AbstractScheme
from .schemes.euler import Euler
from .schemes.gaussian_transition import GaussianTransition
from .schemes.heun import Heun
from .schemes.heun_or_euler import HeunOrEuler
from .schemes.milstein import Milstein
from .schemes.path_likelihood import path_log_likelihood
from .schemes.relative_frame import Frame
from .schemes.semi_implicit import SemiImplicit
from .schemes.step_density import (
    AbstractStepDensity,
    EulerDensity,
    HypoellipticDensity,
    ItoTaylorDensity,
    LinearStep,
    LocalLinearDensity,
    StepsFrom,
)
from .schemes.step_law import DegenerateLaw, StepLaw
from .schemes.survival import log_survival
from .tuning.choose_proposal import choose_proposal
from .tuning.hitting_variation import HittingVariation, hitting_variation
from .tuning.settings import Setting, WorkPrecision
from .tuning.start_law import Pilot, Tuning, fit_start_law, tune_coupling
from .tuning.work_precision import work_precision

__version__ = _metadata.version("jaxbridge")

__all__ = [
    # Models and their paths.
    "Diffusion",
    "ornstein_uhlenbeck",
    "OrnsteinUhlenbeckParams",
    "hyperbolic",
    "langevin",
    "stationary_diffusion",
    "transform",
    "lamperti",
    "Transformed",
    "simulate",
    "simulate_observations",
    "Jumps",
    "windings",
    # Hypoelliptic and time-dependent models.
    "fitzhugh_nagumo",
    "FitzHughNagumoParams",
    "underdamped_langevin",
    "UnderdampedLangevinParams",
    "integrated",
    "seasonal_ornstein_uhlenbeck",
    "SeasonalParams",
    # Bridges by coupling.
    "sample_bridges",
    "Bridges",
    "Coupling",
    # Schemes, meeting rules and rotations of couplings.
    "Heun",
    "HeunOrEuler",
    "Euler",
    "Milstein",
    "SemiImplicit",
    "GaussianTransition",
    "BrownianCrossing",
    "SignTest",
    "ReflectionPlane",
    "polar_rotation",
    "no_rotation",
    "published_rotation",
    # Guided proposals and their target densities.
    "ModifiedDiffusionBridge",
    "Guided",
    "ResidualBridge",
    "EulerDensity",
    "HypoellipticDensity",
    "ItoTaylorDensity",
    "LocalLinearDensity",
    # Exact bridges, by Markov chains or by weights.
    "sample_exact_bridges",
    "Chain",
    "sample_weighted_bridges",
    "weigh_bridges",
    "WeightedBridges",
    "expectation",
    "extrapolate",
    "ExtrapolatedBridges",
    "ExtrapolatedLogDensity",
    # The same Markov chains as kernels.
    "pseudo_marginal",
    "renewal",
    "crank_nicolson",
    "Kernel",
    # Transition densities.
    "transition_log_density",
    "TransitionLogDensity",
    # Start laws of the associated diffusion.
    "Stationary",
    "GaussianLaw",
    "Reversed",
    "StartLaw",
    "fit_start_law",
    "measure_burn_in",
    # Choices by pilot runs.
    "choose_proposal",
    "Choice",
    "tune_coupling",
    "Tuning",
    "Pilot",
    # Records: noisy, partial or missing observations.
    "forecast",
    "Forecast",
    "LinearGaussian",
    "PoissonCounts",
    "NegativeBinomialCounts",
    "StudentT",
    "LogNormal",
    "Censored",
    "Rounded",
    "ObservationDensity",
    "AbstractObservation",
    "AbstractComponents",
    "Quantity",
    "log_likelihood",
    "LogLikelihood",
    "smooth",
    "Smoothed",
    "smoothing_kernel",
    "innovations",
    "Innovations",
    # Inference from discrete observations.
    "gibbs",
    "GibbsPosterior",
    "GibbsState",
    "RecordPosterior",
    "RecordState",
    "pmmh",
    "PMMHPosterior",
    "PMMHState",
    "maximum_likelihood",
    "MaximumLikelihood",
    "RecordMaximumLikelihood",
    "score",
    "Score",
    "PosteriorSummary",
    "simulation_based_calibration",
    "Calibration",
    "NormalPrior",
    "NormalPopulation",
    "path_log_likelihood",
    "log_survival",
    "sample_exits",
    "Exits",
    "sample_events",
    "Events",
    # Diagnostics and costs.
    "hitting_counts",
    "HittingCounts",
    "hitting_variation",
    "HittingVariation",
    "effective_sample_size",
    "pareto_k",
    "potential_scale_reduction",
    "work_precision",
    "WorkPrecision",
    "Setting",
    "effects",
    # The exact laws of Ornstein–Uhlenbeck processes.
    "gaussian_bridge",
    "GaussianBridge",
    "ou_stationary",
    "ou_transition",
    # Base classes to subclass, and the arguments of their methods.
    "AbstractCoupling",
    "Frame",
    "AbstractMeeting",
    "PairStep",
    "AbstractScheme",
    "AbstractStepDensity",
    "StepLaw",
    "DegenerateLaw",
    "StepsFrom",
    "LinearStep",
    "AbstractGuidedProposal",
    "Step",
    "AbstractWeightedProposal",
    "CoupledPairs",
    "AbstractPosterior",
]
