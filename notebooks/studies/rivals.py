"""The same tasks by other packages and by this one, in one run on one machine.

The tasks are bridges (`rival_bridges`), filters (`rival_filters`), posteriors (`rival_posteriors`)
and rare events (`rival_events`). A package that is not installed has a row that says so. Results
are stored as JSON, and the page `notebooks/rivals.md` is made from that file.
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
from .rival_events import NUM_STEPS as EVENT_STEPS, EventRow, run_events
from .rival_filters import NUM_STEPS, FilterRow, run_filters
from .rival_posteriors import PosteriorRow, run_posteriors

_PACKAGES = ("jax", "numpyro", "particles", "cuthbert", "equinox", "optax", "numpy", "numba")


class Sizes(NamedTuple):
    """Size of each task: paths of a bridge, training iterations, particles, filters, draws of a
    posterior, and simulated paths of an event."""

    paths: int = 1_000
    iterations: int = 1_000
    particles: int = 100
    filters: int = 64
    draws: int = 4_000
    simulated: int = 100_000


class Rivals(NamedTuple):
    """All rows, with the machine, its load and the date of the run."""

    device: str
    processor: str
    load: tuple[float, float]
    versions: dict[str, str]
    date: str
    sizes: Sizes
    bridges: list[BridgeRow]
    filters: list[FilterRow]
    posteriors: list[PosteriorRow]
    events: list[EventRow]


def run_rivals(key: Key[Array, ""], quick: bool, sizes: Sizes, say: Say = silent) -> Rivals:
    """Run all parts; with `quick` only the first task of each."""
    before = _load()
    keys = jax.random.split(key, 4)
    bridges = run_bridges(keys[0], quick, sizes.paths, sizes.iterations, say)
    filters = run_filters(keys[1], quick, sizes.particles, sizes.filters, say)
    posteriors = run_posteriors(keys[2], quick, sizes.draws, say)
    events = run_events(keys[3], quick, sizes.simulated, say)
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
        events,
    )


def _load() -> float:
    """Return the load average of the last minute, or zero if the system does not report it."""
    return round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else 0.0


def rivals_files(rivals: Rivals) -> dict[str, str]:
    """Return all results as JSON, and the page made from them, by file name."""
    content: dict[str, Any] = rivals._asdict()
    content["sizes"] = rivals.sizes._asdict()
    for name in ("bridges", "filters", "posteriors", "events"):
        content[name] = [row._asdict() for row in content[name]]
    text = json.dumps(content, indent=1, ensure_ascii=False)
    return {"rivals.json": text + "\n", "rivals.md": as_page(rivals)}


def load_rivals(path: Path) -> Rivals:
    """Read the JSON file of `rivals_files`."""
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    content["load"] = tuple(content["load"])
    content["sizes"] = Sizes(**content["sizes"])
    content["bridges"] = [BridgeRow(**row) for row in content["bridges"]]
    content["filters"] = [FilterRow(**row) for row in content["filters"]]
    content["posteriors"] = [PosteriorRow(**row) for row in content["posteriors"]]
    content["events"] = [EventRow(**row) for row in content["events"]]
    return Rivals(**content)


def bridge_table(rows: Sequence[BridgeRow]) -> Table:
    """Return the table of effective shares, log densities and seconds."""
    titles = ("bridge", "method", "effective share", "log p̂ - log p", "training, s",
              "first call, s", "later call, s")  # fmt: skip
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
    """Return the table of log-likelihoods, their spread and seconds.

    `variance × ms` is the time for one filter of variance one: the less, the better.
    """
    titles = ("record", "method", "log p̂", "log p̂ - log p", "sd of one filter", "ms per filter",
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
    """Return the table of shifts, widths, effective draws and seconds."""
    titles = ("data", "method", "unknown", "error of the mean, posterior sds", "sd / exact sd",
              "effective draws", "first call, s", "later call, s",
              "effective draws per s")  # fmt: skip
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


def event_table(rows: Sequence[EventRow]) -> Table:
    """Return the table of log probabilities, their errors and seconds."""
    titles = ("event", "method", "log P̂", "log P̂ - log P", "effective paths", "first call, s",
              "later call, s", "effective paths per s")  # fmt: skip
    return titles, [
        (
            r.event,
            r.way,
            r.why or _with_error(r.log_probability, r.standard_error, ".2f"),
            _number(r.error, "+.2f"),
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
        event_table(rivals.events),
    ]


def in_plain_characters(rivals: Rivals) -> str:
    """Return the tables as they are printed."""
    words = (2, 2, 3, 2)
    shown = zip(_tables(rivals), words, strict=True)
    return "\n\n".join(table(*each, number) for each, number in shown)


def _where(rivals: Rivals) -> str:
    packages = ", ".join(f"{name} {number}" for name, number in rivals.versions.items())
    before, after = rivals.load
    return f"""\
{rivals.device}, {rivals.processor}, {rivals.date}; {packages}.

