"""`python -m jaxbridge`: the paper's simulation study, in numbers and pictures."""

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import jax

from .studies.accuracy import (
    format_accuracy,
    format_effects,
    format_sigmas,
    run_accuracy,
    run_effect_costs,
    write_accuracy_figures,
)
from .studies.bayes import format_bayes, run_bayes, write_bayes_figures
from .studies.benchmark import DURATIONS, format_ratios, run_benchmark, save
from .studies.crossover import format_crossover, processes, write_crossover_figure
from .studies.exact import (
    draw_as_many,
    format_cost,
    format_exact,
    format_variation,
    run_cost,
    run_exact,
    run_variation,
    slope,
    write_exact_figures,
)
from .studies.paper import format_table, run_study, write_figures

_WHAT_TO_SEE = """\
Approximate bridges have the law of the bridge given that an associated diffusion hits it. For
the likely bridge that changes the law by about 1 % of a standard deviation; for the unlikely
ones it pulls the mid-point towards the stationary law, by the bias shown: the error of the
method itself, which more bridges do not remove. It shrinks as gamma -> 1, at the price of fewer
pairs that meet. "default" is Heun with the Brownian crossing; "as published" is Euler with the
sign test in radius 0.05, which has a step error of its own and overlooks about half of the
meetings."""

_WHAT_TO_SEE_EXACT = """\
"paths/n" is the number of simulated paths, "worth" that of the independent exact bridges which
the n are worth. "as published" is the paper's pseudo-marginal chain with the start law that it
prints, which leaves most of the bias; started from the stationary law, or from any other that is
paid for, it is gone. The very unlikely bridge has a start law fitted by a pilot run. The paper's
seconds are those of its authors' computer and program, given for the same bridge and number of
iterations: only their order of magnitude can be compared."""

_WHAT_TO_SEE_VARIATION = """\
An approximate bridge is exact if the probability pi that its associated diffusion hits it does
not vary. std/mean of 1/pi shrinks as gamma -> 1 with either start law, while 1/pi grows:
approximate bridges become exact as they become rare."""


_WHAT_TO_SEE_ACCURACY = """\
"error" is the distance of the mean half way from the exact one, in standard deviations (of orders:
of the transition density, relative); "step", "method" and "Monte Carlo" are its parts. The method's
own error, that of approximate bridges, no number of steps removes. The Brownian crossing sees the
meetings that the sign test overlooks, which is an error of order 1/2; Heun's scheme brings what is
left from first to second order where sigma is constant; elsewhere it gains less. With exact
Gaussian transitions nothing is left, at any number of steps."""

_WHAT_TO_SEE_BAYES = """\
"shift / sd" is the distance from the exact posterior mean in posterior standard deviations, with
its Monte Carlo error; "worth" is the effective number of draws, "moved" the share of bridges
that an iteration replaces. "seconds" are without "start", the seconds of compilation and of pilot
runs; "/numbers" is in multiples of the time to draw one path's numbers for each interval and
iteration; "paths" are those of an iteration in the second and in the last quarter of the run. The
exact posterior is by Brownian bridges; where observations are far apart, by the stationary law.
Approximate bridges shift the posterior, exact ones do not; with Heun's scheme 12 steps give the
posterior of 50."""

