"""Data augmentation: completion of the observations by bridges.

Given θ the bridges of all intervals are independent, and a separate Markov kernel renews each of
them (`bridge_kernels`). Given the bridges the log-likelihood of θ is that of the completed path. It
is quadratic in θ if the drift is linear in θ. The module detects this case by tracing the Hessian:
the traced program then does not use θ.
"""

import math
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from ..coupling import AbstractCoupling
from ..engine.arguments import check_choice
from ..engine.checks import is_traced
from ..engine.keys import split_each
from ..models.diffusion import Diffusion
from ..models.tracing import uses_argument
from ..proposals import (
    AbstractWeightedProposal,
    Budget,
    ModifiedDiffusionBridge,
    ProposalLike,
    as_pairs,
)
from ..schemes import (
    MOST_TOO_LONG,
    UNKNOWN_SHARE,
    EulerDensity,
    Form,
    log_likelihoods,
    share_in_regime,
)
from .blocks import Block, Use, make_blocks, target_forms, with_keys
from .bridge_kernels import AbstractBridgeKernel, BridgeInfo, ByRenewal, ByWeights, Unweighted
from .data import Problem

# One array of shape (I, N+1, d) for each block.
Paths = tuple[Float[Array, "_ _ d"], ...]


class Augmentation(eqx.Module):
    """Data augmentation by bridges of all intervals.

    - `blocks`, `kernels`: blocks of intervals with the same number of steps, and a bridge kernel
      for each block.
    - `form`: form of the likelihood of the paths.
    - `is_quadratic`: whether the log-likelihood is quadratic in θ.
    """

    blocks: tuple[Block, ...]
    kernels: tuple[AbstractBridgeKernel, ...]
    form: Form = eqx.field(static=True)
    is_quadratic: bool = eqx.field(static=True)

    @property
    def like(self) -> Float[Array, " d"]:
        """Return a point of the state space. Only its shape and dtype are used."""
        return self.blocks[0].problem.like

    @property
    def num_intervals(self) -> int:
        return sum(len(block.index) for block in self.blocks)

    def check_paths(self, paths: tuple[Float[Array, "..."], ...], chains: tuple[int, ...]) -> None:
        """Raise `ValueError` unless these are paths between the observations.

        `chains` is the leading shape of the paths, () or (number of chains,).
        """
        expected = [
            (*chains, len(block.index), block.num_steps + 1, block.intervals.start.shape[1])
            for block in self.blocks
        ]
        shapes = [array.shape for array in paths]
        if shapes != expected:
            raise ValueError(
                f"`init` is a state with paths of shapes {shapes}, but these observations and "
                f"numbers of steps need {expected}: pass the same observations and `num_steps` as "
                "before, or unknown parameters as `init`."
            )
        for block, array in zip(self.blocks, paths, strict=True):
            ends = (block.intervals.start, block.intervals.end)
            for end, point in zip(ends, (array[..., 0, :], array[..., -1, :]), strict=True):
                # Traced ends cannot be compared. Ends may differ from the observations by rounding.
                if is_traced(end, point):
                    continue
                rounding = 1e-6 * float(np.max(np.abs(end)))
                if not np.allclose(point, end, atol=rounding, rtol=1e-4):
                    raise ValueError(
                        "`init` is a state of other data: its paths do not start and end at these "
                        "observations. Pass the same observations as before, or unknown "
                        "parameters as `init`."
                    )

    def first(self, key: Key[Array, ""], model: Diffusion) -> tuple[Paths, Bool[Array, " I"]]:
        """Sample initial paths; return them, and whether the proposal found each, in block order.

        An interval without a bridge gets a placeholder, because a chain may start from any path. If
        a proposal of the block is a coupling (inside `jit`: if a candidate is one), the placeholder
        is a modified diffusion bridge. Otherwise, or if that is not finite, it is a straight line.
        """
        model = model.prepared()

        def of_block(block, kernel, keys):
            intervals, num_steps = block.intervals, block.num_steps
            found_keys, other_keys = split_each(keys, 2)
            proposed = kernel.first(found_keys, model, intervals, num_steps)
            preferred = [proposed]
            if block.proposal.coupled:
                other = ModifiedDiffusionBridge(EulerDensity()).draw(
                    other_keys[:, None], model, intervals, num_steps, None, False
                )
                preferred = [other.paths[:, 0], proposed]
            # Elapsed fraction of the interval at each point.
            done = jnp.concatenate([jnp.zeros(1), jnp.cumsum(block.fractions)]).astype(
                proposed.dtype
            )
            start, end = intervals.start[:, None], intervals.end[:, None]
            path = start + done[:, None] * (end - start)
            for candidate in preferred:  # the last finite one is used
                path = jnp.where(is_complete(candidate)[:, None, None], candidate, path)
            return path, is_complete(proposed)

        paths, found = zip(*map(of_block, self.blocks, self.kernels, self._keys(key)), strict=True)
        return paths, jnp.concatenate(found)

    def renew(
        self, key: Key[Array, ""], model: Diffusion, paths: Paths
    ) -> tuple[Paths, BridgeInfo]:
        """Return the paths after one step of each bridge kernel, at the parameters of `model`."""
        model = model.prepared()

        def of_block(block, kernel, keys, current):
            return kernel.renew(keys, model, block.intervals, current)

        results = map(of_block, self.blocks, self.kernels, self._keys(key), paths)
        paths, infos = zip(*results, strict=True)
        return paths, jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *infos)

    def log_likelihood(self, model: Diffusion, paths: Paths) -> Float[Array, ""]:
        """Return the log-likelihood of all paths."""

        def of_block(block, array):
            return log_likelihoods(model, block.steps, array, self.form)

        return jnp.sum(jnp.concatenate(list(map(of_block, self.blocks, paths))))

    def log_step_error(self, model: Diffusion, paths: Paths) -> Float[Array, ""]:
        """Estimate the discretisation error of log L(θ) by a function of the paths.

        Its mean given θ is the error. With half as many steps a path is e^D times as likely
        (`halving`), so log p of an interval changes by log E[e^D], to leading order E[D + ½ D²].
        The error is a fixed share of this change. It is infinite if steps are too long for the
        drift in more than 2 % of the intervals.
        """
        model, form = model.prepared(), self.form

        def of_block(block, array):
            halvings = block.log_halvings(model, array, form)
            share = block.step_shares(model, form)
            # Where a step exceeds the relaxation time of the drift, the leading term means nothing.
            in_regime = share_in_regime(share, model, block.intervals, block.num_steps)
            # D² has the same order as the mean of D. E[e^D - 1] is no alternative: it is about -1
            # for steps that are far too long, which would hide the error.
            error = jnp.sum(share * (halvings + halvings**2 / 2))
            return error, jnp.sum(in_regime == UNKNOWN_SHARE)

        errors, too_long = zip(*map(of_block, self.blocks, paths), strict=True)
        hopeless = sum(too_long) > math.floor(MOST_TOO_LONG * self.num_intervals)
        return jnp.where(hopeless, jnp.inf, sum(errors))

    def points(self, paths: Paths) -> tuple[Float[Array, "points d"], Float[Array, " points"]]:
        """Return the points of all paths without the last ones, and the step sizes after them."""
        points = [array[:, :-1].reshape(-1, array.shape[-1]) for array in paths]
        steps = [block.steps.T.reshape(-1) for block in self.blocks]
        return jnp.concatenate(points), jnp.concatenate(steps)

    def _keys(self, key: Key[Array, ""]) -> list[Key[Array, " I"]]:
        return [
            jax.random.split(key, len(block.index)) for key, block in with_keys(key, self.blocks)
        ]


