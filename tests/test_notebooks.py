"""The notebooks run as they stand, in a quick mode."""

import json
import pathlib

import matplotlib.pyplot
import pytest

NOTEBOOKS = sorted((pathlib.Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, monkeypatch):
    monkeypatch.setenv("JAXBRIDGE_QUICK", "1")
    matplotlib.use("agg")
    namespace = {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), namespace)
    matplotlib.pyplot.close("all")


def test_there_are_notebooks():
    assert NOTEBOOKS
