"""Gibbs sampling of parameters and paths, given noisy or partial records.

Exact observations are a record without noise. They belong here if σ is unknown.

The state is (θ, path). Two moves alternate:

- The path moves given θ.
- The path is converted to its noise ξ (`record_paths`), and θ moves given ξ by a normal random
  walk. The target is π(θ) w(θ, ξ). The path changes with θ.

Hence any parameters may be unknown: those of the drift, of σ, of the noise and of the initial law.
This holds for every step size.

The guide is linearised along a path that is likely at some θ. It may be poor at a θ far away.
Neither the law of the path given θ nor that of θ given ξ depends on the guide, so the warm-up
replaces it (`warm_up`).

The discretisation error of the likelihood follows from E[w̃ / w] (`record_paths`). If half as many
steps are too few for the drift, a path may diverge; then its w̃ is zero.
"""

from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.averages import nan_to_neg_inf
from ..engine.checks import nondifferentiable
from ..engine.compiled import compiled_sooner
from ..engine.keys import key_for
from ..engine.progress import metered_stages
from ..exact import acceptance_rate
from ..records import Guidance, GuideCheck, Records, tuned
from .parameter_walk import adapt_covariance
from .parameters import Parameters
from .posterior import (
    AbstractPosterior,
    Combination,
    check_likelihood_was_found,
    first_chain,
    last,
    over_chains,
    posterior_fields,
    refused_moves,
    thinned_step_errors,
)
from .priors import GivenDensity, NormalDensity
from .record_paths import (
    GuidedTheta,
    RecordPaths,
    as_record_paths,
    likely_root,
    movable,
    no_paths,
    share_of_step_error,
    unguided,
)
from .warm_up import stages


class RecordState(NamedTuple):
    """State of a chain of `gibbs` for a record. Several chains have a leading axis.

    - `theta`: θ, shape (p,).
    - `paths`: knots of the paths of R records (`records.guided_record`).
    - `root`: S of the covariance S Sᵀ of moves of θ, shape (p, p).
    - `log_scales`: log β of the moves of the blocks.
    - `num_done`: number of iterations so far.
    """

    theta: Float[Array, "*chains p"]
    paths: Float[Array, "*chains R points d"]
    root: Float[Array, "*chains p p"]
    log_scales: Float[Array, "*chains R 2 B"]
    num_done: Int[Array, "*chains"]


class GuidedState(NamedTuple):
    """A `RecordState` with the guides at its θ, which are computed once for each θ."""

    state: RecordState
    guides: Guidance


class RecordPosterior(AbstractPosterior):
    """Posterior draws of the unknown parameters, from `gibbs` for a record.

    A record has an `observation`, or exact observations and an unknown σ.

    Arrays have a leading axis of chains if there are several.

    - `params`: all parameters of the model, each with leading axes (*chains, n).
    - `theta`: the unknown parameters as vectors, shape (*chains, n, p).
    - `names`: names of the entries of θ, for instance "alpha" or "B[0,1]". The keys of a dictionary
        are in alphabetical order.
    - `parameters_moved`: whether θ moved, shape (*chains, n).
    - `blocks_moved`: fraction of the blocks of the path that moved, shape (*chains, n).
    - `stuck`: whether some block never moved, shape (*chains). Then the draws do not represent the
        posterior, and `standard_error` is infinite.
    - `log_step_error`: estimated discretisation error of the log density of data and noise at each
        draw, up to a constant, shape (*chains, n). NaN at draws without an estimate. `step_error`,
        that of the posterior mean, is computed from it.
    - `sigma_varies`: whether σ depends on the state.
    - `state`: last state; pass it as `init`, with `num_warmup=0`, to continue.
    - `guide`: diagnostics of the last guide of each record, from the warm-up. A poor guide is a
        fault only if chains mix poorly, too.
    """

    params: PyTree
    theta: Float[Array, "*chains n p"]
    names: tuple[str, ...] = eqx.field(static=True)
    parameters_moved: Bool[Array, "*chains n"]
    blocks_moved: Float[Array, "*chains n"]
    stuck: Bool[Array, "*chains"]
    log_step_error: Float[Array, "*chains n"]
    sigma_varies: bool = eqx.field(static=True)
    state: RecordState
    guide: GuideCheck | None = None

    _combinations: ClassVar[dict[str, Combination]] = {
        "stuck": lambda first, second, share: first & second,
        "state": last,
        "guide": last,
    }  # fmt: skip
    _continued_with: ClassVar[dict[str, Any]] = {"num_warmup": 0, "covariance": None}

    @property
    def _stuck(self):
        return self.stuck

    @property
    def _faults(self):
        refused = refused_moves(self.parameters_moved)
        mixes_poorly = refused.present | jnp.any(self.stuck)
        return refused, *(() if self.guide is None else (self.guide.fault(mixes_poorly),))


