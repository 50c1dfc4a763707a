"""Proposals pulled to the end point, against the exact law of the Euler scheme and closed forms."""

import cir
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    FULL_SIGMA,
    NON_REVERSIBLE,
    assert_weighted_moments,
    count_compilations,
    exact_case,
    loglog_slope,
    paper_model,
    slow_beyond,
    swirl,
    unswirl,
)

import jaxbridge as jb
from jaxbridge.exact.log_means import log_mean_and_error
from jaxbridge.models.bridge_problem import Intervals
from jaxbridge.proposals.guided import Step, noise_of, path_of
from jaxbridge.schemes.step_density import QuadraticDensity

slow = pytest.mark.slow
PROPOSALS = {
    "modified diffusion bridge": jb.ModifiedDiffusionBridge(),
    "residual bridge": jb.ResidualBridge(),
    "guided": jb.Guided(),
    "guided along the path": jb.Guided("path"),
    "guided by a matrix": jb.Guided([[-0.4]]),
    "refined": jb.Guided(refinement=2.0),
    "refined modified diffusion bridge": jb.ModifiedDiffusionBridge(refinement=1.5),
}
# One dimension, nonlinear drift and σ that depends on the state.
BENT = jb.Diffusion(
    lambda x, p: p * (x - x**3), lambda x, p: 0.5 + 0.4 / (1 + x**2), None, jnp.asarray(0.8)
)


def two_wells(barrier=1.7):
    return jb.langevin(lambda x, p: -p * ((x[0] ** 2 - 1) ** 2 + x[1] ** 2), barrier)


def euler_bridge_1d(model, start, end, times, middle):
    """log density and mean of x at grid point `middle` for the Euler scheme on `times`, by
    quadrature: its law exactly, with no step error."""
    grid = np.linspace(-5, 5, 2001)
    width = grid[1] - grid[0]
    alpha = np.asarray(jax.vmap(lambda x: model.drift(x[None])[0])(jnp.asarray(grid)), float)
    sigma = np.asarray(jax.vmap(lambda x: model.diffusion(x[None])[0, 0])(jnp.asarray(grid)))

    def density(x, drift, s, y, dt):
        return np.exp(-((y - x - drift * dt) ** 2) / (2 * s**2 * dt)) / (
            s * np.sqrt(2 * np.pi * dt)
        )

    dts = np.diff(times)
    at = lambda x: np.argmin(np.abs(grid - x))
    forward = density(start, alpha[at(start)], sigma[at(start)], grid, dts[0])
    backward = density(grid, alpha, sigma, end, dts[-1])
    kernels = [density(grid[:, None], alpha[:, None], sigma[:, None], grid, dt) for dt in dts[1:-1]]
    for kernel in kernels[: middle - 1]:
        forward = forward @ kernel * width
    for kernel in kernels[middle - 1 :][::-1]:
        backward = kernel @ backward * width
    joint = forward * backward
    return np.log(joint.sum() * width), (grid * joint).sum() / joint.sum()


@pytest.mark.slow
@pytest.mark.parametrize("name", PROPOSALS)
def test_weights_make_the_euler_scheme_exact(name):
    """Density and mean of the mid-point, state-dependent σ, five coarse steps: no step error."""
    no_density = lambda p: p.density
    proposal = eqx.tree_at(
        no_density, PROPOSALS[name], jb.EulerDensity(), is_leaf=lambda leaf: leaf is None
    )
    start, end, duration, n = 0.3, -0.9, 1.2, 40_000
    arguments = (BENT, jnp.array([start]), jnp.array([end]), duration)
    estimate = jb.transition_log_density(
        jax.random.key(0), *arguments, num_proposals=n, num_steps=5, proposal=proposal
    )
    weighted = jb.sample_weighted_bridges(
        jax.random.key(1), *arguments, num_bridges=n, num_steps=5, proposal=proposal
    )
    exact, mean = euler_bridge_1d(BENT, start, end, np.asarray(weighted.times, float), 3)
    assert 0 < float(estimate.standard_error) < 0.01
    assert abs(float(estimate.value) - exact) < 5 * float(estimate.standard_error) + 1e-4
    point = lambda path: path[3, 0]
    error = float(weighted.standard_error(point))
    assert 0 < error < 0.01 and weighted.effective_sample_size > 0.3 * n
    assert abs(float(weighted.mean(point)) - mean) < 5 * error + 1e-4
    # Without weights the mean is elsewhere, so that the weights are seen to matter.
    assert abs(float(weighted.paths[:, 3, 0].mean()) - mean) > 5 * error


