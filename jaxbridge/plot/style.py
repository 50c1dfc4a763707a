"""How pictures look: colours, markers, axes. Needs the extra `plot`."""

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
        'pictures are drawn by matplotlib; install it with `pip install "jaxbridge[plot]"`.'
    ) from error

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9")  # Okabe & Ito
EXACT = "0.15"
MARKERS = ("o", "^", "s", "D")
DASHES = ((0, (6, 3)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))

# Margins and samples come as arrays of either kind.
Reals = Array | np.ndarray
Number = float | np.floating | Float[Reals, ""]


def axes_or_new(ax: Axes | None, **axes: Any) -> Axes:
    if ax is not None:
        return ax
    return plt.subplots(layout="constrained", subplot_kw=axes)[1]


def finish(ax: Axes, **legend: Any) -> Axes:
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize="small", **legend)
    return ax


def found(
    paths: Float[Reals, "n K d"],
) -> tuple[Float[np.ndarray, "m K d"], Int[np.ndarray, " m"]]:
    """Those of the bridges that there are, and which they are: the others are NaN."""
    values = np.asarray(paths, float)
    if values.ndim != 3:
        raise ValueError(f"`paths` must have shape (n, K, d); got shape {values.shape}.")
    (index,) = np.nonzero(_finite(values))
    if len(index) == 0:
        raise ValueError("`paths` must have a bridge to draw: none of these was found.")
    return values[index], index


def there(name: str, draws: Float[Reals, "n ..."]) -> Float[np.ndarray, "m ..."]:
    """The draws that are numbers: those of bridges that were found."""
    draws = np.asarray(draws, float)
    kept = draws[_finite(draws)]
    if len(kept) == 0:
        raise ValueError(f"the sample `{name}` must have draws that are finite; none is.")
    return kept


def _finite(rows: Float[np.ndarray, "n ..."]) -> Bool[np.ndarray, " n"]:
    """Which rows have finite numbers only."""
    return np.asarray(np.isfinite(rows).reshape(len(rows), -1).all(axis=1))
