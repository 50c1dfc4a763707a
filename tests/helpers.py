"""Oracles and gates shared by the tests."""

import ast
import contextlib
import functools
import inspect
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.proposals.choice import Choice

# The process of section 3 of the paper.
PAPER_B = np.array([[1.5, 1.0], [1.0, 1.5]])
PAPER_CASES = {
    "likely": ([0.0, 0.0], [0.0, 0.0]),
    "unlikely": ([0.785, 0.785], [1.091, 1.091]),
    "very unlikely": ([2.0, -2.0], [3.0, -3.0]),
}


def paper_model():
    return jb.ornstein_uhlenbeck(jnp.asarray(PAPER_B))


def chosen_of(candidates, chosen, used):
    """A choice that was made without pilot runs."""
    unseen = jnp.full((len(candidates), len(chosen)), jnp.nan)
    return Choice(candidates, *4 * [unseen], chosen, used)


def run_program(program, deadline=240, num_devices=1, in_haste=False):
    """Run it in a process of its own, on CPU, as if that were several devices, within a deadline
    in seconds; `in_haste` without most of the compiler's optimisations."""
    command = [sys.executable, "-c", textwrap.dedent(program)]
    flags = f"--xla_force_host_platform_device_count={num_devices}"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    environment["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(in_haste))
    environment.pop("OPENBLAS_NUM_THREADS", None)  # which `conftest.py` sets
    subprocess.run(command, check=True, timeout=deadline, env=environment)


def assert_moments(samples, mean, covariance, num_sigma=5.0, mean_allowance=0.0):
    """Sample means and covariances within `num_sigma` standard errors of the exact ones.

    `samples` (n, d) are independent; standard errors are those of a normal law.
    `mean_allowance`, in exact standard deviations, is for a stated error of the method.
    """
    samples, mean, covariance = (np.asarray(a, float) for a in (samples, mean, covariance))
    n = len(samples)
    variance = np.diag(covariance)
    z = (samples.mean(0) - mean) / np.sqrt(variance)
    np.testing.assert_array_less(np.abs(z), num_sigma / np.sqrt(n) + mean_allowance)
    error = np.sqrt((np.outer(variance, variance) + covariance**2) / n)
    deviation = (np.cov(samples.T).reshape(covariance.shape) - covariance) / error
    np.testing.assert_array_less(np.abs(deviation), num_sigma + mean_allowance * np.sqrt(n))


def warped_model(model, forward, backward):
    """The diffusion `X = forward(Y)` for an Ornstein–Uhlenbeck Y, with `backward` the inverse
    of the smooth bijection `forward`: drift and σ by Itô's formula, log ν by the Jacobian.

    Its bridges are images of Gaussian bridges: an exact law for a full, state-dependent σ.
    """

    def coefficients(x, params):
        inner = model.with_params(params)
        y = backward(x)
        jacobian = jax.jacfwd(forward)(y)
        sigma = inner.diffusion(y)
        hessian = jax.jacfwd(jax.jacfwd(forward))(y)
        ito = jnp.einsum("ijk,jl,kl->i", hessian, sigma, sigma) / 2
        return jacobian @ inner.drift(y) + ito, jacobian @ sigma

    def log_stationary(x, params):
        _, log_determinant = log_abs_det_2x2(jax.jacfwd(backward)(x))
        return model.with_params(params).log_stationary(backward(x)) + log_determinant

    return jb.Diffusion(
        lambda x, p: coefficients(x, p)[0],
        lambda x, p: coefficients(x, p)[1],
        log_stationary,
        model.params,
        sample_stationary=lambda key, p: forward(model.with_params(p).sample_stationary(key)),
    )


def log_abs_det_2x2(matrix):
    determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    return jnp.sign(determinant), jnp.log(jnp.abs(determinant))


def turning_model():
    """σ(x) a rotation through full turns within the law's reach: as σσᵀ = I, the law is that of the
    Ornstein–Uhlenbeck process with B = I/2."""

    def turn(x, p):
        angle = 2 * x[0]
        return jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]])

    return jb.Diffusion(
        lambda x, p: -x / 2,
        turn,
        lambda x, p: -x @ x / 2 - float(np.log(2 * np.pi)),
        reversible=True,
        normalised=True,
    )


def swirl(y):
    """A bijection of the plane that turns each circle by its own angle."""
    angle = 0.7 * jnp.sqrt(1 + y @ y)
    return jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]]) @ y


