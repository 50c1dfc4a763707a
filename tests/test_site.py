"""The documentation site has one entry for each public name. `.ci/docs` builds and checks it."""

import ast
import collections
import pathlib
import re

import pytest

import jaxbridge as jb

ROOT = pathlib.Path(__file__).parent.parent
REFERENCE = ROOT / "notebooks" / "reference"
PAGES = {page.name: page.read_text(encoding="utf-8") for page in sorted(REFERENCE.glob("*.md"))}
ENTRIES = collections.Counter(re.findall(r"^::: (\S+)$", "\n".join(PAGES.values()), re.MULTILINE))


def names_of_plot():
    """Return `jaxbridge.plot.__all__` without importing the module, which needs Matplotlib."""
    tree = ast.parse((ROOT / "jaxbridge/plot/__init__.py").read_text(encoding="utf-8"))
    (names,) = (node.value for node in tree.body if isinstance(node, ast.Assign))
    return ast.literal_eval(names)


def test_each_public_name_has_one_entry():
    names = [f"jaxbridge.{name}" for name in jb.__all__]
    names += [f"jaxbridge.plot.{name}" for name in names_of_plot()]
    assert {name: ENTRIES[name] for name in names} == dict.fromkeys(names, 1)


def test_other_entries_are_those_of_verdicts():
    public = re.compile(r"jaxbridge\.(plot\.)?\w+")
    others = {name for name in ENTRIES if not public.fullmatch(name)}
    assert others == {
        f"jaxbridge.engine.verdict.{n}" for n in ("AbstractResult", "Fault", "Verdict")
    }


@pytest.mark.parametrize("folder", ["reference", "howto", "explanation", "."])
def test_each_page_is_in_the_navigation(folder):
    """The build fails for a missing page, too. This test needs no extra."""
    navigation = (ROOT / "notebooks/site/mkdocs.yml").read_text(encoding="utf-8")
    pages = (ROOT / "notebooks" / folder).glob("*.md")
    for page in pages:
        path = page.relative_to(ROOT / "notebooks").as_posix()
        assert re.search(rf"[ -]{re.escape(path)}$", navigation, re.MULTILINE), path


def test_the_lines_before_examples_are_those_of_the_package():
    block = re.compile(r"```python\n.*?```", re.DOTALL)
    assert block.findall(jb.__doc__) == block.findall(PAGES["index.md"])
