"""Effective fraction of the draws of x_0 by normal noise, estimated from a law that covers ν.

Let f be the tilted density of x_0, n the tilted normal law in its place, and q the tilted mixture
of `cover`. The fraction is (∫f)² / ∫ f²/n = (E_q f/q)² / E_q (f/q)(f/n).
"""

import math

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float

from ..engine.averages import nan_to_neg_inf
from ..engine.compiled import compiled_sooner
from ..models.diffusion import Diffusion
from .cover import cover, covered_start
from .guided_record import correction, guided
from .initial import calls_for_cover, log_ratio
from .problem import RecordProblem
from .segments import split_first

_NUM_DRAWS = 1024


@compiled_sooner
def start_share(
    problem: RecordProblem, model: Diffusion, points: Float[Array, "points d"]
) -> Float[Array, ""]:
    """Return the effective fraction of draws of x_0, for a record guided along these points."""
    dtype = problem.like.dtype
    if not calls_for_cover(problem.initial, model, problem.like):
        return jnp.ones((), dtype)
    guide, log_nu = guided(problem, model, points), model.prepared().log_stationary
    law = cover(model, guide.initial)
    h = jax.tree.map(lambda leaf: leaf[0, 0], guide.steps.h)
    start = covered_start(law, guide.first, points[0], h)
    of_first = correction(problem, model)
    # Stratified positions: each law of the mixture gets its exact share of the draws.
    positions = (jnp.arange(_NUM_DRAWS, dtype=dtype) + 0.5) / _NUM_DRAWS
    zeta = jax.random.normal(jax.random.key(0), (problem.dim, _NUM_DRAWS), dtype)

    def both(x):
        log_factor = of_first(split_first(problem.rows)[0], x)
        to_cover = log_nu(x) - law.log_density(x) + start.log_integral
        to_normal = log_ratio(problem.initial, model, guide.initial, x) + guide.start.log_integral
        return nan_to_neg_inf(log_factor + to_cover), nan_to_neg_inf(log_factor + to_normal)

    to_cover, to_normal = jax.vmap(both, in_axes=-1)(start.points(positions, zeta))
    log_num = math.log(_NUM_DRAWS)
    log_mean = logsumexp(to_cover) - log_num
    return jnp.exp(2 * log_mean - logsumexp(to_cover + to_normal) + log_num)