def unswirl(x):
    angle = -0.7 * jnp.sqrt(1 + x @ x)
    return jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]]) @ x


def without_sampler(model, **options):
    """The same diffusion, whose stationary law is known as a density only."""
    return jb.Diffusion(
        lambda x, p: model.with_params(p).drift(x),
        None,
        lambda x, p: model.with_params(p).log_stationary(x),
        model.params,
        **options,
    )


def of_unknown_constant():
    """An Ornstein–Uhlenbeck process with a sampler, whose `log_stationary` has a constant of 7."""
    return jb.Diffusion(
        lambda x, p: -x,
        None,
        lambda x, p: 7 - x @ x,
        reversible=True,
        sample_stationary=lambda key, p: jax.random.normal(key, (1,)) / jnp.sqrt(2),
    )


def zeros_of(call):
    """Return what `call()` returns with zeros for its numbers: it is traced, not run."""
    like = eqx.filter_eval_shape(call)
    shaped = lambda leaf: hasattr(leaf, "dtype")
    with jax.ensure_compile_time_eval():  # wherever it is called for first
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if shaped(x) else x, like)


def loglog_slope(sizes, errors):
    """The exponent p of errors ∝ sizes^p."""
    return np.polyfit(np.log(sizes), np.log(errors), 1)[0]


@contextlib.contextmanager
def count_compilations():
    """A list that grows by one entry with each program XLA compiles inside the block."""
    compiled = []

    def listen(event, duration, **_):
        if event.endswith("backend_compile_duration"):
            compiled.append(duration)

    jax.effects_barrier()  # callbacks of programs before may compile, too
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield compiled
    finally:
        jax.monitoring.clear_event_listeners()


