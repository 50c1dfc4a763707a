"""Benchmarks: how they are stored and shown. Their speed is for the clock, not for tests."""

import jax
import numpy as np
import pytest
from studies.benchmark import (
    Benchmark,
    Ratio,
    as_files,
    draw_floor,
    in_markdown,
    in_plain_characters,
    load,
)
from studies.crossover import Rate
from studies.first_calls import FirstCall

from jaxbridge.studies.clock import in_turns


def made_up():
    ratio = Ratio("ours", "theirs", 0.2, 0.1, 1.3)
    rates = [
        Rate("double well", t, name, 1e4, 0.5, 0.1, -1.0, 0.01, "")
        for name in ("Coupling(0)", '"auto"')
        for t in (0.05, 1.0)
    ]
    return Benchmark(
        "cpu",
        "x, 2 cores",
        {"jax": "0.10"},
        "2026-01-01",
        [ratio],
        [(2, 10.0, 30.0)],
        rates,
        [FirstCall("ours", 2.5, 0.01, 0.9, 12, 300)],
    )


def test_results_survive_their_file(tmp_path):
    files = as_files(made_up())
    (tmp_path / "a.json").write_text(files["benchmark.json"], encoding="utf-8")
    assert load(tmp_path / "a.json") == made_up()


def test_tables_show_ratios_and_shares():
    text = in_markdown(made_up())
    assert "| ours | theirs | 0.2 s | 2 | 1.3 |" in text and "| 2 | 10 | 30 | 3.0 |" in text
    assert "T = 0.05 | T = 1 |" in text and "|  | auto / best | 1.00 | 1.00 |" in text
    beyond = made_up()._replace(ratios=[Ratio("ours", "theirs", 0.2, np.inf, None)])
    assert "| ours | theirs | 0.2 s | not reached |  |" in in_markdown(beyond)
    assert "0.2 s  not reached" in in_plain_characters(beyond)
    assert "| ours | 2.5 | 0.010 | 0.9 | 12 | 300 |" in text


def test_functions_are_timed_in_turns():
    order = []
    times = in_turns(lambda: order.append(1), lambda: order.append(2), repeats=3)
    assert order == [1, 2] * 4 and all(seconds >= 0 for seconds in times)


@pytest.mark.parametrize("own_noise", [False, True])
def test_the_floor_draws_every_number(own_noise):
    drawn = draw_floor(own_noise, 100)(jax.random.key(0))
    assert sum(np.size(leaf) for leaf in drawn) == 50 * 100 * (3 + own_noise)
