"""Hard cases are numerically stable. Each test compares with an oracle or checks an invariant.

The decorator `hard` has the row of the test in the table of notebooks/hard_cases.md.
"""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from helpers import PAPER_B, paper_model, run_program, turning_model

import jaxbridge as jb
from jaxbridge.coupling.join import Inputs, propose
from jaxbridge.models.bridge_problem import Intervals

PAGE = pathlib.Path(__file__).parent.parent / "notebooks" / "hard_cases.md"
ROWS: list[tuple[str, str, str, str]] = []
# Where rounding is not what is hard.
in_single = pytest.mark.parametrize("precision", ["float32"], indirect=True)


def hard(case, plain, here):
    """Add a row to the table: case, failure of a plain implementation, behaviour here."""

    def keep(test):
        ROWS.append((case, plain, here, test.__name__))
        return test

    return keep


def table():
    lines = ["| case | plain implementation | here | test |", "|---|---|---|---|"]
    lines += [f"| {case} | {plain} | {here} | `{test}` |" for case, plain, here, test in ROWS]
    return "\n".join(lines)


def test_the_page_has_the_table():
    assert table() in PAGE.read_text(encoding="utf-8")


def all_finite(*trees):
    leaves = [leaf for leaf in jax.tree.leaves(trees) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return all(bool(jnp.isfinite(leaf).all()) for leaf in leaves)


def density_on_grid(drift, grid, start, duration):
    """p_T(start, ·) of dX = α(X) dt + dW on a grid, by the exponential of a generator of jumps
    between neighbours (Scharfetter–Gummel rates)."""
    h = grid[1] - grid[0]
    middle = (grid[1:] + grid[:-1]) / 2
    exponent = np.clip(2 * drift(middle) * h, -500, 500)
    bernoulli = np.where(np.abs(exponent) < 1e-8, 1.0, exponent / np.expm1(exponent))
    down, up = bernoulli / (2 * h**2), bernoulli * np.exp(exponent) / (2 * h**2)
    rates = np.diag(up, 1) + np.diag(down, -1)
    rates -= np.diag(rates.sum(1))
    row = scipy.linalg.expm(duration * rates)[np.abs(grid - start).argmin()]
    return row / h


# Meetings


@hard(
    "start equals end; start within 1e-7 of the reversed path; met at step 0",
    "0/0 in u = v/‖v‖ (v is the difference of the pair), and in its derivative",
    "u and its derivative are zero; index 0 counts as a meeting",
)
@pytest.mark.slow
@in_single
def test_pairs_that_have_met_before_they_start(precision):
    model, dtype = paper_model(), jnp.dtype(precision)
    coupling = jb.Coupling(0.5)
    end = jnp.zeros((2, 1), dtype)
    keys, duration = jax.random.split(jax.random.key(0), 1), jnp.ones(1, dtype)

    def joined(start):
        return propose(Inputs(model, coupling, Intervals(start, end, duration)), keys, 20)

    first = joined(end)
    for away in (0.0, 1e-7):
        again = joined(first.reverse_start + away)
        assert int(again.meeting_step[0]) == 1 and all_finite(again)

    def total(scale, start):
        scaled = model.with_params(jax.tree.map(lambda leaf: leaf * scale, model.params))
        bridges = jb.sample_bridges(
            jax.random.key(1), scaled, start, jnp.zeros(2, dtype), 1.0, num_bridges=50
        )
        return jnp.sum(bridges.paths)

    assert all_finite(jax.grad(total, argnums=(0, 1))(jnp.ones((), dtype), jnp.zeros(2, dtype)))
    bridges = jb.sample_bridges(
        jax.random.key(1), model, jnp.zeros(2, dtype), jnp.zeros(2, dtype), 1.0, num_bridges=200
    )
    weighted = jb.weigh_bridges(jax.random.key(2), model, bridges)
    assert bridges.met.all() and all_finite(bridges.paths, weighted.log_weights)


@hard(
    "γ = -1; γ = 1 - 1e-3; γ = 1 - 1e-6; γ = 1",
    "√(1-γ²) of a negative number, division by 1-γ = 0; an endless search",
    "paths are finite for every γ < 1; fewer pairs meet as γ → 1, and the search stops at "
    "`max_proposals`; γ = 1 raises an error",
)
@pytest.mark.slow
@in_single
def test_gamma_at_both_ends(precision, unchecked):
    dtype, acceptance = jnp.dtype(precision), []
    start, end = jnp.array([0.3, 0.3], dtype), jnp.array([0.4, 0.2], dtype)
    for gamma in (-1.0, 0.5, 1 - 1e-3, 1 - 1e-6):
        bridges = jb.sample_bridges(
            jax.random.key(0),
            paper_model(),
            start,
            end,
            1.0,
            num_bridges=20,
            coupling=jb.Coupling(gamma),
            max_proposals=20_000,
        )
        assert all_finite(bridges.paths[bridges.met]) and bridges.num_proposals <= 30_000
        assert bridges.num_nonfinite == 0
        acceptance.append(int(bridges.met.sum()) / int(bridges.num_proposals))
    assert acceptance[0] > 0.5 and (np.diff(acceptance[1:]) < 0).all()
    with pytest.raises(ValueError, match="gamma"):
        jb.Coupling(1.0)


# Unlikely bridges


@hard(
    "bridges 7 standard deviations out, (5, -5) → (6, -6), and 30, (10, 10) → (-10, -10)",
    "an endless search; weights that under- or overflow",
    "the right density from a fitted start law, or `met` is false after `max_proposals`; "
    "weights are stored as logarithms",
)
@pytest.mark.slow
@pytest.mark.optimised
@in_single
def test_very_unlikely_bridges(precision):
    model, dtype = paper_model(), jnp.dtype(precision)
    exact = lambda a, b: float(jb.ou_transition(model, a, 1.0).log_density(b))
    start, end = jnp.array([5.0, -5.0], dtype), jnp.array([6.0, -6.0], dtype)
    law = jb.fit_start_law(
        jax.random.key(0), model, start, end, 1.0, coupling=jb.Coupling(0.5), num_pilot=400
    )
    options = dict(num_proposals=10_000, num_steps=50)
    estimate = jb.transition_log_density(
        jax.random.key(1),
        model,
        start,
        end,
        1.0,
        proposal=jb.Coupling(0.5, start_law=law),
        **options,
    )
    error = float(estimate.standard_error)
    assert estimate.num_met > 0 and error < 0.2
    assert abs(float(estimate.value) - exact(start, end)) < 5 * error + 0.03
    # No pair crosses 28 standard deviations: that is said, not hidden.
    far = (jnp.array([10.0, 10.0], dtype), jnp.array([-10.0, -10.0], dtype))
    bridges = jb.sample_bridges(
        jax.random.key(0), model, *far, 1.0, num_bridges=5, max_proposals=1_000
    )
    assert not bridges.met.any() and np.isnan(bridges.paths).all()
    assert bridges.num_proposals <= 10_000
    missed = jb.transition_log_density(jax.random.key(1), model, *far, 1.0, **options)
    assert missed.value == -np.inf and missed.standard_error == np.inf and missed.num_met == 0
    # A linear guide knows the way: a log density of some -800.
    guided = jb.transition_log_density(
        jax.random.key(1),
        model,
        *far,
        1.0,
        num_proposals=500,
        num_steps=400,
        proposal=jb.Guided(density=jb.ItoTaylorDensity()),
    )
    assert exact(*far) < -500
    assert abs(float(guided.value) / exact(*far) - 1) < 1e-3


@hard(
    "T = 1000 in 50,000 steps",
    "sums of δ in float32 are wrong by several steps at the end; every step is stored",
    "times are i δ, computed from i; only requested times are stored",
)
@pytest.mark.slow
@pytest.mark.optimised
@pytest.mark.parametrize("model", [paper_model(), jb.hyperbolic(0.8, 2)], ids=["OU", "hyperbolic"])
def test_long_intervals(model):
    bridges = jb.sample_bridges(
        jax.random.key(0),
        model,
        [0.0, 0.0],
        [1.0, 0.0],
        1000.0,
        num_bridges=4,
        num_steps=50_000,
        save_at=jnp.linspace(0, 1000, 11),
    )
    assert bridges.met.all() and all_finite(bridges.paths)
    np.testing.assert_array_equal(bridges.times, np.linspace(0, 1000, 11, dtype=np.float32))
    np.testing.assert_array_equal(bridges.paths[:, -1], np.tile([1.0, 0.0], (4, 1)))
    assert (bridges.meeting_step < 5_000).all()


@hard(
    "T = 0.001",
    "pairs do not meet unless the end points are close: an endless search",
    "`met` is false after `max_proposals`, and `throw=True` names alternatives",
)
@in_single
def test_short_intervals(precision):
    dtype = jnp.dtype(precision)
    options = dict(num_bridges=2, num_steps=10, max_proposals=2_000)
    ends = (jnp.zeros(2, dtype), jnp.ones(2, dtype), 1e-3)
    bridges = jb.sample_bridges(jax.random.key(0), paper_model(), *ends, **options)
    assert not bridges.met.any() and bridges.num_proposals <= 4_000
    with pytest.raises(RuntimeError, match="ModifiedDiffusionBridge"):
        jb.sample_bridges(jax.random.key(0), paper_model(), *ends, throw=True, **options)


# Stiff and superlinear drift


@hard(
    "stiff drift: eigenvalues 0.5 and 500 at δ = 0.02",
    "explicit steps overflow",
    "with an explicit scheme paths are lost and counted in `num_nonfinite`; `SemiImplicit` "
    "and, for linear drift, `GaussianTransition` stay stable and give the right density",
)
@pytest.mark.slow
@in_single
def test_stiff_drift(precision):
    dtype = jnp.dtype(precision)
    model = jb.ornstein_uhlenbeck([[0.5, 0.0], [0.0, 500.0]])
    start, end = jnp.array([0.3, 0.02], dtype), jnp.array([0.8, -0.03], dtype)
    exact = jb.ou_transition(model, start, 1.0).log_density(end)
    bridges = lambda scheme: jb.sample_bridges(
        jax.random.key(0), model, start, end, 1.0,
        num_bridges=5, max_proposals=500, coupling=jb.Coupling(scheme=scheme),
    )  # fmt: skip
    assert bridges(None).met.all()  # exact steps by default
    explicit = bridges(jb.Heun())
    assert not explicit.met.any() and explicit.num_nonfinite > 0
    for scheme in (jb.SemiImplicit(), jb.GaussianTransition()):
        estimate = jb.transition_log_density(
            jax.random.key(1),
            model,
            start,
            end,
            1.0,
            num_proposals=20_000,
            num_steps=50,
            proposal=jb.Coupling(0.0, scheme=scheme),
        )
        error = float(estimate.standard_error)
        assert error < 0.1 and estimate.num_nonfinite == 0
        assert abs(float(estimate.value - exact)) < 5 * error + 0.01


TURN = np.array([[0.8, -0.6], [0.6, 0.8]])


def in_wells(x):
    """The coordinates in which a point moves in a double well for each, independently: a turn of
    the given ones if there are two."""
    return x if x.shape[0] == 1 else jnp.asarray(TURN, x.dtype) @ x


def wells_drift(x, p):
    y = in_wells(x)
    force = y - y**3
    return force if x.shape[0] == 1 else jnp.asarray(TURN.T, x.dtype) @ force


def log_wells(x, p):
    y = in_wells(x)
    return jnp.sum(y**2 - y**4 / 2 - jnp.asarray(p, x.dtype))


@hard(
    "superlinear drift: a double well, dX = (X - X³) dt + dW from 8, δ = 0.05, and a rotated "
    "quartic well in the plane",
    "explicit steps overflow from the first step",
    "lost paths are counted in `num_nonfinite`; `SemiImplicit` gives the density of the "
    "Fokker–Planck equation",
)
@pytest.mark.slow
@pytest.mark.parametrize("wells", [[8.0, 0.5], [[8.0, 0.5], [-0.8, -0.4]]], ids=["line", "plane"])
@in_single
def test_superlinear_drift(wells, precision):
    """`wells` are start and end in coordinates where the density is a product."""
    wells = np.atleast_2d(wells)
    d, dtype = len(wells), jnp.dtype(precision)
    grid = np.linspace(-4, 9, 1301)
    densities = [density_on_grid(lambda x: x - x**3, grid, start, 1.0) for start, _ in wells]
    exact = sum(
        np.log(np.interp(end, grid, density))
        for density, (_, end) in zip(densities, wells, strict=True)
    )
    log_mass = float(np.log(np.exp(grid**2 - grid**4 / 2).sum() * (grid[1] - grid[0])))
    model = jb.Diffusion(wells_drift, None, log_wells, log_mass, reversible=True, normalised=True)
    back = np.eye(1) if d == 1 else TURN.T
    start, end = (jnp.asarray(back @ point, dtype) for point in wells.T)
    options = dict(num_proposals=50_000, num_steps=20)
    law = jb.GaussianLaw(np.zeros(d), np.eye(d))

    def estimate(scheme):
        proposal = jb.Coupling(0.0, scheme=scheme, start_law=law)
        return jb.transition_log_density(
            jax.random.key(0), model, start, end, 1.0, proposal=proposal, **options
        )

    explicit, implicit = estimate(jb.Euler()), estimate(jb.SemiImplicit())
    assert int(explicit.num_nonfinite) > 0.9 * options["num_proposals"]
    assert implicit.num_nonfinite == 0 and implicit.standard_error < (0.06 if d == 1 else 0.1)
    assert abs(float(implicit.value) - exact) < 5 * float(implicit.standard_error) + 0.1


@hard(
    "a metastable double well over T = 50",
    "end points in different wells are reported as unreachable",
    "the share of bridges in either well half way is that of the Fokker–Planck equation",
)
@pytest.mark.slow
def test_metastable_double_well():
    barrier = 1.5
    slope = lambda x: 4 * barrier * x * (1 - x**2) / 2
    grid = np.linspace(-2.5, 2.5, 501)
    one, other = (density_on_grid(slope, grid, a, 25.0) for a in (-1.0, 1.0))
    nu = np.exp(-barrier * (grid**2 - 1) ** 2)
    # p(a, x) p(x, b), the latter by reversibility.
    middle = one * other * nu.max() / nu * (nu > 1e-12)
    right = middle[grid > 0].sum() / middle.sum()
    model = jb.Diffusion(
        lambda x, p: 2 * barrier * x * (1 - x**2),
        None,
        lambda x, p: -jnp.sum(barrier * (x**2 - 1) ** 2),
        reversible=True,
    )
    weighted = jb.sample_weighted_bridges(
        jax.random.key(0),
        model,
        [-1.0],
        [1.0],
        50.0,
        num_bridges=4_000,
        num_steps=1_000,
        save_at=[25.0],
        proposal=jb.Coupling(0.0, scheme=jb.SemiImplicit()),
    )
    share = weighted.mean(lambda path: (path[0, 0] > 0).astype(path.dtype))
    error = 0.5 / np.sqrt(float(weighted.effective_sample_size))
    assert abs(float(share) - right) < 5 * error + 0.01


# σ


@hard(
    "nearly singular σ: condition number 1e6, and correlation 0.9999",
    "V = σσᵀ squares the condition number, beyond float32",
    "only systems with σ are solved, never with V; densities agree with the closed form",
)
@pytest.mark.slow
@pytest.mark.parametrize(
    "mixing",
    [np.diag([1.0, 1e-6]), np.array([[1.0, 0.0], [0.9999, 0.014]])],
    ids=["scales", "correlation"],
)
@pytest.mark.optimised
@in_single
def test_nearly_singular_sigma(mixing, precision):
    """The paper's process in other linear coordinates."""
    dtype = jnp.dtype(precision)
    B = mixing @ PAPER_B @ np.linalg.inv(mixing)
    model = jb.ornstein_uhlenbeck(jnp.asarray(B, dtype), sigma=mixing)
    ends = [jnp.asarray(mixing @ np.array(x), dtype) for x in ([0.3, -0.2], [0.5, 0.4])]
    exact = jb.ou_transition(paper_model(), jnp.array([0.3, -0.2]), 1.0).log_density(
        jnp.array([0.5, 0.4])
    ) - np.log(np.linalg.det(mixing))
    for proposal in (jb.Coupling(0.5), jb.ModifiedDiffusionBridge(jb.ItoTaylorDensity())):
        estimate = jb.transition_log_density(
            jax.random.key(0), model, *ends, 1.0, num_proposals=20_000, proposal=proposal
        )
        error = float(estimate.standard_error)
        assert error < 0.03
        assert abs(float(estimate.value - exact)) < 5 * error + 0.01


@hard(
    "σ(x) a rotation through full turns: repeated singular values",
    "the polar factor by singular vectors jumps, with infinite derivatives",
    "the rotation of the pair is σ(x')ᵀσ(x), without singular vectors; bridges have the "
    "Ornstein–Uhlenbeck law",
)
@pytest.mark.slow
@in_single
def test_rotating_sigma(precision):
    dtype, model = jnp.dtype(precision), turning_model()
    start, end = jnp.array([0.3, -0.2], dtype), jnp.array([-0.5, 0.4], dtype)
    plain = jb.ornstein_uhlenbeck(0.5 * jnp.eye(2))
    exact = jb.ou_transition(plain, start, 2.0).log_density(end)
    estimate = jb.transition_log_density(
        jax.random.key(0),
        model,
        start,
        end,
        2.0,
        num_proposals=10_000,
        num_steps=200,
        proposal=jb.Coupling(0.5, scheme=jb.Heun()),
    )
    error = float(estimate.standard_error)
    assert error < 0.05
    assert abs(float(estimate.value - exact)) < 5 * error + 0.05


# Stationary densities


def uniform(x, p):
    return jnp.zeros((), x.dtype)


def student(x, p):
    return -2.5 * jnp.log1p(x @ x / 3)


def laplace(x, p):
    return -jnp.sum(jnp.abs(x))


def half_plane(x, p):
    return jnp.where(x[0] > -3, -x @ x, -jnp.inf)


@hard(
    "log ν flat, with heavy tails, with a kink, -∞ outside, and at 10⁴ standard deviations",
    "ν underflows, ∇ν/ν is 0/0",
    "only ∇log ν is used; a path is lost where it is not finite",
)
@pytest.mark.parametrize(
    "log_density",
    [student, *(pytest.param(f, marks=pytest.mark.slow) for f in (uniform, laplace, half_plane))],
)
@in_single
def test_unusual_stationary_densities(log_density, precision):
    dtype = jnp.dtype(precision)
    model = jb.langevin(log_density)
    bridges = jb.sample_bridges(
        jax.random.key(0),
        model,
        jnp.zeros(2, dtype),
        jnp.array([0.5, -0.5], dtype),
        2.0,
        num_bridges=100,
        max_proposals=20_000,
    )
    assert all_finite(bridges.paths[bridges.met])
    assert log_density is uniform or bridges.met.all()
    far = jnp.full(2, 1e4, dtype)
    assert all_finite(jb.langevin(lambda x, p: -x @ x / 2).reverse_drift(far))


# Dimensions


@pytest.mark.optimised
@hard(
    "d = 50",
    "matrices of d×d numbers and their O(d³) products, although σ = I needs none",
    "with σ = I memory grows as d; laws and meeting probabilities are those of the closed form",
)
@pytest.mark.slow
@in_single
def test_dimensions(precision):
    d = 50
    model, dtype = jb.ornstein_uhlenbeck(jnp.eye(d)), jnp.dtype(precision)
    check_meetings(model, d, dtype)
    check_memory(model, d, dtype)
    start, end = jnp.full(d, 0.2, dtype), jnp.full(d, -0.1, dtype)
    weighted = jb.sample_weighted_bridges(
        jax.random.key(0),
        model,
        start,
        end,
        3.0,
        num_bridges=2_000,
        num_steps=60,
        proposal=jb.Coupling(-1.0, scheme=jb.Heun()),
        save_at=[1.5],
    )
    exact = jb.gaussian_bridge(model, start, end, 3.0, times=[1.5])
    size = float(weighted.effective_sample_size)
    assert size > 100 and not weighted.truncated.any()
    bias = (weighted.mean()[0] - exact.mean[0]) / jnp.sqrt(jnp.diagonal(exact.covariance[0]))
    assert float(jnp.abs(bias).max()) < 5 / np.sqrt(size)


def check_meetings(model, d, dtype):
    """Ends drawn from ν make the reversed path a stationary one, whose distance from the driven
    path, started at zero, is for γ = -1 an Ornstein–Uhlenbeck process dR = -R dt + 2 dW: it comes
    to zero by time T with probability 2Φ(-R_0 / √(2(e^{2T} - 1)))."""
    n, duration = 10_000, 2.0
    key, keys = jax.random.key(3), jax.random.split(jax.random.key(4), n)
    end = jax.random.normal(key, (d, n), dtype) * 0.5**0.5
    num_steps = 40
    intervals = Intervals(jnp.zeros((d, n), dtype), end, jnp.full(n, duration, dtype))
    coupling = jb.Coupling(-1.0, scheme=jb.Heun())
    found = propose(Inputs(model, coupling, intervals), keys, num_steps)
    distance = scipy.stats.chi(d, scale=0.5**0.5)
    exact = distance.expect(
        lambda r: 2 * scipy.stats.norm.cdf(-r / np.sqrt(2 * np.expm1(2 * duration)))
    )
    share = float(jnp.mean(found.meeting_step <= num_steps))
    assert abs(share - exact) < 5 * np.sqrt(exact * (1 - exact) / n) + 0.002  # the step error


def check_memory(model, d, dtype):
    """What a compiled search takes beside its result: some numbers for each coordinate, step and
    proposal of a batch."""
    n, num_steps = 1_000, 50

    def run(end):
        return jb.sample_bridges(
            jax.random.key(0),
            model,
            jnp.zeros(d, dtype),
            end,
            2.0,
            num_bridges=n,
            num_steps=num_steps,
            batch_size=n,
        ).paths

    memory = jax.jit(run).lower(jnp.zeros(d, dtype)).compile().memory_analysis()
    paths = n * (num_steps + 1) * d * dtype.itemsize
    assert memory.temp_size_in_bytes < 8 * paths + 2**20


@hard(
    "a drift that is mostly rotation, eigenvalues 0.1 ± 20i",
    "the path turns once in 15 steps, so symmetric formulas for the reversal fail",
    "the reverse drift, computed from log ν, rotates in the opposite direction; the density "
    "is that of the closed form",
)
@pytest.mark.slow
@in_single
def test_rotation_dominated_drift(precision):
    dtype = jnp.dtype(precision)
    model = jb.ornstein_uhlenbeck([[0.1, 20.0], [-20.0, 0.1]])
    start, end = jnp.array([1.0, 0.5], dtype), jnp.array([-0.5, 1.5], dtype)
    estimate = jb.transition_log_density(
        jax.random.key(0),
        model,
        start,
        end,
        2.0,
        num_proposals=20_000,
        num_steps=100,
        proposal=jb.Coupling(0.0, scheme=jb.GaussianTransition()),
    )
    exact = jb.ou_transition(model, start, 2.0).log_density(end)
    assert estimate.standard_error < 0.05
    assert abs(float(estimate.value - exact)) < 5 * float(estimate.standard_error)


# Counts, parameters, determinism


@hard(
    "bridges that 100,000 trials do not hit; all proposals missed; one accepted",
    "a geometric count that never ends; division by no hits",
    "`max_trials` bounds the work and sets `truncated`; weights stay finite",
)
@pytest.mark.slow
def test_extreme_counts():
    model, ends = paper_model(), ([3.6, -3.6], [4.0, -4.0], 1.0)
    bridges = jb.sample_bridges(
        jax.random.key(0), model, *ends, num_bridges=3, coupling=jb.Coupling(0.5)
    )
    assert bridges.met.all()
    weighted = jb.weigh_bridges(jax.random.key(1), model, bridges, max_trials=1_000)
    assert weighted.truncated.all() and all_finite(weighted.log_weights, weighted.mean())
    with pytest.raises(RuntimeError, match="max_trials"):
        jb.weigh_bridges(jax.random.key(1), model, bridges, max_trials=5, throw=True)
    nothing = jb.sample_bridges(
        jax.random.key(0), model, [9.0, 9.0], [-9.0, -9.0], 0.1, num_bridges=3, max_proposals=50
    )
    empty = jb.weigh_bridges(jax.random.key(1), model, nothing)
    assert not empty.met.any() and empty.effective_sample_size == 0
    assert all_finite(empty.weights) and (empty.log_weights == -np.inf).all()
    single = jb.sample_bridges(jax.random.key(0), model, [0.0, 0.0], [0.1, 0.0], 1.0, num_bridges=1)
    one = jb.weigh_bridges(jax.random.key(1), model, single)
    assert one.weights[0] == 1 and one.effective_sample_size == 1


@hard(
    "parameters that are not finite, inside `jit`",
    "NaN paths that look like results",
    "no pair meets, and all proposals are counted in `num_nonfinite`; `throw=True` raises an error",
)
@pytest.mark.slow
def test_parameters_that_are_not_finite():
    def run(alpha, throw):
        return jb.sample_bridges(
            jax.random.key(0),
            jb.hyperbolic(alpha, 2),
            [0.0, 0.0],
            [1.0, 0.0],
            1.0,
            num_bridges=3,
            max_proposals=100,
            throw=throw,
        )

    bridges = jax.jit(lambda alpha: run(alpha, False))(jnp.nan)
    assert not bridges.met.any() and bridges.num_nonfinite == bridges.num_proposals
    with pytest.raises(RuntimeError, match="parameters of the model are not finite"):
        jax.block_until_ready(jax.jit(lambda alpha: run(alpha, True))(jnp.nan))
    density = jax.jit(
        lambda alpha: jb.transition_log_density(
            jax.random.key(0), jb.hyperbolic(alpha, 2), [0.0, 0.0], [1.0, 0.0], 1.0
        )
    )(jnp.nan)
    assert density.value == -np.inf and density.num_met == 0


@hard(
    "the same key with and without `jit`, and in other batches",
    "different numbers",
    "the same numbers up to rounding, because each path has its own key",
)
@pytest.mark.slow
def test_the_same_key_gives_the_same_numbers():
    def run(batch_size=None):
        return jb.sample_bridges(
            jax.random.key(0),
            paper_model(),
            [0.0, 0.0],
            [1.0, 0.0],
            1.0,
            num_bridges=50,
            batch_size=batch_size,
        ).paths

    plain = run()
    np.testing.assert_allclose(jax.jit(run)(), plain, atol=1e-5)
    for batch_size in (7, 64):
        np.testing.assert_allclose(run(batch_size), plain, atol=1e-5)


@hard(
    "60,000 lanes with a full σ(x), d = 6",
    "batched LAPACK calls inside a scan deadlock XLA's thread pool on CPU",
    "no LAPACK call in any loop; elimination and polar iterations instead",
)
@pytest.mark.slow
def test_no_deadlock():
    """Sampler, counts, weights and Gibbs in a process of their own, with a deadline."""
    run_program(
        """
        import jax, jax.numpy as jnp, jaxbridge as jb
        d, n = 6, 60_000
        mix = lambda x: jnp.eye(d) + 0.1 * jnp.sin(x)[:, None] * jnp.cos(x)
        model = jb.Diffusion(
            lambda x, p: -p * x, lambda x, p: mix(x), lambda x, p: -x @ x, 1.0, reversible=True
        )
        zero = jnp.zeros(d)
        law = jb.Stationary(burn_in=3.0)
        coupling = jb.Coupling(0.0, scheme=jb.Euler(), start_law=law)
        bridges = jb.sample_bridges(
            jax.random.key(0), model, zero, zero, 1.0, num_bridges=n, num_steps=2,
            batch_size=n, coupling=coupling, max_proposals=2 * n,
        )
        weighted = jb.weigh_bridges(
            jax.random.key(1), model, bridges, max_trials=2, batch_size=n
        )
        times = jnp.linspace(0, 6, 7)
        path = jax.random.normal(jax.random.key(2), (7, d)) / 2
        posterior = jb.gibbs(
            jax.random.key(3), model, times, path, prior=jb.NormalPrior(1.0, 1.0),
            proposal=coupling, num_iterations=3, num_steps=2,
        )
        jax.block_until_ready((weighted, posterior))
        """,
        deadline=580,
    )
