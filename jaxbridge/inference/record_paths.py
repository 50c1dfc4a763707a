"""Paths of records as functions of θ and of noise ξ, and moves of these paths given θ.

Given θ a path moves in blocks (`records.path_blocks`). It is a function of θ and of noise ξ, by
guided steps through its record. The function has an inverse, so a path at θ gives ξ, and ξ gives a
path at another θ. A complete path determines σ, but ξ does not (Roberts & Stramer 2001; van der
Meulen & Schauer 2017).

Paths are represented by their knots, which determine their noise (`records.guided_record`).

The discretisation error of the likelihood is that of w. Steps of twice the size have the noise
(ζ_i + ζ_{i+1}) / √2, which is N(0, I) as well, and a weight w̃. Hence L̃(θ) = E[w̃ / w] L(θ), with
the mean over ξ given θ and the data. The weights are products over segments, so to leading order
the relative change is a sum of changes of segments.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Key, PyTree

from ..engine.averages import nan_to_neg_inf
from ..engine.compiled import compiled_sooner
from ..records import (
    Guidance,
    GuideCheck,
    Records,
    change_by_coarse_steps,
    cuts,
    guided,
    has_segments,
    knots_and_log_weight,
    log_densities_left_out,
    no_check,
    noise_and_log_weight,
    on_each_grid,
    pair_noise,
    path_and_log_weights,
    path_of_knots,
    points_and_check,
    steps_are_too_long,
    swept_path,
)
from ..schemes import share_of_grid
from .parameters import Parameters, of_rows

# Number of intervals between observations in a block, which moves at once.
_BLOCK_LENGTH = 10

# Number of secant steps for the width of the likelihood, and the bounds of their factors.
_NUM_SECANTS, _SECANT = 6, (1 / 16, 8.0)

# Conditions of the arguments about bridges, with their remedies.
_OF_NOISE = "without noise. Omit this argument, or omit `observation`."
OF_UNKNOWN_SIGMA = (
    "with a known σ, because a complete path determines σ. Omit this argument, use `pmmh`, or "
    "select other parameters by `where=`."
)
OF_POPULATION = (
    "whose parameters do not vary between records. Omit this argument, or omit `population`."
)
# Defaults of the arguments about bridges.
_USUAL = {"proposal": "auto", "bridges": "exact", "method": "gradient"}


class GuidedRecords(NamedTuple):
    """Records, the points along which the model is linearised for each, and checks of the guides.

    The points are the same for all parameters.
    """

    records: Records
    points: Float[Array, "R points d"]
    check: GuideCheck


class GuidedTheta(NamedTuple):
    """Parameters θ, and the guides of the paths of each record at θ.

    If θ varies between records, it has a leading axis.
    """

    theta: Float[Array, "*R p"]
    guides: Guidance


class RecordPaths(eqx.Module):
    """Paths of R records in one chain, as functions of θ and noise.

    - `fine`: records with their grids, and points of linearisation.
    - `coarse`: the same with half as many steps.
    """

    parameters: Parameters
    fine: GuidedRecords
    coarse: GuidedRecords

    @property
    def num_steps(self) -> int:
        """Return N, the number of steps of each segment."""
        return self.fine.records.stacked.num_steps

    def at(self, theta: Float[Array, "*R p"]) -> GuidedTheta:
        """Return θ and the guides at θ."""
        return GuidedTheta(theta, _guides(self.parameters, self.fine, theta))

    def first(
        self, key: Key[Array, ""], at: GuidedTheta
    ) -> tuple[Float[Array, "R points d"], Float[Array, "R 2 B"]]:
        """Sample the first paths; return them, and log β of the moves of their blocks.

        The points of linearisation replace a path without weight.
        """
        records, points, _ = self.fine

        def one(problem, model, key, points, guide):
            noise = jax.random.normal(key, points.shape, points.dtype)
            knots, log_weight = knots_and_log_weight(problem, model, guide, noise)
            return jnp.where(jnp.isfinite(log_weight), knots, points)

        keys = jax.random.split(key, records.number)
        paths = _each(self.parameters, records, one, at.theta, keys, points, at.guides)
        return paths, no_paths(records)[1]

    def renewed(
        self,
        key: Key[Array, ""],
        at: GuidedTheta,
        paths: Float[Array, "R points d"],
        log_scales: Float[Array, "R 2 B"],
    ) -> tuple[Float[Array, "R points d"], Bool[Array, "R 2 B 1"]]:
        """Return the paths after a sweep given θ, and whether each block moved."""
        records, points, _ = self.fine

        def one(problem, model, key, points, guide, log_scales, path):
            along = points, guide
            return swept_path(key, problem, model, along, _BLOCK_LENGTH, log_scales, path)

        keys = jax.random.split(key, records.number)
        arguments = keys, points, at.guides, log_scales, paths
        return _each(self.parameters, records, one, at.theta, *arguments)

    def noise(
        self, key: Key[Array, ""], at: GuidedTheta, paths: Float[Array, "R points d"]
    ) -> tuple[Float[Array, "R points d"], Float[Array, " R"]]:
        """Return ξ of these paths, and log w of each record."""
        records = self.fine.records

        def one(problem, model, key, guide, path):
            return noise_and_log_weight(key, problem, model, guide, path)

        keys = jax.random.split(key, records.number)
        return _each(self.parameters, records, one, at.theta, keys, at.guides, paths)

    def of_noise(
        self, at: GuidedTheta, noise: Float[Array, "R points d"]
    ) -> tuple[Float[Array, "R points d"], Float[Array, " R"]]:
        """Return the paths of ξ, and log w of each record."""
        return _paths_of_noise(self.parameters, self.fine.records, at, noise)

    def at_observations(
        self, key: Key[Array, ""], at: GuidedTheta, paths: Float[Array, "R points d"]
    ) -> tuple[Float[Array, "R ends d"], Float[Array, "R ends"]]:
        """Return the states at the ends of segments, and the log densities of the observations.

        These are given θ and the states at the ends before and after (`records.left_out`).
        """
        records, points, _ = self.fine

        def one(problem, model, key, points, guide, knots):
            states = path_of_knots(problem, model, knots)[:: problem.num_steps]
            return states, log_densities_left_out(key, problem, model, (points, guide), knots)

        keys = jax.random.split(key, records.number)
        return _each(self.parameters, records, one, at.theta, keys, points, at.guides, paths)

    def change_by_coarse_steps(
        self, theta: Float[Array, "*R p"], noise: Float[Array, "R points d"]
    ) -> Float[Array, ""]:
        """Return the relative change of the likelihood by steps of twice the size, from one ξ.

        It is infinite if steps are too long for the drift.
        """
        parameters = self.parameters

        def path_on_grid(grid_and_noise):
            grid, noise = grid_and_noise
            guides = _guides(parameters, grid, theta)
            return _each(parameters, grid.records, path_and_log_weights, theta, guides, noise)

        both = (self.fine, noise), (self.coarse, self._coarsened(noise))
        (paths, log_fine), (_, log_coarse) = on_each_grid(path_on_grid, *both)
        change = jnp.sum(jax.vmap(change_by_coarse_steps)(log_fine, log_coarse))
        too_long = _each(parameters, self.fine.records, steps_are_too_long, theta, paths)
        return jnp.where(jnp.any(too_long), jnp.inf, change)

    def either_log_weight(
        self, theta: Float[Array, " p"], noise: Float[Array, "R points d"], coarse: Bool[Array, ""]
    ) -> Float[Array, ""]:
        """Return log w̃ of ξ if `coarse`, else log w. One program serves both."""
        choose = lambda a, b: jnp.where(coarse, a, b) if eqx.is_array(a) else b
        grid = jax.tree.map(choose, self.coarse, self.fine)
        return self._log_weight(grid, theta, jnp.where(coarse, self._coarsened(noise), noise))

    def _log_weight(
        self, grid: GuidedRecords, theta: Float[Array, " p"], noise: Float[Array, "R points d"]
    ) -> Float[Array, ""]:
        at = GuidedTheta(theta, _guides(self.parameters, grid, theta))
        return jnp.sum(_paths_of_noise(self.parameters, grid.records, at, noise)[1])

    def _coarsened(self, noise: Float[Array, "R points d"]) -> Float[Array, "R points d"]:
        lengths = self.fine.records.stacked.record.lengths
        return jax.vmap(lambda noise: pair_noise(noise, lengths))(noise)


def check_no_bridges(condition: str = _OF_NOISE, **arguments: Any) -> None:
    """Raise `ValueError` if an argument about bridges is neither `None` nor its default.

    Such arguments are for complete observations without noise and a known σ that is the same for
    all records. `condition` is the part of this that does not hold, with its remedy.
    """
    names = not_default(arguments)
    if names:
        raise ValueError(
            f"{' and '.join(f'`{name}`' for name in names)}: only for complete observations "
            f"{condition}"
        )


def not_default(arguments: dict[str, Any]) -> list[str]:
    """Return the names of arguments about bridges that are neither `None` nor their default."""
    usual = lambda name, value: isinstance(value, str) and value == _USUAL.get(name)
    return [
        name for name, value in arguments.items() if value is not None and not usual(name, value)
    ]


def check_no_record(**arguments: Any) -> None:
    """Raise `ValueError` if an argument for records is not `None`."""
    names = [f"`{name}`" for name, value in arguments.items() if value is not None]
    if names:
        raise ValueError(
            f"{' and '.join(names)}: only for records with an `observation`. Pass one, for "
            "instance `observation=jb.LinearGaussian(covariance=0.01)`, or omit this argument."
        )


def movable(records: Records) -> Bool[Array, "R 2 B"]:
    """Return whether each block contains a part of its record; the other blocks are padding."""
    return records.each(lambda problem: has_segments(problem, _BLOCK_LENGTH))


def share_of_step_error(records: Records) -> float:
    """Return the discretisation error as a fraction of the change from half as many steps."""
    return share_of_grid(records.stacked.density.order, records.stacked.record.lengths)


def unguided(records: Records) -> GuidedRecords:
    """Return the records with zeros as placeholders for the points of linearisation."""
    problem = records.stacked
    shape = records.number, problem.num_segments * problem.num_steps + 1, problem.dim
    dtype = problem.like.dtype
    return GuidedRecords(records, jnp.zeros(shape, dtype), no_check(records.number, dtype))


def guided_near(
    fine: Records, coarse: Records, linearise: Callable[[Records], tuple[Array, GuideCheck]]
) -> tuple[GuidedRecords, GuidedRecords]:
    """Return both records with points of linearisation by `linearise`."""
    of_fine, of_coarse = on_each_grid(linearise, fine, coarse)
    return GuidedRecords(fine, *of_fine), GuidedRecords(coarse, *of_coarse)


def no_paths(records: Records) -> tuple[Float[Array, "R points d"], Float[Array, "R 2 B"]]:
    """Return placeholders of the paths, and log β = 0 of the moves of their blocks."""
    num_blocks = cuts(records.stacked.num_segments, _BLOCK_LENGTH).shape[-1]
    points = unguided(records).points
    return points, jnp.zeros((records.number, 2, num_blocks), points.dtype)


def as_record_paths(
    parameters: Parameters, records: Records, theta: Float[Array, "*R p"]
) -> RecordPaths:
    """Return the paths of the records, linearised at θ."""
    # Outside `jit` the search for a single record decides in Python which programs it compiles.
    make = _as_record_paths if records.number == 1 else _compiled_record_paths
    return make(parameters, records, theta)


def _as_record_paths(
    parameters: Parameters, records: Records, theta: Float[Array, "*R p"]
) -> RecordPaths:
    def linearise(records):
        return _each(parameters, records, points_and_check, theta)

    return RecordPaths(parameters, *guided_near(records, records.coarsened(), linearise))


_compiled_record_paths = compiled_sooner(_as_record_paths)


def likely_root(
    parameters: Parameters,
    grid: GuidedRecords,
    log_prior: Callable[[Array], Array],
    phi: Float[Array, " p"],
    root: Float[Array, "p p"],
    of_records: Callable[[Array], Array] = lambda theta: theta,
) -> Float[Array, "p p"]:
    """Return a diagonal S of first moves, from the width of each parameter's conditional posterior.

    φ are the parameters that move, and `of_records` returns θ of the records.

    The likelihood is that of the guided path without noise. For a linear model it is exact up to a
    constant. The width h of an entry is such that the mean of the log densities at φ ± h is ½ below
    the log density at φ. A few secant steps find h; they need no derivatives, and every start will
    do. h is at most ten times the diagonal of `root`. S has the entries 2.4 h / √p. If the path has
    no weight, `root` is returned.
    """
    points, p = grid.points, phi.shape[0]

    def log_density(phi):
        theta = of_records(phi)
        at = GuidedTheta(theta, _guides(parameters, grid, theta))
        _, log_weights = _paths_of_noise(parameters, grid.records, at, jnp.zeros_like(points))
        allowed = jnp.all(of_rows(parameters.allowed, theta))
        value = nan_to_neg_inf(jnp.sum(log_weights)) + log_prior(phi)
        return jnp.where(allowed, value, -jnp.inf)

    def turn(width, _):
        steps = jnp.diag(width)
        values = lax.map(log_density, jnp.concatenate([phi[None], phi + steps, phi - steps]))
        drop = values[0] - (values[1 : p + 1] + values[p + 1 :]) / 2
        # For a quadratic the drop is proportional to h², so at h / √(2 drop) it is ½.
        factor = jnp.clip(lax.rsqrt(2 * jnp.maximum(drop, 1e-3)), *_SECANT)
        # Without weight at θ there is no drop to measure.
        factor = jnp.where(values[0] > -jnp.inf, factor, 1)
        return jnp.minimum(width * factor, 10 * jnp.diagonal(root)), values[0]

    first = jnp.diagonal(root)
    width, values = lax.scan(turn, first, length=_NUM_SECANTS)
    # The best factor for random walks with a normal target (Roberts & Rosenthal 2001).
    width = width * np.asarray(2.4 / np.sqrt(p), phi.dtype)
    return jnp.where(values[0] > -jnp.inf, jnp.diag(width), root)


def _each(
    parameters: Parameters,
    records: Records,
    function: Callable,
    theta: Float[Array, "*R p"],
    *mapped: PyTree,
) -> Any:
    """Evaluate `function(problem, model, *mapped)` for each record, with the model at its θ."""
    if theta.ndim == 1:  # one model for all, which is prepared once
        model = parameters.bind(theta)
        return records.each(lambda problem, *each: function(problem, model, *each), *mapped)
    of_record = lambda problem, theta, *each: function(problem, parameters.bind(theta), *each)
    return records.each(of_record, theta, *mapped)


def _guides(parameters: Parameters, grid: GuidedRecords, theta: Float[Array, "*R p"]) -> Guidance:
    """Return the guides of the paths of each record."""
    return _each(parameters, grid.records, guided, theta, grid.points)


def _paths_of_noise(
    parameters: Parameters, records: Records, at: GuidedTheta, noise: Float[Array, "R points d"]
) -> tuple[Float[Array, "R points d"], Float[Array, " R"]]:
    return _each(parameters, records, knots_and_log_weight, at.theta, at.guides, noise)
