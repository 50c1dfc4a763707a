"""Gibbs sampling of parameters and paths of records that were seen with noise or in part.

The state is (θ, path). In turn the path moves given θ, in blocks (`records.path_blocks`); then it
is read as the noise ξ that makes it, guided through the record at θ, and θ moves given ξ: by a
normal random walk from π(θ) w(θ, ξ), which takes the path along. Given a whole path its σ would be
known, given ξ it is not (Roberts & Stramer 2001; van der Meulen & Schauer 2017): so parameters of
σ, of the noise and of the initial law are as good as those of the drift, however small the steps.

The step error of the posterior is that of w. From ξ steps of twice the length have the noise
(ζ_i + ζ_{i+1}) / √2, which is N(0, I) as well, and a weight w̃; so L̃(θ) = E[w̃ / w] L(θ), the mean
over ξ given θ and the data, and to second order log E[w̃ / w] = E[D + ½ (D - ED)²], D = log w̃ / w.
"""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.averages import proper
from ..engine.checks import nondifferentiable
from ..engine.progress import metered_scan
from ..exact import acceptance_rate
from ..records import (
    Paths,
    Records,
    blocks_of_both_cuts,
    cuts,
    guided,
    has_segments,
    linearisations,
    noise_and_log_weight,
    path_and_log_weight,
    sweep,
    tuned,
)
from ..schemes import share_of_order
from .parameter_walk import TARGET, adapted
from .parameters import Parameters
from .posterior import (
    STEP_ERRORS,
    AbstractPosterior,
    drawn,
    first_chain,
    first_states,
    over_chains,
)
from .priors import GivenDensity, NormalDensity

# Intervals between observations that move at once.
_BLOCK_LENGTH = 10


