"""Measurement of the burn-in: the time after which the reversed diffusion is nearly stationary.

Models without a sampler of their stationary law need it. The method couples two copies of the
reversed diffusion by reflection. One copy starts from b, the other from the end of another run of
length s from b. Let τ be the time when they meet. By the coupling inequality, the total variation
distance between the laws of the copies at time t is at most P(τ > t).

The method doubles s until all of 512 pairs meet within s. Then a time s closes every distance that
a run of length s opens. A very small s does not pass, because pairs at a distance of order √s do
not all meet within s. The burn-in is 2s.

The result has these limits:

- 512 meetings show only that P(τ > s) is about 1/512 or less.
- Meeting times have exponential tails if the drift pulls back in proportion to the distance, or
    with a force that does not vanish far out. Then P(τ > 2s) is of the order of P(τ > s)². The
    remaining distance is about 512⁻² ≈ 4·10⁻⁶.
- Meeting times have polynomial tails if the drift fades far out, as for heavy-tailed stationary
    laws. Then a doubling of s gains a constant factor only; 2·10⁻³ has been measured.
- A diffusion may stay in one well for very many relaxation times. No finite run shows this.

In the last two cases pass a longer time to `Stationary(burn_in=...)`, or choose a start law with a
density.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.arguments import check_instance
from ..engine.checks import Numbers, check_key, check_num_steps, is_traced
from ..engine.compiled import compiled
from ..engine.entry import public_entry
from ..engine.keys import fold_in_each, key_for
from ..engine.lanes import over_lanes
from ..engine.linalg import is_finite
from ..engine.noise import noisy_scan
from ..models.bridge_problem import as_intervals, as_points
from ..models.diffusion import Diffusion, check_diffusion
from ..models.dynamics import Dynamics
from ..schemes import check_model
from .base import AbstractCoupling
from .gamma import Coupling
from .pair import Lane, PairNoise, drive, have_met, in_lanes
from .rotation import driven_through_root
from .smoothed_draws import NUM_DRAWS, SmoothedDraws, smoothed_draws
from .start_laws import MOST_STEPS, Stationary, draw_starts, needs_burn_in, run_for

_NUM_PAIRS = 512
# Non-finite pairs are ignored, as in bridges, unless their share is larger than this.
_MOST_EXPLODED = 0.5


def with_burn_in(
    key: Key[Array, ""],
    model: Diffusion,
    coupling: AbstractCoupling,
    end: Float[Array, "P d"],
    duration: Float[Array, " P"],
    num_steps: int,
) -> AbstractCoupling:
    """Return the coupling, with a measured burn-in in its start law if that needs one.

    The burn-in is infinite if no time was found. `run_is_cut` recognises that value.
    """
    if not needs_burn_in(coupling.start_law, model):
        return coupling
    time = _measure_time(key, model, coupling, _replace_missing(end), duration, num_steps)
    # The constructor refuses infinite times, so the field is set afterwards.
    law = eqx.tree_at(lambda law: law.burn_in, Stationary(1.0), time)
    return eqx.tree_at(lambda c: c.start_law, coupling, law)


def with_start_law(
    key: Key[Array, ""],
    model: Diffusion,
    coupling: AbstractCoupling,
    end: Float[Array, "P d"],
    duration: Float[Array, " P"],
    num_steps: int,
) -> AbstractCoupling:
    """Return the coupling for weights, where the start law may be any law with a density.

    For `Stationary()` without `burn_in`, and a model with a density but no sampler of ν, smoothed
    draws replace ν as the start law. Otherwise the result is that of `with_burn_in`.
    """
    measured = with_burn_in(key, model, coupling, end, duration, num_steps)
    if not (needs_burn_in(coupling.start_law, model) and model.has_density):
        return measured
    # Runs of the measured length supply the draws, once for all trials.
    law = _smoothed_law(key, model, measured, _replace_missing(end), duration, num_steps)
    return eqx.tree_at(lambda c: c.start_law, measured, law)


def _replace_missing(end: Float[Array, "P d"]) -> Float[Array, "P d"]:
    """Return the ends, with a finite one in place of each NaN (the end of a missing bridge)."""
    is_found = jnp.all(jnp.isfinite(end), axis=1, keepdims=True)
    return jnp.where(is_found, end, end[jnp.argmax(is_found)])


@compiled
def _smoothed_law(key, model, coupling, end, duration, num_steps) -> SmoothedDraws:
    interval = jnp.arange(NUM_DRAWS) * len(end) // NUM_DRAWS
    # An infinite burn-in (none found) makes `draw_starts` take the longest run.
    # Named keys keep these draws independent of the random numbers of the proposals.
    draw_key, fit_key = (key_for(f"smoothed draws{suffix}", key) for suffix in ("", ", fit"))
    keys = jax.random.split(draw_key, NUM_DRAWS)
    dt, law = duration[interval] / num_steps, coupling.start_law
    draws = draw_starts(
        law, model.prepared(), coupling.scheme, keys, end[interval].T, dt, num_steps
    )
    return smoothed_draws(fit_key, draws.T, end[0], model.prepared())


@public_entry
def measure_burn_in(
    key: Key[Array, ""],
    model: Diffusion,
    end: Numbers,
    duration: Numbers,
    *,
    num_steps: int = 50,
    coupling: AbstractCoupling | None = None,
) -> Float[Array, ""]:
    """Estimate a time after which the reversed diffusion from `end` is nearly stationary.

    Pass this time to `Stationary(burn_in=...)`. It is a multiple of the (longest) `duration`: twice
    a time within which all of 512 coupled pairs meet. Pairs that become non-finite do not count.

    The remaining distance to the stationary density ν, in total variation, depends on the drift:

    - It is about 1e-5 under exponential mixing, for instance if the drift pulls back however far
        out.
    - It may be 2e-3 if the drift fades far out, as for heavy-tailed stationary laws. Then use a
        multiple of this time.
    - It is unknown if the diffusion stays in one well for very many of its relaxation times: no
        finite run shows this. Then choose a longer time yourself.

    **Arguments:** as in `sample_bridges`. Of `coupling` only the scheme and the rotation matter.

    **Returns:** one time for all intervals, shape (). Inside `jit` it is infinite if no time was
    found. Functions that measure the burn-in themselves also use infinity, and mark results of
    runs that are too short as `truncated` (see `Stationary`).

    **Raises:** `ValueError` and `TypeError` for invalid arguments. `ValueError` if some pairs have
    not met after at most 2¹⁷ steps, or if most pairs become non-finite.

    **Example:**

    ```python
    burn_in = jb.measure_burn_in(key, model, end, 1.0)
    coupling = jb.Coupling(0.5, start_law=jb.Stationary(burn_in))
    ```
    """
    check_key(key)
    check_diffusion(model)
    num_steps = check_num_steps(num_steps, 1)
    end = as_points("end", end)
    if not is_traced(end) and not np.all(np.isfinite(end)):
        raise ValueError(
            f"`end` must be finite; got {end}. Remove points that are NaN or infinite."
        )
    intervals, _, _ = as_intervals(end, end, duration)
    coupling = Coupling() if coupling is None else coupling
    check_instance("coupling", coupling, AbstractCoupling, "a `Coupling`")
    check_model(model, intervals, coupling.scheme)
    model.check_reversal()
    time = _measure_time(key, model, coupling, intervals.end, intervals.duration, num_steps)
    if not is_traced(time) and not np.isfinite(time):
        raise ValueError(
            "no burn-in was found: the pairs of copies of the reversed diffusion have not all met "
            "after 2¹⁷ steps, or most paths became non-finite. Pass a sampler of the stationary "
            "law to `Diffusion`, a start law with a density to the coupling, or, if you know the "
            "time, `Stationary(burn_in=...)`. A stiff drift needs short steps in an explicit "
            "scheme: pass the scheme `SemiImplicit()`, which allows longer steps."
        )
    return time


@compiled
def _measure_time(
    key: Key[Array, ""],
    model: Diffusion,
    coupling: AbstractCoupling,
    end: Float[Array, "P d"],
    duration: Float[Array, " P"],
    num_steps: int,
) -> Float[Array, ""]:
    """Return 2s for the first s = 1, 2, 4, ... times `num_steps` steps within which all pairs meet.

    Pairs that become non-finite are ignored. Return infinity if there is no such s, or if more than
    half of the pairs become non-finite.
    """
    key = key_for("burn-in", key)
    interval = jnp.arange(_NUM_PAIRS) * len(end) // _NUM_PAIRS
    end, dt = end[interval].T, duration[interval] / num_steps
    # Reflection needs no dU, and pairs meet fast. Scheme and rotation are those of the user.
    reflection = Coupling(-1.0, scheme=coupling.scheme, rotation=coupling.rotation)
    backward = model.prepared().backward(end[:, 0])
    dynamics = driven_through_root(reflection, backward, end[:, 0])
    pairs = in_lanes(reflection, dynamics, end[:, 0], jax.random.split(key, _NUM_PAIRS), dt)
    # 2s must not exceed the bound on the steps of a run.
    max_doublings = max(0, (MOST_STEPS // 2 // num_steps).bit_length() - 1)

    def attempt(doublings):
        """Return whether all pairs met, and whether too many became non-finite."""
        ahead_key, pair_key = jax.random.split(jax.random.fold_in(key, doublings))
        keys, repeats = jax.random.split(ahead_key, _NUM_PAIRS), 2**doublings
        repeats_of_lanes = jnp.full(_NUM_PAIRS, repeats)
        # X' starts at the end of an independent run of length s.
        driven = run_for(dynamics, coupling.scheme, keys, end, dt, num_steps, repeats_of_lanes)
        x, driven, met = _run_pairs(pair_key, dynamics, pairs, end, driven, num_steps, repeats)
        exploded = ~met & ~jnp.all(is_finite(x) & is_finite(driven), axis=0)
        # A few lost pairs are tolerable; many mean that the step size is too large.
        too_many = jnp.mean(exploded) > _MOST_EXPLODED
        return jnp.all(met | exploded) & ~too_many, too_many

    def is_unfinished(state):
        doublings, (all_met, too_many) = state
        return ~all_met & ~too_many & (doublings < max_doublings)

    def double(state):
        doublings, _ = state
        return doublings + 1, attempt(doublings + 1)

    init = (jnp.int32(0), attempt(jnp.int32(0)))
    doublings, (all_met, _) = lax.while_loop(is_unfinished, double, init)
    # With several intervals the step sizes differ; the longest is on the safe side.
    time = 2 * num_steps * jnp.max(dt) * (2**doublings).astype(dt.dtype)
    return jnp.where(all_met, time, jnp.inf)


def _run_pairs(
    key: Key[Array, ""],
    dynamics: Dynamics,
    pairs: tuple[Lane, Lane],
    x: Float[Array, "d pairs"],
    driven: Float[Array, "d pairs"],
    num_steps: int,
    repeats: Int[Array, ""],
) -> tuple[Float[Array, "d pairs"], Float[Array, "d pairs"], Bool[Array, " pairs"]]:
    """Run the pairs for `repeats` times `num_steps` steps. Return both states, and which pairs met.

    Pairs that have met stay together.
    """
    lanes, axes = pairs
    keys = jax.random.split(key, _NUM_PAIRS)

    @over_lanes(-1, -1, -1, -1, -1, axes)
    def step_pair(x, driven, met, normal, noise, lane):
        dw = lane.root_dt * normal
        x_next = lane.scheme.step(dynamics, x, lane.dt, dw)
        pair = drive(dynamics, lane, x, x_next, dw, driven, noise)
        # A pair that has met is one path from then on.
        met |= have_met(dynamics, lane.coupling, pair, noise)
        return x_next, jnp.where(met, x_next, pair.driven_next), met

    def draw(key, k):
        normal_key, uniform_key = jax.random.split(key)
        uniform = jax.random.uniform(uniform_key, (k,), x.dtype)
        # Reflection has no independent noise dU.
        return jax.random.normal(normal_key, (k, len(x)), x.dtype), PairNoise(None, uniform)

    def run_once(repeat, pairs):
        return noisy_scan(
            lambda pairs, inputs: (step_pair(*pairs, *inputs[0], lanes), None),
            pairs,
            fold_in_each(keys, repeat),
            draw,
            None,
            num_steps,
        )[0]

    return lax.fori_loop(0, repeats, run_once, (x, driven, jnp.zeros(_NUM_PAIRS, bool)))
