"""Stochastic approximation of the maximum likelihood estimate, with new bridges in each iteration.

In each iteration the exact kernel at the current θ moves the bridges once (Gu & Kong 1998). Then θ
moves by the completed path:

- "gradient": an optimiser makes a step along ∇ log f_θ(Z), whose mean over bridges is the score.
- "em": log f is expanded at θ as cᵀθ - ½ θᵀPθ, and c and P are averaged over the iterations. The
  new θ is P⁻¹c. For a drift linear in θ this is the EM algorithm with averaged statistics (Delyon,
  Lavielle & Moulines 1999). In every case a fixed point has score zero.
"""

from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

from ..engine.checks import all_finite_leaves, nondifferentiable
from ..engine.compiled import compiled_sooner
from ..engine.linalg import any_solve
from ..engine.progress import metered_scan
from .augmentation import Augmentation
from .parameter_kernels import CompleteData
from .parameters import Parameters


class SearchInfo(NamedTuple):
    """Numbers of missing bridges, truncated weights, and iterations without a step of θ."""

    missing: Int[Array, "*n"]
    truncated: Int[Array, "*n"]
    refused: Int[Array, "*n"]


class Gradient(eqx.Module):
    """Rule that moves θ by steps of an optimiser along the gradient of the log-likelihood."""

    optimizer: optax.GradientTransformation = eqx.field(static=True)

    def init(self, theta: Float[Array, " p"]) -> PyTree:
        return self.optimizer.init(theta)

    def ascend(
        self, theta: Float[Array, " p"], memory: PyTree, gradient: Float[Array, " p"]
    ) -> tuple[Float[Array, " p"], PyTree]:
        """Return θ and the optimiser's state after one step.

        `gradient` is that of the mean log-likelihood per interval.
        """
        # Optimisers of optax minimise, hence the sign.
        updates, memory = self.optimizer.update(-gradient, memory, theta)
        return theta + jnp.asarray(updates), memory

    def update(
        self, i: Int[Array, ""], theta: Float[Array, " p"], memory: PyTree, data: CompleteData
    ) -> tuple[Float[Array, " p"], PyTree]:
        # Per interval, so that one learning rate suits data of all sizes.
        gradient = jax.grad(data.log_likelihood)(theta) / data.augmentation.num_intervals
        return self.ascend(theta, memory, gradient)


class EM(eqx.Module):
    """Rule that moves θ to the maximum of averaged expansions of the log-likelihood.

    The average is weighted towards the later iterations, about the second half.
    """

    def init(self, theta: Float[Array, " p"]) -> PyTree:
        return theta, jnp.zeros((*theta.shape, *theta.shape), theta.dtype)

    def update(
        self, i: Int[Array, ""], theta: Float[Array, " p"], memory: PyTree, data: CompleteData
    ) -> tuple[Float[Array, " p"], PyTree]:
        gradient = jax.grad(data.log_likelihood)(theta)
        P = data.information(theta)
        expansion = gradient + P @ theta, P  # c and P of cᵀθ - ½ θᵀPθ
        # Weights 2 / i give an average over about the second half of the iterations.
        gain = jnp.minimum(1.0, 2.0 / (i + 1).astype(theta.dtype))
        memory = jax.tree.map(lambda old, new: old + gain * (new - old), memory, expansion)
        c, P = memory
        return any_solve(P, c), memory


class Search(NamedTuple):
    """Settings of a search: the rule that moves θ, the number of iterations, the meter."""

    rule: Gradient | EM
    num_iterations: int
    progress_meter: diffrax.AbstractProgressMeter | None


@compiled_sooner
def approximate(
    key: Key[Array, ""],
    parameters: Parameters,
    augmentation: Augmentation,
    search: Search,
    theta: Float[Array, " p"],
) -> tuple[Float[Array, "n p"], SearchInfo]:
    """Return the iterates of the stochastic approximation over bridges, and failure counts."""
    parameters, augmentation = nondifferentiable((parameters, augmentation))
    first_key, run_key = jax.random.split(key)

    def propose(i, theta, memory, paths):
        bridge_key = jax.random.fold_in(run_key, i)
        paths, bridges = augmentation.renew(bridge_key, parameters.bind(theta), paths)
        data = CompleteData(parameters, augmentation, paths, jnp.zeros_like)
        updated = search.rule.update(i, theta, memory, data)
        return updated, paths, (bridges.missing, bridges.truncated)

    # Placeholders are allowed: the first iterations replace them.
    first, _ = augmentation.first(first_key, parameters.bind(theta))
    iterates, _, info = iterate(propose, parameters, search, theta, first)
    return iterates, info


def iterate(
    propose: Callable,
    parameters: Parameters,
    search: Search,
    theta: Float[Array, " p"],
    paths: PyTree,
) -> tuple[Float[Array, "n p"], PyTree, SearchInfo]:
    """Iterate `propose` from θ and paths; return the iterates, the last paths and the counts.

    `propose(i, θ, memory, paths)` returns ((θ, memory), paths, (missing, truncated)). The memory
    is the state of the rule. θ does not move if the new θ violates the constraint or if the new θ
    or memory is not finite.
    """

    def step(state, i):
        theta, memory, paths = state
        (new_theta, new_memory), paths, (missing, truncated) = propose(i, theta, memory, paths)
        finite = all_finite_leaves(new_memory)
        ok = parameters.allowed(new_theta) & finite
        theta = jnp.where(ok, new_theta, theta)
        # A memory with NaN would spoil all later steps.
        memory = jax.tree.map(lambda new, old: jnp.where(finite, new, old), new_memory, memory)
        info = _counted(SearchInfo(missing, truncated, ~ok))
        return (theta, memory, paths), (theta, info)

    start, steps = (theta, search.rule.init(theta), paths), jnp.arange(search.num_iterations)
    last, (iterates, info) = metered_scan(step, start, steps, search.progress_meter)
    return iterates, last[2], _counted(info)


def _counted(info: SearchInfo) -> SearchInfo:
    return jax.tree.map(lambda leaf: jnp.sum(leaf, dtype=jnp.int32), info)