def is_complete(paths: Float[Array, "I points d"]) -> Bool[Array, " I"]:
    """Return whether each path exists: missing paths are NaN."""
    return jnp.all(jnp.isfinite(paths), axis=(1, 2))


def augment(
    key: Key[Array, ""],
    problem: Problem,
    theta: Float[Array, " p"],
    proposal: ProposalLike,
    bridges: Literal["exact", "approximate"],
    method: Literal["pseudo_marginal", "renewal"] | None,
    budget: Budget,
) -> Augmentation:
    """Build the data augmentation. Pilot runs and burn-ins use this θ.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.
    """
    check_choice("bridges", bridges, ("exact", "approximate"))
    if method is not None:
        check_choice("method", method, ("pseudo_marginal", "renewal"))
    if bridges == "approximate" and method is not None:
        raise ValueError('`method` is for exact bridges: omit it with `bridges="approximate"`.')
    use = "weights" if bridges == "exact" else "approximate"
    if method == "renewal":
        use = "renewal"
    if proposal is None and use == "weights" and method is None:
        proposal = "auto"
    # Renewal and approximate bridges use pairs without hitting counts as weights.
    by_pairs = method is None and isinstance(proposal, AbstractCoupling)
    if use != "weights" or by_pairs:
        reason = (
            "only weights use hitting counts, but here bridges are approximate, or come from the "
            'renewal chain of a coupling (`gibbs` also has `method="pseudo_marginal"`)'
        )
        budget._replace(max_proposals=None).refuse(reason)
    model = problem.parameters.bind(theta)
    blocks = make_blocks(key, model, problem, proposal, budget, use)
    kernels = tuple(_kernel(block.proposal, use, method) for block in blocks)
    forms = target_forms(blocks, model)
    quadratic = _quadratic_form(problem, theta, forms)
    return Augmentation(blocks, kernels, quadratic or forms[0], quadratic is not None)


def _kernel(
    proposal: AbstractWeightedProposal, use: Use, method: str | None
) -> AbstractBridgeKernel:
    if use == "approximate":
        return Unweighted(as_pairs(proposal))
    # The default for a coupling: the renewal kernel stores no weight.
    if use == "renewal" or (method is None and proposal.by_coupling is not None):
        return ByRenewal(as_pairs(proposal))
    return ByWeights(proposal)


def _quadratic_form(
    problem: Problem, theta: Float[Array, " p"], forms: Sequence[Form]
) -> Form | None:
    """Return the first form in which the log-likelihood is quadratic in θ, or `None`."""
    like, parameters = problem.like, problem.parameters
    for form in forms:

        def log_likelihood(theta, form: Form = form):
            # One step suffices: dependence on θ is a property of the program, not of its numbers.
            steps, paths = jnp.ones((1, 1), like.dtype), jnp.stack([like, like])[None]
            return log_likelihoods(parameters.bind(theta), steps, paths, form)[0]

        if not uses_argument(jax.jacfwd(jax.jacfwd(log_likelihood)), theta):
            return form
    return None
