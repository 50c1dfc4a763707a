"""How much do hitting probabilities vary over exact bridges?

The approximate bridge has the density `f_bridge(z) π_T(z) / π_T`, equation (z-density): it is
exact if π_T(z) is constant. With ρ̂_N the mean of N counts and B an exact bridge,

    V(ρ̂_N) = V(1/π_T(B)) + E[(1 - π_T(B)) / π_T(B)²] / N,

equation (regression), so a regression of the variance of ρ̂_N on 1/N has V(1/π_T(B)) as its
intercept. It holds for **fresh** counts drawn for each exact bridge; the counts that a chain
itself has kept are size-biased.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from ..coupling import AnyStartLaw, hitting_counts
from ..engine.arguments import as_sequence
from ..engine.averages import normalised
from ..engine.checks import check_count, check_key
from ..engine.doors import door
from ..engine.keys import key_for
from ..exact import AbstractExactBridges, Chain, WeightedBridges
from ..models.diffusion import Diffusion


class HittingVariation(NamedTuple):
    """What `hitting_variation` returns: the regression of V(ρ̂_N) on 1/N, with standard errors by
    bootstrap over the bridges.

    - `num_counts`, `variances`: N and V(ρ̂_N), shape (K,).
    - `intercept`, `intercept_error`: an estimate of V(1/π_T(B)), which chance can make negative,
        and its error.
    - `slope`: an estimate of E[(1-π)/π²].
    - `mean`: of ρ̂, an estimate of E[1/π_T(B)].
    - `ratio`, `ratio_error`: √intercept / mean, zero for a negative intercept: the variation of
        1/π_T(B), and its error. Zero for a proposal that is exact as it is.
    - `num_truncated`: bridges left out because their counts were cut off by `max_trials`.
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


@door
def hitting_variation(
    key: Key[Array, ""],
    model: Diffusion,
    bridges: WeightedBridges | Chain,
    num_counts: Sequence[int] = (50, 100, 150, 200, 300),
    *,
    start_law: AnyStartLaw | None = None,
    max_trials: int | None = None,
) -> HittingVariation:
    """How much 1/π_T varies over exact bridges: section 3.2 of the paper.

    **Arguments:**

    - `key`, `model`, `max_trials`: as in `hitting_counts`.
    - `bridges`: exact ones, of one interval, with whole paths: from `sample_exact_bridges`
        (thin the chain: states that repeat cost counts but say little) or `weigh_bridges`,
        whose weights are taken into account.
    - `num_counts`: increasing, at least two. The largest is what is simulated for each bridge.
    - `start_law`: where the associated diffusion starts, by default as the bridges' coupling has
        it.

    **Returns:** `HittingVariation`.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    **Example:**

    ```python
    weighted = jb.weigh_bridges(key, model, bridges)
    jb.hitting_variation(key, model, weighted, num_counts=(10, 20, 40)).ratio
    ```
    """
    check_key(key)
    sizes = [check_count("num_counts", n) for n in as_sequence("num_counts", num_counts, "counts")]
    if len(sizes) < 2 or sorted(set(sizes)) != sizes:
        raise ValueError(f"`num_counts` must be two or more increasing numbers; got {num_counts}.")
    if not isinstance(bridges, AbstractExactBridges):
        raise TypeError(
            "`bridges` must have the exact law: pass what `weigh_bridges` or "
            f"`sample_exact_bridges` returned; got {type(bridges).__name__}."
        )
    if bridges.paths.ndim != 3 or len(bridges.paths) < 2:
        raise ValueError(
            "`bridges` must be two or more of one interval, paths of shape (n, N+1, d); got "
            f"{bridges.paths.shape}."
        )
    counted = hitting_counts(
        key_for("variation", key),
        model,
        bridges,
        sizes[-1],
        start_law=start_law,
        max_trials=max_trials,
    )
    usable = bridges.met & ~counted.truncated
    weights = jnp.where(usable, normalised(bridges.log_mean_weights), 0)
    sums = jnp.cumsum(jnp.where(usable[:, None], counted.counts, 1), axis=1)
    ends = np.asarray(sizes)
    # ρ̂_N of each bridge, (n, K)
    rho = sums[:, ends - 1].astype(weights.dtype) / ends.astype(weights.dtype)
    drawn = jax.random.randint(key_for("bootstrap", key), (200, len(rho)), 0, len(rho))
    estimates = _regress(rho, weights, ends)
    replicates = _replicates(drawn, rho, weights, ends)
    variances, intercept, slope, mean, ratio = estimates
    return HittingVariation(
        jnp.asarray(ends),
        variances,
        intercept,
        jnp.nanstd(replicates[1]),
        slope,
        mean,
        ratio,
        jnp.nanstd(replicates[4]),
        jnp.sum(counted.truncated),
    )


def _regress(
    rho: Float[Array, "n K"], weights: Float[Array, " n"], sizes: Int[Array | np.ndarray, " K"]
):
    """V(ρ̂_N), then intercept and slope of its regression on 1/N, the mean and the ratio."""
    weights = weights / jnp.sum(weights)
    mean = weights @ rho
    # With equal weights this is the variance with n - 1 in the denominator.
    variances = weights @ (rho - mean) ** 2 / (1 - jnp.sum(weights**2))
    x = (1 / sizes).astype(variances.dtype)
    slope = jnp.sum((x - x.mean()) * variances) / jnp.sum((x - x.mean()) ** 2)
    intercept = variances.mean() - slope * x.mean()
    ratio = jnp.sqrt(jnp.maximum(intercept, 0)) / mean[-1]
    return variances, intercept, slope, mean[-1], ratio


@jax.jit
def _replicates(drawn, rho, weights, sizes):
    """The regression with bridges drawn anew, with replacement: the bootstrap."""
    return jax.vmap(lambda i: _regress(rho[i], weights[i], sizes))(drawn)
