"""Discretisation error of an estimate: its distance from the limit for small steps.

With D of `halving`, paths with weights w e^D have the law of half as many steps. If the error is
O(δ^p), its leading term is

    error = (2^p - 1)⁻¹ [estimate of N/2 steps - estimate of N steps].

Both estimates use the same paths. Hence their difference has a much smaller Monte Carlo error than
either of them if D is small. This error is reported as the uncertainty.

The uncertainty is infinite in two cases: if few paths carry nearly all of the weights w e^D, and if
a step is longer than the relaxation time of the drift at either end. In both cases the steps are
too long for an estimate. The log of a mean of few weights is too small on average, by half the
relative variance to leading order; the estimate corrects this bias.

For a state-dependent σ e^D has heavy tails. Weights of half as many steps from the same noise do
not. They replace w e^D if only the mean of the weights is needed (`error_of_coupled_grids`).
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Inexact

from ..engine.averages import align_axes, effective_size, normalise_weights, weighted_mean
from ..engine.linalg import spectral_radius
from ..engine.verdict import Fault
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion

# Fewer effective paths than this, or than this share of those without e^D, give no estimate.
_FEWEST_EFFECTIVE, _LEAST_OVERLAP = 5, 0.1
# In units of relaxation times. Steps that are twice as long are then unstable.
_LONGEST_STEP = 1.0
# A smaller step error, in log p or in standard deviations, does not matter to users.
_MATTERS = 0.05
# A smaller rounding error of log p does not matter.
_LEAST_ROUNDING = 1e-3
_SHORTER = "Use more steps (`num_steps`; for observations also a smaller `step_size`)."
_FOR_COUPLINGS = " For stiff drift use the scheme `SemiImplicit()` of the coupling."
_TOO_LARGE = (
    "The discretisation error (`step_error`) exceeds the standard error and 0.05 (of a log "
    f"density, or of a standard deviation). {_SHORTER}"
)
_TOO_LONG = (
    "The discretisation error is unknown, because steps are longer than the relaxation time of "
    "the drift, or σ or time-dependent coefficients change too much within a step (for a "
    f"posterior: in more than a tenth of the draws). {_SHORTER}"
)
_TOO_LONG_OR_VARYING_SIGMA = (
    "The discretisation error is unknown. Either steps are longer than the relaxation time of the "
    "drift: use more `num_steps`, and for stiff drift the scheme `SemiImplicit()` of the coupling. "
    "Or σ depends on the state: then couplings have no estimate, so run two grids and "
    "`extrapolate`. Or the meeting rule of the coupling is not `BrownianCrossing()`, and overlooks "
    "meetings."
)
_NO_ESTIMATE = (
    "The discretisation error is unknown (`step_error` is NaN). There is no estimate for a single "
    "step, for fewer than ten draws, or for steps so long that half as many give a very different "
    f"law. {_SHORTER}"
)
_NO_COMPARISON = (
    "The discretisation error is unknown (`step_uncertainty` is infinite): results for half as "
    f"many steps differ too much, or too few paths carry weight. {_SHORTER} For a small effective "
    "sample size use more proposals, particles or draws, too."
)
_TOO_UNCERTAIN = (
    "The estimate of the discretisation error is too uncertain: `step_uncertainty` exceeds three "
    "standard errors, and the error may exceed 0.05 (of a log density, or of a standard "
    "deviation). Too few paths, bridges or draws determine it, or its leading order is not enough. "
    "Use more proposals, bridges, particles or draws, or more `num_steps`."
)


class StepError(NamedTuple):
    """Discretisation error of an estimate.

    - `value`: the estimated error, NaN if it is unknown.
    - `uncertainty`: its standard error.
    """

    value: Inexact[Array, "..."]
    uncertainty: Inexact[Array, "..."]


def error_of_log_mean(
    log_weights: Float[Array, "*I n"],
    log_halving: Float[Array, "*I n"],
    share: Float[Array, "*I"],
    held: bool = False,
) -> StepError:
    """Estimate the step error of the log of the mean of the weights.

    `log_halving` is D of each path, NaN for paths without D. `share` is (2^p - 1)⁻¹, infinite if
    the error is unknown (`share_in_regime`). `held` states that the weights are the state of a
    pseudo-marginal chain. Their law is then tilted by their mean.
    """
    weights, has_D = _known_weights(log_weights, log_halving)
    D = jnp.where(has_D, log_halving, 0)
    largest = jnp.max(jnp.where(weights > 0, D, -jnp.inf), axis=-1, keepdims=True)
    largest = jnp.where(jnp.isfinite(largest), largest, 0)
    factors = jnp.where(weights > 0, jnp.exp(D - largest), 0)
    mean = jnp.sum(weights * factors, axis=-1)
    is_positive = mean > 0
    ratio = jnp.where(is_positive, mean, 1)
    # Normalised before they are squared: relative to a large D the other factors are tiny.
    coarse = weights * factors / ratio[..., None]
    change = jnp.log(ratio) + largest[..., 0]
    return _error_of_log_ratio(weights, coarse, share, change, is_positive, held)


def error_of_coupled_grids(
    log_weights: Float[Array, "*I n"],
    log_coarse: Float[Array, "*I n"],
    share: Float[Array, "*I"],
    num_steps: int,
    held: bool = False,
) -> StepError:
    """Estimate the step error of the log of the mean of the weights, from coarse paths.

    `log_coarse` are the log weights of paths of half as many steps with the same noise. They are
    NaN for paths without a coarse path, and -inf for a lost coarse path.
    """
    has_coarse = ~jnp.isnan(log_coarse)
    logs = [jnp.where(has_coarse, log, -jnp.inf) for log in (log_weights, log_coarse)]
    weights, coarse = (normalise_weights(log) for log in logs)
    fine_sum, coarse_sum = (logsumexp(log, axis=-1) for log in logs)
    is_known = jnp.isfinite(fine_sum) & jnp.isfinite(coarse_sum)
    change = jnp.where(is_known, coarse_sum, 0) - jnp.where(is_known, fine_sum, 0)
    share = share_of_pairs(share, num_steps)
    return _error_of_log_ratio(weights, coarse, share, change, is_known, held)


def share_of_pairs(share: Float[Array, "*I"], num_steps: int) -> Float[Array, "*I"]:
    """Return the share of the change by coarse steps that replace pairs of steps.

    If N is odd, the last step is the same on both grids, so the share is scaled by N/(N - 1).
    """
    return share * num_steps / max(num_steps - num_steps % 2, 1)


def _error_of_log_ratio(weights, coarse, share, change, is_known, held):
    """Return the step error from the log of the ratio of two means, by their normalised weights."""
    spread = jnp.sqrt(jnp.sum((coarse - weights) ** 2, axis=-1))
    # The log of a mean is too small on average, by half its relative variance; there are two such
    # logs. Under the law that is tilted by the mean, the log of the ratio is too small by half its
    # own variance.
    fresh = jnp.sum(coarse**2, axis=-1) - jnp.sum(weights**2, axis=-1)
    overlap = _overlap(weights, coarse)
    bias = jnp.where(overlap, spread**2 if held else fresh, 0) / 2
    spread = jnp.where(overlap, spread, jnp.inf)
    return _scale(share, change + bias, spread, is_known)


def error_of_mean(
    log_weights: Float[Array, "*I n"],
    log_halving: Float[Array, "*I n"],
    share: Float[Array, "*I"],
    values: Inexact[Array, "..."],
    coarse_values: Inexact[Array, "..."] | None = None,
) -> StepError:
    """Estimate the step error of the weighted mean of values, entry by entry.

    `values` has shape (*I, n, ...). `coarse_values` are the values for half as many steps, by
    default the same.
    """
    coarse_values = values if coarse_values is None else coarse_values
    weights, has_D = _known_weights(log_weights, log_halving)
    # Not from `weights`, which may underflow to zero.
    D = jnp.where(has_D, log_halving, 0)
    # The largest weight is factored out before D, which may be tiny, is added.
    largest = jnp.max(log_weights, axis=-1, keepdims=True, initial=-jnp.inf, where=has_D)
    largest = jnp.where(jnp.isfinite(largest), largest, 0)
    coarse = normalise_weights(jnp.where(has_D, (log_weights - largest) + D, -jnp.inf))
    axis = weights.ndim - 1
    fine_mean, coarse_mean = weighted_mean(weights, values), weighted_mean(coarse, coarse_values)
    terms = align_axes(coarse, values) * (coarse_values - jnp.expand_dims(coarse_mean, axis))
    terms -= align_axes(weights, values) * (values - jnp.expand_dims(fine_mean, axis))
    spread = jnp.sqrt(jnp.sum(jnp.where(align_axes(has_D, values), terms, 0) ** 2, axis))
    overlap = _overlap(weights, coarse)
    share, overlap = (
        leaf.reshape(*leaf.shape, *[1] * (spread.ndim - leaf.ndim)) for leaf in (share, overlap)
    )
    spread = jnp.where(overlap, spread, jnp.inf)
    is_known = jnp.isfinite(coarse_mean) & jnp.isfinite(fine_mean)
    change = jnp.where(is_known, coarse_mean - fine_mean, 0)
    return _scale(share, change, jnp.where(is_known, spread, 0), is_known)


def relative_change(D: Float[Array, "..."], typical: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return e^(D - typical) - 1, to second order above zero and exactly below.

    Its covariance with a function is the change of the function's mean under the weights e^D.
    A draw that half as many steps lose, D = -∞, counts as missing, -1. Above zero e^D itself may
    have no finite variance.
    """
    D = D - typical
    above = jnp.maximum(D, 0)
    return jnp.where(D < 0, jnp.expm1(jnp.minimum(D, 0)), above + above**2 / 2)


