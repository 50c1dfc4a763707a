"""Transition densities and mid-points of bridges from Kolmogorov's equations, without the package.

In one or two dimensions the generator L f = b·∇f + ½ V:∇²f becomes a sparse matrix on a grid, and
exp(tL) is applied to point masses: from b for x ↦ p_{T/2}(x, b), transposed from a for
x ↦ p_{T/2}(a, x). Their product is p_T(a, b) times the density of the bridge at T/2.

- In space: central differences, of second order, in which the variance along an axis is raised to
  at least |drift| h, so that the matrix along the axes is that of a Markov chain. Point masses
  between nodes are those of interpolation of degree five. Three grids are extrapolated to h = 0.
- In time: the [4/5] Padé approximation of the exponential, which is of order nine and damps what
  is stiff.
"""

import functools
import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg

import jaxbridge as jb


class Bridge(NamedTuple):
    """log p_T(a, b), and the mean and sd (d,) of the bridge at T/2; each `error` is how much the
    coarsest grid matters."""

    log_density: float
    mean: np.ndarray
    sd: np.ndarray
    log_density_error: float
    mean_error: np.ndarray
    sd_error: np.ndarray


def solve(
    drift, covariance, start, end, duration, box, num_nodes, num_steps=12, levels=(1, 1.5, 2)
) -> Bridge:
    """Of the bridge from `start` to `end`, for functions of points (n, d) to b (n, d) and V
    (n, d, d), reflected at the sides of `box`, d pairs, with `num_nodes` on each axis of the
    coarsest grid."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    counts = np.broadcast_to(num_nodes, start.shape)
    values = np.array(
        [
            _on_grid(
                drift,
                covariance,
                start,
                end,
                duration,
                [
                    np.linspace(*side, round(level * (count - 1)) + 1)
                    for side, count in zip(box, counts, strict=True)
                ],
                num_steps,
            )
            for level in levels
        ]
    )
    spacings = 1 / np.array(levels)
    best, other = _at_zero(spacings**2, values), _at_zero(spacings[1:] ** 2, values[1:])
    error = np.abs(best - other)
    d = len(start)
    return Bridge(
        float(best[0]), best[1 : d + 1], best[d + 1 :], error[0], error[1 : d + 1], error[d + 1 :]
    )


def solve_model(model, start, end, duration, box, num_nodes, **options) -> Bridge:
    """The same of a `jb.Diffusion`, of which it uses the drift and σ."""

    def both(points):
        with jax.enable_x64(True):
            wide = jax.tree.map(_widen, model)
            b, sigma = jax.jit(jax.vmap(lambda x: (wide.drift(x), wide.diffusion(x))))(
                jnp.asarray(points, jnp.float64)
            )
        return np.asarray(b), np.asarray(sigma)

    def covariance(points):
        sigma = both(points)[1]
        return sigma @ sigma.swapaxes(-1, -2)

    return solve(lambda x: both(x)[0], covariance, start, end, duration, box, num_nodes, **options)


def bulk(log_density, points, drop=30.0, reach=6.0, num_nodes=200):
    """The box, d pairs, around where log ν is at most `drop` below that at the least likely of
    `points` (n, d), within `reach` of them. `log_density` maps (n, d) to (n,)."""
    points = np.asarray(points, float)
    least = np.min(log_density(points)) - drop
    axes = [
        np.linspace(low - reach, high + reach, num_nodes)
        for low, high in zip(points.min(0), points.max(0), strict=True)
    ]
    grid = np.stack([x.ravel() for x in np.meshgrid(*axes, indexing="ij")], axis=-1)
    inside = grid[log_density(grid) > least]
    return [
        (low - (axis[1] - axis[0]), high + (axis[1] - axis[0]))
        for low, high, axis in zip(inside.min(0), inside.max(0), axes, strict=True)
    ]


def _widen(leaf):
    return leaf.astype(float) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf


def _on_grid(drift, covariance, start, end, duration, axes, num_steps):
    """log p_T(a, b), means and sds, in one array."""
    grid = np.stack([x.ravel() for x in np.meshgrid(*axes, indexing="ij")], axis=-1)
    volume = math.prod(axis[1] - axis[0] for axis in axes)
    matrix = _generator(drift(grid), covariance(grid), axes)
    forward, backward = _exponential(matrix, duration / 2, num_steps)
    ahead = forward(_point_mass(axes, start)) / volume  # p_{T/2}(a, x)
    back = backward(_point_mass(axes, end)) / volume  # p_{T/2}(x, b)
    mass = ahead * back * volume
    density = mass.sum()
    mean = mass @ grid / density
    sd = np.sqrt(mass @ (grid - mean) ** 2 / density)
    return np.concatenate([[np.log(density)], mean, sd])


def _generator(drift, covariance, axes):
    """L on the nodes. What would leave the box stays."""
    shape = tuple(len(axis) for axis in axes)
    index = np.arange(math.prod(shape)).reshape(shape)
    spacing = [axis[1] - axis[0] for axis in axes]
    rows, columns, rates = [], [], []

    def add(shift, rate):
        """A rate from each node to the one `shift` away."""
        here = tuple(slice(max(0, -s), min(n, n - s)) for s, n in zip(shift, shape, strict=True))
        there = tuple(slice(max(0, s), min(n, n + s)) for s, n in zip(shift, shape, strict=True))
        rows.append(index[here].ravel())
        columns.append(index[there].ravel())
        rates.append(rate.reshape(shape)[here].ravel())

    for k, h in enumerate(spacing):
        b, v = drift[:, k], covariance[:, k, k]
        v = v * (1 + (b * h / v) ** 4) ** 0.25
        for sign in (-1, 1):
            shift = [0] * len(shape)
            shift[k] = sign
            add(shift, v / (2 * h**2) + sign * b / (2 * h))
    if len(shape) == 2:
        for s, t in itertools.product((-1, 1), repeat=2):
            add((s, t), s * t * covariance[:, 0, 1] / (4 * spacing[0] * spacing[1]))
    size = index.size
    matrix = sparse.coo_array(
        (np.concatenate(rates), (np.concatenate(rows), np.concatenate(columns))), (size, size)
    ).tocsc()
    return matrix - sparse.diags_array(matrix.sum(axis=1))


def _point_mass(axes, point):
    """A mass of one at `point` on the nodes: the weights of interpolation there."""
    weights = np.ones(1)
    for axis, x in zip(axes, point, strict=True):
        first = np.clip(np.searchsorted(axis, x) - 3, 0, len(axis) - 6)
        one = np.zeros(len(axis))
        one[first : first + 6] = _lagrange(axis[first : first + 6], x)
        weights = np.multiply.outer(weights, one)
    return weights.ravel()


def _lagrange(nodes, x):
    """The weights with which values at the nodes make that of their polynomial at x."""
    return np.array(
        [
            math.prod((x - other) / (node - other) for other in nodes if other != node)
            for node in nodes
        ]
    )


def _at_zero(x, values):
    return _lagrange(x, 0.0) @ values


@functools.cache
def _pade(degree=5):
    """Poles in the upper half plane, or real, and residues of the [degree-1/degree] Padé
    approximation of exp."""
    m, n = degree - 1, degree
    top = [math.comb(m, j) * math.factorial(m + n - j) for j in range(m + 1)]
    bottom = [(-1) ** j * math.comb(n, j) * math.factorial(m + n - j) for j in range(n + 1)]
    top, bottom = np.polynomial.Polynomial(top), np.polynomial.Polynomial(bottom)
    poles = bottom.roots()
    poles = poles[poles.imag > -1e-9]
    # The coefficients are those of exp up to one factor, which the two polynomials share.
    return poles, top(poles) / bottom.deriv()(poles)


def _exponential(matrix, time, num_steps):
    """Functions of a vector: exp(time·Lᵀ) and exp(time·L) of it."""
    poles, residues = _pade()
    step = time / num_steps
    identity = sparse.eye_array(matrix.shape[0], format="csc")
    factors = [sparse_linalg.splu((step * matrix - p * identity).tocsc()) for p in poles]
    counts = np.where(np.abs(poles.imag) < 1e-9, 1, 2)

    def apply(trans, vector):
        for _ in range(num_steps):
            vector = sum(
                (n * c * factor.solve(vector.astype(complex), trans)).real
                for n, c, factor in zip(counts, residues, factors, strict=True)
            )
        return vector

    return functools.partial(apply, "T"), functools.partial(apply, "N")


class ExactBridge(NamedTuple):
    """A bridge, with its log p_T(start, end), and its mean and sd at T/2."""

    model: jb.Diffusion
    start: np.ndarray
    end: np.ndarray
    duration: float
    log_density: float
    mean: np.ndarray
    sd: np.ndarray


MULLER_BROWN_BOX = ((-2.2, 1.5), (-0.9, 2.5))
_MULLER_BROWN_TERMS = [  # A, a, b, c, x₀, y₀
    (-200.0, -1.0, 0.0, -10.0, 1.0, 0.0),
    (-100.0, -1.0, 0.0, -10.0, 0.0, 0.5),
    (-170.0, -6.5, 11.0, -6.5, -0.5, 1.5),
    (15.0, 0.7, 0.6, 0.7, -1.0, 1.0),
]


def muller_brown_log_density(x, params):
    """-U/15, of the potential of Müller & Brown (1979)."""
    energy = 0.0
    for A, a, b, c, x0, y0 in _MULLER_BROWN_TERMS:
        u, v = x[0] - x0, x[1] - y0
        energy += A * jnp.exp(a * u**2 + b * u * v + c * v**2)
    return -energy / 15


def muller_brown(backwards=False):
    """The Langevin diffusion from its deepest well to the other deep one, for a duration of 2:
    results of `solve_model` on grids of up to 370 × 340, which other boxes change by 3e-4; or from
    the other to the deepest, with the same bridge in reverse."""
    start, end, log_density = np.array([-0.558, 1.442]), np.array([0.623, 0.028]), -3.0174
    if backwards:
        start, end, log_density = end, start, -0.4486
    return ExactBridge(
        jb.langevin(muller_brown_log_density),
        start,
        end,
        2.0,
        log_density,
        np.array([-0.2228, 0.6449]),
        np.array([0.5058, 0.5056]),
    )
