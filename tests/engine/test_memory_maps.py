"""The warning before a process has no memory maps left."""

import warnings

import jax
import pytest
from helpers import paper_model

import jaxbridge as jb
from jaxbridge.engine import memory_maps


def call():
    jb.sample_bridges(jax.random.key(0), paper_model(), [0.0, 0.0], [0.5, 0.0], 1.0, num_steps=4)


def test_a_process_near_its_limit_is_warned(monkeypatch):
    monkeypatch.setattr(memory_maps, "_most_maps", lambda: 65_530)
    monkeypatch.setattr(memory_maps, "_num_maps", lambda moment: 50_000)
    with pytest.warns(RuntimeWarning, match=r"50,000 of the 65,530.*jax\.clear_caches"):
        call()


@pytest.mark.parametrize("num, most", [(40_000, 65_530), (40_000, 0), (0, 65_530)])
def test_others_are_not(num, most, monkeypatch):
    monkeypatch.setattr(memory_maps, "_most_maps", lambda: most)
    monkeypatch.setattr(memory_maps, "_num_maps", lambda moment: num)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        call()


def test_maps_are_counted_where_the_system_tells():
    memory_maps._num_maps.cache_clear()
    num, most = memory_maps._num_maps(0), memory_maps._most_maps()
    assert (num > 100) == (most > 0)
