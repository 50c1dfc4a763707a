"""The pictures themselves."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri

import jaxbridge as jb

from .copula import empirical_copula, gaussian_copula
from .style import (
    COLOURS,
    DASHES,
    EXACT,
    MARKERS,
    Axes,
    Axes3D,
    Line2D,
    Number,
    Reals,
    axes_or_new,
    finish,
    found,
    there,
)

LEVELS = np.array([0.05, 0.25, 0.5, 0.75, 0.95])
SCORES = ndtri(LEVELS)


def paths_in_space(
    times: Float[Reals, " K"],
    paths: Float[Reals, "n K 2"],
    ax: Axes | None = None,
    num_paths: int = 3,
) -> Axes:
    """The first few two-dimensional bridges with time upwards, as in the paper's first figure.

    `times`, shape (K,), and `paths`, (n, K, 2), as `sample_bridges` returns them; bridges not found
    are left out, and of the others `num_paths` are drawn. `ax`, if it is given, must be made with
    `projection="3d"`.

    **Raises:** `ValueError` for paths that do not have two coordinates; `TypeError` for flat axes.

    **Example:**

    ```python
    plot.paths_in_space(bridges.times, bridges.paths)
    ```
    """
    space = axes_or_new(ax, projection="3d")
    if not isinstance(space, Axes3D):
        raise TypeError('`ax` must be made with `projection="3d"`; got flat axes.')
    times, (paths, _) = np.asarray(times, float), found(paths)
    if paths.shape[-1] != 2:
        raise ValueError(f"`paths` must have two coordinates; got shape {paths.shape}.")
    for i, path in enumerate(paths[:num_paths]):
        space.plot(*path.T, times, color=COLOURS[i % len(COLOURS)], linewidth=0.9)
    for end in (0, -1):
        space.plot(*paths[:1, end].T, times[end], "o", color=EXACT, markersize=4)
    space.set(xlabel="$Z^{(1)}$", ylabel="$Z^{(2)}$")
    space.set_title("time upwards", fontsize="small")
    space.tick_params(labelsize="x-small", pad=0)
    space.locator_params(nbins=4)
    space.set_box_aspect((1, 1, 1.6))
    space.view_init(elev=15, azim=-55)
    return space


def bridge_fan(
    times: Float[Reals, " K"],
    paths: Float[Reals, "*n K d"],
    ax: Axes | None = None,
    coordinate: int = 0,
    num_paths: int = 5,
    exact: jb.GaussianBridge | None = None,
    weights: Float[Reals, " n"] | None = None,
    data: tuple[Float[Reals, " m"], Float[Reals, " m"]] | None = None,
    data_sd: Number | Float[Reals, " m"] = 0.0,
) -> Axes:
    """One coordinate of many bridges: median, 50 % and 90 % bands, and the first few paths.

    `times`, shape (K,), and `paths`, (n, K, d), as `sample_bridges` returns them, or (chains, n, K,
    d), as `smooth` does; bridges not found are left out. `coordinate` counts from zero; `num_paths`
    are drawn. `weights`, shape (n,), are those of weighted bridges, by which the paths that are
    drawn are chosen too. The same quantiles of an `exact` law, a result of `gaussian_bridge` at
    these times, are dashed. `data` are times and values at which this coordinate was seen, NaN
    where it was not, with noise of standard deviation `data_sd`, drawn twice either way. `ax` is
    where to draw.

    **Example:**

    ```python
    plot.bridge_fan(bridges.times, bridges.paths, coordinate=1)
    ```
    """
    ax = axes_or_new(ax)
    times, paths = np.asarray(times, float), np.asarray(paths)
    kept, index = found(paths.reshape(-1, *paths.shape[2:]) if paths.ndim == 4 else paths)
    values = kept[..., coordinate]
    if weights is None:
        shown, curves = values[:num_paths], np.quantile(values, LEVELS, axis=0)
    else:
        mass = np.asarray(weights, float)[index]
        places = (np.arange(num_paths) + 0.5) / max(num_paths, 1) * mass.sum()
        shown = values[np.searchsorted(np.cumsum(mass), places)]
        curves = np.quantile(values, LEVELS, axis=0, weights=mass, method="inverted_cdf")
    low, lower, median, upper, high = curves
    colour = COLOURS[0]
    band = {"color": colour, "linewidth": 0}
    ax.fill_between(times, low, high, alpha=0.15, label="90 %", **band)
    ax.fill_between(times, lower, upper, alpha=0.3, label="50 %", **band)
    ax.plot(times, shown.T, color=EXACT, linewidth=0.6, alpha=0.7)
    ax.plot(times, median, color=colour, linewidth=1.6, label="median")
    if exact is not None:
        mean = np.asarray(exact.mean, float)[:, coordinate]
        variance = np.asarray(exact.covariance, float)[:, coordinate, coordinate]
        curves = mean[:, None] + np.sqrt(np.maximum(variance, 0))[:, None] * SCORES
        lines = ax.plot(times, curves, color=EXACT, linewidth=0.9, linestyle=DASHES[0])
        lines[2].set_label("exact")
    if data is not None:
        when, seen = (np.asarray(each, float) for each in data)
        error = np.where(np.isnan(seen), np.nan, 2 * np.asarray(data_sd, float))
        style = {"fmt": ".", "color": COLOURS[1], "markersize": 5, "elinewidth": 0.9, "zorder": 3}
        ax.errorbar(when, seen, error if np.any(error > 0) else None, label="seen", **style)
    ax.set(xlabel="time", ylabel=f"$Z^{{({coordinate + 1})}}_t$", xlim=(times[0], times[-1]))
    return finish(ax)


def qq(
    samples: Mapping[str, Float[Reals, " n"]],
    mean: Number,
    sd: Number,
    ax: Axes | None = None,
) -> Axes:
    """Q-Q plot of one margin against N(mean, sd²), each method in its own colour.

    `samples` are the draws of each method by its name, shape (n,), of which those that are NaN, of
    bridges not found, are left out; `mean` and `sd` those of the exact law. Quantiles are shown at
    levels that are evenly spaced on the normal scale, out to the most extreme draws; on the
    diagonal the two laws agree. `ax` is where to draw.

    **Example:**

    ```python
    exact = jb.gaussian_bridge(model, start, end, 1.0, times=[0.5])
    mean, sd = exact.mean[0, 0], jnp.sqrt(exact.covariance[0, 0, 0])
    plot.qq({"approximate": bridges.paths[:, 25, 0]}, mean, sd)
    ```
    """
    ax, mean, sd = axes_or_new(ax), float(mean), float(sd)
    kept = {name: there(name, values) for name, values in samples.items()}
    largest = max(len(values) for values in kept.values())
    reach = mean + sd * np.array([-1, 1]) * _scores(largest)[-1]
    ax.plot(reach, reach, color=EXACT, linewidth=0.8, label="exact")
    for i, (name, values) in enumerate(kept.items()):
        scores = _scores(len(values))
        quantiles = np.quantile(values, ndtr(scores), method="hazen")
        colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]
        style = {"color": colour, "markersize": 3.5, "markeredgewidth": 0.8, "fillstyle": "none"}
        ax.plot(mean + sd * scores, quantiles, marker, label=name, **style)
    ax.set(xlabel="exact quantile", ylabel="quantile of the bridges")
    return finish(ax)


def copula_levels(
    samples: Mapping[str, Float[Reals, "n 2"]],
    covariance: Float[Reals, "2 2"],
    levels: Sequence[float] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9),
    ax: Axes | None = None,
) -> Axes:
    """Level curves of the copula: exact (full drawn) and of each method's draws (dashed).

    `samples` are the draws of each method by its name, shape (n, 2), of which those that are NaN,
    of bridges not found, are left out; `covariance`, (2, 2), is that
    of the exact, Gaussian law; `levels` are those of the curves, between 0 and 1. `ax` is where to
    draw.

    **Example:**

    ```python
    exact = jb.gaussian_bridge(model, start, end, 1.0, times=[0.5])
    plot.copula_levels({"approximate": bridges.paths[:, 25]}, exact.covariance[0])
    ```
    """
    ax = axes_or_new(ax)
    variance = np.diag(covariance)
    correlation = float(covariance[0, 1] / np.sqrt(variance[0] * variance[1]))
    resolution = 100
    grid = np.linspace(0, 1, resolution + 1)

    def draw(copula, **style):
        return ax.contour(grid, grid, copula.T, levels=list(levels), **style)

    u, v = np.meshgrid(grid, grid, indexing="ij")
    draw(gaussian_copula(u, v, correlation), colors=EXACT, linewidths=0.8)
    handles = [Line2D([], [], color=EXACT, linewidth=0.8, label="exact")]
    for i, (name, values) in enumerate(samples.items()):
        colour, dashes = COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)]
        copula = empirical_copula(there(name, values), resolution)
        draw(copula, colors=colour, linewidths=1.4, linestyles=[dashes])
        handles.append(Line2D([], [], color=colour, linewidth=1.4, linestyle=dashes, label=name))
    # No labels on the curves: C(1, v) = v, so each ends on the right at its own level.
    ax.set(xlabel="$u$", ylabel="$v$", xticks=levels, yticks=levels)
    return finish(ax, handles=handles, loc="lower left")


def work_precision(result: jb.WorkPrecision, ax: Axes | None = None) -> Axes:
    """Error against time, a curve for each proposal and method, its points labelled with their
    numbers of steps.

    `result` is what `jaxbridge.work_precision` returned. The error is that which stays however many
    bridges are made, ± its uncertainty; the time is that of 1,000 effective samples. The dotted
    line is the Monte Carlo error of so many. `ax` is where to draw.

    **Example:**

    ```python
    result = jb.work_precision(
        key, model, start, end, 1.0, proposals=[jb.Coupling()], num_steps=(4, 8), target=0.05
    )
    plot.work_precision(result)
    ```
    """
    ax = axes_or_new(ax)
    for i, (curve, group) in enumerate(result.curves()):
        seconds = np.array([1_000 / s.per_second for s in group])
        error, uncertainty = (
            np.array([getattr(s, name) for s in group]) for name in ("error", "uncertainty")
        )
        below = np.minimum(uncertainty, 0.9 * error)  # the axis is logarithmic
        style: dict[str, Any] = {"color": COLOURS[i % 5], "marker": MARKERS[i % 4]}
        style |= {"markersize": 4, "linewidth": 1.1, "capsize": 2, "elinewidth": 0.7}
        style["linestyle"] = "-" if i < len(COLOURS) else "--"
        ax.errorbar(seconds, error, [below, uncertainty], label=curve, **style)
        for s, x, y in zip(group, seconds, error, strict=True):
            label = {"fontsize": "x-small", "color": style["color"], "xytext": (4, 3)}
            ax.annotate(str(s.num_steps), (x, y), textcoords="offset points", **label)
    if result.target is not None:
        ax.axhline(result.target, color=EXACT, linewidth=0.8, linestyle="--", label="target")
    ax.axhline(1_000**-0.5, color=EXACT, linewidth=0.8, linestyle=":")
    ax.set(xscale="log", yscale="log", xlabel="seconds for 1,000 effective samples")
    ax.set_ylabel("error in standard deviations")
    return finish(ax)


def posterior(
    draws: Mapping[str, Float[Reals, "*chains n"]],
    grid: Float[Reals, " m"],
    curves: Mapping[str, Float[Reals, " m"]],
    label: str = "parameter",
    ax: Axes | None = None,
    bins: int = 60,
) -> Axes:
    """Histograms of each sampler's draws of one parameter, over densities that are known.

    `draws` are those of each sampler by its name, shape (n,), or (chains, n), taken together;
    `curves` densities on the `grid`, both of shape (m,), likewise. `label` names the parameter.
    `ax` is where to draw, `bins` how many bins there are over the range of all draws.

    **Example:**

    ```python
    draws = jax.random.normal(key, (1000,))  # as `theta[:, 0]` of a posterior
    grid = jnp.linspace(-4, 4, 100)
    plot.posterior({"Gibbs": draws}, grid, {"exact": jax.scipy.stats.norm.pdf(grid)})
    ```
    """
    ax = axes_or_new(ax)
    flat = {name: there(name, np.ravel(values)) for name, values in draws.items()}
    everything = np.concatenate(list(flat.values()))
    edges = np.linspace(everything.min(), everything.max(), bins + 1)
    for i, (name, values) in enumerate(flat.items()):
        colour = COLOURS[i % len(COLOURS)]
        ax.hist(
            values,
            edges,
            density=True,
            histtype="step",
            color=colour,
            linewidth=1.2,
            label=name,
        )
    for i, (name, density) in enumerate(curves.items()):
        dashes = ("-", *DASHES)[i % (len(DASHES) + 1)]
        ax.plot(grid, density, color=EXACT, linestyle=dashes, linewidth=1.0, label=name)
    spread = everything.max() - everything.min()
    ax.set_xlim(everything.min() - spread / 2, everything.max() + spread / 2)
    ax.set(xlabel=label, ylabel="density")
    return finish(ax)


def trace(
    draws: Mapping[str, Float[Reals, "*chains n"]],
    level: float | None = None,
    label: str = "parameter",
    ax: Axes | None = None,
) -> Axes:
    """The draws of one parameter in the order in which they were made, by each sampler.

    `draws` are those of each sampler by its name, shape (n,), or (chains, n), drawn over each
    other. A line is drawn at `level`, where it is given, for instance at the true value. `label`
    names the parameter. `ax` is where to draw.

    **Example:**

    ```python
    draws = jax.random.normal(key, (1000,))  # as `theta[:, 0]` of a posterior
    plot.trace({"Gibbs": draws}, level=0.0)
    ```
    """
    ax = axes_or_new(ax)
    for i, (name, values) in enumerate(draws.items()):
        style: dict[str, Any] = {"color": COLOURS[i % len(COLOURS)], "linewidth": 0.4}
        for j, chain in enumerate(np.atleast_2d(np.asarray(values, float))):
            ax.plot(chain, **style, label=name if j == 0 else None)
    if level is not None:
        ax.axhline(level, color=EXACT, linewidth=0.8)
    ax.set(xlabel="iteration", ylabel=label)
    return finish(ax)


def _scores(n: int) -> Float[np.ndarray, " scores"]:
    """Evenly spaced normal scores, out to those of the extremes of n draws."""
    last = -ndtri(0.5 / n)
    return np.linspace(-last, last, 61)
