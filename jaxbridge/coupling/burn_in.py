"""How long until the reversed diffusion has forgotten where it started?

For models without a sampler of their stationary law. Two copies of the reversed diffusion,
coupled by reflection, start from b and from where another run from b has come in a time s. By
the coupling inequality the total variation distance between their laws after t is at most
P(τ > t), τ the time when they meet. s is doubled until all of 512 pairs meet within s, that
is, until what s can spread s can join again; pairs at distance √s do not all meet within s
before that, however small s is. Twice that s is the burn-in.

That all of 512 pairs have met says that P(τ > s) is about 1/512 or less, and no more. Where
meeting times have exponential tails, as for a drift that pulls back in proportion to the distance
or with a force that does not vanish far out, P(τ > 2s) is of the order of its square, and so
the distance left is about 512⁻² ≈ 4·10⁻⁶. Where the drift fades far out, as for heavy-tailed
stationary laws, they have polynomial tails, and to double s gains a factor only: 2·10⁻³ has been
measured. And a diffusion with wells that it leaves only after very many relaxation times can
deceive this, as any look at a finite run. In both cases give `Stationary(burn_in=...)` a longer
time, or choose a start law with a density.
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
from ..engine.doors import door
from ..engine.keys import folded, key_for
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
# Pairs that explode are left out, as they are from bridges; but not if so many do.
_MOST_EXPLODED = 0.5


def with_burn_in(
    key: Key[Array, ""],
    model: Diffusion,
    coupling: AbstractCoupling,
    end: Float[Array, "P d"],
    duration: Float[Array, " P"],
    num_steps: int,
) -> AbstractCoupling:
    """The coupling, whose start law knows its burn-in where it needs one: infinite where none was
    found, by which `run_is_cut` knows it."""
    if not needs_burn_in(coupling.start_law, model):
        return coupling
    time = _measure(key, model, coupling, _known(end), duration, num_steps)
    # Not by the constructor, which takes no infinite time from a user.
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
    """The coupling for weights, of which a start law with a density is paid for: that of smoothed
    draws where ν would call for a run for each trial."""
    known = with_burn_in(key, model, coupling, end, duration, num_steps)
    if not (needs_burn_in(coupling.start_law, model) and model.has_density):
        return known
    law = _draw_law(key, model, known, _known(end), duration, num_steps)
    return eqx.tree_at(lambda c: c.start_law, known, law)


def _known(end: Float[Array, "P d"]) -> Float[Array, "P d"]:
    """A known end in place of those of bridges that were not found, which are NaN."""
    usable = jnp.all(jnp.isfinite(end), axis=1, keepdims=True)
    return jnp.where(usable, end, end[jnp.argmax(usable)])


@compiled
def _draw_law(key, model, coupling, end, duration, num_steps) -> SmoothedDraws:
    mine = jnp.arange(NUM_DRAWS) * len(end) // NUM_DRAWS
    # If no burn-in was found it is infinite, and the longest run has to do.
    draw_key, fit_key = (key_for(f"smoothed draws{which}", key) for which in ("", ", fit"))
    keys = jax.random.split(draw_key, NUM_DRAWS)
    dt, law = duration[mine] / num_steps, coupling.start_law
    draws = draw_starts(law, model.prepared(), coupling.scheme, keys, end[mine].T, dt, num_steps)
    return smoothed_draws(fit_key, draws.T, end[0], model.prepared())


@door
def measure_burn_in(
    key: Key[Array, ""],
    model: Diffusion,
    end: Numbers,
    duration: Numbers,
    *,
    num_steps: int = 50,
    coupling: AbstractCoupling | None = None,
) -> Float[Array, ""]:
    """A time after which the reversed diffusion from `end` is stationary, for
    `Stationary(burn_in=...)`: twice one within which all of 512 coupled pairs meet, a multiple of
    `duration`.

    In total variation what is left of the start is about 1e-5 where the diffusion forgets it
    exponentially fast, as where the drift pulls back however far out. Where the drift fades far
    out, as for heavy-tailed stationary laws, it is forgotten by a power of the time, and 2e-3 may
    be left: give a multiple of this time. It sees wells only if they are left within the run:
    where a diffusion stays in one well for very many relaxation times of it, give a longer time
    yourself.

    **Arguments:** as in `sample_bridges`; only the scheme and the step matter.

    **Raises:** `ValueError` where the diffusion has not forgotten its start after 2¹⁷ steps, or
    most paths explode, or for arguments that do not fit. Inside `jit`, and where a result measures
    its burn-in itself, the time is then infinite, and what rests on it marked as `truncated`.

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
        raise ValueError(f"`end` must be finite; got {end}.")
    intervals, _, _ = as_intervals(end, end, duration)
    coupling = Coupling() if coupling is None else coupling
    check_instance("coupling", coupling, AbstractCoupling, "a `Coupling`")
    check_model(model, intervals, coupling.scheme)
    model.check_reversal()
    time = _measure(key, model, coupling, intervals.end, intervals.duration, num_steps)
    if not is_traced(time) and not np.isfinite(time):
        raise ValueError(
            "two copies of the reversed diffusion have not all met after 2¹⁷ steps, so it has "
            "not forgotten its start, or most paths left the finite numbers: give `Diffusion` a "
            "sampler of its stationary law, the coupling a start law with a density, or, if you "
            "know it, a `Stationary(burn_in=...)`. For a stiff drift, which calls for short steps "
            "of an explicit scheme, take `SemiImplicit()`: its steps may be longer."
        )
    return time