@pytest.mark.parametrize("name", list(PROPOSALS)[:4])
def test_one_step_is_the_euler_density(name):
    ends = jnp.array([0.3]), jnp.array([0.7])
    estimate = jb.transition_log_density(
        jax.random.key(0), BENT, *ends, 0.4, num_steps=1, num_proposals=2, proposal=PROPOSALS[name]
    )
    weighted = jb.sample_weighted_bridges(
        jax.random.key(0), BENT, *ends, 0.4, num_steps=1, num_bridges=3, proposal=PROPOSALS[name]
    )
    np.testing.assert_allclose(weighted.paths, jnp.broadcast_to(jnp.stack(ends), (3, 2, 1)))
    np.testing.assert_allclose(weighted.log_weights, float(estimate.value), atol=1e-5)
    sd = float(BENT.diffusion(ends[0])[0, 0]) * np.sqrt(0.4)
    z = (0.7 - 0.3 - float(BENT.drift(ends[0])[0]) * 0.4) / sd
    assert float(estimate.value) == pytest.approx(-(z**2) / 2 - np.log(sd * np.sqrt(2 * np.pi)))


@pytest.mark.parametrize("refinement", slow_beyond(1, [1.0, 2.0]))
@pytest.mark.parametrize("linearisation", slow_beyond(1, ["end", "path", -NON_REVERSIBLE]))
def test_linear_drift_is_guided_without_error(x64, linearisation, refinement):
    """Every weight is the density of the Euler chain, a Gaussian recursion."""
    model = jb.ornstein_uhlenbeck(NON_REVERSIBLE, [0.2, -0.1], FULL_SIGMA)
    start, end, duration, n = jnp.array([0.8, -0.3]), jnp.array([-0.5, 0.4]), 1.5, 12
    proposal = jb.Guided(linearisation, jb.EulerDensity(), refinement)
    weighted = jb.sample_weighted_bridges(
        jax.random.key(0),
        model,
        start,
        end,
        duration,
        num_bridges=8,
        num_steps=n,
        proposal=proposal,
    )
    mean, covariance = np.asarray(start) - [0.2, -0.1], np.zeros((2, 2))
    for dt in np.diff(weighted.times):
        step = np.eye(2) - NON_REVERSIBLE * dt
        mean, covariance = step @ mean, step @ covariance @ step.T + FULL_SIGMA @ FULL_SIGMA.T * dt
    law = jb.GaussianLaw(mean + np.array([0.2, -0.1]), covariance)
    np.testing.assert_allclose(weighted.log_weights, law.log_density(end), atol=1e-9)
    np.testing.assert_array_equal(weighted.paths[:, -1], jnp.broadcast_to(end, (8, 2)))


