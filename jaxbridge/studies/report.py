"""Studies, which a command runs, and the layout of their tables."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from jaxtyping import Array, Key

Say = Callable[[str], None]
Row = Sequence[str]
Table = tuple[Row, Sequence[Row]]  # titles, and rows


def _no_files(results: Any) -> Mapping[str, str]:
    return {}


class Study(NamedTuple):
    """A study that a command runs.

    - `title`: printed first.
    - `run(key, quick, say)`: returns the results; calls `say` with a line of progress.
    - `tables(results)`: the text that is printed.
    - `what_to_see`: printed below the tables.
    - `draw(figures, results)`: returns pictures by file name, from functions of a module `figures`.
    - `files(results)`: returns texts by file name; those of `.jsonl` files are appended.
    """

    title: str
    run: Callable[[Key[Array, ""], bool, Say], Any]
    tables: Callable[[Any], str]
    what_to_see: str
    draw: Callable[[Any, Any], dict[str, Any]]
    files: Callable[[Any], Mapping[str, str]] = _no_files


def silent(what: str) -> None:
    """Ignore a line of progress."""


def table(titles: Row, rows: Iterable[Row], words: int = 1) -> str:
    """Lay out rows under titles as plain text; the first `words` columns are left-aligned."""
    # An entry that repeats the one above is left blank.
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
    """Lay out rows under titles as a Markdown table."""
    lines = [titles, ["---"] * len(titles), *_unrepeated(rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _unrepeated(rows: Iterable[Row]) -> list[Row]:
    """Return the rows, with a blank first cell where it repeats the one above."""
    return [
        ("" if row[0] == above[0] else row[0], *row[1:]) for above, row in pairwise([[""], *rows])
    ]
