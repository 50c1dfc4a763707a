"""Gibbs sampling of parameters and paths of records that were seen with noise or in part.

The state is (θ, path). In turn the path moves given θ; then it is read as the noise ξ that makes it
(`record_paths`), and θ moves given ξ: by a normal random walk from π(θ) w(θ, ξ), which takes the
path along. So parameters of σ, of the noise and of the initial law are as good as those of the
drift, however small the steps.

The step error of the likelihood is that of E[w̃ / w] (`record_paths`), and with D = log w̃ / w, to
second order, log E[w̃ / w] = E[D + ½ (D - ED)²].
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
from ..engine.compiled import compiled
from ..engine.progress import metered_scan
from ..exact import acceptance_rate
from ..records import Records, tuned
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
from .record_paths import RecordPaths, as_record_paths


class RecordState(NamedTuple):
    """Where a chain of `gibbs` is, given an `observation`, with chains in a leading axis if there
    are several.

    - `theta`: θ, shape (p,).
    - `paths`: of R records, at the points of their grids.
    - `root`: S of the covariance S Sᵀ of moves of θ; `log_scales`: log β of those of the blocks.
    - `num_done`: iterations so far.
    """

    theta: Float[Array, "*chains p"]
    paths: Float[Array, "*chains R points d"]
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
        those of the posterior, and `standard_error` is infinite.
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

    @property
    def _stuck(self):
        return self.stuck


class RecordSampler(eqx.Module):
    """What does not change from iteration to iteration, and the steps of one chain."""

    completion: RecordPaths
    log_prior: NormalDensity | GivenDensity

    @property
    def parameters(self) -> Parameters:
        return self.completion.parameters

    def start(
        self, key: Key[Array, ""], start: tuple[Float[Array, " p"], Float[Array, "p p"]]
    ) -> RecordState:
        theta, root = start
        paths, log_scales = self.completion.first(key, theta)
        return RecordState(theta, paths, root, log_scales, jnp.int32(0))

    def step(
        self, key: Key[Array, ""], state: RecordState, learning: Bool[Array, ""]
    ) -> tuple[RecordState, tuple[Bool[Array, ""], Bool[Array, "R 2 B 1"]]]:
        """The paths given θ, then θ given ξ; both learn the size of their moves. Whether θ moved,
        and which blocks."""
        path_key, noise_key, walk_key, accept_key = jax.random.split(key, 4)
        theta, log_scales = state.theta, state.log_scales
        paths, taken = self.completion.renewed(path_key, theta, state.paths, log_scales)
        noise, log_weight = self.completion.noise(noise_key, theta, paths)
        step = jax.random.normal(walk_key, theta.shape, theta.dtype)
        proposed = theta + state.root @ step
        inside = self.parameters.allowed(proposed)
        proposed = jnp.where(inside, proposed, theta)
        new_paths, new_weight = self.completion.of_noise(proposed, noise)
        new = jnp.where(inside, new_weight + self.log_prior(proposed), -jnp.inf)
        rate = acceptance_rate(proper(log_weight) + self.log_prior(theta), proper(new))
        accepted = jax.random.uniform(accept_key, dtype=rate.dtype) < rate

        number = (state.num_done + 1).astype(rate.dtype)
        gain = jnp.where(learning, jnp.minimum(1.0, len(proposed) * number ** (-2 / 3)), 0)
        root = adapted(state.root, step, gain * (rate - TARGET))
        moved = RecordState(
            jnp.where(accepted, proposed, theta),
            jnp.where(accepted, new_paths, paths),
            jnp.where((gain > 0) & jnp.all(jnp.isfinite(root)), root, state.root),
            jnp.where(learning, tuned(log_scales, taken, number), log_scales),
            state.num_done + 1,
        )
        return moved, (accepted, taken)

    def log_ratio(self, key: Key[Array, ""], state: RecordState) -> Float[Array, ""]:
        """log w̃ / w, of steps of twice the length."""
        noise, log_weight = self.completion.noise(key, state.theta, state.paths)
        return self.completion.coarse_log_weight(state.theta, noise) - log_weight


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
    completion = as_record_paths(parameters, records, first_chain(theta))
    sampler = RecordSampler(completion, log_prior)
    if isinstance(start, RecordState):
        return _run(key, sampler, start, size, progress_meter)
    root = jnp.broadcast_to(start[1], (*theta.shape[:-1], *start[1].shape))
    state = first_states(sampler.start, key, (theta, root))
    return _run(key, sampler, state, size, progress_meter)


@compiled
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
        if sampler.completion.num_steps == 1:
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
    real = sampler.completion.movable()
    ever = jnp.any(taken > 0, axis=-4)  # of all draws
    deviation = log_ratio - jnp.nanmean(log_ratio)
    return RecordPosterior(
        **fields,
        parameters_moved=moved,
        blocks_moved=jnp.mean(taken, axis=(-3, -2, -1), where=real),
        stuck=jnp.any(real & ~ever, axis=(-3, -2, -1)),
        log_step_error=sampler.completion.share_of_step_error * (log_ratio + deviation**2 / 2),
        state=state,
    )
