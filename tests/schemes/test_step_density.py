"""Densities of steps: that they are densities, and the order of the error that they add up to
along a path, by quadrature and closed forms, without Monte Carlo."""

import fokker_planck
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from helpers import FULL_SIGMA, NON_REVERSIBLE, PAPER_B, loglog_slope
from scipy.stats import multivariate_normal

import jaxbridge as jb
from jaxbridge.models.linear import linear_transition
from jaxbridge.schemes import (
    QuadraticDensity,
    known_transition,
    most_accurate_density,
    with_transition,
)

DENSITIES = {
    "euler": jb.EulerDensity(),
    "ito_taylor": jb.ItoTaylorDensity(),
    "local_linear": jb.LocalLinearDensity(),
}
EXPANSIONS = {name: DENSITIES[name] for name in ("euler", "ito_taylor")}
J = np.array([[0.0, 1.0], [-1.0, 0.0]])


class Rotation:
    """α = κ|x|²Jx - |x|²x in any dimension, J antisymmetric, with its derivatives by hand."""

    def __init__(self, d, kappa=5.0, sigma=None):
        self.J = kappa * (np.eye(d, k=1) - np.eye(d, k=-1)) - np.eye(d)
        self.sigma = np.eye(d) if sigma is None else np.asarray(sigma)
        self.model = jb.Diffusion(self.drift, lambda x, p: jnp.asarray(self.sigma, x.dtype))

    def drift(self, x, params=None):
        return (x @ x) * (jnp.asarray(self.J, x.dtype) @ x)

    def moments(self, x, dt):
        """Mean and covariance of the Itô–Taylor step."""
        x, V, J = np.asarray(x, float), self.sigma @ self.sigma.T, self.J
        alpha = (x @ x) * (J @ x)
        G = (x @ x) * J + np.outer(J @ x, 2 * x)
        bend = J @ (2 * np.trace(V) * x + 4 * V @ x)  # tr V∇²α
        mean = x + dt * alpha + dt**2 / 2 * (G @ alpha + bend / 2)
        flow = G @ V
        return mean, dt * V + dt**2 / 2 * (flow + flow.T) + dt**3 / 3 * flow @ G.T


def step_law(density, model, x, dt):
    return density.steps_from(model.forward(x), x).law(jnp.asarray(dt, x.dtype))


@pytest.mark.parametrize("d", [1, 2, 3, 5])
@pytest.mark.parametrize("dt", [0.01, 0.3, 20.0])
def test_ito_taylor_step_is_normal_with_these_moments(d, dt, precision):
    """Of a superlinear drift with a full σ, by hand; the density is that of what is simulated, and
    so it integrates to one."""
    rng = np.random.default_rng(d)
    sigma = np.eye(d) + 0.3 * rng.normal(size=(d, d))
    rotation, x = Rotation(d, sigma=sigma), jnp.asarray(rng.normal(size=d))
    law = step_law(jb.ItoTaylorDensity(), rotation.model, x, dt)
    mean, covariance = rotation.moments(x, dt)
    tolerance = {"float32": 2e-3, "float64": 1e-9}[precision]
    scale = np.sqrt(np.diag(covariance))
    units = [law.point(jnp.asarray(unit, x.dtype)) - law.mean for unit in np.eye(d)]
    made = np.stack(units, axis=1)
    np.testing.assert_allclose(law.mean / scale, mean / scale, atol=tolerance, rtol=tolerance)
    np.testing.assert_allclose(
        made @ made.T / np.outer(scale, scale),
        covariance / np.outer(scale, scale),
        atol=tolerance,
    )
    xi = jnp.asarray(rng.normal(size=d))
    point = law.point(xi)
    np.testing.assert_allclose(law.noise(point), xi, rtol=tolerance, atol=10 * tolerance)
    expected = multivariate_normal(np.asarray(law.mean, float), covariance).logpdf(
        np.asarray(point, float)
    )
    np.testing.assert_allclose(law.log_density(point), expected, atol=20 * tolerance)
    np.testing.assert_allclose(
        law.log_relative_of_noise(xi), law.log_relative(point), rtol=tolerance, atol=20 * tolerance
    )


