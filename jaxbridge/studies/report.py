"""What `python -m jaxbridge` runs, and how its tables are written."""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from jaxtyping import Array, Key

Say = Callable[[str], None]
Row = Sequence[str]
Table = tuple[Row, Sequence[Row]]  # titles, and rows


class Study(NamedTuple):
    """A part of the study: `run(key, quick, say)` gives its results, and `say`s what it is at;
    `tables` of them are printed above `what_to_see`; `draw(figures, results)` makes pictures, by
    their names, with the functions of the module `figures`."""

    title: str
    run: Callable[[Key[Array, ""], bool, Say], Any]
    tables: Callable[[Any], str]
    what_to_see: str
    draw: Callable[[Any, Any], dict[str, Any]]


def silent(what: str) -> None:
    """Say nothing."""


def table(titles: Row, rows: Iterable[Row], words: int = 1) -> str:
    """Rows under their titles, in plain characters, the first columns being `words`."""
    lines = [titles, *_unrepeated(rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    head, *body = (
        "  ".join(
            [
                *map(str.ljust, line[:words], widths),
                *map(str.rjust, line[words:], widths[words:]),
            ]
        )
        for line in lines
    )
    return "\n".join([head, "-" * len(head), *body])


def markdown(titles: Row, rows: Iterable[Row]) -> str:
    """The same in Markdown."""
    lines = [titles, ["---"] * len(titles), *_unrepeated(rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _unrepeated(rows: Iterable[Row]) -> list[Row]:
    """A first cell is left blank where it repeats the one above it."""
    return [
        ("" if row[0] == above[0] else row[0], *row[1:]) for above, row in pairwise([[""], *rows])
    ]
