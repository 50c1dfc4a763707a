"""Means over exact bridges, whether by weights or by a chain, and how far to trust them."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ..coupling import AbstractCoupling
from ..engine.averages import (
    PathFunction,
    filled,
    mean_over_paths,
    normalised,
    values_of,
    weighted_mean,
)
from ..engine.verdict import AbstractResult
from ..proposals import AbstractWeightedProposal
from ..schemes import StepError, dominates, error_of_mean, root_mean_square_in_sds


class AbstractExactBridges(AbstractResult):
    """Bridges with the exact law, up to the step error. Arrays have a leading axis I if there are
    several intervals.

    - `paths`, `met`: shapes (n, K, d) and (n,).
    - `log_halving`: log of the factor by which the weight of a path would change with half as many
        steps, NaN where none was worked out, shape (n,).
    - `step_share`: the step error as a share of what that changes, shape (); infinite where that
        says nothing of it, and then its uncertainty is, too: of couplings with a σ(x) that varies.
    - `proposal`: what they were made with.
    """

    paths: eqx.AbstractVar[Float[Array, "*I n K d"]]
    met: eqx.AbstractVar[Bool[Array, "*I n"]]
    log_halving: eqx.AbstractVar[Float[Array, "*I n"]]
    step_share: eqx.AbstractVar[Float[Array, "*I"]]
    proposal: eqx.AbstractVar[AbstractWeightedProposal]

    @property
    def coupling(self) -> AbstractCoupling | None:
        """That of the proposal, if it has one."""
        return self.proposal.by_coupling

    @property
    @abstractmethod
    def log_mean_weights(self) -> Float[Array, "*I n"]:
        """The logs of the weights of means, -inf for a bridge that is missing."""

    @abstractmethod
    def standard_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """The Monte Carlo error of `mean(fn)`, entry by entry."""

    def mean(self, fn: PathFunction = lambda path: path) -> PyTree:
        """The mean of `fn(path)`, a function of one path of shape (K, d), by default the path
        itself: an estimate of its expectation over exact bridges. NaN where there are none."""
        return mean_over_paths(fn, normalised(self.log_mean_weights), self.paths, self.met)

    def step_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """What `mean(fn)` is too large by for the length of the steps, an estimate, entry by entry;
        NaN where it is not known, as of one step, or of couplings whose σ(x) varies."""
        return jax.tree.map(lambda error: error.value, self._step_errors(fn), is_leaf=_is_error)

    def step_uncertainty(self, fn: PathFunction = lambda path: path) -> PyTree:
        """A standard error of `step_error(fn)`."""
        errors = self._step_errors(fn)
        return jax.tree.map(lambda error: error.uncertainty, errors, is_leaf=_is_error)

    def step_error_dominates(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Whether the step error of `mean(fn)` is beyond its standard error, or not known well
        enough to say: then more steps help, and more bridges do not. False of what is the same for
        all bridges."""

        def of_entry(error, standard_error):
            return dominates(error, standard_error) & (standard_error > 0)

        errors = self._step_errors(fn)
        return jax.tree.map(of_entry, errors, self.standard_error(fn), is_leaf=_is_error)

    def step_error_in_sds(self) -> StepError:
        """The step error of the mean path in standard deviations of the points of paths, root mean
        square, shape ()."""
        weights, axis = normalised(self.log_mean_weights), self.met.ndim - 1
        paths, error = filled(self.paths, self.met), self._step_errors(lambda path: path)
        deviation = paths - jnp.expand_dims(weighted_mean(weights, paths), axis)
        variance = weighted_mean(weights, deviation**2)
        return StepError(*(root_mean_square_in_sds(value, variance) for value in error))

    def _step_errors(self, fn: PathFunction) -> PyTree:
        def error(value):
            return error_of_mean(self.log_mean_weights, self.log_halving, self.step_share, value)

        return jax.tree.map(error, values_of(fn, filled(self.paths, self.met)))


def _is_error(leaf) -> bool:
    return isinstance(leaf, StepError)
