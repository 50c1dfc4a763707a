"""Paths of a record across gaps in which several ways are possible.

The states at the ends of segments are part of the chain, and bridges from any proposal join them.

A proposal of bridges is a path from a to b with a weight w such that
E[w h(path)] = p(b|a) E_bridge[h]. The same holds for the mean ŵ of several weights with one path
drawn in proportion to its weight. The state of the chain has the states x_k, and such a path with
its ŵ for each segment. The density

    π(x_0) Π_k ŵ_k g(y_k|x_k)

has the conditional law of states and paths given the record as a marginal (Andrieu & Roberts 2009).
States with even and with odd k move in turn, all of one kind at once. A new state x_k' with new
paths on both sides is accepted with probability

    min{1, ŵ'_left ŵ'_right g(y_k|x_k') q(x_k) / (ŵ_left ŵ_right g(y_k|x_k) q(x_k'))}.

Two kinds of proposals of x_k' alternate: a random walk, for which q cancels, and a normal law q,
the normal approximation of ν conditioned on the observation. Then each segment proposes a new path
between the same two states.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from ..coupling import Coupling, Stationary, with_start_law
from ..engine.averages import nan_to_neg_inf
from ..engine.checks import is_traced, nondifferentiable
from ..engine.compiled import compiled_sooner
from ..engine.keys import key_for
from ..engine.linalg import any_cholesky, any_inverse, dot, semidefinite_cholesky, solve_lower
from ..engine.progress import metered_scan
from ..exact import acceptance_rate
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion
from ..models.gaussian_law import GaussianLaw
from ..proposals import (
    AbstractProposal,
    AbstractWeightedProposal,
    Choice,
    best_at_worst,
    resolve,
)
from .guided_record import log_observation_densities
from .initial import bound
from .observations import Scalars
from .path_blocks import tuned
from .problem import RecordProblem
from .record import Record

# Number of draws of ν for the moments of q. The factor widens q, for tails that are not normal.
_NUM_DRAWS, _WIDER = 512, 1.3
# Number of pairs of states of each segment between which "auto" tries the methods.
_NUM_PILOTS = 6


class States(NamedTuple):
    """States of C chains.

    - `x`: states at the ends of segments.
    - `paths`: a path of each segment.
    - `log_weights`: log ŵ of each segment.
    - `num_truncated`: number of weights that were truncated so far.
    """

    x: Float[Array, "C ends d"]
    paths: Float[Array, "C K points d"]
    log_weights: Float[Array, "C K"]
    num_truncated: Int[Array, ""]


class Moved(NamedTuple):
    """Masks of the states and of the paths that moved in one iteration."""

    states: Bool[Array, "C ends"]
    paths: Bool[Array, "C K"]


class NormalLaws(NamedTuple):
    """Laws q of each state: means, and lower triangular roots of the covariances."""

    mean: Float[Array, "ends d"]
    root: Float[Array, "ends d d"]


class StateSampler(eqx.Module):
    """Quantities that are the same in all iterations.

    - `proposal`: for the intervals of all chains, the K segments of each chain in a row.
    - `movable`: whether a state is unknown. Only a first state given as a point is known.
    """

    problem: RecordProblem
    model: Diffusion
    proposal: AbstractWeightedProposal
    laws: NormalLaws
    scalars: Scalars
    movable: Bool[Array, " ends"]
    num_proposals: int = eqx.field(static=True)

    def log_target(self, x: Float[Array, "C ends d"]) -> Float[Array, "C ends"]:
        """Return log g(y_k|x_k). That of the first state includes the log density of its law."""
        problem = self.problem
        of_chain = lambda x: log_observation_densities(problem, problem.model, self.scalars, x)
        logs = jax.vmap(of_chain)(x)
        law = bound(problem.initial, problem.model)
        if isinstance(law, Stationary):
            logs = logs.at[:, 0].add(jax.vmap(self.model.log_stationary)(x[:, 0]))
        elif isinstance(law, GaussianLaw):
            logs = logs.at[:, 0].add(jax.vmap(law.log_density)(x[:, 0]))
        return nan_to_neg_inf(logs)

    def log_q(self, x: Float[Array, "C ends d"]) -> Float[Array, "C ends"]:
        """Return log q up to a constant."""

        def of_one(mean, root, x):
            white = solve_lower(root, x - mean)
            return -dot(white, white) / 2  # the normaliser cancels in acceptance ratios

        return jax.vmap(lambda x: jax.vmap(of_one)(*self.laws, x))(x)

    def paths(self, key: Key[Array, ""], x: Float[Array, "C ends d"]) -> States:
        """Sample new paths of all segments between these states."""
        draw_key, pick_key = jax.random.split(key)
        C, ends, d = x.shape
        num = C * (ends - 1)
        durations = jnp.tile(self.problem.record.durations, C)
        intervals = Intervals(x[:, :-1].reshape(num, d), x[:, 1:].reshape(num, d), durations)
        keys = jax.random.split(draw_key, (num, self.num_proposals))
        proposed = self.proposal.draw(
            keys, self.model, intervals, self.problem.num_steps, None, True
        )
        log_weights = nan_to_neg_inf(proposed.log_weights)
        picked = jax.random.categorical(pick_key, log_weights)
        paths = jnp.take_along_axis(proposed.paths, picked[:, None, None, None], axis=1)[:, 0]
        log_mean = jax.nn.logsumexp(log_weights, axis=1) - math.log(self.num_proposals)
        paths, log_mean = paths.reshape(C, ends - 1, -1, d), log_mean.reshape(C, ends - 1)
        return States(x, paths, log_mean, jnp.sum(proposed.truncated, dtype=jnp.int32))

    def move_states(
        self,
        key: Key[Array, ""],
        state: States,
        parity: int,
        walk: Bool[Array, ""],
        log_scales: Float[Array, " ends"],
    ) -> tuple[States, Bool[Array, "C ends"]]:
        """Move the states with even or odd k, together with the paths on both sides.

        **Returns:** the new states, and which of them moved.
        """
        noise_key, path_key, accept_key = jax.random.split(key, 3)
        x, (mean, root) = state.x, self.laws
        noise = jnp.einsum("kij,ckj->cki", root, jax.random.normal(noise_key, x.shape, x.dtype))
        proposed = jnp.where(walk, x + jnp.exp(log_scales)[:, None] * noise, mean + noise)
        # At most one end of each segment moves, so the decisions are independent.
        moving = self.movable & (np.arange(x.shape[1]) % 2 == parity)
        new = self.paths(path_key, jnp.where(moving[:, None], proposed, x))

        def of_states(state):
            beside = jnp.pad(state.log_weights, ((0, 0), (1, 1)))
            log_q = jnp.where(walk, 0, self.log_q(state.x))
            return beside[:, :-1] + beside[:, 1:] + self.log_target(state.x) - log_q

        rate = acceptance_rate(nan_to_neg_inf(of_states(state)), nan_to_neg_inf(of_states(new)))
        accepted = moving & (jax.random.uniform(accept_key, rate.shape, rate.dtype) < rate)
        beside = accepted[:, :-1] | accepted[:, 1:]
        return States(
            jnp.where(accepted[..., None], new.x, x),
            jnp.where(beside[..., None, None], new.paths, state.paths),
            jnp.where(beside, new.log_weights, state.log_weights),
            state.num_truncated + new.num_truncated,
        ), accepted

    def move_paths(self, key: Key[Array, ""], state: States) -> tuple[States, Bool[Array, "C K"]]:
        """Propose new paths between the same states.

        **Returns:** the new states, and which paths were accepted.
        """
        path_key, accept_key = jax.random.split(key)
        new = self.paths(path_key, state.x)
        rate = acceptance_rate(state.log_weights, new.log_weights)
        accepted = jax.random.uniform(accept_key, rate.shape, rate.dtype) < rate
        return States(
            state.x,
            jnp.where(accepted[..., None, None], new.paths, state.paths),
            jnp.where(accepted, new.log_weights, state.log_weights),
            state.num_truncated + new.num_truncated,
        ), accepted

    def sweep(
        self,
        key: Key[Array, ""],
        state: States,
        walk: Bool[Array, ""],
        log_scales: Float[Array, " ends"],
    ) -> tuple[States, Moved]:
        """Move the even states, then the odd states, then the paths."""
        even_key, odd_key, path_key = jax.random.split(key, 3)
        state, even = self.move_states(even_key, state, 0, walk, log_scales)
        state, odd = self.move_states(odd_key, state, 1, walk, log_scales)
        state, paths = self.move_paths(path_key, state)
        states = even | odd
        return state, Moved(states, paths | states[:, :-1] | states[:, 1:])


class Draws(NamedTuple):
    """Draws of paths of a whole record.

    - `since`: times of the points since the first time.
    - `paths`: draws of whole paths.
    - `accepted`: acceptance rate of each state or block.
    - `stuck`: whether a state, path or block of the chain never moved.
    - `num_truncated`: number of weights that were truncated.
    - `record`: the record on the grid of the paths.
    - `knots`: knots of the paths, if they are not the paths themselves.
    """

    since: Float[Array, " points"]
    paths: Float[Array, "n C points d"]
    accepted: Float[Array, "..."]
    stuck: Bool[Array, " C"]
    num_truncated: Int[Array, ""]
    record: Record
    knots: Float[Array, "n C points d"] | None = None


def sample_states(
    key: Key[Array, ""],
    problem: RecordProblem,
    proposal: AbstractProposal,
    guided: Float[Array, "C points d"],
    counts: tuple[int, int, int],
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> Draws:
    """Sample paths of a record by moving states and bridges, starting from guided paths.

    `counts` holds the number of draws, of iterations of the warm-up, and of paths in each ŵ.

    The arguments satisfy `check_states`.
    """
    model, K = problem.model, problem.num_segments
    scalars = problem.scalars(model)
    first = guided[:, :: problem.num_steps]
    durations = problem.record.durations
    intervals = Intervals(first[0, :-1], first[0, 1:], durations)
    pilot_key = key_for("states", key)
    laws = _normal_laws(pilot_key, problem, scalars, intervals)
    proposal = _prepare_proposal(pilot_key, problem, proposal, laws, first[0])
    proposal = proposal.of(np.tile(np.arange(K), len(guided)))  # the same proposal for all chains
    assert isinstance(proposal, AbstractWeightedProposal)
    point = not isinstance(bound(problem.initial, model), Stationary | GaussianLaw)
    movable = jnp.ones(K + 1, bool).at[0].set(not point)
    num_draws, num_warmup, num_proposals = counts
    model = nondifferentiable(model.prepared())
    sampler = StateSampler(problem, model, proposal, laws, scalars, movable, num_proposals)
    within = np.diff(proposal.fractions(problem.num_steps))
    dt = durations[:, None] * jnp.asarray(within, durations.dtype)
    record = dataclasses.replace(
        problem.record, dt=dt, lengths=tuple((problem.num_steps * within).tolist())
    )
    grid = record.grid()
    paths, moves, num_truncated = _run_state_chains(
        key, sampler, guided, (num_draws, num_warmup), progress_meter
    )
    all_moved = jnp.all(jnp.any(moves.states, axis=0) | ~movable, axis=1)
    all_moved &= jnp.all(jnp.any(moves.paths, axis=0), axis=1)
    accepted = jnp.mean(moves.states.astype(grid.dtype), axis=(0, 1))
    return Draws(grid, paths, accepted, ~all_moved, num_truncated, record)


def check_states(proposal: AbstractProposal, problem: RecordProblem) -> None:
    """Raise `ValueError` if states cannot move with this proposal.

    It must suit the model, the model needs a stationary law, and all observations need noise.
    """
    model, law = problem.model, bound(problem.initial, problem.model)
    scalars = problem.scalars(model)
    if model.depends_on_time or not model.sigma_is_invertible(problem.like):
        raise ValueError(
            "bridges of a `proposal` need coefficients that do not depend on time, and an "
            "invertible σ: leave out `proposal`, so that paths are guided by the whole record."
        )
    if not (model.has_sampler or model.has_density):
        raise ValueError(
            "a `proposal` needs the moments of the stationary law, for states at the times of "
            "observations: give `Diffusion` a `log_stationary` or `sample_stationary`, or leave "
            "out `proposal`, so that paths are guided by the whole record."
        )
    if proposal.coupled and not model.has_density:
        raise ValueError(
            "the weights of a coupling need the stationary density at the moving states: give "
            "`Diffusion` a `log_stationary` (up to a constant), or use a proposal that does not "
            "need it, such as `ModifiedDiffusionBridge()` or `Guided()`."
        )
    if not is_traced(scalars) and np.any(scalars.seen & (scalars.variances <= 0)):
        raise ValueError(
            "with a `proposal` every observed component must have noise, but `covariance` has "
            "variances of zero: give these a small variance, or leave out `proposal` for the "
            "default paths, which exact observations allow."
        )
    if isinstance(law, GaussianLaw) and not is_traced(law):
        if np.any(np.diagonal(semidefinite_cholesky(law.covariance)) == 0):
            raise ValueError(
                "with a `proposal` the first state must be a point or have a density, but the "
                "covariance of `initial` is singular: leave out `proposal` for the default "
                "paths, which allow it."
            )


def _prepare_proposal(
    key: Key[Array, ""],
    problem: RecordProblem,
    proposal: AbstractProposal,
    laws: NormalLaws,
    guided: Float[Array, "ends d"],
) -> AbstractProposal:
    """Prepare the proposal for the segments of one chain.

    "auto" tries the methods on each segment between several likely pairs of states. The best method
    within one well may be useless between two wells. States of a guided path replace those outside
    the state space.
    """
    model, num_steps, (ends, d) = problem.model, problem.num_steps, laws.mean.shape
    noise = jax.random.normal(key, (ends, _NUM_PILOTS, d), laws.mean.dtype)
    x = laws.mean[:, None] + jnp.einsum("kij,knj->kni", laws.root, noise)
    if (inside := model.state_space()) is not None:
        x = jnp.where(jax.vmap(jax.vmap(inside))(x)[..., None], x, guided[:, None])
    durations = jnp.repeat(problem.record.durations, _NUM_PILOTS)
    pilots = Intervals(x[:-1].reshape(-1, d), x[1:].reshape(-1, d), durations)
    one_each = jax.tree.map(lambda leaf: leaf[::_NUM_PILOTS], pilots)
    if proposal.is_open and not is_traced(key, model, pilots):
        proposal.check(model, pilots)
        choice = resolve(proposal, key, model, pilots, num_steps)
        return best_at_worst(choice, _NUM_PILOTS) if isinstance(choice, Choice) else choice
    proposal.check(model, one_each)
    return proposal.prepared(key, model.prepared(), one_each, num_steps)


def _normal_laws(
    key: Key[Array, ""], problem: RecordProblem, scalars: Scalars, intervals: Intervals
) -> NormalLaws:
    """Return q: the normal approximation of ν, conditioned on the observation under its guess."""
    model = problem.model.prepared()
    keys = jax.random.split(key, _NUM_DRAWS)
    if model.has_sampler:
        draws = jax.vmap(model.sample_stationary)(keys)
    else:
        with_law = with_start_law(
            key, model, Coupling(), intervals.end, intervals.duration, problem.num_steps
        )
        law: Any = with_law.start_law  # it has a density, and so a sampler
        draws = jax.vmap(lambda key: law.sample(key, model))(keys)
    draws = draws.astype(problem.like.dtype)
    mean, eye = jnp.mean(draws, axis=0), jnp.eye(problem.dim, dtype=draws.dtype)
    centred = draws - mean
    S = centred.T @ centred / _NUM_DRAWS
    # A small multiple of I keeps S invertible.
    S += 1e-6 * jnp.max(jnp.diagonal(S)) * eye
    before = any_inverse(S)

    def of_one(scalars):
        rows, residual = scalars.rows, scalars.values - scalars.rows @ mean
        scaled = jnp.where(scalars.seen, 1 / scalars.variances, 0)[:, None] * rows
        covariance = any_inverse(before + rows.T @ scaled)
        return mean + covariance @ (scaled.T @ residual), _WIDER * any_cholesky(covariance)

    return NormalLaws(*jax.vmap(of_one)(scalars))


@compiled_sooner
def _run_state_chains(
    key: Key[Array, ""],
    sampler: StateSampler,
    guided: Float[Array, "C points d"],
    counts: tuple[int, int],
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> tuple[Float[Array, "n C points d"], Moved, Int[Array, ""]]:
    """Run the chains; return the draws, the moves, and the number of truncated weights."""
    num_draws, num_warmup = counts
    N, (C, _, d), dtype = sampler.problem.num_steps, guided.shape, guided.dtype
    first_key, key = jax.random.split(key)

    def step(carry: tuple[States, Array], i: Int[Array, ""]):
        state, log_scales = carry
        # The random walk and the independent proposals alternate; only the walk is tuned.
        walk = i % 2 == 0
        state, moves = sampler.sweep(jax.random.fold_in(key, i), state, walk, log_scales)
        new_scales = tuned(log_scales, moves.states.T, (i // 2 + 1).astype(dtype))
        log_scales = jnp.where(walk & (i < num_warmup), new_scales, log_scales)
        path = state.paths[:, :, :-1].reshape(C, -1, d)
        return (state, log_scales), (jnp.concatenate([path, state.x[:, -1:]], axis=1), moves)

    state = sampler.paths(first_key, guided[:, ::N])
    # If no proposal became a bridge, the chain starts from the guided path with weight zero.
    within = jnp.arange(sampler.problem.num_segments)[:, None] * N + jnp.arange(N + 1)
    is_bridge = (state.log_weights > -jnp.inf)[..., None, None]
    state = state._replace(paths=jnp.where(is_bridge, state.paths, guided[:, within]))
    init = state, jnp.zeros(sampler.movable.shape, dtype)
    steps = jnp.arange(num_warmup + num_draws)
    (state, _), outputs = metered_scan(step, init, steps, progress_meter)
    paths, moves = jax.tree.map(lambda leaf: leaf[num_warmup:], outputs)
    return paths, moves, state.num_truncated