@compiled
def _measure(
    key: Key[Array, ""],
    model: Diffusion,
    coupling: AbstractCoupling,
    end: Float[Array, "P d"],
    duration: Float[Array, " P"],
    num_steps: int,
) -> Float[Array, ""]:
    """2s for the first s = 1, 2, 4, ... times `num_steps` steps within which all pairs meet."""
    key = key_for("burn-in", key)
    mine = jnp.arange(_NUM_PAIRS) * len(end) // _NUM_PAIRS
    end, dt = end[mine].T, duration[mine] / num_steps
    reflection = Coupling(-1.0, scheme=coupling.scheme, rotation=coupling.rotation)
    backward = model.prepared().backward(end[:, 0])
    dynamics = driven_through_root(reflection, backward, end[:, 0])
    pairs = in_lanes(reflection, dynamics, end[:, 0], jax.random.split(key, _NUM_PAIRS), dt)
    most = max(0, (MOST_STEPS // 2 // num_steps).bit_length() - 1)

    def attempt(doublings):
        """Whether all pairs met, and whether too many exploded."""
        ahead_key, pair_key = jax.random.split(jax.random.fold_in(key, doublings))
        keys, repeats = jax.random.split(ahead_key, _NUM_PAIRS), 2**doublings
        ahead = jnp.full(_NUM_PAIRS, repeats)
        driven = run_for(dynamics, coupling.scheme, keys, end, dt, num_steps, ahead)
        x, driven, met = _run_pairs(pair_key, dynamics, pairs, end, driven, num_steps, repeats)
        exploded = ~met & ~jnp.all(is_finite(x) & is_finite(driven), axis=0)
        too_many = jnp.mean(exploded) > _MOST_EXPLODED
        return jnp.all(met | exploded) & ~too_many, too_many

    def going_on(state):
        doublings, (all_met, too_many) = state
        return ~all_met & ~too_many & (doublings < most)

    def double(state):
        doublings, _ = state
        return doublings + 1, attempt(doublings + 1)

    init = (jnp.int32(0), attempt(jnp.int32(0)))
    doublings, (all_met, _) = lax.while_loop(going_on, double, init)
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
    """The pairs after `repeats` times `num_steps` steps, and which have met and stay together."""
    lanes, axes = pairs
    keys = jax.random.split(key, _NUM_PAIRS)

    @over_lanes(-1, -1, -1, -1, -1, axes)
    def step_pair(x, driven, met, normal, noise, lane):
        dw = lane.root_dt * normal
        x_next = lane.scheme.step(dynamics, x, lane.dt, dw)
        pair = drive(dynamics, lane, x, x_next, dw, driven, noise)
        met |= have_met(dynamics, lane.coupling, pair, noise)
        return x_next, jnp.where(met, x_next, pair.driven_next), met

    def draw(key, k):
        normal_key, uniform_key = jax.random.split(key)
        uniform = jax.random.uniform(uniform_key, (k,), x.dtype)
        return jax.random.normal(normal_key, (k, len(x)), x.dtype), PairNoise(None, uniform)

    def once(repeat, pairs):
        return noisy_scan(
            lambda pairs, inputs: (step_pair(*pairs, *inputs[0], lanes), None),
            pairs,
            folded(keys, repeat),
            draw,
            None,
            num_steps,
        )[0]

    return lax.fori_loop(0, repeats, once, (x, driven, jnp.zeros(_NUM_PAIRS, bool)))
