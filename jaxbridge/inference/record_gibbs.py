"""Gibbs sampling of parameters and paths, given noisy or partial records.

Exact observations are a record without noise. They are treated here if σ is unknown or depends on
the state, or if parameters vary between records.

The state is (θ, path). Two moves alternate:

- The path moves given θ.
- The path is converted to its noise ξ (`record_paths`), and θ moves a few times given ξ by a normal
  random walk. The target is π(θ) w(θ, ξ). The path changes with θ.

Hence any parameters may be unknown: those of the drift, of σ, of the noise and of the initial law.
This holds for every step size.

Parameters may vary between records (`population`). Two more moves follow then: those of each record
given ξ, all at once, and those of the population given the parameters of the records.

The guide is linearised along a path that is likely at some θ. It may be poor at a θ far away. Both
moves leave the posterior law of θ and path invariant for every guide, so the warm-up may replace
the guide (`warm_up`).

The discretisation error of the likelihood follows from E[w̃ / w] (`record_paths`). If half as many
steps are too few for the drift, a path may diverge; then its w̃ is zero.
"""

import functools
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
from .population import Population
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

# Number of moves of θ for each sweep over the paths. θ mixes more slowly than the paths, and a move
# of it costs a tenth to a half of a sweep.
_NUM_MOVES = 8


class RecordState(NamedTuple):
    """State of a chain of `gibbs` for a record. Several chains have a leading axis.

    - `theta`: θ, shape (p,). With a `population` the logs of its q standard deviations follow.
    - `paths`: knots of the paths of R records (`records.guided_record`).
    - `root`: S of the covariance S Sᵀ of moves of θ; a square matrix with a row for each entry of
        `theta`.
    - `log_scales`: log β of each block of the paths, where β is the size of its moves.
    - `num_done`: number of iterations so far.
    - `units`, `unit_roots`: z of each record (`population`), and S of their moves.
    """

    theta: Float[Array, "*chains p"]
    paths: Float[Array, "*chains R points d"]
    root: Float[Array, "*chains p p"]
    log_scales: Float[Array, "*chains R 2 B"]
    num_done: Int[Array, "*chains"]
    units: Float[Array, "*chains R q"]
    unit_roots: Float[Array, "*chains R q q"]


class GuidedState(NamedTuple):
    """A `RecordState` with what is computed once for each state.

    - `guides`: the guides at its θ.
    - `noise`: noise ξ of the paths, from the last iteration.
    - `log_weights`: log w of each record, from the last iteration.
    """

    state: RecordState
    guides: Guidance
    noise: Float[Array, "*chains R points d"]
    log_weights: Float[Array, "*chains R"]


class RecordPosterior(AbstractPosterior):
    """Posterior draws of the unknown parameters, from `gibbs` for a record.

    The records have an `observation`. Exact observations count as records, too, if σ is unknown or
    depends on the state, or with a `population`.

    Arrays have a leading axis of chains if there are several.

    - `params`: all parameters of the model, each with leading axes (*chains, n). With a
        `population` they are means in the population.
    - `theta`: the unknown parameters as vectors, shape (*chains, n, p). With a `population` the
        logs of its standard deviations follow, with names such as "log_sd(rate)".
    - `names`: names of the entries of θ, for instance "alpha" or "B[0,1]". The keys of a dictionary
        are in alphabetical order.
    - `parameters_moved`: fraction of accepted moves of θ given the noise of the paths, shape
        (*chains, n).
    - `blocks_moved`: fraction of the blocks of the path that moved, shape (*chains, n).
    - `stuck`: whether some block, or the parameters of some record, never moved, shape (*chains).
        Then the draws do not represent the posterior, and `standard_error` is infinite.
    - `log_step_error`: estimated discretisation error of the log density of data and noise at each
        draw, up to a constant, shape (*chains, n). NaN at draws without an estimate. `step_error`,
        that of the posterior mean, is computed from it.
    - `sigma_varies`: whether σ depends on the state.
    - `state`: last state; pass it as `init`, with `num_warmup=0`, to continue.
    - `guide`: diagnostics of the last guide of each record, from the warm-up. A poor guide is a
        fault only if chains mix poorly, too.
    - `unit_params`: all parameters of each record, with leading axes (*chains, n, R); `None`
        without a `population`.
    - `states`: the states of R records at the K times of their observations, shape
        (*chains, n, R, K, d); NaN after the end of a record. `None` without `save_states`.
    - `log_densities`: log density of each observation given the parameters of a draw and its states
        at the times before and after, for leave-one-out validation, shape (*chains, n, R, K). NaN
        if nothing was observed. `None` without `save_states`.
    """

    params: PyTree
    theta: Float[Array, "*chains n p"]
    names: tuple[str, ...] = eqx.field(static=True)
    parameters_moved: Float[Array, "*chains n"]
    blocks_moved: Float[Array, "*chains n"]
    stuck: Bool[Array, "*chains"]
    log_step_error: Float[Array, "*chains n"]
    sigma_varies: bool = eqx.field(static=True)
    state: RecordState
    guide: GuideCheck | None = None
    unit_params: PyTree = None
    states: Float[Array, "*chains n records K d"] | None = None
    log_densities: Float[Array, "*chains n records K"] | None = None

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


