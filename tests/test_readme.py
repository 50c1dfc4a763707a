"""README and the pages beside the notebooks: their code runs, each page as a program of its own;
their tables are those of the stored run; and their links lead somewhere."""

import inspect
import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_calls_fit, slow_beyond, zeros_of
from studies.benchmark import in_markdown, load

import jaxbridge as jb

ROOT = pathlib.Path(__file__).parent.parent
NOTEBOOKS = ROOT / "notebooks"
README, CONTRIBUTING = ROOT / "README.md", ROOT / "CONTRIBUTING.md"
FOLDERS = [NOTEBOOKS, NOTEBOOKS / "howto", NOTEBOOKS / "explanation"]
PAGES = [
    README,
    *(page for folder in FOLDERS for page in sorted(folder.glob("*.md"))),
    CONTRIBUTING,
]
TEXT = {page: page.read_text(encoding="utf-8") for page in PAGES}
# Blocks of other languages, and those marked as `py`, do not run.
CODE = {page: re.findall(r"```python\n(.*?)```", text, re.DOTALL) for page, text in TEXT.items()}


def covers(values, truth):
    """Whether the draws of an unknown parameter are near its true value."""
    return bool(np.abs(np.mean(values) - truth) < 4 * np.std(values))


# These run for minutes: only their calls are checked.
LONG = {
    "circles",
    "counts_and_outliers",
    "doses",
    "model_checking",
    "random_effects",
    "rare_transitions",
    "unknown_sigma",
}

# What must hold after the code of a page, a condition on its variables.
CLAIMS = {
    "README": lambda page: (
        0.2 < page["rate"].mean() < 2.5
        and page["bridges"].paths.shape == (1000, 101, 2)
        and bool(page["bridges"].met.all())
        and bool(page["density"].trustworthy)
    ),
    "how_to_choose": lambda page: len(str(page["table"]).splitlines()) > 5,
    "boundaries": lambda page: (
        bool((page["bridges"].paths > 0).all()) and bool(page["density"].standard_error < 0.1)
    ),
    "bridges": lambda page: (
        bool(page["bridges"].met.all())
        and page["weighted"].effective_sample_size > 100
        and page["chain"].paths.shape == (1000, 101, 2)
        and page["short"].acceptance_rate > 0.95
    ),
    "exits": lambda page: (
        abs(page["exits"].log_probability + 8.96) < 5 * page["exits"].standard_error
        and abs(page["mean"] - 0.4829) < 5 * page["standard_error"]
        and abs(page["first"].mean() - 0.7009) < 5 * page["error"]
        and abs(page["reached"].log_probability + 9.742) < 5 * page["reached"].standard_error
        and abs(page["high"].log_probability + 16.104) < 5 * page["high"].standard_error
        and np.allclose(
            page["safe_until"].mean(axis=0)[np.array([10, 50, 200])],
            [0.7058, 0.3425, 0.0390],
            atol=5 * 0.0079,
        )
    ),
    "debugging": lambda page: not page["density"].trustworthy,
    "densities": lambda page: (
        page["densities"].value.shape == (100,)
        and (page["densities"].standard_error < 0.5).mean() > 0.95
        and page["density"].standard_error < 0.2
        and abs(page["better"].value - page["fine"].value) < 0.5
    ),
    "forecasts": lambda page: (
        page["made"].trustworthy
        and page["inside"] > 0.5
        and page["made"].p_uniform[0] > 0.001
        and page["without"].p_independent[0] < 0.01
    ),
    "gpu": lambda page: page["bridges"].paths.shape == (20_000, 3, 2),
    "hypoelliptic": lambda page: 2 < page["posterior"].theta.mean() < 7,
    "missing_data": lambda page: page["inside"] > 0.75,
    "models": lambda page: (
        page["paths"].shape == (8, 101, 1) and page["exact"].mean.shape == (2, 2)
    ),
    "noisy_data": lambda page: (
        page["posterior"].theta.shape == (500, 3)
        and covers(page["posterior"].params["log_noise"], -1)
        and bool(page["paths"].trustworthy)
    ),
    "nuts": lambda page: (
        covers(np.log(page["draws"]["sigma_1"]), np.log(0.7))
        and covers(page["logs"]["sigma"], 0)
        and page["smoothed"].shape == (1200, 39, 1)
    ),
    "pandas_and_dates": lambda page: (
        list(page["times"]) == [0, 1, 3, 4, 8, 9] and str(page["grid"][-1])[:10] == "2024-03-10"
    ),
    "panels": lambda page: (
        covers(page["posterior"].params["log_noise"], -1)
        and page["curves"][0].mean().shape == (71, 1)
    ),
    "progress": lambda page: bool(page["bridges"].met.all()),
    "saving": lambda page: (
        covers(page["posterior"].params, 0.8)
        and page["both"].theta.shape == (600, 1)
        and page["again"].sizes == {"draw": 600, "parameter": 1}
    ),
    "several_devices": lambda page: bool(page["bridges"].met.all()),
    "several_records": lambda page: max(page["values_at"], key=page["values_at"].get) == 0.0,
    "speed": lambda page: page["costs"].cheapest() is not None,
    "trust": lambda page: page["density"].trustworthy.tolist() == [True, False],
    "write_a_proposal": lambda page: all(
        abs(density.value + 4.126) < 5 * density.standard_error < 0.5
        for density in page["densities"].values()
    ),
}


