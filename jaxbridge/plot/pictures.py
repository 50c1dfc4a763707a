"""The drawing functions of `jaxbridge.plot`, one per picture."""

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
    finite_draws,
    finite_paths,
)

LEVELS = np.array([0.05, 0.25, 0.5, 0.75, 0.95])
SCORES = ndtri(LEVELS)  # the same quantiles of N(0, 1)


def paths_in_space(
    times: Float[Reals, " K"] | None,
    paths: Float[Reals, "n K 2"],
    ax: Axes | None = None,
    num_paths: int = 3,
) -> Axes:
    """Plot a few two-dimensional bridges in the plane, or in space with time upwards.

    With `times` the picture has three axes: both coordinates, and time upwards (the paper's first
    figure). With `times=None` it has the two coordinates only. Dots mark both end points.

    **Arguments:**

    - `times`, `paths`: shapes (K,) and (n, K, 2), as returned by `sample_bridges`. Bridges that
        were not found (NaN) are left out.
    - `ax`: axes to draw in; by default new ones. With `times` they need `projection="3d"`.
    - `num_paths`: number of paths to draw, the first ones.

    **Returns:** the axes.

    **Raises:** `ValueError` for paths without exactly two coordinates or without a finite path;
    `TypeError` for two-dimensional axes.

    **Example:**

    ```python
    plot.paths_in_space(bridges.times, bridges.paths)
    plot.paths_in_space(None, bridges.paths)  # in the plane
    ```
    """
    paths, _ = finite_paths(paths)
    if paths.shape[-1] != 2:
        raise ValueError(f"`paths` must have two coordinates; got shape {paths.shape}.")
    if times is None:
        return _draw_paths(axes_or_new(ax), paths, num_paths)
    space = axes_or_new(ax, projection="3d")
    if not isinstance(space, Axes3D):
        raise TypeError(
            '`ax` must be made with `projection="3d"`; got two-dimensional axes. Use '
            '`plt.subplots(subplot_kw={"projection": "3d"})`, or `times=None` for a picture in the '
            "plane."
        )
    upwards = np.broadcast_to(np.asarray(times, float)[:, None], (*paths.shape[:2], 1))
    _draw_paths(space, np.concatenate([paths, upwards], axis=-1), num_paths)
    space.set_title("time upwards", fontsize="small")
    space.tick_params(labelsize="x-small", pad=0)
    space.locator_params(nbins=4)
    space.set_box_aspect((1, 1, 1.6))
    space.view_init(elev=15, azim=-55)
    return space


def _draw_paths(ax: Axes, paths: Float[Reals, "n K axes"], num_paths: int) -> Axes:
    """Draw the first paths with their end points, and label both coordinates."""
    for i, path in enumerate(paths[:num_paths]):
        ax.plot(*path.T, color=COLOURS[i % len(COLOURS)], linewidth=0.9)
    # All bridges share both end points, so one path suffices.
    for end in (0, -1):
        ax.plot(*paths[:1, end].T, "o", color=EXACT, markersize=4)
    ax.set(xlabel=_label(0, 2), ylabel=_label(1, 2))
    return ax


def _label(coordinate: int, d: int, time: str = "") -> str:
    """Return the label of a coordinate of the state, without an index if there is only one."""
    return f"$X^{{({coordinate + 1})}}{time}$" if d > 1 else f"$X{time}$"


def _numbers_or_dates(times: Reals) -> np.ndarray:
    """Return times as floats; dates stay dates, for which matplotlib has an axis."""
    times = np.asarray(times)
    return times if times.dtype.kind == "M" else times.astype(float)