class RecordState(NamedTuple):
    """Where a chain of `gibbs` is, given an `observation`, with chains in a leading axis if there
    are several.

    - `theta`: θ, shape (p,).
    - `start`, `points`: the paths of R records, x_0 and the points at the ends of steps.
    - `root`: S of the covariance S Sᵀ of moves of θ; `log_scales`: log β of those of the blocks.
    - `num_done`: iterations so far.
    """

    theta: Float[Array, "*chains p"]
    start: Float[Array, "*chains R d 1"]
    points: Float[Array, "*chains R K N d 1"]
    root: Float[Array, "*chains p p"]
    log_scales: Float[Array, "*chains R 2 B"]
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
    - `log_step_error`: an estimate of the step error of the log density of data and noise at each
        draw, up to a constant, NaN where none was worked out, shape (*chains, n): what
        `step_error`, that of the posterior mean, is made of.
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
    """What does not change from iteration to iteration, and the steps of one chain. `points` are
    those along which each record is linearised; `coarse` are with half as many steps."""

    parameters: Parameters
    records: Records
    log_prior: NormalDensity | GivenDensity
    points: Float[Array, "R points d"]
    coarse: Records
    coarse_points: Float[Array, "R points d"]

    def start(
        self, key: Key[Array, ""], start: tuple[Float[Array, " p"], Float[Array, "p p"]]
    ) -> RecordState:
        theta, root = start
        model, number = self.parameters.bind(theta), self.records.number

        def first(problem, key, points):
            noise = jax.random.normal(key, points.shape, points.dtype)
            path, log_weight = path_and_log_weight(
                problem, model, guided(problem, model, points), noise
            )
            path = jnp.where(jnp.isfinite(log_weight), path, points)
            return path, jnp.zeros((2, cuts(problem.num_segments, _BLOCK_LENGTH).shape[-1]))

        paths, scales = self.records.each(first, jax.random.split(key, number), self.points)
        return RecordState(
            theta, *self.split(paths), root, scales.astype(theta.dtype), jnp.int32(0)
        )

    def split(self, paths: Float[Array, "R points d"]) -> Paths:
        """x_0 and all other points, of one chain."""
        problem = self.records.stacked
        shape = *problem.record.dt.shape, problem.dim, 1
        return Paths(paths[:, 0, :, None], paths[:, 1:].reshape(shape))

    def step(
        self, key: Key[Array, ""], state: RecordState, learning: Bool[Array, ""]
    ) -> tuple[RecordState, tuple[Bool[Array, ""], Bool[Array, "R 2 B 1"]]]:
        """The paths given θ, then θ given ξ; both learn the size of their moves. Whether θ moved,
        and which blocks did, of those that hold a part of a record."""
        path_key, noise_key, walk_key, accept_key = jax.random.split(key, 4)
        paths, taken = self.renewed(path_key, state)
        noise, log_weight = self.noise(noise_key, state.theta, paths)
        step = jax.random.normal(walk_key, state.theta.shape, state.theta.dtype)
        proposed = state.theta + state.root @ step
        inside = self.parameters.allowed(proposed)
        proposed = jnp.where(inside, proposed, state.theta)
        new_paths, new_weight = self.paths(self.records, proposed, self.points, noise)
        new = jnp.where(inside, new_weight + self.log_prior(proposed), -jnp.inf)
        old = proper(log_weight) + self.log_prior(state.theta)
        rate = acceptance_rate(old, proper(new))
        accepted = jax.random.uniform(accept_key, dtype=rate.dtype) < rate

        number = (state.num_done + 1).astype(rate.dtype)
        gain = jnp.where(learning, jnp.minimum(1.0, len(proposed) * number ** (-2 / 3)), 0)
        root = adapted(state.root, step, gain * (rate - TARGET))
        root = jnp.where((gain > 0) & jnp.all(jnp.isfinite(root)), root, state.root)
        log_scales = tuned(state.log_scales, taken, number)
        moved = RecordState(
            jnp.where(accepted, proposed, state.theta),
            *self.split(jnp.where(accepted, new_paths, paths)),
            root,
            jnp.where(learning, log_scales, state.log_scales),
            state.num_done + 1,
        )
        return moved, (accepted, taken)

    def renewed(
        self, key: Key[Array, ""], state: RecordState
    ) -> tuple[Float[Array, "R points d"], Bool[Array, "R 2 B 1"]]:
        """The paths after a sweep given θ, and which blocks moved."""
        model = self.parameters.bind(state.theta)

        def one(problem, key, points, scales, *path):
            (K, N), d = problem.record.dt.shape, problem.dim
            guide = guided(problem, model, points)
            both = blocks_of_both_cuts(problem, points, guide, _BLOCK_LENGTH)
            made, taken = sweep(key, problem, model, both, scales, Paths(*path))
            return jnp.concatenate([made.start.T, made.points.reshape(K * N, d)]), taken

        keys = jax.random.split(key, self.records.number)
        each = (keys, self.points, state.log_scales, state.start, state.points)
        return self.records.each(one, *each)

    def noise(
        self, key: Key[Array, ""], theta: Float[Array, " p"], paths: Float[Array, "R points d"]
    ) -> tuple[Float[Array, "R points d"], Float[Array, ""]]:
        """ξ of these paths, and log w."""
        model = self.parameters.bind(theta)

        def one(problem, key, points, path):
            guide = guided(problem, model, points)
            return noise_and_log_weight(key, problem, model, guide, path)

        keys = jax.random.split(key, self.records.number)
        noise, log_weight = self.records.each(one, keys, self.points, paths)
        return noise, jnp.sum(log_weight)

    def paths(
        self,
        records: Records,
        theta: Float[Array, " p"],
        points: Float[Array, "R points d"],
        noise: Float[Array, "R points d"],
    ) -> tuple[Float[Array, "R points d"], Float[Array, ""]]:
        """The paths of ξ, and log w."""
        model = self.parameters.bind(theta)

        def one(problem, points, noise):
            guide = guided(problem, model, points)
            return path_and_log_weight(problem, model, guide, noise)

        paths, log_weight = records.each(one, points, noise)
        return paths, jnp.sum(log_weight)

    def log_ratio(self, key: Key[Array, ""], state: RecordState) -> Float[Array, ""]:
        """log w̃ / w, of steps of twice the length."""
        path = lambda start, points: jnp.concatenate([start.T, points.reshape(-1, start.shape[0])])
        paths = jax.vmap(path)(state.start, state.points)
        noise, log_weight = self.noise(key, state.theta, paths)
        N = self.coarse.stacked.num_steps
        halved = jax.vmap(lambda noise: _of_pairs(noise, N))(noise)
        return self.paths(self.coarse, state.theta, self.coarse_points, halved)[1] - log_weight


