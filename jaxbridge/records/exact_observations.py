"""Exact observations of the whole state as intervals, after all checks of times and values."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..engine.checks import Numbers, check_precision, index_without_compiling, is_traced
from ..engine.compiled import compiled_sooner
from ..engine.times import check_increasing
from ..models.bridge_problem import Intervals, as_intervals
from ..models.diffusion import Diffusion
from .record import as_times_and_rows, of_each, split_records


def as_observations(model: Diffusion, times: Numbers, observations: Numbers) -> Intervals:
    """Return the intervals between n + 1 observations, or those of several records in sequence.

    **Raises:** `ValueError` that names the invalid time or observation.
    """
    one = lambda times, observations: _intervals(model, times, observations)
    intervals = of_each(one, split_records(times, observations))
    with jax.ensure_compile_time_eval():  # concrete values stay concrete inside `jit`
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *intervals)


def _intervals(model: Diffusion, times: Numbers, observations: Numbers) -> Intervals:
    """Return the intervals of one record, after all checks."""
    grid, observations = as_times_and_rows(
        _unmasked("times", times), _unmasked("observations", observations)
    )
    if grid.shape[0] < 2:
        raise ValueError(
            f"`times` and `observations` need at least two entries; got {grid.shape[0]}."
        )
    check_precision("`times` and `observations`", jnp.promote_types(grid.dtype, observations.dtype))
    check_increasing(grid)
    if not is_traced(observations):
        _check_finite(np.asarray(observations))
        _check_state_space(model, observations)
    # Slices of JAX arrays would compile a program for each shape.
    before, after = (
        index_without_compiling(observations, slice(-1)),
        index_without_compiling(observations, slice(1, None)),
    )
    intervals, _, _ = as_intervals(before, after, grid.gaps)
    return intervals


def _check_finite(observations: np.ndarray) -> None:
    """Raise `ValueError` for the first observation that is not finite."""
    finite = np.isfinite(observations)
    missing = np.flatnonzero(~finite.all(axis=1))
    if not missing.size:
        return
    i = missing[0]
    if finite[i].any():
        which = ", ".join(map(str, np.flatnonzero(~finite[i])))
        raise ValueError(
            f"`observations[{i}]` = {observations[i]} has no finite number for coordinate {which}, "
            "but exact observations must be complete: leave out this row, with its time, or pass "
            "an `observation` to functions that take records."
        )
    raise ValueError(
        f"`observations[{i}]` = {observations[i]} is not finite: leave out observations that are "
        "missing, with their times."
    )


def _unmasked(name: str, values: Numbers) -> Numbers:
    """Return the data of a masked NumPy array.

    **Raises:** `ValueError` if an entry is masked.
    """
    if not isinstance(values, np.ma.MaskedArray):
        return values
    mask = np.ma.getmaskarray(values)
    if mask.any():
        place = np.argwhere(mask)[0]
        which = f"`{name}[{place[0]}]`" if place.size else f"`{name}`"
        all_masked = place.size < 2 or mask[place[0]].all()
        coordinate = "" if all_masked else f", in coordinate {place[1]},"
        raise ValueError(
            f"{which} is masked{coordinate} but observations must be complete: leave out the whole "
            "row with its time."
        )
    return values.data


def _check_state_space(model: Diffusion, observations: Array) -> None:
    """Raise `ValueError` for the first observation outside the model's state space."""
    # The coefficients of a traced model have no values yet.
    if is_traced(model):
        return

    good = _inside(model, observations)
    if not is_traced(good) and not np.all(np.asarray(good)):
        i = int(np.argmin(good))
        raise ValueError(
            f"`observations[{i}]` = {np.asarray(observations[i])} is outside the state space: "
            "drift, σ or the stationary density of the model is not finite there. Check the "
            "observation and the model's `params`."
        )


@compiled_sooner
def _inside(model: Diffusion, observations: Float[Array, "n d"]) -> Bool[Array, " n"]:
    """Return whether the coefficients and the stationary density are finite at each point."""

    def finite(x):
        values = [model.drift(x), model.diffusion(x)]
        values += [model.log_stationary(x)] if model.has_density else []
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(value)) for value in values]))

    return jax.vmap(finite)(observations)
