"""Results of `work_precision`: the measured settings, their table and the cheapest setting.

The module needs no simulation: it works on numbers that `measurement` produced.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..engine.pareto import is_reliable


class Setting(NamedTuple):
    """One setting of `work_precision` with its measured errors and times.

    Errors are in standard deviations of the estimated variable; errors of a density are relative.

    - `method`, `proposal`, `scheme`, `meeting`, `gamma`, `dtype`, `num_steps`: the setting.
        `scheme` is the scheme of a coupling or the target density of a guided proposal. `gamma` is
        NaN for proposals without γ.
    - `error`, `uncertainty`: distance of the estimate from the reference, and its standard error.
    - `step_error`, `step_uncertainty`: discretisation error, and its standard error.
    - `method_error`: distance of the method's limit from the exact law. Zero except for approximate
        bridges.
    - `monte_carlo_error`: standard error of the estimate because of the finite number of samples.
    - `seconds`: median duration of one run, without compilation.
    - `compile_seconds`: additional duration of the first run, mostly compilation.
    - `num_simulated`: number of simulated paths.
    - `effective_samples`: number of independent exact bridges with the same Monte Carlo error.
    - `per_second`: effective samples per second.
    - `num_missing`: number of bridges that were not found, or whose weights were truncated. The
        estimate uses the other bridges and is NaN if there are none.
    - `pareto_k`: k̂ of the weights, NaN for methods without weights. Above 0.7 the whole row is
        unreliable.
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
        """Return the setting in words, without the number of steps."""
        words = (self.method, self.proposal, self.scheme, self.meeting, self.dtype)
        return ", ".join(word for word in words if word)

    def seconds_for(self, target: float) -> float:
        """Return the seconds that this setting needs for a total error of `target`.

        The squared total error is the sum of two squares. The first is the bound `error` +
        `uncertainty` of the error that more samples do not reduce. The second is the Monte Carlo
        error of a longer run. The result is infinite if the bound is not below `target`.
        """
        bias_bound = self.error + self.uncertainty
        # `not <` instead of `>=`: an error of NaN gives infinity, too.
        if not bias_bound < target:
            return np.inf
        return 1 / (target**2 - bias_bound**2) / self.per_second


class Order(NamedTuple):
    """Fitted order of convergence: the exponent of the discretisation error in the step size.

    - `order`: the exponent, NaN if fewer than two step counts have significant errors.
    - `error`: its standard error. It omits the error of the reference, which all points share.
    """

    order: float
    error: float


class WorkPrecision(NamedTuple):
    """Result of `work_precision`.

    - `settings`: tuple of `Setting`. `pandas.DataFrame(result.settings)` converts it to a table.
    - `reference`: "exact", or a description of the reference run.
    - `target`: the required accuracy, or `None`.
    """

    settings: tuple[Setting, ...]
    reference: str
    target: float | None

    def as_dict(self) -> dict[str, np.ndarray]:
        """Return the table as a dictionary with one array per column."""
        columns = zip(*self.settings, strict=True)
        return {
            name: np.array(column) for name, column in zip(Setting._fields, columns, strict=True)
        }

    def cheapest(self, target: float | None = None) -> Setting | None:
        """Return the setting that reaches an accuracy (by default `self.target`) in the least time.

        Return `None` if no setting reaches it, or if the uncertainties are too large to decide.

        **Raises:** `ValueError` if there is no target.
        """
        target = self.target if target is None else target
        if target is None:
            raise ValueError(
                "`cheapest` needs a `target`; got None. Pass an error in standard deviations."
            )
        best = min(self.settings, key=lambda setting: setting.seconds_for(target))
        return best if np.isfinite(best.seconds_for(target)) else None

    def statement(self, target: float | None = None) -> str:
        """Return one sentence with the cheapest setting for an accuracy, or with advice.

        **Raises:** `ValueError` if there is no target.
        """
        target = self.target if target is None else target
        best = self.cheapest(target)
        if target is None or best is None:
            return (
                f"accuracy {target:g}: none of these settings is shown to reach it; use more "
                "steps, or more bridges"
            )
        seconds = best.seconds_for(target)
        return (
            f"accuracy {target:g} costs {seconds:.2g} s here: {best.curve}, {best.num_steps} steps"
        )

    def orders(self) -> dict[str, Order]:
        """Return the fitted order of convergence of each curve, by the curve's name."""
        return {curve: _fit_order(group) for curve, group in self.curves()}

    def curves(self) -> Iterator[tuple[str, list[Setting]]]:
        """Iterate over curves: a name, and the settings that differ in the number of steps only."""
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
    """Fit log error against log step size by weighted least squares, for one curve."""
    # Errors within two standard errors of zero are mostly noise: their logarithms would mislead.
    significant = [s for s in group if s.step_error > 2 * s.step_uncertainty]
    if len({s.num_steps for s in significant}) < 2:
        return Order(np.nan, np.nan)
    x = -np.log([s.num_steps for s in significant])
    y = np.log([s.step_error for s in significant])
    # By the delta method log(error) has the standard error uncertainty / error.
    weight = np.array([(s.step_error / s.step_uncertainty) ** 2 for s in significant])
    centred = x - np.average(x, weights=weight)
    spread = weight @ centred**2
    return Order(float(weight * centred @ y / spread), float(spread**-0.5))
