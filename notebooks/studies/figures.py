"""Figures of the studies, composed from the pictures of `jaxbridge.plot`."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxbridge import plot
from jaxbridge.plot.style import COLOURS, EXACT, MARKERS, Figure

from .bayes import PRIOR_MEAN, PRIOR_VARIANCE, Example


def crossover(rates: Sequence[Any], long: float) -> Figure:
    """Effective samples per second against the duration, a panel for each process: results of
    `crossover.run_crossover`. Durations from `long` on, with more steps, are shaded."""
    names = list(dict.fromkeys(rate.process for rate in rates))
    figure = Figure(figsize=(4.1 * len(names), 3.8), layout="constrained")
    panels = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
    for ax, name in zip(panels, names, strict=True):
        group = [rate for rate in rates if rate.process == name]
        for i, proposal in enumerate(dict.fromkeys(rate.proposal for rate in group)):
            points = [(r.duration, r.per_second) for r in group if r.proposal == proposal]
            duration, value = np.array(points).T
            if proposal == '"auto"':
                style = {"color": EXACT, "linestyle": "--", "marker": "", "linewidth": 1.4}
            else:
                style = {"color": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % 4]}
                style |= {"markersize": 4, "linewidth": 1.2}
            ax.loglog(duration, np.maximum(value, 1e-1), label=proposal, **style)
        ax.set(xlabel="duration T", title=name.replace("-", "–"))
        longest = max(rate.duration for rate in group)
        if longest >= long:
            ax.axvspan(long / 2, 2 * longest, color="0.95", zorder=0)
        ax.set_xlim(0.7 * min(rate.duration for rate in group), 1.4 * longest)
        ax.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("effective samples per second")
    panels[0].set_ylim(bottom=3)
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=6,
        frameon=False,
        fontsize="small",
    )
    return figure


def accuracy(results: Mapping[str, Any]) -> Figure:
    """Error against time for the paper's process and for a full σ(x): results of
    `accuracy.run_accuracy`."""
    chosen = [results[title] for title in ("the paper's process", "a full σ(x)")]
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    for ax, result in zip(figure.subplots(1, 2, sharey=True), chosen, strict=True):
        plot.work_precision(result, ax)
        ax.legend(frameon=False, fontsize="x-small", loc="lower left")
        ax.set_ylim(1e-3, 1)
    figure.axes[1].set_ylabel("")
    return figure


def effect_costs(costs: Sequence[Any]) -> Figure:
    """What each effect adds to the time of a path and step: results of
    `accuracy.run_effect_costs`."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    ax, place = figure.subplots(), np.arange(len(costs))[::-1]
    bars = ax.barh(place, [cost.nanoseconds for cost in costs], color=COLOURS[0], height=0.6)
    ax.bar_label(bars, fmt=" {:.0f}", fontsize="small")
    ax.set(yticks=place, yticklabels=[cost.scene for cost in costs])
    ax.set_xlabel("nanoseconds a path and step")
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def bayes(example: Example) -> dict[str, Figure]:
    """Posterior, prior and likelihood, and the traces of the chains."""
    exact = example.exact
    prior = np.exp(-((exact.grid - PRIOR_MEAN) ** 2) / (2 * PRIOR_VARIANCE))
    curves = {
        "exact posterior": exact.density,
        "likelihood": exact.likelihood,
        "prior": prior / math.sqrt(2 * math.pi * PRIOR_VARIANCE),
    }
    shown = {each.name: each.draws for each in example.sampled if "N = 12" not in each.name}
    density, trace = Figure(layout="constrained"), Figure(layout="constrained")
    plot.posterior(shown, exact.grid, curves, "α", density.subplots())
    plot.trace(shown, exact.mean, "α", trace.subplots())
    return {"bayes_posterior.png": density, "bayes_trace.png": trace}


# Observation, purpose, condition, call.
_CHOICES = (
    (
        "observed exactly",
        (
            (
                "bridges, or\ntransition densities",
                (
                    ("T below one\nrelaxation time", "ModifiedDiffusionBridge(), Guided()"),
                    ("in doubt", 'proposal="auto"'),
                    ("T many\nrelaxation times", "Coupling(0.0)"),
                ),
            ),
            (
                "parameters",
                (
                    ("σ known", "gibbs, maximum_likelihood, score"),
                    ("σ unknown", "pmmh, maximum_likelihood"),
                ),
            ),
        ),
    ),
    (
        "observed with noise,\nor in part;\nor noise in some\ncoordinates only;\n"
        "or time-dependent\ncoefficients",
        (
            ("likelihood", (("", "log_likelihood"),)),
            (
                "paths",
                (
                    ("short gaps", "smooth"),
                    ("long gaps\nbetween wells", 'smooth(proposal="auto")'),
                ),
            ),
            ("parameters", (("σ and noise known\nor unknown", "gibbs, pmmh, maximum_likelihood"),)),
        ),
    ),
)  # fmt: skip


def how_to_choose() -> Figure:
    """Draw the choice of a function as a tree, from the kind of observation on the left."""
    figure = Figure(figsize=(11, 5.4), layout="constrained")
    ax = figure.subplots()
    ax.set_axis_off()
    columns, height = (0.0, 0.26, 0.49, 0.68), 0.0
    box: dict[str, Any] = {"boxstyle": "round,pad=0.45", "linewidth": 1.0}
    asked: dict[str, Any] = {"ha": "left", "va": "center", "fontsize": "small"}

    def write(column: int, y: float, text: str) -> None:
        if column == 3:
            shown = {**box, "facecolor": "white", "edgecolor": COLOURS[0]}
            ax.text(columns[3], y, text, family="monospace", bbox=shown, **asked)
        elif text:
            shown = {**box, "facecolor": "0.94", "edgecolor": "0.7"}
            ax.text(columns[column], y, text, bbox=shown, **asked)

    def join(column: int, y: float, others: Sequence[float]) -> None:
        for other in others:
            ends = [columns[column], columns[column + 1]], [y, other]
            ax.plot(*ends, color="0.6", linewidth=1.0, zorder=0)

    for seen, wanted in _CHOICES:
        middles = []
        for what, conditions in wanted:
            places = []
            for condition, call in conditions:
                write(3, height, call)
                write(2, height, condition)
                join(2, height, [height])
                places.append(height)
                height -= 1.0
            middles.append(float(np.mean(places)))
            write(1, middles[-1], what)
            join(1, middles[-1], places)
        middle = float(np.mean(middles))
        write(0, middle, seen)
        join(0, middle, middles)
        height -= 0.4
    ax.set(xlim=(-0.01, 0.93), ylim=(height + 0.5, 0.7))
    for x, title in zip(
        columns, ("the diffusion is", "you want", "if", "call, or proposal"), strict=True
    ):
        ax.text(x, 0.75, title, fontsize="small", fontweight="bold")
    return figure
