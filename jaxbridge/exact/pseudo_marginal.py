"""Pseudo-marginal Metropolis–Hastings on bridges (section 2.3 of the paper).

Each step proposes a weighted path, and accepts it with the ratio of the weights. The weights are
random but unbiased, and a state keeps its weight. Proposals do not depend on the state of the
chain. So all of them run first, side by side, and the chain itself is a scan over numbers.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.checks import Numbers, check_key, nondifferentiable
from ..engine.compiled import compiled_for, compiled_sooner
from ..engine.entry import public_entry
from ..engine.keys import split_each
from ..engine.pareto import pareto_k
from ..models.bridge_problem import BridgeProblem
from ..models.diffusion import Diffusion
from ..proposals import AbstractProposal, Budget, ProposalLike, WeightedPaths, as_proposal
from .kernels import Chain, Kernel, acceptance_rate, chain_keys, check_position, one_interval


class PseudoMarginalState(NamedTuple):
    """State of the chain.

    - `position`: the path, shape (N+1, d).
    - `log_weight`: its log weight; -inf for a state without a path.
    - `truncated`: whether that weight was truncated.
    """

    position: Float[Array, "points d"]
    log_weight: Float[Array, ""]
    truncated: Bool[Array, ""]


class PseudoMarginalInfo(NamedTuple):
    """Report of one step of the chain.

    - `acceptance_rate`: the acceptance probability of the proposal.
    - `is_accepted`: whether the proposal was accepted.
    - `log_weight`: log weight of the proposal, -inf if none was found.
    - `num_simulated`: number of simulated paths.
    """

    acceptance_rate: Float[Array, ""]
    is_accepted: Bool[Array, ""]
    log_weight: Float[Array, ""]
    num_simulated: Int[Array, ""]


@public_entry
def pseudo_marginal(
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_steps: int = 50,
    proposal: ProposalLike = None,
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
) -> Kernel:
    """Return the pseudo-marginal Metropolis–Hastings kernel on (start, end, duration)-bridges.

    `init(position, rng_key)` takes a path of shape (N+1, d). It samples a weight of this path from
    its stationary law in the chain, so the kernel can be a block of a Gibbs sampler. With `None` it
    proposes a first path. `step(rng_key, state)` returns a `PseudoMarginalState` and a
    `PseudoMarginalInfo`.

    **Arguments:** as in `sample_exact_bridges`. A kernel makes no pilot run and measures no
    burn-in: pass a result of `choose_proposal` instead of "auto", and for a model without sampler
    `Stationary(burn_in=...)` or a start law with a density. For a state-dependent σ guided
    proposals have Euler steps.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    kernel = jb.pseudo_marginal(model, start, end, 1.0, proposal=jb.Coupling(0.5))
    state, info = kernel.step(jax.random.key(1), kernel.init(None, jax.random.key(0)))
    ```
    """
    problem = one_interval(model, start, end, duration, num_steps)
    budget = Budget(num_counts, max_proposals, max_trials)
    proposal = as_proposal(proposal, model, problem.like, budget)
    proposal.check(model, problem.intervals)
    proposal.check_prepared(model)
    setting = (model, proposal, problem.intervals, num_steps)

    @public_entry
    def init(position, rng_key):
        check_key(rng_key)
        paths = check_position(position, problem)
        if paths is None:
            return _propose_state(rng_key, *setting)[0]
        return _reweigh_state(rng_key, paths, *setting)

    @public_entry
    def step(rng_key, state):
        check_key(rng_key)
        return _pseudo_marginal_step(rng_key, state, *setting)

    return Kernel(init, step)


@compiled_sooner
def _propose_state(rng_key, model, proposal, intervals, num_steps):
    model, proposal, intervals = nondifferentiable((model.prepared(), proposal, intervals))
    weighted_paths = proposal.draw(rng_key[None, None], model, intervals, num_steps, None, False)
    return _first_state(weighted_paths), weighted_paths.num_simulated[0, 0]


@compiled_sooner
def _reweigh_state(rng_key, paths, model, proposal, intervals, num_steps):
    arguments = (model.prepared(), proposal, intervals, paths)
    model, proposal, intervals, paths = nondifferentiable(arguments)
    return _first_state(proposal.reweigh(rng_key[None], model, intervals, paths))


def _first_state(weighted_paths: WeightedPaths) -> PseudoMarginalState:
    """Return the first path of the first interval as a state."""
    return PseudoMarginalState(
        weighted_paths.paths[0, 0], weighted_paths.log_weights[0, 0], weighted_paths.truncated[0, 0]
    )


@compiled_sooner
def _pseudo_marginal_step(rng_key, state, *setting):
    # The same split as in `run_pseudo_marginal`, so both give the same chain.
    draw_key, accept_key = jax.random.split(rng_key)
    candidate, num_simulated = _propose_state(draw_key, *setting)
    uniform = jax.random.uniform(accept_key, dtype=candidate.position.dtype)
    rate = acceptance_rate(state.log_weight, candidate.log_weight)
    accepted = uniform < rate
    new_state = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), candidate, state)
    return new_state, PseudoMarginalInfo(rate, accepted, candidate.log_weight, num_simulated)


@compiled_for(lambda key, model, proposal, problem, num, *_: problem.num_path_steps(num))
def run_pseudo_marginal(
    key: Key[Array, ""],
    model: Diffusion,
    proposal: AbstractProposal,
    problem: BridgeProblem,
    num_bridges: int,
    first: Float[Array, "I points d"] | None,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> Chain:
    """Run the chain of each interval, from its path `first` if that is not `None`."""
    arguments = (model.prepared(), proposal, problem, first)
    model, proposal, problem, first = nondifferentiable(arguments)
    intervals, num_steps = problem.intervals, problem.num_steps
    proposal = proposal.prepared(key, model, intervals, num_steps)
    step_keys, init_keys = chain_keys(key, problem, num_bridges)
    draw_keys, accept_keys = split_each(step_keys.reshape(-1), 2)
    draw_keys = draw_keys.reshape(step_keys.shape)
    # Row 0 of each interval is its first state. Row i is the candidate of step i.
    if first is None:
        draw_keys = jnp.concatenate([init_keys[:, None], draw_keys], axis=1)
    candidates = proposal.draw(
        draw_keys, model, intervals, num_steps, problem.stored, False, progress_meter=progress_meter
    )
    if first is not None:
        first_state = proposal.reweigh(init_keys, model, intervals, first)
        # `reweigh` returns whole paths, candidates only have the stored times.
        first_state = first_state._replace(paths=problem.kept(first_state.paths))
        candidates = jax.tree.map(
            lambda *rows: jnp.concatenate(rows, axis=1), first_state, candidates
        )
    uniform = jax.vmap(lambda k: jax.random.uniform(k, dtype=intervals.start.dtype))(accept_keys)
    # The chain selects rows; paths are gathered once, after the scan.
    row, accepted = accept_reject(candidates.log_weights, uniform.reshape(step_keys.shape))
    interval = jnp.arange(problem.num_intervals)[:, None]
    states = jax.tree.map(lambda leaf: leaf[interval, row], candidates)
    log_change, states = problem.result((states.log_change, states))
    return Chain(
        times=problem.times(proposal.fractions(num_steps)),
        paths=states.paths,
        accepted=problem.result(accepted),
        log_weights=states.log_weights,
        met=states.found,
        truncated=states.truncated,
        num_simulated=problem.total(candidates.num_simulated),
        num_nonfinite=problem.total(candidates.num_nonfinite),
        num_truncated=problem.total(candidates.truncated),
        proposal=proposal,
        pareto_k=problem.result(pareto_k(candidates.log_weights)),
        log_halving=log_change,
        coarse_paths=states.coarse_paths,
        step_share=problem.result(proposal.share_in_regime(model, intervals, num_steps)),
        num_steps=num_steps,
    )


def accept_reject(
    log_weights: Float[Array, "I weights"], uniform: Float[Array, "I n"]
) -> tuple[Int[Array, "I n"], Bool[Array, "I n"]]:
    """Run the chains on the weights alone, for n steps.

    Row 0 of the weights is the first state of each chain, and row i the candidate of step i. Return
    the row of the state after each step, and whether the step accepted its candidate; both shape
    (I, n).
    """

    def step(state, inputs):
        row, log_weight = state
        i, candidate, uniform = inputs
        # A candidate keeps its random weight for as long as it is the state: this makes the chain
        # exact.
        accepted = uniform < acceptance_rate(log_weight, candidate)
        state = jnp.where(accepted, i, row), jnp.where(accepted, candidate, log_weight)
        return state, (state[0], accepted)

    num_intervals, n = uniform.shape
    init = (jnp.zeros(num_intervals, jnp.int32), log_weights[:, 0])
    candidates = jnp.arange(1, n + 1, dtype=jnp.int32), log_weights[:, 1:].T
    _, (row, accepted) = lax.scan(step, init, (*candidates, uniform.T))
    return row.T, accepted.T
