"""Compiled loops that report their progress to one of diffrax's progress meters."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from .interrupt import InterruptibleMeter

_State = TypeVar("_State")
_Context = TypeVar("_Context")
_Item = TypeVar("_Item")


def as_meter(progress_meter: diffrax.AbstractProgressMeter | None) -> diffrax.AbstractProgressMeter:
    """Return the progress meter, with checks for Ctrl-C; for `None`, one without any effect."""
    if progress_meter is None or isinstance(progress_meter, diffrax.NoProgressMeter):
        return diffrax.NoProgressMeter()
    return InterruptibleMeter(progress_meter)


def metered(
    items: Sequence[_Item], progress_meter: diffrax.AbstractProgressMeter | None
) -> Iterator[_Item]:
    """Iterate over items in Python, with a progress meter."""
    meter = as_meter(progress_meter)
    state = meter.init()
    for number, item in enumerate(items, start=1):
        yield item
        state = meter.step(state, jnp.asarray(number / len(items)))
    meter.close(state)


def metered_scan(
    step: Callable[[_State, Any], tuple[_State, Any]],
    init: _State,
    xs: PyTree,
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> tuple[_State, Any]:
    """Run `lax.scan` over `xs`, and report the share of steps that are complete."""
    meter, length = as_meter(progress_meter), len(jax.tree.leaves(xs)[0])

    def metered_step(carry, inputs):
        state, metered = carry
        i, x = inputs
        state, y = step(state, x)
        return (state, meter.step(metered, (i + 1).astype(jnp.float32) / length)), y

    (state, metered), ys = lax.scan(metered_step, (init, meter.init()), (jnp.arange(length), xs))
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
    """Run steps with numbers 0 to `bounds[-1]` - 1 in stages that end at `bounds`.

    - `begin(state, i)` returns the state and the context of a stage, from the number i of its first
      step.
    - `step(context, state, i)` returns the state and the output of step i.

    Return the last state and the outputs of the last `num_kept` steps. All stages are one loop,
    which is compiled once, whatever their lengths.
    """
    meter, length = as_meter(progress_meter), bounds[-1]
    # `filter_jit` traces each of them once, for the shapes and for the loop.
    begin, step = eqx.filter_jit(begin), eqx.filter_jit(step)

    def first_output(state):
        state, context = begin(state, jnp.int32(0))
        return step(context, state, jnp.int32(0))[1]

    shapes = eqx.filter_eval_shape(first_output, init)
    outputs = jax.tree.map(lambda leaf: jnp.zeros((num_kept, *leaf.shape), leaf.dtype), shapes)

    def run_stage(carry, ends):
        (state, outputs), metered = carry
        state, context = begin(state, ends[0])

        def run_step(i, carry):
            (state, outputs), metered = carry
            state, output = step(context, state, i)
            place = jnp.maximum(i - (length - num_kept), 0)  # earlier outputs are overwritten
            outputs = jax.tree.map(lambda stored, new: stored.at[place].set(new), outputs, output)
            return (state, outputs), meter.step(metered, (i + 1).astype(jnp.float32) / length)

        return lax.fori_loop(ends[0], ends[1], run_step, ((state, outputs), metered)), None

    # The ends are traced numbers, so stages of different lengths share one compiled body.
    ends = jnp.asarray(list(itertools.pairwise((0, *bounds))), jnp.int32)
    (results, metered), _ = lax.scan(run_stage, ((init, outputs), meter.init()), ends)
    meter.close(metered)
    return results


def metered_while_loop(
    continues: Callable[[_State], Bool[Array, ""]],
    step: Callable[[_State], _State],
    init: _State,
    progress: Callable[[_State], Float[Array, ""]],
    progress_meter: diffrax.AbstractProgressMeter | None,
) -> _State:
    """Run `lax.while_loop`; `progress(state)` returns the share that is complete, from 0 to 1."""
    meter = as_meter(progress_meter)

    # The state of the meter is a part of the loop's state.
    def metered_step(carry):
        state, metered = carry
        state = step(state)
        return state, meter.step(metered, progress(state))

    carry = (init, meter.init())
    state, metered = lax.while_loop(lambda carry: continues(carry[0]), metered_step, carry)
    meter.close(metered)
    return state
