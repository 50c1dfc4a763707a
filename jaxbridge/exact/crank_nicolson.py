"""Preconditioned Crank–Nicolson moves on bridges: a chain that moves the noise a little.

A proposal that is pulled to the end point (`guided`) maps noise ξ ~ N(0, I) to a path, and the
bridge is that law weighted with w(ξ). The move

    ξ' = √(1-β²) ξ + β η,    η ~ N(0, I),

leaves N(0, I) invariant, so ξ' is accepted with probability min(1, w(ξ')/w(ξ)): for long or
hard bridges, where paths that are proposed from scratch are hardly ever accepted. β = 1 is that
again. The number of steps does not matter for the acceptance (Beskos, Roberts, Stuart & Voss
2008; Cotter, Roberts, Stuart & White 2013).
"""

from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from ..engine.checks import (
    Numbers,
    as_floating,
    check_key,
    is_traced,
    nondifferentiable,
)
from ..engine.compiled import compiled_for, compiled_sooner
from ..engine.doors import door
from ..engine.keys import split_each
from ..engine.progress import metered_scan
from ..models.bridge_problem import BridgeProblem, Intervals
from ..models.diffusion import Diffusion
from ..proposals import AbstractGuidedProposal, Guided, as_guided, as_proposal, noise_of, path_of
from .kernels import Chain, Kernel, acceptance_rate, chain_keys, check_position, one_interval


class CrankNicolsonState(NamedTuple):
    """`position`, the path, shape (N+1, d); the `noise` it is made from, (N-1, d); its
    `log_weight`, -inf for a path that left the finite numbers; and its `log_halving`, the log of
    the factor by which half as many steps would change that (`halving`)."""

    position: Float[Array, "*I points d"]
    noise: Float[Array, "*I steps d"]
    log_weight: Float[Array, "*I"]
    log_halving: Float[Array, "*I"]


class CrankNicolsonInfo(NamedTuple):
    """Of one step: the `acceptance_rate`, whether the move was accepted, and the log weight of
    the path that was proposed, -inf where it left the finite numbers."""

    acceptance_rate: Float[Array, "*I"]
    is_accepted: Bool[Array, "*I"]
    log_weight: Float[Array, "*I"]


@door
def crank_nicolson(
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_steps: int = 50,
    proposal: Any = None,
    step_size: Numbers | None = None,
) -> Kernel:
    """The preconditioned Crank–Nicolson kernel on (start, end, duration)-bridges.

    `init(position, rng_key)` takes a path of shape (N+1, d), and so may enter a chain, as a block
    of a Gibbs sampler; or `None`, for a first path by proposal. `step(rng_key, state)` gives a
    `CrankNicolsonState` and a `CrankNicolsonInfo`.

    **Arguments:** as in `sample_exact_bridges`, but `proposal` is by default `Guided()`;
    `step_size` is β in (0, 1], by default 0.5: aim at accepting a quarter to a half.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    **Example:**

    ```python
    kernel = jb.crank_nicolson(model, start, end, 10.0, num_steps=500, step_size=0.3)
    state, info = kernel.step(jax.random.key(1), kernel.init(None, jax.random.key(0)))
    ```
    """
    problem = one_interval(model, start, end, duration, num_steps)
    proposal = Guided() if proposal is None else proposal
    proposal = as_guided(as_proposal(proposal, model, problem.like))
    proposal.check(model, problem.intervals)
    beta = check_step_size(step_size)
    setting = (model, proposal, problem.intervals)

    @door
    def init(position, rng_key):
        check_key(rng_key)
        paths = check_position(position, problem)
        state = _init(rng_key[None], paths, *setting, num_steps)
        return jax.tree.map(lambda leaf: leaf[0], state)

    @door
    def step(rng_key, state):
        check_key(rng_key)
        return _step(rng_key, state, *setting, beta)

    return Kernel(init, step)


@compiled_sooner
def _init(
    keys: Key[Array, " I"],
    paths: Float[Array, "I points d"] | None,
    model: Diffusion,
    proposal: AbstractGuidedProposal,
    intervals: Intervals,
    num_steps: int,
) -> CrankNicolsonState:
    model, proposal, intervals = nondifferentiable((model.prepared(), proposal, intervals))
    dynamics = model.forward(intervals.start[0])
    if paths is None:
        noise = _normal(keys, num_steps, intervals)
        paths, log_weights, log_halving = path_of(proposal, dynamics, intervals, noise)
    else:
        noise, log_weights, log_halving = noise_of(proposal, dynamics, intervals, paths)
        noise = jnp.where(jnp.isfinite(noise), noise, 0)  # a path outside the state space is left
    return CrankNicolsonState(paths, noise, _finite(log_weights), log_halving)


