"""Command lines that run studies, print their tables and write their pictures and files."""

import argparse
import contextlib
import importlib
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

import jax

from .report import Study

_QUICK = " (--quick: expect larger errors, and times of little meaning)"


class Command(NamedTuple):
    """A command line over studies.

    - `program`: the command as the user types it.
    - `description`: the first paragraph of its help.
    - `parts`: studies by the name that selects them.
    - `groups`: names for several parts.
    - `part`: the default, one of the names.
    - `figures`: name of the module of figures, imported only to draw: it needs matplotlib.
    - `keeps_programs`: whether compiled programs are stored in the output folder. False for studies
        that measure the time of compilation.
    - `next_steps`: printed at the end: further reading.
    """

    program: str
    description: str
    parts: Mapping[str, Sequence[Study]]
    groups: Mapping[str, Sequence[str]]
    part: str
    figures: str
    keeps_programs: bool
    next_steps: str

    def run(self, arguments: Sequence[str] | None = None) -> None:
        """Parse the arguments, `sys.argv` by default, and run the selected studies."""
        options = self._parse(arguments)
        begin = time.perf_counter()
        if self.keeps_programs and not jax.config.values["jax_compilation_cache_dir"]:
            _store_programs(options.out / "programs")
        print(f"JAX {jax.__version__} on {jax.devices()[0].device_kind}\n")
        written: list[Path] = []
        for part in self.groups.get(options.part, (options.part,)):
            for study in self.parts[part]:
                written += self._run_study(study, options)
        print(f"{time.perf_counter() - begin:.0f} s in all")
        if written:
            print(f"Written to {options.out}: {', '.join(path.name for path in written)}")
        print(self.next_steps)

    def _parse(self, arguments: Sequence[str] | None) -> argparse.Namespace:
        parser = _Parser(prog=self.program, description=self.description)
        parser.add_argument(
            "part",
            nargs="?",
            choices=(*self.groups, *self.parts),
            default=self.part,
            help=f"the studies to run (default {self.part}): "
            + "; ".join(
                f"{name}: {', '.join(study.title for study in studies)}"
                for name, studies in self.parts.items()
            ),
        )
        parser.add_argument("--quick", action="store_true", help="simulate far fewer paths")
        parser.add_argument("--seed", type=_seed, default=0, help="random seed (default 0)")
        parser.add_argument(
            "--out",
            type=Path,
            default=Path("jaxbridge-output"),
            metavar="DIR",
            help="folder for pictures, figures and compiled programs (default %(default)s)",
        )
        options = parser.parse_args(arguments)
        try:
            options.out.mkdir(parents=True, exist_ok=True)
            # A study may run for minutes: find out now whether its results can be written.
            with tempfile.TemporaryFile(dir=options.out):
                pass
        except OSError as error:
            parser.error(f"cannot write to --out {options.out}: {error.strerror}")
        return options

    def _run_study(self, study: Study, options: argparse.Namespace) -> list[Path]:
        """Run one study, print its tables, and return the files that were written."""
        print(f"{study.title}{_QUICK if options.quick else ''}\n")
        results = study.run(jax.random.key(options.seed), options.quick, _show_progress)
        # The tables start on a line of their own.
        _end_progress()
        print(f"{study.tables(results)}\n\n{study.what_to_see}\n")
        written = []
        for name, text in study.files(results).items():
            file = options.out / name
            # A file of lines is a history: each run adds to it.
            before = file.read_text(encoding="utf-8") if _is_history(file) else ""
            with self.writing(file) as path:
                path.write_text(before + text, encoding="utf-8")
            written.append(file)
        try:
            # matplotlib is an extra.
            figures = importlib.import_module(self.figures)
        except ImportError as error:
            print(f"no pictures: {error}\n")
            return written
        for name, figure in study.draw(figures, results).items():
            with self.writing(options.out / name) as path:
                figure.savefig(path, dpi=150, format=Path(name).suffix[1:])
            written.append(options.out / name)
        return written

    @contextlib.contextmanager
    def writing(self, path: Path) -> Iterator[Path]:
        """Yield a path to write to, which becomes `path` once it is complete.

        If the file cannot be written, end the program with one line. No partial file is left, and
        earlier files and tables stay.
        """
        # A rename in the same folder replaces the file at once.
        partial = path.with_name(f".{path.name}")
        try:
            yield partial
            partial.replace(path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            _end_progress()
            print(f"{self.program}: cannot write {path}: {error.strerror}", file=sys.stderr)
            sys.exit(1)


def _is_history(file: Path) -> bool:
    return file.suffix == ".jsonl" and file.exists()


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Print one line instead of argparse's usage and message."""
        self.exit(2, f"{self.prog}: {message} (see --help)\n")


def _seed(text: str) -> int:
    if not text.isdecimal() or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(f"{text!r} is not an integer from 0 to 2^32 - 1")
    return int(text)


def _store_programs(folder: Path) -> None:
    """Store compiled programs in the folder: the same study takes half as long a second time."""
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def _show_progress(message: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\033[K{message}", end="", file=sys.stderr, flush=True)
    else:
        print(message, file=sys.stderr, flush=True)


def _end_progress() -> None:
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr, flush=True)
