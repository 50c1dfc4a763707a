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
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.averages import proper
from ..engine.lanes import over_lanes
from ..engine.linalg import matvec
from ..exact import acceptance_rate
from ..models.diffusion import Diffusion
from ..schemes import solve_root
from .guided_record import Guidance, correction
from .guided_steps import Guide, guided_law, guided_start, target_law
from .information_filter import information_filter
from .initial import log_ratio
from .linearisation import LinearisedStep
from .observation import Row, Scalars
from .problem import RecordProblem
from .record import Steps
from .segments import flat, following, split_last
from .tilted_step import NormalStep

# Of the moves: the share accepted to which β is tuned.
_TARGET = 0.4


class Paths(NamedTuple):
    """Of C chains: x_0, and the points at the ends of all steps."""

    start: Float[Array, "d C"]
    points: Float[Array, "K N d C"]


class GuidesToEnds(NamedTuple):
    """What guides steps to any end e: log h is quadratic in x and e together, so that its precision
    does not depend on e, and its shift is r + Tᵀe. Chains share it, block by block.

    - `guide`: for e = 0.
    - `turn`, `next_turn`: T at the beginning and at the end of the step.
    """

    guide: Guide
    turn: Float[Array, "d d *lanes"]
    next_turn: Float[Array, "d d *lanes"]

    def to(self, end: Float[Array, " d"]) -> Guide:
        """The guide of one step to this end."""
        guide = self.guide
        h = guide.h._replace(shift=guide.h.shift + matvec(self.turn.T, end))
        next_h = guide.next_h._replace(shift=guide.next_h.shift + matvec(self.next_turn.T, end))
        return guide._replace(h=h, next_h=next_h)