WITH_CODE = [page for page, blocks in CODE.items() if blocks]


@pytest.mark.parametrize("page", WITH_CODE, ids=lambda page: page.stem)
def test_calls_fit_the_functions(page):
    assert_calls_fit("\n".join(CODE[page]))


@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.usefixtures("unchecked")  # annotations, as for users
@pytest.mark.parametrize(
    "page", [page for page in WITH_CODE if page.stem not in LONG], ids=lambda page: page.stem
)
def test_code_runs(page):
    """The blocks of a page, in order, in a namespace of their own."""
    variables = {}
    with jax.numpy_dtype_promotion("standard"):  # BlackJAX mixes dtypes
        for block in CODE[page]:
            exec(compile(block, page.name, "exec"), variables)
    assert CLAIMS[page.stem](variables)


def traced(function):
    """Return a function that returns zeros for the numbers of `function`, which is not run."""
    return lambda *args, **options: zeros_of(lambda: function(*args, **options))


# Of each block of README: a condition on its variables, whatever the numbers.
SHAPES = [
    lambda page: page["paths"].paths.shape[-1] == 1 and page["rate"].shape == (1000,),
    lambda page: page["bridges"].paths.shape == (1000, 101, 2),
]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("block", slow_beyond(1, range(len(SHAPES))))
def test_calls_of_the_readme_are_accepted(block, monkeypatch):
    """Its computations are traced; the slow tests run them."""
    for name in ("simulate", "smooth", "gibbs", "sample_bridges", "transition_log_density"):
        assert f"jb.{name}(" in TEXT[README]
        monkeypatch.setattr(jb, name, traced(getattr(jb, name)))
    page = {"jax": jax, "jnp": jnp, "jb": jb}
    exec(compile(CODE[README][block], README.name, "exec"), page)
    assert SHAPES[block](page)


def test_every_task_has_code():
    assert len(SHAPES) == len(CODE[README])
    assert {page.stem for page, blocks in CODE.items() if blocks} == set(CLAIMS) | LONG
    tasks = [page for page in PAGES if page.parent.name == "howto" and page.stem != "index"]
    assert len(tasks) >= 23 and all(CODE[page] for page in tasks)


def test_readme_is_short_and_names_the_two_commands():
    assert len(TEXT[README].splitlines()) <= 250
    assert 'pip install ".[plot]" && python -m jaxbridge' in TEXT[README]
    assert 'pip install ".[test]" && pytest' in TEXT[README]


def test_tables_are_those_of_the_stored_run():
    stored = in_markdown(load(NOTEBOOKS / "benchmark.json"))
    for table in stored.split("\n\n"):
        assert table in TEXT[NOTEBOOKS / "costs.md"]


def anchors(page):
    """The headings of a page as links name them."""
    titles = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", TEXT[page], flags=re.DOTALL), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\((?!https?:)([^)\s]*)\)", TEXT[page]):
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_names_by_which_to_choose_exist():
    """Public names, their arguments, and the fields of results: all code on the page."""
    known = set(jb.__all__)
    for symbol in (getattr(jb, name) for name in jb.__all__):
        known |= {*inspect.signature(symbol).parameters, *dir(symbol)}
        known |= set(getattr(symbol, "__dataclass_fields__", ()))
    text = re.sub(r"```.*?```", "", TEXT[NOTEBOOKS / "how_to_choose.md"], flags=re.DOTALL)
    named = {
        word
        for code in re.findall(r"`([^`]+)`", text)
        for word in re.findall(r"[a-z]\w+", code, re.I)
    }
    assert len(named) > 30 and named <= known
