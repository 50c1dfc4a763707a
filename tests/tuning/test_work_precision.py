"""What accuracy costs: the errors it reports, against closed forms and against made-up tables."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import paper_model

import jaxbridge as jb
from jaxbridge import plot
from jaxbridge.tuning.settings import Setting

KEY = jax.random.key(0)
ENDS = ([0.785, 0.785], [1.091, 1.091], 1.0)


@pytest.fixture(scope="module")
def euler():
    """The paper's unlikely bridge by Euler's scheme, approximate and weighted."""
    return jb.work_precision(
        KEY,
        paper_model(),
        *ENDS,
        proposals=[jb.Coupling(0.5, scheme=jb.Euler())],
        num_steps=(4, 8),
        methods=("approximate", "weights"),
        num_bridges=20_000,
        repeats=1,
        target=0.5,
    )


def by_method(result, method):
    return [setting for setting in result.settings if setting.method == method]


@pytest.mark.slow
def test_errors_are_told_apart(euler):
    assert euler.reference == "exact"
    for setting in euler.settings:
        # n draws of unit variance have a Monte Carlo error of n^{-1/2}, weighted ones a larger.
        assert setting.monte_carlo_error >= 0.8 * 20_000**-0.5
        assert setting.uncertainty >= setting.monte_carlo_error
        assert setting.effective_samples == pytest.approx(setting.monte_carlo_error**-2)
        assert setting.per_second == pytest.approx(setting.effective_samples / setting.seconds)
        assert setting.num_simulated > 20_000 and setting.compile_seconds > 0
    for setting in by_method(euler, "weights"):
        assert setting.method_error == 0 and setting.step_error == setting.error
    # The method's own error is a property of the bridge and γ: about 0.14 here, for all steps.
    approximate = by_method(euler, "approximate")
    assert len({setting.method_error for setting in approximate}) == 1
    assert abs(approximate[0].method_error - 0.139) < 5 * 0.006
    # The paper's Euler scheme, weighted: -0.25 and -0.14 sd with 6 and 10 steps.
    coarse, fine = by_method(euler, "weights")
    assert coarse.error > 0.3 > fine.error > 0.12


@pytest.mark.slow
def test_step_errors_of_euler_are_of_first_order(euler):
    orders = euler.orders()
    (weights,) = [order for curve, order in orders.items() if curve.startswith("weights")]
    assert abs(weights.order - 1) < 0.35 + 5 * weights.error


@pytest.mark.slow
def test_exact_transitions_have_hardly_a_step_error():
    result = jb.work_precision(
        KEY,
        paper_model(),
        *ENDS,
        proposals=[jb.Coupling(0.5, scheme=jb.GaussianTransition())],
        num_steps=(4,),
        methods=("weights", "density"),
        num_bridges=20_000,
        repeats=1,
    )
    weights, density = result.settings
    assert weights.error < 5 * weights.uncertainty + 0.03
    assert density.error < 5 * density.uncertainty + 0.12  # Heun's is 0.21 with so few steps


@pytest.mark.slow
def test_the_closed_form_serves_functions_of_the_path():
    result = jb.work_precision(
        KEY,
        paper_model(),
        *ENDS,
        proposals=[jb.Guided(density=jb.ItoTaylorDensity())],
        num_steps=(20,),
        methods=("weights",),
        num_bridges=20_000,
        save_at=[0.5],
        fn=lambda points: jnp.sum(points**2),
        repeats=1,
    )
    (setting,) = result.settings
    assert setting.scheme == "ItoTaylorDensity" and np.isnan(setting.gamma)
    assert result.reference == "1,000,000 draws of the exact law"
    assert setting.error < 5 * setting.uncertainty


@pytest.mark.slow
def test_other_models_have_a_finer_reference_with_its_own_error():
    result = jb.work_precision(
        KEY,
        jb.hyperbolic(0.8, 2),
        [0.0, 0.0],
        [0.4, 0.2],
        1.0,
        proposals=[jb.ModifiedDiffusionBridge()],
        num_steps=(4,),
        methods=("weights",),
        dtypes=("float32", "float64"),
        num_bridges=5_000,
        repeats=1,
    )
    assert "16 steps" in result.reference and "20,000 bridges" in result.reference
    single, double = result.settings
    assert (single.dtype, double.dtype) == ("float32", "float64")
    for setting in result.settings:
        assert setting.uncertainty > setting.monte_carlo_error
        assert setting.error < 5 * setting.uncertainty + 0.02


def made_up(num_steps, error, per_second, method="weights", uncertainty=1e-4):
    words = (method, "Coupling(0)", "Heun", "BrownianCrossing", 0.0, "float32", num_steps)
    errors = (error, uncertainty, error, uncertainty, 0.0, uncertainty)
    return Setting(*words, *errors, 1.0, 2.0, 100, per_second, per_second)


def table(*settings, target=None):
    return jb.WorkPrecision(tuple(settings), "exact", target)


def test_orders_are_fitted_to_what_can_be_told_from_noise():
    result = table(*(made_up(n, 3 * n**-2.0, 10.0) for n in (4, 8, 16)), made_up(512, 1e-4, 10.0))
    (order,) = result.orders().values()
    assert order.order == pytest.approx(2) and 0 < order.error < 0.02
    (unknown,) = table(made_up(4, 1e-4, 1.0), made_up(8, 1e-4, 1.0)).orders().values()
    assert np.isnan(unknown.order)


def test_the_cheapest_setting_pays_for_both_errors():
    coarse, fine = made_up(8, 0.0899, 1000.0), made_up(64, 0.0099, 100.0)
    result = table(coarse, fine, target=0.1)
    # The coarse one leaves √(0.1² - 0.09²) to chance, and is faster still.
    assert result.cheapest() is coarse
    assert coarse.seconds_for(0.1) == pytest.approx(1 / (0.1**2 - 0.09**2) / 1000)
    assert result.cheapest(0.091) is fine
    assert result.cheapest(0.05) is fine and result.cheapest(0.005) is None
    assert "costs" in result.statement() and "64 steps" in result.statement(0.05)
    assert "none of these settings" in result.statement(0.005)
    with pytest.raises(ValueError, match="needs a `target`"):
        table(coarse).cheapest()


def test_the_table_reads_well_and_exports():
    result = table(made_up(4, 0.1, 10.0), made_up(8, 0.03, 5.0), target=0.1)
    columns = result.as_dict()
    assert list(columns["num_steps"]) == [4, 8] and columns["error"].dtype == float
    assert set(columns) == set(Setting._fields)
    text = str(result)
    assert "order 1.74" in text and "reference: exact" in text and "costs" in text
    (line,) = plot.work_precision(result).get_legend_handles_labels()[1][:1]
    assert line in ("target", "weights, Coupling(0), Heun, BrownianCrossing, float32")


@pytest.mark.slow
def test_constants_of_one_precision_are_refused_before_anything_runs(unchecked):
    """NumPy's, which JAX takes for those of the precision in which it sees them first."""
    height = np.array([-2.0, -1.0])
    arguments = (KEY, [0.2], [0.5], 1.0)

    def run(log_density):
        key, *ends = arguments
        jb.work_precision(
            key,
            jb.langevin(log_density),
            *ends,
            proposals=[jb.ModifiedDiffusionBridge()],
            num_steps=(2,),
            methods=("weights",),
            dtypes=("float32", "float64"),
            num_bridges=50,
            reference_bridges=50,
            repeats=1,
        )

    with pytest.raises(TypeError, match=r"`jnp.asarray\(constant, x.dtype\)`, or give them"):
        run(lambda x, p: jnp.sum(height * jnp.exp(x[0] ** 2 * height * 0.1)) - x @ x)

    def cast(x, p):
        mine = jnp.asarray(height, x.dtype)
        return jnp.sum(mine * jnp.exp(x[0] ** 2 * mine * 0.1)) - x @ x

    run(cast)