class Blocks(NamedTuple):
    """One cut of a record into B blocks of J segments; arrays have blocks in the last axis.

    - `segment`: which segments the blocks are made of, -1 before the record and K after it.
    - `guides`: of all steps, leading axes (J, N), to the end ξ.
    - `scalars`, `rows`: what is seen at the ends of segments, leading axis J.
    - `first`, `first_row`, `root`: what is seen of x_0, and the root of its law; of other blocks
        nothing, and zero. `mean`: that of the law of x_0, shape (d,).
    - `goes_on`: after which of them there is more of the record.
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
    """Which segments the blocks of each cut are made of."""
    length = min(length, num_segments)
    num_blocks = -(-(num_segments + length // 2) // length)

    def cut(offset: int) -> np.ndarray:
        number = np.arange(num_blocks * length) - offset
        return np.clip(number, -1, num_segments).reshape(num_blocks, length).T

    return np.stack([cut(0), cut(length // 2)])


def has_length(problem: RecordProblem) -> Bool[Array, " K"]:
    """Which segments are a part of the record: those beyond its end have steps of length zero."""
    return jnp.any(problem.record.dt > 0, axis=1)


def has_segments(problem: RecordProblem, length: int) -> Bool[Array, "2 B"]:
    """Which blocks of each cut hold a part of the record: the last may lie beyond it."""
    some = jnp.pad(has_length(problem), 1)
    return jnp.any(some[cuts(problem.num_segments, length) + 1], axis=1)


def blocks_of(
    problem: RecordProblem,
    points: Float[Array, "points d"],
    guide: Guidance,
    segment: Int[np.ndarray, "J B"],
) -> Blocks:
    """The blocks of one cut, of a record that is guided along these points."""
    (K, N), d = problem.record.dt.shape, problem.dim
    outside = (segment < 0) | (segment >= K)
    inside = np.clip(segment, 0, K - 1)
    # Outside the record there is one point, and steps of no length.
    of_step = np.where(outside, np.where(segment < 0, 0, K * N - 1), 0)[:, None]
    number = np.where(outside[:, None], of_step, inside[:, None] * N + np.arange(N)[:, None])
    edge = np.where(segment < 0, 0, K * N)[:, None]
    here = points[np.where(outside[:, None], edge, number)]  # (J, N, B, d)
    there = points[np.where(outside[:, None], edge, number + 1)]
    lengths = jax.tree.map(lambda leaf: leaf.reshape(-1)[number], problem.record.steps())
    lengths = lengths._replace(dt=jnp.where(outside[:, None], 0, lengths.dt))
    dtype = points.dtype
    still = LinearisedStep(jnp.eye(d, dtype=dtype), *2 * [jnp.zeros((), dtype)])
    steps = jax.tree.map(
        lambda leaf, none: jnp.where(
            outside.reshape(len(outside), 1, -1, *(leaf.ndim - 1) * [1]), none, leaf[number]
        ),
        flat(guide.linear),
        still,
    )
    everything = jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest]), guide.first, guide.scalars
    )
    everything = _filled(everything, d)
    nothing = _nothing_like(jax.tree.map(lambda leaf: leaf[0], everything))

    def seen(place: np.ndarray, absent: np.ndarray) -> Scalars:
        """At these ends of segments, nothing where it is absent; their axes first."""

        def of(all_, none):
            here = all_[place]
            return jnp.where(absent.reshape(*absent.shape, *[1] * none.ndim), none, here)

        return jax.tree.map(of, everything, nothing)

    lanes_last = lambda tree, axis: jax.tree.map(lambda leaf: jnp.moveaxis(leaf, axis, -1), tree)
    is_first = np.arange(segment.shape[1]) == 0
    at_end = np.where(outside, 0, inside + 1)
    values, times = problem.rows
    rows = Row(jnp.where(outside[..., None], jnp.nan, values[at_end]), times[at_end])
    lane_times = jnp.broadcast_to(times[0], is_first.shape)
    first_row = Row(jnp.where(is_first, values[0][:, None], jnp.nan), lane_times)
    # Whether a segment has a length, or one that comes after it.
    after = jnp.cumsum(has_length(problem)[::-1])[::-1] > 0
    goes_on = jnp.append(after[1:], False)[inside[-1]]
    scalars = lanes_last(seen(at_end, outside), 1)
    along = lanes_last(here, 2), lanes_last(there, 2), lengths
    return Blocks(
        jnp.asarray(segment),
        _guides_to_ends(lanes_last(steps, 2), scalars, goes_on, *along),
        scalars,
        lanes_last(rows, 1),
        lanes_last(seen(np.zeros(len(is_first), int), ~is_first), 0),
        first_row,
        jnp.where(is_first, guide.initial.root[..., None], 0),
        guide.initial.mean,
        goes_on,
    )


def _nothing_like(scalars: Scalars) -> Scalars:
    """Of as many rows, of which nothing is seen."""
    return Scalars(
        jnp.zeros_like(scalars.rows),
        jnp.zeros_like(scalars.values),
        jnp.ones_like(scalars.variances),
        jnp.zeros_like(scalars.seen),
    )


def _filled(scalars: Scalars, num: int) -> Scalars:
    """With at least so many rows, of which nothing is seen in those that were not there."""
    lacking = max(num - scalars.values.shape[1], 0)
    pad = lambda leaf, value: jnp.pad(
        leaf, [(0, 0), (0, lacking), *[(0, 0)] * (leaf.ndim - 2)], constant_values=value
    )
    return Scalars(*(pad(*both) for both in zip(scalars, (0, 0, 1, False), strict=True)))


class _Lanes(NamedTuple):
    """The blocks of all chains, B C lanes in the last axis: their old paths, what guides paths to
    the ends of these, and how far noise turns.

    - `start`, `old`: where the old paths begin, and their points, leading axes (J, N).
    - `end`: where the old paths end, counted from ξ.
    - `scalars`: what is seen at the ends of segments.
    - `is_first`: which begin where the record does.
    - `rho`, `beta`: √(1 - β²), and β.
    """

    start: Float[Array, "d lanes"]
    old: Float[Array, "J N d lanes"]
    end: Float[Array, "d lanes"]
    scalars: Scalars
    is_first: Bool[Array, " lanes"]
    rho: Float[Array, " lanes"]
    beta: Float[Array, " lanes"]


class _State(NamedTuple):
    """The old and the new path of each lane, and their log weights."""

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
    """New paths of all blocks, with β = `scale`; and which blocks took theirs."""
    noise_key, start_key, accept_key = jax.random.split(key, 3)
    lanes = _lanes_of(blocks, scale, paths)
    first = _new_starts(start_key, problem, model, blocks, lanes)
    last, new = _new_points(noise_key, problem, model, blocks, lanes, first)
    rate = acceptance_rate(proper(last.log_old), proper(last.log_new))
    accepted = jax.random.uniform(accept_key, rate.shape, rate.dtype) < rate

    # The blocks one after the other, without what reaches beyond the record.
    (J, B), (K, N), (d, C) = blocks.segment.shape, problem.record.dt.shape, paths.start.shape
    points = jnp.where(accepted, new, lanes.old).reshape(J, N, d, B, C)
    points = jnp.moveaxis(points, 3, 0).reshape(B * J, N, d, C)
    begin = jnp.argmax(blocks.segment.T.ravel() == 0)
    start = jnp.where(accepted, first.new, lanes.start).reshape(d, B, C)[:, 0]
    return Paths(start, lax.dynamic_slice_in_dim(points, begin, K)), accepted.reshape(B, C)


def _lanes_of(blocks: Blocks, scale: Float[Array, " B"], paths: Paths) -> _Lanes:
    B, (N, d, C) = blocks.segment.shape[1], paths.points.shape[1:]
    spread = functools.partial(_for_chains, C)
    joined = lambda leaf: leaf.reshape(*leaf.shape[:-2], B * C)
    # The old paths of the blocks: before the record x_0, after it the last point.
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
    scalars = _pinned(spread(blocks.scalars), spread(blocks.goes_on), end)
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
    """By the filter to the end 0; and side by side to each of the unit vectors, with all else that
    r is made of zero, for T."""
    d, B = points.shape[2:]
    several = functools.partial(_for_chains, d + 1)
    whole = jnp.tile(jnp.eye(1, d + 1, dtype=points.dtype)[0], B)
    linear, scalars = several(linear), several(scalars)
    linear = linear._replace(shift=linear.shift * whole)
    scalars = scalars._replace(values=scalars.values * whole)
    ends = jnp.tile(jnp.eye(d, d + 1, 1, dtype=points.dtype), (1, B))
    h = information_filter(linear, _pinned(scalars, several(goes_on), ends), _in_lanes)
    each = jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-1], B, d + 1), h)
    zero = jax.tree.map(lambda leaf: leaf[..., 0], each)
    turn = jnp.moveaxis(each.shift[..., 1:], -1, 2)
    guide = Guide(points, zero, next_points, following(zero), lengths)
    return GuidesToEnds(guide, turn, following(turn))


def _pinned(
    scalars: Scalars, goes_on: Bool[Array, " lanes"], end: Float[Array, "d lanes"]
) -> Scalars:
    """What is seen at the ends of segments, where unless the record has ended the last is exact."""
    last = jax.tree.map(lambda leaf: leaf[-1], scalars)
    exact = _seen_exactly(end, last, goes_on)
    return jax.tree.map(lambda leaf, pin: leaf.at[-1].set(pin), scalars, exact)


def _new_starts(
    key: Key[Array, ""], problem: RecordProblem, model: Diffusion, blocks: Blocks, lanes: _Lanes
) -> _State:
    """Where the paths begin: new only where the record does."""
    spread = functools.partial(_for_chains, lanes.start.shape[-1] // blocks.segment.shape[1])
    nothing = _no_noise(blocks)

    def of_start(x, mean, root, first, step, end, eta, rho, beta):
        guide = step.to(end)
        law = guided_start(NormalStep(mean, root), first, guide.point, guide.h)
        solve = functools.partial(solve_root, root)
        zeta, log_old = law.noise_and_log_weight(x, solve, nothing)
        new, log_new = law.point_and_log_weight(_turned(zeta, eta, rho, beta))
        return new, log_old, log_new

    initial = NormalStep(blocks.mean, blocks.root[..., 0])
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
    return _State(lanes.start, new, *log_weights)


def _new_points(
    key: Key[Array, ""],
    problem: RecordProblem,
    model: Diffusion,
    blocks: Blocks,
    lanes: _Lanes,
    first: _State,
) -> tuple[_State, Float[Array, "J N d lanes"]]:
    """The rest of the new paths, and the weights of both."""
    spread = functools.partial(_for_chains, lanes.start.shape[-1] // blocks.segment.shape[1])
    density, dynamics_at = problem.density, model.forward_at(problem.like)
    nothing, corrected = _no_noise(blocks), _corrections(problem, model, spread)

    def step_of(old, new, old_next, eta, step, end, scalars, rho, beta):
        guide = step.to(end)
        law = target_law(density, dynamics_at, old, guide.step)
        here = guided_law(law, guide, scalars)
        zeta, log_old = here.noise_and_log_weight(old_next, law.solve, nothing)
        law = target_law(density, dynamics_at, new, guide.step)
        there = guided_law(law, guide, scalars)
        new, log_new = there.point_and_log_weight(_turned(zeta, eta, rho, beta))
        return new, log_old, log_new

    def advance(state: _State, old_next, eta, step, scalars) -> _State:
        axes = (*6 * [-1], None if scalars is None else -1, -1, -1)
        # Of chains no more is kept than they do not share.
        each = (state.old, state.new, old_next, eta, spread(step), lanes.end, scalars)
        new, log_old, log_new = over_lanes(*axes)(step_of)(*each, lanes.rho, lanes.beta)
        return _State(old_next, new, state.log_old + log_old, state.log_new + log_new)

    def one(state, inputs):
        old_next, eta, step = inputs
        state = advance(state, old_next, eta, step, None)
        return state, state.new

    def segment(state, inputs):
        number, old, guides, scalars, row = inputs
        eta = jax.random.normal(jax.random.fold_in(key, number), old.shape, old.dtype)
        plain, (old_last, eta_last, guide_last) = split_last((old, eta, guides))
        state, path = lax.scan(one, state, plain)
        state = advance(state, old_last, eta_last, guide_last, scalars)
        # What is seen at a pinned end weighs both paths alike.
        state = state._replace(
            log_old=state.log_old + corrected(row, state.old),
            log_new=state.log_new + corrected(row, state.new),
        )
        return state, jnp.concatenate([path, state.new[None]])

    numbers = jnp.arange(len(lanes.old))
    inputs = (numbers, lanes.old, blocks.guides, lanes.scalars, blocks.rows)
    return lax.scan(segment, first, inputs)


def _for_chains(num_chains: int, tree: PyTree) -> PyTree:
    """What belongs to blocks, in the lanes of all chains."""
    return jax.tree.map(lambda leaf: jnp.repeat(leaf, num_chains, axis=-1), tree)


def _turned(zeta, eta, rho, beta):
    """ζ' = √(1 - β²) ζ + β η; of a path of no weight ζ may be anything."""
    return rho * jnp.where(jnp.isfinite(zeta), zeta, 0) + beta * eta


