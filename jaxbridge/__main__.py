"""`python -m jaxbridge`: the paper's simulation study, in numbers and pictures."""

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
# Parts of which no figure is the time that compilation takes.
_PROGRAMS_KEPT = ("paper", "approximate", "exact")


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
        description="Approximate and exact Ornstein-Uhlenbeck bridges, section 3 of "
        "Bladt, Finch & Sorensen, Simulation of multivariate diffusion bridges, and other "
        "proposals beside them.",
    )
    parser.add_argument(
        "part",
        nargs="?",
        choices=("paper", *_PARTS, "all"),
        default="paper",
        help="approximate or exact bridges, or both: the paper's study (the default); what "
        "accuracy costs in time; Bayesian inference, the paper's section 4; how fast it is, and "
        "which proposal is best for which duration; other packages beside this one; or all",
    )
    parser.add_argument("--quick", action="store_true", help="a twenty-fifth of the bridges")
    parser.add_argument("--seed", type=_seed, default=0, help="of the random numbers (default 0)")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("jaxbridge-output"),
        metavar="DIR",
        help="where pictures go, and compiled programs for another time (default %(default)s)",
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
    """Run the studies, print their tables and write their pictures."""
    options = _parse(arguments)
    begin = time.perf_counter()
    if options.part in _PROGRAMS_KEPT and not jax.config.values["jax_compilation_cache_dir"]:
        _keep_programs(options.out / "programs")
    print(f"JAX {jax.__version__} on {jax.devices()[0].device_kind}\n")
    for part in _GROUPS.get(options.part, (options.part,)):
        for study in _PARTS[part]:
            _run(study, options)
    print(f"{time.perf_counter() - begin:.0f} s in all")


def _keep_programs(folder: Path) -> None:
    """Compiled programs go there, so that the same study takes half as long a second time."""
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[Path]:
    """Give a name to write to; the file becomes `path` once it is complete. If it cannot be
    written, end with one line and without a part of it; earlier files and tables stay."""
    partial = path.with_name(f".{path.name}")
    try:
        yield partial
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        _end_progress()
        print(f"python -m jaxbridge: cannot write {path}: {error.strerror}", file=sys.stderr)
        sys.exit(1)


def _run(study: Study, options: argparse.Namespace) -> None:
    print(f"{study.title}{_QUICK if options.quick else ''}\n")
    results = study.run(jax.random.key(options.seed), options.quick, _say)
    _end_progress()
    print(f"{study.tables(results)}\n\n{study.what_to_see}\n")
    if isinstance(results, Benchmark):
        with _writing(options.out / "benchmark.json") as path:
            save(results, path)
        print(f"all figures in {options.out / 'benchmark.json'}")
    if isinstance(results, Rivals):
        for name, text in rivals_files(results).items():
            with _writing(options.out / name) as path:
                path.write_text(text, encoding="utf-8")
        print(f"all figures in {options.out / 'rivals.json'}, and as a page beside it")
    try:
        from .studies import figures
    except ImportError as error:
        print(f"no pictures: {error}\n")
        return
    pictures = study.draw(figures, results)
    for name, figure in pictures.items():
        with _writing(options.out / name) as path:
            figure.savefig(path, dpi=150, format=Path(name).suffix[1:])
    some = "a picture" if len(pictures) == 1 else f"{len(pictures)} pictures"
    print(f"{some} in {options.out}\n")


def _say(what: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\033[K{what}", end="", file=sys.stderr, flush=True)
    else:
        print(what, file=sys.stderr, flush=True)


def _end_progress() -> None:
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