@pytest.mark.slow
@pytest.mark.parametrize("duration, num_steps", slow_beyond(1, [(0.1, 50), (1.0, 400)]))
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("modified diffusion bridge", marks=pytest.mark.slow),
        pytest.param("residual bridge", marks=pytest.mark.slow),
        "guided",
    ],
)
def test_density_is_that_of_the_closed_form(name, duration, num_steps):
    model = paper_model()
    start = jnp.array([0.785, 0.785])
    law = jb.ou_transition(model, start, duration)
    end = law.mean + jnp.sqrt(jnp.diag(law.covariance)) * jnp.array([0.7, -0.4])
    estimate = jb.transition_log_density(
        jax.random.key(1),
        model,
        start,
        end,
        duration,
        num_proposals=20_000,
        num_steps=num_steps,
        proposal=PROPOSALS[name],
    )
    error = float(estimate.standard_error)
    assert error < 0.03
    assert abs(float(estimate.value - law.log_density(end))) < 5 * error + 0.01


@slow
def test_full_state_dependent_sigma_has_the_exact_law():
    """OU turned by a rotation that depends on the radius: density and mid-point."""
    ou = jb.ornstein_uhlenbeck(NON_REVERSIBLE)
    case = exact_case(ou, [0.8, -0.3], [0.5, 0.4], 0.25, 0.0, num_steps=20, warp=(swirl, unswirl))
    options = dict(num_steps=case.num_steps, proposal=jb.Guided())
    ends = (case.start, case.end, case.duration)
    weighted = jb.sample_weighted_bridges(
        jax.random.key(1), case.model, *ends, num_bridges=20_000, save_at=[0.125], **options
    )
    log_mean, error, _ = (leaf[0] for leaf in log_mean_and_error(weighted.log_weights[None]))
    assert error < 0.01 and abs(log_mean - case.log_density) < 5 * error + 0.01
    middle = np.asarray(jax.vmap(case.to_gaussian)(weighted.paths[:, 0]))
    assert_weighted_moments(middle, weighted.weights, case.mean, case.covariance, allowance=0.01)


def brownian_bridge_density(rng, log_nu, start, end, duration, num_steps, num_paths):
    """log p_T for dX = ½∇log ν dt + dW, and its standard error, in NumPy: with A = ½ log ν,
    N(b - a; 0, T I) exp[A(b) - A(a)] E exp[-½ ∫ |∇A|² + ΔA] over Brownian bridges."""
    a, b = np.asarray(start), np.asarray(end)
    dt = duration / num_steps
    noise = rng.normal(size=(num_steps, num_paths, 2)) * np.sqrt(dt)
    walk = np.concatenate([np.zeros((1, num_paths, 2)), np.cumsum(noise, 0)])
    t = np.linspace(0, 1, num_steps + 1)[:, None, None]
    paths = a + walk + t * (b - a - walk[-1])
    A, gradient_squared, laplacian = log_nu(paths)
    potential = (gradient_squared + laplacian) / 2
    integral = (potential[1:] + potential[:-1]).sum(0) * dt / 2
    first, last = A[0, 0], A[-1, 0]
    weights = np.exp(-integral)
    log_normal = -((b - a) ** 2).sum() / (2 * duration) - np.log(2 * np.pi * duration)
    value = log_normal + last - first + np.log(weights.mean())
    return value, weights.std() / weights.mean() / np.sqrt(num_paths)


def two_wells_in_numpy(barrier):
    """A = ½ log ν, |∇A|² and ΔA."""

    def functions(x):
        first, second = x[..., 0], x[..., 1]
        A = -barrier / 2 * ((first**2 - 1) ** 2 + second**2)
        slopes = -2 * barrier * first * (first**2 - 1), -barrier * second
        laplacian = -2 * barrier * (3 * first**2 - 1) - barrier
        return A, slopes[0] ** 2 + slopes[1] ** 2, laplacian

    return functions


@pytest.mark.optimised
@pytest.mark.slow
def test_double_well_agrees_with_brownian_bridge_monte_carlo():
    name, duration, num_steps = "guided", 1.0, 800
    ends = ([-1.0, 0.0], [0.8, 0.3])
    oracle, oracle_error = brownian_bridge_density(
        np.random.default_rng(0), two_wells_in_numpy(1.7), *ends, duration, 200, 40_000
    )
    estimate = jb.transition_log_density(
        jax.random.key(0),
        two_wells(),
        *ends,
        duration,
        num_proposals=40_000,
        num_steps=num_steps,
        proposal=PROPOSALS[name],
    )
    error = np.hypot(float(estimate.standard_error), oracle_error)
    assert error < 0.03
    assert abs(float(estimate.value) - oracle) < 5 * error + 0.01


