"""Small dense linear algebra in plain operations, for use inside compiled loops.

A path is simulated as a `lax.scan` over time of a step that is vmapped over thousands of
lanes. LAPACK calls in such a loop are slow, and on CPU batched ones can deadlock XLA's thread
pool. The matrices here are d × d with d the dimension of the diffusion, so elimination is
written out in elementwise operations: every function acts on one point and is vmapped.
"""

import functools
import operator

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float


def dot(left: Float[Array, " d"], right: Float[Array, " d"]) -> Float[Array, ""]:
    """`left @ right`."""
    return _sum([left[i] * right[i] for i in range(left.shape[0])])


# Squares of larger numbers overflow in float32. A path that is further out has exploded, and it
# shall have in float64 as well.
_EXPLODED = 1e18


def is_finite(values: Float[Array, "*shape"]) -> Bool[Array, "*shape"]:
    """Whether numbers are such as a path that did not explode can have."""
    return jnp.abs(values) < _EXPLODED


def all_finite(vector: Float[Array, " d"]) -> Bool[Array, ""]:
    """Whether all are, of one point."""
    return is_finite(_sum([jnp.abs(x) for x in vector]))


def total(terms: Float[Array, "d *shape"]) -> Float[Array, "*shape"]:
    """The sum along the first axis."""
    return _sum([terms[i] for i in range(terms.shape[0])])


def log_of_product(numbers: list[Float[Array, ""]]) -> Float[Array, ""]:
    """The log of the product of positive numbers, by few logarithms; NaN if one is not positive."""
    groups = [numbers[i : i + _FACTORS] for i in range(0, len(numbers), _FACTORS)]
    value = _sum([jnp.log(functools.reduce(operator.mul, group)) for group in groups])
    return jnp.where(functools.reduce(jnp.minimum, numbers) > 0, value, jnp.nan)


# Of so many the product of numbers near one does not overflow.
_FACTORS = 4


def matvec(matrix: Float[Array, "n m"], vector: Float[Array, " m"]) -> Float[Array, " n"]:
    """`matrix @ vector`, column by column where those are few."""
    if matrix.shape[1] > _MOST_COLUMNS:
        return matrix @ vector
    return _sum([matrix[:, j] * vector[j] for j in range(matrix.shape[1])])


# More take long to compile, and one product of matrices for all lanes is as fast.
_MOST_COLUMNS = 16


def matmul(left: Float[Array, "n k"], right: Float[Array, "k m"]) -> Float[Array, "n m"]:
    """`left @ right`, as a sum of outer products."""
    return _sum([left[:, j : j + 1] * right[j] for j in range(left.shape[1])])


def _sum(terms: list[Array]) -> Array:
    """Σ terms, written out. A reduction would be a kernel of its own, which does not fuse with
    its neighbours under `vmap`; and XLA's CPU compiler (JAX 0.10.2) leaves all but the first
    32,768 numbers of some reductions inside loops uncomputed."""
    return functools.reduce(operator.add, terms)


def sum_of_many(terms: Float[Array, " n"]) -> Float[Array, ""]:
    """Σ terms, in pairs: to rounding of one addition and of their logarithm, and without what is
    said of reductions in `_sum`."""
    while terms.shape[0] > 1:
        half = terms.shape[0] // 2
        pairs = terms[:half] + terms[half : 2 * half]
        terms = jnp.concatenate([pairs, terms[2 * half :]])
    return terms[0]


def safe_norm(vector: Float[Array, " d"]) -> Float[Array, ""]:
    """|v| with a zero (not NaN) derivative at v = 0."""
    square = dot(vector, vector)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)


def spectral_radius(matrix: Float[Array, "d d"]) -> Float[Array, ""]:
    """Return the largest absolute value of eigenvalues, up to a few per cent: ‖Aⁿ‖^{1/n} at n = 32,
    which hardly depends on the units of coordinates."""

    def squared(_, state):
        power, log_size = state
        size = jnp.max(jnp.abs(power))
        size = jnp.where(size > 0, size, 1)
        power = power / size
        return matmul(power, power), 2 * (log_size + jnp.log(size))

    power, log_size = lax.fori_loop(0, 5, squared, (matrix, jnp.zeros((), matrix.dtype)))
    return jnp.exp((log_size + jnp.log(jnp.sum(power**2)) / 2) / 32)


