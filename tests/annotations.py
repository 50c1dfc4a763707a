"""Check of annotations, for jaxtyping's import hook."""

from collections.abc import Callable

from beartype import beartype


def check_annotations(fn: Callable | type) -> Callable | type:
    """Return the function or class with its annotations checked; a function inside of a function as
    it is.

    The latter would be decorated at each call of the outer one, which takes a third of the time of
    tracing.
    """
    return fn if "<locals>" in fn.__qualname__ else beartype(fn)