def _of_pairs(noise: Float[Array, "points d"], num_steps: int) -> Float[Array, "points d"]:
    """The noise of steps of twice the length, as `Record.halved` has them: of each pair of a
    segment the second step."""
    odd = num_steps % 2
    segments = noise[1:].reshape(-1, num_steps, noise.shape[-1])
    first, second = segments[:, odd::2], segments[:, odd + 1 :: 2]
    pairs = jnp.stack([first, (first + second) * np.sqrt(0.5).astype(noise.dtype)], axis=2)
    pairs = pairs.reshape(len(segments), -1, noise.shape[-1])
    segments = jnp.concatenate([segments[:, :odd], pairs], axis=1)
    return jnp.concatenate([noise[:1], segments.reshape(-1, noise.shape[-1])])


def sample_records(
    key: Key[Array, ""],
    parameters: Parameters,
    records: Records,
    log_prior: NormalDensity | GivenDensity,
    start: tuple[Float[Array, "*chains p"], Float[Array, "p p"]] | RecordState,
    size: tuple[int, int, int],
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> RecordPosterior:
    """After so many iterations of the warm-up, so many draws, with so many iterations each."""
    theta = start.theta if isinstance(start, RecordState) else start[0]
    model, coarse = parameters.bind(first_chain(theta)), records.halved()
    both = linearisations(records, model), coarse, linearisations(coarse, model)
    sampler = RecordSampler(parameters, records, log_prior, *both)
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
    begun = state.num_done.reshape(-1)[0]
    # The warm-up counts in draws, too, so that there is one loop.
    skipped = -(-num_warmup // thin)
    every = max(1, num_iterations // STEP_ERRORS)

    def iterate(state, i):
        step = lambda key, state: sampler.step(key, state, i < num_warmup)
        # Number 0 made the first paths.
        return over_chains(step, jax.random.fold_in(key, begun + i + 1), state)

    def log_ratios(i, state):
        mine = jax.random.fold_in(jax.random.fold_in(key, begun + (i + 1) * thin), 1)
        known = lambda state: over_chains(sampler.log_ratio, mine, state)
        unknown = lambda state: jnp.full(state.theta.shape[:-1], jnp.nan, state.theta.dtype)
        if sampler.records.stacked.num_steps == 1:
            return unknown(state)
        return lax.cond((i >= skipped) & ((i - skipped) % every == 0), known, unknown, state)

    def draw(state, i):
        state, (moved, taken) = lax.scan(iterate, state, i * thin + jnp.arange(thin))
        share = jnp.mean(taken.astype(state.theta.dtype), axis=0)
        made = state.theta, jnp.any(moved, axis=0), share[..., 0], log_ratios(i, state)
        return state, made

    steps = jnp.arange(skipped + num_iterations)
    state, made = metered_scan(draw, state, steps, progress_meter)
    draws = jax.tree.map(lambda leaf: leaf[skipped:], made)
    fields, (moved, taken, log_ratio) = drawn(sampler.parameters, *draws)
    real = sampler.records.each(lambda problem: has_segments(problem, _BLOCK_LENGTH))
    ever = jnp.any(taken > 0, axis=-4)  # of all draws
    deviation = log_ratio - jnp.nanmean(log_ratio)
    share = share_of_order(sampler.records.stacked.density.order)
    return RecordPosterior(
        **fields,
        parameters_moved=moved,
        blocks_moved=jnp.mean(taken, axis=(-3, -2, -1), where=real),
        stuck=jnp.any(real & ~ever, axis=(-3, -2, -1)),
        log_step_error=share * (log_ratio + deviation**2 / 2),
        state=state,
    )