class _Weighted(NamedTuple):
    """Parameters with their guides, paths of each record, and log w of each record."""

    at: GuidedTheta
    paths: Float[Array, "R points d"]
    log_weights: Float[Array, " R"]


class RecordSampler(eqx.Module):
    """Constants of the sampler, and the steps of one chain."""

    completion: RecordPaths
    population: Population

    def start(self, key: Key[Array, ""], guided: GuidedState) -> RecordState:
        """Return the state with its first paths."""
        state = guided.state
        theta = self.population.of_units(state.theta, state.units)
        paths, log_scales = self.completion.first(key, GuidedTheta(theta, guided.guides))
        return state._replace(paths=paths, log_scales=log_scales)

    def step(
        self, key: Key[Array, ""], guided: GuidedState, learning: Bool[Array, ""]
    ) -> tuple[GuidedState, tuple[Array, ...]]:
        """Move the paths given θ, then θ given ξ; `learning` adapts the scales of both moves.

        Return the state, the fraction of accepted moves of θ, whether the paths have a weight,
        whether each block moved, and whether the parameters of each record moved.
        """
        path_key, noise_key, walk_key = jax.random.split(key, 3)
        state, guides, *_ = guided
        here = GuidedTheta(self.population.of_units(state.theta, state.units), guides)
        # This move leaves the law of the path given θ invariant, whatever the guide.
        paths, blocks_moved = self.completion.renewed(path_key, here, state.paths, state.log_scales)
        noise, log_weights = self.completion.noise(noise_key, here, paths)
        number = state.num_done + 1
        scales = tuned(state.log_scales, blocks_moved, number.astype(log_weights.dtype))
        scales = jnp.where(learning, scales, state.log_scales)

        def move(carry, i):
            at = noise, learning, _NUM_MOVES * (number - 1) + i
            return self._moved_parameters(jax.random.fold_in(walk_key, i), carry, *at)

        init = state._replace(log_scales=scales), _Weighted(here, paths, log_weights)
        (state, held), moved = lax.scan(move, init, 1 + jnp.arange(_NUM_MOVES))
        accepted, units_moved = moved
        share = jnp.mean(accepted.astype(log_weights.dtype), axis=0)
        has_weight = nan_to_neg_inf(jnp.sum(held.log_weights)) > -jnp.inf
        state = state._replace(paths=held.paths, num_done=number)
        moved = share, has_weight, blocks_moved, jnp.any(units_moved, axis=0)
        return GuidedState(state, held.at.guides, noise, held.log_weights), moved

    def _moved_parameters(
        self,
        key: Key[Array, ""],
        carry: tuple[RecordState, _Weighted],
        noise: Float[Array, "R points d"],
        learning: Bool[Array, ""],
        number: Int[Array, ""],
    ) -> tuple[tuple[RecordState, _Weighted], tuple[Bool[Array, ""], Bool[Array, " R"]]]:
        """Move φ given ξ, then the parameters of each record; `number` counts these moves from one.

        Return the state, and whether φ and z of each record moved.
        """
        walk_key, accept_key = jax.random.split(key)
        state, old = carry
        population, phi, units = self.population, state.theta, state.units
        step = jax.random.normal(walk_key, phi.shape, phi.dtype)
        moves = population.moves(number)
        step = jnp.where(moves, step, 0)
        proposed = phi + state.root @ step
        # Outside the constraint the model may be invalid: evaluate at θ, and reject.
        inside = jnp.all(population.allowed(proposed, units))
        proposed = jnp.where(inside, proposed, phi)
        new = self._weighted(population.of_units(proposed, units), noise)
        # Given ξ the target is π(θ) w(θ, ξ): the density of ξ cancels.
        rate = acceptance_rate(
            nan_to_neg_inf(jnp.sum(old.log_weights)) + population.log_density(phi),
            jnp.where(inside, nan_to_neg_inf(jnp.sum(new.log_weights)), -jnp.inf)
            + population.log_density(proposed),
        )
        accepted = jax.random.uniform(accept_key, dtype=rate.dtype) < rate
        phi, held = jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old), (proposed, new), (phi, old)
        )
        root = adapt_covariance(state.root, step, rate, number, learning)
        # Entries that did not move keep their scales.
        state = state._replace(theta=phi, root=jnp.where(moves[:, None], root, state.root))
        units_moved = jnp.ones(old.log_weights.shape, bool)
        carry = state, held
        if population.varies:
            given = carry, noise, learning, number
            carry, units_moved = self._moved_units(key_for("units", key), *given)
        return carry, (accepted, units_moved)

    def _weighted(self, theta: Float[Array, "*R p"], noise: Float[Array, "R points d"]):
        """Return the paths of this noise at θ, with their weights."""
        at = self.completion.at(theta)
        return _Weighted(at, *self.completion.of_noise(at, noise))

    def _moved_units(
        self,
        key: Key[Array, ""],
        carry: tuple[RecordState, _Weighted],
        noise: Float[Array, "R points d"],
        learning: Bool[Array, ""],
        number: Int[Array, ""],
    ) -> tuple[tuple[RecordState, _Weighted], Bool[Array, " R"]]:
        """Move z of each record given ξ and φ, then φ given the parameters of the records.

        Return the state, and whether z of each record moved.
        """
        walk_key, accept_key, population_key = jax.random.split(key, 3)
        state, old = carry
        population, phi, z = self.population, state.theta, state.units
        step = jax.random.normal(walk_key, z.shape, z.dtype)
        proposed = z + jnp.einsum("rij,rj->ri", state.unit_roots, step)
        inside = population.allowed(phi, proposed)
        proposed = jnp.where(inside[:, None], proposed, z)
        new = self._weighted(population.of_units(phi, proposed), noise)
        log_target = lambda weighted, z: (
            nan_to_neg_inf(weighted.log_weights) - jnp.sum(z**2, axis=1) / 2
        )
        target = jnp.where(inside, log_target(new, proposed), -jnp.inf)
        rate = jax.vmap(acceptance_rate)(log_target(old, z), target)
        accepted = jax.random.uniform(accept_key, rate.shape, rate.dtype) < rate

        def choose(new, old):
            return jnp.where(accepted.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        z, held = jax.tree.map(choose, (proposed, new), (z, old))
        adapt = lambda root, step, rate: adapt_covariance(root, step, rate, number, learning)
        roots = jax.vmap(adapt)(state.unit_roots, step, rate)
        phi, z = population.given_units(population_key, phi, z)
        return (state._replace(theta=phi, units=z, unit_roots=roots), held), accepted

    def change_by_coarse_steps(self, guided: GuidedState) -> Float[Array, ""]:
        """Return the relative change of the likelihood by steps of twice the size.

        It is NaN if the path has no weight, and infinite if steps are too long for the drift.
        """
        state = guided.state
        theta = self.population.of_units(state.theta, state.units)
        change = self.completion.change_by_coarse_steps(theta, guided.noise)
        # A path without weight, such as a placeholder, has no change.
        return jnp.where(jnp.all(jnp.isfinite(guided.log_weights)), change, jnp.nan)


def sample_records(
    key: Key[Array, ""],
    population: Population,
    records: Records,
    start: tuple[Float[Array, "*chains p"], Float[Array, "p p"]] | RecordState,
    size: tuple[int, int, int],
    finds_root: bool,
    saves_states: bool,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> RecordPosterior:
    """Sample parameters and paths.

    - `start`: initial φ and the root S of its first moves, or the state of earlier draws.
    - `size`: (number of warm-up iterations, number of draws, iterations per draw).
    - `finds_root`: whether S is replaced by one with the width of the likelihood.
    - `saves_states`: whether the states at observations are returned for each draw.

    **Raises:** `ValueError` if a chain never has paths with a positive weight.
    """
    options = (finds_root, saves_states, progress_meter)
    posterior, never = _sample_records(key, population, records, start, size, *options)
    check_likelihood_was_found(never)
    return posterior


@compiled_sooner
def _sample_records(
    key: Key[Array, ""],
    population: Population,
    records: Records,
    start: tuple[Float[Array, "*chains p"], Float[Array, "p p"]] | RecordState,
    size: tuple[int, int, int],
    finds_root: bool,
    saves_states: bool,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> tuple[RecordPosterior, Bool[Array, "*chains"]]:
    """Return the posterior, and whether each chain never had paths with a weight."""
    population, records, start = nondifferentiable((population, records, start))
    parameters = population.parameters
    fresh = not isinstance(start, RecordState)
    num_warmup, num_iterations, thin = size
    # The warm-up is measured in draws, too, so that one loop serves both.
    skipped = -(-num_warmup // thin)

    def begin(guided, i):
        state = guided.state
        phi, root = first_chain(state.theta), first_chain(state.root, 2)
        of_records = functools.partial(population.of_units, z=first_chain(state.units, 2))
        completion = as_record_paths(parameters, records, of_records(phi))
        sampler = RecordSampler(completion, population)
        guided = guided._replace(guides=_guides_of(completion, population, state))

        def first(guided):
            state = over_chains(sampler.start, jax.random.fold_in(key, 0), guided)
            if finds_root:
                log_prior = population.log_density
                likely = likely_root(parameters, completion.fine, log_prior, phi, root, of_records)
                state = state._replace(root=jnp.broadcast_to(likely, state.root.shape))
            return guided._replace(state=state)

        if fresh:
            # Stages share one compiled loop, and only the first one creates paths.
            guided = lax.cond(i == 0, first, lambda guided: guided, guided)
        return guided, sampler

    def number(guided):
        return guided.state.num_done.reshape(-1)[0]  # key 0 is for the first paths

    def changes(sampler, i, guided):
        theta = guided.state.theta
        of_chain = lambda guided: sampler.change_by_coarse_steps(guided)
        function = of_chain if theta.ndim == 1 else jax.vmap(of_chain)
        if records.stacked.density.is_exact:
            return jnp.zeros(theta.shape[:-1], theta.dtype)
        if records.stacked.num_steps == 1:
            return jnp.full(theta.shape[:-1], jnp.nan, theta.dtype)
        return thinned_step_errors(function, guided, i - skipped, num_iterations)

    def at_observations(sampler, guided):
        def of_chain(key, guided):
            state, guides, *_ = guided
            at = GuidedTheta(population.of_units(state.theta, state.units), guides)
            return sampler.completion.at_observations(key, at, state.paths)

        its_key = key_for("observations", jax.random.fold_in(key, number(guided)))
        return over_chains(of_chain, its_key, guided)

    def draw(sampler, guided, i):
        def iterate(guided, i):
            step = lambda key, guided: sampler.step(key, guided, i < num_warmup)
            return over_chains(step, jax.random.fold_in(key, number(guided) + 1), guided)

        result = lax.scan(iterate, guided, i * thin + jnp.arange(thin))
        guided, (theta_moved, has_weight, blocks_moved, units_moved) = result
        theta = guided.state.theta
        share = jnp.mean(blocks_moved.astype(theta.dtype), axis=0)
        weights = jnp.any(has_weight, axis=0), changes(sampler, i, guided)
        units = guided.state.units
        moved = jnp.mean(theta_moved, axis=0), share[..., 0], jnp.any(units_moved, axis=0)
        seen = at_observations(sampler, guided) if saves_states else ()
        result = theta, units, *moved, *weights, seen
        return guided, (result, sampler.completion.fine.check)

    bounds = stages(skipped if fresh else 0, skipped + num_iterations)
    state = _initial_state(key, population, records, *start) if fresh else start
    noise = jnp.zeros_like(state.paths)
    log_weights = jnp.zeros(noise.shape[:-2], noise.dtype)
    init = GuidedState(state, _no_guides(population, records, state), noise, log_weights)
    guided, draws = metered_stages(begin, draw, init, bounds, num_iterations, progress_meter)
    draws, checks = draws
    fields, values = posterior_fields(population, *draws)
    units, theta_moved, blocks_moved, units_moved, has_weight, change, seen = values
    states, log_densities = _by_observation(records, *seen) if saves_states else (None, None)
    real = movable(records)
    ever = jnp.any(blocks_moved > 0, axis=-4)  # in any draw
    posterior = RecordPosterior(
        **fields,
        parameters_moved=theta_moved,
        blocks_moved=jnp.mean(blocks_moved, axis=(-3, -2, -1), where=real),
        stuck=jnp.any(real & ~ever, axis=(-3, -2, -1))
        | jnp.any(~jnp.any(units_moved, axis=-2), axis=-1),
        log_step_error=share_of_step_error(records) * change,
        sigma_varies=parameters.model.sigma_varies(records.stacked.like),
        state=guided.state,
        guide=jax.tree.map(lambda leaf: leaf[-1], checks),
        unit_params=_params_of_units(population, fields["theta"], units),
        states=states,
        log_densities=log_densities,
    )
    return posterior, ~jnp.any(has_weight, axis=-1)


def _by_observation(
    records: Records,
    states: Float[Array, "*chains n R ends d"],
    log_densities: Float[Array, "*chains n R ends"],
) -> tuple[Float[Array, "*chains n R K d"], Float[Array, "*chains n R K"]]:
    """Return the states at observations, and the log densities of these."""
    seen = ~jnp.all(jnp.isnan(records.stacked.record.values), axis=-1)
    log_densities = jnp.where(seen, log_densities, jnp.nan)
    axis = log_densities.ndim - 1
    return records.by_observation(states, axis), records.by_observation(log_densities, axis)


def _initial_state(
    key: Key[Array, ""],
    population: Population,
    records: Records,
    theta: Float[Array, "*chains p"],
    root: Float[Array, "p p"],
) -> RecordState:
    """Return the state before the first paths, with placeholders for them."""
    chains, q = theta.shape[:-1], len(population.varies)
    first = lambda key, phi: population.first_units(key, phi, records.number)
    units = over_chains(first, key_for("first units", key), theta)
    unit_root = jnp.broadcast_to(jnp.eye(q, dtype=theta.dtype), (records.number, q, q))
    paths, log_scales, root, num_done, unit_roots = (
        jnp.broadcast_to(leaf, (*chains, *leaf.shape))
        for leaf in (*no_paths(records), root, jnp.int32(0), unit_root)
    )
    return RecordState(theta, paths, root, log_scales, num_done, units, unit_roots)


def _guides_of(completion: RecordPaths, population: Population, state: RecordState) -> Guidance:
    """Return the guides at θ of one chain, or of each of several chains."""
    of_chain = lambda phi, units: completion.at(population.of_units(phi, units)).guides
    each = state.theta, state.units
    return of_chain(*each) if state.theta.ndim == 1 else jax.vmap(of_chain)(*each)


def _no_guides(population: Population, records: Records, state: RecordState) -> Guidance:
    """Return placeholders with the shapes of the guides."""
    completion = RecordPaths(population.parameters, unguided(records), unguided(records))
    shapes = jax.eval_shape(lambda state: _guides_of(completion, population, state), state)
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


def _params_of_units(
    population: Population, phi: Float[Array, "*chains n p"], units: Float[Array, "*chains n R q"]
) -> PyTree:
    """Return the parameters of each record, with leading axes (*chains, n, R), or `None`."""
    if not population.varies:
        return None
    full = eqx.filter_vmap(population.parameters.full)
    of_draw = eqx.filter_vmap(lambda phi, units: full(population.of_units(phi, units)))
    return (of_draw if phi.ndim == 2 else eqx.filter_vmap(of_draw))(phi, units)
