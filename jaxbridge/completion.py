"""The observations completed by bridges, and the Markov kernels that renew them.

Given θ the bridges of all intervals are independent. A kernel moves each of them once, leaving its
exact law invariant whatever θ it was made with (section 2.3 of the paper):

* `ByRenewal` keeps a bridge until a diffusion associated with it hits it, for couplings. It
  keeps nothing but the path.
* `ByWeights` accepts a new weighted proposal with the ratio of the weights, which for the path
  at hand is drawn anew from its law given θ and the path: for the counts of a coupling that is
  the size-biased law, for proposals that are pulled to the end point a function of the path.
* `Unweighted` takes each new proposal of a coupling: approximate, as in section 4 of the paper.
"""

from abc import abstractmethod
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from .choice import as_proposal, settled
from .coupled_pairs import CoupledPairs
from .diffusion import Diffusion
from .guided import ModifiedDiffusionBridge
from .intervals import Intervals
from .kernels import acceptance_rate
from .likelihood import Form, log_likelihoods
from .observations import Group
from .renewal_chain import as_pairs, first_paths, propose_paths, renew
from .weighted import AbstractWeightedProposal

# One array of shape (I, N+1, d) for each part.
Paths = tuple[Float[Array, "_ _ d"], ...]


class Renewed(NamedTuple):
    """Of one step on all intervals: whether the path of each was replaced; how many paths were
    simulated, or weighed, for it; whether no proposal was found though one was called for. Then
    the path stays, which leaves the exact law invariant, for whether one is found does not
    depend on the path."""

    moved: Bool[Array, " I"]
    num_simulated: Int[Array, " I"]
    missing: Bool[Array, " I"]


class AbstractBridgeKernel(eqx.Module):
    """A Markov kernel on the bridges of many intervals."""

    @abstractmethod
    def first(
        self, keys: Key[Array, " I"], model: Diffusion, intervals: Intervals, num_steps: int
    ) -> Float[Array, "I points d"]:
        """Paths to start from, NaN where none was found."""

    @abstractmethod
    def renew(
        self,
        keys: Key[Array, " I"],
        model: Diffusion,
        intervals: Intervals,
        paths: Float[Array, "I points d"],
    ) -> tuple[Float[Array, "I points d"], Renewed]:
        """One step of each."""


class ByRenewal(AbstractBridgeKernel):
    """The renewal kernel."""

    pairs: CoupledPairs

    def first(self, keys, model, intervals, num_steps):
        return first_paths(keys, model, self.pairs, intervals, num_steps)

    def renew(self, keys, model, intervals, paths):
        everything = jnp.ones(len(keys), bool)
        paths, info = renew(keys, model, self.pairs, intervals, paths, everything)
        return paths, Renewed(info.is_accepted, info.num_simulated, info.is_missing)


class ByWeights(AbstractBridgeKernel):
    """The pseudo-marginal kernel."""

    proposal: AbstractWeightedProposal

    def first(self, keys, model, intervals, num_steps):
        drawn = self.proposal.draw(keys[:, None], model, intervals, num_steps, None, False)
        return drawn.paths[:, 0]

    def renew(self, keys, model, intervals, paths):
        weigh_keys, draw_keys, accept_keys = jax.vmap(
            lambda key: jax.random.split(key, 3), out_axes=1
        )(keys)
        num_steps = paths.shape[1] - 1
        old = self.proposal.reweigh(weigh_keys, model, intervals, paths)
        new = self.proposal.draw(draw_keys[:, None], model, intervals, num_steps, None, False)
        uniform = jax.vmap(lambda key: jax.random.uniform(key, dtype=paths.dtype))(accept_keys)
        accepted = uniform < acceptance_rate(old.log_weights[:, 0], new.log_weights[:, 0])
        num_simulated = old.num_simulated[:, 0] + new.num_simulated[:, 0]
        paths = jnp.where(accepted[:, None, None], new.paths[:, 0], paths)
        return paths, Renewed(accepted, num_simulated, ~new.found[:, 0])


class Unweighted(AbstractBridgeKernel):
    """A new approximate bridge each time."""

    pairs: CoupledPairs

    def first(self, keys, model, intervals, num_steps):
        return first_paths(keys, model, self.pairs, intervals, num_steps)

    def renew(self, keys, model, intervals, paths):
        num_steps = paths.shape[1] - 1
        proposed = propose_paths(keys, model, self.pairs, intervals, None, num_steps)
        found = proposed.num_found > 0
        paths = jnp.where(found[:, None, None], proposed.outputs.paths, paths)
        return paths, Renewed(found, proposed.num_trials, ~found)


class _Part(eqx.Module):
    """Intervals with one number of steps, which are these fractions of their durations."""

    intervals: Intervals
    kernel: AbstractBridgeKernel
    index: Int[Array, " I"]
    fractions: Float[Array, " N"]

    @property
    def num_steps(self) -> int:
        return self.fractions.shape[0]

    @property
    def steps(self) -> Float[Array, "N I"]:
        return self.fractions[:, None] * self.intervals.duration


