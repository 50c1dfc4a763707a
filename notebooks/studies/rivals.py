"""The same tasks by other packages and by this one, in one run on one machine.

Bridges (`rival_bridges`), filters (`rival_filters`) and posteriors (`rival_posteriors`). What is
not installed has a row that says so. Results are kept as JSON, and the page
`notebooks/rivals.md` is made of that file.
"""

import datetime
import json
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Key

from jaxbridge.studies.report import Row, Say, Study, Table, markdown, silent, table

from .benchmark import num_cores
from .peers import versions
from .rival_bridges import BridgeRow, run_bridges
from .rival_filters import NUM_STEPS, FilterRow, run_filters
from .rival_posteriors import PosteriorRow, run_posteriors

_PACKAGES = ("jax", "numpyro", "particles", "cuthbert", "equinox", "optax", "numpy", "numba")


class Sizes(NamedTuple):
    """How much of each task is run: paths of a bridge, iterations of learning, particles, filters,
    and draws of a posterior."""

    paths: int = 1_000
    iterations: int = 1_000
    particles: int = 100
    filters: int = 64
    draws: int = 4_000


class Rivals(NamedTuple):
    """All rows, and where, when and beside what load they were found."""

    device: str
    processor: str
    load: tuple[float, float]
    versions: dict[str, str]
    date: str
    sizes: Sizes
    bridges: list[BridgeRow]
    filters: list[FilterRow]
    posteriors: list[PosteriorRow]


def run_rivals(key: Key[Array, ""], quick: bool, sizes: Sizes, say: Say = silent) -> Rivals:
    """All three parts. `quick` takes the first task of each."""
    before = _load()
    keys = jax.random.split(key, 3)
    bridges = run_bridges(keys[0], quick, sizes.paths, sizes.iterations, say)
    filters = run_filters(keys[1], quick, sizes.particles, sizes.filters, say)
    posteriors = run_posteriors(keys[2], quick, sizes.draws, say)
    return Rivals(
        jax.devices()[0].device_kind,
        f"{platform.machine()}, {num_cores()} cores",
        (before, _load()),
        versions(_PACKAGES) | {"python": platform.python_version()},
        datetime.date.today().isoformat(),
        sizes,
        bridges,
        filters,
        posteriors,
    )


def _load() -> float:
    """How many processes wanted to run in the last minute; zero where the system does not say."""
    return round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else 0.0


def rivals_files(rivals: Rivals) -> dict[str, str]:
    """Return everything as JSON, and the page that is made of it, by the names of their files."""
    content: dict[str, Any] = rivals._asdict()
    content["sizes"] = rivals.sizes._asdict()
    for name in ("bridges", "filters", "posteriors"):
        content[name] = [row._asdict() for row in content[name]]
    text = json.dumps(content, indent=1, ensure_ascii=False)
    return {"rivals.json": text + "\n", "rivals.md": as_page(rivals)}


def load_rivals(path: Path) -> Rivals:
    """What `rivals_files` has as JSON."""
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    content["load"] = tuple(content["load"])
    content["sizes"] = Sizes(**content["sizes"])
    content["bridges"] = [BridgeRow(**row) for row in content["bridges"]]
    content["filters"] = [FilterRow(**row) for row in content["filters"]]
    content["posteriors"] = [PosteriorRow(**row) for row in content["posteriors"]]
    return Rivals(**content)


def bridge_table(rows: Sequence[BridgeRow]) -> Table:
    """Effective shares, log densities and seconds."""
    titles = ("bridge", "by", "effective share", "log p̂ less exact", "training, s", "first call, s",
              "again, s")  # fmt: skip
    return titles, [
        (
            r.task,
            r.way,
            r.why or _number(r.share, ".3f"),
            _with_error(r.error, r.standard_error),
            _number(r.training, ".1f"),
            _number(r.first, ".1f"),
            _number(r.again, ".3f"),
        )
        for r in rows
    ]


def filter_table(rows: Sequence[FilterRow]) -> Table:
    """Log likelihoods, their spread and seconds; the last column is what one filter of variance one
    would take, the less the better."""
    titles = ("record", "by", "log p̂", "less exact", "sd of one filter", "ms a filter",
              "variance × ms", "first call, s")  # fmt: skip
    made: list[Row] = []
    for r in rows:
        milliseconds = None if r.seconds is None else 1e3 * r.seconds
        price = None if r.sd is None or milliseconds is None else r.sd**2 * milliseconds
        made.append(
            (
                r.record,
                r.way,
                r.why or _with_error(r.log_likelihood, r.standard_error, ".2f"),
                "" if r.error is None else _number(r.error, "+.2f"),
                _number(r.sd, ".2g"),
                _number(milliseconds, ".2g"),
                _number(price, ".2g"),
                _number(r.first, ".1f"),
            )
        )
    return titles, made