@jax.jit  # a single program if the caller is not compiled
def dominates(error: StepError, standard_error: Inexact[Array, "..."]) -> Bool[Array, "..."]:
    """Return whether the step error exceeds the standard error, or may do so undetected.

    This holds if its size exceeds both the standard error and twice its uncertainty, if the
    uncertainty exceeds three standard errors, or if either is NaN.
    """
    size, uncertainty = jnp.abs(error.value), error.uncertainty
    is_small = size <= jnp.maximum(standard_error, 2 * uncertainty)
    return ~(is_small & (uncertainty <= 3 * standard_error))


def with_rounding(error: StepError, num_steps: int, d: int) -> StepError:
    """Add the rounding error to the uncertainty of the log of a mean of weights.

    Log weights are sums over steps of numbers near one. Each has an error of half a unit in the
    last place, and the errors along a path need not cancel. The bound is N d ε/2, with ε = 1.2e-7
    in single precision. It is added if it exceeds 0.001.
    """
    rounding = num_steps * d * float(jnp.finfo(error.value.dtype).eps) / 2
    if rounding < _LEAST_ROUNDING:
        return error
    return error._replace(uncertainty=jnp.hypot(error.uncertainty, rounding))


def root_mean_square_in_sds(
    value: Float[Array, "*I K d"], variance: Float[Array, "*I K d"]
) -> Float[Array, "*I"]:
    """Return the root mean square of errors at points of a path, in their standard deviations.

    Entries that do not vary are left out.
    """
    varies = variance > 1e-6 * jnp.max(variance, axis=(-2, -1), keepdims=True)
    squares = jnp.where(varies, value**2 / jnp.where(varies, variance, 1), 0)
    number = jnp.maximum(jnp.sum(varies, axis=(-2, -1)), 1).astype(value.dtype)
    return jnp.sqrt(jnp.sum(squares, axis=(-2, -1)) / number)