@pytest.mark.slow
def test_noise_makes_the_path_and_the_path_gives_the_noise(precision):
    """The maps are inverse to each other, and a path's weight is a function of the path."""
    model = jb.Diffusion(
        lambda x, p: -x + jnp.sin(x[::-1]), lambda x, p: jnp.array([[1.0, 0.2], [0.3 * x[0], 0.9]])
    )
    intervals = Intervals(
        jnp.array([[0.0, 0.0], [0.3, -0.2]]),
        jnp.array([[0.5, 0.1], [0.0, 0.4]]),
        jnp.array([1.0, 0.7]),
    )
    dynamics = model.forward(intervals.start[0])
    xi = jax.random.normal(jax.random.key(0), (2, 9, 2))
    tolerance = 2e-4 if precision == "float32" else 1e-11
    euler = jb.EulerDensity()
    for proposal in (jb.ModifiedDiffusionBridge(euler), jb.Guided("path", euler, refinement=1.5)):
        paths, log_weights, log_halving = jax.jit(
            lambda xi, proposal=proposal: path_of(
                proposal, dynamics, intervals, xi, xi.shape[1] + 1
            )[:3]
        )(xi)
        noise, again, halving_again = jax.jit(
            lambda paths, proposal=proposal: noise_of(proposal, dynamics, intervals, paths)
        )(paths)
        np.testing.assert_allclose(noise, xi, atol=tolerance)
        np.testing.assert_allclose(again, log_weights, atol=tolerance)
        np.testing.assert_allclose(halving_again, log_halving, atol=tolerance)


