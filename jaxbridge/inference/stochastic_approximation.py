"""Stochastic approximation of the maximum likelihood estimate, with new bridges in each iteration.

In each iteration the exact kernel at the current θ moves the bridges once (Gu & Kong 1998). Then θ
moves by the completed path:

- "gradient": an optimiser makes a step along ∇ log f_θ(Z), whose mean over bridges is the score.
- "em": let log f = cᵀθ - ½ θᵀPθ be the expansion at θ, with c and P averaged over iterations. The
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
    """Bridges that were not found, weights that were cut off, and steps that were not made."""

    missing: Int[Array, "*n"]
    truncated: Int[Array, "*n"]
    refused: Int[Array, "*n"]


class Gradient(eqx.Module):
    """Steps of an optimiser."""

    optimizer: optax.GradientTransformation = eqx.field(static=True)

    def init(self, theta: Float[Array, " p"]) -> PyTree:
        return self.optimizer.init(theta)

    def ascend(
        self, theta: Float[Array, " p"], memory: PyTree, gradient: Float[Array, " p"]
    ) -> tuple[Float[Array, " p"], PyTree]:
        """θ after a step along the gradient of the mean log likelihood per interval."""
        updates, memory = self.optimizer.update(-gradient, memory, theta)
        return theta + jnp.asarray(updates), memory

    def update(
        self, i: Int[Array, ""], theta: Float[Array, " p"], memory: PyTree, data: CompleteData
    ) -> tuple[Float[Array, " p"], PyTree]:
        gradient = jax.grad(data.log_likelihood)(theta) / data.augmentation.num_intervals
        return self.ascend(theta, memory, gradient)


class EM(eqx.Module):
    """The maximum of the averaged expansions of the log likelihood; they are averaged over the
    later half of the iterations so far, about."""

    def init(self, theta: Float[Array, " p"]) -> PyTree:
        return theta, jnp.zeros((*theta.shape, *theta.shape), theta.dtype)

    def update(
        self, i: Int[Array, ""], theta: Float[Array, " p"], memory: PyTree, data: CompleteData
    ) -> tuple[Float[Array, " p"], PyTree]:
        gradient = jax.grad(data.log_likelihood)(theta)
        P = data.information(theta)
        made = gradient + P @ theta, P
        gain = jnp.minimum(1.0, 2.0 / (i + 1).astype(theta.dtype))
        memory = jax.tree.map(lambda old, new: old + gain * (new - old), memory, made)
        c, P = memory
        return any_solve(P, c), memory


class Search(NamedTuple):
    """How θ is moved, how often, and who is told."""

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
    """The iterates by a rule over bridges, and what was lost on the way."""
    parameters, augmentation = nondifferentiable((parameters, augmentation))
    first_key, run_key = jax.random.split(key)

    def propose(i, theta, memory, paths):
        bridge_key = jax.random.fold_in(run_key, i)
        paths, bridges = augmentation.renew(bridge_key, parameters.bind(theta), paths)
        data = CompleteData(parameters, augmentation, paths, jnp.zeros_like)
        moved = search.rule.update(i, theta, memory, data)
        return moved, paths, (bridges.missing, bridges.truncated)

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
    """The iterates from θ and paths, and the last paths. `propose(i, θ, memory, paths)` makes
    ((θ, memory), paths, what was missing and truncated), with what the rule remembers; θ stays
    where that leads out of the constraint, or to what is not finite."""

    def step(state, i):
        theta, memory, paths = state
        (new_theta, new_memory), paths, (missing, truncated) = propose(i, theta, memory, paths)
        finite = all_finite_leaves(new_memory)
        ok = parameters.allowed(new_theta) & finite
        theta = jnp.where(ok, new_theta, theta)
        # What an optimiser remembers must not be spoilt for all steps to come.
        memory = jax.tree.map(lambda new, old: jnp.where(finite, new, old), new_memory, memory)
        info = _counted(SearchInfo(missing, truncated, ~ok))
        return (theta, memory, paths), (theta, info)

    start, steps = (theta, search.rule.init(theta), paths), jnp.arange(search.num_iterations)
    last, (iterates, info) = metered_scan(step, start, steps, search.progress_meter)
    return iterates, last[2], _counted(info)


def _counted(info: SearchInfo) -> SearchInfo:
    return jax.tree.map(lambda leaf: jnp.sum(leaf, dtype=jnp.int32), info)
