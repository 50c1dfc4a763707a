"""Runs in parts: the file after each part, its continuation, and joined results."""

import dataclasses
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb

TIMES = 0.5 * np.arange(8.0)
VALUES = np.array([0.1, 0.5, -0.2, 0.3, 0.8, 0.4, -0.1, 0.2])
KEY = jax.random.key(0)


def line(rate=1.0):
    return jb.Diffusion(lambda x, p: -p * x, [0.5], lambda x, p: -4 * p * x @ x, params=rate)


MODEL = line()  # one program for all runs
PRIOR = jb.NormalPrior(1.0, 0.5)
COMMON = dict(prior=PRIOR, num_steps=3, num_iterations=25, num_chains=2)
NOISY = dict(observation=jb.LinearGaussian(covariance=0.01), initial=[0.0], num_warmup=20)
SAMPLERS = {
    "gibbs": (jb.gibbs, {"proposal": jb.ModifiedDiffusionBridge()}),
    "record": (jb.gibbs, NOISY),
    "pmmh": (jb.pmmh, NOISY | {"num_proposals": 4}),
}


def run(name, path=None, model=MODEL, **options):
    sample, own = SAMPLERS[name]
    options = COMMON | own | options | ({} if path is None else {"checkpoint": path})
    return sample(KEY, model, TIMES, VALUES, **options)


class Stopped(Exception):
    pass


def stop_after(monkeypatch, num_parts):
    """End the process, as it were, after the file of this part was written."""
    save = jb.inference.checkpoint._save

    def save_and_stop(path, posterior, num_done):
        save(path, posterior, num_done)
        if num_done == num_parts:
            raise Stopped

    monkeypatch.setattr(jb.inference.checkpoint, "_save", save_and_stop)
    return lambda: monkeypatch.setattr(jb.inference.checkpoint, "_save", save)


def assert_equal(one, other):
    leaves = [jax.tree.leaves(part) for part in (one, other)]
    for a, b in zip(*leaves, strict=True):
        if not callable(a):
            np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_an_interrupted_run_goes_on_to_the_same_draws(tmp_path, monkeypatch, caplog):
    whole = run("pmmh", tmp_path / "whole.npz")
    assert whole.theta.shape == (2, 25, 1)
    go_on = stop_after(monkeypatch, 4)
    with pytest.raises(Stopped):
        run("pmmh", tmp_path / "part.npz")
    go_on()
    with caplog.at_level("INFO", "jaxbridge"):
        resumed = run("pmmh", tmp_path / "part.npz")
        assert "part 4 of 9" in caplog.messages[0] and "part 9 of 9" in caplog.messages[-1]
        (tmp_path / "new.npz").unlink(missing_ok=True)
        run("pmmh", tmp_path / "new.npz")  # whose first part has too few draws for R̂
        (tmp_path / "new.npz").unlink()
    assert_equal(resumed, whole)
    assert_equal(run("pmmh", tmp_path / "part.npz"), whole)  # nothing is left to do
    assert sorted(file.name for file in tmp_path.iterdir()) == ["part.npz", "whole.npz"]
    assert np.any(whole.theta[:, 3:] != whole.theta[:, 2:3])


@pytest.mark.slow
def test_a_file_of_another_run_is_refused(tmp_path):
    run("pmmh", tmp_path / "run.npz")
    with pytest.raises(ValueError, match="does not begin with the draws of this call"):
        run("pmmh", tmp_path / "run.npz", MODEL.with_params(1.5))
    (tmp_path / "text.npz").write_text("no arrays")
    (tmp_path / "empty.npz").write_text("")
    whole = (tmp_path / "run.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    for name in ("text", "empty", "half"):
        with pytest.raises(ValueError, match="is not a file of such a run"):
            run("pmmh", tmp_path / f"{name}.npz")


def test_paths_that_cannot_be_files_are_refused(tmp_path):
    with pytest.raises(TypeError, match="`checkpoint` must be the path of a file"):
        run("record", 3)
    for path in (tmp_path, tmp_path / "none" / "run.npz"):
        with pytest.raises(ValueError, match="must be the path of a file"):
            run("record", path)
    with pytest.raises(ValueError, match="`num_iterations` must be"):
        run("record", tmp_path / "run.npz", num_iterations=0)
    with pytest.raises(ValueError, match="outside `jit`"):
        sample = lambda values: jb.gibbs(
            KEY, line(), TIMES, values, **COMMON, checkpoint=tmp_path / "run.npz"
        )
        jax.jit(sample)(jnp.asarray(VALUES))


@pytest.mark.slow
def test_joined_parts_have_the_errors_of_all_draws():
    first = run("record", num_iterations=3)
    later = run("record", **{"num_iterations": 3, **first.continuation})
    both = first.joined(later)
    assert both.theta.shape == (2, 6, 1) and both.params.shape == (2, 6)
    np.testing.assert_array_equal(both.theta[:, 3:], later.theta)
    np.testing.assert_array_equal(both.state.theta, later.state.theta)
    with pytest.raises(TypeError, match="must be a RecordPosterior"):
        first.joined(run("pmmh", num_iterations=3))
    with pytest.raises(ValueError, match="as this part"):
        first.joined(dataclasses.replace(later, theta=later.theta[:1]))


@pytest.mark.slow
def test_the_file_stays_whole_if_the_process_ends_while_it_is_written(tmp_path, monkeypatch):
    replace, calls = os.replace, []

    def replace_twice(source, target):
        if len(calls) == 2:
            raise Stopped
        calls.append(target)
        replace(source, target)

    path = tmp_path / "run.npz"
    monkeypatch.setattr(os, "replace", replace_twice)
    with pytest.raises(Stopped):
        run("record", path)
    monkeypatch.undo()
    assert [file.name for file in tmp_path.iterdir()] == ["run.npz"]
    with np.load(path) as file:
        assert file["num_done"] == 2
    assert_equal(run("record", path), run("record", tmp_path / "whole.npz"))