@partial(jax.jit, static_argnames="coupled")  # a single program if the caller is not compiled
def step_faults(
    error: StepError,
    standard_error: Inexact[Array, "..."],
    sd: Inexact[Array, "..."] | float = 1.0,
    coupled: bool = False,
) -> tuple[Fault, ...]:
    """Return the faults of a step error that dominates and that matters.

    The error matters if it or its uncertainty exceeds 0.05 `sd`; for the log of a density `sd` is
    1. At most one fault is present in each entry: the error is large, or unknown for one of three
    reasons, or its estimate is too uncertain. `coupled` states that the paths are from a coupling,
    which has no estimate for a state-dependent σ.
    """
    size, uncertainty, floor = jnp.abs(error.value), error.uncertainty, _MATTERS * sd
    present = dominates(error, standard_error) & ~((size <= floor) & (uncertainty <= floor))
    values = jnp.broadcast_arrays(present, error.value, uncertainty, standard_error)[1:]
    detail = "the estimate is {:.2g} ± {:.1g}, and the standard error {:.2g}"
    too_large = _TOO_LARGE + _FOR_COUPLINGS if coupled else _TOO_LARGE
    too_long = _TOO_LONG_OR_VARYING_SIGMA if coupled else _TOO_LONG
    cases = (
        (jnp.isnan(size) & jnp.isinf(uncertainty), too_long),
        (jnp.isnan(size), _NO_ESTIMATE),
        (~jnp.isfinite(uncertainty), _NO_COMPARISON),
        (size > jnp.maximum(standard_error, 2 * uncertainty), too_large),
        (jnp.ones_like(present), _TOO_UNCERTAIN),
    )
    faults = []
    for case, sentence in cases:
        has_numbers = sentence in (too_large, _TOO_UNCERTAIN)
        numbers = (detail, tuple(values)) if has_numbers else ("", ())
        faults.append(Fault(present & case, sentence, *numbers))
        present &= ~case
    return tuple(faults)