def solve(matrix: Float[Array, "d d"], right: Float[Array, "d *m"]) -> Float[Array, "d *m"]:
    """`matrix⁻¹ right`, by Cramer's rule for d ≤ 2, otherwise by Gauss–Jordan elimination with
    partial pivoting.

    A singular matrix gives non-finite numbers, as a division by zero does.
    """
    d = matrix.shape[0]
    if d == 1:
        return right / matrix[0, 0]
    if d == 2:
        (a, b), (c, e) = matrix
        first, second = e * right[0] - b * right[1], a * right[1] - c * right[0]
        return jnp.stack([first, second]) / (a * e - b * c)
    rows = jnp.concatenate([matrix, right.reshape(d, -1)], axis=1)
    for k in range(d):
        below = jnp.where(np.arange(d) < k, -1, jnp.abs(rows[:, k]))
        chosen = jnp.arange(d) == jnp.argmax(below)
        pivot_row = _sum([jnp.where(chosen[i], rows[i], 0) for i in range(d)])
        rows = jnp.where(chosen[:, None], rows[k], rows)  # the other half of the swap
        pivot_row = pivot_row / pivot_row[k]
        reduced = rows - rows[:, k : k + 1] * pivot_row
        rows = jnp.where((np.arange(d) == k)[:, None], pivot_row, reduced)
    return rows[:, d:].reshape(right.shape)


def inverse(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """`matrix⁻¹`, unrolled."""
    return solve(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))


