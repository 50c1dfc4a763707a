"""Chains have the exact law, batched or step by step, and run in BlackJAX."""

import functools
import re
import sys

import blackjax.util
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    PAPER_CASES,
    assert_chain_moments,
    exact_cases,
    paper_model,
)

import jaxbridge as jb
from jaxbridge.models.bridge_problem import Intervals
from jaxbridge.proposals.auto import Budget, as_proposal

CASES = exact_cases()
slow = pytest.mark.slow
FITTED = jb.GaussianLaw([0.4, 0.3], [[0.5, -0.3], [-0.3, 0.5]])


@slow
@pytest.mark.parametrize(
    "method, name",
    [
        ("pseudo_marginal", "unlikely, gamma 0.5"),
        ("renewal", "very unlikely, fitted law"),
    ],
)
@pytest.mark.optimised
def test_chain_midpoints_have_the_exact_law(method, name):
    case = CASES[name]()
    chain = jb.sample_exact_bridges(
        jax.random.key(3),
        case.model,
        case.start,
        case.end,
        case.duration,
        num_bridges=15_000,
        num_steps=case.num_steps,
        proposal=case.coupling,
        method=method,
    )
    assert chain.met.all() and (chain.truncated is None or not chain.truncated.any())
    assert 0.02 < chain.acceptance_rate < 0.95
    assert_chain_moments(case.middle(chain.paths), case.mean, case.covariance)
    moved = np.any(np.diff(np.asarray(chain.paths[:, case.num_steps // 2]), axis=0) != 0, axis=1)
    np.testing.assert_array_equal(moved, chain.accepted[1:])


def run_kernel(kernel, key, num_bridges):
    run_key, init_key = jax.random.split(key)
    state = kernel.init(None, init_key)
    step = lambda state, key: (lambda new: (new[0], new))(kernel.step(key, state))
    return jax.lax.scan(step, state, jax.random.split(run_key, num_bridges))[1]


ARGUMENTS = (paper_model(), [0.785, 0.785], [1.091, 1.091], 1.0)


@pytest.mark.slow
def test_batched_chain_is_the_kernel_stepped():
    """Where the renewal chain runs in several segments."""
    key, num_bridges = jax.random.key(5), 300
    options = dict(num_steps=20, proposal=jb.Coupling(0.5, start_law=FITTED))
    kernel = jb.renewal(*ARGUMENTS, **options)
    states, infos = jax.jit(functools.partial(run_kernel, kernel), static_argnums=1)(
        key, num_bridges
    )
    chain = jb.sample_exact_bridges(
        key, *ARGUMENTS, num_bridges=num_bridges, method="renewal", **options
    )
    np.testing.assert_array_equal(chain.accepted, infos.is_accepted)
    np.testing.assert_allclose(chain.paths, states.position, atol=1e-5)
    assert chain.log_weights is None
    assert (infos.is_accepted <= infos.is_hit).all() and infos.is_accepted.any()


@pytest.mark.slow
def test_a_chain_goes_on_from_a_path():
    """As the kernel does from the same position; of several intervals each from its own."""
    options = dict(num_steps=20, proposal=jb.Coupling(0.5))
    key, n = jax.random.key(5), 12
    bend = jnp.sin(jnp.linspace(0.0, jnp.pi, 21))[:, None]
    start, end = (jnp.asarray(point) for point in ARGUMENTS[1:3])
    path = start + jnp.linspace(0.0, 1.0, 21)[:, None] * (end - start) + 0.1 * bend
    run = functools.partial(
        jb.sample_exact_bridges, num_bridges=n, method="pseudo_marginal", **options
    )
    chain = run(key, *ARGUMENTS, position=path)

    kernel = jb.pseudo_marginal(*ARGUMENTS, **options)
    run_key, init_key = jax.random.split(key)
    step = lambda state, key: (lambda new: (new[0], new[0].position))(kernel.step(key, state))
    first = kernel.init(path, init_key)
    _, stepped = jax.jit(lambda state, keys: jax.lax.scan(step, state, keys))(
        first, jax.random.split(run_key, n)
    )
    np.testing.assert_allclose(chain.paths, stepped, atol=1e-5)

    ends = jnp.stack([end, end])
    both = run(key, ARGUMENTS[0], start, ends, 1.0, position=jnp.stack([path, path - 0.2 * bend]))
    assert both.paths.shape == (2, n, 21, 2) and both.met.all()
    given = np.stack([path, path - 0.2 * bend])
    for i, moved in enumerate(np.cumsum(both.accepted, axis=1)):
        still = np.asarray(both.paths[i])[moved == 0]
        np.testing.assert_allclose(still, np.broadcast_to(given[i], still.shape), atol=1e-6)
    assert not both.accepted[:, 0].all()


@pytest.mark.slow
def test_chains_under_vmap_share_their_lanes():
    """As many lanes as chains, in place of 64 or more for each; and the numbers of each alone."""
    kernel = jb.renewal(*ARGUMENTS, num_steps=7, proposal=jb.Coupling(0.5))
    chains = jax.vmap(lambda key: run_kernel(kernel, key, 3)[0].position)
    keys = jax.random.split(jax.random.key(1), 70)
    text = jax.jit(chains).lower(keys).as_text()
    lanes = {int(n) for n in re.findall(r"<7x2x(\d+)xf32>", text)}
    assert 70 in lanes and max(lanes) <= 70
    together = jax.jit(chains)(keys[:2])
    for i in range(2):
        np.testing.assert_array_equal(together[i], run_kernel(kernel, keys[i], 3)[0].position)


@pytest.mark.slow
def test_chains_of_several_models_under_vmap():
    """Of which each has lanes of its own."""
    keys = jax.random.split(jax.random.key(1), 2)

    def chain(key, scale):
        model = ARGUMENTS[0]
        model = model.with_params(model.params._replace(B=scale * model.params.B))
        kernel = jb.renewal(model, *ARGUMENTS[1:], num_steps=7, proposal=jb.Coupling(0.5))
        return run_kernel(kernel, key, 3)[0].position

    scales = jnp.array([1.0, 2.0])
    together = jax.jit(jax.vmap(chain))(keys, scales)
    for i in range(2):
        np.testing.assert_allclose(together[i], chain(keys[i], scales[i]), atol=1e-5)


@slow
def test_segments_of_hard_bridges_are_mended_to_one_chain(monkeypatch):
    """Few renewals: trajectories seldom rejoin within their segment. All segments are run and
    mended by one body, and those beyond as many as are mended at a time by another."""
    monkeypatch.setattr(sys.modules["jaxbridge.exact.renewal"], "_REPAIR_WIDTH", 8)
    num_bridges = 1400
    arguments = (paper_model(), *PAPER_CASES["very unlikely"], 1.0)
    options = dict(num_steps=10, proposal=jb.Coupling(0.5))
    kernel = jb.renewal(*arguments, **options)
    key = jax.random.key(2)
    states, infos = jax.jit(functools.partial(run_kernel, kernel), static_argnums=1)(
        key, num_bridges
    )
    chain = jb.sample_exact_bridges(
        key, *arguments, num_bridges=num_bridges, method="renewal", save_at=[0.5, 1.0], **options
    )
    assert 0 < infos.is_accepted.mean() < 0.1
    np.testing.assert_array_equal(chain.accepted, infos.is_accepted)
    np.testing.assert_allclose(chain.paths, states.position[:, [5, 10]], atol=1e-5)


@pytest.mark.slow
def test_blackjax_runs_the_kernels():
    """The runner touches `init(position, key)` and `step(key, state)` only."""
    kernel = jb.renewal(*ARGUMENTS, num_steps=20, proposal=jb.Coupling(0.5))
    bridge = jb.sample_bridges(jax.random.key(0), *ARGUMENTS, num_steps=20).paths[0]
    key = jax.random.key(1)
    final, (states, infos) = blackjax.util.run_inference_algorithm(
        key, kernel, num_steps=40, initial_position=bridge
    )
    assert states.position.shape == (40, 21, 2) and infos.is_accepted.any()
    run_key, init_key = jax.random.split(key)
    state = kernel.init(bridge, init_key)
    for step_key in jax.random.split(run_key, 40):
        state, _ = kernel.step(step_key, state)
    np.testing.assert_allclose(final.position, state.position, atol=1e-5)


@pytest.mark.slow
def test_weights_of_given_bridges_have_their_law_in_the_chain():
    """Over exact bridges with weights from their law in the chain, E[1/w] = P(met)/p: one over
    the mean weight of proposals. Plain counts are size-unbiased and fail."""
    model, start, end, duration = ARGUMENTS
    n, num_steps = 20_000, 30
    exact = jb.gaussian_bridge(model, start, end, duration, jnp.linspace(0, 1, num_steps + 1))
    paths = exact.sample(jax.random.key(0), n)
    paths = paths.at[:, 0].set(jnp.asarray(start)).at[:, -1].set(jnp.asarray(end))
    coupling = jb.Coupling(0.5)
    bridges = jb.sample_bridges(
        jax.random.key(1),
        *ARGUMENTS,
        num_bridges=n,
        num_steps=num_steps,
        coupling=coupling,
    )
    met = n / float(bridges.num_proposals)
    density = jb.ou_transition(model, jnp.asarray(start), 1.0).log_density(jnp.asarray(end))
    expected = met / float(jnp.exp(density))

    proposal = as_proposal(coupling, model, jnp.asarray(start), Budget(1))
    intervals = jax.tree.map(
        lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, jnp.float32), (n, *jnp.shape(leaf))),
        Intervals(jnp.asarray(start), jnp.asarray(end), jnp.asarray(duration)),
    )
    keys = jax.random.split(jax.random.key(2), n)
    drawn = jax.jit(lambda keys: proposal.reweigh(keys, model.prepared(), intervals, paths))(keys)
    assert drawn.found.all()
    inverse = np.exp(-np.asarray(drawn.log_weights, float))
    error = inverse.std() / np.sqrt(n) + expected * np.sqrt((1 - met) / n)
    assert abs(inverse.mean() - expected) < 5 * error + 0.02 * expected
    fresh = jb.hitting_counts(jax.random.key(3), model, bridges).mean
    weights = np.asarray(fresh) * float(jnp.exp(model.log_stationary(jnp.asarray(end))))
    assert abs((1 / weights).mean() - expected) > 20 * error


@slow
def test_chain_without_a_bridge_is_nan_and_said():
    arguments = (paper_model(), [0.0, 0.0], [9.0, 0.0], 0.01)
    chain = jb.sample_exact_bridges(
        jax.random.key(0), *arguments, num_bridges=20, method="renewal", max_proposals=9
    )
    assert not chain.met.any() and not chain.accepted.any()
    assert np.isnan(chain.paths).all()
    # In each step, where renewal tries to hit besides, and for the first path.
    assert chain.num_simulated == 20 * 10 + 9
    kernel = jb.renewal(*arguments, max_proposals=9)
    state = kernel.init(None, jax.random.key(0))
    state, info = kernel.step(jax.random.key(1), state)
    assert np.isnan(state.position).all() and not info.is_accepted


@pytest.mark.slow
def test_cut_off_counts_are_flagged():
    chain = jb.sample_exact_bridges(
        jax.random.key(0),
        paper_model(),
        *PAPER_CASES["very unlikely"],
        1.0,
        num_bridges=200,
        max_trials=20,
    )
    assert chain.truncated.any() and chain.met.all()
    assert np.isfinite(chain.log_weights).all() and np.isfinite(chain.paths).all()
