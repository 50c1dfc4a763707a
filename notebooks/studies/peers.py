"""Other packages, where they are installed.

None of them is needed: each is imported by the function that runs it, and where it is missing the
row of its table says so.
"""

import shutil
import subprocess
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any, TypeVar

import jax

NOT_INSTALLED = "not installed"

Row = TypeVar("Row")


def where_installed(
    modules: Sequence[str], run: Callable[..., list[Row]], otherwise: Callable[[str], list[Row]]
) -> list[Row]:
    """What `run` makes of the modules; without one of them, what is said `otherwise`."""
    try:
        found = [import_module(name) for name in modules]
    except ImportError:
        return otherwise(NOT_INSTALLED)
    with jax.numpy_dtype_promotion("standard"):  # which others count on
        return run(*found)


def in_r(package: str, script: str) -> dict[str, float] | None:
    """The numbers that an R script prints, each with its name before it on a line; `None` without
    R or its `package`."""
    rscript = shutil.which("Rscript")
    if rscript is None or _printed(rscript, f'cat(requireNamespace("{package}"))') != "TRUE":
        return None
    lines = (line.split() for line in _printed(rscript, script).splitlines())
    return {words[0]: float(words[1]) for words in lines if len(words) == 2}


def _printed(rscript: str, script: str) -> str:
    made = subprocess.run([rscript, "-e", script], capture_output=True, text=True, check=True)
    return made.stdout.strip()


def versions(packages: Sequence[str]) -> dict[str, str]:
    """Of those that are installed."""
    found: dict[str, Any] = {}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
