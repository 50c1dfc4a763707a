"""Check of annotations, for jaxtyping's import hook."""

from collections.abc import Callable

from beartype import beartype


def check_annotations(fn: Callable | type) -> Callable | type:
    """Return the function or class with its annotations checked.

    Nested functions are returned unchanged. Otherwise each call of the outer function would
    decorate them again, which slows tracing.
    """
    return fn if "<locals>" in fn.__qualname__ else beartype(fn)
