"""What is done before a process has no memory maps left."""

import warnings

import jax
import jax.numpy as jnp
import pytest
from helpers import paper_model, run_program

import jaxbridge as jb
from jaxbridge.engine import memory_maps
from jaxbridge.engine.compiled import compiled

double = compiled(lambda x: 2 * x)


def call():
    jb.sample_bridges(jax.random.key(0), paper_model(), [0.0, 0.0], [0.5, 0.0], 1.0, num_steps=4)


def pretend(monkeypatch, num, most):
    monkeypatch.setattr(memory_maps, "_most_maps", lambda: most)
    monkeypatch.setattr(memory_maps, "_num_maps", lambda moment: num)


def test_a_process_near_its_limit_is_warned(monkeypatch):
    pretend(monkeypatch, 50_000, 65_530)
    with pytest.warns(RuntimeWarning, match=r"50,000 of the 65,530.*jax\.clear_caches"):
        call()


@pytest.mark.parametrize("num, most", [(40_000, 65_530), (40_000, 0), (0, 65_530)])
def test_others_are_not(num, most, monkeypatch):
    pretend(monkeypatch, num, most)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        call()


def test_a_process_that_fills_the_memory_is_warned_once(monkeypatch):
    monkeypatch.setattr(memory_maps, "_memory", lambda moment: (13 * 2**30, 16 * 2**30))
    monkeypatch.setattr(memory_maps, "_warned", [])
    with pytest.warns(RuntimeWarning, match=r"13\.0 of the 16\.0 GiB.*lambda.*clear_caches"):
        double(jnp.ones(3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        double(jnp.ones(3))


def test_memory_is_read_where_the_system_tells():
    memory_maps._memory.cache_clear()
    resident, total = memory_maps._memory(0)
    assert 0 < resident < total or resident == total == 0


def test_maps_are_counted_where_the_system_tells():
    memory_maps._num_maps.cache_clear()
    num, most = memory_maps._num_maps(0), memory_maps._most_maps()
    assert (num > 100) == (most > 0)


@pytest.mark.parametrize("traced", [False, True])
def test_programs_are_dropped_before_the_process_ends(traced, monkeypatch):
    """But not in the midst of tracing."""
    dropped = []
    monkeypatch.setattr(jax, "clear_caches", lambda: dropped.append(True))
    pretend(monkeypatch, 60_000, 65_530)
    monkeypatch.setattr(memory_maps._num_maps, "cache_clear", lambda: None, raising=False)
    double = compiled(lambda x: 2 * x)  # a new one, which is compiled here
    said = "will be dropped" if traced else "were dropped"
    with pytest.warns(RuntimeWarning, match=said):
        (jax.jit(double) if traced else double)(jnp.ones(3))
    assert bool(dropped) != traced


@pytest.mark.slow
def test_many_models_survive_in_one_process():
    """As many as it takes to reach a limit, here a lower one, twice."""
    run_program(
        """
        import warnings
        import jax, jax.numpy as jnp
        import jaxbridge as jb
        from jaxbridge.engine import memory_maps

        limit = memory_maps.count_maps() + 1_000
        memory_maps._most_maps = lambda: limit
        warnings.simplefilter("always")
        most = num_dropped = 0
        with warnings.catch_warnings(record=True) as said:
            for i in range(100):
                model = jb.langevin(lambda x, p: -(x @ x) - 0.1 * i * jnp.sum(x**4))
                arguments = jax.random.key(i), model, [0.0], [0.3], 1.0
                jb.sample_bridges(*arguments, num_bridges=4, num_steps=4)
                for proposal in (jb.ModifiedDiffusionBridge(), jb.Guided()):
                    options = dict(num_bridges=4, num_steps=4, proposal=proposal)
                    jb.sample_weighted_bridges(*arguments, **options)
                most = max(most, memory_maps.count_maps())
                num_dropped = sum("were dropped" in str(each.message) for each in said)
                if num_dropped == 2:
                    break
        assert num_dropped == 2 and most < limit, (num_dropped, most, limit)
        """,
        in_haste=True,
    )