@pytest.mark.parametrize("diagonal", [True, False])
def test_without_drift_a_guess_has_the_mean_of_both_covariances(diagonal, x64):
    """A normal law of variance V δ tilted by one of variance ½ (V(x) + V(b)) (T - t), by hand."""

    def sigma(x, p):
        scale = jnp.exp(jnp.sin(2 * x) - x)
        return scale if diagonal else jnp.diag(scale) + jnp.array([[0.0, 0.7], [-0.4, 0.0]])

    model, x, end = jb.Diffusion(lambda x, p: 0 * x, sigma), jnp.array([0.0, 0.3]), [1.5, -1.0]
    proposal = jb.Guided(density=jb.EulerDensity())
    dt, end = jnp.full(5, 0.2), jnp.array(end)
    dynamics = model.forward(x)
    guide = jax.tree.map(lambda leaf: leaf[2], proposal.guide(dynamics, x, end, dt))
    target = proposal.target.steps_from(dynamics, x).law(dt[0])
    law = proposal.step_law(Step(guide, dt[0], jnp.array(0.6), end), x, target)

    V, V_end = (
        np.asarray(matrix @ matrix.T)
        for matrix in (dynamics.sigma(point).as_matrix(2, x.dtype) for point in (x, end))
    )
    H = np.linalg.inv(0.4 * (V + V_end) / 2)
    covariance = np.linalg.inv(np.linalg.inv(0.2 * V) + H)
    np.testing.assert_allclose(law.mean, x + covariance @ H @ (end - x), atol=1e-12)
    units = np.stack([law.point(unit) - law.mean for unit in jnp.eye(2)], axis=1)
    np.testing.assert_allclose(units @ units.T, covariance, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("linearisation", ["end", "path"])
def test_sigma_may_turn_and_a_guess_does_not_see_it(linearisation, x64):
    """The law depends on V alone."""

    def sigma(x, p):
        return jnp.array([[1.0 + x[0] ** 2, 0.0], [0.4 * jnp.sin(x[1]), 0.5 + jnp.cos(x[0]) ** 2]])

    def turned(x, p):
        angle = 3 * x[0] - x[1]
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        return sigma(x, p) @ jnp.array([[cos, -sin], [sin, cos]])

    made = [
        jb.sample_weighted_bridges(
            jax.random.key(0), jb.Diffusion(lambda x, p: -x + jnp.sin(x[::-1]), each),
            [0.0, 0.3], [1.0, -0.5], 1.0, num_bridges=100, num_steps=20,
            proposal=jb.Guided(linearisation),
        )
        for each in (sigma, turned)
    ]  # fmt: skip
    np.testing.assert_allclose(made[0].paths, made[1].paths, atol=1e-9)
    np.testing.assert_allclose(made[0].log_weights, made[1].log_weights, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("density", "order"), [(jb.EulerDensity(), 1), (jb.ItoTaylorDensity(), 2)])
def test_both_families_converge_to_one_law(density, order):
    """The error of log p̂ against the closed form: O(δ) for Euler steps, O(δ²) for others."""
    model, ends = paper_model(), (jnp.array([0.785, 0.785]), jnp.array([0.5, 0.2]))
    exact = float(jb.ou_transition(model, ends[0], 1.0).log_density(ends[1]))
    sizes = np.array([10, 20, 40])
    errors = [
        float(
            jb.transition_log_density(
                jax.random.key(0), model, *ends, 1.0, num_proposals=2, num_steps=int(n),
                proposal=jb.Guided(density=density),
            ).value
        )
        - exact
        for n in sizes
    ]  # fmt: skip
    assert abs(loglog_slope(1 / sizes, np.abs(errors)) - order) < 0.15
    # Extrapolated to no step at all, the two agree; the coupling's own error is O(δ²).
    extrapolated = exact + errors[-1] + (errors[-1] - errors[-2]) / (2**order - 1)
    coupled = jb.transition_log_density(
        jax.random.key(0), model, *ends, 1.0, num_proposals=30_000, num_steps=40,
        proposal=jb.Coupling(0.5),
    )  # fmt: skip
    error = float(coupled.standard_error)
    assert abs(float(coupled.value) - extrapolated) < 5 * error + 0.01


@pytest.mark.slow
def test_derivatives_of_the_density_are_those_of_the_closed_form():
    """The score by autodiff of the estimate, and of a weighted mean, within 5 standard errors."""
    start, end, duration = jnp.array([0.4, -0.2]), jnp.array([0.1, 0.3]), 0.5
    B = jnp.array([[1.0, 0.4], [-0.3, 0.8]])
    steps = 100

    def estimates(B, key):
        model = jb.ornstein_uhlenbeck(NON_REVERSIBLE)
        model = model.with_params(model.params._replace(B=B))
        density = jb.transition_log_density(
            key, model, start, end, duration, num_proposals=400, num_steps=steps,
            proposal=jb.ModifiedDiffusionBridge(),
        )  # fmt: skip
        weighted = jb.sample_weighted_bridges(
            key, model, start, end, duration, num_bridges=400, num_steps=steps, save_at=[0.25],
            proposal=jb.ModifiedDiffusionBridge(),
        )  # fmt: skip
        return density.value, weighted.mean(lambda path: path[0, 0])

    def exact(B):
        model = jb.ornstein_uhlenbeck(NON_REVERSIBLE)
        model = model.with_params(model.params._replace(B=B))
        bridge = jb.gaussian_bridge(model, start, end, duration, [0.25])
        return jb.ou_transition(model, start, duration).log_density(end), bridge.mean[0, 0]

    keys = jax.random.split(jax.random.key(0), 40)
    derivatives = jax.jit(jax.vmap(jax.jacrev(estimates), in_axes=(None, 0)))(B, keys)
    forward = jax.jit(jax.jacfwd(estimates))(B, keys[0])
    for derivative, ahead, truth in zip(derivatives, forward, jax.jacrev(exact)(B), strict=True):
        np.testing.assert_allclose(ahead, derivative[0], atol=2e-4)
        error = derivative.std(0) / np.sqrt(len(keys))
        assert error.max() < 0.02
        np.testing.assert_array_less(np.abs(derivative.mean(0) - truth), 5 * error + 0.01)


@pytest.mark.slow
def test_lost_paths_do_not_spoil_derivatives():
    """√x is not a number where Euler steps have left the half line: forward and reverse agree, and
    with the derivative over the paths that were found."""
    root = jb.Diffusion(lambda x, p: p * (1 - x), lambda x, p: jnp.sqrt(x), None, 1.0)

    def middle(params):
        weighted = jb.sample_weighted_bridges(
            jax.random.key(0), root.with_params(params), jnp.array([0.3]), jnp.array([0.2]), 1.0,
            num_bridges=200, num_steps=10, proposal=jb.ModifiedDiffusionBridge(jb.EulerDensity()),
        )  # fmt: skip
        return weighted.mean(lambda path: path[5, 0]), weighted.met

    (forward, _), (reverse, met) = (
        jax.jacfwd(middle, has_aux=True)(1.0),
        jax.grad(middle, has_aux=True)(1.0),
    )
    assert 20 < met.sum() < 180
    assert np.isfinite(forward) and forward != 0
    np.testing.assert_allclose(reverse, forward, rtol=1e-3)
    step = 1e-2
    difference = (middle(1.0 + step)[0] - middle(1.0 - step)[0]) / (2 * step)
    np.testing.assert_allclose(forward, difference, rtol=0.05)


def test_no_stationary_law_is_called_for():
    arguments = (BENT, jnp.array([0.3]), jnp.array([-0.2]), 0.5)
    chain = jb.sample_exact_bridges(
        jax.random.key(0), *arguments, num_bridges=50, proposal=jb.ModifiedDiffusionBridge()
    )
    assert chain.met.all() and chain.acceptance_rate > 0.8
    assert chain.coupling is None and not chain.truncated.any()


@pytest.mark.slow
@pytest.mark.parametrize("ends", [([0.0, 0.0], [1.0, 1.0]), ([0.5, -0.3], [-0.4, 0.8])])
def test_brownian_bridges_are_nearly_exact_for_the_hyperbolic_diffusion(ends):
    """On unit intervals, as in the paper's section 4."""
    weighted = jb.sample_weighted_bridges(
        jax.random.key(0), jb.hyperbolic(0.8, 2), *ends, 1.0, num_bridges=20_000,
        proposal=jb.ModifiedDiffusionBridge(),
    )  # fmt: skip
    assert weighted.effective_sample_size > 0.95 * 20_000


@pytest.mark.slow
def test_results_do_not_depend_on_blocks_and_keep_what_is_stored():
    model, arguments = paper_model(), ([0.3, 0.1], [-0.2, 0.4], 0.5)
    options = dict(num_steps=7, proposal=jb.Guided())
    few = jb.sample_weighted_bridges(
        jax.random.key(0), model, *arguments, num_bridges=50, **options
    )
    many = jb.sample_weighted_bridges(
        jax.random.key(0), model, *arguments, num_bridges=20_001, **options
    )
    np.testing.assert_allclose(many.paths[:50], few.paths, atol=1e-6)
    np.testing.assert_allclose(many.log_weights[:50], few.log_weights, atol=1e-5)
    assert len(np.unique(np.asarray(many.paths[:, 3, 0]))) > 19_900
    some = jb.sample_weighted_bridges(
        jax.random.key(0),
        model,
        *arguments,
        num_bridges=50,
        save_at=[0.0, 0.5 * 3 / 7, 0.5],
        **options,
    )
    np.testing.assert_array_equal(some.paths, few.paths[:, np.array([0, 3, 7])])


@pytest.mark.slow
def test_thousands_of_intervals_without_compiling_again():
    rng = np.random.default_rng(0)
    model = paper_model()
    starts, ends = rng.normal(size=(2, 3000, 2)).astype(np.float32) * 0.6
    durations = rng.uniform(0.05, 1.0, 3000).astype(np.float32)

    def run(seed, durations):
        return jb.transition_log_density(
            jax.random.key(seed), model, starts, ends, durations, num_proposals=4, num_steps=30,
            proposal=jb.Guided(),
        )  # fmt: skip

    jax.block_until_ready(run(0, durations).value)
    with count_compilations() as compiled:
        estimate = run(1, durations * 0.9)
        jax.block_until_ready(estimate.value)
    assert len(compiled) == 0
    exact = jax.vmap(lambda a, b, t: jb.ou_transition(model, a, t).log_density(b))(
        starts, ends, durations * 0.9
    )
    assert np.abs(np.asarray(estimate.value) - exact).max() < 0.5  # the step error alone
    assert np.median(np.abs(np.asarray(estimate.value) - exact)) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("proposal", [jb.Guided(), jb.ModifiedDiffusionBridge()])
def test_what_cannot_be_a_bridge_is_flagged_where_it_is_traced(unchecked, proposal):
    key = jax.random.key(0)
    options = dict(num_bridges=4, num_steps=5, proposal=proposal)
    root = jb.Diffusion(lambda x, p: 1 - x, lambda x, p: jnp.sqrt(x))

    @jax.jit
    def inside(end):
        return jb.sample_weighted_bridges(key, root, jnp.array([1.0]), end, 1.0, **options)

    for end in (-0.5, 0.0, jnp.nan):
        flagged = inside(jnp.array([end]))
        assert not flagged.met.any() and flagged.num_nonfinite == 4
        assert (flagged.log_weights == -jnp.inf).all() and flagged.effective_sample_size == 0
    # Far away in next to no time: as unlikely as it is, but a number.
    ou = paper_model()
    for duration in (1e-5, 1e-12):
        estimate = jb.transition_log_density(
            key,
            ou,
            [0.0, 0.0],
            [1.0, 0.0],
            duration,
            num_steps=5,
            num_proposals=4,
            proposal=proposal,
        )
        assert float(estimate.value) == pytest.approx(-1 / (2 * duration), rel=1e-3)
        assert 1 <= float(estimate.effective_sample_size) <= 4.001


@pytest.mark.slow
@pytest.mark.parametrize(("start", "found"), [(6.0, 0), (1.0, 200)])
def test_explosions_are_counted_and_never_returned(start, found):
    """The drift alone explodes in steps of one where |x| > √2."""
    cubic = jb.Diffusion(lambda x, p: -(x**3))
    weighted = jb.sample_weighted_bridges(
        jax.random.key(0), cubic, [start], [0.0], 20.0, num_bridges=200, num_steps=20,
        proposal=jb.ResidualBridge(),
    )  # fmt: skip
    assert int(weighted.met.sum()) == 200 - int(weighted.num_nonfinite) == found
    assert np.isnan(weighted.paths[~weighted.met]).all()
    assert np.isfinite(weighted.paths[weighted.met]).all()
    assert (np.isfinite(weighted.mean()) == (found > 0)).all()  # of none there is no mean


@slow
def test_defaults_agree_in_what_they_are_exact_for():
    """Fisher's identity: the mean score of bridges is that of p_T. By default bridges and the
    likelihood of paths are of second order both; bridges of the Euler scheme are not."""
    start, end, theta, duration = jnp.array([0.4]), jnp.array([1.5]), jnp.array(0.9), 1.0

    def model(theta):
        return jb.Diffusion(lambda x, p: -p * x, params=theta)

    def log_density(theta):
        variance = (1 - jnp.exp(-2 * theta * duration)) / (2 * theta)
        residual = end[0] - jnp.exp(-theta * duration) * start[0]
        return -(residual**2 / variance + jnp.log(variance)) / 2

    def score(path, times):
        return jax.grad(lambda p: jb.path_log_likelihood(model(p), times, path))(theta)

    errors = {}
    for density in (None, jb.EulerDensity()):
        bridges = jb.sample_weighted_bridges(
            jax.random.key(0), model(theta), start, end, duration,
            num_bridges=200_000, num_steps=6, proposal=jb.ModifiedDiffusionBridge(density),
        )  # fmt: skip
        each = lambda path, times=bridges.times: score(path, times)
        error = float(bridges.mean(each)) - float(jax.grad(log_density)(theta))
        errors[density] = error, float(bridges.standard_error(each))
    value, standard_error = errors[None]
    assert abs(value) < 5 * standard_error + 0.1 / 6**2
    assert abs(errors[jb.EulerDensity()][0]) > 5 * standard_error + 0.1 / 6**2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("proposal", "start", "end", "duration", "num_steps"),
    slow_beyond(
        1,
        [
            (proposal, *interval, num_steps)
            for proposal in (jb.Guided, jb.ModifiedDiffusionBridge)
            for interval in ((0.5, 0.8, 1.0), (0.3, 0.6, 2.0), (1.5, 0.2, 1.0))
            for num_steps in (10, 20)
        ],
    ),
)
def test_densities_of_a_square_root_process_are_of_second_order(
    proposal, start, end, duration, num_steps
):
    """Against the closed form: four times nearer than by the Euler scheme, and the step error
    explains what is left."""
    params = np.array([1.2, 0.5, 0.6])
    exact = float(cir.log_density(params, start, end, duration))
    errors = {}
    for density in (None, jb.EulerDensity()):
        estimate = jb.transition_log_density(
            jax.random.key(1), cir.model(params), [start], [end], duration,
            num_proposals=100_000, num_steps=num_steps, proposal=proposal(density=density),
        )  # fmt: skip
        errors[density] = float(estimate.value) - exact
        noise = 5 * np.hypot(estimate.standard_error, estimate.step_uncertainty)
        left = errors[density] - float(estimate.step_error)
        assert abs(left) < noise + abs(errors[density]) / 3
    _, euler = errors.values()
    assert abs(errors[None]) < abs(euler) / 4 + noise


