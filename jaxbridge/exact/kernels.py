"""What the Markov chains on bridges have in common: kernels of two functions, their keys, and the
chain that many steps make."""

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.averages import (
    PathFunction,
    expanded,
    filled,
    normalised,
    values_of,
    weighted_mean,
)
from ..engine.checks import Numbers, as_floating, is_traced
from ..engine.diagnostics import effective_sample_size
from ..engine.keys import split_each
from ..engine.verdict import (
    Fault,
    Verdict,
    heavy_tails,
    lost_paths,
    missing_bridges,
    truncated_weights,
)
from ..models.bridge_problem import BridgeProblem, bridge_problem
from ..models.diffusion import Diffusion
from ..proposals import AbstractWeightedProposal
from ..schemes import step_fault
from .exact_bridges import AbstractExactBridges

# Of fewer moves a mean, and its error, mean nothing.
_FEWEST_MOVES = 5
_STILL = (
    "The chain hardly moves, so that its mean and its error rest on a few paths. Take more "
    '`num_bridges`, another proposal, or `method="crank_nicolson"`.'
)


class Kernel(NamedTuple):
    """A Markov kernel on bridges, from `pseudo_marginal`, `renewal` or `crank_nicolson`. Runners
    that look for its two functions, such as BlackJAX's, take it as it is.

    - `init`: a function `(position, rng_key) -> state`.
    - `step`: a function `(rng_key, state) -> (state, info)`.
    """

    init: Callable
    step: Callable