class RecordSampler(eqx.Module):
    """Constants of the sampler, and the steps of one chain."""

    completion: RecordPaths
    log_prior: NormalDensity | GivenDensity

    @property
    def parameters(self) -> Parameters:
        return self.completion.parameters

    def start(
        self, key: Key[Array, ""], start: tuple[Float[Array, " p"], Float[Array, "p p"]]
    ) -> RecordState:
        theta, root = start
        paths, log_scales = self.completion.first(key, self.completion.at(theta))
        return RecordState(theta, paths, root, log_scales, jnp.int32(0))

    def step(
        self, key: Key[Array, ""], guided: GuidedState, learning: Bool[Array, ""]
    ) -> tuple[GuidedState, tuple[Bool[Array, ""], Bool[Array, ""], Bool[Array, "R 2 B 1"]]]:
        """Move the paths given θ, then θ given ξ; `learning` adapts the scales of both moves.

        Return the state, whether θ moved, whether the paths have a weight, and whether each block
        moved.
        """
        path_key, noise_key, walk_key, accept_key = jax.random.split(key, 4)
        state, guides = guided
        theta, log_scales = state.theta, state.log_scales
        here = GuidedTheta(theta, guides)
        # This move leaves the law of the path given θ invariant, whatever the guide.
        paths, blocks_moved = self.completion.renewed(path_key, here, state.paths, log_scales)
        noise, log_weight = self.completion.noise(noise_key, here, paths)
        step = jax.random.normal(walk_key, theta.shape, theta.dtype)
        proposed = theta + state.root @ step
        # Outside the constraint the model may be invalid: evaluate at θ, and reject.
        inside = self.parameters.allowed(proposed)
        there = self.completion.at(jnp.where(inside, proposed, theta))
        new_paths, new_weight = self.completion.of_noise(there, noise)
        # Given ξ the target is π(θ) w(θ, ξ): the density of ξ cancels.
        new = jnp.where(inside, new_weight + self.log_prior(there.theta), -jnp.inf)
        rate = acceptance_rate(
            nan_to_neg_inf(log_weight) + self.log_prior(theta), nan_to_neg_inf(new)
        )
        accepted = jax.random.uniform(accept_key, dtype=rate.dtype) < rate

        number = state.num_done + 1
        scales = tuned(log_scales, blocks_moved, number.astype(rate.dtype))
        (theta, guides), paths = jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old), (there, new_paths), (here, paths)
        )
        new_state = RecordState(
            theta,
            paths,
            adapt_covariance(state.root, step, rate, number, learning),
            jnp.where(learning, scales, log_scales),
            number,
        )
        has_weight = nan_to_neg_inf(jnp.where(accepted, new_weight, log_weight)) > -jnp.inf
        return GuidedState(new_state, guides), (accepted, has_weight, blocks_moved)

    def change_by_coarse_steps(self, key: Key[Array, ""], guided: GuidedState) -> Float[Array, ""]:
        """Return the relative change of the likelihood by steps of twice the size.

        It is NaN if the path has no weight, and infinite if steps are too long for the drift.
        """
        (state, guides), completion = guided, self.completion
        here = GuidedTheta(state.theta, guides)
        noise, log_weight = completion.noise(key, here, state.paths)
        # A path without weight, such as a placeholder, has no change.
        change = completion.change_by_coarse_steps(here, noise)
        return jnp.where(jnp.isfinite(log_weight), change, jnp.nan)


