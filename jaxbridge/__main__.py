"""`python -m jaxbridge`: the paper's study of approximate bridges, in numbers and pictures."""

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import jax

from .study import format_table, run_study, write_figures

_WHAT_TO_SEE = """\
Approximate bridges have the law of the bridge given that an associated diffusion hits it. For
the likely bridge that changes the law by about 1 % of a standard deviation; for the unlikely
ones it pulls the mid-point towards the stationary law, by the bias shown: the error of the
method itself, which more bridges do not remove. It shrinks as gamma -> 1, at the price of fewer
pairs that meet. "default" is Heun with the Brownian crossing; "as published" is Euler with the
sign test in radius 0.05, which has a step error of its own and overlooks about half of the
meetings."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line instead of argparse's usage and message."""
        self.exit(2, f"{self.prog}: {message} (see --help)\n")


def _seed(text: str) -> int:
    if not text.isdecimal() or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to 2^32 - 1")
    return int(text)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = _Parser(
        prog="python -m jaxbridge",
        description="Approximate Ornstein-Uhlenbeck bridges beside their exact law: section 3 of "
        "Bladt, Finch & Sorensen, Simulation of multivariate diffusion bridges.",
    )
    parser.add_argument("--quick", action="store_true", help="2,000 bridges a case, not 50,000")
    parser.add_argument("--seed", type=_seed, default=0, help="of the random numbers (default 0)")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("jaxbridge-output"),
        metavar="DIR",
        help="where the pictures go (default %(default)s)",
    )
    options = parser.parse_args(arguments)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=options.out):
            pass
    except OSError as error:
        parser.error(f"cannot write to --out {options.out}: {error.strerror}")
    return options


def _show_progress(index: int, total: int, what: str) -> None:
    line = f"[{index}/{total}] {what}"
    if sys.stderr.isatty():
        print(f"\r\033[K{line}", end="", file=sys.stderr, flush=True)
    else:
        print(line, file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study, print its table and write its pictures."""
    options = _parse(arguments)
    begin = time.perf_counter()
    num_bridges = 2_000 if options.quick else 50_000
    quick = " (--quick: expect larger errors)" if options.quick else ""
    print(f"JAX {jax.__version__} on {jax.devices()[0].device_kind}")
    print(f"{num_bridges:,} bridges a case{quick}, at time 1/2, N = 50 steps\n")
    results = run_study(jax.random.key(options.seed), num_bridges, on_start=_show_progress)
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr, flush=True)
    print(f"{format_table(results)}\n\n{_WHAT_TO_SEE}\n")
    try:
        pictures = write_figures(jax.random.key(options.seed), results, options.out)
        print(f"{len(pictures)} pictures in {options.out}")
    except ImportError as error:
        print(f"no pictures: {error}")
    print(f"{time.perf_counter() - begin:.0f} s in all")


if __name__ == "__main__":
    main()