def posterior_table(rows: Sequence[PosteriorRow]) -> Table:
    """Shifts, widths, effective draws and seconds."""
    titles = ("data", "by", "unknown", "mean off by, posterior sds", "sd / exact", "worth, draws",
              "first call, s", "again, s", "draws a second")  # fmt: skip
    return titles, [
        (
            r.data,
            r.way,
            r.parameter,
            r.why or _with_error(r.shift, r.shift_error),
            _number(r.sd_ratio, ".2f"),
            _number(r.worth, ",.0f"),
            _number(r.first, ".1f"),
            _number(r.again, ".1f"),
            _number(None if r.worth is None or r.again is None else r.worth / r.again, ",.0f"),
        )
        for r in rows
    ]


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _with_error(value: float | None, error: float | None, form: str = "+.3f") -> str:
    if value is None or error is None:
        return ""
    return f"{value:{form}} ± {error:{form.lstrip('+')}}"


def _tables(rivals: Rivals) -> list[Table]:
    return [
        bridge_table(rivals.bridges),
        filter_table(rivals.filters),
        posterior_table(rivals.posteriors),
    ]


def in_plain_characters(rivals: Rivals) -> str:
    """The tables as they are printed."""
    words = (2, 2, 3)
    shown = zip(_tables(rivals), words, strict=True)
    return "\n\n".join(table(*each, number) for each, number in shown)


def _where(rivals: Rivals) -> str:
    packages = ", ".join(f"{name} {number}" for name, number in rivals.versions.items())
    before, after = rivals.load
    return f"""\
{rivals.device}, {rivals.processor}, {rivals.date}; {packages}.
The load average of the machine was {before:g} before and {after:g} after: where that is above
the number of cores others ran beside, and all seconds are longer for it, at times several times."""


def as_page(rivals: Rivals) -> str:
    """`notebooks/rivals.md`."""
    bridges, filters, posteriors = (markdown(*each) for each in _tables(rivals))
    sizes = rivals.sizes
    return f"""\
# Beside other packages

`python -m studies rivals`, in the folder `notebooks`, runs the same tasks by this package and by
each peer that is installed, and writes this page and [rivals.json](rivals.json). All seconds are
from one machine, in float32 for JAX and in float64 for NumPy. A first call compiles; "again" is
the fastest of a few more.

{_where(rivals)}

{_about_bridges(sizes)}
{bridges}

{_about_filters(sizes)}
{filters}

{_about_posteriors(sizes)}
{posteriors}

## What to see

{_WHAT_TO_SEE}
## Peers

What is not installed is left out with a word. `pip install ".[rivals]"` installs cuthbert,
numpyro, and what particles needs. particles 0.4 itself asks for a NumPy below 2, which JAX no
longer takes, but runs with later ones: `pip install --no-deps particles`. In R,
`install.packages(c("sde", "Sim.DiffProc"))`; these make approximate bridges without weights, of
which only the mean half way is compared.
"""


def _about_bridges(sizes: Sizes) -> str:
    """Which bridges, and by what."""
    return f"""\
## Bridges

{sizes.paths:,} paths each, of

- an Ornstein–Uhlenbeck process, dX = -2X dt + dW, over T = 1 in 50 steps;
- the radial process dX = (4/X - X) dt + dW, over T = 1 in 50 steps;
- two kinds of cells that differentiate, dX_i = [X_i⁴/(2⁻⁴ + X_i⁴) + 2⁻⁴/(2⁻⁴ + X_j⁴) - X_i] dt +
  0.1 dW_i, from (0.1, -0.1) to (2, -0.1) over T = 4 in 100 steps.

The settings of the first two are those of Heng, De Bortoli, Doucet & Thornton (*Simulating
diffusion bridges with score matching*, 2021), with end points that differ here and there; the
cells (Wang, Zhang, Xu & Wang 2011) have less noise and more time than theirs, as in later studies
of learnt bridges (Baker, Schauer & Sommer 2024). The exact log p is a closed form (a normal law;
a noncentral χ²), and for the cells the solution of the Fokker–Planck equation on two grids,
extrapolated, which is known to 0.001.

Here, `sample_weighted_bridges` tells the share of paths that count, and `transition_log_density`
log p, both with `proposal="auto"`; what it took stands behind it, and seconds are those of both
calls. "Score, learnt" is the method of Heng et al. in small, written for this page: a network
with two hidden layers of 128 is fitted by {sizes.iterations:,} iterations of Adam at a rate of
0.01, with 100 paths each, weights averaged, to the score of the time reversal from the start. It
serves for any end, so the two bridges from 1.5 share a training. Its weights are for the Euler
scheme, whose step error is in its log p; steps are of second order here.
"""