class Completion(eqx.Module):
    """How the observations are completed: by bridges of all intervals, in parts of one number of
    steps each."""

    parts: tuple[_Part, ...]

    def first(self, key: Key[Array, ""], model: Diffusion) -> Paths:
        """Paths to start from. Where the proposal finds none, whatever its weight, a modified
        diffusion bridge serves, or a straight line: a chain may start anywhere."""
        model = model.prepared()

        def of_part(part, keys):
            intervals, num_steps = part.intervals, part.num_steps
            found_keys, other_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
            found = part.kernel.first(found_keys, model, intervals, num_steps)
            other = ModifiedDiffusionBridge().draw(
                other_keys[:, None], model, intervals, num_steps, None, False
            )
            done = jnp.concatenate([jnp.zeros(1), jnp.cumsum(part.fractions)]).astype(found.dtype)
            start, end = intervals.start[:, None], intervals.end[:, None]
            path = start + done[:, None] * (end - start)
            for better in (other.paths[:, 0], found):
                path = jnp.where(is_there(better)[:, None, None], better, path)
            return path

        return tuple(map(of_part, self.parts, self._keys(key)))

    def renew(self, key: Key[Array, ""], model: Diffusion, paths: Paths) -> tuple[Paths, Renewed]:
        """One step of every bridge, at the parameters of this model."""
        model = model.prepared()
        made = [
            part.kernel.renew(keys, model, part.intervals, mine)
            for part, keys, mine in zip(self.parts, self._keys(key), paths, strict=True)
        ]
        renewed = [each for _, each in made]
        together = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *renewed)
        return tuple(each for each, _ in made), together

    def log_likelihoods(
        self, model: Diffusion, paths: Paths, form: Form
    ) -> Float[Array, " intervals"]:
        """Those of the paths, part by part."""
        values = [
            log_likelihoods(model, part.steps, mine, form)
            for part, mine in zip(self.parts, paths, strict=True)
        ]
        return jnp.concatenate(values)

    def points(self, paths: Paths) -> tuple[Float[Array, "points d"], Float[Array, " points"]]:
        """All points of the paths but their ends, and the steps that begin there."""
        points = [mine[:, :-1].reshape(-1, mine.shape[-1]) for mine in paths]
        steps = [part.steps.T.reshape(-1) for part in self.parts]
        return jnp.concatenate(points), jnp.concatenate(steps)

    def _keys(self, key: Key[Array, ""]) -> list[Key[Array, " I"]]:
        keys = jax.random.split(key, len(self.parts))
        return [
            jax.random.split(key, len(part.intervals.duration))
            for key, part in zip(keys, self.parts, strict=True)
        ]


def is_there(paths: Float[Array, "I points d"]) -> Bool[Array, " I"]:
    """Which paths are not missing."""
    return jnp.all(jnp.isfinite(paths), axis=(1, 2))


def complete(
    key: Key[Array, ""],
    model: Diffusion,
    intervals: Intervals,
    groups: tuple[Group, ...],
    proposal: Any,
    bridges: Literal["exact", "approximate"],
    method: Literal["pseudo_marginal", "renewal"] | None,
    bounds: tuple[int | None, int | None, int | None],
) -> Completion:
    """The completion that the user asked for; pilot runs and burn-ins are at the parameters of
    this model.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.
    """
    if bridges not in ("exact", "approximate"):
        raise ValueError(f'`bridges` must be "exact" or "approximate"; got {bridges!r}.')
    if method not in (None, "pseudo_marginal", "renewal"):
        raise ValueError(f'`method` must be "pseudo_marginal" or "renewal"; got {method!r}.')
    if bridges == "approximate" and method is not None:
        raise ValueError("`method` is for exact bridges: approximate ones need none.")
    given = proposal
    if proposal is None and bridges == "exact" and method is None:
        given = "auto"
    keys = jax.random.split(key, len(groups))
    parts = []
    for part_key, group in zip(keys, groups, strict=True):
        mine = jax.tree.map(lambda leaf, which=group.which: leaf[which], intervals)
        chosen = as_proposal(given, model, mine.start[0], *bounds)
        chosen.check(model, mine)
        if bridges == "approximate" or method == "renewal":
            chosen = as_pairs(chosen)
        chosen = settled(chosen, part_key, model, mine, group.num_steps)
        chosen = chosen.prepared(part_key, model, mine, group.num_steps)
        if bridges == "approximate":
            kernel = Unweighted(as_pairs(chosen))
        elif method == "renewal" or (method is None and isinstance(chosen, CoupledPairs)):
            kernel = ByRenewal(as_pairs(chosen))
        else:
            kernel = ByWeights(chosen)
        fractions = np.diff(chosen.fractions(group.num_steps))
        fractions = jnp.asarray(fractions, mine.duration.dtype)
        parts.append(_Part(mine, kernel, jnp.asarray(group.which), fractions))
    return Completion(tuple(parts))