def cholesky(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """The lower triangular L with `L Lᵀ = matrix`; NaN where there is none. Number by number, which
    fuses; in many dimensions, where that takes long to compile, in a loop over columns."""
    d = matrix.shape[0]
    if d > _UNROLLED:
        return _looped_cholesky(matrix)
    L: list[list[Array]] = [[] for _ in range(d)]
    for k in range(d):
        rest = [_minus(matrix[i, k], [L[i][j] * L[k][j] for j in range(k)]) for i in range(k, d)]
        root = lax.rsqrt(rest[0])
        for i in range(k, d):
            L[i].append(rest[i - k] * root)
    return _lower(L)


def semidefinite_cholesky(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """`cholesky` of a covariance that may be singular: a pivot that is zero, but for rounding, has
    a column of zeros."""
    d, rest, columns = matrix.shape[0], matrix, []
    for k in range(d):
        pivot = rest[k, k]
        least = 10 * d * jnp.finfo(matrix.dtype).eps * jnp.abs(matrix[k, k])
        nothing = jnp.abs(pivot) <= least
        column = rest[k] * jnp.where(nothing, 0, lax.rsqrt(jnp.where(nothing, 1, pivot)))
        columns.append(jnp.where(np.arange(d) < k, 0, column))
        rest = rest - columns[-1][:, None] * columns[-1]
    return jnp.stack(columns, axis=1)


def lower_factor(matrix: Float[Array, "d m"]) -> Float[Array, "d d"]:
    """L of `matrix = L Q`, lower triangular with a positive diagonal, Q orthogonal: the root of
    `matrix matrixᵀ`, without squaring the condition number. By Gram and Schmidt's procedure on the
    rows, modified, which is as stable for L as any; non-finite numbers where `matrix` is singular.
    """
    d = matrix.shape[0]
    if d > _UNROLLED:
        return cholesky(matmul(matrix, matrix.T))
    L: list[list[Array]] = []
    directions: list[Array] = []
    for i in range(d):
        row, along = matrix[i], []
        for direction in directions:
            along.append(dot(row, direction))
            row = row - along[-1] * direction
        square = dot(row, row)
        root = lax.rsqrt(square)
        directions.append(row * root)
        L.append([*along, square * root])
    return _lower(L)


def semidefinite_factor(matrix: Float[Array, "d n"]) -> Float[Array, "d d"]:
    """`lower_factor` of a matrix whose rows may be linearly dependent, or more than its columns: a
    row of which nothing is left, but for rounding, has a zero on the diagonal and below."""
    d = matrix.shape[0]
    if d > _UNROLLED:
        return _looped_factor(matrix)
    L: list[list[Array]] = []
    directions: list[Array] = []
    for i in range(d):
        row, along, whole = matrix[i], [], dot(matrix[i], matrix[i])
        for direction in directions:
            along.append(dot(row, direction))
            row = row - along[-1] * direction
        square = dot(row, row)
        nothing = square <= (10 * d * jnp.finfo(matrix.dtype).eps) ** 2 * whole
        root = jnp.where(nothing, 0, lax.rsqrt(jnp.where(nothing, 1, square)))
        directions.append(row * root)
        L.append([*along, jnp.where(nothing, 0, square * root)])
    return _lower(L)


def _minus(number: Float[Array, ""], terms: list[Float[Array, ""]]) -> Float[Array, ""]:
    return number - _sum(terms) if terms else number


def _lower(rows: list[list[Float[Array, ""]]]) -> Float[Array, "d d"]:
    """The lower triangular matrix of these numbers."""
    zero = jnp.zeros_like(rows[0][0])
    return jnp.stack([jnp.stack(row + [zero] * (len(rows) - len(row))) for row in rows])


def quadratic_form(
    matrix: Float[Array, "d d"], vector: Float[Array, " d"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """vᵀM⁻¹v and log det M of a positive definite matrix, NaN of another, by elimination: without
    the square roots of `cholesky`, with which XLA does not vectorise loops over lanes on CPU. From
    five dimensions on what is written out is slower to run as well, by factors of 3 to 7."""
    d = matrix.shape[0]
    if d > _WRITTEN_FORM:
        return _looped_quadratic_form(matrix, vector)
    rows = [[matrix[i, j] for j in range(i + 1)] for i in range(d)]  # of the lower triangle
    left, terms, pivots = list(vector), [], []
    for k in range(d):
        pivot = rows[k][k]
        for i in range(k + 1, d):
            share = rows[i][k] / pivot
            left[i] = left[i] - share * left[k]
            for j in range(k + 1, i + 1):
                rows[i][j] = rows[i][j] - share * rows[j][k]
        terms.append(left[k] * left[k] / pivot)
        pivots.append(pivot)
    return _sum(terms), log_of_product(pivots)


def solve_lower(matrix: Float[Array, "d d"], right: Float[Array, " d"]) -> Float[Array, " d"]:
    """`L⁻¹ right` for a lower triangular L, by forward substitution."""
    if matrix.shape[0] > _UNROLLED:
        return _looped_substitution(matrix, right, range(matrix.shape[0]))
    solved = []
    for i in range(matrix.shape[0]):
        rest = _minus(right[i], [matrix[i, j] * solved[j] for j in range(i)])
        solved.append(rest / matrix[i, i])
    return jnp.stack(solved)


def solve_lower_transposed(
    matrix: Float[Array, "d d"], right: Float[Array, " d"]
) -> Float[Array, " d"]:
    """`L⁻ᵀ right` for a lower triangular L, by back substitution."""
    d = matrix.shape[0]
    if d > _UNROLLED:
        return _looped_substitution(matrix.T, right, range(d - 1, -1, -1))
    solved: dict[int, Array] = {}
    for i in reversed(range(d)):
        rest = _minus(right[i], [matrix[j, i] * solved[j] for j in range(i + 1, d)])
        solved[i] = rest / matrix[i, i]
    return jnp.stack([solved[i] for i in range(d)])


# Beyond this, writing the elimination out costs too much compilation: in fifty dimensions minutes,
# and all memory.
_UNROLLED, _WRITTEN_FORM = 16, 4


def _looped_cholesky(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """`cholesky`, in a loop over columns."""
    n = np.arange(matrix.shape[0])

    def eliminate(k, carry):
        rest, L = carry
        column = jnp.where(n < k, 0, rest[k] * lax.rsqrt(rest[k, k]))
        return rest - column[:, None] * column, jnp.where(n == k, column[:, None], L)

    return lax.fori_loop(0, len(n), eliminate, (matrix, jnp.zeros_like(matrix)))[1]


def _looped_factor(matrix: Float[Array, "d n"]) -> Float[Array, "d d"]:
    """`semidefinite_factor`, in a loop over columns."""
    d, eps = matrix.shape[0], jnp.finfo(matrix.dtype).eps

    def column(k, carry):
        rows, L = carry
        square = jnp.sum(rows[k] ** 2)
        nothing = square <= (10 * d * eps) ** 2 * jnp.sum(matrix[k] ** 2)
        root = jnp.where(nothing, 0, lax.rsqrt(jnp.where(nothing, 1, square)))
        direction = rows[k] * root
        along = jnp.where(jnp.arange(d) < k, 0, jnp.sum(rows * direction, axis=1))
        return rows - along[:, None] * direction, L.at[:, k].set(along)

    return lax.fori_loop(0, d, column, (matrix, jnp.zeros((d, d), matrix.dtype)))[1]


def _looped_quadratic_form(
    matrix: Float[Array, "d d"], vector: Float[Array, " d"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """`quadratic_form`, in a loop: -vᵀM⁻¹v is what elimination leaves of a last row (vᵀ, 0)."""
    d = matrix.shape[0]
    zeros = jnp.zeros_like(vector, shape=(d + 1, 1))
    rest = jnp.concatenate([matrix, vector[None, :]], axis=0)
    rest = jnp.concatenate([rest, jnp.append(vector, 0)[:, None]], axis=1)

    def eliminate(_, carry):
        # What is left moves up and to the left, so that all steps are alike.
        rest, log_det = carry
        pivot = rest[0, 0]
        rest = rest[1:, 1:] - rest[1:, :1] * (rest[:1, 1:] / pivot)
        rest = jnp.concatenate([rest, zeros[:d].T], axis=0)
        rest = jnp.concatenate([rest, zeros], axis=1)
        return rest, log_det + jnp.log(jnp.where(pivot > 0, pivot, jnp.nan))

    rest, log_det = lax.fori_loop(0, d, eliminate, (rest, zeros[0, 0]))
    return -rest[0, 0], log_det


def _looped_substitution(
    matrix: Float[Array, "d d"], right: Float[Array, " d"], order: range
) -> Float[Array, " d"]:
    """`matrix⁻¹ right` of a triangular matrix, whose unknowns are found in this order."""
    n, which = np.arange(len(order)), jnp.array(order)

    def substitute(i, carry):
        rest, solved = carry
        k = which[i]
        found = rest[k] / matrix[k, k]
        # What is on the other side of the diagonal is zero, and belongs to what has been found.
        return rest - matrix[:, k] * found, jnp.where(n == k, found, solved)

    return lax.fori_loop(0, len(n), substitute, (right, jnp.zeros_like(right)))[1]


def any_solve(matrix: Float[Array, "p p"], right: Float[Array, "p *m"]) -> Float[Array, "p *m"]:
    """`solve`, by LAPACK for large matrices: for use outside loops over lanes."""
    small = matrix.shape[0] <= _UNROLLED
    return solve(matrix, right) if small else jnp.linalg.solve(matrix, right)


def any_inverse(matrix: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """`inverse`, likewise."""
    return inverse(matrix) if matrix.shape[0] <= _UNROLLED else jnp.linalg.inv(matrix)


def any_cholesky(matrix: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """`cholesky`, likewise."""
    return cholesky(matrix) if matrix.shape[0] <= _UNROLLED else jnp.linalg.cholesky(matrix)


def any_log_abs_det(matrix: Float[Array, "p p"]) -> Float[Array, ""]:
    """`log_abs_det`, likewise."""
    small = matrix.shape[0] <= _UNROLLED
    return log_abs_det(matrix) if small else jnp.linalg.slogdet(matrix)[1]


def log_abs_det(matrix: Float[Array, "d d"]) -> Float[Array, ""]:
    """log |det matrix|, by elimination with partial pivoting."""
    d, rows, logs = matrix.shape[0], matrix, []
    for k in range(d):
        below = jnp.where(np.arange(d) < k, -1, jnp.abs(rows[:, k]))
        chosen = jnp.arange(d) == jnp.argmax(below)
        pivot_row = _sum([jnp.where(chosen[i], rows[i], 0) for i in range(d)])
        logs.append(jnp.log(jnp.abs(pivot_row[k])))
        rows = jnp.where(chosen[:, None], rows[k], rows)  # the other half of the swap
        eliminated = rows - rows[:, k : k + 1] * (pivot_row / pivot_row[k])
        rows = jnp.where((np.arange(d) > k)[:, None], eliminated, rows)
    return _sum(logs)


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

    def newton(_, factor):
        inverse_transpose = inverse(factor).T
        scale = jnp.sqrt(jnp.sqrt(total(total(inverse_transpose**2)) / total(total(factor**2))))
        return (scale * factor + inverse_transpose / scale) / 2

    return lax.fori_loop(0, _NEWTON_STEPS, newton, matrix)


# With this scaling a condition number of 1e8 is orthogonal to 1e-15 after nine steps.
_NEWTON_STEPS = 9