def _about_filters(sizes: Sizes) -> str:
    """Which records, and by what."""
    return f"""\
## Filters

{sizes.filters} filters with {sizes.particles} particles each, in {NUM_STEPS} steps between two
observations, of

- a rotating Ornstein–Uhlenbeck process, d = 2, whose first coordinate is seen 50 times, each 0.5,
  with an error of sd 0.1; exact is Kalman's filter;
- a double well, dX = 2(X - X³) dt + 0.7 dW, seen likewise; exact is a filter on two grids,
  extrapolated;
- prey and predators by the chemical Langevin equation of Lotka and Volterra's reactions, with
  rates 0.5, 0.0025 and 0.3 (Golightly & Wilkinson 2008), whose prey is seen 40 times, each 1,
  with an error of sd 5. Its likelihood is not known; all make Euler's steps of the same length.

[particles](https://github.com/nchopin/particles) (Chopin & Papaspiliopoulos 2020) and
[cuthbert](https://github.com/state-space-models/cuthbert) resample systematically where fewer
than half of the particles count. They are frameworks: what moves particles was written for this
page, once for both: Euler's steps ("bootstrap"), or these bent towards the next observation
("guided"; Golightly & Wilkinson 2008; Whitaker, Golightly, Boys & Sherlock 2017). Here, steps are
of second order where σ is constant, paths are bent by a linear process that knows all that is
still to be seen, and the seconds include the step error, by half as many steps and a quarter.
"variance × ms" is what one filter of variance one would take: the less the better.
"""


def _about_posteriors(sizes: Sizes) -> str:
    """Which parameters, and by what."""
    return f"""\
## Posteriors

{sizes.draws:,} draws of one chain, given exact observations at unit intervals: of the rate of an
Ornstein–Uhlenbeck process with σ = 1, which is known, and of rate and σ of dX = κ(½ - X) dt + σ√X
dW (Cox, Ingersoll & Ross 1985). Priors are N(1, 1) above zero, and the exact posterior is that of
the closed forms on a grid. numpyro's `EulerMaruyama` is sampled by NUTS, with the unit interval
as its one step, or with latent points that make {NUM_STEPS} steps of it. Here, `gibbs` serves
where σ is known, `pmmh` where it is not, in raw coordinates and in logarithms. "Again" is another
call, with another key, less what XLA compiled in it: each chain of numpyro's compiles its start
anew, and `gibbs` does where a pilot run chooses otherwise.
"""


_WHAT_TO_SEE = """\
In the run that is kept here:

- **Bridges.** On three of the five more of the paths count here, most plainly on the cells; on
  the radial bridges from 1.5 more of those by a learnt score do. Nothing has to be learnt here,
  and a new start or duration costs no more. Once learnt, a score is faster, as a rule several
  times, for "auto" tries proposals in each call. The Euler scheme's error is in its log p, most
  plainly from 3 to 4.
- **Filters.** By variance and time together all others take from some thirty times as much to
  very much more. Of the linear process all weights are equal here, and log p is Kalman's. A
  bootstrap filter with so few particles is of little use where the noise is small. What limits
  the guided ones of the peers is what was written for them: they look one observation ahead, and
  Euler's steps shift log p of the double well by half. The peers win before the first result:
  particles compiles nothing, and has one filter in some hundredths of a second, where JAX compiles
  for seconds, here for two or three times as many as with cuthbert.
- **Posteriors.** The unit step is the fastest by far, and the wrong law: off by 1.6 to 2.5
  posterior standard deviations, and too sure of it. With latent points it is off by what Euler's
  ten steps are. `gibbs`, of second order in as many steps, is not visibly off, with more draws a
  second. Where σ is unknown and varies the two are level at equal steps: off alike, with about as
  many independent draws a second. In logarithms, with four times as many steps, most of that is
  gone, at half as many draws a second; a part is left, of which its `step_error` tells.
"""


def _run(key: Key[Array, ""], quick: bool, say: Say) -> Rivals:
    sizes = Sizes(500, 50, 50, 8, 500) if quick else Sizes()
    return run_rivals(key, quick, sizes, say)


RIVALS = Study(
    "Beside other packages",
    _run,
    in_plain_characters,
    """\
The same tasks, side by side. "first call" compiles, "again" does not. Bridges: log p less the
exact one, and the share of paths that count. Filters: the spread of one log likelihood, and what a
filter of variance one would take. Posteriors: how far their means are off, in exact posterior
standard deviations. What is not installed has a row that says so.""",
    lambda figures, made: {"how_to_choose.png": figures.how_to_choose()},
    rivals_files,
)