The load average of the machine was {before:g} before the run and {after:g} after it. A load above
the number of cores makes all times longer, at times several times longer."""


def as_page(rivals: Rivals) -> str:
    """Return the text of `notebooks/rivals.md`."""
    bridges, filters, posteriors, events = (markdown(*each) for each in _tables(rivals))
    sizes = rivals.sizes
    return f"""\
# Comparison with other packages

jaxbridge and other packages run the same tasks: bridges, particle filters, posteriors and
rare events. In the stored run:

{_SUMMARY}
`python -m studies rivals`, in the folder `notebooks`, runs all packages that are installed. It
writes this page and [rivals.json](rivals.json).

{_where(rivals)}

All times are from one machine. JAX uses float32, NumPy float64. `first call` includes compilation,
`later call` does not.

## Bridges

{_about_bridges(sizes)}
{bridges}

## Filters

{_about_filters(sizes)}
{filters}

## Posteriors

{_about_posteriors(sizes)}
{posteriors}

## Rare events

{_about_events(sizes)}
{events}

## Results in detail

These remarks are about the stored run.

{_DETAILS}
## Install the other packages

A package that is not installed has a row that says so.

- `pip install ".[rivals]"` installs cuthbert, numpyro, and the dependencies of particles.
- particles 0.4 requires a NumPy below 2, which JAX no longer supports. It runs with later versions,
  too: `pip install --no-deps particles`.
- In R: `install.packages(c("sde", "Sim.DiffProc"))`. These packages make approximate bridges
  without weights, so only their mean half way is compared.
"""


_SUMMARY = """\
- **Bridges.** More paths count with jaxbridge on three of five bridges, and with a learnt score on
  two. jaxbridge needs no training. A trained score is faster.
- **Filters.** At equal variance the other particle filters take from twice as much time to very
  much more. For a linear process a Kalman filter written by hand is exact and as fast as jaxbridge.
  The others have their first result sooner.
- **Posteriors.** `gibbs` is not visibly biased, whether σ is known or not. numpyro is, with as many
  steps of Euler's scheme.
- **Rare events.** Simulation is as good for a probability of 0.05. For probabilities below 1e-4
  jaxbridge has from 30 to 180 times as many effective paths per second, and simulation soon has
  none.
"""


def _about_bridges(sizes: Sizes) -> str:
    """Describe the bridges, the methods and the columns."""
    return f"""\
There are {sizes.paths:,} paths of each bridge:

- **OU**: an Ornstein–Uhlenbeck process, dX = -2X dt + dW, over T = 1 in 50 steps.
- **radial**: the radial process dX = (4/X - X) dt + dW, over T = 1 in 50 steps.
- **cells**: differentiation into two kinds of cells,
  dX_i = [X_i⁴/(2⁻⁴ + X_i⁴) + 2⁻⁴/(2⁻⁴ + X_j⁴) - X_i] dt + 0.1 dW_i, from (0.1, -0.1) to
  (2, -0.1) over T = 4 in 100 steps.