_WHAT_TO_SEE_CROSSOVER = """\
Thousands of effective samples per second, compile time left out, of a run of 200,000 proposals in
50 steps (T up to 1) or 20,000 in 1,000 (from T = 5 on); fewer for couplings alone. The step error
is of second order for all: Heun for couplings, the Itô–Taylor density for the others. "auto"
includes its pilot runs."""


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
        choices=("paper", "approximate", "exact", "accuracy", "bayes", "bench", "all"),
        default="paper",
        help="approximate or exact bridges, or both: the paper's study (the default); what "
        "accuracy costs in time; Bayesian inference, the paper's section 4; how fast it is, and "
        "which proposal is best for which duration; or all",
    )
    parser.add_argument("--quick", action="store_true", help="a twenty-fifth of the bridges")
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the studies, print their tables and write their pictures."""
    options = _parse(arguments)
    begin = time.perf_counter()
    print(f"JAX {jax.__version__} on {jax.devices()[0].device_kind}\n")
    parts = {
        "approximate": _approximate,
        "exact": _exact,
        "accuracy": _accuracy,
        "bayes": _bayes,
        "bench": _bench,
    }
    groups = {"paper": ["approximate", "exact"], "all": list(parts)}
    chosen = groups.get(options.part, [options.part])
    for part in chosen:
        try:
            pictures = parts[part](options)
            print(f"{len(pictures)} pictures in {options.out}\n")
        except ImportError as error:
            print(f"no pictures: {error}\n")
    print(f"{time.perf_counter() - begin:.0f} s in all")


def _approximate(options: argparse.Namespace) -> list[Path]:
    num_bridges = 2_000 if options.quick else 50_000
    quick = " (--quick: expect larger errors)" if options.quick else ""
    print("Approximate bridges")
    print(f"{num_bridges:,} bridges a case{quick}, at time 1/2, N = 50 steps\n")
    results = run_study(jax.random.key(options.seed), num_bridges, on_start=_show_progress)
    _end_progress()
    print(f"{format_table(results)}\n\n{_WHAT_TO_SEE}\n")
    return write_figures(jax.random.key(options.seed), results, options.out)


def _exact(options: argparse.Namespace) -> list[Path]:
    key = jax.random.key(options.seed)
    quick = " (--quick: expect larger errors)" if options.quick else ""
    print(f"Exact bridges, gamma = 0.5, at time 1/2, N = 50 steps{quick}\n")
    results = run_exact(key, 0.04 if options.quick else 1.0, _say)
    _end_progress()
    print(f"{format_exact(results)}\n")
    floor = draw_as_many(key, results[0])
    ratio = results[0].seconds / floor.seconds
    print(
        f"Drawing the {floor.numbers / 1e6:.0f} million random numbers of the first row alone "
        f"takes {floor.seconds:.2f} s:\nthe chain takes {ratio:.1f} times that.\n"
    )
    print(f"{_WHAT_TO_SEE_EXACT}\n\nHow much hitting probabilities vary\n")
    variation = run_variation(key, 50 if options.quick else 300, on_start=_say)
    _end_progress()
    print(f"{format_variation(variation)}\n\n{_WHAT_TO_SEE_VARIATION}\n\nWhat duration costs\n")
    durations = (1.0, 3.0, 10.0) if options.quick else (1.0, 3.0, 10.0, 30.0, 100.0)
    work = 5_000 if options.quick else 200_000
    costs = run_cost(key, work, durations, on_start=_say)
    _end_progress()
    print(format_cost(costs))
    if not options.quick:
        print(f"From T = 10 on, seconds grow as T to the power {slope(costs):.2f}.")
    return write_exact_figures(results, variation, costs, options.out)


def _accuracy(options: argparse.Namespace) -> list[Path]:
    key = jax.random.key(options.seed)
    quick = " (--quick: expect larger errors)" if options.quick else ""
    print(f"What accuracy costs in time{quick}\n")
    results = run_accuracy(key, 1_000 if options.quick else 50_000, _say, options.quick)
    effects = run_effect_costs(key, 1_000 if options.quick else 20_000, _say)
    _end_progress()
    print(f"{format_accuracy(results)}\n\n{_WHAT_TO_SEE_ACCURACY}\n")
    print(f"{format_effects(effects)}\n")
    return write_accuracy_figures(results, effects, options.out)


def _bayes(options: argparse.Namespace) -> list[Path]:
    quick = " (--quick: expect larger errors)" if options.quick else ""
    print(f"Bayesian estimation of the hyperbolic diffusion{quick}\n")
    key = jax.random.key(options.seed)
    scale, num_data_sets = (0.04, 1) if options.quick else (1.0, 3)
    examples = run_bayes(key, scale, num_data_sets, _say)
    _end_progress()
    print(f"{format_bayes(examples)}\n\n{_WHAT_TO_SEE_BAYES}\n")
    return write_bayes_figures(examples, options.out)


def _bench(options: argparse.Namespace) -> list[Path]:
    scale = 0.04 if options.quick else 1.0
    durations = (0.05, 5.0) if options.quick else DURATIONS
    chosen = processes()[:1] if options.quick else None
    quick = " (--quick: too short a run for the clock)" if options.quick else ""
    print(f"How fast it is{quick}\n")
    dimensions = (2,) if options.quick else (2, 5, 10)
    key = jax.random.key(options.seed)
    results = run_benchmark(key, scale, durations, chosen, dimensions, _say)
    _end_progress()
    save(results, options.out / "benchmark.json")
    print(f"{format_ratios(results)}\n\n{format_sigmas(results.sigmas)}\n")
    print(f"Which proposal for which duration\n\n{format_crossover(results.rates)}\n")
    print(f"{_WHAT_TO_SEE_CROSSOVER}\n\nall figures in {options.out / 'benchmark.json'}\n")
    return write_crossover_figure(results.rates, options.out)


def _say(what: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\033[K{what}", end="", file=sys.stderr, flush=True)
    else:
        print(what, file=sys.stderr, flush=True)


def _show_progress(index: int, total: int, what: str) -> None:
    _say(f"[{index}/{total}] {what}")


def _end_progress() -> None:
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
