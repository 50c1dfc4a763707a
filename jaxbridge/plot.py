"""Pictures of bridges, and of their law beside an exact one. Needs the extra `plot`."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, Float

from .bridges import Bridges
from .gaussian import GaussianBridge, GaussianLaw

try:
    import matplotlib.pyplot as plt
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
except ImportError as error:
    raise ImportError(
        'pictures are drawn by matplotlib; install it with `pip install "jaxbridge[plot]"`.'
    ) from error

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9")  # Okabe & Ito
_EXACT = "0.15"
_MARKERS = ("o", "^", "s", "D")
_DASHES = ((0, (6, 3)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))

# Margins and samples come as arrays of either kind.
Reals = Array | np.ndarray


def qq(
    samples: Mapping[str, Float[Reals, " n"]],
    mean: float,
    sd: float,
    ax: Axes | None = None,
) -> Axes:
    """Q-Q plot of one margin against N(mean, sd²), each method in its own colour.

    `samples` are the draws of each method by its name. Quantiles are shown at levels that are
    evenly spaced on the normal scale, out to the most extreme draws; on the diagonal the two
    laws agree.
    """
    ax = _axes(ax)
    largest = max(np.size(values) for values in samples.values())
    reach = mean + sd * np.array([-1, 1]) * _scores(largest)[-1]
    ax.plot(reach, reach, color=_EXACT, linewidth=0.8, label="exact")
    for i, (name, values) in enumerate(samples.items()):
        scores = _scores(np.size(values))
        levels = np.asarray(ndtr(scores), float)
        quantiles = np.quantile(np.asarray(values, float), levels, method="hazen")
        colour, marker = _COLOURS[i % len(_COLOURS)], _MARKERS[i % len(_MARKERS)]
        style = {"color": colour, "markersize": 3.5, "markeredgewidth": 0.8, "fillstyle": "none"}
        ax.plot(mean + sd * scores, quantiles, marker, label=name, **style)
    ax.set(xlabel="exact quantile", ylabel="quantile of the bridges")
    return _finish(ax)


def copula_levels(
    samples: Mapping[str, Float[Reals, "n 2"]],
    covariance: Float[Reals, "2 2"],
    levels: Sequence[float] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9),
    ax: Axes | None = None,
) -> Axes:
    """Level curves of the copula: exact (full drawn) and of each method's draws (dashed).

    `samples` are the draws of each method by its name; `covariance` is that of the exact,
    Gaussian law.
    """
    ax = _axes(ax)
    variance = np.diag(covariance)
    correlation = float(covariance[0, 1] / np.sqrt(variance[0] * variance[1]))
    resolution = 100
    grid = np.linspace(0, 1, resolution + 1)

    def draw(copula, **style):
        return ax.contour(grid, grid, copula.T, levels=list(levels), **style)

    u, v = np.meshgrid(grid, grid, indexing="ij")
    draw(gaussian_copula(u, v, correlation), colors=_EXACT, linewidths=0.8)
    handles = [Line2D([], [], color=_EXACT, linewidth=0.8, label="exact")]
    for i, (name, values) in enumerate(samples.items()):
        colour, dashes = _COLOURS[i % len(_COLOURS)], _DASHES[i % len(_DASHES)]
        copula = empirical_copula(values, resolution)
        draw(copula, colors=colour, linewidths=1.4, linestyles=[dashes])
        handles.append(Line2D([], [], color=colour, linewidth=1.4, linestyle=dashes, label=name))
    # No labels on the curves: C(1, v) = v, so each ends on the right at its own level.
    ax.set(xlabel="$u$", ylabel="$v$", xticks=levels, yticks=levels)
    return _finish(ax, handles=handles, loc="lower left")


def bridge_fan(
    times: Float[Reals, " K"],
    paths: Float[Reals, "n K d"],
    ax: Axes | None = None,
    coordinate: int = 0,
    num_paths: int = 5,
) -> Axes:
    """One coordinate of many bridges: median, 50 % and 90 % bands, and the first few paths.

    `times` and `paths` as `sample_bridges` returns them; bridges not found are left out.
    """
    ax = _axes(ax)
    values = np.asarray(paths, float)[..., coordinate]
    values = values[np.all(np.isfinite(values), axis=1)]
    times = np.asarray(times, float)
    low, lower, median, upper, high = np.quantile(values, [0.05, 0.25, 0.5, 0.75, 0.95], axis=0)
    colour = _COLOURS[0]
    band = {"color": colour, "linewidth": 0}
    ax.fill_between(times, low, high, alpha=0.15, label="90 %", **band)
    ax.fill_between(times, lower, upper, alpha=0.3, label="50 %", **band)
    ax.plot(times, values[:num_paths].T, color=_EXACT, linewidth=0.6, alpha=0.7)
    ax.plot(times, median, color=colour, linewidth=1.6, label="median")
    ax.set(xlabel="time", ylabel=f"$Z^{{({coordinate + 1})}}_t$", xlim=(times[0], times[-1]))
    return _finish(ax)


def margins_and_copula(
    samples: Mapping[str, Float[Reals, "n 2"]], law: GaussianLaw, title: str
) -> Figure:
    """The figures of section 3: Q-Q plots of both margins and the copula, in one row."""
    figure = Figure(figsize=(11, 4.1), layout="constrained")
    *margins, dependence = figure.subplots(1, 3)
    for i, ax in enumerate(margins):
        margin = {name: values[:, i] for name, values in samples.items()}
        qq(margin, float(law.mean[i]), float(jnp.sqrt(law.covariance[i, i])), ax)
        ax.set_title(f"coordinate {i + 1}", fontsize="medium")
        ax.set_box_aspect(1)
    copula_levels(samples, law.covariance, ax=dependence)
    dependence.set_title("copula, level curves", fontsize="medium")
    dependence.set_box_aspect(1)
    figure.suptitle(title)
    return figure


def bridges_overview(bridges: Bridges, exact: GaussianBridge) -> Figure:
    """Two-dimensional bridges: paths with time upwards, and each coordinate's bands with those
    of the exact law dashed over them."""
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    space = figure.add_subplot(1, 3, 1, projection="3d")
    times, paths = np.asarray(bridges.times, float), np.asarray(bridges.paths, float)
    for colour, path in zip(_COLOURS[:3], paths, strict=False):
        space.plot(*path.T, times, color=colour, linewidth=0.9)
    for end, time in ((paths[0, 0], times[0]), (paths[0, -1], times[-1])):
        space.plot([end[0]], [end[1]], [time], "o", color=_EXACT, markersize=4)
    space.set(xlabel="$Z^{(1)}$", ylabel="$Z^{(2)}$")
    space.set_title("time upwards", fontsize="small")
    space.tick_params(labelsize="x-small", pad=0)
    space.locator_params(nbins=4)
    space.set_box_aspect((1, 1, 1.6))
    space.view_init(elev=15, azim=-55)
    for coordinate in range(2):
        ax = bridge_fan(times, paths, figure.add_subplot(1, 3, coordinate + 2), coordinate)
        mean = np.asarray(exact.mean, float)[:, coordinate]
        sd = np.sqrt(np.maximum(np.asarray(exact.covariance, float)[:, coordinate, coordinate], 0))
        for score in ndtri(np.array([0.05, 0.25, 0.5, 0.75, 0.95])):
            label = "exact" if score == 0 else None
            curve = mean + float(score) * sd
            ax.plot(times, curve, color=_EXACT, linewidth=0.9, linestyle=_DASHES[0], label=label)
        bottom, top = ax.get_ylim()
        ax.set_ylim(bottom - 0.2 * (top - bottom), top)  # room for the legend
        ax.legend(frameon=False, fontsize="x-small", ncols=2, loc="lower center")
    return figure


def variation(results: Sequence[Any]) -> Figure:
    """std/mean of 1/π_T against γ for each bridge: results of `exact_study.run_variation`."""
    bridges = list(dict.fromkeys(result.bridge for result in results))
    figure = Figure(figsize=(3.6 * len(bridges), 3.4), layout="constrained")
    for ax, bridge in zip(figure.subplots(1, len(bridges), squeeze=False)[0], bridges, strict=True):
        group = [result for result in results if result.bridge == bridge]
        place = np.arange(len(group))
        for i, (label, name) in enumerate([("ν", "right"), ("as printed", "published")]):
            found = [getattr(result, name) for result in group]
            ratio = [float(v.ratio) for v in found]
            error = [2 * float(v.ratio_error) for v in found]
            style = {"color": _COLOURS[i], "marker": _MARKERS[i], "capsize": 3, "markersize": 5}
            ax.errorbar(place + 0.08 * i, ratio, error, label=label, **style)
        ax.set(xticks=place, xticklabels=[f"{result.gamma:g}" for result in group], xlabel="γ")
        ax.set(ylim=(-0.02, 0.8))
        ax.set_title(bridge.replace("->", "→").replace("-", "−"), fontsize="medium")
        _finish(ax, title="start law")
    figure.axes[0].set_ylabel("std / mean of $1/\\pi_T$, ± 2 s.e.")
    return figure


def cost(costs: Sequence[Any], slope: float) -> Figure:
    """Seconds per effective bridge against the duration: results of `exact_study.run_cost`."""
    figure = Figure(figsize=(7.6, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    duration = np.array([c.duration for c in costs])
    seconds = np.array([c.seconds for c in costs])
    left.loglog(duration, seconds, _MARKERS[0] + "-", color=_COLOURS[0], label="measured")
    last = duration >= 10
    line = seconds[-1] * (duration[last] / duration[-1]) ** slope
    left.loglog(duration[last], line, "--", color=_EXACT, label=f"slope {slope:.2f}")
    left.set(xlabel="duration T", ylabel="seconds per effective bridge")
    _finish(left)
    acceptance = [c.acceptance for c in costs]
    right.semilogx(duration, acceptance, _MARKERS[0] + "-", color=_COLOURS[0])
    right.set(xlabel="duration T", ylabel="share of steps accepted", ylim=(0, 1.03))
    right.spines[["top", "right"]].set_visible(False)
    return figure


def crossover(rates: Sequence[Any]) -> Figure:
    """Effective samples per second against the duration, a panel for each process: results of
    `crossover_study.run_crossover`."""
    names = list(dict.fromkeys(rate.process for rate in rates))
    figure = Figure(figsize=(4.1 * len(names), 3.8), layout="constrained")
    panels = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
    for ax, name in zip(panels, names, strict=True):
        group = [rate for rate in rates if rate.process == name]
        for i, proposal in enumerate(dict.fromkeys(rate.proposal for rate in group)):
            points = [(r.duration, r.per_second) for r in group if r.proposal == proposal]
            duration, value = np.array(points).T
            if proposal == '"auto"':
                style = {"color": _EXACT, "linestyle": "--", "marker": "", "linewidth": 1.4}
            else:
                style = {"color": _COLOURS[i % len(_COLOURS)], "marker": _MARKERS[i % 4]}
                style |= {"markersize": 4, "linewidth": 1.2}
            ax.loglog(duration, np.maximum(value, 1e-1), label=proposal, **style)
        ax.set(xlabel="duration T", title=name.replace("-", "–"))
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


def work_precision(result: Any, ax: Axes | None = None) -> Axes:
    """Error against time, a curve for each proposal and method, its points labelled with their
    numbers of steps: a result of `jaxbridge.work_precision`.

    The error is that which stays however many bridges are made, ± its uncertainty; the time is
    that of 1,000 effective samples. The dotted line is the Monte Carlo error of so many.
    """
    ax = _axes(ax)
    for i, (curve, group) in enumerate(result.curves()):
        seconds = np.array([1_000 / s.per_second for s in group])
        error, uncertainty = (
            np.array([getattr(s, name) for s in group]) for name in ("error", "uncertainty")
        )
        below = np.minimum(uncertainty, 0.9 * error)  # the axis is logarithmic
        style: dict[str, Any] = {"color": _COLOURS[i % 5], "marker": _MARKERS[i % 4]}
        style |= {"markersize": 4, "linewidth": 1.1, "capsize": 2, "elinewidth": 0.7}
        style["linestyle"] = "-" if i < len(_COLOURS) else "--"
        ax.errorbar(seconds, error, [below, uncertainty], label=curve, **style)
        for s, x, y in zip(group, seconds, error, strict=True):
            label = {"fontsize": "x-small", "color": style["color"], "xytext": (4, 3)}
            ax.annotate(str(s.num_steps), (x, y), textcoords="offset points", **label)
    if result.target is not None:
        ax.axhline(result.target, color=_EXACT, linewidth=0.8, linestyle="--", label="target")
    ax.axhline(1_000**-0.5, color=_EXACT, linewidth=0.8, linestyle=":")
    ax.set(xscale="log", yscale="log", xlabel="seconds for 1,000 effective samples")
    ax.set_ylabel("error in standard deviations")
    return _finish(ax)


def accuracy(results: Mapping[str, Any]) -> Figure:
    """Error against time for the paper's process and for a full σ(x): results of
    `accuracy_study.run_accuracy`."""
    chosen = [results[title] for title in ("the paper's process", "a full σ(x)")]
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    for ax, result in zip(figure.subplots(1, 2, sharey=True), chosen, strict=True):
        work_precision(result, ax)
        ax.legend(frameon=False, fontsize="x-small", loc="lower left")
        ax.set_ylim(1e-3, 1)
    figure.axes[1].set_ylabel("")
    return figure


def effect_costs(costs: Sequence[Any], ax: Axes | None = None) -> Axes:
    """What each effect adds to the time of a path and step: results of
    `accuracy_study.run_effect_costs`."""
    ax = _axes(ax)
    names = [cost.scene for cost in costs]
    nanoseconds = [cost.nanoseconds for cost in costs]
    place = np.arange(len(costs))[::-1]
    ax.barh(place, nanoseconds, color=_COLOURS[0], height=0.6)
    for y, value in zip(place, nanoseconds, strict=True):
        ax.annotate(f" {value:.0f}", (value, y), va="center", fontsize="small")
    ax.set(yticks=place, yticklabels=names, xlabel="nanoseconds a path and step")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def posterior(
    draws: Mapping[str, Float[Reals, " n"]],
    grid: Float[Reals, " m"],
    curves: Mapping[str, Float[Reals, " m"]],
    label: str = "parameter",
    ax: Axes | None = None,
) -> Axes:
    """Histograms of each sampler's draws of one parameter, over densities that are known.

    `draws` are those of each sampler by its name, `curves` densities on the `grid`, likewise.
    """
    ax = _axes(ax)
    everything = np.concatenate([np.asarray(values, float) for values in draws.values()])
    bins = np.linspace(everything.min(), everything.max(), 60)
    for i, (name, values) in enumerate(draws.items()):
        colour = _COLOURS[i % len(_COLOURS)]
        ax.hist(
            np.asarray(values, float),
            bins,
            density=True,
            histtype="step",
            color=colour,
            linewidth=1.2,
            label=name,
        )
    for i, (name, density) in enumerate(curves.items()):
        dashes = ("-", *_DASHES)[i % (len(_DASHES) + 1)]
        ax.plot(grid, density, color=_EXACT, linestyle=dashes, linewidth=1.0, label=name)
    spread = everything.max() - everything.min()
    ax.set_xlim(everything.min() - spread / 2, everything.max() + spread / 2)
    ax.set(xlabel=label, ylabel="density")
    return _finish(ax)


def trace(
    draws: Mapping[str, Float[Reals, " n"]],
    level: float | None = None,
    label: str = "parameter",
    ax: Axes | None = None,
) -> Axes:
    """The draws of one parameter in the order in which they were made, by each sampler."""
    ax = _axes(ax)
    for i, (name, values) in enumerate(draws.items()):
        colour = _COLOURS[i % len(_COLOURS)]
        ax.plot(np.asarray(values, float), color=colour, linewidth=0.4, label=name)
    if level is not None:
        ax.axhline(level, color=_EXACT, linewidth=0.8)
    ax.set(xlabel="iteration", ylabel=label)
    return _finish(ax)


def gaussian_copula(
    u: Float[np.ndarray, "..."], v: Float[np.ndarray, "..."], correlation: float
) -> Float[np.ndarray, "..."]:
    """The Gaussian copula C(u, v), for u, v in [0, 1] and -1 < correlation < 1.

    By Plackett's identity ∂C/∂r = φ₂(x, y; r), integrated from independence with r = sin θ.
    """
    # Away from the edges, where the scores are infinite, by less than a picture can show.
    x, y = (np.asarray(ndtri(np.clip(p, 1e-6, 1 - 1e-6)), float)[..., None] for p in (u, v))
    nodes, weights = np.polynomial.legendre.leggauss(48)
    half = np.arcsin(correlation) / 2
    angle = half * (1 + nodes)
    exponent = (x**2 + y**2 - 2 * x * y * np.sin(angle)) / (2 * np.cos(angle) ** 2)
    return u * v + half * np.exp(-exponent) @ weights / (2 * np.pi)


def empirical_copula(
    samples: Float[Reals, "n 2"], resolution: int
) -> Float[np.ndarray, "{resolution}+1 {resolution}+1"]:
    """C_n(u, v), the share of draws with ranks at most nu and nv, at u, v = 0, 1/m, ..., 1,
    m being the `resolution`."""
    n = len(samples)
    ranks = np.argsort(np.argsort(np.asarray(samples), axis=0), axis=0) + 1
    cell = (ranks * resolution - 1) // n  # rank/n lies in (cell/m, (cell + 1)/m]
    counts = np.zeros((resolution + 1, resolution + 1))
    np.add.at(counts, tuple(cell.T + 1), 1)
    return counts.cumsum(0).cumsum(1) / n


def _scores(n: int, num_points: int = 61) -> Float[np.ndarray, " num_points"]:
    """Evenly spaced normal scores, out to those of the extremes of n draws."""
    last = -float(ndtri(0.5 / n))
    return np.linspace(-last, last, num_points)


def _axes(ax: Axes | None) -> Axes:
    return plt.subplots(layout="constrained")[1] if ax is None else ax


def _finish(ax: Axes, **legend) -> Axes:
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize="small", **legend)
    return ax
