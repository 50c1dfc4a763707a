"""All notebooks call functions that there are; some of them run as they stand, in a quick mode."""

import json
import pathlib

import matplotlib.pyplot
import pytest
from helpers import assert_calls_fit

FOLDER = pathlib.Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
# The calls of all others are only compared with signatures.
RUN = ["01_quickstart"]


def cells(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_calls_fit_the_functions(path):
    assert_calls_fit("\n".join(cells(path)))


@pytest.mark.slow
@pytest.mark.parametrize("name", RUN)
def test_notebook_runs(name, monkeypatch):
    monkeypatch.setenv("JAXBRIDGE_QUICK", "1")
    matplotlib.use("agg")
    namespace = {}
    for cell in cells(FOLDER / f"{name}.ipynb"):
        exec(cell, namespace)
    matplotlib.pyplot.close("all")