def sample_records(
    key: Key[Array, ""],
    parameters: Parameters,
    records: Records,
    log_prior: NormalDensity | GivenDensity,
    start: tuple[Float[Array, "*chains p"], Float[Array, "p p"]] | RecordState,
    size: tuple[int, int, int],
    finds_root: bool,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> RecordPosterior:
    """Sample parameters and paths.

    - `start`: initial θ and the root S of its first moves, or the state of earlier draws.
    - `size`: (number of warm-up iterations, number of draws, iterations per draw).
    - `finds_root`: whether S is replaced by one with the width of the likelihood.

    **Raises:** `ValueError` if a chain never has paths with a positive weight.
    """
    arguments = (key, parameters, records, log_prior, start, size, finds_root, progress_meter)
    posterior, never = _sample_records(*arguments)
    check_likelihood_was_found(never)
    return posterior


@compiled_sooner
def _sample_records(
    key: Key[Array, ""],
    parameters: Parameters,
    records: Records,
    log_prior: NormalDensity | GivenDensity,
    start: tuple[Float[Array, "*chains p"], Float[Array, "p p"]] | RecordState,
    size: tuple[int, int, int],
    finds_root: bool,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> tuple[RecordPosterior, Bool[Array, "*chains"]]:
    """Return the posterior, and whether each chain never had paths with a weight."""
    parameters, records, log_prior, start = nondifferentiable(
        (parameters, records, log_prior, start)
    )
    fresh = not isinstance(start, RecordState)
    num_warmup, num_iterations, thin = size
    # The warm-up is measured in draws, too, so that one loop serves both.
    skipped = -(-num_warmup // thin)

    def begin(guided, i):
        state = guided.state
        completion = as_record_paths(parameters, records, first_chain(state.theta))
        sampler = RecordSampler(completion, log_prior)

        def first(state):
            root = state.root
            if finds_root:
                of_chain = first_chain(state.theta), root.reshape(-1, *root.shape[-2:])[0]
                likely = likely_root(parameters, completion.fine, log_prior, *of_chain)
                root = jnp.broadcast_to(likely, root.shape)
            return over_chains(sampler.start, jax.random.fold_in(key, 0), (state.theta, root))

        if fresh:
            # Stages share one compiled loop, and only the first one creates paths.
            state = lax.cond(i == 0, first, lambda state: state, state)
        return GuidedState(state, _guides_of(completion, state.theta)), sampler

    def number(guided):
        return guided.state.num_done.reshape(-1)[0]  # key 0 is for the first paths

    def changes(sampler, i, guided):
        theta = guided.state.theta
        own_key = jax.random.fold_in(key_for("step error", key), number(guided))
        function = lambda guided: over_chains(sampler.change_by_coarse_steps, own_key, guided)
        if records.stacked.density.is_exact:
            return jnp.zeros(theta.shape[:-1], theta.dtype)
        if records.stacked.num_steps == 1:
            return jnp.full(theta.shape[:-1], jnp.nan, theta.dtype)
        return thinned_step_errors(function, guided, i - skipped, num_iterations)

    def draw(sampler, guided, i):
        def iterate(guided, i):
            step = lambda key, guided: sampler.step(key, guided, i < num_warmup)
            return over_chains(step, jax.random.fold_in(key, number(guided) + 1), guided)

        result = lax.scan(iterate, guided, i * thin + jnp.arange(thin))
        guided, (theta_moved, has_weight, blocks_moved) = result
        theta = guided.state.theta
        share = jnp.mean(blocks_moved.astype(theta.dtype), axis=0)
        weights = jnp.any(has_weight, axis=0), changes(sampler, i, guided)
        result = theta, jnp.any(theta_moved, axis=0), share[..., 0], *weights
        return guided, (result, sampler.completion.fine.check)

    bounds = stages(skipped if fresh else 0, skipped + num_iterations)
    state = _initial_state(records, *start) if fresh else start
    init = GuidedState(state, _no_guides(parameters, records, state.theta))
    (state, _), draws = metered_stages(begin, draw, init, bounds, num_iterations, progress_meter)
    draws, checks = draws
    fields, (theta_moved, blocks_moved, has_weight, change) = posterior_fields(parameters, *draws)
    real = movable(records)
    ever = jnp.any(blocks_moved > 0, axis=-4)  # in any draw
    posterior = RecordPosterior(
        **fields,
        parameters_moved=theta_moved,
        blocks_moved=jnp.mean(blocks_moved, axis=(-3, -2, -1), where=real),
        stuck=jnp.any(real & ~ever, axis=(-3, -2, -1)),
        log_step_error=share_of_step_error(records) * change,
        sigma_varies=parameters.model.sigma_varies(records.stacked.like),
        state=state,
        guide=jax.tree.map(lambda leaf: leaf[-1], checks),
    )
    return posterior, ~jnp.any(has_weight, axis=-1)


def _initial_state(
    records: Records, theta: Float[Array, "*chains p"], root: Float[Array, "p p"]
) -> RecordState:
    """Return the state before the first paths, with placeholders for them."""
    chains = theta.shape[:-1]
    paths, log_scales, root, num_done = (
        jnp.broadcast_to(leaf, (*chains, *leaf.shape))
        for leaf in (*no_paths(records), root, jnp.int32(0))
    )
    return RecordState(theta, paths, root, log_scales, num_done)


def _guides_of(completion: RecordPaths, theta: Float[Array, "*chains p"]) -> Guidance:
    """Return the guides at θ of one chain, or of each of several chains."""
    of_chain = lambda theta: completion.at(theta).guides
    return of_chain(theta) if theta.ndim == 1 else jax.vmap(of_chain)(theta)


def _no_guides(
    parameters: Parameters, records: Records, theta: Float[Array, "*chains p"]
) -> Guidance:
    """Return placeholders with the shapes of the guides."""
    completion = RecordPaths(parameters, unguided(records), unguided(records))
    shapes = jax.eval_shape(lambda theta: _guides_of(completion, theta), theta)
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
