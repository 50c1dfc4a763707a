"""Variation of the hitting probability over exact bridges, by a regression.

π_T(z) is the probability that the associated diffusion hits the path z. By equation (z-density) the
approximate bridge has the density `f_bridge(z) π_T(z) / π_T`. Hence approximate bridges are exact
if π_T(z) is constant in z. Let ρ̂_N be the mean of N counts, and B an exact bridge. By equation
(regression)

    V(ρ̂_N) = V(1/π_T(B)) + E[(1 - π_T(B)) / π_T(B)²] / N,

so a regression of the variance of ρ̂_N on 1/N has the intercept V(1/π_T(B)). The equation needs
**fresh** counts for each exact bridge: the counts stored in a pseudo-marginal chain are
size-biased.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from ..coupling import AnyStartLaw, hitting_counts
from ..engine.arguments import as_sequence
from ..engine.averages import normalise_weights
from ..engine.checks import check_count, check_key
from ..engine.entry import public_entry
from ..engine.keys import key_for
from ..exact import AbstractExactBridges, Chain, WeightedBridges
from ..models.diffusion import Diffusion


class HittingVariation(NamedTuple):
    """Result of `hitting_variation`: the regression of V(ρ̂_N) on 1/N.

    Standard errors are by bootstrap over the bridges. Scalars have shape ().

    - `num_counts`, `variances`: N and V(ρ̂_N), shape (K,).
    - `intercept`, `intercept_error`: estimate of V(1/π_T(B)), and its standard error. The estimate
        may be negative by chance.
    - `slope`: estimate of E[(1 - π_T(B)) / π_T(B)²].
    - `mean`: mean of ρ̂_N for the largest N, an estimate of E[1/π_T(B)].
    - `ratio`, `ratio_error`: √intercept / mean, the coefficient of variation of 1/π_T(B), and its
        standard error. A negative intercept gives zero. The exact value is zero if approximate
        bridges are exact.
    - `num_truncated`: number of bridges left out because `max_trials` truncated their counts.
    """

    num_counts: Int[Array, " K"]
    variances: Float[Array, " K"]
    intercept: Float[Array, ""]
    intercept_error: Float[Array, ""]
    slope: Float[Array, ""]
    mean: Float[Array, ""]
    ratio: Float[Array, ""]
    ratio_error: Float[Array, ""]
    num_truncated: Int[Array, ""]


@public_entry
def hitting_variation(
    key: Key[Array, ""],
    model: Diffusion,
    bridges: WeightedBridges | Chain,
    num_counts: Sequence[int] = (50, 100, 150, 200, 300),
    *,
    start_law: AnyStartLaw | None = None,
    max_trials: int | None = None,
) -> HittingVariation:
    """Estimate how much 1/π_T varies over exact bridges, as in section 3.2 of the paper.

    A large variation means that approximate bridges are biased and that weights are unequal.

    **Arguments:**

    - `key`, `model`, `max_trials`: as in `hitting_counts`.
    - `bridges`: exact bridges of one interval with complete paths, paths of shape (n, N+1, d).
        Pass a result of `weigh_bridges`, whose weights are used, or of `sample_exact_bridges`. Thin
        the chain first, because repeated states need new counts but add little information.
    - `num_counts`: two or more increasing values of N. The largest is the number of simulated
        counts per bridge.
    - `start_law`: law of the associated diffusion at time zero, by default that of the bridges'
        coupling.

    **Returns:** `HittingVariation`.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    weighted = jb.weigh_bridges(key, model, bridges)
    jb.hitting_variation(key, model, weighted, num_counts=(10, 20, 40)).ratio
    ```
    """
    check_key(key)
    sizes = [check_count("num_counts", n) for n in as_sequence("num_counts", num_counts, "counts")]
    if len(sizes) < 2 or sorted(set(sizes)) != sizes:
        raise ValueError(f"`num_counts` needs two or more increasing numbers; got {num_counts}.")
    if not isinstance(bridges, AbstractExactBridges):
        raise TypeError(
            "`bridges` must have the exact law: pass a result of `weigh_bridges` or "
            f"`sample_exact_bridges`; got {type(bridges).__name__}."
        )
    if bridges.paths.ndim != 3 or len(bridges.paths) < 2:
        raise ValueError(
            "`bridges` must be two or more of one interval, with paths of shape (n, N+1, d); got "
            f"paths of shape {bridges.paths.shape}."
        )
    hits = hitting_counts(
        key_for("variation", key),
        model,
        bridges,
        sizes[-1],
        start_law=start_law,
        max_trials=max_trials,
    )
    usable = bridges.met & ~hits.truncated
    weights = jnp.where(usable, normalise_weights(bridges.log_mean_weights), 0)
    # The 1 is a placeholder: bridges that are not usable have weight zero.
    sums = jnp.cumsum(jnp.where(usable[:, None], hits.counts, 1), axis=1)
    ends = np.asarray(sizes)
    # ρ̂_N of each bridge, shape (n, K). The estimates share counts, so the errors are correlated
    # over N: hence the bootstrap.
    rho = sums[:, ends - 1].astype(weights.dtype) / ends.astype(weights.dtype)
    resampled = jax.random.randint(key_for("bootstrap", key), (200, len(rho)), 0, len(rho))
    estimates = _regress(rho, weights, ends)
    replicates = _replicates(resampled, rho, weights, ends)
    variances, intercept, slope, mean, ratio = estimates
    # `nanstd`: a bootstrap sample without a usable bridge has no estimate.
    return HittingVariation(
        jnp.asarray(ends),
        variances,
        intercept,
        jnp.nanstd(replicates[1]),
        slope,
        mean,
        ratio,
        jnp.nanstd(replicates[4]),
        jnp.sum(hits.truncated),
    )


def _regress(
    rho: Float[Array, "n K"], weights: Float[Array, " n"], sizes: Int[Array | np.ndarray, " K"]
):
    """Return V(ρ̂_N), the intercept and slope of its regression on 1/N, the mean and the ratio."""
    weights = weights / jnp.sum(weights)
    mean = weights @ rho
    # With equal weights this is the variance with n - 1 in the denominator.
    variances = weights @ (rho - mean) ** 2 / (1 - jnp.sum(weights**2))
    x = (1 / sizes).astype(variances.dtype)
    slope = jnp.sum((x - x.mean()) * variances) / jnp.sum((x - x.mean()) ** 2)
    intercept = variances.mean() - slope * x.mean()
    # The variance of 1/π is not negative, but its estimate may be.
    ratio = jnp.sqrt(jnp.maximum(intercept, 0)) / mean[-1]
    return variances, intercept, slope, mean[-1], ratio


@jax.jit
def _replicates(resampled, rho, weights, sizes):
    """Repeat the regression for each bootstrap sample, given by bridge indices of shape (B, n)."""
    return jax.vmap(lambda i: _regress(rho[i], weights[i], sizes))(resampled)
