"""Compiled loops that tell how far they are, by one of diffrax's progress meters."""

from collections.abc import Callable
from typing import Any, TypeVar

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

_State = TypeVar("_State")


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
