"""Gibbs sampling of parameters and paths of a record that was seen with noise or in part.

The state is (θ, path). In turn the path moves given θ, in blocks (`records.path_blocks`); then it
is read as the noise ξ that makes it, guided through the record at θ, and θ moves given ξ: by a
normal random walk from π(θ) w(θ, ξ), which takes the path along. Given a whole path its σ would be
known, given ξ it is not (Roberts & Stramer 2001; van der Meulen & Schauer 2017): so parameters of
σ, of the noise and of the initial law are as good as those of the drift, however small the steps.
"""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.averages import proper
from ..engine.checks import nondifferentiable
from ..engine.progress import metered_scan
from ..exact import acceptance_rate
from ..records import (
    Paths,
    RecordProblem,
    blocks_of_both_cuts,
    cuts,
    guided,
    has_segments,
    linearised,
    noise_and_log_weight,
    path_and_log_weight,
    sweep,
    tuned,
)
from .parameter_walk import TARGET, adapted
from .parameters import Parameters
from .posterior import AbstractPosterior, drawn, first_chain, first_states, over_chains
from .priors import GivenDensity, NormalDensity

# Intervals between observations that move at once.
_BLOCK_LENGTH = 10


class RecordState(NamedTuple):
    """Where a chain of `gibbs` is, given an `observation`, with chains in a leading axis if there
    are several.

    - `theta`: θ, shape (p,).
    - `start`, `points`: its path, x_0 and the points at the ends of steps.
    - `root`: S of the covariance S Sᵀ of moves of θ; `log_scales`: log β of those of the blocks.
    - `num_done`: iterations so far.
    """

    theta: Float[Array, "*chains p"]
    start: Float[Array, "*chains d 1"]
    points: Float[Array, "*chains K N d 1"]
    root: Float[Array, "*chains p p"]
    log_scales: Float[Array, "*chains 2 B"]
    num_done: Int[Array, "*chains"]


class RecordPosterior(AbstractPosterior):
    """What `gibbs` returns for a record that was seen with noise or in part: draws of the unknown
    parameters. Arrays have a leading axis of chains if there are several.

    - `params`: all parameters of the model, each with leading axes (*chains, n).
    - `theta`: the unknown ones as vectors, shape (*chains, n, p).
    - `names`: those of θ's entries.
    - `parameters_moved`: whether θ moved, shape (*chains, n).
    - `blocks_moved`: the share of the blocks of the path that moved, shape (*chains, n).
    - `stuck`: whether there is a block that never did, shape (*chains): then the draws are not
        those of the posterior, whatever their error.
    - `log_step_error`: NaN, for it is not worked out.
    - `state`: where it ended; pass it as `init`, with `num_warmup=0`, to go on.
    """

    params: PyTree
    theta: Float[Array, "*chains n p"]
    names: tuple[str, ...] = eqx.field(static=True)
    parameters_moved: Bool[Array, "*chains n"]
    blocks_moved: Float[Array, "*chains n"]
    stuck: Bool[Array, "*chains"]
    log_step_error: Float[Array, "*chains n"]
    state: RecordState