def _no_noise(blocks: Blocks) -> Float[Array, " n"]:
    """In the place of noise that does not move a path: it stays apart from all that does."""
    return jnp.zeros(blocks.first.values.shape[0], blocks.mean.dtype)


def _corrections(
    problem: RecordProblem, model: Diffusion, spread: Callable[[PyTree], PyTree]
) -> Callable[[Row, Float[Array, "d lanes"]], Float[Array, " lanes"]]:
    """Of what blocks saw, and the states of their lanes."""
    each = over_lanes(-1, -1)(correction(problem, model))
    return lambda row, x: each(spread(row), x)


def blocks_of_both_cuts(
    problem: RecordProblem, points: Float[Array, "points d"], guide: Guidance, length: int
) -> Blocks:
    """The blocks of both cuts, in a leading axis."""
    each = [blocks_of(problem, points, guide, cut) for cut in cuts(problem.num_segments, length)]
    return jax.tree.map(lambda *both: jnp.stack(both), *each)


def sweep(
    key: Key[Array, ""],
    problem: RecordProblem,
    model: Diffusion,
    both: Blocks,
    log_scales: Float[Array, "2 B"],
    paths: Paths,
) -> tuple[Paths, Bool[Array, "2 B C"]]:
    """New paths of all blocks of one cut, then of the other, with log β; and which took theirs."""

    def one(paths, inputs):
        number, blocks, log_scale = inputs
        mine = jax.random.fold_in(key, number)
        return move(mine, problem, model, blocks, jnp.exp(log_scale), paths)

    return lax.scan(one, paths, (jnp.arange(2), both, log_scales))