class Chain(AbstractExactBridges):
    """What `sample_exact_bridges` returns: the states of a chain. With I intervals arrays have a
    leading axis I.

    - `times`: the K stored times, shape (K,); (I, K) for I durations.
    - `paths`: the states of the chain after each step, shape (n, K, d); NaN until a first path
        was found.
    - `accepted`: whether the step took a new path, shape (n,).
    - `log_weights`: those of the states, shape (n,); `None` for the renewal chain, which has none.
    - `met`: whether there is a path, shape (n,).
    - `truncated`: whether the state's counts were cut off by `max_trials`: then it has too
        little weight, and the chain's law is not exact. Shape (n,), or `None` as `log_weights`.
    - `num_simulated`: paths simulated in all, shape ().
    - `num_nonfinite`: how many of them left the state space or the finite numbers; of more than
        2 % the mass that is missing is a fault.
    - `num_truncated`: how many proposals, accepted or not, had counts cut off; for the renewal
        chain all its steps where the run that replaces a sampler of ν was (see `Stationary`).
    - `proposal`: what proposed; a `Stationary` that had to be run has its `burn_in` in it.
    - `pareto_k`: k̂ of the weights of all proposals: above 0.7 states with large weights stay too
        long for any error to be trusted. `None` where no new weights are proposed, as by renewal
        and Crank–Nicolson moves.
    - `log_halving`: log of the factor by which half as many steps would change the weight of a
        state, NaN where none was worked out; and `step_share`, the step error as a share of what
        that changes.
    - `num_steps`: N.
    """

    times: Float[Array, "*durations K"]
    paths: Float[Array, "*I n K d"]
    accepted: Bool[Array, "*I n"]
    log_weights: Float[Array, "*I n"] | None
    met: Bool[Array, "*I n"]
    truncated: Bool[Array, "*I n"] | None
    num_simulated: Int[Array, "*I"]
    num_nonfinite: Int[Array, "*I"]
    num_truncated: Int[Array, "*I"]
    proposal: AbstractWeightedProposal
    pareto_k: Float[Array, "*I"] | None
    log_halving: Float[Array, "*I n"]
    step_share: Float[Array, "*I"]
    num_steps: int = eqx.field(static=True)

    @property
    def acceptance_rate(self) -> Float[Array, "*I"]:
        """The share of steps that took a new path."""
        return jnp.mean(self.accepted, axis=-1)

    @property
    def log_mean_weights(self) -> Float[Array, "*I n"]:
        """All states count alike."""
        return jnp.where(self.met, 0.0, -jnp.inf).astype(self.paths.dtype)

    @property
    def verdict(self) -> Verdict:
        """Return the faults: missing bridges, weights cut off or with heavy tails, more than 2 % of
        the paths lost, a chain that hardly moves, a step error of the mean path that dominates and
        is beyond 0.05 standard deviations."""
        moves = jnp.sum(self.accepted, axis=-1)
        # The renewal chain keeps no weights to be cut off, but its trials may start wrongly.
        cut = self.num_truncated > 0
        if self.truncated is not None:
            cut = jnp.any(self.truncated, axis=-1)
        heavy = () if self.pareto_k is None else (heavy_tails(self.pareto_k, math.inf),)
        # Each move is a new path at best.
        error = 1 / jnp.sqrt(jnp.maximum(moves, 1).astype(self.paths.dtype))
        return Verdict(
            (
                missing_bridges(jnp.any(~self.met, axis=-1), self.proposal.coupled),
                truncated_weights(cut),
                lost_paths(self.num_nonfinite, self.num_simulated),
                *heavy,
                Fault(moves < min(_FEWEST_MOVES, (self.accepted.shape[-1] + 1) // 2), _STILL),
                step_fault(self.step_error_in_sds(), error),
            )
        ).with_finite(self.mean())

    def standard_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """That of `mean(fn)`, from the effective sample size of the chain, of at least four states,
        entry by entry."""
        weights, axis = normalised(self.log_mean_weights), self.met.ndim - 1
        size = effective_sample_size
        for _ in range(axis):
            size = jax.vmap(size)

        def error(value):
            deviation = value - jnp.expand_dims(weighted_mean(weights, value), axis)
            there = expanded(self.met, value)
            share = jnp.mean(there, axis=axis, dtype=value.dtype)
            many = size(jnp.where(there, deviation, 0)) * share
            return jnp.sqrt(weighted_mean(weights, deviation**2) / many)

        return jax.tree.map(error, values_of(fn, filled(self.paths, self.met)))


def acceptance_rate(
    log_weight: Float[Array, "*I"], candidate: Float[Array, "*I"]
) -> Float[Array, "*I"]:
    """min(1, ratio of the weights); a missing candidate is refused, a missing state left."""
    ratio = jnp.where(candidate > -jnp.inf, candidate - log_weight, -jnp.inf)
    return jnp.exp(jnp.minimum(ratio, 0))


def chain_keys(
    key: Key[Array, ""], problem: BridgeProblem, num_bridges: int
) -> tuple[Key[Array, "I n"], Key[Array, " I"]]:
    """The keys of the steps and of the first state of each interval's chain."""
    keys = problem.keys(key, 1)[:, 0] if problem.batched else key[None]
    run_keys, init_keys = split_each(keys, 2)
    return jax.vmap(lambda key: jax.random.split(key, num_bridges))(run_keys), init_keys


def one_interval(
    model: Diffusion, start: Numbers, end: Numbers, duration: Numbers, num_steps: int
) -> BridgeProblem:
    """The problem of a kernel."""
    problem = bridge_problem(model, start, end, duration, num_steps)
    if problem.batched:
        raise ValueError(
            "a kernel is for one interval: `start` and `end` of shape (d,), `duration` (); use "
            "`jax.vmap`, or `sample_exact_bridges`, for several."
        )
    return problem


def check_position(
    position: Numbers | None, problem: BridgeProblem
) -> Float[Array, "I points d"] | None:
    """A path of each interval, or none."""
    if position is None:
        return None
    path, intervals = as_floating("position", position), problem.intervals
    num_intervals, d = intervals.start.shape
    shape = (num_intervals, problem.num_steps + 1, d)
    wanted = shape if problem.batched else shape[1:]
    if path.shape != wanted:
        what = "paths, one of each interval" if problem.batched else "a path"
        raise ValueError(f"`position` must be {what}, shape {wanted}, or `None`; got {path.shape}.")
    paths = path.reshape(shape)
    if not is_traced(paths, intervals):
        ends = np.stack([intervals.start, intervals.end], axis=1)
        mine = np.asarray(paths)
        if not (np.all(np.isfinite(mine)) and np.allclose(mine[:, [0, -1]], ends, atol=1e-3)):
            raise ValueError(f"`position` must be finite, from and to {problem.result(ends)}.")
    return paths.astype(intervals.start.dtype)
