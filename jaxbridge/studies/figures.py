"""Figures of the paper's study, composed from the pictures of `plot`. Needs the extra `plot`."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import jaxbridge as jb

from .. import plot
from ..plot.style import COLOURS, EXACT, MARKERS, Figure, Reals, finish


def margins_and_copula(
    samples: Mapping[str, Float[Reals, "n 2"]], law: jb.GaussianLaw, title: str
) -> Figure:
    """Draw the figures of section 3: Q-Q plots of both margins and the copula, in one row."""
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
    """Draw two-dimensional bridges with time upwards, and the bands of each coordinate with those
    of the exact law as dashed lines."""
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
    """Draw std/mean of 1/π_T against γ for each bridge: results of `exact.run_variation`."""
    bridges = list(dict.fromkeys(result.bridge for result in results))
    figure = Figure(figsize=(3.6 * len(bridges), 3.4), layout="constrained")
    for ax, bridge in zip(figure.subplots(1, len(bridges), squeeze=False)[0], bridges, strict=True):
        group = [result for result in results if result.bridge == bridge]
        # Values of γ are far from equally spaced.
        place = np.arange(len(group))
        for i, (label, name) in enumerate([("ν", "right"), ("as printed", "published")]):
            variations = [getattr(result, name) for result in group]
            ratio = [float(v.ratio) for v in variations]
            # Bars of two standard errors hold about 95 %.
            error = [2 * float(v.ratio_error) for v in variations]
            style = {"color": COLOURS[i], "marker": MARKERS[i], "capsize": 3, "markersize": 5}
            ax.errorbar(place + 0.08 * i, ratio, error, label=label, **style)
        ax.set(xticks=place, xticklabels=[f"{result.gamma:g}" for result in group], xlabel="γ")
        ax.set(ylim=(-0.02, 0.8))
        ax.set_title(_typeset(bridge), fontsize="medium")
        finish(ax, title="start law")
    figure.axes[0].set_ylabel("std / mean of $1/\\pi_T$, ± 2 s.e.")
    return figure


def cost(costs: Sequence[Any], slope: float) -> Figure:
    """Draw seconds per effective bridge against the duration: results of `exact.run_cost`."""
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


def _typeset(title: str) -> str:
    return title.replace("->", "→").replace("-", "−")
