"""Paths of records as functions of θ and of noise ξ, and moves of these paths given θ.

Given θ a path moves in blocks (`records.path_blocks`). It is a function of θ and of noise ξ, by
guided steps through its record. The function has an inverse, so a path at θ gives ξ, and ξ gives a
path at another θ. A complete path determines σ, but ξ does not (Roberts & Stramer 2001; van der
Meulen & Schauer 2017).

The discretisation error of the likelihood is that of w. Steps of twice the size have the noise
(ζ_i + ζ_{i+1}) / √2, which is N(0, I) as well, and a weight w̃. Hence L̃(θ) = E[w̃ / w] L(θ), with
the mean over ξ given θ and the data.
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
from ..models.diffusion import Diffusion
from ..records import (
    Guidance,
    GuideCheck,
    Paths,
    Records,
    blocks_of_both_cuts,
    cuts,
    guided,
    has_segments,
    linearisations,
    no_check,
    noise_and_log_weight,
    path_and_log_weight,
    stacked,
    steps_are_too_long,
    sweep,
)
from ..schemes import share_of_grid
from .parameters import Parameters

# Intervals between observations that move at once.
_BLOCK_LENGTH = 10


# How often the width of the likelihood is found anew from the last, and by which factors.
_NUM_SECANTS, _SECANT = 6, (1 / 16, 8.0)

# What says nothing about bridges.
_USUAL = {"proposal": "auto", "bridges": "exact", "method": "gradient"}


class GuidedRecords(NamedTuple):
    """Records, the points along which each is linearised, whatever the parameters, and how good a
    guide that makes."""

    records: Records
    points: Float[Array, "R points d"]
    check: GuideCheck


class At(NamedTuple):
    """θ, and what guides the paths of each record there."""

    theta: Float[Array, " p"]
    guides: Guidance


class RecordPaths(eqx.Module):
    """What makes and moves the paths of R records, of one chain; `coarse` have half as many
    steps."""

    parameters: Parameters
    fine: GuidedRecords
    coarse: GuidedRecords

    @property
    def num_steps(self) -> int:
        """N, of each segment."""
        return self.fine.records.stacked.num_steps

    def at(self, theta: Float[Array, " p"]) -> At:
        """θ, and what guides paths there."""
        return At(theta, _guides(self.fine, self.parameters.bind(theta)))

    def first(
        self, key: Key[Array, ""], at: At
    ) -> tuple[Float[Array, "R points d"], Float[Array, "R 2 B"]]:
        """Paths to begin with, and log β of the moves of their blocks."""
        model, (records, points, _) = self.parameters.bind(at.theta), self.fine

        def one(problem, key, points, guide):
            noise = jax.random.normal(key, points.shape, points.dtype)
            path, log_weight = path_and_log_weight(problem, model, guide, noise)
            return jnp.where(jnp.isfinite(log_weight), path, points)

        paths = records.each(one, jax.random.split(key, records.number), points, at.guides)
        return paths, no_paths(records)[1]

    def renewed(
        self,
        key: Key[Array, ""],
        at: At,
        paths: Float[Array, "R points d"],
        log_scales: Float[Array, "R 2 B"],
    ) -> tuple[Float[Array, "R points d"], Bool[Array, "R 2 B 1"]]:
        """The paths after a sweep given θ, and which blocks moved."""
        model, (records, points, _) = self.parameters.bind(at.theta), self.fine

        def one(problem, key, points, guide, log_scales, path):
            (K, N), d = problem.record.dt.shape, problem.dim
            both = blocks_of_both_cuts(problem, points, guide, _BLOCK_LENGTH)
            old = Paths(path[0][:, None], path[1:].reshape(K, N, d, 1))
            made, taken = sweep(key, problem, model, both, log_scales, old)
            return jnp.concatenate([made.start.T, made.points.reshape(K * N, d)]), taken

        keys = jax.random.split(key, records.number)
        return records.each(one, keys, points, at.guides, log_scales, paths)

    def noise(
        self, key: Key[Array, ""], at: At, paths: Float[Array, "R points d"]
    ) -> tuple[Float[Array, "R points d"], Float[Array, ""]]:
        """ξ of these paths, and log w."""
        model, records = self.parameters.bind(at.theta), self.fine.records

        def one(problem, key, guide, path):
            return noise_and_log_weight(key, problem, model, guide, path)

        keys = jax.random.split(key, records.number)
        noise, log_weight = records.each(one, keys, at.guides, paths)
        return noise, jnp.sum(log_weight)

    def of_noise(
        self, at: At, noise: Float[Array, "R points d"]
    ) -> tuple[Float[Array, "R points d"], Float[Array, ""]]:
        """The paths of ξ, and log w."""
        return _of_noise(self.fine.records, self.parameters.bind(at.theta), at.guides, noise)

    def steps_are_too_long(
        self, theta: Float[Array, " p"], paths: Float[Array, "R points d"]
    ) -> Bool[Array, ""]:
        """Whether steps are too long for the drift along the path of some record."""
        model = self.parameters.bind(theta)
        one = lambda problem, path: steps_are_too_long(problem, model, path)
        return jnp.any(self.fine.records.each(one, paths))

    def coarse_log_weight(
        self, theta: Float[Array, " p"], noise: Float[Array, "R points d"]
    ) -> Float[Array, ""]:
        """log w̃ of ξ, with steps of twice the length."""
        return self._log_weight(self.coarse, theta, self._coarsened(noise))

    def either_log_weight(
        self, theta: Float[Array, " p"], noise: Float[Array, "R points d"], coarse: Bool[Array, ""]
    ) -> Float[Array, ""]:
        """log w̃ of ξ or log w, as `coarse` says: one program for both."""
        choose = lambda a, b: jnp.where(coarse, a, b) if eqx.is_array(a) else b
        grid = jax.tree.map(choose, self.coarse, self.fine)
        return self._log_weight(grid, theta, jnp.where(coarse, self._coarsened(noise), noise))

    def _log_weight(
        self, grid: GuidedRecords, theta: Float[Array, " p"], noise: Float[Array, "R points d"]
    ) -> Float[Array, ""]:
        model = self.parameters.bind(theta)
        return _of_noise(grid.records, model, _guides(grid, model), noise)[1]

    def _coarsened(self, noise: Float[Array, "R points d"]) -> Float[Array, "R points d"]:
        return jax.vmap(lambda noise: _of_pairs(noise, self.num_steps))(noise)


def check_no_bridges(**given: Any) -> None:
    """Raise `ValueError` where one of these arguments, which are about bridges between complete
    observations, is neither `None` nor what it is by default."""
    usual = lambda name, value: isinstance(value, str) and value == _USUAL.get(name)
    asked = [name for name, value in given.items() if value is not None and not usual(name, value)]
    if asked:
        raise ValueError(
            f"{' and '.join(f'`{name}`' for name in asked)}: for complete observations without "
            "noise. Omit this argument, or omit `observation`."
        )


def check_no_record(**given: Any) -> None:
    """Raise `ValueError` where one of these arguments, which are about records with an
    `observation`, is not `None`."""
    asked = [f"`{name}`" for name, value in given.items() if value is not None]
    if asked:
        raise ValueError(
            f"{' and '.join(asked)}: for records with an `observation`. Pass one, for instance "
            "`observation=jb.LinearGaussian(covariance=0.01)`, or omit this argument."
        )


def movable(records: Records) -> Bool[Array, "R 2 B"]:
    """Which blocks hold a part of a record."""
    return records.each(lambda problem: has_segments(problem, _BLOCK_LENGTH))


def share_of_step_error(records: Records) -> float:
    """The step error as a share of what half as many steps change."""
    return share_of_grid(records.stacked.density.order, records.stacked.num_steps)


def unguided(records: Records) -> GuidedRecords:
    """With points that stand in until there are some."""
    problem = records.stacked
    shape = records.number, problem.num_segments * problem.num_steps + 1, problem.dim
    dtype = problem.like.dtype
    return GuidedRecords(records, jnp.zeros(shape, dtype), no_check(records.number, dtype))


def on_both_grids(function: Callable, fine: PyTree, coarse: PyTree) -> Any:
    """`function` of what has fine and of what has coarse steps, in arrays of one shape: one after
    the other, in a leading axis, and compiled once."""
    arrays, rest = stacked(fine, coarse)
    return lax.map(lambda arrays: function(eqx.combine(arrays, rest)), arrays)


def guided_near(
    fine: Records, coarse: Records, model: Diffusion
) -> tuple[GuidedRecords, GuidedRecords]:
    """Linearised at the parameters of this model."""
    made = on_both_grids(lambda records: linearisations(records, model), fine, coarse)
    of_fine, of_coarse = (jax.tree.map(lambda leaf, i=i: leaf[i], made) for i in range(2))
    return GuidedRecords(fine, *of_fine), GuidedRecords(coarse, *of_coarse)


def no_paths(records: Records) -> tuple[Float[Array, "R points d"], Float[Array, "R 2 B"]]:
    """What stands in for paths, and log β of the moves of their blocks, until there are some."""
    num_blocks = cuts(records.stacked.num_segments, _BLOCK_LENGTH).shape[-1]
    points = unguided(records).points
    return points, jnp.zeros((records.number, 2, num_blocks), points.dtype)


@compiled_sooner
def as_record_paths(
    parameters: Parameters, records: Records, theta: Float[Array, " p"]
) -> RecordPaths:
    """Linearised at θ."""
    grids = guided_near(records, records.coarsened(), parameters.bind(theta))
    return RecordPaths(parameters, *grids)


def likely_root(
    parameters: Parameters,
    grid: GuidedRecords,
    log_prior: Callable[[Array], Array],
    theta: Float[Array, " p"],
    root: Float[Array, "p p"],
) -> Float[Array, "p p"]:
    """Return S of first moves that are as wide as the posterior of each parameter given the others.

    The likelihood is that of the guided path without noise, which is exact but for a constant
    where the model is linear. The width h is where the mean of the log densities at θ ± h is ½
    below that at θ, at most what the prior spans, ten times `root`; it is found by a few secants,
    which needs no derivatives and takes any start. `root` is kept where the path has no weight.
    """
    points, p = grid.points, theta.shape[0]

    def log_density(theta):
        model = parameters.bind(theta)
        _, log_weight = _of_noise(grid.records, model, _guides(grid, model), jnp.zeros_like(points))
        allowed = parameters.allowed(theta)
        return jnp.where(allowed, nan_to_neg_inf(log_weight) + log_prior(theta), -jnp.inf)

    def turn(width, _):
        steps = jnp.diag(width)
        values = lax.map(log_density, jnp.concatenate([theta[None], theta + steps, theta - steps]))
        drop = values[0] - (values[1 : p + 1] + values[p + 1 :]) / 2
        factor = jnp.clip(lax.rsqrt(2 * jnp.maximum(drop, 1e-3)), *_SECANT)
        factor = jnp.where(values[0] > -jnp.inf, factor, 1)
        return jnp.minimum(width * factor, 10 * jnp.diagonal(root)), values[0]

    first = jnp.diagonal(root)
    width, values = lax.scan(turn, first, length=_NUM_SECANTS)
    width = width * np.asarray(2.4 / np.sqrt(p), theta.dtype)
    return jnp.where(values[0] > -jnp.inf, jnp.diag(width), root)


def _guides(grid: GuidedRecords, model: Diffusion) -> Guidance:
    """What guides the paths of each record."""
    return grid.records.each(lambda problem, points: guided(problem, model, points), grid.points)


def _of_noise(
    records: Records, model: Diffusion, guides: Guidance, noise: Float[Array, "R points d"]
) -> tuple[Float[Array, "R points d"], Float[Array, ""]]:
    def one(problem, guide, noise):
        return path_and_log_weight(problem, model, guide, noise)

    paths, log_weight = records.each(one, guides, noise)
    return paths, jnp.sum(log_weight)


def _of_pairs(noise: Float[Array, "points d"], num_steps: int) -> Float[Array, "points d"]:
    """The noise of steps of twice the length, as `Record.coarsened` has them: of each pair of a
    segment the second step."""
    odd = num_steps % 2
    segments = noise[1:].reshape(-1, num_steps, noise.shape[-1])
    first, second = segments[:, odd::2], segments[:, odd + 1 :: 2]
    pairs = jnp.stack([first, (first + second) * np.sqrt(0.5).astype(noise.dtype)], axis=2)
    pairs = pairs.reshape(len(segments), -1, noise.shape[-1])
    segments = jnp.concatenate([segments[:, :odd], pairs], axis=1)
    return jnp.concatenate([noise[:1], segments.reshape(-1, noise.shape[-1])])
