"""What accuracy costs in time: the settings that were measured, and the cheapest of them."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..engine.pareto import is_reliable


class Setting(NamedTuple):
    """One setting of `work_precision`, and what it came to.

    - `method`, `proposal`, `scheme`, `meeting`, `gamma`, `dtype`, `num_steps`: the setting;
        `scheme` is the target density of proposals that are pulled to the end point, and `gamma`
        NaN where there is none.
    - `error`: of the estimate, in standard deviations of the estimated variable (of a density:
        relative), with its `uncertainty`, a standard error.
    - `step_error` with its `step_uncertainty`, `method_error`, `monte_carlo_error`: its parts.
    - `seconds` of a run, and `compile_seconds`, which are apart.
    - `num_simulated`: paths simulated.
    - `effective_samples`: how many independent exact bridges have this Monte Carlo error.
    - `per_second`: those, per second.
    - `num_missing`: bridges that were not found, or whose weights were cut off: the estimate is
        that of the others, or NaN if there are none.
    - `pareto_k`: k̂ of the weights, NaN where there are none. Above 0.7 no figure of the row is to
        be trusted.
    """

    method: str
    proposal: str
    scheme: str
    meeting: str
    gamma: float
    dtype: str
    num_steps: int
    error: float
    uncertainty: float
    step_error: float
    step_uncertainty: float
    method_error: float
    monte_carlo_error: float
    seconds: float
    compile_seconds: float
    num_simulated: int
    effective_samples: float
    per_second: float
    num_missing: int = 0
    pareto_k: float = np.nan

    @property
    def curve(self) -> str:
        """All but the number of steps, in words."""
        words = (self.method, self.proposal, self.scheme, self.meeting, self.dtype)
        return ", ".join(word for word in words if word)

    def seconds_for(self, target: float) -> float:
        """Seconds until the root of the sum of both squared errors is below `target`: the one that
        stays, at its upper end, and the Monte Carlo error of a longer run. Infinite where the
        former is above, be it for its uncertainty alone."""
        stays = self.error + self.uncertainty
        if not stays < target:
            return np.inf
        return 1 / (target**2 - stays**2) / self.per_second


class Order(NamedTuple):
    """The fitted exponent of the step error in the step length, and its standard error, in which
    the error of the reference, common to all points, is not counted; NaN where fewer than two step
    errors can be told from noise."""

    order: float
    error: float


class WorkPrecision(NamedTuple):
    """What `work_precision` returns.

    - `settings`: a tuple of `Setting`; `pandas.DataFrame(result.settings)` is a table.
    - `reference`: "exact", or how the finest run was made.
    - `target`: the accuracy asked for, or `None`.
    """

    settings: tuple[Setting, ...]
    reference: str
    target: float | None

    def as_dict(self) -> dict[str, np.ndarray]:
        """The table as one array for each column."""
        columns = zip(*self.settings, strict=True)
        return {
            name: np.array(column) for name, column in zip(Setting._fields, columns, strict=True)
        }

    def cheapest(self, target: float | None = None) -> Setting | None:
        """The setting that reaches an accuracy, by default `target`, in the least time; `None`
        where none does, or the uncertainty of their errors is too large to tell."""
        target = self.target if target is None else target
        if target is None:
            raise ValueError("`cheapest` needs a `target`: an error in standard deviations.")
        best = min(self.settings, key=lambda setting: setting.seconds_for(target))
        return best if np.isfinite(best.seconds_for(target)) else None

    def statement(self, target: float | None = None) -> str:
        """What an accuracy costs here, in a sentence."""
        target = self.target if target is None else target
        best = self.cheapest(target)
        if target is None or best is None:
            return (
                f"accuracy {target:g}: none of these settings is seen to reach it; take more "
                "steps, or more bridges"
            )
        seconds = best.seconds_for(target)
        return (
            f"accuracy {target:g} costs {seconds:.2g} s here: {best.curve}, {best.num_steps} steps"
        )

    def orders(self) -> dict[str, Order]:
        """The order of the step error of each curve."""
        return {curve: _fit_order(group) for curve, group in self.curves()}

    def curves(self) -> Iterator[tuple[str, list[Setting]]]:
        """The settings that differ in the number of steps only, by what they share."""
        for curve in dict.fromkeys(setting.curve for setting in self.settings):
            yield curve, [setting for setting in self.settings if setting.curve == curve]

    def __str__(self) -> str:
        head = ("steps", "error", "±", "step", "method", "Monte Carlo", "seconds", "compile")
        row = "{:>8} {:>9} {:>8} {:>9} {:>9} {:>12} {:>9} {:>8} {:>10} {:>10}"
        lines = [row.format(*head, "paths", "eff/s")]
        for curve, group in self.curves():
            order = _fit_order(group)
            fitted = f"   order {order.order:.2f} ± {order.error:.2f}"
            lines.append(curve + ("" if np.isnan(order.order) else fitted))
            for s in group:
                parts = (s.error, s.uncertainty, s.step_error, s.method_error, s.monte_carlo_error)
                errors = (f"{part:.4f}" for part in parts)
                times = (f"{s.seconds:.3f}", f"{s.compile_seconds:.1f}")
                work = (f"{s.num_simulated:,}", f"{s.per_second:,.0f}")
                missing = f"   {s.num_missing:,} missing" if s.num_missing else ""
                if not (np.isnan(s.pareto_k) or is_reliable(jnp.asarray(s.pareto_k))):
                    missing += f"   heavy tails, k = {s.pareto_k:.2f}"
                lines.append(row.format(s.num_steps, *errors, *times, *work) + missing)
        lines.append(f"reference: {self.reference}")
        if self.target is not None:
            lines.append(self.statement())
        return "\n".join(lines)


def _fit_order(group: Sequence[Setting]) -> Order:
    """Least squares of log step error against log number of steps, weighted by how well each is
    known; those within two standard errors of zero are left out."""
    known = [s for s in group if s.step_error > 2 * s.step_uncertainty]
    if len({s.num_steps for s in known}) < 2:
        return Order(np.nan, np.nan)
    x = -np.log([s.num_steps for s in known])
    y = np.log([s.step_error for s in known])
    weight = np.array([(s.step_error / s.step_uncertainty) ** 2 for s in known])
    centred = x - np.average(x, weights=weight)
    spread = weight @ centred**2
    return Order(float(weight * centred @ y / spread), float(spread**-0.5))
