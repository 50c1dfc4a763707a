"""Small dense linear algebra in plain operations, for use inside compiled loops.

A path is simulated as a `lax.scan` over time of a step that is vmapped over thousands of
lanes. LAPACK calls in such a loop are slow, and on CPU batched ones can deadlock XLA's thread
pool. The matrices here are d × d with d the dimension of the diffusion, so elimination is
written out in elementwise operations: every function acts on one point and is vmapped.
"""

import functools
import operator

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


# Sums are written out up to this dimension: a reduction would be a kernel of its own.
_WRITTEN_OUT = 16


def dot(left: Float[Array, " d"], right: Float[Array, " d"]) -> Float[Array, ""]:
    """`left @ right`, written out so that it fuses with its neighbours under `vmap`."""
    if left.shape[0] > _WRITTEN_OUT:
        return jnp.sum(left * right)
    return functools.reduce(operator.add, [left[i] * right[i] for i in range(left.shape[0])])


def all_finite(vector: Float[Array, " d"]) -> Bool[Array, ""]:
    """Whether every coordinate is finite (up to overflow of their sum)."""
    return jnp.isfinite(dot(vector, jnp.ones_like(vector)))


def matvec(matrix: Float[Array, "n m"], vector: Float[Array, " m"]) -> Float[Array, " n"]:
    """`matrix @ vector`, written out."""
    if matrix.shape[0] > _WRITTEN_OUT:
        return jnp.matmul(matrix, vector, precision="highest")
    return jnp.stack([dot(matrix[i], vector) for i in range(matrix.shape[0])])


def matmul(left: Float[Array, "n k"], right: Float[Array, "k m"]) -> Float[Array, "n m"]:
    """`left @ right`, written out."""
    return jnp.stack([matvec(right.T, left[i]) for i in range(left.shape[0])])


def safe_norm(vector: Float[Array, " d"]) -> Float[Array, ""]:
    """|v| with a zero (not NaN) derivative at v = 0."""
    square = dot(vector, vector)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)


def solve(matrix: Float[Array, "d d"], right: Float[Array, "d *m"]) -> Float[Array, "d *m"]:
    """`matrix⁻¹ right` by Gaussian elimination with partial pivoting, unrolled.

    A singular matrix gives non-finite numbers, as a division by zero does.
    """
    d = matrix.shape[0]
    columns = right.reshape(d, -1)
    rows = [jnp.concatenate([matrix[i], columns[i]]) for i in range(d)]
    for k in range(d):
        for i in range(k + 1, d):  # one bubble pass brings the largest pivot to row k
            swap = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            rows[k], rows[i] = (
                jnp.where(swap, rows[i], rows[k]),
                jnp.where(swap, rows[k], rows[i]),
            )
        for i in range(k + 1, d):
            rows[i] = rows[i] - rows[i][k] / rows[k][k] * rows[k]
    solution: list = [None] * d
    for k in reversed(range(d)):
        known = sum((rows[k][j] * solution[j] for j in range(k + 1, d)), start=jnp.zeros(()))
        solution[k] = (rows[k][d:] - known) / rows[k][k]
    return jnp.stack(solution).reshape(right.shape)


def inverse(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """`matrix⁻¹`, unrolled."""
    return solve(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))


def cholesky(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """The lower triangular L with `L Lᵀ = matrix`, unrolled; NaN where there is none."""
    d = matrix.shape[0]
    entries = [[jnp.zeros_like(matrix[0, 0])] * d for _ in range(d)]
    for i in range(d):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= entries[i][k] * entries[j][k]
            entries[i][j] = jnp.sqrt(rest) if i == j else rest / entries[j][j]
    return jnp.stack([jnp.stack(row) for row in entries])


def polar_factor(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """The orthogonal matrix closest to `matrix` in the Frobenius norm: `U Vᵀ` of its
    singular value decomposition `U Σ Vᵀ`, differentiable wherever `matrix` is invertible.

    In two dimensions in closed form; otherwise by Newton's iteration
    `X ← (s X + X⁻ᵀ / s) / 2` (Higham 1986), where the scale s balances the norms of the two
    terms. Repeated singular values are no special case.
    """
    d = matrix.shape[0]
    if d == 1:
        return jnp.where(matrix < 0, -1, 1).astype(matrix.dtype)
    if d == 2:
        (a, b), (c, e) = matrix
        sign = jnp.where(a * e - b * c < 0, -1, 1).astype(matrix.dtype)
        p, q = a + sign * e, c - sign * b  # matrix + sign × cofactors = a multiple of a rotation
        length = safe_norm(jnp.stack([p, q]))
        p, q = p / length, q / length
        return jnp.stack([jnp.stack([p, -sign * q]), jnp.stack([q, sign * p])])
    factor = matrix
    for _ in range(_NEWTON_STEPS):
        inverse_transpose = inverse(factor).T
        scale = jnp.sqrt(jnp.sqrt(jnp.sum(inverse_transpose**2)) / jnp.sqrt(jnp.sum(factor**2)))
        factor = (scale * factor + inverse_transpose / scale) / 2
    return factor


# With this scaling a condition number of 1e8 is orthogonal to 1e-15 after nine steps.
_NEWTON_STEPS = 9