@pytest.mark.parametrize("density", DENSITIES.values(), ids=DENSITIES)
@pytest.mark.parametrize("dt", [0.1, 30.0])
@pytest.mark.parametrize("d", [1, 2])
def test_steps_integrate_to_one(density, dt, d, x64):
    """By quadrature over where they lead, also in steps out of all proportion."""
    rotation, x = Rotation(d), jnp.array([0.7, -1.1])[:d]
    law = step_law(density, rotation.model, x, dt)
    covariance = dt * np.asarray(law.matrix)
    root, nodes = np.linalg.cholesky(covariance), np.linspace(-9, 9, 91)
    grid = np.stack([g.ravel() for g in np.meshgrid(*d * [nodes])], axis=-1)
    points = np.asarray(law.mean) + grid @ root.T
    values = np.exp(np.asarray(jax.vmap(law.log_density)(jnp.asarray(points))))
    volume = (nodes[1] - nodes[0]) ** d * np.linalg.det(root)
    assert abs(values.sum() * volume - 1) < 1e-8


@pytest.mark.slow
def test_covariance_is_never_near_singular(x64):
    """S ≥ ¼ I, however long the step: equality where A is symmetric and δ = 3/2 of its rate."""
    d, rng = 3, np.random.default_rng(13)
    matrices = jnp.asarray([*rng.normal(size=(50, d, d)), -np.eye(d)])
    least = []
    for dt in (0.1, 1.5, 4.0, 1e3):
        for F in matrices:
            model = jb.Diffusion(lambda x, p, F=F: F @ x)
            law = step_law(jb.ItoTaylorDensity(), model, jnp.zeros(d), dt)
            least.append(np.linalg.eigvalsh(np.asarray(law.covariance))[0])
    assert abs(min(least) - 0.25) < 1e-9


@pytest.mark.parametrize("density", DENSITIES.values(), ids=DENSITIES)
def test_linear_step_is_the_step_of_a_linear_drift(density, precision):
    d, dt = 3, 0.4
    rng = np.random.default_rng(0)
    F, c, sigma = rng.normal(size=(d, d)), rng.normal(size=d), rng.normal(size=(d, d)) + np.eye(d)
    F, c, sigma, x, dt = (jnp.asarray(leaf) for leaf in (F, c, sigma, rng.normal(size=d), dt))
    model = jb.Diffusion(lambda x, p: c + F @ x, lambda x, p: sigma)
    steps = density.steps_from(model.forward(x), x)
    law, made = steps.law(dt), density.linear_step(F, sigma @ sigma.T, dt)
    tolerance = {"float32": 1e-5, "float64": 1e-12}[precision]
    S = law.covariance * jnp.eye(d) if law.covariance.ndim == 0 else law.covariance
    covariance = dt * sigma @ S @ sigma.T
    np.testing.assert_allclose(law.mean, made.decay @ x + made.integral @ c, rtol=tolerance * 10)
    np.testing.assert_allclose(covariance, made.covariance, rtol=10 * tolerance, atol=tolerance)
    decay = sigma @ steps.decay(dt) @ jnp.linalg.inv(sigma)
    np.testing.assert_allclose(decay, made.decay, rtol=10 * tolerance, atol=10 * tolerance)


FAST = np.array([[-40.0, 25.0], [-30.0, -60.0]])


