"""The figures of the studies, made of the pictures of `plot`. Needs the extra `plot`."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import jaxbridge as jb

from .. import plot
from ..plot.style import COLOURS, EXACT, MARKERS, Figure, Reals, finish
from .bayes import PRIOR_MEAN, PRIOR_VARIANCE, Example


def margins_and_copula(
    samples: Mapping[str, Float[Reals, "n 2"]], law: jb.GaussianLaw, title: str
) -> Figure:
    """The figures of section 3: Q-Q plots of both margins and the copula, in one row."""
    figure = Figure(figsize=(11, 4.1), layout="constrained")
    *margins, dependence = figure.subplots(1, 3)
    for i, ax in enumerate(margins):
        margin = {name: values[:, i] for name, values in samples.items()}
        plot.qq(margin, float(law.mean[i]), float(jnp.sqrt(law.covariance[i, i])), ax)
        ax.set_title(f"coordinate {i + 1}", fontsize="medium")
        ax.set_box_aspect(1)
    plot.copula_levels(samples, law.covariance, ax=dependence)
    dependence.set_title("copula, level curves", fontsize="medium")
    dependence.set_box_aspect(1)
    figure.suptitle(_typeset(title))
    return figure


def bridges_overview(bridges: jb.Bridges, exact: jb.GaussianBridge) -> Figure:
    """Two-dimensional bridges: paths with time upwards, and each coordinate's bands with those
    of the exact law dashed over them."""
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    plot.paths_in_space(bridges.times, bridges.paths, figure.add_subplot(1, 3, 1, projection="3d"))
    for i in range(2):
        panel = figure.add_subplot(1, 3, i + 2)
        ax = plot.bridge_fan(bridges.times, bridges.paths, panel, coordinate=i, exact=exact)
        bottom, top = ax.get_ylim()
        ax.set_ylim(bottom - 0.2 * (top - bottom), top)  # room for the legend
        ax.legend(frameon=False, fontsize="x-small", ncols=2, loc="lower center")
    return figure


def variation(results: Sequence[Any]) -> Figure:
    """std/mean of 1/π_T against γ for each bridge: results of `exact.run_variation`."""
    bridges = list(dict.fromkeys(result.bridge for result in results))
    figure = Figure(figsize=(3.6 * len(bridges), 3.4), layout="constrained")
    for ax, bridge in zip(figure.subplots(1, len(bridges), squeeze=False)[0], bridges, strict=True):
        group = [result for result in results if result.bridge == bridge]
        place = np.arange(len(group))
        for i, (label, name) in enumerate([("ν", "right"), ("as printed", "published")]):
            found = [getattr(result, name) for result in group]
            ratio = [float(v.ratio) for v in found]
            error = [2 * float(v.ratio_error) for v in found]
            style = {"color": COLOURS[i], "marker": MARKERS[i], "capsize": 3, "markersize": 5}
            ax.errorbar(place + 0.08 * i, ratio, error, label=label, **style)
        ax.set(xticks=place, xticklabels=[f"{result.gamma:g}" for result in group], xlabel="γ")
        ax.set(ylim=(-0.02, 0.8))
        ax.set_title(_typeset(bridge), fontsize="medium")
        finish(ax, title="start law")
    figure.axes[0].set_ylabel("std / mean of $1/\\pi_T$, ± 2 s.e.")
    return figure


def cost(costs: Sequence[Any], slope: float) -> Figure:
    """Seconds per effective bridge against the duration: results of `exact.run_cost`."""
    figure = Figure(figsize=(7.6, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    duration = np.array([c.duration for c in costs])
    seconds = np.array([c.seconds for c in costs])
    left.loglog(duration, seconds, MARKERS[0] + "-", color=COLOURS[0], label="measured")
    last = duration >= 10
    line = seconds[-1] * (duration[last] / duration[-1]) ** slope
    left.loglog(duration[last], line, "--", color=EXACT, label=f"slope {slope:.2f}")
    left.set(xlabel="duration T", ylabel="seconds per effective bridge")
    finish(left)
    acceptance = [c.acceptance for c in costs]
    right.semilogx(duration, acceptance, MARKERS[0] + "-", color=COLOURS[0])
    right.set(xlabel="duration T", ylabel="share of steps accepted", ylim=(0, 1.03))
    right.spines[["top", "right"]].set_visible(False)
    return figure


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


# What was seen, what is wanted, under which condition: and the call.
_CHOICES = (
    (
        "seen exactly",
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
        "seen with noise,\nor in part;\nor σ does not reach\nthe whole state, or\n"
        "coefficients depend\non time",
        (
            ("likelihood", (("", "log_likelihood"),)),
            (
                "paths",
                (
                    ("gaps short beside\njumps of wells", "smooth"),
                    ("long gaps, wells", 'smooth(proposal="auto")'),
                ),
            ),
            ("parameters", (("σ or noise,\nknown or not", "gibbs, pmmh, maximum_likelihood"),)),
        ),
    ),
)  # fmt: skip


def how_to_choose() -> Figure:
    """From how the diffusion was seen to the function, as a tree from left to right."""
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
        columns, ("the diffusion was", "wanted", "where", "call, or proposal"), strict=True
    ):
        ax.text(x, 0.75, title, fontsize="small", fontweight="bold")
    return figure


def _typeset(title: str) -> str:
    return title.replace("->", "→").replace("-", "−")