class RecordSampler(eqx.Module):
    """What does not change from iteration to iteration, and the steps of one chain."""

    parameters: Parameters
    problem: RecordProblem
    log_prior: NormalDensity | GivenDensity
    points: Float[Array, "points d"]

    def start(
        self, key: Key[Array, ""], start: tuple[Float[Array, " p"], Float[Array, "p p"]]
    ) -> RecordState:
        theta, root = start
        model = self.parameters.bind(theta)
        noise = jax.random.normal(key, self.points.shape, self.points.dtype)
        guide = guided(self.problem, model, self.points)
        path, log_weight = path_and_log_weight(self.problem, model, guide, noise)
        path = jnp.where(jnp.isfinite(log_weight), path, self.points)
        (K, N), d = self.problem.record.dt.shape, self.problem.dim
        num_blocks = cuts(K, _BLOCK_LENGTH).shape[-1]
        scales = jnp.zeros((2, num_blocks), theta.dtype)
        points = path[1:].reshape(K, N, d, 1)
        return RecordState(theta, path[0][:, None], points, root, scales, jnp.int32(0))

    def step(
        self, key: Key[Array, ""], state: RecordState, learning: Bool[Array, ""]
    ) -> tuple[RecordState, tuple[Bool[Array, ""], Bool[Array, "2 B 1"]]]:
        """The path given θ, then θ given ξ; both learn the size of their moves. Whether θ moved,
        and which blocks."""
        path_key, noise_key, walk_key, accept_key = jax.random.split(key, 4)
        problem, model = self.problem, self.parameters.bind(state.theta)
        (K, N), d = problem.record.dt.shape, problem.dim
        guide = guided(problem, model, self.points)
        both = blocks_of_both_cuts(problem, self.points, guide, _BLOCK_LENGTH)
        paths = Paths(state.start, state.points)
        paths, taken = sweep(path_key, problem, model, both, state.log_scales, paths)
        path = jnp.concatenate([paths.start.T, paths.points.reshape(K * N, d)])

        noise, log_weight = noise_and_log_weight(noise_key, problem, model, guide, path)
        step = jax.random.normal(walk_key, state.theta.shape, state.theta.dtype)
        proposed = state.theta + state.root @ step
        inside = self.parameters.allowed(proposed)
        proposed = jnp.where(inside, proposed, state.theta)
        other = self.parameters.bind(proposed)
        new_guide = guided(problem, other, self.points)
        new_path, new_weight = path_and_log_weight(problem, other, new_guide, noise)
        new = jnp.where(inside, new_weight + self.log_prior(proposed), -jnp.inf)
        old = proper(log_weight) + self.log_prior(state.theta)
        rate = acceptance_rate(old, proper(new))
        accepted = jax.random.uniform(accept_key, dtype=rate.dtype) < rate

        number = (state.num_done + 1).astype(rate.dtype)
        gain = jnp.where(learning, jnp.minimum(1.0, len(proposed) * number ** (-2 / 3)), 0)
        root = adapted(state.root, step, gain * (rate - TARGET))
        root = jnp.where((gain > 0) & jnp.all(jnp.isfinite(root)), root, state.root)
        log_scales = tuned(state.log_scales, taken, number)
        path = jnp.where(accepted, new_path, path)
        moved = RecordState(
            jnp.where(accepted, proposed, state.theta),
            path[0][:, None],
            path[1:].reshape(K, N, d, 1),
            root,
            jnp.where(learning, log_scales, state.log_scales),
            state.num_done + 1,
        )
        return moved, (accepted, taken)


def sample_record(
    key: Key[Array, ""],
    parameters: Parameters,
    problem: RecordProblem,
    log_prior: NormalDensity | GivenDensity,
    start: tuple[Float[Array, "*chains p"], Float[Array, "p p"]] | RecordState,
    size: tuple[int, int, int],
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> RecordPosterior:
    """After so many iterations of the warm-up, so many draws, with so many iterations each."""
    theta = start.theta if isinstance(start, RecordState) else start[0]
    points = linearised(problem, parameters.bind(first_chain(theta))).points
    sampler = RecordSampler(parameters, problem, log_prior, points)
    if isinstance(start, RecordState):
        return _run(key, sampler, start, size, progress_meter)
    root = jnp.broadcast_to(start[1], (*theta.shape[:-1], *start[1].shape))
    state = first_states(sampler.start, key, (theta, root))
    return _run(key, sampler, state, size, progress_meter)


@eqx.filter_jit
def _run(
    key: Key[Array, ""],
    sampler: RecordSampler,
    state: RecordState,
    size: tuple[int, int, int],
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> RecordPosterior:
    sampler, state = nondifferentiable((sampler, state))
    num_warmup, num_iterations, thin = size
    real = has_segments(sampler.problem.num_segments, _BLOCK_LENGTH)[..., None]
    begun = state.num_done.reshape(-1)[0]

    def iterate(state, i):
        step = lambda key, state: sampler.step(key, state, i < num_warmup)
        # Number 0 made the first path.
        return over_chains(step, jax.random.fold_in(key, begun + i + 1), state)

    def draw(state, i):
        state, (moved, taken) = lax.scan(iterate, state, i * thin + jnp.arange(thin))
        taken = jnp.mean(taken.astype(state.theta.dtype), axis=0)
        share = jnp.mean(taken, axis=(-3, -2, -1), where=real)
        return state, (state.theta, jnp.any(moved, axis=0), share, taken > 0)

    # The warm-up counts in draws, too, so that there is one loop.
    skipped = -(-num_warmup // thin)
    state, made = metered_scan(draw, state, jnp.arange(skipped + num_iterations), progress_meter)
    draws = jax.tree.map(lambda leaf: leaf[skipped:], made)
    fields, (moved, share, taken) = drawn(sampler.parameters, *draws)
    ever = jnp.any(taken, axis=-4)  # of all draws
    unknown = jnp.full(moved.shape, jnp.nan, share.dtype)
    return RecordPosterior(
        **fields,
        parameters_moved=moved,
        blocks_moved=share,
        stuck=jnp.any(real & ~ever, axis=(-3, -2, -1)),
        log_step_error=unknown,
        state=state,
    )