class ExactCase(NamedTuple):
    """A bridge whose law is known: that of `to_gaussian` of its mid-point, and its density."""

    model: jb.Diffusion
    start: list
    end: list
    duration: float
    num_steps: int
    gamma: float
    start_law: object
    allowance: float  # for the step error, of log p and in standard deviations
    to_gaussian: Callable
    mean: np.ndarray
    covariance: np.ndarray
    log_density: float

    @property
    def coupling(self):
        return jb.Coupling(self.gamma, start_law=self.start_law)

    def middle(self, paths):
        """The mid-points of paths (n, N+1, d), in the coordinates where they are Gaussian."""
        return np.asarray(jax.vmap(self.to_gaussian)(paths[:, self.num_steps // 2]))


def exact_case(
    model, start, end, duration, gamma, start_law=None, num_steps=40, allowance=0.015, warp=None
):
    """A bridge of an Ornstein–Uhlenbeck process, or of `warp` = (forward, backward) of one."""
    start, end = jnp.asarray(start, jnp.float32), jnp.asarray(end, jnp.float32)
    law = jb.gaussian_bridge(model, start, end, duration, [duration / 2])
    log_density = float(jb.ou_transition(model, start, duration).log_density(end))
    to_gaussian = lambda x: x
    if warp is not None:
        forward, to_gaussian = warp
        model, start, end = warped_model(model, *warp), forward(start), forward(end)
        log_density += float(log_abs_det_2x2(jax.jacfwd(to_gaussian)(end))[1])
    return ExactCase(
        model,
        start,
        end,
        duration,
        num_steps,
        gamma,
        start_law,
        allowance,
        to_gaussian,
        np.asarray(law.mean[0]),
        np.asarray(law.covariance[0]),
        log_density,
    )


NON_REVERSIBLE = np.array([[1.0, 1.5], [-1.0, 0.5]])
FIVE_DIMENSIONAL = np.eye(5) + 0.4 * (np.eye(5, k=1) - np.eye(5, k=-1)) + 0.2
FULL_SIGMA = np.array([[1.0, 0.3], [-0.2, 0.7]])


def exact_cases():
    """The bridges on which everything exact is tested."""
    unlikely, very_unlikely = PAPER_CASES["unlikely"], PAPER_CASES["very unlikely"]
    fitted = jb.GaussianLaw([1.5, -1.5], [[0.3, -0.12], [-0.12, 0.3]])
    one = jb.ornstein_uhlenbeck([[0.8]], [0.5], [[1.2]])
    two = jb.ornstein_uhlenbeck(NON_REVERSIBLE, [0.2, -0.1], FULL_SIGMA)
    five = jb.ornstein_uhlenbeck(FIVE_DIMENSIONAL)
    swirled = jb.ornstein_uhlenbeck(NON_REVERSIBLE)
    paper = paper_model()
    return {
        **{
            f"unlikely, gamma {gamma:g}": lambda gamma=gamma: exact_case(
                paper, *unlikely, 1.0, gamma
            )
            for gamma in (-1.0, 0.0, 0.5, 0.9)
        },
        "very unlikely": lambda: exact_case(paper, *very_unlikely, 1.0, 0.5, allowance=0.03),
        "very unlikely, fitted law": lambda: exact_case(
            paper, *very_unlikely, 1.0, 0.5, fitted, allowance=0.03
        ),
        "not reversible": lambda: exact_case(two, [0.8, -0.3], [-0.5, 0.4], 1.5, 0.3),
        "five dimensions": lambda: exact_case(five, 5 * [0.3], [-0.4, 0, 0, 0, 0.4], 2.0, 0.0),
        "one dimension": lambda: exact_case(one, [-0.5], [1.5], 1.0, 0.0),
        "swirled": lambda: exact_case(
            swirled,
            [0.8, -0.3],
            [-0.5, 0.4],
            1.5,
            0.3,
            num_steps=80,
            warp=(swirl, unswirl),
        ),
    }


def assert_weighted_moments(values, weights, mean, covariance, num_sigma=5.0, allowance=0.0):
    """Weighted means and covariances within `num_sigma` standard errors of the exact ones, for
    the effective sample size of the weights; `allowance` in exact standard deviations."""
    values, weights = np.asarray(values, float), np.asarray(weights, float)
    weights = weights / weights.sum()
    size = 1 / (weights**2).sum()
    sd = np.sqrt(np.diag(covariance))
    deviations = (values - mean) / sd
    correlation = covariance / np.outer(sd, sd)
    bias = weights @ deviations
    error = np.sqrt(weights**2 @ deviations**2)
    np.testing.assert_array_less(np.abs(bias), num_sigma * error + allowance)
    products = deviations[:, :, None] * deviations[:, None]
    difference = np.tensordot(weights, products, 1) - correlation
    error = np.sqrt(np.tensordot(weights**2, (products - correlation) ** 2, 1))
    np.testing.assert_array_less(np.abs(difference), num_sigma * error + allowance)
    return size


def assert_chain_moments(values, mean, covariance):
    """5 standard errors of batch means; batches are many times longer than the chain's memory."""
    values = np.asarray(values, float)
    sd = np.sqrt(np.diag(covariance))
    deviations = (values - mean) / sd
    products = deviations[:, :, None] * deviations[:, None]
    correlation = covariance / np.outer(sd, sd)
    for samples, exact in [(deviations, np.zeros(len(sd))), (products, correlation)]:
        batches = samples[: len(samples) // 50 * 50].reshape(50, -1, *samples.shape[1:]).mean(1)
        error = batches.std(0, ddof=1) / np.sqrt(50)
        np.testing.assert_array_less(np.abs(batches.mean(0) - exact), 5 * error)
        assert error.max() < 0.1


def assert_calls_fit(code):
    """The calls of functions of the package in this code fit their signatures."""
    calls = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Call)]
    names = [_names_of(node.func) for node in calls]
    assert any(name[:1] == ["jb"] for name in names)
    for node, (package, *path) in zip(calls, names, strict=True):
        if package != "jb":
            continue
        signature = inspect.signature(functools.reduce(getattr, path, jb))
        keywords = [keyword.arg for keyword in node.keywords]
        starred = None in keywords or any(isinstance(arg, ast.Starred) for arg in node.args)
        bind = signature.bind_partial if starred else signature.bind
        bind(*node.args, **{name: None for name in keywords if name is not None})


def _names_of(node):
    """The names in an expression such as `jb.plot.work_precision`, or one that is empty."""
    names = []
    while isinstance(node, ast.Attribute):
        names, node = [node.attr, *names], node.value
    return [node.id, *names] if isinstance(node, ast.Name) else [""]


def slow_cases(cases, everywhere):
    """Names of cases, of which those not in `everywhere` are marked as slow."""
    return [
        name if name in everywhere else pytest.param(name, marks=pytest.mark.slow) for name in cases
    ]


def slow_beyond(num, cases):
    """Cases of which those after the first `num` are marked as slow."""
    cases = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [
        pytest.param(*case, marks=[pytest.mark.slow] if i >= num else [])
        for i, case in enumerate(cases)
    ]
