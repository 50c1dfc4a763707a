"""What is seen of a function by tracing it: which of its values depend on its argument."""

from collections.abc import Callable

import jax.extend
from jaxtyping import Array, Float


def uses_argument(function: Callable, like: Float[Array, " d"]) -> bool:
    """Whether the values of `function` depend on its argument, by following its jaxpr."""
    jaxpr = jax.make_jaxpr(function)(like).jaxpr
    return any(_reached(jaxpr, [True] * len(jaxpr.invars)))


def _reached(jaxpr: jax.extend.core.Jaxpr, given: list[bool]) -> list[bool]:
    """Which results depend on the given arguments."""
    reached = {var for var, own in zip(jaxpr.invars, given, strict=True) if own}

    def is_reached(atom) -> bool:
        return not isinstance(atom, jax.extend.core.Literal) and atom in reached

    for equation in jaxpr.eqns:
        into = [is_reached(atom) for atom in equation.invars]
        if equation.primitive.name in ("jit", "pjit"):
            out = _reached(equation.params["jaxpr"].jaxpr, into)
        else:
            out = [any(into)] * len(equation.outvars)
        reached.update(var for var, own in zip(equation.outvars, out, strict=True) if own)
    return [is_reached(atom) for atom in jaxpr.outvars]
