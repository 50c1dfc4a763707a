"""Preconditioned Crank–Nicolson moves on bridges: a chain that changes the noise a little.

A guided proposal (`guided`) maps noise ξ ~ N(0, I) to a path. The bridge is the law of that path,
weighted by w(ξ). The move

    ξ' = √(1-β²) ξ + β η,    η ~ N(0, I),

leaves N(0, I) invariant. So the chain accepts ξ' with probability min(1, w(ξ')/w(ξ)). It suits long
or hard bridges, where independent proposals are rarely accepted. β = 1 gives independent proposals.
The acceptance rate does not fall to zero as the number of steps grows (Beskos, Roberts, Stuart &
Voss 2008; Cotter, Roberts, Stuart & White 2013).
"""

from typing import NamedTuple

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
from ..engine.entry import public_entry
from ..engine.keys import split_each
from ..engine.progress import metered_scan
from ..models.bridge_problem import BridgeProblem, Intervals
from ..models.diffusion import Diffusion
from ..proposals import (
    AbstractGuidedProposal,
    Guided,
    ProposalLike,
    as_guided,
    as_proposal,
    noise_of,
    num_noises,
    path_of,
)
from .kernels import Chain, Kernel, acceptance_rate, chain_keys, check_position, one_interval


class CrankNicolsonState(NamedTuple):
    """State of the chain.

    - `position`: the path, shape (N+1, d).
    - `noise`: the noise of the path, shape (N-1, d); a few more numbers for steps that are not
        normal.
    - `log_weight`: its log weight, -inf for a path that became non-finite.
    - `log_halving`: log of the factor by which half as many steps would change the weight
        (`halving`).
    - `coarse_path`: the path that the same noise gives with half as many steps, shape (N+1, d);
        `None` if the path itself is used for this, as for normal steps.
    """

    position: Float[Array, "*I points d"]
    noise: Float[Array, "*I steps d"]
    log_weight: Float[Array, "*I"]
    log_halving: Float[Array, "*I"]
    coarse_path: Float[Array, "*I points d"] | None


class CrankNicolsonInfo(NamedTuple):
    """Report of one step of the chain.

    - `acceptance_rate`: the acceptance probability of the move.
    - `is_accepted`: whether the move was accepted.
    - `log_weight`: log weight of the proposed path, -inf if it became non-finite.
    """

    acceptance_rate: Float[Array, "*I"]
    is_accepted: Bool[Array, "*I"]
    log_weight: Float[Array, "*I"]