def share_of_order(order: int | float) -> float:
    """Return (2^p - 1)⁻¹, the error of order p over the change under half as many steps."""
    return 1 / (2**order - 1)


# D has no information about the error. Estimates from it were wrong by factors of 10,000.
UNKNOWN_SHARE = math.inf
# A smaller share of intervals with too long steps does not matter to a sum over all intervals.
MOST_TOO_LONG = 0.02
_GUESS = 3.0


def guessed(share: Float[Array, "*I"]) -> Float[Array, "*I"]:
    """Return the share, with the guess 3 in place of an unknown (infinite) one."""
    return jnp.where(share == UNKNOWN_SHARE, _GUESS, share)


def share_in_regime(
    share: Float[Array, "*I"], model: Diffusion, intervals: Intervals, num_steps: int | float
) -> Float[Array, "*I"]:
    """Return the share, infinite if a step is longer than the relaxation time at either end.

    A share of zero stays zero. The mean of a step of length δ is usually a polynomial of δ∇α, in
    place of an exponential function. Half as many steps are unstable if the spectral radius ρ of
    ∇α has 2δρ > 2. Then changes can have any size and either sign, and may be small by chance. One
    end is enough: paths from a slow tail to a fast centre, or between the walls of a well, are
    wrong then.
    """

    def rate(x):
        return spectral_radius(jax.jacfwd(model.drift)(x))

    rates = jax.vmap(rate)(jnp.concatenate([intervals.start, intervals.end])).reshape(2, -1)
    too_long = jnp.max(rates, axis=0) * intervals.duration / num_steps > _LONGEST_STEP
    return jnp.where(too_long & (share > 0), UNKNOWN_SHARE, share)


def unknown_where(unknown: Bool[Array, ""], error: StepError) -> StepError:
    """Return the step error, NaN with an infinite uncertainty where it is unknown."""
    value, uncertainty = error
    return StepError(jnp.where(unknown, jnp.nan, value), jnp.where(unknown, jnp.inf, uncertainty))


def share_of_known_order(share: Float[Array, "*I"]) -> Float[Array, "*I"]:
    """Return the error divided by its change under half as many steps, at most 1.

    An unknown or guessed share is above 1. It becomes 1, that of order p = 1.
    """
    return jnp.minimum(share, 1)


def _overlap(weights: Float[Array, "*I n"], coarse: Float[Array, "*I n"]) -> Bool[Array, "*I"]:
    """Return whether enough paths have weight under both laws, and enough paths have weight at all.

    A single path would have no uncertainty.
    """
    size = effective_size(weights)
    return (effective_size(coarse) >= _LEAST_OVERLAP * size) & (size >= _FEWEST_EFFECTIVE)


def _known_weights(
    log_weights: Float[Array, "*I n"], log_halving: Float[Array, "*I n"]
) -> tuple[Float[Array, "*I n"], Bool[Array, "*I n"]]:
    """Return the normalised weights of the paths with a D, and a mask of these paths."""
    has_D = ~jnp.isnan(log_halving) & (log_weights > -jnp.inf)
    return normalise_weights(jnp.where(has_D, log_weights, -jnp.inf)), has_D


def _scale(share, change, spread, is_known):
    """Return the share of a change, with its uncertainty.

    Both are zero for a share of zero. The value is NaN with an infinite uncertainty for an unknown
    share. Both are NaN for an unknown change.
    """
    share = jnp.asarray(share, change.dtype)
    unknown = share == UNKNOWN_SHARE
    factor = jnp.where(unknown, 1, share)
    of = lambda value: jnp.where(share == 0, 0, jnp.where(is_known, factor * value, jnp.nan))
    value, uncertainty = of(change), of(spread)
    return StepError(
        jnp.where(unknown, jnp.nan, value),
        jnp.where(unknown & ~jnp.isnan(uncertainty), jnp.inf, uncertainty),
    )
