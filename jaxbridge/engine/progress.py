"""Compiled loops that tell how far they are, by one of diffrax's progress meters."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

_State = TypeVar("_State")
_Context = TypeVar("_Context")


def as_meter(progress_meter: diffrax.AbstractProgressMeter | None) -> diffrax.AbstractProgressMeter:
    """The meter, by default one that tells nothing."""
    return diffrax.NoProgressMeter() if progress_meter is None else progress_meter


def metered_scan(
    step: Callable[[_State, Any], tuple[_State, Any]],
    init: _State,
    xs: PyTree,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> tuple[_State, Any]:
    """`lax.scan` over `xs`."""
    meter, length = as_meter(progress_meter), len(jax.tree.leaves(xs)[0])

    def told(carry, inputs):
        state, metered = carry
        i, x = inputs
        state, y = step(state, x)
        return (state, meter.step(metered, (i + 1).astype(jnp.float32) / length)), y

    (state, metered), ys = lax.scan(told, (init, meter.init()), (jnp.arange(length), xs))
    meter.close(metered)
    return state, ys


def metered_stages(
    begin: Callable[[_State, Int[Array, ""]], tuple[_State, _Context]],
    step: Callable[[_Context, _State, Int[Array, ""]], tuple[_State, Any]],
    init: _State,
    bounds: Sequence[int],
    num_kept: int,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> tuple[_State, Any]:
    """`step`s with numbers from zero to `bounds[-1]`, in stages that end at `bounds`. With what
    `begin` makes of the state, given the first number of a stage, go the steps of that stage. What
    the last `num_kept` make is kept. All stages are one loop, however they differ in length."""
    meter, length = as_meter(progress_meter), bounds[-1]
    begin, step = eqx.filter_jit(begin), eqx.filter_jit(step)  # for shapes and in the loop once

    def both(state):
        state, context = begin(state, jnp.int32(0))
        return step(context, state, jnp.int32(0))[1]

    shapes = eqx.filter_eval_shape(both, init)
    kept = jax.tree.map(lambda leaf: jnp.zeros((num_kept, *leaf.shape), leaf.dtype), shapes)

    def stage(carry, ends):
        (state, kept), metered = carry
        state, context = begin(state, ends[0])

        def one(i, carry):
            (state, kept), metered = carry
            state, made = step(context, state, i)
            place = jnp.maximum(i - (length - num_kept), 0)  # what is not kept is written over
            kept = jax.tree.map(lambda leaf, one: leaf.at[place].set(one), kept, made)
            return (state, kept), meter.step(metered, (i + 1).astype(jnp.float32) / length)

        return lax.fori_loop(ends[0], ends[1], one, ((state, kept), metered)), None

    ends = jnp.asarray(list(itertools.pairwise((0, *bounds))), jnp.int32)
    (made, metered), _ = lax.scan(stage, ((init, kept), meter.init()), ends)
    meter.close(metered)
    return made


def metered_while_loop(
    going_on: Callable[[_State], Bool[Array, ""]],
    step: Callable[[_State], _State],
    init: _State,
    progress: Callable[[_State], Float[Array, ""]],
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> _State:
    """`lax.while_loop`, of which `progress` says how much of it is done, from 0 to 1."""
    meter = as_meter(progress_meter)

    def told(carry):
        state, metered = carry
        state = step(state)
        return state, meter.step(metered, progress(state))

    carry = (init, meter.init())
    state, metered = lax.while_loop(lambda carry: going_on(carry[0]), told, carry)
    meter.close(metered)
    return state
