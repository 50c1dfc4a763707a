"""Approximate bridges: their law, the search for them, gradients, compilation and errors."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    PAPER_B,
    PAPER_CASES,
    assert_moments,
    paper_model,
    run_program,
    swirl,
    unswirl,
    warped_model,
)
from studies.numpy_reference import approximate_bridges

import jaxbridge as jb
import jaxbridge.coupling.bridges
from jaxbridge.coupling.join import propose

NON_REVERSIBLE = np.array([[1.0, 1.5], [-1.0, 0.5]])


def mid_points(case, gamma, coupling=None, num_bridges=50_000, seed=0):
    """Deviations of approximate bridges at T/2 from the exact mean, in exact sds."""
    start, end = PAPER_CASES[case]
    model = paper_model()
    bridges = jb.sample_bridges(
        jax.random.key(seed),
        model,
        start,
        end,
        1.0,
        num_bridges=num_bridges,
        num_steps=50,
        coupling=jb.Coupling(gamma) if coupling is None else coupling,
        save_at=[0.5],
    )
    exact = jb.gaussian_bridge(model, start, end, 1.0, [0.5])
    assert bridges.met.all()
    scale = np.sqrt(np.diag(exact.covariance[0]))
    return (np.asarray(bridges.paths[:, 0]) - np.asarray(exact.mean[0])) / scale


# The law


@pytest.mark.slow
def test_likely_bridges_by_reflection_have_the_exact_law():
    start, end = PAPER_CASES["likely"]
    exact = jb.gaussian_bridge(paper_model(), start, end, 1.0, [0.5]).covariance[0]
    scale = np.sqrt(np.diag(exact))
    z = mid_points("likely", -1.0)
    assert_moments(z, np.zeros(2), exact / np.outer(scale, scale))


@pytest.mark.slow
@pytest.mark.optimised
def test_unlikely_bridges_show_the_error_of_the_method():
    """Conditioning on being hit pulls the bridge towards the stationary law. The error is the
    same in both coordinates up to sign, by symmetry, and shrinks as γ → 1, as the paper saw."""
    error = 5 / np.sqrt(50_000)
    half, close = (mid_points("unlikely", gamma).mean(0) for gamma in (0.5, 0.95))
    assert (half < -0.1).all() and abs(half[0] - half[1]) < 2 * error
    assert (np.abs(close) < np.abs(half) - error).all() and (np.abs(close) < 0.06).all()
    extreme = mid_points("very unlikely", 0.5).mean(0)
    assert extreme[0] < -0.15 and abs(extreme[0] + extreme[1]) < 2 * error


@pytest.mark.parametrize(
    ("gamma", "meeting", "crossing"),
    [
        pytest.param(-1.0, jb.SignTest(), False, marks=pytest.mark.slow),
        (0.5, jb.BrownianCrossing(), True),
    ],
)
def test_same_law_as_an_independent_implementation(gamma, meeting, crossing):
    """Mid-points, meeting and acceptance against NumPy, same scheme and same step."""
    start, end = PAPER_CASES["unlikely"]
    num_proposals, num_steps = 40_000, 20
    other = approximate_bridges(
        np.random.default_rng(0),
        PAPER_B,
        np.array(start),
        np.array(end),
        1.0,
        num_steps,
        num_proposals,
        gamma,
        crossing,
    )
    other = np.moveaxis(other, -1, 0)
    bridges = jb.sample_bridges(
        jax.random.key(0),
        paper_model(),
        start,
        end,
        1.0,
        num_bridges=20_000,
        num_steps=num_steps,
        coupling=jb.Coupling(gamma, meeting, jb.Euler()),
    )
    share, other_share = 20_000 / float(bridges.num_proposals), len(other) / num_proposals
    assert abs(share - other_share) < 5 * np.sqrt(share * (1 - share) * 2 / 20_000)
    for step in (5, 10, 15):
        ours, theirs = np.asarray(bridges.paths[:, step]), other[:, step]
        for statistic in (lambda z: z, lambda z: z**2, lambda z: z[:, :1] * z[:, 1:]):
            a, b = statistic(ours), statistic(theirs)
            error = np.sqrt(a.var(0) / len(a) + b.var(0) / len(b))
            assert (np.abs(a.mean(0) - b.mean(0)) < 5 * error).all()


@pytest.mark.slow
@pytest.mark.optimised
def test_non_reversible_process_on_a_long_interval():
    """Nearly every pair meets, so the approximate bridge is exact up to Monte Carlo error."""
    model = jb.ornstein_uhlenbeck(NON_REVERSIBLE, mean=[0.2, -0.1], sigma=[[1.0, 0.3], [0.0, 0.8]])
    arguments = ([0.5, 0.5], [-0.5, 0.3], 10.0)
    bridges = jb.sample_bridges(
        jax.random.key(1),
        model,
        *arguments,
        num_bridges=20_000,
        num_steps=250,
        coupling=jb.Coupling(-1.0),
        save_at=[1.0, 5.0, 9.0],
    )
    exact = jb.gaussian_bridge(model, *arguments, [1.0, 5.0, 9.0])
    for k in range(3):
        assert_moments(
            bridges.paths[:, k], exact.mean[k], exact.covariance[k], mean_allowance=0.002
        )


@pytest.mark.slow
@pytest.mark.optimised
def test_state_dependent_full_sigma_on_a_long_interval():
    """Bridges of the swirled process, unswirled. The allowance is for its first-order step."""
    inner = jb.ornstein_uhlenbeck(NON_REVERSIBLE)
    start, end = jnp.array([0.5, 0.5]), jnp.array([-0.5, 0.3])
    bridges = jb.sample_bridges(
        jax.random.key(1),
        warped_model(inner, swirl, unswirl),
        swirl(start),
        swirl(end),
        8.0,
        num_bridges=3_000,
        num_steps=400,
        coupling=jb.Coupling(-1.0),
        save_at=[1.0, 4.0, 7.0],
    )
    exact = jb.gaussian_bridge(inner, start, end, 8.0, [1.0, 4.0, 7.0])
    for k in range(3):
        y = jax.vmap(unswirl)(bridges.paths[:, k])
        assert_moments(y, exact.mean[k], exact.covariance[k], mean_allowance=0.02)


@pytest.mark.slow
def test_one_dimension_and_independent_copies():
    """d = 1 and γ = 0: the method of Bladt & Sørensen (2014)."""
    model = jb.ornstein_uhlenbeck([[1.0]])
    bridges = jb.sample_bridges(
        jax.random.key(1),
        model,
        [0.3],
        [-0.2],
        10.0,
        num_bridges=20_000,
        num_steps=200,
        save_at=[1.0, 5.0],
    )
    exact = jb.gaussian_bridge(model, [0.3], [-0.2], 10.0, [1.0, 5.0])
    for k in range(2):
        assert_moments(bridges.paths[:, k], exact.mean[k], exact.covariance[k])


@pytest.mark.slow
def test_precisions_agree_in_law(precision):
    bridges = jb.sample_bridges(
        jax.random.key(1),
        paper_model(),
        [0.5, 0.0],
        [0.0, 0.5],
        6.0,
        num_bridges=10_000,
        num_steps=120,
        save_at=[3.0],
    )
    assert bridges.paths.dtype == precision and bridges.times.dtype == precision
    exact = jb.gaussian_bridge(paper_model(), [0.5, 0.0], [0.0, 0.5], 6.0, [3.0])
    assert_moments(bridges.paths[:, 0], exact.mean[0], exact.covariance[0])


# The search


@pytest.mark.slow
def test_unreachable_end_stops_at_the_bound():
    bridges = jb.sample_bridges(
        jax.random.key(0),
        paper_model(),
        [[40.0, 40.0], [0.0, 0.0]],
        [[-40.0, -40.0], [0.0, 0.0]],
        [0.01, 1.0],
        num_bridges=3,
        num_steps=10,
        max_proposals=500,
    )
    np.testing.assert_array_equal(bridges.met, [[False] * 3, [True] * 3])
    np.testing.assert_array_equal(bridges.meeting_step[0], [-1] * 3)
    assert bridges.num_proposals[0] == 500 and bridges.num_proposals[1] < 500
    assert jnp.isnan(bridges.paths[0]).all() and jnp.isfinite(bridges.paths[1]).all()


def test_exploding_proposals_are_rejected_and_counted():
    """Explicit steps of a quartic potential overflow from some starts, not from all."""
    model = jb.langevin(lambda x, p: -((x @ x) ** 2))
    bridges = jb.sample_bridges(
        jax.random.key(0),
        model,
        [0.0, 0.0],
        [1.3, 0.0],
        10.0,
        num_bridges=200,
        num_steps=40,
        coupling=jb.Coupling(0.0, scheme=jb.Euler()),
        max_proposals=20_000,
    )
    assert 0 < bridges.num_nonfinite <= bridges.num_proposals
    assert jnp.isfinite(bridges.paths[bridges.met]).all()


def test_throw():
    arguments = (jax.random.key(0), paper_model(), [9.0, 9.0], [-9.0, -9.0], 0.01)
    settings = dict(num_steps=5, max_proposals=10, throw=True)
    with pytest.raises(RuntimeError, match=r"no pair met.* Use more `max_proposals`"):
        jax.block_until_ready(jb.sample_bridges(*arguments, **settings))


# Gradients


def quantity(params, start, end, duration, coupling=None):
    model = jb.ornstein_uhlenbeck(np.eye(2)).with_params(params)
    bridges = jb.sample_bridges(
        jax.random.key(0),
        model,
        start,
        end,
        duration,
        num_bridges=8,
        num_steps=20,
        coupling=jb.Coupling(0.5) if coupling is None else coupling,
    )
    return jnp.sum(bridges.paths[:, 10] ** 2)


@pytest.mark.slow
def test_gradients_are_those_at_fixed_noise_and_meeting_step(x64):
    """Forward and reverse mode against central differences, too small to move a meeting."""
    params = jb.OrnsteinUhlenbeckParams(jnp.asarray(NON_REVERSIBLE), jnp.zeros(2), jnp.eye(2))
    arguments = (params, jnp.array([0.5, 0.2]), jnp.array([0.3, -0.2]), jnp.asarray(1.0))
    direction = jax.tree.map(
        lambda leaf: jnp.cos(jnp.arange(1.0, leaf.size + 1)).reshape(leaf.shape), arguments
    )
    shifted = lambda e: jax.tree.map(lambda leaf, d: leaf + e * d, arguments, direction)
    numeric = (quantity(*shifted(1e-6)) - quantity(*shifted(-1e-6))) / 2e-6
    _, forward = jax.jvp(quantity, arguments, direction)
    gradient = jax.jit(jax.grad(quantity, argnums=(0, 1, 2, 3)))(*arguments)
    reverse = sum(
        jnp.vdot(g, d) for g, d in zip(*map(jax.tree.leaves, (gradient, direction)), strict=True)
    )
    assert abs(forward) > 1e-2
    np.testing.assert_allclose([forward, reverse], numeric, rtol=1e-6)


def test_a_caller_who_asks_for_no_gradient_pays_for_none(monkeypatch):
    """The replay of proposals is traced only when a derivative is asked for."""
    calls = []

    def counted(*arguments):
        calls.append(arguments)
        return propose(*arguments)

    monkeypatch.setattr(jaxbridge.coupling.bridges, "propose", counted)

    def plain(start):
        params = jb.OrnsteinUhlenbeckParams(jnp.eye(2), jnp.zeros(2), None)
        return quantity(params, start, jnp.ones(2), 1.0)

    jax.make_jaxpr(plain)(jnp.zeros(2))
    assert all(arguments[4] is None for arguments in calls)
    jax.make_jaxpr(jax.grad(plain))(jnp.zeros(2))
    assert calls[-1][4] is not None  # the fixed meeting step of a replay


@pytest.mark.slow
def test_gradients_stay_finite_where_no_bridge_was_found():
    """Some rows have no bridge because every proposal overflowed; masked, they count nothing,
    in reverse mode too."""

    def masked_sum(rate):
        model = jb.Diffusion(
            lambda x, p: -p * x**3, None, lambda x, p: -p * jnp.sum(x**4) / 2, rate
        )
        bridges = jb.sample_bridges(
            jax.random.key(0),
            model,
            [[3.0], [0.0]],
            [[3.2], [0.0]],
            4.0,
            num_bridges=2,
            num_steps=12,
            coupling=jb.Coupling(0.0, scheme=jb.Euler()),
            max_proposals=8,
        )
        found = bridges.met[..., None, None]
        return jnp.where(found, bridges.paths, 0).sum(), bridges

    derivative, bridges = jax.grad(masked_sum, has_aux=True)(1.0)
    assert not bridges.met[0].any() and bridges.met[1].all() and bridges.num_nonfinite[0] == 8
    assert jnp.isfinite(derivative)


@pytest.mark.slow
def test_derivatives_at_a_traced_reflection_are_finite():
    def path(start, gamma):
        bridges = jb.sample_bridges(
            jax.random.key(0),
            paper_model(),
            start,
            [0.0, 0.5],
            1.0,
            num_steps=10,
            coupling=jb.Coupling(gamma),
        )
        return bridges.paths.sum()

    gradients = jax.vmap(jax.grad(path), in_axes=(None, 0))(jnp.zeros(2), jnp.array([-1.0, 0.5]))
    assert jnp.isfinite(gradients).all()


# Compilation


def test_numbers_written_in_a_traced_function_are_known():
    """And decide what is compiled."""
    couplings = []
    jax.jit(lambda: couplings.append(jb.Coupling(-1.0, jb.ReflectionPlane())))()
    assert not couplings[0].independent_noise
    assert jb.Coupling(0.7).independent_noise
    assert jax.tree.structure(jb.Coupling(-1.0)) != jax.tree.structure(jb.Coupling(0.7))


@pytest.mark.slow
def test_models_that_close_over_traced_values_can_be_batched():
    def paths(rate):
        model = jb.Diffusion(lambda x, p: -rate * x, reversible=True)
        return jb.sample_bridges(
            jax.random.key(0), model, [0.0, 0.0], [0.1, 0.0], 1.0, num_steps=10
        ).paths

    rates = jnp.array([0.5, 1.0])
    np.testing.assert_allclose(jax.vmap(paths)(rates)[1], paths(1.0), atol=1e-5)


@pytest.mark.slow
def test_params_may_hold_a_neural_network():
    network = eqx.nn.MLP(2, 2, 8, 1, key=jax.random.key(0))
    model = jb.Diffusion(
        lambda x, p: -x + p(x), reverse_drift=lambda x, p: -x - p(x), params=network
    )

    def loss(model):
        return jb.sample_bridges(
            jax.random.key(0), model, [0.0, 0.0], [0.1, 0.0], 2.0, num_steps=10
        ).paths.sum()

    gradient = eqx.filter_grad(loss)(model)
    leaves = jax.tree.leaves(eqx.filter(gradient.params, eqx.is_array))
    assert any((leaf != 0).any() for leaf in leaves)
    assert all(jnp.isfinite(leaf).all() for leaf in leaves)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["Heun", "Euler"])
def test_sixty_thousand_lanes_with_full_sigma_finish(scheme):
    """Batched LAPACK calls in such a scan can hang XLA's thread pool on CPU for ever."""
    program = f"""
        import jax, jax.numpy as jnp, jaxbridge as jb
        mix = lambda x: jnp.array([[1.0, jnp.sin(x[0])], [jnp.cos(x[1]) / 2, 2.0]])
        model = jb.stationary_diffusion(lambda x, p: -x @ x / 2, V=lambda x, p: mix(x) @ mix(x).T)
        bridges = jb.sample_bridges(
            jax.random.key(0), model, [0.5, 0.0], [0.0, 0.5], 1.0, num_bridges=60_000,
            num_steps=10, batch_size=60_000, coupling=jb.Coupling(0.5, scheme=jb.{scheme}()),
        )
        assert bridges.met.all()
    """
    run_program(program)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads Linux's own count")
def test_a_thousand_long_bridges_take_less_than_two_gibibytes():
    """Measured where nothing else has been run: the peak of a process does not come down.
    `VmHWM` and not `ru_maxrss`, which starts from the peak of the process that started this one."""
    run_program("""
        import re, pathlib
        import jax, jax.numpy as jnp, jaxbridge as jb
        from jaxbridge.studies.paper import study_model
        bridges = jb.sample_bridges(
            jax.random.key(0), study_model(), [0.0, 0.0], [1.0, 0.0], 1_000.0, num_bridges=1_000,
            num_steps=50_000, save_at=jnp.linspace(0, 1_000, 11),
        )
        assert bridges.met.all()
        status = pathlib.Path("/proc/self/status").read_text()
        peak = int(re.search(r"VmHWM:\\s*(\\d+) kB", status).group(1)) * 1024
        assert peak < 2**31, peak
    """)