@pytest.mark.slow
def test_bridges_that_are_not_found_are_counted():
    """Ends that no pair joins in so short a time."""
    (setting,) = jb.work_precision(
        KEY,
        paper_model(),
        [0.0, 0.0],
        [60.0, -60.0],
        0.01,
        proposals=[jb.Coupling(-1.0, jb.SignTest(), jb.Euler())],
        num_steps=(2,),
        methods=("weights",),
        num_bridges=3,
        repeats=1,
    ).settings
    assert setting.num_missing == 3
    assert np.isnan(setting.error) and setting.seconds_for(1.0) == np.inf


def test_ends_alone_leave_nothing_to_estimate(unchecked):
    with pytest.raises(ValueError, match="nothing to estimate"):
        jb.work_precision(KEY, paper_model(), *ENDS, num_steps=(4,), save_at=[0.0, 1.0])


@pytest.mark.slow
def test_two_grids_leave_less_of_a_step_error():
    """An Ornstein–Uhlenbeck process seen through sinh, σ(x) = √(1 + x²): the mid-point and the
    density, against closed forms, by one grid and by two."""
    ou = jb.ornstein_uhlenbeck([[1.0]])
    stretched = jb.transform(ou, jnp.sinh, jnp.arcsinh)
    start, end = (np.sinh([y]) for y in (0.3, 1.0))
    middle = jb.gaussian_bridge(ou, [0.3], [1.0], 1.0, [0.5])
    log_density = jb.ou_transition(ou, jnp.array([0.3]), 1.0).log_density(jnp.array([1.0]))
    made = jb.work_precision(
        KEY,
        stretched.model,
        start,
        end,
        1.0,
        proposals=[jb.ModifiedDiffusionBridge(jb.EulerDensity())],
        num_steps=(16,),
        methods=("weights", "extrapolated_weights", "density", "extrapolated_density"),
        num_bridges=100_000,
        fn=lambda path: jnp.arcsinh(path[0]),
        reference=(middle.mean[0], np.sqrt(middle.covariance[0, 0])),
        log_density=log_density - np.log(np.cosh(1.0)),
        repeats=1,
    )
    for name in ("weights", "density"):
        (one,), (two,) = by_method(made, name), by_method(made, f"extrapolated_{name}")
        assert one.step_error > 5 * one.step_uncertainty
        assert two.step_error < one.step_error / 2 + 3 * two.step_uncertainty
        # Twice the noise of the fine grid, and that of the coarse one.
        assert two.monte_carlo_error > 2 * one.monte_carlo_error
        assert two.num_simulated == 2 * one.num_simulated