@public_entry
def crank_nicolson(
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_steps: int = 50,
    proposal: ProposalLike = None,
    step_size: Numbers | None = None,
) -> Kernel:
    """Return the preconditioned Crank–Nicolson kernel on (start, end, duration)-bridges.

    `init(position, rng_key)` takes a path of shape (N+1, d), so the kernel can be a block of a
    Gibbs sampler. With `None` it proposes a first path. `step(rng_key, state)` returns a
    `CrankNicolsonState` and a `CrankNicolsonInfo`.

    **Arguments:** as in `sample_exact_bridges`, with these differences:

    - `proposal`: a guided proposal, by default `Guided()`. For a state-dependent σ it has Euler
        steps.
    - `step_size`: β in (0, 1], by default 0.5. A smaller β gives smaller moves, which are accepted
        more often. Choose it for an acceptance rate of 25 to 50 %.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

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

    @public_entry
    def init(position, rng_key):
        check_key(rng_key)
        paths = check_position(position, problem)
        state = _init(rng_key[None], paths, *setting, num_steps)
        return jax.tree.map(lambda leaf: leaf[0], state)

    @public_entry
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
        noise = _sample_noise(keys, num_noises(proposal, num_steps), intervals)
        return _state_of(proposal, dynamics, intervals, noise, num_steps)
    noise, log_weights, log_halving = noise_of(proposal, dynamics, intervals, paths)
    # A path outside the state space has no noise. Zeros let the chain leave it.
    noise = jnp.where(jnp.isfinite(noise), noise, 0)
    return CrankNicolsonState(paths, noise, _non_finite_to_neg_inf(log_weights), log_halving, None)


def _state_of(
    proposal: AbstractGuidedProposal,
    dynamics,
    intervals: Intervals,
    noise: Float[Array, "I steps d"],
    num_steps: int,
) -> CrankNicolsonState:
    """Return the states whose paths have this noise."""
    paths, log_weights, log_change, coarse_paths = path_of(
        proposal, dynamics, intervals, noise, num_steps
    )
    log_weights = _non_finite_to_neg_inf(log_weights)
    return CrankNicolsonState(paths, noise, log_weights, log_change, coarse_paths)


@compiled_sooner
def _step(rng_key, state, model, proposal, intervals, beta):
    model, proposal, intervals = nondifferentiable((model.prepared(), proposal, intervals))
    dynamics = model.forward(intervals.start[0])
    state = jax.tree.map(lambda leaf: leaf[None], state)
    state_and_info = _move(rng_key[None], state, proposal, dynamics, intervals, beta)
    return jax.tree.map(lambda leaf: leaf[0], state_and_info)


def _move(
    keys: Key[Array, " I"],
    state: CrankNicolsonState,
    proposal: AbstractGuidedProposal,
    dynamics,
    intervals: Intervals,
    beta: Float[Array, ""],
) -> tuple[CrankNicolsonState, CrankNicolsonInfo]:
    """Make one move of each of I chains."""
    noise_keys, accept_keys = split_each(keys, 2)
    dtype = state.noise.dtype
    beta = beta.astype(dtype)
    fresh = _sample_noise(noise_keys, state.noise.shape[1], intervals)
    # 1 - β² as a product keeps its digits near β = 1.
    noise = jnp.sqrt((1 - beta) * (1 + beta)) * state.noise + beta * fresh
    num_steps = state.position.shape[1] - 1
    candidate = _state_of(proposal, dynamics, intervals, noise, num_steps)
    # The move leaves N(0, I) invariant, so the rate contains the weights only.
    rate = acceptance_rate(state.log_weight, candidate.log_weight)
    uniform = jax.vmap(lambda key: jax.random.uniform(key, dtype=dtype))(accept_keys)
    accepted = uniform < rate

    def select(new, old):
        # Add axes so that one decision for each chain broadcasts over its arrays.
        return jnp.where(accepted.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    info = CrankNicolsonInfo(rate, accepted, candidate.log_weight)
    return jax.tree.map(select, candidate, state), info


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
    """Run the chains of all intervals side by side, from `position` if it is not `None`."""
    arguments = (model.prepared(), proposal, problem, position)
    model, proposal, problem, position = nondifferentiable(arguments)
    intervals, num_steps = problem.intervals, problem.num_steps
    dynamics = model.forward(problem.like)
    step_keys, init_keys = chain_keys(key, problem, num_bridges)
    first = _init(init_keys, position, model, proposal, intervals, num_steps)

    def step(state, keys):
        state, info = _move(keys, state, proposal, dynamics, intervals, beta)
        # The noise is as large as the path and is not part of the result.
        kept = lambda path: None if path is None else problem.kept(path)
        stored = state._replace(
            position=kept(state.position), noise=None, coarse_path=kept(state.coarse_path)
        )
        return state, (stored, info)

    _, outputs = metered_scan(step, first, step_keys.T, progress_meter)
    # The scan puts steps first; results have intervals first.
    states, info = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), outputs)
    met = states.log_weight > -jnp.inf
    # The first path counts as a simulated path too.
    log_weights_of_proposals = jnp.concatenate([first.log_weight[:, None], info.log_weight], axis=1)
    # A state of weight zero, for instance a first path outside the state space, is missing.
    paths = jnp.where(met[..., None, None], states.position, jnp.nan)
    return Chain(
        times=problem.times(proposal.fractions(num_steps)),
        paths=problem.result(paths),
        accepted=problem.result(info.is_accepted),
        log_weights=problem.result(states.log_weight),
        met=problem.result(met),
        truncated=problem.result(jnp.zeros_like(met)),
        num_simulated=problem.total(jnp.ones_like(log_weights_of_proposals)),
        num_nonfinite=problem.total(log_weights_of_proposals == -jnp.inf),
        num_truncated=problem.total(jnp.zeros_like(log_weights_of_proposals)),
        proposal=proposal,
        pareto_k=None,
        log_halving=problem.result(states.log_halving),
        coarse_paths=problem.result(states.coarse_path),
        step_share=problem.result(proposal.share_in_regime(model, intervals, num_steps)),
        num_steps=num_steps,
    )


def _sample_noise(
    keys: Key[Array, " I"], num: int, intervals: Intervals
) -> Float[Array, "I steps d"]:
    _, d = intervals.start.shape
    dtype = intervals.start.dtype
    return jax.vmap(lambda key: jax.random.normal(key, (num, d), dtype))(keys)


def _non_finite_to_neg_inf(log_weights: Float[Array, " I"]) -> Float[Array, " I"]:
    return jnp.where(jnp.isfinite(log_weights), log_weights, -jnp.inf)


def check_step_size(step_size: Numbers | None) -> Float[Array, ""]:
    """Check β and return it, by default 0.5."""
    beta = as_floating("step_size", 0.5 if step_size is None else step_size)
    if beta.shape != () or not (is_traced(beta) or 0 < np.asarray(beta) <= 1):
        raise ValueError(
            f"`step_size` must be a number in (0, 1]; got {step_size}. Omit it for 0.5."
        )
    return beta
