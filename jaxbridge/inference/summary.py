"""A table of a posterior: means, quantiles, errors, diagnostics and the verdict."""

import html
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_COLUMNS = ("mean", "sd", "2.5 %", "median", "97.5 %", "MC error", "step error", "R̂", "eff. draws")


class PosteriorSummary(NamedTuple):
    """Result of `summary` of a posterior: one row for each unknown parameter. It prints as text.

    In a notebook it is shown as a table. Arrays have shape (p,).

    - `title`: numbers of chains and draws.
    - `names`: names of the parameters.
    - `mean`, `sd`, `low`, `median`, `high`: posterior means, standard deviations, and quantiles at
        2.5, 50 and 97.5 %.
    - `standard_error`: Monte Carlo error of the mean.
    - `step_error`: estimated discretisation error of the mean.
    - `r_hat`, `effective_sample_size`: R̂ and the effective number of draws.
    - `verdict`: the result of `why()`.
    """

    title: str
    names: tuple[str, ...]
    mean: Float[np.ndarray, " p"]
    sd: Float[np.ndarray, " p"]
    low: Float[np.ndarray, " p"]
    median: Float[np.ndarray, " p"]
    high: Float[np.ndarray, " p"]
    standard_error: Float[np.ndarray, " p"]
    step_error: Float[np.ndarray, " p"]
    r_hat: Float[np.ndarray, " p"]
    effective_sample_size: Float[np.ndarray, " p"]
    verdict: str

    def _rows(self) -> list[list[str]]:
        """Return the cells of the table, without the names."""
        numbers = (
            *(self.mean, self.sd, self.low, self.median, self.high),
            *(self.standard_error, self.step_error),
        )
        rows = []
        for i in range(len(self.names)):
            cells = [f"{column[i]:.3g}" for column in numbers]
            rows.append([*cells, f"{self.r_hat[i]:.3f}", f"{self.effective_sample_size[i]:,.0f}"])
        return rows

    def __str__(self) -> str:
        """Return the table as text."""
        named = zip(self.names, self._rows(), strict=True)
        table = [["", *_COLUMNS], *([name, *row] for name, row in named)]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        lines = [
            "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])])
            for row in table
        ]
        return "\n".join([self.title, *lines, self.verdict])

    def _repr_html_(self) -> str:
        """Return the table as HTML, which notebooks show."""
        head = "".join(f"<th>{column}</th>" for column in ("", *_COLUMNS))
        body = "".join(
            f"<tr><th>{html.escape(name)}</th>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>"
            for name, row in zip(self.names, self._rows(), strict=True)
        )
        title, verdict = html.escape(self.title), html.escape(self.verdict)
        return f"<p>{title}</p><table><tr>{head}</tr>{body}</table><p>{verdict}</p>"