@pytest.mark.slow
def test_a_law_selected_for_a_density_is_replaced_if_paths_are_given():
    """Quadratic steps have no inverse, so chains from a given path are of the Euler scheme."""
    arguments = (jax.random.key(0), BENT, jnp.array([0.3]), jnp.array([0.7]), 0.4)
    estimate = jb.transition_log_density(*arguments, num_proposals=3, num_steps=4, proposal="auto")
    path = jnp.linspace(0.3, 0.7, 5)[:, None]
    for single in (estimate.proposal.singles[0], jb.Guided()):
        drawn = jb.sample_exact_bridges(*arguments, num_steps=4, proposal=single, position=path)
        assert drawn.proposal.density == jb.EulerDensity()


@slow
def test_the_default_is_the_most_accurate_that_the_model_has():
    arguments = (jax.random.key(0), BENT, jnp.array([0.3]), jnp.array([0.7]), 0.4)
    made = jb.sample_weighted_bridges(*arguments, num_bridges=3, num_steps=4, proposal=jb.Guided())
    assert made.proposal.density == QuadraticDensity()
    ends = jnp.array([0.3, 0.0]), jnp.array([0.7, 0.1])
    made = jb.sample_weighted_bridges(
        jax.random.key(0), two_wells(), *ends, 0.4, num_bridges=3, num_steps=4, proposal=jb.Guided()
    )
    assert made.proposal.density == jb.ItoTaylorDensity()