@pytest.mark.parametrize("dt", [1e-4, 0.3, 5.0])
@pytest.mark.parametrize("columns", [2, 1])
def test_steps_of_linear_models_are_their_transitions(columns, dt, x64):
    """Of up to 250 relaxation times, and for noise in one coordinate only: by matrix exponentials
    and Lyapunov's equation."""
    sigma, c, x = np.array([[1.0, 0.4], [0.0, 0.7]])[:, :columns], np.array([3.0, -1.0]), [0.2, 0.5]
    model = jb.Diffusion(lambda x, p: jnp.array(c) + FAST @ x, jnp.array(sigma))
    density, x = most_accurate_density(model, jnp.array(x)), jnp.array(x)
    assert density.is_exact
    law = step_law(density, model, x, dt)
    flow = scipy.linalg.expm(FAST * dt)
    mean = flow @ x + np.linalg.solve(FAST, (flow - np.eye(2)) @ c)
    # e^{δF} times the integral of e^{-sF} V e^{-sFᵀ} would overflow: Γ solves Lyapunov's equation.
    rest = scipy.linalg.solve_continuous_lyapunov(FAST, -sigma @ sigma.T)
    covariance = rest - flow @ rest @ flow.T
    np.testing.assert_allclose(law.mean, mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(law.root @ law.root.T, covariance, rtol=1e-6)


def test_linear_drifts_are_recognised():
    like, matrix = jnp.zeros(2), jnp.array([[-2.0, 1.0], [0.5, -4.0]])
    for drift in (
        lambda x, p: matrix @ x + jnp.array([1.0, 2.0]),
        lambda x, p: p["rate"] * (jnp.stack([x[1], -x[0]]) - 0.5 * x),
        lambda x, p: jnp.array([x[1], -4 * x[0] - x[1] / 2]),
        lambda x, p: jnp.einsum("ij,j->i", matrix, x - jnp.mean(x)) - jnp.roll(x, 1),
        lambda x, p: jnp.where(p["rate"] > 0, -x, x),
        lambda x, p: jnp.ones(2),
    ):
        assert jb.Diffusion(drift, params={"rate": 1.0}).is_linear(like)


def test_steps_of_length_zero_do_not_move(x64):
    """As those that pad records of fewer observations."""
    model, x = jb.ornstein_uhlenbeck([[3.0]]), jnp.array([0.5])
    density = most_accurate_density(model, x)
    law = step_law(density, model, x, 0.0)
    assert law.mean == x and law.root == 0
    transition = known_transition(density, model.forward(x), x, jnp.asarray(0.0))
    assert density.linear_step(-3 * jnp.eye(1), jnp.eye(1), jnp.asarray(0.0)).decay == 1
    assert with_transition(density, transition).linear_step(None, None, None).decay == 1


@pytest.mark.parametrize("dt", [0.125, 0.01])
def test_noise_that_is_integrated_twice(dt):
    """In single precision, to a few roundings of each entry."""
    chain = jnp.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    noise = jnp.diag(jnp.array([0.0, 0.0, 1.0]))
    single = linear_transition(chain, noise, jnp.asarray(dt)).covariance
    with jax.enable_x64(True):
        double = linear_transition(*(jnp.asarray(a, float) for a in (chain, noise, dt))).covariance
    np.testing.assert_allclose(single, double, rtol=1e-5)


def test_steps_of_other_models_are_not_exact():
    like = jnp.zeros(1)
    for model in (
        jb.Diffusion(lambda x, p: -(x**3)),
        jb.Diffusion(lambda x, p: -x, lambda x, p: jnp.sqrt(1 + x**2)[:, None]),
        jb.Diffusion(lambda x, p, t: -t * x),
        # Derivatives that are zero where they exist.
        jb.Diffusion(lambda x, p: -jnp.sign(x)),
        jb.Diffusion(lambda x, p: jnp.where(x > 0, -1.0, 1.0)),
        jb.Diffusion(lambda x, p: -jnp.floor(x)),
        jb.Diffusion(lambda x, p: jnp.array([1.0, -1.0])[x.astype(int)]),
        jb.Diffusion(lambda x, p: jnp.ones(1), domain=lambda x, p: x[0] > 0),
    ):
        assert not most_accurate_density(model, like).is_exact


def test_local_linearisation_is_that_of_short_steps(x64):
    """Up to O(δ³) in the mean, for a curved drift and noise in one of two coordinates."""
    model, x, sizes = jb.fitzhugh_nagumo(), jnp.array([0.7, -0.4]), np.array([0.02, 0.01, 0.005])
    densities = jb.ItoTaylorDensity(), jb.LocalLinearDensity()
    laws = [[step_law(density, model, x, dt) for density in densities] for dt in sizes]
    means = [np.max(np.abs(taylor.mean - local.mean)) for taylor, local in laws]
    assert loglog_slope(sizes, means) > 2.8
    scales = [np.abs(local.root / taylor.root - 1)[np.tril_indices(2)] for taylor, local in laws]
    assert np.all(loglog_slope(sizes, np.max(scales, axis=1)) > 0.9) and np.max(scales[-1]) < 0.05


def test_local_linearisation_holds_where_drift_is_stiff(x64):
    """A step of eight relaxation times in a well, against Kolmogorov's equation."""
    model = jb.Diffusion(lambda x, p: 20 * (x - x**3), [3.0])
    start, end, dt = [0.8], [1.1], 0.2
    exact = fokker_planck.solve_model(model, start, end, dt, [(-3.0, 3.0)], 401).log_density
    end = jnp.array(end)
    error = {
        name: float(step_law(density, model, jnp.array(start), dt).log_density(end)) - exact
        for name, density in DENSITIES.items()
    }
    assert abs(error["local_linear"]) < 0.7
    assert abs(error["ito_taylor"]) > 1
    # On the barrier the drift expands, and the mean stays between the wells.
    law = step_law(jb.LocalLinearDensity(), model, jnp.array([0.1]), 0.1)
    assert abs(law.mean[0]) < 1


@pytest.mark.parametrize("density", EXPANSIONS.values(), ids=EXPANSIONS)
def test_linear_step_is_near_the_transition(density, x64):
    """Decay, integral and covariance, each to O(δ^(p+1)) in a step."""
    rng = np.random.default_rng(1)
    F, V = jnp.asarray(rng.normal(size=(3, 3))), jnp.asarray(np.diag([1.0, 0.5, 2.0]) + 0.1)
    sizes = np.array([0.04, 0.02, 0.01])
    exact = [linear_transition(F, V, jnp.asarray(dt)) for dt in sizes]
    made = [density.linear_step(F, V, jnp.asarray(dt)) for dt in sizes]
    for name in ("decay", "integral", "covariance"):
        pairs = [(getattr(e, name), getattr(m, name)) for e, m in zip(exact, made, strict=True)]
        errors = [np.abs(e - m).max() for e, m in pairs]
        assert abs(loglog_slope(sizes, errors) - (density.order + 1)) < 0.1


def log_density_of_chain(density, B, sigma, start, end, duration, num_steps, centre=0.0):
    """log p̂ of a chain of steps of dX = -B(X - centre) dt + σ dW, in closed form."""
    F, V, dt = jnp.asarray(-np.asarray(B)), jnp.asarray(sigma) @ jnp.asarray(sigma).T, duration
    step = density.linear_step(F, V, jnp.asarray(dt / num_steps))
    decay, covariance = np.asarray(step.decay), np.asarray(step.covariance)
    mean, spread = np.asarray(start, float) - centre, np.zeros_like(covariance)
    for _ in range(num_steps):
        mean, spread = decay @ mean, decay @ spread @ decay.T + covariance
    return multivariate_normal(mean + centre, spread).logpdf(np.asarray(end))


GRADIENT_2D = (PAPER_B, np.eye(2), [0.785, 0.785], [-0.2, 0.4], 1.0)
CURL_2D = (2 * NON_REVERSIBLE, FULL_SIGMA, [0.785, 0.785], [-0.2, 0.4], 1.0)
ONE_D = ([[0.8]], [[1.2]], [-0.5], [1.5], 1.0)


@pytest.mark.parametrize("density", EXPANSIONS.values(), ids=EXPANSIONS)
@pytest.mark.parametrize("case", [ONE_D, GRADIENT_2D, CURL_2D], ids=["1d", "gradient", "curl"])
def test_order_with_linear_drift(density, case, x64):
    B, sigma, start, end, duration = (np.asarray(leaf, float) for leaf in case)
    model = jb.ornstein_uhlenbeck(B, np.full(len(B), 0.1), sigma)
    exact = float(jb.ou_transition(model, start, duration).log_density(jnp.asarray(end)))
    sizes = np.array([64, 128, 256])
    errors = [log_density_of_chain(density, *case, int(size), centre=0.1) - exact for size in sizes]
    assert abs(loglog_slope(1 / sizes, np.abs(errors)) - density.order) < 0.2


FROM, TO = [0.5, 0.2], [-0.4, 0.6]


def rotating(decay, speed):
    return decay * np.eye(2) + speed * J


@pytest.mark.slow
@pytest.mark.parametrize(
    "decay, speed, duration, at_50, at_100",
    [(1.0, 2 * np.pi, 5.0, 0.10, 0.02), (0.5, 3.0, 10.0, 0.10, 0.02), (0.5, 3.0, 5.0, 0.02, 0.005)],
)
def test_long_bridges_of_fast_rotation(decay, speed, duration, at_50, at_100, x64):
    """Where a density that does not integrate to one gives infinity, or a factor of two: log p̂ of
    guided paths, all of one weight, is that of the chain, and near log p."""
    B = rotating(decay, speed)
    model = jb.ornstein_uhlenbeck(B)
    exact = float(jb.ou_transition(model, FROM, duration).log_density(jnp.asarray(TO)))
    for num_steps, bound in [(50, at_50), (100, at_100)]:
        estimate = jb.transition_log_density(
            jax.random.key(0), model, FROM, TO, duration, num_proposals=100, num_steps=num_steps,
            proposal=jb.Guided(density=jb.ItoTaylorDensity()),
        )  # fmt: skip
        chain = log_density_of_chain(
            jb.ItoTaylorDensity(), B, np.eye(2), FROM, TO, duration, num_steps
        )
        assert abs(float(estimate.value) - chain) < 1e-9
        assert estimate.standard_error < 1e-7
        assert abs(float(estimate.value) - exact) < bound


def quadrature(density, model, start, end, duration, num_steps, nodes):
    """log p̂ of the chain, by quadrature on a grid that has the points in every dimension."""
    d, width = len(start), nodes[1] - nodes[0]
    grid = jnp.asarray(np.stack([g.ravel() for g in np.meshgrid(*d * [nodes])], axis=-1))
    start, end = jnp.asarray(start), jnp.asarray(end)
    dynamics, dt = model.forward(start), jnp.asarray(duration / num_steps)

    def log_densities(x, points):
        return jax.vmap(density.steps_from(dynamics, x).law(dt).log_density)(points)

    between = np.exp(np.asarray(jax.jit(jax.vmap(log_densities, (0, None)))(grid, grid)))
    mass = np.exp(np.asarray(log_densities(start, grid)))
    for _ in range(num_steps - 2):
        mass = mass @ between * width**d
    last = np.exp(np.asarray(jax.vmap(log_densities, (0, None))(grid, end[None])))[:, 0]
    return np.log(mass @ last * width**d)


def assert_order(density, model, start, end, duration, exact, sizes, nodes, slack=0.25):
    errors = [
        quadrature(density, model, start, end, duration, int(size), nodes) - exact for size in sizes
    ]
    slope = loglog_slope(1 / np.array(sizes), np.abs(errors))
    assert abs(slope - density.order) < slack, (slope, errors)
    return errors


@pytest.mark.parametrize("density", DENSITIES.values(), ids=DENSITIES)
def test_order_in_a_double_well(density, x64):
    """In one dimension, against e^{-TH}, H being the Schrödinger operator of the process."""
    start, end, duration = -0.3, 1.0, 1.0

    def beta(x):
        return 2 * (x - x**3)

    def log_density(num_nodes):
        grid = np.linspace(-3.5, 3.5, num_nodes)
        width = grid[1] - grid[0]
        potential = (beta(grid) ** 2 + 2 * (1 - 3 * grid**2)) / 2
        diagonal, off = potential + 1 / width**2, np.full(len(grid) - 1, -0.5 / width**2)
        energies, states = scipy.linalg.eigh_tridiagonal(
            diagonal, off, select="v", select_range=(-10.0, 60.0)
        )
        i, j = (np.argmin(np.abs(grid - x)) for x in (start, end))
        kernel = (states[i] * np.exp(-duration * energies)) @ states[j] / width
        return np.log(kernel) + end**2 - end**4 / 2 - start**2 + start**4 / 2

    exact = (4 * log_density(1401) - log_density(701)) / 3
    model = jb.Diffusion(lambda x, p: beta(x))
    ends = [start], [end]
    nodes = np.linspace(-3.5, 3.5, 351)
    errors = assert_order(density, model, *ends, duration, exact, [32, 64, 128], nodes)
    assert abs(errors[-1]) < {1: 0.05, 2: 1e-3}[density.order]


def curled_well(curl):
    """A double well beside a quartic one, coupled, with a curl that grows outwards."""

    def drift(x, params):
        well = jnp.stack([1.2 * (x[0] - x[0] ** 3), -0.8 * x[1] - 0.3 * x[1] ** 3])
        coupled = 0.4 * jnp.stack([x[1], x[0]])
        return well + coupled + curl * (1 + x @ x / 4) * jnp.stack([x[1], -x[0]])

    return jb.Diffusion(drift)


@pytest.mark.slow
@pytest.mark.parametrize(
    "curl, start, end",
    [(0.0, [1.2, -0.3], [0.9, 0.5]), (2.0, [0.6, -0.3], [-0.4, 0.5])],
    ids=["gradient", "curl"],
)
def test_order_in_two_dimensions(curl, start, end, x64):
    """Against the Fokker–Planck equation on a grid."""
    model, duration = curled_well(curl), 1.0
    oracle = fokker_planck.solve_model(model, start, end, duration, 2 * [(-2.8, 2.8)], 49)
    nodes = np.linspace(-2.8, 2.8, 41)
    density = jb.ItoTaylorDensity()
    errors = assert_order(
        density, model, start, end, duration, oracle.log_density, [8, 16, 32], nodes, slack=0.3
    )
    assert oracle.log_density_error < 0.03 * abs(errors[-1])
    assert abs(errors[-1]) < 0.01


SUPERLINEAR = Rotation(2).model
PROPOSALS = {
    "mdb": lambda density: jb.ModifiedDiffusionBridge(density),
    "end": lambda density: jb.Guided("end", density),
    "path": lambda density: jb.Guided("path", density),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PROPOSALS)
def test_superlinear_rotation_is_finite_and_converges(name):
    """α = 5|x|²Jx - |x|²x, from where it turns fast: log p̂ is finite however long the steps, that
    of the chain, and tends to a limit at least as fast as its step error says. The weights are of
    heavy tails, and of fewer paths one may decide."""
    start, end, estimates = [1.0, 0.2], [-0.4, 0.6], {}
    for num_steps in (4, 25, 50):
        estimates[num_steps] = estimate = jb.transition_log_density(
            jax.random.key(1), SUPERLINEAR, start, end, 1.0, num_proposals=40_000,
            num_steps=num_steps, proposal=PROPOSALS[name](jb.ItoTaylorDensity()),
        )  # fmt: skip
        assert np.isfinite(estimate.value)
        assert estimate.num_met > 30_000
        known = np.isfinite(estimate.step_error)  # not of steps beyond the relaxation time
        assert not known or estimate.step_error < 2 * estimate.step_uncertainty
    if name == "mdb":
        assert not any(e.trustworthy for e in estimates.values())
        assert all(estimates[n].pareto_k > 0.7 for n in (25, 50))
        return
    with jax.enable_x64(True):
        nodes = np.linspace(-2.4, 2.4, 41)
        chain = quadrature(jb.ItoTaylorDensity(), SUPERLINEAR, start, end, 1.0, 25, nodes)
    assert abs(estimates[25].value - chain) < 5 * estimates[25].standard_error < 0.4
    coarse, fine = estimates[25], estimates[50]
    noise = np.hypot(coarse.standard_error, fine.standard_error) + coarse.step_uncertainty
    limit = fine.value - coarse.value + coarse.step_error
    assert abs(limit) < 5 * noise + 0.5 * abs(coarse.step_error)


@pytest.mark.slow
def test_guides_along_a_path_that_explodes_are_finite(precision):
    """In four steps the deterministic path of the superlinear rotation is off by 1e8."""
    estimate = jb.transition_log_density(
        jax.random.key(1), SUPERLINEAR, jnp.array([1.0, 0.2]), jnp.array([-0.4, 0.6]), 1.0,
        num_proposals=100, num_steps=4, proposal=jb.Guided("path", jb.ItoTaylorDensity()),
    )  # fmt: skip
    assert estimate.num_met == 100
    assert estimate.effective_sample_size > 5


def test_noise_that_grows_with_a_clock(x64):
    """dC = dt, dX = (1 + rC) dW, dY = X dt: var X = ∫ (1 + rs)² ds and, but for δ³ and beyond,
    cov(X, Y) = ½δ² and var Y = ⅓δ³."""
    rate, dt = 0.7, 0.1
    drift = lambda x, p: jnp.stack([jnp.ones(()), jnp.zeros(()), x[1]])
    sigma = lambda x, p: (1 + rate * x[0]) * jnp.array([[0.0], [1.0], [0.0]])
    x = jnp.array([0.0, 0.3, -0.2])
    dynamics = jb.Diffusion(drift, sigma).forward(x)
    law = jb.HypoellipticDensity().steps_from(dynamics, x).law(dt)
    covariance = np.asarray(law.root @ law.root.T)
    np.testing.assert_allclose(law.mean, [dt, 0.3, -0.2 + 0.3 * dt])
    assert covariance[0, 0] == 0
    bound = (rate * dt) ** 2  # by about which the growth of σ is bounded
    np.testing.assert_allclose(
        covariance[1, 1], ((1 + rate * dt) ** 3 - 1) / (3 * rate), rtol=rate * dt * bound
    )
    assert abs(covariance[1, 2] - dt**2 / 2) < rate * dt**3 / 2
    assert abs(covariance[2, 2] - dt**3 / 3) < rate * dt**4

    constant = jb.Diffusion(drift, sigma(x, None)).forward(x)
    each = [
        density.steps_from(constant, x).law(dt)
        for density in (jb.HypoellipticDensity(), jb.ItoTaylorDensity())
    ]
    np.testing.assert_array_equal(each[0].root, each[1].root)


@pytest.mark.slow
def test_noise_that_would_turn_round_within_a_step():
    """σ = q, which at such a speed is zero after half of a step: all of the state still moves."""
    model = jb.Diffusion(
        lambda x, p: jnp.stack([x[1], -x[0]]), lambda x, p: x[:1, None] * jnp.array([[0.0], [1.0]])
    )
    root = lambda x, dt: jb.HypoellipticDensity().steps_from(model.forward(x), x).law(dt).root
    for speed in (-10.0, -20.0):
        x = jnp.array([1.0, speed])
        assert np.all(np.diagonal(root(x, jnp.float32(0.1))) > 0)
        assert np.all(np.isfinite(jax.jacfwd(root, 1)(x, jnp.float32(0.0))))
    at_rest = jnp.array([0.0, 1.0])  # where there is no noise
    assert np.all(np.isfinite(jax.jacfwd(root)(at_rest, jnp.float32(0.1))))


def curved(d):
    """Drift and σ whose columns do not commute, and which no coordinates make constant."""

    def drift(x, p):
        return jnp.sin(x[::-1]) - x + 0.3 * x**2

    def sigma(x, p):
        turned = 0.3 * jnp.cos(jnp.arange(d, dtype=x.dtype)[:, None] + x)
        return turned + (1 + 0.4 * jnp.sin(x[::-1])) * jnp.eye(d)

    return drift, sigma


def generator(model, g):
    """L g = α·∇g + ½ tr(V ∇²g)."""

    def of(x):
        dynamics = model.forward(x)
        matrix = dynamics.sigma(x).as_matrix(len(x), x.dtype)
        return (
            dynamics.drift(x) @ jax.grad(g)(x) + jnp.vdot(matrix @ matrix.T, jax.hessian(g)(x)) / 2
        )

    return of


@pytest.mark.slow
@pytest.mark.parametrize("d", [1, 2, 3])
def test_quadratic_steps_are_of_weak_order_2(d, x64):
    """E g(x') = g + δLg + ½δ²L²g + O(δ³) for cubic and exponential g, by quadrature over the
    noise: an oracle that has no square root and no expansion of the step in it."""
    model, x = jb.Diffusion(*curved(d)), jnp.array([0.3, -0.4, 0.6])[:d]
    rng = np.random.default_rng(d)
    directions = jnp.asarray(rng.normal(size=(4, d)))
    tests = [
        *(lambda y, a=a: (a @ (y - 0.2)) ** 3 for a in directions[:2]),
        *(lambda y, a=a: jnp.exp(a @ y / 2) for a in directions[2:]),
        lambda y: y[0] * y[-1] * jnp.sum(y),
    ]
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    xi = np.stack([g.ravel() for g in np.meshgrid(*d * [nodes])], axis=-1)
    probability = np.prod(np.stack(np.meshgrid(*d * [weights / weights.sum()])), axis=0).ravel()
    steps = QuadraticDensity().steps_from(model.forward(x), x)
    sizes, errors = np.array([0.02, 0.01, 0.005]), []
    for dt in sizes:
        law = steps.law(jnp.asarray(dt))
        ends = jax.vmap(lambda noise, law=law: law.bent(law.point(noise)))(jnp.asarray(xi))
        first = [generator(model, g) for g in tests]
        second = [generator(model, Lg) for Lg in first]
        expected = [
            g(x) + dt * Lg(x) + dt**2 / 2 * LLg(x)
            for g, Lg, LLg in zip(tests, first, second, strict=True)
        ]
        errors.append(
            [probability @ jax.vmap(g)(ends) - e for g, e in zip(tests, expected, strict=True)]
        )
    slopes = [loglog_slope(sizes, np.abs(column)) for column in np.transpose(errors)]
    assert min(slopes) > 2.8, slopes


def test_quadratic_steps_depend_on_the_covariance_only(x64):
    """Another root of V, which turns with the state, gives the same law."""
    (drift, sigma), x = curved(2), jnp.array([0.3, -0.4])

    def turned(y, p):
        c, s = jnp.cos(3 * y[0]), jnp.sin(3 * y[0])
        return sigma(y, p) @ jnp.array([[c, -s], [s, c]])

    ours, theirs = (
        step_law(QuadraticDensity(), jb.Diffusion(drift, root), x, 0.1) for root in (sigma, turned)
    )
    for name in ("mean", "covariance", "curvature"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-12)


def test_quadratic_steps_are_for_weights_in_few_dimensions():
    """Memory grows as d³ and time as d⁴; and paths need steps with an inverse."""
    for d, normal_steps, expected in [(10, False, True), (11, False, False), (10, True, False)]:
        model, like = jb.Diffusion(lambda x, p: -x, lambda x, p: 1 + x**2), jnp.zeros(d)
        density = most_accurate_density(model, like, normal_steps)
        assert isinstance(density, QuadraticDensity if expected else jb.EulerDensity)


@pytest.mark.parametrize("dt", [0.0, 0.1, 2.0, 7.0, 1e3])
def test_quadratic_steps_have_a_positive_covariance(dt, x64):
    """S ≥ ¼ I also for a relaxation time of half a step, and a step of no length moves nothing."""
    sigma = lambda x, p: jnp.stack([jnp.ones_like(x[0]), 0.3 * x[1]])
    for rate in (1.0, 2 / max(dt, 0.1), 30.0):
        drift = lambda x, p, rate=rate: jnp.stack([-rate * x[0], 0.1 * x[1]])
        x = jnp.array([0.3, 0.8])
        law = step_law(QuadraticDensity(), jb.Diffusion(drift, sigma), x, dt)
        assert np.linalg.eigvalsh(np.asarray(law.covariance))[0] > 0.25 - 1e-9
        if dt == 0:
            np.testing.assert_array_equal(law.bent(x), x)


class Tempered(jb.AbstractStepDensity):
    """Euler's steps with a factor for the variance of each coordinate: a density of a user."""

    factors: jax.Array
    name: str

    order = 1

    def steps_from(self, dynamics, x):
        assert self.name == "tempered"
        steps = jb.EulerDensity().steps_from(dynamics, x)

        def law(dt):
            return steps.law(dt)._replace(covariance=jnp.diag(self.factors))

        return jb.StepsFrom(law, steps.decay)

    def linear_step(self, F, V, dt):
        return jb.EulerDensity().linear_step(F, V, dt)


@pytest.mark.slow
def test_step_densities_of_users_may_have_fields():
    """An array that is no array of lanes, and a name: factors of one give Euler's steps."""
    model = jb.Diffusion(lambda x, p: -x, lambda x, p: 1 + 0.3 * jnp.sin(x))
    times, values = np.arange(3) * 0.5, np.array([[0.1, 0.2], [0.3, 0.0], [-0.2, 0.1]])
    seen = {"observation": jb.LinearGaussian(covariance=0.1), "initial": [0.0, 0.0]}
    ends = jnp.zeros((3, 2)), 0.2 * jnp.ones((3, 2)), 0.4

    def numbers(density):
        options = {"num_steps": 4, "num_proposals": 20}
        proposal = jb.ModifiedDiffusionBridge(density)
        log_p = jb.transition_log_density(
            jax.random.key(0), model, *ends, **options, proposal=proposal
        )
        L = jb.log_likelihood(
            jax.random.key(0), model, times, values, **seen, num_steps=4, density=density
        )
        return jnp.append(log_p.value, L.value)

    tempered = Tempered(jnp.ones(2), "tempered")
    np.testing.assert_allclose(numbers(tempered), numbers(jb.EulerDensity()), atol=1e-5)
