"""The picture of README: bridges around a ring, and a record with its smoothed path.

Run `python -m studies.readme_picture` in the folder `notebooks`; it writes `readme.png`.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxbridge as jb
from jaxbridge.plot.style import COLOURS, EXACT, Figure

# Stiffness of the ring of radius one.
_STIFFNESS = 30.0
_STEPS = 200


def log_density(x: Float[Array, " 2"], p: None) -> Float[Array, ""]:
    """Return the log of the stationary density on a ring, up to a constant."""
    return -_STIFFNESS * jnp.square(x @ x - 1.0) / 2


def ring_bridges(key: Array, num: int) -> Float[np.ndarray, "num points 2"]:
    """Sample bridges between opposite points of the ring, which can take either way round."""
    chain = jb.sample_exact_bridges(
        key,
        jb.langevin(log_density),
        [-1.0, 0.0],
        [1.0, 0.0],
        1.5,
        num_bridges=8 * num,
        num_steps=_STEPS,
        proposal=jb.Coupling(0.0, start_law=jb.Stationary(burn_in=20.0)),
    )
    paths = np.asarray(chain.paths)
    return paths[np.isfinite(paths).all(axis=(1, 2))][::8][:num]


def smoothed_record(key: Array) -> tuple[np.ndarray, ...]:
    """Simulate a double well and a noisy record with a gap, and smooth it.

    Return the times and points of the path, those of the record, the times of the smoothed paths,
    and the paths, shape (n, K).
    """
    model = jb.Diffusion(lambda x, p: 2 * (x - x**3), [0.9])
    fine = np.linspace(0, 20, 1001)
    path = np.asarray(jb.simulate(key, model, [-1.0], fine, num_steps=2)[0])[:, 0]
    times, values = fine[::25], path[::25] + 0.25 * np.random.default_rng(5).normal(size=41)
    values[22:28] = np.nan
    smoothed = jb.smooth(
        jax.random.fold_in(key, 1),
        model,
        times,
        values[:, None],
        observation=jb.LinearGaussian(covariance=0.25**2),
        initial=[-1.0],
    )
    draws = np.asarray(smoothed.paths)[..., 0].reshape(-1, len(smoothed.times))
    return fine, path, times, values, np.asarray(smoothed.times), draws


def draw(key: Array) -> Figure:
    """Draw both panels."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.7])
    grid = np.linspace(-1.7, 1.7, 200)
    squares = grid[None] ** 2 + grid[:, None] ** 2
    density = np.exp(-_STIFFNESS * (squares - 1) ** 2 / 2)
    left.contourf(grid, grid, density, 12, cmap="Greys", alpha=0.5)
    paths = ring_bridges(jax.random.fold_in(key, 2), 40)
    above = paths[:, :, 1].mean(axis=1) > 0
    for side, colour in zip((paths[above], paths[~above]), COLOURS[:2], strict=True):
        for path in side[:4]:
            left.plot(*path.T, color=colour, linewidth=0.9, alpha=0.8)
    left.plot([-1, 1], [0, 0], "o", color=EXACT, markersize=7)
    left.annotate("a", (-1, 0), (-1.5, 0.0), fontsize="x-large", va="center")
    left.annotate("b", (1, 0), (1.4, 0.0), fontsize="x-large", va="center")
    left.set(aspect="equal", xticks=[], yticks=[], xlim=(-1.7, 1.7), ylim=(-1.7, 1.7))
    left.set_title("bridges from a to b, both ways round", fontsize="medium")
    fine, path, times, values, grid, draws = smoothed_record(key)
    low, middle, high = np.quantile(draws, [0.05, 0.5, 0.95], axis=0)
    right.fill_between(grid, low, high, color=COLOURS[0], alpha=0.3, label="90 % band")
    right.plot(grid, middle, color=COLOURS[0], label="smoothed path")
    right.plot(fine, path, color=EXACT, linewidth=0.6, label="true path")
    right.plot(times, values, "o", color=COLOURS[1], markersize=4, label="observations")
    right.set(xlabel="time", ylabel="position")
    right.set_title("a noisy record with a gap", fontsize="medium")
    right.legend(frameon=False, ncols=4, fontsize="small", loc="lower center")
    right.set_ylim(bottom=-2.6)
    right.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    draw(jax.random.key(0)).savefig(Path(__file__).parents[1] / "readme.png", dpi=150)
