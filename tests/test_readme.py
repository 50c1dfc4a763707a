"""The code in the README runs as it stands."""

import pathlib
import re

import pytest

from jaxbridge.studies.benchmark import load, markdown

ROOT = pathlib.Path(__file__).parent.parent
README = ROOT / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


def test_quickstart_runs():
    namespace = {}
    for block in BLOCKS[:3]:
        exec(block, namespace)
    assert bool(namespace["bridges"].met.all()) and bool(namespace["many"].met.all())
    assert namespace["closer"].paths.shape == (1000, 51, 2)


@pytest.mark.slow
def test_readme_code_runs():
    assert len(BLOCKS) == 13
    namespace = {}
    for block in BLOCKS:
        exec(block, namespace)
    assert namespace["bridges"].paths.shape == (1000, 101, 2)
    assert bool(namespace["bridges"].met.all())
    assert namespace["many"].paths.shape == (500, 4, 51, 2)
    assert bool(namespace["many"].met.all())
    assert bool(namespace["spread"].met.all())
    assert namespace["exact"].mean.shape == (2, 2)
    assert namespace["weighted"].effective_sample_size > 100
    assert namespace["chain"].paths.shape == (1000, 101, 2)
    assert namespace["density"].standard_error < 0.2
    assert namespace["short"].acceptance_rate > 0.95
    assert namespace["costs"].cheapest() is not None
    assert 0.2 < namespace["posterior"].params.mean() < 2
    assert namespace["sensitivity"] < 0
    assert namespace["positive"].paths.shape == (1000, 51, 1)
    assert bool((namespace["positive"].paths > 0).all())
    assert namespace["densities"].value.shape == (500,)
    assert (namespace["densities"].standard_error < 0.5).mean() > 0.95


def test_readme_names_the_two_commands():
    text = README.read_text(encoding="utf-8")
    assert 'pip install ".[plot]" && python -m jaxbridge' in text
    assert 'pip install ".[test]" && pytest' in text


def test_tables_are_those_of_the_stored_run():
    table = markdown(load(ROOT / "notebooks" / "benchmark.json"))
    assert table in README.read_text(encoding="utf-8")
