"""Step errors against known ones, and what is said of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FULL_SIGMA, NON_REVERSIBLE, PAPER_B, slow_beyond
from test_step_density import EXPANSIONS, FROM, TO

import jaxbridge as jb
from jaxbridge.engine.verdict import Verdict
from jaxbridge.models.bridge_problem import Intervals
from jaxbridge.schemes.step_error import (
    UNKNOWN_SHARE,
    StepError,
    dominates,
    error_of_coupled_grids,
    error_of_log_mean,
    error_of_mean,
    relative_change,
    share_in_regime,
    share_of_order,
    step_faults,
)


@pytest.mark.parametrize("density", slow_beyond(1, EXPANSIONS.values()), ids=EXPANSIONS)
@pytest.mark.parametrize("refinement", slow_beyond(1, [1.0, 1.5]))
@pytest.mark.parametrize("curl", slow_beyond(1, [False, True]), ids=["gradient", "curl"])
def test_error_of_a_log_density(density, refinement, curl, x64):
    """Within a quarter of the true one, and its uncertainty. Of second order and with a curl the
    leading term is seen at 64 steps only: at 16 a half of the error is told."""
    B, sigma = (2 * NON_REVERSIBLE, FULL_SIGMA) if curl else (PAPER_B, np.eye(2))
    model = jb.ornstein_uhlenbeck(B, sigma=sigma)
    ends = jnp.array([0.785, 0.785]), jnp.array([-0.2, 0.4])
    exact = float(jb.ou_transition(model, ends[0], 1.0).log_density(ends[1]))
    estimate = jb.transition_log_density(
        jax.random.key(0), model, *ends, 1.0, num_proposals=128_000,
        num_steps=32 if density.order == 1 else 64 if curl else 16,
        proposal=jb.Guided(density=density, refinement=refinement),
    )  # fmt: skip
    error = float(estimate.value) - exact
    assert estimate.standard_error < 1e-6 * abs(error)
    noise = 5 * float(estimate.step_uncertainty)
    assert noise < abs(error)
    assert abs(float(estimate.step_error) - error) < 0.25 * abs(error) + noise
    assert estimate.step_error_dominates
    assert bool(estimate.trustworthy) is (abs(float(estimate.step_error)) < 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("num_steps", slow_beyond(1, [10, 9]))
@pytest.mark.parametrize(
    "proposal", slow_beyond(1, [jb.Guided(), jb.ModifiedDiffusionBridge(refinement=1.5)])
)
def test_error_where_sigma_varies(num_steps, proposal):
    """It is a share of the change by half as many steps, from paths of the same noise. The change
    agrees with a separate run of half as many steps, and has a smaller error."""
    model = jb.Diffusion(lambda x, p: -x, lambda x, p: 0.6 * jnp.sqrt(1 + x**2))
    ends, options = ([0.5], [-0.6], 1.0), dict(proposal=proposal)

    def estimate(key, steps, number):
        return jb.transition_log_density(
            jax.random.key(key), model, *ends, num_proposals=number, num_steps=steps, **options
        )

    fine = estimate(0, num_steps, 20_000)
    if num_steps % 2 == 0:
        coarse = estimate(1, num_steps // 2, 20_000)
        change, noise = (
            coarse.value - fine.value,
            np.hypot(coarse.standard_error, fine.standard_error),
        )
        told, doubt = (x / fine.step_share for x in (fine.step_error, fine.step_uncertainty))
        assert abs(told - change) < 5 * np.hypot(noise, doubt)
        assert doubt < noise
    else:  # the last step is left as it is: within the even grids beside it
        shares = [estimate(0, steps, 20_000) for steps in (num_steps - 1, num_steps + 1)]
        low, high = sorted(float(one.step_error) for one in shares)
        noise = 5 * float(fine.step_uncertainty)
        assert low - noise < fine.step_error < high + noise


def test_error_of_coupled_grids_counts_lost_paths():
    """A path that one grid has lost has no weight there and its weight on the other."""
    fine = jnp.log(jnp.array([[1.0, 2.0, 0.0, 3.0] * 10]))
    coarse = jnp.log(jnp.array([[2.0, 0.0, 1.0, 3.0] * 8 + 8 * [jnp.nan]]))
    error = error_of_coupled_grids(fine, coarse, jnp.ones(1), 9)
    weights, halved = (np.exp(np.asarray(x[0, :32], float)) for x in (fine, coarse))
    weights, halved = weights / weights.sum(), halved / halved.sum()
    bias = ((halved**2).sum() - (weights**2).sum()) / 2
    np.testing.assert_allclose(error.value, 9 / 8 * (np.log(6 / 6) + bias), atol=1e-6)
    spread = np.sqrt(((halved - weights) ** 2).sum())
    np.testing.assert_allclose(error.uncertainty, 9 / 8 * spread, rtol=1e-5)
    nothing = error_of_coupled_grids(fine, jnp.full_like(fine, jnp.nan), jnp.ones(1), 1)
    assert np.isnan(nothing.value).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("density", "method"), list(zip(EXPANSIONS.values(), ["weighted", "chain"], strict=True))
)
def test_error_of_a_mean(density, method, x64):
    """That of the mid-point, against the closed form."""
    model = jb.ornstein_uhlenbeck(2 * NON_REVERSIBLE, sigma=FULL_SIGMA)
    ends, num_steps = ([0.785, 0.785], [-0.2, 0.4]), {1: 64, 2: 16}[density.order]
    exact = jb.gaussian_bridge(model, *map(jnp.array, ends), 1.0, [0.5]).mean[0]
    middle = lambda path: path[num_steps // 2]
    options = {"num_steps": num_steps, "proposal": jb.Guided(density=density)}
    sample = jb.sample_weighted_bridges if method == "weighted" else jb.sample_exact_bridges
    made = sample(jax.random.key(0), model, *ends, 1.0, num_bridges=100_000, **options)
    error, told = made.mean(middle) - exact, made.step_error(middle)
    noise = made.standard_error(middle) + made.step_uncertainty(middle)
    assert np.all(np.abs(error - told) < 5 * noise + 0.5 * np.abs(told))


@pytest.mark.slow
def test_exact_transitions_have_none():
    model = jb.ornstein_uhlenbeck(PAPER_B)
    pairs = jb.Coupling(0.5, scheme=jb.GaussianTransition())
    estimate = jb.transition_log_density(
        jax.random.key(0), model, FROM, TO, 1.0, num_proposals=200, num_steps=10, proposal=pairs
    )
    assert estimate.step_error == 0 and estimate.step_uncertainty == 0
    assert not estimate.step_error_dominates


def test_of_one_step_nothing_is_known():
    estimate = jb.transition_log_density(
        jax.random.key(0), jb.ornstein_uhlenbeck(PAPER_B), FROM, TO, 0.1, num_proposals=100,
        num_steps=1, proposal=jb.Guided(density=jb.ItoTaylorDensity()),
    )  # fmt: skip
    assert np.isnan(estimate.step_error) and np.isnan(estimate.step_uncertainty)
    assert estimate.step_error_dominates and not estimate.trustworthy
    assert "num_steps" in estimate.why()


def test_share_of_what_half_as_many_steps_change():
    """An error c δ^p is c (2δ)^p with half as many."""
    for order in (1, 2, 3):
        assert share_of_order(order) * (0.2**order - 0.1**order) == pytest.approx(0.1**order)


def test_negligible_weights_do_not_hide_the_step_error():
    """A weight that underflows counts as little for half as many steps, unless D is as large."""
    rng = np.random.default_rng(0)
    log_w, h = jnp.asarray(rng.normal(size=(2, 200)), jnp.float32)
    D = jnp.asarray(0.1 * rng.normal(size=200), jnp.float32)
    one = jnp.asarray(1.0)
    with_one = [jnp.append(x, value) for x, value in ((log_w, -200), (D, 0), (h, 50))]
    for extra in (0, 199):
        made = error_of_mean(with_one[0], with_one[1].at[-1].set(extra), one, with_one[2])
        if extra == 0:
            expected = error_of_mean(log_w, D, one, h)
            np.testing.assert_allclose(made.value, expected.value, atol=1e-5)
            np.testing.assert_allclose(made.uncertainty, expected.uncertainty, rtol=1e-4)
        else:
            assert abs(made.value) > 0.05  # the path has much weight for half as many steps


def test_changes_are_those_of_weights_and_factors():
    rng = np.random.default_rng(0)
    log_w, D, h = (jnp.asarray(rng.normal(size=50)) for _ in range(3))
    D = D.at[40:].set(jnp.nan)
    w, factors = np.exp(log_w[:40]), np.exp(D[:40])
    share, one = jnp.asarray(1 / 3), jnp.asarray(1.0)
    error = error_of_log_mean(log_w, D, share)
    fine, coarse = (x / x.sum() for x in (w, w * factors))
    bias = ((coarse**2).sum() - (fine**2).sum()) / 2  # of the log of a mean by its variance
    change = np.log((w * factors).sum() / w.sum()) + bias
    np.testing.assert_allclose(error.value, change / 3, atol=1e-5)
    error = error_of_mean(log_w, D, one, h)
    change = np.average(h[:40], weights=w * factors) - np.average(h[:40], weights=w)
    np.testing.assert_allclose(error.value, change, atol=1e-5)
    assert np.isnan(error_of_log_mean(log_w, jnp.full(50, jnp.nan), share).value)
    assert error_of_log_mean(log_w, D, 0 * share).value == 0
    unknown = error_of_log_mean(log_w, D, jnp.asarray(UNKNOWN_SHARE))
    assert np.isnan(unknown.value) and unknown.uncertainty == np.inf
    assert dominates(unknown, one) and not Verdict(step_faults(unknown, one)).trustworthy


@pytest.mark.slow
def test_few_paths_do_not_bias_the_log_of_a_mean():
    """Of log-normal e^D with mean one nothing changes; of 30 of them the log of the mean is
    some .01 too small, and with half of its variance by a fifth of that or less."""
    rng, sd = np.random.default_rng(3), 0.7
    D = jnp.asarray(sd * rng.normal(size=(200_000, 30)) - sd**2 / 2)
    made = error_of_log_mean(jnp.zeros_like(D), D, jnp.ones(len(D)))
    assert np.std(made.value) / np.sqrt(len(D)) < 3.5e-4
    assert abs(float(np.mean(made.value))) < 2e-3
    plain = np.log(np.mean(np.exp(np.asarray(D, float)), axis=1))
    assert np.mean(plain) < -8e-3


@pytest.mark.slow
@pytest.mark.parametrize("held", slow_beyond(1, [True, False]))
def test_few_paths_do_not_bias_it_where_they_are_held_either(held):
    """Of weights and factors that are correlated; those that a chain holds are as likely as their
    mean is large."""
    rng, n, s, t, rho = np.random.default_rng(4), 30, 0.7, 0.4, -0.7
    z = rng.normal(size=(2, 300_000, n))
    log_w, D = s * z[0], t * (rho * z[0] + np.sqrt(1 - rho**2) * z[1])
    exact = t**2 / 2 + s * t * rho
    w = np.exp(log_w).mean(axis=1)
    likelihood = w / w.mean() if held else np.ones_like(w)

    def bias(made):
        return np.mean(likelihood * (np.asarray(made, float) - exact))

    told = error_of_log_mean(jnp.asarray(log_w), jnp.asarray(D), jnp.ones(len(D)), held)
    other = error_of_log_mean(jnp.asarray(log_w), jnp.asarray(D), jnp.ones(len(D)), not held)
    assert abs(bias(told.value)) < 1.5e-3 < 3e-3 < abs(bias(other.value))


def test_uncertainty_is_the_spread_of_repetitions():
    rng = np.random.default_rng(1)
    log_w = jnp.asarray(0.5 * rng.normal(size=(4000, 200)))
    h = jnp.asarray(rng.normal(size=(4000, 200))) + log_w
    D = 0.2 * h + 0.1 * jnp.asarray(rng.normal(size=h.shape))
    one = jnp.ones(4000)
    for error in (error_of_log_mean(log_w, D, one), error_of_mean(log_w, D, one, h)):
        spread = float(np.std(error.value))
        assert float(np.mean(error.uncertainty)) == pytest.approx(spread, rel=0.1)


@pytest.mark.parametrize(
    "value, uncertainty, standard_error, expected",
    [
        (0.5, 0.0, 1.0, False),
        (-1.5, 0.0, 1.0, True),
        (1.5, 1.0, 1.0, False),  # no more than twice its uncertainty
        (0.1, 4.0, 1.0, True),  # could be anything
        (np.nan, np.nan, 1.0, True),
        (0.0, np.inf, 1.0, True),
        (0.0, 0.0, 0.0, False),
        (0.5, 0.1, np.inf, False),
    ],
)
def test_when_step_errors_dominate(value, uncertainty, standard_error, expected):
    error = StepError(jnp.asarray(value), jnp.asarray(uncertainty))
    assert bool(dominates(error, jnp.asarray(standard_error))) is expected


@pytest.mark.parametrize(
    "value, uncertainty, sd, expected",
    [
        (0.04, 0.01, 1.0, "No fault was found"),  # too small to matter
        (0.04, 0.06, 1.0, "too uncertain"),
        (-0.2, 0.0, 1.0, "(`step_error`) exceeds the standard error"),
        (-0.2, 0.0, 10.0, "No fault was found"),  # in standard deviations
        (0.0, np.inf, 1.0, "(`step_uncertainty` is infinite)"),
        (np.nan, np.inf, 1.0, "longer than the relaxation time"),
        (np.nan, np.nan, 1.0, "(`step_error` is NaN)"),
    ],
)
def test_faults_are_step_errors_that_matter(value, uncertainty, sd, expected):
    """Beside no Monte Carlo error at all, as where a model is linear. One sentence says why."""
    error = StepError(jnp.asarray(value), jnp.asarray(uncertainty))
    for coupled in (False, True):
        why = Verdict(step_faults(error, jnp.asarray(0.0), sd, coupled=coupled)).why()
        assert expected in why and "\n" not in why
        has_scheme = coupled and ("exceeds the standard" in expected or "longer" in expected)
        assert ("SemiImplicit" in why) == has_scheme
        assert ("`extrapolate`" in why) == (coupled and np.isnan(value) and np.isinf(uncertainty))


def test_step_errors_are_reported_with_their_numbers():
    error = StepError(jnp.array([0.01, -0.2]), jnp.array([0.0, 0.012]))
    *_, large, uncertain = step_faults(error, jnp.asarray(0.1))
    why = Verdict((large.in_any(), uncertain.in_any())).why()
    assert why.endswith("Here the estimate is -0.2 ± 0.01, and the standard error 0.1.")


def test_large_step_errors_beside_larger_noise_are_no_fault():
    error = StepError(jnp.asarray(0.2), jnp.asarray(0.01))
    assert Verdict(step_faults(error, jnp.asarray(0.5))).trustworthy


def test_draws_that_half_as_many_steps_lose_are_missing_and_no_more():
    D = jnp.array([-jnp.inf, -1e20, -0.01, 0.0, 0.02, 3.0])
    made = relative_change(D, jnp.zeros(()))
    np.testing.assert_allclose(made, [-1, -1, np.expm1(-0.01), 0, 0.0202, 7.5], rtol=1e-5)


def test_steps_may_be_too_long_at_one_end_only():
    """From the centre of a law of heavy tails, where the relaxation time is 1/2, into a tail, and
    back: the change by half as many steps was .1 where the error was .7."""
    model = jb.Diffusion(lambda x, p: -2 * x / (1 + x**2))
    points = jnp.array([[0.0], [40.0], [40.0], [0.0]])
    intervals = Intervals(points, points[jnp.array([1, 0, 1, 0])], jnp.array([100.0] * 3 + [20.0]))
    share = share_in_regime(jnp.array([1.0, 1.0, 1.0, 1.0]), model.prepared(), intervals, 50)
    assert share.tolist() == [np.inf, np.inf, 1.0, 1.0]
    assert share_in_regime(jnp.zeros(4), model.prepared(), intervals, 50).tolist() == 4 * [0.0]


@pytest.mark.parametrize(
    "method",
    ["density", *(pytest.param(name, marks=pytest.mark.slow) for name in ("weighted", "chain"))],
)
def test_of_steps_beyond_the_relaxation_time_nothing_is_known(method):
    """Of four relaxation times the error is -32, and half as many steps change next to nothing."""
    model, ends, num_steps = jb.ornstein_uhlenbeck([[1.0]]), ([0.5], [0.3]), 20
    density = jb.ItoTaylorDensity()  # that of a linear model has no error
    options = {"num_steps": num_steps, "proposal": jb.Guided(density=density)}
    for steps, known in ((0.2, True), (4.02, False)):
        arguments = (jax.random.key(0), model, *ends, steps * num_steps)
        if method == "density":
            made = jb.transition_log_density(*arguments, num_proposals=500, **options)
            exact = jb.ou_transition(model, jnp.array(ends[0]), arguments[-1])
            error = float(made.value - exact.log_density(jnp.array(ends[1])))
            assert (abs(error) < 0.02) is known and (error < -30) is not known
            assert bool(made.trustworthy) is known
            doubt = made.step_uncertainty
        else:
            sample = jb.sample_weighted_bridges if method == "weighted" else jb.sample_exact_bridges
            made = sample(*arguments, num_bridges=500, **options)
            doubt = made.step_uncertainty(lambda path: path[num_steps // 2, 0])
        assert bool(np.isfinite(doubt)) is known