def tuned(
    log_scales: Float[Array, "*moves"], taken: Bool[Array, "*moves C"], number: Float[Array, ""]
) -> Float[Array, "*moves"]:
    """log β after the sweep of this number in a warm-up, in which these moves were accepted."""
    share = jnp.mean(taken.astype(log_scales.dtype), axis=-1)
    return jnp.minimum(log_scales + number**-0.6 * (share - _TARGET), 0)


def _in_lanes(function: Callable) -> Callable:
    return lambda *arguments: over_lanes(*len(arguments) * [-1])(function)(*arguments)


def _seen_exactly(
    point: Float[Array, "d lanes"], otherwise: Scalars, where: Bool[Array, " lanes"]
) -> Scalars:
    """The state itself, counted from ξ, as what is seen; in other lanes what is seen there."""
    d, rows = point.shape[0], otherwise.values.shape[0]
    exact = Scalars(
        jnp.broadcast_to(jnp.eye(rows, d, dtype=point.dtype)[..., None], otherwise.rows.shape),
        jnp.zeros_like(otherwise.values).at[:d].set(point),
        jnp.ones_like(otherwise.variances).at[:d].set(0),
        jnp.zeros_like(otherwise.seen).at[:d].set(True),
    )
    return jax.tree.map(lambda pin, leaf: jnp.where(where, pin, leaf), exact, otherwise)