The methods:

- **jaxbridge** uses `proposal="auto"`; its selection follows the colon. Times are those of two
  calls: `sample_weighted_bridges` for the effective share, and `transition_log_density` for log p.
  Steps are of second order here.
- **learnt score** is a small version, written for this page, of a published method: Heng, De
  Bortoli, Doucet & Thornton, *Simulating diffusion bridges with score matching* (2021). It fits the
  score of the time reversal from the start.
    - The network has two hidden layers of 128. It is fitted by {sizes.iterations:,} iterations of
      Adam at a rate of 0.01, with 100 paths in each iteration. Its parameters are averaged.
    - One training serves for all ends, so the two bridges from 1.5 share one.
    - The weights are for the Euler scheme, so log p includes its discretisation error.

The first two settings are those of Heng et al., except for some end points. The cells are a model
of Wang, Zhang, Xu & Wang (2011). They have less noise and more time than those of Heng et al., as
in later studies of learnt bridges (Baker, Schauer & Sommer 2024).

The exact log p has a closed form for the first two: a normal law, and a noncentral χ². For the
cells it is the solution of the Fokker–Planck equation on two grids, extrapolated, with an error of
0.001.

Read the table so: an effective share near 1 and a log p̂ - log p near 0 are best.
"""


def _about_filters(sizes: Sizes) -> str:
    """Describe the records, the methods and the columns."""
    return f"""\
There are {sizes.filters} filters with {sizes.particles} particles each, in {NUM_STEPS} steps
between two observations, for each record:

- **OU**: a rotating Ornstein–Uhlenbeck process, d = 2. Its first coordinate is observed 50 times,
  at intervals of 0.5, with noise of sd 0.1. The exact likelihood is that of the Kalman filter.
- **double well**: dX = 2(X - X³) dt + 0.7 dW, observed in the same way. The exact likelihood is
  that of a filter on two grids, extrapolated.
- **prey and predators**: the chemical Langevin equation of the reactions of Lotka and Volterra,
  with rates 0.5, 0.0025 and 0.3 (Golightly & Wilkinson 2008). The prey is observed 40 times, at
  unit intervals, with noise of sd 5. The likelihood is not known. All packages use Euler steps of
  the same length.

The methods:

- **jaxbridge**: steps are of second order where σ is constant. Paths are guided by a linear process
  that depends on all later observations. Times include the estimate of the discretisation error, by
  half and a quarter as many steps.
