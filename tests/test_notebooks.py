"""All notebooks call functions that there are; some of them run as they stand, in a quick mode."""

import ast
import inspect
import json
import pathlib

import matplotlib.pyplot
import pytest

import jaxbridge as jb

FOLDER = pathlib.Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
# One for bridges, one for exact observations. The pages of `test_readme` have noisy ones.
RUN = ["01_quickstart", "05_pipeline"]


def cells(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]


def chain_of(node):
    """The names of an expression such as `jb.plot.work_precision`, or nothing."""
    names = []
    while isinstance(node, ast.Attribute):
        names, node = [node.attr, *names], node.value
    return [node.id, *names] if isinstance(node, ast.Name) else []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_calls_fit_the_functions(path):
    number = 0
    for node in ast.walk(ast.parse("\n".join(cells(path)))):
        chain = chain_of(node.func) if isinstance(node, ast.Call) else []
        if chain[:1] != ["jb"]:
            continue
        function = jb
        for name in chain[1:]:
            function = getattr(function, name)
        keywords = [keyword.arg for keyword in node.keywords]
        starred = None in keywords or any(isinstance(arg, ast.Starred) for arg in node.args)
        bind = (
            inspect.signature(function).bind_partial
            if starred
            else inspect.signature(function).bind
        )
        bind(*node.args, **{name: None for name in keywords if name is not None})
        number += 1
    assert number > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", RUN)
def test_notebook_runs(name, monkeypatch):
    monkeypatch.setenv("JAXBRIDGE_QUICK", "1")
    matplotlib.use("agg")
    namespace = {}
    for cell in cells(FOLDER / f"{name}.ipynb"):
        exec(cell, namespace)
    matplotlib.pyplot.close("all")
