"""The Cox–Ingersoll–Ross process dX = κ(θ - X) dt + σ√X dW, whose transitions are known."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import optimize, special, stats

import jaxbridge as jb

TRUTH = np.array([1.0, 0.5, 0.6])  # κ, θ, σ


def transition(params, start, duration):
    """`scale`, degrees of freedom and noncentrality: X_T is scale × noncentral χ²."""
    rate, level, sigma = params
    scale = -(sigma**2) * np.expm1(-rate * duration) / (4 * rate)
    return scale, 4 * rate * level / sigma**2, start * np.exp(-rate * duration) / scale


def log_density(params, start, end, duration, killed=False):
    """log p_T(start, end), for arrays of points and durations; `killed` for the process that ends
    where it reaches zero (a Bessel function of the opposite order).

    Through the exponentially scaled Bessel function, which stays finite where the noncentrality
    is large, that is for short gaps. (Its order is too small for its own overflow to matter.)
    """
    scale, freedom, noncentrality = transition(params, start, duration)
    x, order = end / scale, freedom / 2 - 1
    root = np.sqrt(x * noncentrality)
    bessel = np.log(special.ive(abs(order) if killed else order, root))
    gap = (np.sqrt(x) - np.sqrt(noncentrality)) ** 2 / 2
    return order / 2 * np.log(x / noncentrality) - gap + bessel - np.log(2 * scale)


def simulate(params, times, rng):
    """The stationary process at the times, exactly, shape (n, 1)."""
    rate, level, sigma = params
    x = [rng.gamma(2 * rate * level / sigma**2, sigma**2 / (2 * rate))]
    for gap in np.diff(times):
        scale, freedom, noncentrality = transition(params, x[-1], gap)
        x.append(scale * rng.noncentral_chisquare(freedom, noncentrality))
    return np.array(x)[:, None]


@functools.cache
def data(seed=0, num_intervals=300):
    """Times, with gaps from 0.05 to 4, and observations (n + 1, 1) at `TRUTH`."""
    rng = np.random.default_rng(seed)
    gaps = np.exp(rng.uniform(np.log(0.05), np.log(4.0), size=num_intervals))
    times = np.concatenate([[0.0], np.cumsum(gaps)])
    return times, simulate(TRUTH, times, rng)


def log_likelihood(params, times, observations):
    """Of the transitions."""
    x = observations[:, 0]
    return np.sum(log_density(params, x[:-1], x[1:], np.diff(times)))


class Fit(NamedTuple):
    params: np.ndarray
    sd: np.ndarray  # from the observed information
    covariance: np.ndarray
    log_likelihood: float


def fit(times, observations, start=TRUTH) -> Fit:
    """The exact maximum likelihood estimate of (κ, θ, σ)."""
    loss = lambda logs: -log_likelihood(np.exp(logs), times, observations)
    logs = _minimise(loss, np.log(start))
    params = np.exp(logs)
    information = _hessian(lambda p: -log_likelihood(p, times, observations), params)
    covariance = np.linalg.inv(information)
    return Fit(params, np.sqrt(np.diag(covariance)), covariance, -loss(logs))


def ridge(times, observations, ratios=(2.0, 1.6, 1.3, 1.0, 0.8)):
    """Parameters (n, 3), and log likelihoods (n,), of the best points with 2κθ = ratio × σ²: below
    a ratio of 1 the process touches 0."""
    points, values = [], []
    logs = np.log(fit(times, observations).params)
    for ratio in ratios:

        def complete(two, ratio=ratio):
            rate, sigma = two
            return np.exp([rate, np.log(ratio / 2) + 2 * sigma - rate, sigma])

        loss = lambda two, complete=complete: -log_likelihood(complete(two), times, observations)
        two = _minimise(loss, logs[[0, 2]])
        points.append(complete(two))
        values.append(-loss(two))
        logs = np.log(points[-1])
    return np.array(points), np.array(values)


def _minimise(loss, start):
    for method in ("Nelder-Mead", "BFGS"):
        start = optimize.minimize(loss, start, method=method).x
    return start


def _hessian(function, at):
    """By central differences of steps that suit second derivatives, extrapolated once."""

    def with_step(relative):
        steps = np.diag(relative * np.abs(at))
        return np.array(
            [
                [
                    (
                        function(at + u + v)
                        - function(at + u - v)
                        - function(at - u + v)
                        + function(at - u - v)
                    )
                    / (4 * u.sum() * v.sum())
                    for v in steps
                ]
                for u in steps
            ]
        )

    return (4 * with_step(2e-3) - with_step(4e-3)) / 3


def _drift(x, p):
    return p[0] * (p[1] - x)


def _diffusion(x, p):
    return p[2] * jnp.sqrt(x)


def _log_stationary(x, p):
    return jnp.sum((2 * p[0] * p[1] / p[2] ** 2 - 1) * jnp.log(x) - 2 * p[0] * x / p[2] ** 2)


def _inside(x, p):
    return jnp.all(x > 0)


def model(params=TRUTH):
    """On the half line, where it must stay; `params` is (κ, θ, σ)."""
    return jb.Diffusion(
        _drift,
        _diffusion,
        _log_stationary,
        tuple(float(p) for p in params),
        reversible=True,
        domain=_inside,
    )


def in_logarithms(params=TRUTH):
    return jb.transform(model(params), jnp.log, jnp.exp)


def in_roots(params=TRUTH, reach=8.0):
    """Of σ = 1: Y = 2 (√X - √θ)/σ."""
    return jb.lamperti(model(params), at=params[1], reach=reach)


def ncx2_log_density(params, start, end, duration):
    """log p_T as SciPy's distribution has it: for a check."""
    scale, freedom, noncentrality = transition(params, start, duration)
    return stats.ncx2.logpdf(end / scale, freedom, noncentrality) - np.log(scale)
