"""What the installed compiler accepts, and what it is known to compute wrongly."""

import pathlib
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import run_program

from jaxbridge.engine import compiler
from jaxbridge.engine.compiled import compiled

double = compiled(lambda x: 2 * x)


@pytest.mark.parametrize("name, is_known", [("xla_dump_to", True), ("xla_of_no_release", False)])
def test_only_known_options_are_asked_for(name, is_known, monkeypatch):
    monkeypatch.setattr(compiler, "_SOONER", {name: ""})
    wanted = compiler.cpu_options.__wrapped__(sooner=True)
    assert (name in wanted) == is_known


def test_users_are_warned_where_their_loops_are_wrong(monkeypatch):
    """The warning names the programs, the flag, and a page that has the flag, too."""
    monkeypatch.setattr(compiler, "has_loop_fault", lambda: True)
    flag = "disable_hlo_passes=small-while-loop-hoisting"
    with pytest.warns(RuntimeWarning, match=f"XLA_FLAGS=--xla_{flag}") as caught:
        double(jnp.ones(3))
    text = str(caught[0].message)
    assert all(name in text for name in ("jax.jit", "jax.vmap", "lax.scan", "NumPyro"))
    page = pathlib.Path(__file__).parents[2] / "notebooks/howto/debugging.md"
    assert "howto/debugging.md" in text and flag in page.read_text("utf-8")


def test_where_nothing_is_wrong_nobody_is_warned(monkeypatch):
    monkeypatch.setattr(compiler, "has_loop_fault", lambda: False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        double(jnp.ones(3))


def test_small_loops_are_compiled_correctly():
    """In a process of its own, with the compiler as users have it: the loop that releases from
    0.11.1 on compile wrongly is right in programs of ours, and users hear, once, of theirs."""
    run_program(
        """
        import warnings
        import jax, jax.numpy as jnp, numpy as np
        from jaxbridge.engine import compiler
        from jaxbridge.engine.compiled import compiled, compiled_sooner

        with warnings.catch_warnings(record=True) as caught:
            for compile in (compiled, compiled_sooner):
                slope = compile(lambda x: compiler.slope_of_normalised_twice(x))
                for _ in range(2):
                    result = slope(jnp.asarray(compiler.POINT))
                np.testing.assert_allclose(result, compiler.EXACT_SLOPE, atol=1e-5)
        result = jax.jit(compiler.slope_of_normalised_twice)(compiler.POINT)
        is_wrong = not np.allclose(result, compiler.EXACT_SLOPE, atol=1e-3)
        messages = [each for each in caught if "XLA_FLAGS" in str(each.message)]
        assert len(messages) == is_wrong == compiler.has_loop_fault()
        assert is_wrong == (jax.__version_info__ >= (0, 11, 1)), "has a release mended it?"
        """
    )


def test_reductions_are_compiled_correctly(x64):
    """JAX 0.10.2 leaves all but the first 32,768 of these numbers uncomputed: no version that
    `pyproject.toml` allows may."""
    matrix, points = (
        np.random.default_rng(i).normal(size=(n, 3)) for i, n in enumerate((3, 40_000))
    )
    values = jax.jit(jax.vmap(lambda x: jnp.sum((matrix @ x) ** 2)))(points)
    np.testing.assert_allclose(values, np.sum((points @ matrix.T) ** 2, axis=1), rtol=1e-9)
