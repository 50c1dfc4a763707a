"""Means over exact bridges, from weights or from a chain, and their errors.

`WeightedBridges` and `Chain` share this base class, so all functions of exact bridges accept both.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ..coupling import AbstractCoupling
from ..engine.averages import (
    PathFunction,
    evaluate_on_paths,
    fill_missing_paths,
    mean_over_paths,
    normalise_weights,
    weighted_mean,
)
from ..engine.verdict import AbstractResult
from ..proposals import AbstractWeightedProposal
from ..schemes import (
    StepError,
    dominates,
    error_of_mean,
    root_mean_square_in_sds,
    share_of_pairs,
)


class AbstractExactBridges(AbstractResult):
    """Base class of results with bridges of the exact law, up to the discretisation error.

    With I intervals arrays have a leading axis I.

    - `paths`, `met`: the bridges, shape (n, K, d), and whether each was found, shape (n,).
    - `log_halving`: log of the factor by which half as many steps would change the weight of a
        path, shape (n,); NaN where it was not computed.
    - `coarse_paths`: the paths that the same noise gives with half as many steps, shape (n, K, d).
        Where none was simulated, the entry is the bridge itself. `None` if no coarse paths are
        needed. Between the points of the coarse grid the distance to the bridge is constant.
    - `step_share`: the discretisation error divided by the change of the estimate under half as
        many steps, shape (). It is infinite if this change has no information about the error:
        for steps longer than the relaxation time of the drift, and for couplings with a
        state-dependent σ(x) or with another meeting rule than `BrownianCrossing()`. Then the
        uncertainty of the error is infinite, too.
    - `proposal`, `num_steps`: the proposal and the number N of steps of the paths.
    """

    paths: eqx.AbstractVar[Float[Array, "*I n K d"]]
    met: eqx.AbstractVar[Bool[Array, "*I n"]]
    log_halving: eqx.AbstractVar[Float[Array, "*I n"]]
    coarse_paths: eqx.AbstractVar[Float[Array, "*I n K d"] | None]
    step_share: eqx.AbstractVar[Float[Array, "*I"]]
    proposal: eqx.AbstractVar[AbstractWeightedProposal]
    num_steps: eqx.AbstractVar[int]

    @property
    def coupling(self) -> AbstractCoupling | None:
        """Return the coupling of the proposal, or `None` if it has none."""
        return self.proposal.by_coupling

    @property
    @abstractmethod
    def log_mean_weights(self) -> Float[Array, "*I n"]:
        """Return the log weights that `mean` uses, shape (n,); -inf for a missing bridge."""

    @abstractmethod
    def standard_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the Monte Carlo standard error of `mean(fn)`, entry by entry."""

    def mean(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the mean of `fn(path)`: an estimate of its expectation over exact bridges.

        `fn` takes one path of shape (K, d); by default it returns the path. The mean is NaN if
        there are no bridges.
        """
        return mean_over_paths(fn, normalise_weights(self.log_mean_weights), self.paths, self.met)

    def step_error(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the estimated discretisation bias of `mean(fn)` (estimate minus limit), entry by
        entry.

        It is NaN if unknown: for one step, or if `step_share` is infinite.
        """
        return jax.tree.map(lambda error: error.value, self._step_errors(fn), is_leaf=_is_error)

    def step_uncertainty(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return the standard error of `step_error(fn)`, entry by entry."""
        errors = self._step_errors(fn)
        return jax.tree.map(lambda error: error.uncertainty, errors, is_leaf=_is_error)

    def step_error_dominates(self, fn: PathFunction = lambda path: path) -> PyTree:
        """Return whether the discretisation error of `mean(fn)` is, or may be, larger than its
        standard error.

        If true, use more steps. If only the estimate of the error is uncertain, more bridges help,
        too; `why()` reports the reason. The result is false for an entry of `fn` that is the same
        for all bridges, such as an end point.
        """

        def dominates_entry(error, standard_error):
            # A value that is the same for all bridges, such as an end point, has no error at all.
            return dominates(error, standard_error) & (standard_error > 0)

        errors = self._step_errors(fn)
        return jax.tree.map(dominates_entry, errors, self.standard_error(fn), is_leaf=_is_error)

    def step_error_in_sds(self) -> StepError:
        """Return the discretisation error of the mean path, relative to the spread of the paths,
        shape ().

        The unit is the standard deviation of the points of paths; the error is a root mean square
        over them.
        """
        weights, axis = normalise_weights(self.log_mean_weights), self.met.ndim - 1
        paths, error = (
            fill_missing_paths(self.paths, self.met),
            self._step_errors(lambda path: path),
        )
        # The weighted variance of each coordinate at each time gives the unit.
        deviation = paths - jnp.expand_dims(weighted_mean(weights, paths), axis)
        variance = weighted_mean(weights, deviation**2)
        return StepError(*(root_mean_square_in_sds(value, variance) for value in error))

    def _step_errors(self, fn: PathFunction) -> PyTree:
        share = self.step_share

        def values(paths):
            return evaluate_on_paths(fn, fill_missing_paths(paths, self.met))

        def error(*values):
            return error_of_mean(self.log_mean_weights, self.log_halving, share, *values)

        if self.coarse_paths is None:
            return jax.tree.map(error, values(self.paths))
        share = share_of_pairs(share, self.num_steps)
        return jax.tree.map(error, values(self.paths), values(self.coarse_paths))


def _is_error(leaf) -> bool:
    return isinstance(leaf, StepError)
