"""Records: noisy, partial or missing observations of a diffusion at times t_0 < ... < t_K.

The observation model is y_k ~ g(· | X(t_k)) (`observation`), and X(t_0) has a law (`initial`).
Times, values and steps form a `record`. A linear process along a path (`linearisation`) has a
backward h-function, the density of all later observations given the state,

    h_i(x) = p̃(y_k: t_k > t_i | X(t_i) = x) ∝ exp(rᵀ(x - ξ_i) - ½ (x - ξ_i)ᵀ H (x - ξ_i)),

computed by the backward information filter (`information_filter`). Guided paths, whose steps are
tilted by h (`tilted_step`, `guided_steps`), have weights with the likelihood of the record as their
mean:

    w = Z_0 Π_i [∫ p_i(x'| x_i) g(y| x') h_{i+1}(x') dx' / h_i(x_i)].

For a linear model all weights are equal. This extends guided proposals of bridges to several
observations (van der Meulen & Schauer 2017; Mider, Schauer & van der Meulen 2021). The functions
are:

- `log_likelihood`: an unbiased estimate of the likelihood by particle filters with resampling at
  observations (`particle_filter`), for records of any length. If the guide overrates observations
  far ahead, a discount reduces their influence (`forgetting`);
- `innovations`: path and weight as smooth functions of parameters and of normal noise;
- `smooth`: paths given the whole record. Either the noise moves in blocks (`path_blocks`), or,
  across long gaps, the states move with new bridges on both sides (`states`).
"""

# The names that other folders import from this one.
from .exact_observations import as_observations as as_observations
from .forgetting import half_will_do as half_will_do, rate_for_several as rate_for_several
from .guide_search import (
    GuideCheck as GuideCheck,
    check_guide as check_guide,
    linearised as linearised,
    no_check as no_check,
)
from .guided_record import (
    Guidance as Guidance,
    change_by_coarse_steps as change_by_coarse_steps,
    guided as guided,
    knots_and_log_weight as knots_and_log_weight,
    noise_and_log_weight as noise_and_log_weight,
    pair_noise as pair_noise,
    path_and_log_weight as path_and_log_weight,
    path_and_log_weights as path_and_log_weights,
    path_of_knots as path_of_knots,
)
from .initial import Initial as Initial
from .left_out import log_densities_left_out as log_densities_left_out
from .observations import (
    AbstractObservation as AbstractObservation,
    LinearGaussian as LinearGaussian,
)
from .particle_filter import Filtered as Filtered, run_filters as run_filters
from .path_blocks import (
    cuts as cuts,
    has_segments as has_segments,
    swept_path as swept_path,
    tuned as tuned,
)
from .several import (
    Records as Records,
    as_record_problems as as_record_problems,
    linearisations as linearisations,
    on_each_grid as on_each_grid,
    points_and_check as points_and_check,
)
from .simulated import simulate_observations as simulate_observations
from .step_regime import steps_are_too_long as steps_are_too_long
