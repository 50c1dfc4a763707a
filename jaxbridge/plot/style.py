"""Shared style of all pictures (colours, markers, axes) and the selection of finite draws.

The import of Matplotlib is here, with an error message that names the extra to install.
"""

from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float, Int

try:
    import matplotlib.pyplot as plt
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
    from matplotlib.lines import Line2D as Line2D
    from mpl_toolkits.mplot3d import Axes3D as Axes3D
except ImportError as error:
    raise ImportError(
        "`jaxbridge.plot` needs Matplotlib, which is not installed. Run "
        '`pip install "jaxbridge[plot]"`.'
    ) from error

# The palette of Okabe & Ito, which colour-blind readers can distinguish.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9")
EXACT = "0.15"
MARKERS = ("o", "^", "s", "D")
DASHES = ((0, (6, 3)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))

# Users pass arrays of JAX or of NumPy.
Reals = Array | np.ndarray
Number = float | np.floating | Float[Reals, ""]


def axes_or_new(ax: Axes | None, **axes: Any) -> Axes:
    """Return the given axes, or new axes with these keyword arguments of `add_subplot`."""
    if ax is not None:
        return ax
    return plt.subplots(layout="constrained", subplot_kw=axes)[1]


def finish(ax: Axes, **legend: Any) -> Axes:
    """Remove the upper and right frame lines, add a legend, and return the axes."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize="small", **legend)
    return ax


def finite_paths(
    paths: Float[Reals, "n K d"],
) -> tuple[Float[np.ndarray, "m K d"], Int[np.ndarray, " m"]]:
    """Return the finite paths and their indices: bridges that were not found are NaN.

    Raise `ValueError` for paths of another shape, or if no path is finite.
    """
    values = np.asarray(paths, float)
    if values.ndim != 3:
        raise ValueError(f"`paths` must have shape (n, K, d); got shape {values.shape}.")
    (index,) = np.nonzero(_finite(values))
    if len(index) == 0:
        raise ValueError(
            f"`paths` must contain a finite path; got {len(values)} paths with NaN or infinity. "
            "Use more proposals, or check `bridges.met`."
        )
    return values[index], index


def finite_draws(name: str, draws: Float[Reals, "n ..."]) -> Float[np.ndarray, "m ..."]:
    """Return the finite draws, without those of bridges that were not found.

    Raise `ValueError`, with the `name` of the sample, if no draw is finite.
    """
    draws = np.asarray(draws, float)
    finite = draws[_finite(draws)]
    if len(finite) == 0:
        raise ValueError(
            f"the sample `{name}` must contain finite draws; got {len(draws)} draws with NaN or "
            "infinity. Leave the sample out, or sample more bridges."
        )
    return finite


def _finite(rows: Float[np.ndarray, "n ..."]) -> Bool[np.ndarray, " n"]:
    """Return a mask of the rows that contain only finite numbers."""
    return np.asarray(np.isfinite(rows).reshape(len(rows), -1).all(axis=1))
