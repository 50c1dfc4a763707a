"""Bridges of a state-dependent σ: steps of weak order 2, against the exact law of a square root."""

import cir
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow_beyond

import jaxbridge as jb
from jaxbridge.schemes.step_density import QuadraticDensity

PARAMS = (1.0, 0.5, 0.9)  # 2κθ/σ² = 1.2, so paths come close to zero
INTERVALS = {"up": (0.5, 0.8, 1.0), "down": (1.5, 0.15, 1.0), "long": (0.3, 0.6, 2.0)}
MIDDLE = lambda path: jnp.stack([path[len(path) // 2, 0], jnp.log(path[len(path) // 2, 0])])


def sample(method, interval, num_steps=10, num_bridges=20_000, **options):
    start, end, duration = INTERVALS[interval]
    arguments = (jax.random.key(1), cir.model(PARAMS), [start], [end], duration)
    options = dict(num_steps=num_steps, num_bridges=num_bridges) | options
    if method == "weights":
        return jb.sample_weighted_bridges(*arguments, **options)
    return jb.sample_exact_bridges(*arguments, method=method, **options)


def exact_moments(interval):
    """Means and standard deviations of X and log X at the middle, by quadrature."""
    start, end, duration = INTERVALS[interval]
    x = np.exp(np.linspace(np.log(1e-5), np.log(8), 6001))
    halves = (np.full_like(x, start), x), (x, np.full_like(x, end))
    time, params = np.full_like(x, duration / 2), np.array(PARAMS)
    log_density = sum(cir.log_density(params, *half, time) for half in halves)
    weights = np.exp(log_density - log_density.max()) * x  # dx = x d(log x)
    weights /= weights.sum()
    values = np.stack([x, np.log(x)])
    mean = values @ weights
    return mean, np.sqrt((values - mean[:, None]) ** 2 @ weights)


def in_sds(made, interval):
    """The error of the means, its standard error, and the step error with its uncertainty."""
    mean, sd = exact_moments(interval)
    error, step = made.standard_error(MIDDLE), made.step_error(MIDDLE)
    values = (made.mean(MIDDLE) - mean, error, step, made.step_uncertainty(MIDDLE))
    return [np.asarray(value, float) / sd for value in values]


@pytest.mark.slow
@pytest.mark.parametrize("interval", slow_beyond(2, INTERVALS))
@pytest.mark.parametrize("method", slow_beyond(1, ["weights", "crank_nicolson"]))
def test_means_are_of_second_order_and_their_step_error_is_told(method, interval):
    """Of ten steps at most .07 standard deviations, where Euler steps are off by .1 to .2."""
    options = {"step_size": 0.9} if method == "crank_nicolson" else {}
    made = sample(method, interval, proposal=jb.Guided(), **options)
    off, error, told, doubt = in_sds(made, interval)
    assert made.proposal.density == QuadraticDensity()
    if np.all(np.isfinite(doubt)):  # half as many steps may be too few to compare
        # The leading term is most of the error.
        assert np.all(np.abs(off - told) < 5 * np.hypot(error, doubt) + np.abs(told) + 0.01)
    assert np.all(np.abs(off) < 5 * error + (0.07 if interval == "long" else 0.02))


@pytest.mark.slow
@pytest.mark.parametrize("interval", ["down", "long"])
def test_euler_steps_fail(interval):
    made = sample("weights", interval, proposal=jb.Guided(density=jb.EulerDensity()))
    off, error, *_ = in_sds(made, interval)
    assert abs(off[0]) > 5 * error[0] + 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "num_steps"), [("weights", 2), ("weights", 9), ("crank_nicolson", 16)]
)
def test_step_errors_of_means_are_those_of_separate_runs(method, num_steps):
    """Of the coarse paths' mean, against a run with half as many steps and other noise."""
    if num_steps % 2:  # the last step is as it is: between the even grids beside it
        changes = [sample(method, "up", n, proposal=jb.Guided()) for n in (8, 9, 10)]
        low, told, high = (float(made.step_error(MIDDLE)[0]) for made in changes)
        doubt = 5 * float(changes[1].step_uncertainty(MIDDLE)[0])
        assert min(low, high) - doubt < told < max(low, high) + doubt
        return
    last = lambda path: path[-1 - len(path) // 2, 0]  # the middle, which both grids have
    fine = sample(method, "up", num_steps, proposal=jb.Guided())
    told, doubt = (
        x / fine.step_share for x in (fine.step_error(last), fine.step_uncertainty(last))
    )
    if num_steps == 2:  # the coarse path has no points of its own, and another weight
        assert np.isfinite(told)
        return
    coarse = sample(method, "up", num_steps // 2, proposal=jb.Guided())
    change = float(coarse.mean(last) - fine.mean(last))
    noise = np.hypot(float(fine.standard_error(last)), float(coarse.standard_error(last)))
    assert abs(told - change) < 5 * np.hypot(noise, doubt)
    assert doubt < noise


@pytest.mark.slow
def test_stored_times_are_points_of_the_whole_paths():
    """And the parts of the split last step are no points of a path."""
    options = dict(num_steps=10, num_bridges=6, proposal=jb.Guided())
    whole = sample("weights", "up", **options)
    some = sample("weights", "up", **options, save_at=[0.0, 0.5, 1.0])
    assert whole.paths.shape == (6, 11, 1) and whole.coarse_paths.shape == (6, 11, 1)
    for name in ("paths", "coarse_paths"):
        rows = getattr(whole, name)[:, [0, 5, 10]]
        np.testing.assert_allclose(getattr(some, name), rows, rtol=1e-5)
    np.testing.assert_allclose(whole.paths[:, 0], 0.5)
    np.testing.assert_allclose(whole.coarse_paths[:, -1], 0.8, rtol=1e-6)
    chain = sample("crank_nicolson", "up", **options)
    assert chain.paths.shape == chain.coarse_paths.shape == (6, 11, 1)


@pytest.mark.slow
def test_given_paths_need_normal_steps():
    """The noise of a path is not unique if steps are quadratic in it."""
    options = dict(num_steps=4, num_bridges=3, proposal=jb.Guided())
    position = jnp.linspace(0.5, 0.8, 5)[:, None]
    for method in ("pseudo_marginal", "crank_nicolson"):
        chain = sample(method, "up", **options, position=position)
        assert chain.proposal.density == jb.EulerDensity()
        assert chain.coarse_paths is None


@pytest.mark.slow
def test_derivatives_of_weighted_means(x64):
    """Against differences of means with the same noise."""

    def mean(level):
        model = eqx.tree_at(lambda m: m.params[1], cir.model(PARAMS), level)
        made = jb.sample_weighted_bridges(
            jax.random.key(0), model, [0.5], [0.8], 1.0, num_steps=8, num_bridges=200,
            proposal=jb.Guided(),
        )  # fmt: skip
        return made.mean(lambda path: path[4, 0])

    slope = jax.grad(mean)(0.5)
    h = 1e-5
    np.testing.assert_allclose(slope, (mean(0.5 + h) - mean(0.5 - h)) / (2 * h), rtol=1e-6)


@pytest.mark.slow
def test_coordinates_of_coarse_paths_change_too():
    """Then step errors are those of functions of the new paths."""
    inner = jb.Diffusion(lambda x, p: -x, lambda x, p: 0.5 + 0.1 * jnp.tanh(x), reversible=True)
    map_ = jb.transform(inner, jnp.exp, jnp.log)
    made = jb.sample_weighted_bridges(
        jax.random.key(0), map_.model, map_.forward([0.1]), map_.forward([0.4]), 1.0,
        num_steps=8, num_bridges=100, proposal=jb.Guided(),
    )  # fmt: skip
    back = map_.back(made)
    np.testing.assert_allclose(
        back.step_error(lambda path: jnp.exp(path)), made.step_error(), atol=1e-6
    )
