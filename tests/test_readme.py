"""The README and the pages beside the notebooks: their code runs as it stands, their tables are
those of the stored run, and their links lead somewhere."""

import inspect
import pathlib
import re

import jax.numpy as jnp
import pytest
from studies.benchmark import in_markdown, load

import jaxbridge as jb

ROOT = pathlib.Path(__file__).parent.parent
README, CONTRIBUTING = ROOT / "README.md", ROOT / "CONTRIBUTING.md"
PAGES = [README, *sorted((ROOT / "notebooks").glob("*.md")), CONTRIBUTING]
TEXT = {page: page.read_text(encoding="utf-8") for page in PAGES}
BLOCKS = re.findall(r"```python\n(.*?)```", "".join(TEXT.values()), re.DOTALL)


@pytest.mark.slow
def test_code_runs():
    """The quickstart, and the blocks of the pages, which go on from those of the README."""
    assert len(BLOCKS) == 19
    namespace = {}
    for block in BLOCKS[:4]:
        exec(block, namespace)
    assert namespace["paths"].mean().shape == (291, 2)
    assert bool(namespace["bridges"].met.all()) and bool(namespace["many"].met.all())
    assert namespace["closer"].paths.shape == (1000, 51, 2)
    for block in BLOCKS[4:]:
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
    assert namespace["noisy_posterior"].theta.shape == (300, 3)
    assert 2 < namespace["driven"].theta.mean() < 7
    assert jnp.isfinite(namespace["value"]) and set(namespace["slope"][0]) == {
        "log_noise", "log_rate", "log_sigma"
    }  # fmt: skip
    assert (namespace["densities"].standard_error < 0.5).mean() > 0.95


def test_readme_is_short_and_names_the_two_commands():
    assert len(TEXT[README].splitlines()) <= 250
    assert 'pip install ".[plot]" && python -m jaxbridge' in TEXT[README]
    assert 'pip install ".[test]" && pytest' in TEXT[README]


def test_tables_are_those_of_the_stored_run():
    stored = in_markdown(load(ROOT / "notebooks" / "benchmark.json"))
    for table in stored.split("\n\n"):
        assert table in TEXT[ROOT / "notebooks" / "costs.md"]
    rows = re.findall(r"\| process \|.*?\n\n", TEXT[README], re.DOTALL)[0].strip().splitlines()
    assert len(rows) == 10 and "\n".join(rows[:2]) in stored and "\n".join(rows[2:]) in stored


def anchors(page):
    """The headings of a page as links name them."""
    titles = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", TEXT[page], flags=re.DOTALL), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\((?!https?:)([^)]*)\)", TEXT[page]):
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_names_by_which_to_choose_exist():
    """Public names, their arguments, and what results have: all that the page has as code."""
    known = set(jb.__all__)
    for symbol in (getattr(jb, name) for name in jb.__all__):
        known |= {*inspect.signature(symbol).parameters, *dir(symbol)}
        known |= set(getattr(symbol, "__dataclass_fields__", ()))
    text = re.sub(r"```.*?```", "", TEXT[ROOT / "notebooks" / "how_to_choose.md"], flags=re.DOTALL)
    named = {
        word
        for code in re.findall(r"`([^`]+)`", text)
        for word in re.findall(r"[a-z]\w+", code, re.I)
    }
    assert len(named) > 30 and named <= known
