"""The files that tools read: one version everywhere, and histories that grow."""

import pathlib
import re
import tomllib

import jaxbridge as jb
from jaxbridge.studies.command import Command
from jaxbridge.studies.report import Study

ROOT = pathlib.Path(__file__).parents[1]


def test_there_is_one_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    citation = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    changelog = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert citation and citation[1] == version
    assert changelog and changelog[1] == version
    assert re.fullmatch(r"\d+\.\d+\.\d+", jb.__version__)


def test_each_run_adds_a_line_to_a_history(tmp_path, capsys):
    study = Study(
        "Nothing",
        lambda key, quick, say: 1,
        str,
        "Nothing to see.",
        lambda figures, results: {},
        lambda results: {"all.json": "1\n", "history.jsonl": "1\n"},
    )
    command = Command(
        "nothing", "", {"it": (study,)}, {}, "it", "math", False, "Read next: nothing."
    )
    for _ in range(2):
        command.run(["--out", str(tmp_path)])
    assert (tmp_path / "all.json").read_text() == "1\n"
    assert (tmp_path / "history.jsonl").read_text() == "1\n1\n"
    said = capsys.readouterr().out
    assert "all.json, history.jsonl" in said and said.rstrip().endswith("Read next: nothing.")