@compiled_sooner
def _step(rng_key, state, model, proposal, intervals, beta):
    model, proposal, intervals = nondifferentiable((model.prepared(), proposal, intervals))
    dynamics = model.forward(intervals.start[0])
    state = jax.tree.map(lambda leaf: leaf[None], state)
    moved = _move(rng_key[None], state, proposal, dynamics, intervals, beta)
    return jax.tree.map(lambda leaf: leaf[0], moved)


def _move(
    keys: Key[Array, " I"],
    state: CrankNicolsonState,
    proposal: AbstractGuidedProposal,
    dynamics,
    intervals: Intervals,
    beta: Float[Array, ""],
) -> tuple[CrankNicolsonState, CrankNicolsonInfo]:
    """One move of each of I chains."""
    noise_keys, accept_keys = split_each(keys, 2)
    dtype = state.noise.dtype
    beta = beta.astype(dtype)
    fresh = _normal(noise_keys, state.noise.shape[1] + 1, intervals)
    noise = jnp.sqrt((1 - beta) * (1 + beta)) * state.noise + beta * fresh
    paths, log_weights, log_halving = path_of(proposal, dynamics, intervals, noise)
    candidate = CrankNicolsonState(paths, noise, _finite(log_weights), log_halving)
    rate = acceptance_rate(state.log_weight, candidate.log_weight)
    uniform = jax.vmap(lambda key: jax.random.uniform(key, dtype=dtype))(accept_keys)
    accepted = uniform < rate

    def choose(new, old):
        return jnp.where(accepted.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    info = CrankNicolsonInfo(rate, accepted, candidate.log_weight)
    return jax.tree.map(choose, candidate, state), info


@compiled_for(lambda key, model, proposal, problem, num, *_, beta: problem.num_path_steps(num))
def run_crank_nicolson(
    key: Key[Array, ""],
    model: Diffusion,
    proposal: AbstractGuidedProposal,
    problem: BridgeProblem,
    num_bridges: int,
    position: Float[Array, "I points d"] | None,
    progress_meter: diffrax.AbstractProgressMeter | None,
    beta: Float[Array, ""],
) -> Chain:
    """The chain of each interval, side by side, from its `position` if there is one."""
    fixed = (model.prepared(), proposal, problem, position)
    model, proposal, problem, position = nondifferentiable(fixed)
    intervals, num_steps = problem.intervals, problem.num_steps
    dynamics = model.forward(problem.like)
    step_keys, init_keys = chain_keys(key, problem, num_bridges)
    first = _init(init_keys, position, model, proposal, intervals, num_steps)

    def step(state, keys):
        state, info = _move(keys, state, proposal, dynamics, intervals, beta)
        kept = state._replace(position=problem.kept(state.position), noise=None)
        return state, (kept, info)

    _, made = metered_scan(step, first, step_keys.T, progress_meter)
    states, info = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), made)
    met = states.log_weight > -jnp.inf
    tried = jnp.concatenate([first.log_weight[:, None], info.log_weight], axis=1)
    paths = jnp.where(met[..., None, None], states.position, jnp.nan)
    return Chain(
        times=problem.times(proposal.fractions(num_steps)),
        paths=problem.result(paths),
        accepted=problem.result(info.is_accepted),
        log_weights=problem.result(states.log_weight),
        met=problem.result(met),
        truncated=problem.result(jnp.zeros_like(met)),
        num_simulated=problem.total(jnp.ones_like(tried)),
        num_nonfinite=problem.total(tried == -jnp.inf),
        num_truncated=problem.total(jnp.zeros_like(tried)),
        proposal=proposal,
        pareto_k=None,
        log_halving=problem.result(states.log_halving),
        step_share=problem.result(proposal.share_in_regime(model, intervals, num_steps)),
        num_steps=num_steps,
    )


def _normal(
    keys: Key[Array, " I"], num_steps: int, intervals: Intervals
) -> Float[Array, "I steps d"]:
    _, d = intervals.start.shape
    dtype = intervals.start.dtype
    return jax.vmap(lambda key: jax.random.normal(key, (num_steps - 1, d), dtype))(keys)


def _finite(log_weights: Float[Array, " I"]) -> Float[Array, " I"]:
    return jnp.where(jnp.isfinite(log_weights), log_weights, -jnp.inf)


def check_step_size(step_size: Numbers | None) -> Float[Array, ""]:
    """β, in (0, 1]."""
    beta = as_floating("step_size", 0.5 if step_size is None else step_size)
    if beta.shape != () or not (is_traced(beta) or 0 < np.asarray(beta) <= 1):
        raise ValueError(f"`step_size` must be a number in (0, 1]; got {step_size}.")
    return beta