def bridge_fan(
    times: Reals,
    paths: Float[Reals, "*n K d"],
    ax: Axes | None = None,
    coordinate: int = 0,
    num_paths: int = 5,
    exact: jb.GaussianBridge | None = None,
    weights: Float[Reals, " n"] | None = None,
    data: tuple[Reals, Float[Reals, " m"]] | None = None,
    data_sd: Number | Float[Reals, " m"] = 0.0,
    truth: tuple[Reals, Float[Reals, " m"]] | None = None,
) -> Axes:
    """Plot one coordinate of many bridges or smoothed paths.

    The picture has the median, bands of 50 % and 90 %, and a few paths.

    **Arguments:**

    - `times`: numbers or dates (`datetime64`), shape (K,).
    - `paths`: shape (n, K, d), as returned by `sample_bridges`, or (chains, n, K, d), as returned
        by `smooth`. Bridges that were not found (NaN) are left out.
    - `ax`: axes to draw in; by default new ones.
    - `coordinate`: index of the coordinate, from zero.
    - `num_paths`: number of single paths to draw: the first ones, or a systematic resample if there
        are weights.
    - `exact`: result of `gaussian_bridge` at the same times. Its quantiles are drawn as dashed
        lines.
    - `weights`: weights of weighted bridges, shape (n,).
    - `data`: pair of observation times and observed values of this coordinate, with NaN for missing
        values.
    - `data_sd`: standard deviation of the observation noise. Error bars extend two standard
        deviations to either side.
    - `truth`: pair of times and values of this coordinate on the true path, if it is known. It is
        drawn as a line.

    **Returns:** the axes.

    **Raises:** `ValueError` for paths of another shape or without a finite path.

    **Example:**

    ```python
    plot.bridge_fan(bridges.times, bridges.paths, coordinate=1)
    ```
    """
    ax = axes_or_new(ax)
    times, paths = _numbers_or_dates(times), np.asarray(paths)
    finite, index = finite_paths(paths.reshape(-1, *paths.shape[2:]) if paths.ndim == 4 else paths)
    values = finite[..., coordinate]
    if weights is None:
        shown, curves = values[:num_paths], np.quantile(values, LEVELS, axis=0)
    else:
        mass = np.asarray(weights, float)[index]
        # Systematic resampling: the paths drawn represent the weighted law.
        places = (np.arange(num_paths) + 0.5) / max(num_paths, 1) * mass.sum()
        shown = values[np.searchsorted(np.cumsum(mass), places)]
        # NumPy supports weights only with this method.
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
        # Rounding errors may give small negative variances near the end points.
        curves = mean[:, None] + np.sqrt(np.maximum(variance, 0))[:, None] * SCORES
        lines = ax.plot(times, curves, color=EXACT, linewidth=0.9, linestyle=DASHES[0])
        lines[2].set_label("exact")
    if data is not None:
        data_times, observed = _numbers_or_dates(data[0]), np.asarray(data[1], float)
        # NaN hides the error bars of missing values.
        error = np.where(np.isnan(observed), np.nan, 2 * np.asarray(data_sd, float))
        style = {"fmt": ".", "color": COLOURS[1], "markersize": 5, "elinewidth": 0.9, "zorder": 3}
        ax.errorbar(
            data_times, observed, error if np.any(error > 0) else None, label="observed", **style
        )
    if truth is not None:
        style = {"color": COLOURS[2], "linewidth": 1.2, "zorder": 3}
        ax.plot(_numbers_or_dates(truth[0]), np.asarray(truth[1], float), label="truth", **style)
    label = _label(coordinate, paths.shape[-1], "_t")
    ax.set(xlabel="time", ylabel=label, xlim=(times[0], times[-1]))
    return finish(ax)


