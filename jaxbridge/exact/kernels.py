"""Common parts of the Markov chains on bridges: kernels, their keys, and the result `Chain`."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.averages import (
    PathFunction,
    align_axes,
    evaluate_on_paths,
    fill_missing_paths,
    normalise_weights,
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
from ..schemes import step_faults
from .exact_bridges import AbstractExactBridges

# With fewer moves neither the mean of the chain nor its error is reliable.
_FEWEST_MOVES = 5
_TOO_FEW_MOVES = (
    "The chain hardly moves, so its mean and its error depend on a few paths. Take more "
    '`num_bridges`, another proposal, or `method="crank_nicolson"`.'
)


class Kernel(NamedTuple):
    """Markov kernel on paths.

    Those of `pseudo_marginal`, `renewal` and `crank_nicolson` are for bridges, and that of
    `smoothing_kernel` is for paths given a record.

    It has the interface of the sampling algorithms of BlackJAX, so code for these can run it.

    - `init`: a function `(position, rng_key) -> state`.
    - `step`: a function `(rng_key, state) -> (state, info)`.
    """

    init: Callable
    step: Callable


class Chain(AbstractExactBridges):
    """Result of `sample_exact_bridges`: the states of a chain.

    With I intervals arrays have a leading axis I.

    - `times`: the K stored times, shape (K,); (I, K) for I durations.
    - `paths`: the states of the chain after each step, shape (n, K, d); NaN before the first path.
    - `accepted`: whether the step accepted a new path, shape (n,).
    - `log_weights`: log weights of the states, shape (n,); `None` for the renewal chain, which has
        none.
    - `met`: whether there is a path, shape (n,).
    - `truncated`: whether the weight of the state is truncated, as in `WeightedBridges`, shape
        (n,). Then this weight is biased, and the law of the chain is not exact. `None` for the
        renewal chain.
    - `num_simulated`: number of simulated paths, shape ().
    - `num_nonfinite`: number of these that left the state space or became non-finite, shape ().
        More than 2 % are a fault, because their mass is missing.
    - `num_truncated`: number of proposals, accepted or not, with truncated weights, shape (). The
        renewal chain has no weights. If its run that replaces a sampler of ν is too short (see
        `Stationary`), the number is n, else 0.
    - `proposal`: the proposal of the chain. If its start law `Stationary` needs runs, it contains
        their `burn_in`.
    - `pareto_k`: k̂ of the weights of all proposals, shape (). Above 0.7 the chain stays too long in
        states with large weights, and no error is reliable. `None` for renewal and Crank–Nicolson
        chains, which propose no independent weights.
    - `log_halving`: log of the factor by which half as many steps would change the weight of a
        state, shape (n,); NaN where it was not computed.
    - `coarse_paths`: the paths that the same noise gives with half as many steps, shape (n, K, d).
        Where none was simulated, the entry is the state itself. `None` if no coarse paths are
        needed.
    - `step_share`: the discretisation error divided by the change of the estimate under half as
        many steps; infinite if this change has no information about the error.
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
    coarse_paths: Float[Array, "*I n K d"] | None
    step_share: Float[Array, "*I"]
    num_steps: int = eqx.field(static=True)

    @property
    def acceptance_rate(self) -> Float[Array, "*I"]:
        """Return the share of steps that accepted a new path."""
        return jnp.mean(self.accepted, axis=-1)

    @property
    def log_mean_weights(self) -> Float[Array, "*I n"]:
        """Return zero for each state with a path, because all have the same weight; else -inf."""
        return jnp.where(self.met, 0.0, -jnp.inf).astype(self.paths.dtype)

    @property
    def verdict(self) -> Verdict:
        """Return the possible faults, as a `Verdict`:

        - missing bridges;
        - truncated weights, or weights with heavy tails;
        - more than 2 % of the paths lost;
        - a chain with fewer than five accepted paths (fewer still if it has less than nine steps);
        - a discretisation error of the mean path that is unknown or too uncertain, or that
            dominates and exceeds 0.05 standard deviations;
        - a mean path that is not finite.
        """
        moves = jnp.sum(self.accepted, axis=-1)
        # The renewal chain has no weights, but its trials may start from a wrong law.
        is_truncated = self.num_truncated > 0
        if self.truncated is not None:
            is_truncated = jnp.any(self.truncated, axis=-1)
        # A chain has no effective sample size of weights, so only k̂ decides.
        heavy = () if self.pareto_k is None else heavy_tails(self.pareto_k)
        # The number of moves bounds the effective sample size from above.
        error = 1 / jnp.sqrt(jnp.maximum(moves, 1).astype(self.paths.dtype))
        return Verdict(
            (
                missing_bridges(jnp.any(~self.met, axis=-1), self.proposal.coupled),
                truncated_weights(is_truncated),
                lost_paths(self.num_nonfinite, self.num_simulated),
                *heavy,
                Fault(
                    moves < min(_FEWEST_MOVES, (self.accepted.shape[-1] + 1) // 2), _TOO_FEW_MOVES
                ),
                *step_faults(self.step_error_in_sds(), error, coupled=self.proposal.coupled),
            )
        ).with_finite(self.mean())

    def standard_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the standard error of `mean(fn)`, entry by entry.

        It uses the effective sample size of the chain, which needs at least four states.
        """
        weights, axis = normalise_weights(self.log_mean_weights), self.met.ndim - 1
        size = effective_sample_size
        # With several intervals the chains are independent: one sample size for each.
        for _ in range(axis):
            size = jax.vmap(size)

        def error(value):
            deviation = value - jnp.expand_dims(weighted_mean(weights, value), axis)
            has_path = align_axes(self.met, value)
            # States without a path carry no information, so they reduce the sample size.
            share = jnp.mean(has_path, axis=axis, dtype=value.dtype)
            sample_size = size(jnp.where(has_path, deviation, 0)) * share
            return jnp.sqrt(weighted_mean(weights, deviation**2) / sample_size)

        return jax.tree.map(error, evaluate_on_paths(fn, fill_missing_paths(self.paths, self.met)))


def acceptance_rate(
    log_weight: Float[Array, "*I"], candidate: Float[Array, "*I"]
) -> Float[Array, "*I"]:
    """Return min(1, ratio of the weights), shape (I,).

    It is zero if the candidate is missing (log weight -inf), and one if only the state is missing.
    """
    # Both weights may be zero: -inf - (-inf) would be NaN.
    ratio = jnp.where(candidate > -jnp.inf, candidate - log_weight, -jnp.inf)
    return jnp.exp(jnp.minimum(ratio, 0))


def chain_keys(
    key: Key[Array, ""], problem: BridgeProblem, num_bridges: int
) -> tuple[Key[Array, "I n"], Key[Array, " I"]]:
    """Return the keys of the steps, and of the first state, of the chain of each interval."""
    # A single interval uses the key itself, so that a kernel with the same keys gives this chain.
    keys = problem.keys(key, 1)[:, 0] if problem.batched else key[None]
    run_keys, init_keys = split_each(keys, 2)
    return jax.vmap(lambda key: jax.random.split(key, num_bridges))(run_keys), init_keys


def one_interval(
    model: Diffusion, start: Numbers, end: Numbers, duration: Numbers, num_steps: int
) -> BridgeProblem:
    """Check the arguments of a kernel. Return its problem.

    **Raises:** `ValueError` for several intervals, among other invalid arguments.
    """
    problem = bridge_problem(model, start, end, duration, num_steps)
    if problem.batched:
        raise ValueError(
            "a kernel is for one interval: `start` and `end` of shape (d,), `duration` of shape "
            f"(); got arguments with an axis I = {problem.num_intervals}. Use `jax.vmap`, or "
            "`sample_exact_bridges`, for several intervals."
        )
    return problem


def check_position(
    position: Numbers | None, problem: BridgeProblem
) -> Float[Array, "I points d"] | None:
    """Check the initial paths. Return them with an axis I, or `None` for `None`.

    **Raises:** `ValueError` for a wrong shape, for paths that are not finite, or for wrong end
    points.
    """
    if position is None:
        return None
    path, intervals = as_floating("position", position), problem.intervals
    num_intervals, d = intervals.start.shape
    shape = (num_intervals, problem.num_steps + 1, d)
    required_shape = shape if problem.batched else shape[1:]
    if path.shape != required_shape:
        expected = "paths, one of each interval" if problem.batched else "a path"
        raise ValueError(
            f"`position` must be {expected}, shape {required_shape}, or `None`; got shape "
            f"{path.shape}."
        )
    paths = path.reshape(shape)
    if not is_traced(paths, intervals):
        ends = np.stack([intervals.start, intervals.end], axis=1)
        # The tolerance allows for paths in single precision.
        values = np.asarray(paths)
        if not (np.all(np.isfinite(values)) and np.allclose(values[:, [0, -1]], ends, atol=1e-3)):
            raise ValueError(
                f"`position` must be finite, with the end points {problem.result(ends)}; got the "
                f"end points {problem.result(values[:, [0, -1]])}, or a value that is not finite. "
                "Pass a path of this bridge."
            )
    return paths.astype(intervals.start.dtype)
