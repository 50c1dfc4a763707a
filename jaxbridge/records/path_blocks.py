"""Moves of the path of a record in blocks, given both ends of each block.

Given its ends, the path of a block is independent of all others. A record of K segments has two
partitions into blocks of J segments; the second is shifted by half a block. All blocks of one
partition move at once. The end of a block is an exact observation of the state, its beginning a
fixed state. At the beginning of the record it is the law of x_0; at the end of the record the state
is free. Steps of length zero fill a block beyond the record.

The path of a block is a function of noise ζ ~ N(0, I) with the weight w(ζ). Hence the move

    ζ' = √(1 - β²) ζ + β η,  η ~ N(0, I),    accepted with probability min(1, w(ζ') / w(ζ)),

leaves its law invariant (Neal 1998; Cotter, Roberts, Stuart & White 2013). With a good guide it is
accepted often, even for β = 1. One scan computes both paths and recovers ζ from the old one.

A chain may start from a path of weight zero, for instance if the first guided path diverged. Any
path of positive weight replaces it. The result reports chains with a block that never moved,
because their draws do not show their error.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.averages import nan_to_neg_inf
from ..engine.lanes import over_lanes
from ..engine.linalg import matvec
from ..exact import acceptance_rate
from ..models.diffusion import Diffusion
from ..schemes import solve_root
from .guided_record import Guidance, correction
from .guided_steps import Guide, end_of_step, guided_law, guided_start
from .information_filter import information_filter
from .initial import log_ratio
from .linearisation import LinearisedStep
from .observations import Row, Scalars, missing_like
from .problem import RecordProblem
from .record import Steps
from .segments import flat, following, split_last
from .tilted_step import NormalStep

# Acceptance rate to which the warm-up tunes β.
_TARGET = 0.4


class Paths(NamedTuple):
    """Knots of the paths of C chains (`guided_record`): x_0, and those of all steps."""

    start: Float[Array, "d C"]
    points: Float[Array, "K N d C"]


class GuidesToEnds(NamedTuple):
    """Guides of the steps of blocks, to any end e of the block.

    log h is quadratic in x and e together. Hence its precision does not depend on e, and its shift
    is r + Tᵀe. All chains share these guides.

    - `guide`: guides to e = 0.
    - `turn`, `next_turn`: T at the beginning and at the end of each step.
    """

    guide: Guide
    turn: Float[Array, "d d *lanes"]
    next_turn: Float[Array, "d d *lanes"]

    def to(self, end: Float[Array, " d"]) -> Guide:
        """Return the guide of one step to this end."""
        guide = self.guide
        h = guide.h._replace(shift=guide.h.shift + matvec(self.turn.T, end))
        next_h = guide.next_h._replace(shift=guide.next_h.shift + matvec(self.next_turn.T, end))
        return guide._replace(h=h, next_h=next_h)


class Blocks(NamedTuple):
    """Partition of a record into B blocks of J segments. Arrays have the blocks in the last axis.

    - `segment`: indices of the segments of each block, -1 before the record and K after it.
    - `guides`: guides of all steps to the end ξ, leading axes (J, N).
    - `scalars`, `rows`: observations at the ends of segments, leading axis J.
    - `first`, `first_row`: observation of x_0, for the first block; other blocks have a missing
        one.
    - `root`: root of the covariance of x_0, for the first block; zero for other blocks.
    - `mean`: mean of the law of x_0, shape (d,).
    - `goes_on`: whether a part of the record follows the block.
    """

    segment: Int[Array, "J B"]
    guides: GuidesToEnds
    scalars: Scalars
    rows: Row
    first: Scalars
    first_row: Row
    root: Float[Array, "d d B"]
    mean: Float[Array, " d"]
    goes_on: Bool[Array, " B"]


def cuts(num_segments: int, length: int) -> Int[np.ndarray, "2 J B"]:
    """Return the indices of the segments of each block, for both partitions."""
    length = min(length, num_segments)
    num_blocks = -(-(num_segments + length // 2) // length)

    def cut(offset: int) -> np.ndarray:
        number = np.arange(num_blocks * length) - offset
        return np.clip(number, -1, num_segments).reshape(num_blocks, length).T

    # Ends of blocks in one partition are inside blocks in the other, so all points move.
    return np.stack([cut(0), cut(length // 2)])


def has_length(problem: RecordProblem) -> Bool[Array, " K"]:
    """Return the mask of the segments that belong to the record.

    Additional segments beyond its end have steps of length zero.
    """
    return jnp.any(problem.record.dt > 0, axis=1)


def has_segments(problem: RecordProblem, length: int) -> Bool[Array, "2 B"]:
    """Return the mask of the blocks that contain a part of the record.

    The last block of a partition may lie beyond the record.
    """
    in_record = jnp.pad(has_length(problem), 1)
    return jnp.any(in_record[cuts(problem.num_segments, length) + 1], axis=1)


def blocks_of(
    problem: RecordProblem,
    points: Float[Array, "points d"],
    guide: Guidance,
    segment: Int[np.ndarray, "J B"],
) -> Blocks:
    """Return the blocks of one partition of a record that is guided along these points."""
    (K, N), d = problem.record.dt.shape, problem.dim
    outside = (segment < 0) | (segment >= K)
    inside = np.clip(segment, 0, K - 1)
    # Outside the record the path stays at its first or last point, by steps of length zero.
    of_step = np.where(outside, np.where(segment < 0, 0, K * N - 1), 0)[:, None]
    number = np.where(outside[:, None], of_step, inside[:, None] * N + np.arange(N)[:, None])
    edge = np.where(segment < 0, 0, K * N)[:, None]
    here = points[np.where(outside[:, None], edge, number)]  # (J, N, B, d)
    next_here = points[np.where(outside[:, None], edge, number + 1)]
    lengths = jax.tree.map(lambda leaf: leaf[number], flat(guide.steps.step))
    lengths = lengths._replace(dt=jnp.where(outside[:, None], 0, lengths.dt))
    if lengths.jump is not None:
        jump = lengths.jump
        jump = jump._replace(exists=jump.exists & ~outside[:, None])
        lengths = lengths._replace(jump=jump)
    dtype = points.dtype
    no_step = LinearisedStep(jnp.eye(d, dtype=dtype), *2 * [jnp.zeros((), dtype)])
    steps = jax.tree.map(
        lambda leaf, none: jnp.where(
            outside.reshape(len(outside), 1, -1, *(leaf.ndim - 1) * [1]), none, leaf[number]
        ),
        flat(guide.linear),
        no_step,
    )
    all_scalars = jax.tree.map(
        lambda first, tail: jnp.concatenate([first[None], tail]), guide.first, guide.scalars
    )
    all_scalars = _pad_rows(all_scalars, d)
    missing = missing_like(jax.tree.map(lambda leaf: leaf[0], all_scalars))

    def scalars_at(place: np.ndarray, absent: np.ndarray) -> Scalars:
        """Return the scalars at these ends of segments, missing ones where `absent`."""

        def of(all_, none):
            here = all_[place]
            return jnp.where(absent.reshape(*absent.shape, *[1] * none.ndim), none, here)

        return jax.tree.map(of, all_scalars, missing)

    lanes_last = lambda tree, axis: jax.tree.map(lambda leaf: jnp.moveaxis(leaf, axis, -1), tree)
    is_first = np.arange(segment.shape[1]) == 0
    at_end = np.where(outside, 0, inside + 1)
    values, times = problem.rows
    rows = Row(jnp.where(outside[..., None], jnp.nan, values[at_end]), times[at_end])
    lane_times = jnp.broadcast_to(times[0], is_first.shape)
    first_row = Row(jnp.where(is_first, values[0][:, None], jnp.nan), lane_times)
    # Whether the segment itself or a later one belongs to the record.
    after = jnp.cumsum(has_length(problem)[::-1])[::-1] > 0
    goes_on = jnp.append(after[1:], False)[inside[-1]]
    scalars = lanes_last(scalars_at(at_end, outside), 1)
    along = lanes_last(here, 2), lanes_last(next_here, 2), lanes_last(lengths, 2)
    return Blocks(
        jnp.asarray(segment),
        _guides_to_ends(lanes_last(steps, 2), scalars, goes_on, *along),
        scalars,
        lanes_last(rows, 1),
        lanes_last(scalars_at(np.zeros(len(is_first), int), ~is_first), 0),
        first_row,
        jnp.where(is_first, guide.initial.root[..., None], 0),
        guide.initial.mean,
        goes_on,
    )


def _pad_rows(scalars: Scalars, num: int) -> Scalars:
    """Return the scalars with at least `num` rows; additional rows are missing."""
    lacking = max(num - scalars.values.shape[1], 0)
    pad = lambda leaf, value: jnp.pad(
        leaf, [(0, 0), (0, lacking), *[(0, 0)] * (leaf.ndim - 2)], constant_values=value
    )
    return Scalars(*(pad(*both) for both in zip(scalars, (0, 0, 1, False), strict=True)))


class _Lanes(NamedTuple):
    """Blocks of all chains as B C lanes in the last axis, and the size of their moves.

    - `start`, `old`: beginnings of the old paths, and their knots, leading axes (J, N).
    - `end`: ends of the old paths, relative to ξ.
    - `scalars`: observations at the ends of segments.
    - `is_first`: whether the block begins at the beginning of the record.
    - `rho`, `beta`: √(1 - β²), and β.
    """

    start: Float[Array, "d lanes"]
    old: Float[Array, "J N d lanes"]
    end: Float[Array, "d lanes"]
    scalars: Scalars
    is_first: Bool[Array, " lanes"]
    rho: Float[Array, " lanes"]
    beta: Float[Array, " lanes"]


class _PathPair(NamedTuple):
    """Points of the old and the new path of each lane, and log weights of the paths up to there."""

    old: Float[Array, "d lanes"]
    new: Float[Array, "d lanes"]
    log_old: Float[Array, " lanes"]
    log_new: Float[Array, " lanes"]


def move(
    key: Key[Array, ""],
    problem: RecordProblem,
    model: Diffusion,
    blocks: Blocks,
    scale: Float[Array, " B"],
    paths: Paths,
) -> tuple[Paths, Bool[Array, "B C"]]:
    """Move the paths of all blocks, with β = `scale`.

    **Returns:** the paths, and which blocks accepted their proposals.
    """
    propose_key, accept_key = jax.random.split(key)
    lanes, first, last, new = _proposed(propose_key, problem, model, blocks, scale, paths)
    rate = acceptance_rate(nan_to_neg_inf(last.log_old), nan_to_neg_inf(last.log_new))
    accepted = jax.random.uniform(accept_key, rate.shape, rate.dtype) < rate

    # Join the blocks, and cut off the parts beyond the record.
    (J, B), (K, N), (d, C) = blocks.segment.shape, problem.record.dt.shape, paths.start.shape
    points = jnp.where(accepted, new, lanes.old).reshape(J, N, d, B, C)
    points = jnp.moveaxis(points, 3, 0).reshape(B * J, N, d, C)
    # The first segment of the record, after those before it in the first block.
    begin = jnp.argmax(blocks.segment.T.ravel() == 0)
    start = jnp.where(accepted, first.new, lanes.start).reshape(d, B, C)[:, 0]
    return Paths(start, lax.dynamic_slice_in_dim(points, begin, K)), accepted.reshape(B, C)


def _proposed(
    key: Key[Array, ""],
    problem: RecordProblem,
    model: Diffusion,
    blocks: Blocks,
    scale: Float[Array, " B"],
    paths: Paths,
) -> tuple[_Lanes, _PathPair, _PathPair, Float[Array, "J N d lanes"]]:
    """Return the lanes, the old and new paths at their beginnings and ends, and the new knots."""
    noise_key, start_key = jax.random.split(key)
    lanes = _lanes_of(blocks, scale, paths)
    first = _new_starts(start_key, problem, model, blocks, lanes)
    return lanes, first, *_new_points(noise_key, problem, model, blocks, lanes, first)


def log_evidence(
    key: Key[Array, ""], problem: RecordProblem, model: Diffusion, blocks: Blocks, paths: Paths
) -> Float[Array, " B"]:
    """Estimate the log density of the observations in each block and of its end.

    It is given the beginning of the block. Both ends are those of `paths`, and new paths between
    them, one for each chain, are the sample.
    """
    scale = jnp.ones(blocks.segment.shape[1], paths.start.dtype)
    _, _, last, _ = _proposed(key, problem, model, blocks, scale, paths)
    log_weights = nan_to_neg_inf(last.log_new).reshape(len(scale), -1)
    return jax.nn.logsumexp(log_weights, axis=1) - math.log(log_weights.shape[1])


def _lanes_of(blocks: Blocks, scale: Float[Array, " B"], paths: Paths) -> _Lanes:
    """Return the blocks of all chains as lanes."""
    B, (N, d, C) = blocks.segment.shape[1], paths.points.shape[1:]
    spread = functools.partial(_for_chains, C)
    joined = lambda leaf: leaf.reshape(*leaf.shape[:-2], B * C)
    # Old paths of the blocks, with x_0 before the record and the last point after it.
    padded = jnp.concatenate(
        [
            jnp.broadcast_to(paths.start, (1, N, d, C)),
            paths.points,
            jnp.broadcast_to(paths.points[-1, -1], (1, N, d, C)),
        ]
    )
    old = joined(jnp.moveaxis(padded[blocks.segment + 1], 1, -2))  # (J, N, d, B C)
    start = joined(jnp.moveaxis(padded[jnp.maximum(blocks.segment[0], 0), -1], 0, -2))
    end = old[-1, -1] - spread(blocks.guides.guide.next_point[-1, -1])
    scalars = _pin_ends(spread(blocks.scalars), spread(blocks.goes_on), end)
    is_first = spread(jnp.asarray(np.arange(B) == 0))
    size = spread((jnp.sqrt(1 - scale**2), scale))
    return _Lanes(start, old, end, scalars, is_first, *size)


def _guides_to_ends(
    linear: LinearisedStep,
    scalars: Scalars,
    goes_on: Bool[Array, " B"],
    points: Float[Array, "J N d B"],
    next_points: Float[Array, "J N d B"],
    lengths: Steps,
) -> GuidesToEnds:
    """Return the guides of all steps to any end of their block.

    d + 1 information filters run side by side. One has the end 0. The others have the unit vectors
    as ends and zero in all other terms of r, so their shifts are the rows of T.
    """
    d, B = points.shape[2:]
    for_ends = functools.partial(_for_chains, d + 1)
    # 1 in the lane of the end 0, and 0 in the lanes of the unit vectors.
    is_zero_end = jnp.tile(jnp.eye(1, d + 1, dtype=points.dtype)[0], B)
    linear, scalars = for_ends(linear), for_ends(scalars)
    linear = linear._replace(shift=linear.shift * is_zero_end)
    scalars = scalars._replace(values=scalars.values * is_zero_end)
    ends = jnp.tile(jnp.eye(d, d + 1, 1, dtype=points.dtype), (1, B))
    h = information_filter(linear, _pin_ends(scalars, for_ends(goes_on), ends), _in_lanes)
    by_end = jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-1], B, d + 1), h)
    zero = jax.tree.map(lambda leaf: leaf[..., 0], by_end)
    turn = jnp.moveaxis(by_end.shift[..., 1:], -1, 2)
    guide = Guide(points, zero, next_points, following(zero), lengths)
    return GuidesToEnds(guide, turn, following(turn))


def _pin_ends(
    scalars: Scalars, goes_on: Bool[Array, " lanes"], end: Float[Array, "d lanes"]
) -> Scalars:
    """Return the scalars with the end of each block as an exact observation.

    If the record ends in a block, the last observation of this block stays.
    """
    last = jax.tree.map(lambda leaf: leaf[-1], scalars)
    exact = _exact_in_lanes(end, last, goes_on)
    return jax.tree.map(lambda leaf, pin: leaf.at[-1].set(pin), scalars, exact)


def _new_starts(
    key: Key[Array, ""], problem: RecordProblem, model: Diffusion, blocks: Blocks, lanes: _Lanes
) -> _PathPair:
    """Sample the beginnings of the new paths: new points only at the beginning of the record."""
    spread = functools.partial(_for_chains, lanes.start.shape[-1] // blocks.segment.shape[1])
    hidden = _no_noise(blocks)

    def of_start(x, mean, root, first, step, end, eta, rho, beta):
        guide = step.to(end)
        law = guided_start(NormalStep(mean, root), first, guide.point, guide.h)
        solve = functools.partial(solve_root, root)
        zeta, log_old = law.noise_and_log_weight(x, solve, hidden)
        new, log_new = law.point_and_log_weight(_new_noise(zeta, eta, rho, beta))
        return new, log_old, log_new

    initial = NormalStep(blocks.mean, blocks.root[..., 0])
    # Other blocks begin at a fixed point: the mean is this point, and the root is zero.
    means = jnp.where(lanes.is_first, initial.mean[:, None], lanes.start)
    step = spread(jax.tree.map(lambda leaf: leaf[0, 0], blocks.guides))
    eta = jax.random.normal(key, lanes.start.shape, lanes.start.dtype)
    law = (means, spread(blocks.root), spread(blocks.first), step, lanes.end)
    arguments = (lanes.start, *law, eta, lanes.rho, lanes.beta)
    new, log_old, log_new = over_lanes(*9 * [-1])(of_start)(*arguments)
    new = jnp.where(lanes.is_first, new, lanes.start)
    corrected = _corrections(problem, model, spread)
    of_law = lambda x: log_ratio(problem.initial, model, initial, x)

    def log_weight(x, log_start):
        ratio = jnp.where(lanes.is_first, over_lanes(-1)(of_law)(x), 0)
        return log_start + corrected(blocks.first_row, x) + ratio

    log_weights = log_weight(lanes.start, log_old), log_weight(new, log_new)
    return _PathPair(lanes.start, new, *log_weights)


def _new_points(
    key: Key[Array, ""],
    problem: RecordProblem,
    model: Diffusion,
    blocks: Blocks,
    lanes: _Lanes,
    first: _PathPair,
) -> tuple[_PathPair, Float[Array, "J N d lanes"]]:
    """Sample the knots of the new paths; compute the log weights of the old and new paths."""
    spread = functools.partial(_for_chains, lanes.start.shape[-1] // blocks.segment.shape[1])
    motion = problem.motion(model)
    hidden, corrected = _no_noise(blocks), _corrections(problem, model, spread)

    def step_of(old, new, old_knot, eta, step, end, scalars, rho, beta):
        guide, is_last = step.to(end), scalars is not None
        law = motion.law(old, guide.step)
        here = guided_law(law, guide, scalars)
        zeta, log_old = here.noise_and_log_weight(old_knot, law.solve, hidden)
        old = end_of_step(law, old_knot, is_last)
        law = motion.law(new, guide.step)
        there = guided_law(law, guide, scalars)
        knot, log_new = there.point_and_log_weight(_new_noise(zeta, eta, rho, beta))
        return _PathPair(old, end_of_step(law, knot, is_last), log_old, log_new), knot

    def advance(state: _PathPair, old_knot, eta, step, scalars) -> tuple[_PathPair, Array]:
        axes = (*6 * [-1], None if scalars is None else -1, -1, -1)
        # Guides and rows are spread over the chains step by step, to save memory.
        lane_inputs = (state.old, state.new, old_knot, eta, spread(step), lanes.end, scalars)
        pair, knot = over_lanes(*axes)(step_of)(*lane_inputs, lanes.rho, lanes.beta)
        log_old, log_new = state.log_old + pair.log_old, state.log_new + pair.log_new
        return pair._replace(log_old=log_old, log_new=log_new), knot

    def one(state, inputs):
        old_knot, eta, step = inputs
        return advance(state, old_knot, eta, step, None)

    def segment(state, inputs):
        number, old, guides, scalars, row = inputs
        eta = jax.random.normal(jax.random.fold_in(key, number), old.shape, old.dtype)
        plain, (old_last, eta_last, guide_last) = split_last((old, eta, guides))
        state, knots = lax.scan(one, state, plain)
        state, last_knot = advance(state, old_last, eta_last, guide_last, scalars)
        # At a pinned end both paths have the same state, so this term cancels there.
        state = state._replace(
            log_old=state.log_old + corrected(row, state.old),
            log_new=state.log_new + corrected(row, state.new),
        )
        return state, jnp.concatenate([knots, last_knot[None]])

    numbers = jnp.arange(len(lanes.old))
    inputs = (numbers, lanes.old, blocks.guides, lanes.scalars, blocks.rows)
    return lax.scan(segment, first, inputs)


def _for_chains(num_chains: int, tree: PyTree) -> PyTree:
    """Repeat the entries of blocks for the lanes of all chains."""
    return jax.tree.map(lambda leaf: jnp.repeat(leaf, num_chains, axis=-1), tree)


def _new_noise(zeta, eta, rho, beta):
    """Return the new noise ζ' = √(1 - β²) ζ + β η.

    ζ of a path of weight zero may not be finite; zero replaces it.
    """
    return rho * jnp.where(jnp.isfinite(zeta), zeta, 0) + beta * eta


def _no_noise(blocks: Blocks) -> Float[Array, " n"]:
    """Return zeros for the noise that does not move a path.

    This noise is independent of the path, so its value does not matter.
    """
    return jnp.zeros(blocks.first.values.shape[0], blocks.mean.dtype)


def _corrections(
    problem: RecordProblem, model: Diffusion, spread: Callable[[PyTree], PyTree]
) -> Callable[[Row, Float[Array, "d lanes"]], Float[Array, " lanes"]]:
    """Return a function of rows of blocks and states of lanes, with the terms of `correction`."""
    of_lanes = over_lanes(-1, -1)(correction(problem, model))
    return lambda row, x: of_lanes(spread(row), x)


def blocks_of_both_cuts(
    problem: RecordProblem, points: Float[Array, "points d"], guide: Guidance, length: int
) -> Blocks:
    """Return the blocks of both partitions, stacked in a leading axis."""
    partitions = [
        blocks_of(problem, points, guide, cut) for cut in cuts(problem.num_segments, length)
    ]
    return jax.tree.map(lambda *both: jnp.stack(both), *partitions)


def sweep(
    key: Key[Array, ""],
    problem: RecordProblem,
    model: Diffusion,
    both: Blocks,
    log_scales: Float[Array, "2 B"],
    paths: Paths,
) -> tuple[Paths, Bool[Array, "2 B C"]]:
    """Move the paths of all blocks of one partition, then of the other, with the given log β.

    **Returns:** the paths, and which blocks accepted their proposals.
    """

    def one(paths, inputs):
        number, blocks, log_scale = inputs
        cut_key = jax.random.fold_in(key, number)
        return move(cut_key, problem, model, blocks, jnp.exp(log_scale), paths)

    return lax.scan(one, paths, (jnp.arange(2), both, log_scales))


def swept_path(
    key: Key[Array, ""],
    problem: RecordProblem,
    model: Diffusion,
    linearisation: tuple[Float[Array, "points d"], Guidance],
    length: int,
    log_scales: Float[Array, "2 B"],
    path: Float[Array, "points d"],
) -> tuple[Float[Array, "points d"], Bool[Array, "2 B 1"]]:
    """Move the blocks of both partitions of one path, by its knots, and return which of them moved.

    `linearisation` are the points along which the model is linearised, and the guide along them.
    """
    (K, N), d = problem.record.dt.shape, problem.dim
    both = blocks_of_both_cuts(problem, *linearisation, length)
    old = Paths(path[0][:, None], path[1:].reshape(K, N, d, 1))
    new, accepted = sweep(key, problem, model, both, log_scales, old)
    return jnp.concatenate([new.start.T, new.points.reshape(K * N, d)]), accepted


def tuned(
    log_scales: Float[Array, "*moves"], accepted: Bool[Array, "*moves C"], number: Float[Array, ""]
) -> Float[Array, "*moves"]:
    """Return the adapted log β after sweep `number` of a warm-up.

    `accepted` states which moves of this sweep were accepted. The step of this stochastic
    approximation falls like `number`^-0.6.
    """
    share = jnp.mean(accepted.astype(log_scales.dtype), axis=-1)
    # β is at most 1.
    return jnp.minimum(log_scales + number**-0.6 * (share - _TARGET), 0)


def _in_lanes(function: Callable) -> Callable:
    """Map a function of one block over the last axis of all arguments."""
    return lambda *arguments: over_lanes(*len(arguments) * [-1])(function)(*arguments)


def _exact_in_lanes(
    point: Float[Array, "d lanes"], otherwise: Scalars, where: Bool[Array, " lanes"]
) -> Scalars:
    """Return exact observations of the state in some lanes, and the present ones in the others.

    `point` is relative to ξ.
    """
    d, rows = point.shape[0], otherwise.values.shape[0]
    exact = Scalars(
        jnp.broadcast_to(jnp.eye(rows, d, dtype=point.dtype)[..., None], otherwise.rows.shape),
        jnp.zeros_like(otherwise.values).at[:d].set(point),
        jnp.ones_like(otherwise.variances).at[:d].set(0),
        jnp.zeros_like(otherwise.seen).at[:d].set(True),
    )
    return jax.tree.map(lambda pin, leaf: jnp.where(where, pin, leaf), exact, otherwise)
