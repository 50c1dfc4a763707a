"""Data augmentation: completion of the observations by bridges.

Given θ the bridges of all intervals are independent, and a separate Markov kernel renews each of
them (`bridge_kernels`). Given the bridges the log-likelihood of θ is that of the completed path. It
is quadratic if the drift is linear in θ. The module detects this from the program of the Hessian,
in which θ does not occur.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal

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
from ..proposals import AbstractWeightedProposal, Budget, ModifiedDiffusionBridge, as_pairs
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
    """How the observations are completed: by bridges of all intervals, in blocks of one number of
    steps each, with a kernel for each block; the form of the likelihood of their paths, and
    whether it is quadratic in θ."""

    blocks: tuple[Block, ...]
    kernels: tuple[AbstractBridgeKernel, ...]
    form: Form = eqx.field(static=True)
    is_quadratic: bool = eqx.field(static=True)

    @property
    def like(self) -> Float[Array, " d"]:
        """A point, of which only shape and dtype count."""
        return self.blocks[0].problem.like

    @property
    def num_intervals(self) -> int:
        return sum(len(block.index) for block in self.blocks)

    def check_paths(self, paths: tuple[Float[Array, "..."], ...], chains: tuple[int, ...]) -> None:
        """Raise `ValueError` where these are no paths between the observations."""
        wanted = [
            (*chains, len(block.index), block.num_steps + 1, block.intervals.start.shape[1])
            for block in self.blocks
        ]
        shapes = [mine.shape for mine in paths]
        if shapes != wanted:
            raise ValueError(
                f"`init` is a state with paths of shapes {shapes}, but these observations and "
                f"numbers of steps need {wanted}: pass the same observations and `num_steps` as "
                "before, or unknown parameters as `init`."
            )
        for block, mine in zip(self.blocks, paths, strict=True):
            ends = (block.intervals.start, block.intervals.end)
            for end, found in zip(ends, (mine[..., 0, :], mine[..., -1, :]), strict=True):
                if not is_traced(end, found) and not np.allclose(found, end, atol=1e-6, rtol=1e-4):
                    raise ValueError(
                        "`init` is a state whose paths do not join these observations: pass the "
                        "same observations as before, or unknown parameters as `init`."
                    )

    def first(self, key: Key[Array, ""], model: Diffusion) -> tuple[Paths, Bool[Array, " I"]]:
        """Paths to start from, and which of them the proposal itself has found, in the order of the
        blocks. Where it finds none, whatever its weight, a straight line serves, or, if couplings
        may be used (inside `jit` all of a choice), a modified diffusion bridge: a chain may start
        anywhere."""
        model = model.prepared()

        def of_block(block, kernel, keys):
            intervals, num_steps = block.intervals, block.num_steps
            found_keys, other_keys = split_each(keys, 2)
            found = kernel.first(found_keys, model, intervals, num_steps)
            better = [found]
            if block.proposal.coupled:
                other = ModifiedDiffusionBridge(EulerDensity()).draw(
                    other_keys[:, None], model, intervals, num_steps, None, False
                )
                better = [other.paths[:, 0], found]
            done = jnp.concatenate([jnp.zeros(1), jnp.cumsum(block.fractions)]).astype(found.dtype)
            start, end = intervals.start[:, None], intervals.end[:, None]
            path = start + done[:, None] * (end - start)
            for each in better:
                path = jnp.where(is_there(each)[:, None, None], each, path)
            return path, is_there(found)

        paths, found = zip(*map(of_block, self.blocks, self.kernels, self._keys(key)), strict=True)
        return paths, jnp.concatenate(found)

    def renew(
        self, key: Key[Array, ""], model: Diffusion, paths: Paths
    ) -> tuple[Paths, BridgeInfo]:
        """One step of every bridge, at the parameters of this model."""
        model = model.prepared()

        def of_block(block, kernel, keys, mine):
            return kernel.renew(keys, model, block.intervals, mine)

        made = map(of_block, self.blocks, self.kernels, self._keys(key), paths)
        paths, infos = zip(*made, strict=True)
        return paths, jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *infos)

    def log_likelihood(self, model: Diffusion, paths: Paths) -> Float[Array, ""]:
        """That of all paths."""

        def of_block(block, mine):
            return log_likelihoods(model, block.steps, mine, self.form)

        return jnp.sum(jnp.concatenate(list(map(of_block, self.blocks, paths))))

    def log_step_error(self, model: Diffusion, paths: Paths) -> Float[Array, ""]:
        """A function of these paths whose mean, given θ, is the step error of log L(θ): half as
        many steps make each path e^D times as likely (`halving`), so that they change log p of an
        interval by log E[e^D], to leading order E[D + ½ D²]; of that a share is the error.
        (Not E[D], for the variance of D is of the same order; nor E[e^D - 1], which is -1 however
        far steps are out of all proportion, and would tell of no error.) Infinite where steps are
        too long for the drift in more than 2 % of the intervals."""
        model, form = model.prepared(), self.form

        def of_block(block, mine):
            halvings = block.log_halvings(model, mine, form)
            share = block.step_shares(model, form)
            in_regime = share_in_regime(share, model, block.intervals, block.num_steps)
            error = jnp.sum(share * (halvings + halvings**2 / 2))
            return error, jnp.sum(in_regime == UNKNOWN_SHARE)

        errors, too_long = zip(*map(of_block, self.blocks, paths), strict=True)
        hopeless = sum(too_long) > math.floor(MOST_TOO_LONG * self.num_intervals)
        return jnp.where(hopeless, jnp.inf, sum(errors))

    def points(self, paths: Paths) -> tuple[Float[Array, "points d"], Float[Array, " points"]]:
        """All points of the paths but their ends, and the steps that begin there."""
        points = [mine[:, :-1].reshape(-1, mine.shape[-1]) for mine in paths]
        steps = [block.steps.T.reshape(-1) for block in self.blocks]
        return jnp.concatenate(points), jnp.concatenate(steps)

    def _keys(self, key: Key[Array, ""]) -> list[Key[Array, " I"]]:
        return [
            jax.random.split(key, len(block.index)) for key, block in with_keys(key, self.blocks)
        ]


def is_there(paths: Float[Array, "I points d"]) -> Bool[Array, " I"]:
    """Which paths are not missing."""
    return jnp.all(jnp.isfinite(paths), axis=(1, 2))


def augment(
    key: Key[Array, ""],
    problem: Problem,
    theta: Float[Array, " p"],
    proposal: Any,
    bridges: Literal["exact", "approximate"],
    method: Literal["pseudo_marginal", "renewal"] | None,
    budget: Budget,
) -> Augmentation:
    """The augmentation that the user asked for; pilot runs and burn-ins are at this θ.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.
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
    by_pairs = method is None and isinstance(proposal, AbstractCoupling)
    if use != "weights" or by_pairs:
        reason = (
            'for `method="pseudo_marginal"`: the renewal chain and approximate bridges use no '
            "hitting counts"
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
    if use == "renewal" or (method is None and proposal.by_coupling is not None):
        return ByRenewal(as_pairs(proposal))
    return ByWeights(proposal)


def _quadratic_form(
    problem: Problem, theta: Float[Array, " p"], forms: Sequence[Form]
) -> Form | None:
    """The first of these forms in which the log likelihood is quadratic in θ, if there is one."""
    like, parameters = problem.like, problem.parameters
    for form in forms:

        def log_likelihood(theta, form: Form = form):
            steps, paths = jnp.ones((1, 1), like.dtype), jnp.stack([like, like])[None]
            return log_likelihoods(parameters.bind(theta), steps, paths, form)[0]

        if not uses_argument(jax.jacfwd(jax.jacfwd(log_likelihood)), theta):
            return form
    return None
