"""Command line `python -m jaxbridge`: run the paper's simulation study and the benchmarks.

It prints tables and writes pictures. The default is the study of the paper.
"""

import argparse
import contextlib
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NoReturn

import jax

from .studies.accuracy import ACCURACY
from .studies.bayes import BAYES
from .studies.benchmark import BENCHMARK, Benchmark, save
from .studies.exact import COST, EXACT, VARIATION
from .studies.paper import APPROXIMATE
from .studies.report import Study
from .studies.rivals import RIVALS, Rivals, rivals_files

_PARTS = {
    "approximate": (APPROXIMATE,),
    "exact": (EXACT, VARIATION, COST),
    "accuracy": (ACCURACY,),
    "bayes": (BAYES,),
    "bench": (BENCHMARK,),
    "rivals": (RIVALS,),
}
_QUICK = " (--quick: expect larger errors, and times of little meaning)"
_GROUPS = {"paper": ("approximate", "exact"), "all": tuple(_PARTS)}
# Parts that do not report compile times, so that stored programs do not falsify their results.
_WITHOUT_COMPILE_TIMES = ("paper", "approximate", "exact")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Exit with one line instead of argparse's usage and message."""
        self.exit(2, f"{self.prog}: {message} (see --help)\n")


def _seed(text: str) -> int:
    if not text.isdecimal() or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(
            f"the seed must be an integer from 0 to 2^32 - 1; got {text!r}"
        )
    return int(text)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = _Parser(
        prog="python -m jaxbridge",
        description="Run the simulation study of Bladt, Finch & Sorensen, Simulation of "
        "multivariate diffusion bridges (section 3: approximate and exact Ornstein-Uhlenbeck "
        "bridges), or a benchmark.",
    )
    parser.add_argument(
        "part",
        nargs="?",
        choices=("paper", *_PARTS, "all"),
        default="paper",
        help="paper: approximate and exact bridges, the paper's study (the default); "
        "approximate, exact: one half of it; accuracy: error against computing time; bayes: "
        "Bayesian inference, the paper's section 4; bench: speed, and the best proposal for each "
        "duration; rivals: comparison with other packages; all: everything",
    )
    parser.add_argument("--quick", action="store_true", help="use 1/25 of the bridges")
    parser.add_argument(
        "--seed", type=_seed, default=0, help="seed of the random numbers (default 0)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("jaxbridge-output"),
        metavar="DIR",
        help="folder for pictures, tables and compiled programs (default %(default)s)",
    )
    options = parser.parse_args(arguments)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=options.out):
            pass
    except OSError as error:
        parser.error(f"cannot write to --out {options.out}: {error.strerror}")
    return options


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the studies, print their tables and write their pictures.

    `arguments` replace those of the command line. Exit with status 2 and one line for invalid
    arguments, with status 1 if a file cannot be written.
    """
    options = _parse(arguments)
    begin = time.perf_counter()
    if (
        options.part in _WITHOUT_COMPILE_TIMES
        and not jax.config.values["jax_compilation_cache_dir"]
    ):
        _store_programs(options.out / "programs")
    print(f"JAX {jax.__version__} on {jax.devices()[0].device_kind}\n")
    for part in _GROUPS.get(options.part, (options.part,)):
        for study in _PARTS[part]:
            _run_study(study, options)
    print(f"{time.perf_counter() - begin:.0f} s in all")


def _store_programs(folder: Path) -> None:
    """Store compiled programs in this folder, so that a second run takes half as long."""
    # The defaults of JAX store large and slow programs only; these limits store all.
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to, and rename it to `path` once the file is complete.

    If writing fails, remove the partial file and exit with one line. Earlier files and tables
    remain.
    """
    partial = path.with_name(f".{path.name}")
    try:
        yield partial
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        _end_progress()
        print(f"python -m jaxbridge: cannot write {path}: {error.strerror}", file=sys.stderr)
        sys.exit(1)


def _run_study(study: Study, options: argparse.Namespace) -> None:
    print(f"{study.title}{_QUICK if options.quick else ''}\n")
    results = study.run(jax.random.key(options.seed), options.quick, _show_progress)
    _end_progress()
    print(f"{study.tables(results)}\n\n{study.what_to_see}\n")
    if isinstance(results, Benchmark):
        with _writing(options.out / "benchmark.json") as path:
            save(results, path)
        print(f"all results in {options.out / 'benchmark.json'}")
    if isinstance(results, Rivals):
        for name, text in rivals_files(results).items():
            with _writing(options.out / name) as path:
                path.write_text(text, encoding="utf-8")
        print(f"all results in {options.out / 'rivals.json'}, and as a page next to it")
    try:
        from .studies import figures
    except ImportError as error:
        print(f"no pictures: {error}\n")
        return
    pictures = study.draw(figures, results)
    for name, figure in pictures.items():
        with _writing(options.out / name) as path:
            figure.savefig(path, dpi=150, format=Path(name).suffix[1:])
    count = "one picture" if len(pictures) == 1 else f"{len(pictures)} pictures"
    print(f"{count} in {options.out}\n")


def _show_progress(message: str) -> None:
    """Write a progress message to stderr; on a terminal it replaces the previous one."""
    if sys.stderr.isatty():
        print(f"\r\033[K{message}", end="", file=sys.stderr, flush=True)
    else:
        print(message, file=sys.stderr, flush=True)


def _end_progress() -> None:
    """Erase the last progress message on a terminal."""
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