- **[particles](https://github.com/nchopin/particles)** (Chopin & Papaspiliopoulos 2020) and
  **[cuthbert](https://github.com/state-space-models/cuthbert)** are frameworks, so the moves of the
  particles were written for this page. Both packages use the same moves, and resample
  systematically where fewer than half of the particles count.
    - "bootstrap": Euler steps.
    - "guided": Euler steps bent towards the next observation (Golightly & Wilkinson 2008; Whitaker,
      Golightly, Boys & Sherlock 2017).

Read the table so: `variance × ms` is the time for one filter of variance one, so the less, the
better.
"""


def _about_posteriors(sizes: Sizes) -> str:
    """Describe the data, the methods and the columns."""
    return f"""\
There are {sizes.draws:,} draws of one chain, given exact observations at unit intervals:

- **OU**: the rate of an Ornstein–Uhlenbeck process with known σ = 1.
- **CIR**: the rate κ and σ of dX = κ(½ - X) dt + σ√X dW (Cox, Ingersoll & Ross 1985).

Priors are N(1, 1) above zero. The exact posterior comes from the closed forms on a grid.

The methods:

- **jaxbridge**: `gibbs` for known σ. For unknown σ `pmmh`, in raw coordinates and in logarithms.
- **numpyro**: `EulerMaruyama`, sampled by NUTS. The unit interval is one step, or latent points
  divide it into {NUM_STEPS} steps.

`later call` is a call with another key, without the compilation in it. Each numpyro chain compiles
its start again. `gibbs` compiles again if a pilot run selects another proposal.

Read the table so: a mean error of 0 and an sd ratio of 1 are right.
"""


def _about_events(sizes: Sizes) -> str:
    """Describe the events, the methods and the columns."""
    return f"""\
The events are over one unit of time, in {EVENT_STEPS} steps:

- **passage**: a Brownian motion from 0 exceeds a level.
- **end in a set**: dX = -X dt + dW from 0 ends between 2.4 and 2.6.
- **transition between wells**: dX = 4(X - X³) dt + 0.5 dW from -1 exceeds 0.5.

The first two have a closed form. The third is the solution of the backward equation on two grids,
extrapolated. The methods:

- **jaxbridge** makes independent runs of multilevel splitting, with default settings. Times include
  the estimate of the discretisation error.
- **simulation**: {sizes.simulated:,} Euler paths in NumPy, and a count. It misses passages between
  two points of a path.

Read the table so: `effective paths` is the number of simulated paths *with the event* that have the
same standard error.
"""


_DETAILS = """\
**Bridges**

- On three of five bridges more of the paths count with jaxbridge, most clearly on the cells. On the
  radial bridges from 1.5 more paths count with the learnt score.
- jaxbridge needs no training, and a new start or duration costs no more. A score is trained for one
  start and duration.
- A trained score is faster, mostly several times, because "auto" makes pilot runs in each call.
- The bridge from 3 to 4 reuses compiled programs, so its first call with jaxbridge is short.
- The log p of the learnt score has the error of the Euler scheme, most clearly from 3 to 4.

**Filters**

- For the linear process all weights of jaxbridge are equal, and log p is that of the Kalman filter.
- For the double well the variance of jaxbridge is about that of the guided filters of the other
  packages, whose log p is off by half: their Euler steps are of first order. For prey and
  predators it is a hundredth of theirs.
- A bootstrap filter with so few particles is of little use if the noise is small.
- The guided filters of the other packages are limited by the moves of this page. These depend on
  one observation ahead.
- The other packages have their first result sooner. particles compiles nothing, and mostly has
  one filter in some hundredths of a second. JAX compiles for seconds: the first call of jaxbridge
  takes two to six times as long as that of cuthbert.

**Posteriors**

- numpyro with one step is the fastest by far, but its posterior is wrong. It is off by 1.6 to 2.5
  posterior standard deviations, and too narrow.
- numpyro with latent points has the error of ten Euler steps.
- `gibbs` takes as many steps, of second order, and is not visibly off. It has more effective draws
  per second, but its first call is longer.
- `pmmh` has few effective draws here: each iteration estimates all 100 densities anew.
- For a [population](howto/random_effects.md) of linear processes NUTS on a Kalman likelihood is
  faster than `gibbs`.

**Rare events**

- Simulation counts passages at the points of a path only, so it is too small by 12 % for the level
  2. The levels of `sample_exits` take passages between two points into account.
- For the two rarest events 100,000 paths have the event twice, or never.
"""


def _run(key: Key[Array, ""], quick: bool, say: Say) -> Rivals:
    sizes = Sizes(500, 50, 50, 8, 500, 1_000) if quick else Sizes()
    return run_rivals(key, quick, sizes, say)


RIVALS = Study(
    "Comparison with other packages",
    _run,
    in_plain_characters,
    """\
The same tasks by all packages. "first call" includes compilation, "later call" does not.
Bridges: the share of paths that count, and the error of log p.
Filters: the spread of one log-likelihood, and the time for one filter of variance one.
Posteriors: errors of the means, in exact posterior standard deviations.
Events: the error of log P, and the number of simulated paths with the event of the same error.
A package that is not installed has a row that says so.""",
    lambda figures, made: {"how_to_choose.png": figures.how_to_choose()},
    rivals_files,
)