def qq(
    samples: Mapping[str, Float[Reals, " n"]],
    mean: Number,
    sd: Number,
    ax: Axes | None = None,
) -> Axes:
    """Plot the quantiles of one marginal law against those of N(mean, sd²), for each method.

    Points on the diagonal show agreement. The levels are evenly spaced on the normal scale, out to
    the most extreme draws.

    **Arguments:**

    - `samples`: draws of shape (n,), by the name of the method. Draws that are NaN (bridges not
        found) are left out.
    - `mean`, `sd`: mean and standard deviation of the exact law.
    - `ax`: axes to draw in; by default new ones.

    **Returns:** the axes.

    **Raises:** `ValueError` if a sample has no finite draw.

    **Example:**

    ```python
    exact = jb.gaussian_bridge(model, start, end, 1.0, times=[0.5])
    mean, sd = exact.mean[0, 0], jnp.sqrt(exact.covariance[0, 0, 0])
    plot.qq({"approximate": bridges.paths[:, 25, 0]}, mean, sd)
    ```
    """
    ax, mean, sd = axes_or_new(ax), float(mean), float(sd)
    finite = {name: finite_draws(name, values) for name, values in samples.items()}
    largest = max(len(values) for values in finite.values())
    reach = mean + sd * np.array([-1, 1]) * _scores(largest)[-1]
    ax.plot(reach, reach, color=EXACT, linewidth=0.8, label="exact")
    for i, (name, values) in enumerate(finite.items()):
        scores = _scores(len(values))
        # Hazen's positions (i - 1/2) / n agree with the scores of the extremes.
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
    """Plot level curves of a copula: exact (solid) and of the draws of each method (dashed).

    **Arguments:**

    - `samples`: draws of shape (n, 2), by the name of the method. Draws that are NaN (bridges not
        found) are left out.
    - `covariance`: covariance of the exact Gaussian law, shape (2, 2).
    - `levels`: levels of the curves, between 0 and 1.
    - `ax`: axes to draw in; by default new ones.

    **Returns:** the axes.

    **Raises:** `ValueError` if a sample has no finite draw.

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
        copula = empirical_copula(finite_draws(name, values), resolution)
        draw(copula, colors=colour, linewidths=1.4, linestyles=[dashes])
        handles.append(Line2D([], [], color=colour, linewidth=1.4, linestyle=dashes, label=name))
    # The curves need no labels: C(1, v) = v, so the curve of level v ends on the right at v.
    ax.set(xlabel="$u$", ylabel="$v$", xticks=levels, yticks=levels)
    return finish(ax, handles=handles, loc="lower left")


def work_precision(result: jb.WorkPrecision, ax: Axes | None = None) -> Axes:
    """Plot error against computing time, one curve per method, proposal and precision.

    The vertical axis has the distance from the reference, ± its uncertainty. More bridges reduce
    the uncertainty, but not the bias. The horizontal axis has the seconds for 1,000 effective
    samples. Labels show the number of steps. The dotted line is the Monte Carlo error of 1,000
    effective samples. If there is a target, a dashed line shows it.

    **Arguments:**

    - `result`: result of `jaxbridge.work_precision`.
    - `ax`: axes to draw in; by default new ones.

    **Returns:** the axes.

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
        # The colours repeat after five curves; dashes distinguish the next five.
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
    """Plot histograms of the draws of one parameter, with exact densities if they are known.

    **Arguments:**

    - `draws`: draws of shape (n,) or (chains, n), by the name of the sampler. All chains of one
        sampler share a histogram. Draws that are not finite are left out.
    - `grid`: parameter values of the densities, shape (m,).
    - `curves`: densities on the grid, shape (m,), by their names.
    - `label`: name of the parameter.
    - `ax`: axes to draw in; by default new ones.
    - `bins`: number of bins over the range of all draws.

    **Returns:** the axes.

    **Raises:** `ValueError` if a sampler has no finite draw.

    **Example:**

    ```python
    draws = jax.random.normal(key, (1000,))  # as `theta[:, 0]` of a posterior
    grid = jnp.linspace(-4, 4, 100)
    plot.posterior({"Gibbs": draws}, grid, {"exact": jax.scipy.stats.norm.pdf(grid)})
    ```
    """
    ax = axes_or_new(ax)
    flat = {name: finite_draws(name, np.ravel(values)) for name, values in draws.items()}
    all_draws = np.concatenate(list(flat.values()))
    edges = np.linspace(all_draws.min(), all_draws.max(), bins + 1)
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
    # A margin on both sides shows the tails of the densities.
    spread = all_draws.max() - all_draws.min()
    ax.set_xlim(all_draws.min() - spread / 2, all_draws.max() + spread / 2)
    ax.set(xlabel=label, ylabel="density")
    return finish(ax)


def trace(
    draws: Mapping[str, Float[Reals, "*chains n"]],
    level: float | None = None,
    label: str = "parameter",
    ax: Axes | None = None,
) -> Axes:
    """Plot the draws of one parameter against the iteration, for each sampler.

    **Arguments:**

    - `draws`: draws of shape (n,) or (chains, n), by the name of the sampler. The chains of one
        sampler share a colour.
    - `level`: height of a horizontal line, for instance the true value; by default there is none.
    - `label`: name of the parameter.
    - `ax`: axes to draw in; by default new ones.

    **Returns:** the axes.

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
    """Return 61 evenly spaced normal scores, up to the scores of the extremes of n draws."""
    last = -ndtri(0.5 / n)
    return np.linspace(-last, last, 61)
