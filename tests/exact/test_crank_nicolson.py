"""Chains that move the noise of a path: the exact law, step by step or in one call."""

import functools

import blackjax.util
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import paper_model

import jaxbridge as jb

# Well to well: proposals from scratch are seldom accepted.
WELLS = jb.langevin(lambda x, p: -p * ((x[0] ** 2 - 1) ** 2 + x[1] ** 2), 1.7)
HARD = (WELLS, [-1.0, 0.0], [1.0, 0.0], 2.0)


def batch_means(values, num_batches=40):
    batches = np.asarray(values, float)
    batches = batches[: len(batches) // num_batches * num_batches].reshape(num_batches, -1).mean(1)
    return batches.mean(), batches.std(ddof=1) / np.sqrt(num_batches)


@pytest.mark.slow
def test_chain_has_the_law_that_weights_give():
    """Mean and variance at a third of the time, and the share of paths that have crossed."""
    third = lambda path: path[20, 0]
    functions = [
        third,
        lambda path: path[20, 0] ** 2,
        lambda path: jnp.where(path[30, 0] > 0, 1.0, 0.0),
    ]
    weighted = jb.sample_weighted_bridges(
        jax.random.key(0), *HARD, num_bridges=40_000, num_steps=60, proposal=jb.Guided()
    )
    chain = jb.sample_exact_bridges(
        jax.random.key(1), *HARD, num_bridges=10_000, num_steps=60,
        proposal=jb.Guided(), method="crank_nicolson", step_size=0.7,
    )  # fmt: skip
    assert chain.met.all() and 0.1 < chain.acceptance_rate < 0.9
    for fn in functions:
        exact, exact_error = float(weighted.mean(fn)), float(weighted.standard_error(fn))
        mean, error = batch_means(jax.vmap(fn)(chain.paths)[1000:])
        assert np.hypot(error, exact_error) < 0.07
        assert abs(mean - exact) < 5 * np.hypot(error, exact_error)


@pytest.mark.slow
def test_chain_has_the_law_of_the_closed_form():
    """An Ornstein–Uhlenbeck bridge from Brownian bridges whose weights vary."""
    model, ends = paper_model(), ([0.785, 0.785], [1.091, 1.091])
    chain = jb.sample_exact_bridges(
        jax.random.key(0), model, *ends, 1.0, num_bridges=20_000, num_steps=40, step_size=0.6,
        proposal=jb.ModifiedDiffusionBridge(jb.ItoTaylorDensity()), method="crank_nicolson",
        save_at=[0.5],
    )  # fmt: skip
    law = jb.gaussian_bridge(model, *ends, 1.0, [0.5])
    sd = np.sqrt(np.diag(law.covariance[0]))
    deviations = (np.asarray(chain.paths[500:, 0]) - np.asarray(law.mean[0])) / sd
    for moment, exact in [(deviations, 0.0), (deviations**2, 1.0)]:
        for values in moment.T:
            mean, error = batch_means(values)
            assert error < 0.1
            assert abs(mean - exact) < 5 * error + 0.01  # the allowance is for the step


@pytest.mark.slow
def test_chain_is_that_of_the_kernel_and_runs_in_blackjax():
    arguments, options = (paper_model(), [0.3, 0.1], [-0.2, 0.4], 1.0), dict(num_steps=8)
    run_key, init_key = jax.random.split(jax.random.key(0))
    kernel = jb.crank_nicolson(*arguments, **options, step_size=0.3, proposal=jb.Guided())
    state, positions = kernel.init(None, init_key), []
    for key in jax.random.split(run_key, 20):
        state, info = kernel.step(key, state)
        positions.append(state.position)
    chain = jb.sample_exact_bridges(
        jax.random.key(0), *arguments, **options, num_bridges=20, proposal=jb.Guided(),
        method="crank_nicolson", step_size=0.3,
    )  # fmt: skip
    np.testing.assert_allclose(chain.paths, jnp.stack(positions), atol=1e-5)
    assert float(chain.log_weights[-1]) == pytest.approx(float(state.log_weight), abs=1e-4)
    assert info.acceptance_rate.shape == ()
    _, (states, _) = blackjax.util.run_inference_algorithm(
        jax.random.key(0),
        kernel,
        num_steps=20,
        initial_state=kernel.init(None, init_key),
        transform=lambda state, info: (state, info),
    )
    assert states.position.shape == (20, 9, 2)


@pytest.mark.slow
def test_fast_rotation(x64):
    """Paths of a linear process are linear in the noise, and all moves are accepted: the mid-point
    is autoregressive, of which the effective sample size is known. Mean and second moments are
    those of the closed form, up to the step error that is told."""
    decay, speed, duration, num_steps = 1.0, 6.2832, 5.0, 100
    model = jb.ornstein_uhlenbeck([[decay, speed], [-speed, decay]])
    ends, size, beta = (jnp.array([0.5, 0.2]), jnp.array([-0.4, 0.6])), 8_000, 0.9
    exact = jb.gaussian_bridge(model, *ends, float(duration), [duration / 2])
    mean, variance = exact.mean[0], jnp.diag(exact.covariance[0])
    chain = jb.sample_exact_bridges(
        jax.random.key(0), model, *ends, float(duration), num_bridges=size, num_steps=num_steps,
        proposal=jb.Guided(density=jb.ItoTaylorDensity()), method="crank_nicolson",
        step_size=beta,
    )  # fmt: skip
    assert chain.acceptance_rate > 0.999
    functions = {
        1: lambda path: path[num_steps // 2] - mean,
        2: lambda path: (path[num_steps // 2] - mean) ** 2 - variance,
    }
    for power, fn in functions.items():
        rho = (1 - beta**2) ** (power / 2)
        sd = jnp.sqrt(variance) if power == 1 else jnp.sqrt(2) * variance
        error = sd / np.sqrt(size * (1 - rho) / (1 + rho))
        told, doubt = chain.step_error(fn), chain.step_uncertainty(fn)
        assert np.all(np.abs(chain.mean(fn) - told) < 5 * np.hypot(error, doubt))
        assert np.all(np.abs(told) < 0.1 * sd + 5 * doubt)


@pytest.mark.slow
def test_a_path_that_enters_is_the_state():
    """`init` finds the noise of a path, so a step of size β moves it by no more than that."""
    weighted = jb.sample_weighted_bridges(
        jax.random.key(0), *HARD, num_bridges=1, num_steps=30, proposal=jb.ModifiedDiffusionBridge()
    )
    kernel = jb.crank_nicolson(*HARD, num_steps=30, step_size=1e-4, proposal=jb.Guided())
    state = kernel.init(weighted.paths[0], jax.random.key(1))
    np.testing.assert_array_equal(state.position, weighted.paths[0])
    moved, info = kernel.step(jax.random.key(2), state)
    assert info.acceptance_rate > 0.9
    np.testing.assert_allclose(moved.position, state.position, atol=5e-3)


@pytest.mark.slow
def test_several_intervals_have_chains_of_their_own():
    starts, ends = jnp.array([[0.3, 0.1], [0.5, 0.0]]), jnp.array([[-0.2, 0.4], [0.0, 0.0]])
    model, durations = paper_model(), jnp.array([0.5, 1.0])
    run = functools.partial(
        jb.sample_exact_bridges, num_bridges=300, num_steps=10, proposal=jb.Guided(),
        method="crank_nicolson", step_size=1.0,
    )  # fmt: skip
    chains = run(jax.random.key(0), model, starts, ends, durations, save_at=[0.0, 0.5])
    assert chains.paths.shape == (2, 300, 2, 2) and chains.times.shape == (2, 2)
    alone = run(jax.random.fold_in(jax.random.key(0), 1), model, starts[1], ends[1], durations[1])
    np.testing.assert_allclose(chains.paths[1, :, 1], alone.paths[:, 5], atol=1e-5)
    # Weights of a linear process are equal, so every move is accepted.
    assert (chains.acceptance_rate > 0.99).all()
