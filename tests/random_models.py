"""Twelve models nobody has chosen, of one to three dimensions, each with a bridge.

Their log ν is a polynomial, bounded above, and exact; V is the identity, constant or full and
dependent on x, by its Cholesky root or another; and in the plane and in space most have a skew
part, so that they are not reversible.
"""

import functools
from typing import NamedTuple

import fokker_planck
import jax
import jax.numpy as jnp
import numpy as np

import jaxbridge as jb

COUNT = 12
_SIGMAS = ("identity", "constant", "cholesky", "turned")
_SKEWS = ("reversible", "skew", "skew field")


class RandomModel(NamedTuple):
    name: str
    model: jb.Diffusion
    start: np.ndarray
    end: np.ndarray
    duration: float


class Params(NamedTuple):
    """log ν = -(x-m)ᵀP(x-m) - Σ (w_iᵀx)⁴, and what makes V and the skew part."""

    centre: jax.Array
    precision: jax.Array
    quartic: jax.Array  # rows w_i
    variance: jax.Array
    direction: jax.Array  # W
    turn: jax.Array  # orthogonal
    skew: jax.Array


def log_density(x, p):
    gap = x - p.centre
    return -gap @ (p.precision @ gap) - jnp.sum((p.quartic @ x) ** 4)


def _constant(x, p):
    return p.variance


def _varying(x, p):
    """I + 0.3 tanh(Wx) tanh(Wx)ᵀ."""
    t = jnp.tanh(p.direction @ x)
    return jnp.eye(x.size, dtype=x.dtype) + 0.3 * jnp.outer(t, t)


def _turned_root(x, p):
    """A root of that V which is not triangular: (I + s ttᵀ)R, with s such that its square is V."""
    t = jnp.tanh(p.direction @ x)
    s = 0.3 / (1 + jnp.sqrt(1 + 0.3 * (t @ t)))
    return p.turn + s * jnp.outer(t, t @ p.turn)


def _skew(x, p):
    return p.skew


def _skew_field(x, p):
    return p.skew * (1 + 0.5 * jnp.sin(jnp.sum(x)))


@functools.cache
def random_models():
    """A tuple of `RandomModel`, always the same."""
    return tuple(_random_model(index) for index in range(COUNT))


def named(name):
    return next(model for model in random_models() if model.name == name)


def _random_model(index):
    rng = np.random.default_rng([2024, index])
    dim = 1 + index % 3
    shape = ("quadratic", "quartic")[rng.integers(2)]
    sigma = _SIGMAS[index // 3 % 4]
    skew = _SKEWS[index // 3 % 3] if dim > 1 else "reversible"
    params = _random_params(rng, dim, shape == "quartic")
    model = _model(sigma, skew, jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params))
    start, end = _draws(rng, params, 2)
    duration = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    name = f"{index}: {dim}d, {shape}, {sigma}, {skew}"
    return RandomModel(name, model, start, end, round(duration, 3))


def _random_params(rng, dim, is_quartic):
    def orthogonal():
        return np.linalg.qr(rng.normal(size=(dim, dim)))[0]

    # With a quartic part the quadratic one may push outwards: two wells or more.
    spectrum = rng.uniform(-0.5 if is_quartic else 0.2, 1.5, size=dim)
    basis = orthogonal()
    strength = rng.uniform(0.05, 0.6, size=dim) if is_quartic else np.zeros(dim)
    root = orthogonal() * rng.uniform(0.6, 1.3, size=dim)
    skew = rng.normal(size=(dim, dim))
    return Params(
        centre=rng.normal(size=dim),
        precision=(basis * spectrum) @ basis.T,
        quartic=strength[:, None] ** 0.25 * orthogonal(),
        variance=root @ root.T,
        direction=rng.normal(size=(dim, dim)),
        turn=orthogonal(),
        skew=skew - skew.T,
    )


def _model(sigma, skew, params):
    V = {"identity": None, "constant": _constant}.get(sigma, _varying)
    Q = {"reversible": None, "skew": _skew, "skew field": _skew_field}[skew]
    model = jb.stationary_diffusion(log_density, V, Q, params)
    if sigma != "turned":
        return model
    return jb.Diffusion(
        lambda x, p: model.with_params(p).drift(x),
        _turned_root,
        log_density,
        params,
        reverse_drift=None if Q is None else lambda x, p: model.with_params(p).reverse_drift(x),
        reversible=Q is None,
    )


def _draws(rng, params, count):
    """Of ν, by weights of normal proposals, rounded."""
    points = params.centre + 1.5 * rng.normal(size=(20_000, len(params.centre)))
    gaps = points - params.centre
    log_weights = (
        np.sum(gaps**2, 1) / (2 * 1.5**2)
        - np.einsum("ni,ij,nj->n", gaps, params.precision, gaps)
        - np.sum((points @ params.quartic.T) ** 4, 1)
    )
    weights = np.exp(log_weights - log_weights.max())
    chosen = rng.choice(len(points), size=count, p=weights / weights.sum())
    return np.round(points[chosen], 2)


def box(random):
    """Outside which its bridge hardly ever is."""

    def values(points):
        with jax.enable_x64(True):
            params = jax.tree.map(lambda x: x.astype(float), random.model.params)
            along = jax.jit(jax.vmap(log_density, (0, None)))
            return np.asarray(along(jnp.asarray(points), params))

    return fokker_planck.bulk(values, [random.start, random.end], drop=16.0)


def solve(random):
    """Its bridge by the Fokker–Planck equation, in at most two dimensions."""
    num_nodes = {1: 601, 2: 81}[len(random.start)]
    return fokker_planck.solve_model(
        random.model, random.start, random.end, random.duration, box(random), num_nodes
    )


# By `solve`: log p, and the mean at T/2. Its errors are below 1e-4, but 1e-3 for number 7.
EXACT = {
    "0: 1d, quadratic, identity, reversible": (-0.91284, [1.04989]),
    "1: 2d, quartic, identity, reversible": (-1.53726, [0.40442, 0.63783]),
    "7: 2d, quadratic, cholesky, skew field": (-4.06927, [1.51936, 0.97099]),
    "9: 1d, quadratic, turned, reversible": (-2.63394, [-0.29998]),
}
