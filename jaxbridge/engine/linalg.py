"""Small dense linear algebra in elementary operations, for compiled loops over lanes.

A path is a `lax.scan` over time of a step that is vmapped over thousands of lanes. LAPACK calls in
such a loop are slow, and batched ones can deadlock XLA's thread pool on a CPU. Matrices are d × d,
with d the dimension of the diffusion, so elimination is written out in elementwise operations.
Every function acts on one point; `vmap` or `over_lanes` adds the lanes.
"""

import functools
import operator

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int


def dot(left: Float[Array, " d"], right: Float[Array, " d"]) -> Float[Array, ""]:
    """Compute `left @ right` of two vectors."""
    return _sum([left[i] * right[i] for i in range(left.shape[0])])


# Squares of larger numbers overflow in float32. A path beyond this bound counts as exploded, in
# float64 too, so that both precisions agree.
_EXPLODED = 1e18


def is_finite(values: Float[Array, "*shape"]) -> Bool[Array, "*shape"]:
    """Return whether numbers are within the bound for paths that have not exploded (1e18)."""
    return jnp.abs(values) < _EXPLODED


def all_finite(vector: Float[Array, " d"]) -> Bool[Array, ""]:
    """Return whether the sum of the coordinates' absolute values is within the bound of
    `is_finite`.
    """
    return is_finite(_sum([jnp.abs(x) for x in vector]))


def sum_first_axis(terms: Float[Array, "d *shape"]) -> Float[Array, "*shape"]:
    """Sum over the first axis."""
    return _sum([terms[i] for i in range(terms.shape[0])])


def log_of_product(numbers: list[Float[Array, ""]]) -> Float[Array, ""]:
    """Compute the log of the product of positive numbers with one logarithm.

    The product itself may be out of range. The result is NaN if a number is not positive.
    """
    # A logarithm is slow, a power of two is not. All but one number become m 2^e with m in [1, 4),
    # so the product of these is in range.
    *others, last = numbers
    parts = [_mantissa_and_exponent(number) for number in others]
    value = jnp.log(functools.reduce(operator.mul, [*(m for m, _ in parts), last]))
    if parts:
        exponent = functools.reduce(operator.add, [e for _, e in parts])
        value = value + exponent.astype(last.dtype) * np.log(2).astype(last.dtype)
    return jnp.where(functools.reduce(jnp.minimum, numbers) > 0, value, jnp.nan)


def _mantissa_and_exponent(number: Float[Array, ""]) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Return m in [1, 4) and e with m 2^e equal to a positive number; e has derivative zero."""
    info = jnp.finfo(number.dtype)
    integer = np.dtype(f"int{info.bits}")
    width, bias = integer.type(info.nmant), integer.type(info.maxexp - 1)
    bits = lax.bitcast_convert_type(number, integer)
    # 2^-127 would be no normal number.
    exponent = lax.min(lax.shift_right_arithmetic(bits, width) - bias, bias - integer.type(1))
    power = lax.bitcast_convert_type(lax.shift_left(bias - exponent, width), number.dtype)
    return number * lax.stop_gradient(power), exponent


def matvec(matrix: Float[Array, "n m"], vector: Float[Array, " m"]) -> Float[Array, " n"]:
    """Compute `matrix @ vector`, as a sum over columns if there are at most 16."""
    if matrix.shape[1] > _MOST_COLUMNS:
        return matrix @ vector
    return _sum([matrix[:, j] * vector[j] for j in range(matrix.shape[1])])


# More columns take long to compile, and one product of matrices for all lanes is as fast.
_MOST_COLUMNS = 16


def matmul(left: Float[Array, "n k"], right: Float[Array, "k m"]) -> Float[Array, "n m"]:
    """Compute `left @ right`, as a sum of outer products if there are at most 16."""
    if left.shape[1] > _MOST_COLUMNS:
        return left @ right
    return _sum([left[:, j : j + 1] * right[j] for j in range(left.shape[1])])


def _sum(terms: list[Array]) -> Array:
    """Sum the terms, written out.

    A reduction would be a kernel of its own and would not fuse with its neighbours under `vmap`.
    Moreover, XLA's CPU compiler (JAX 0.10.2) computes only the first 32,768 numbers of some
    reductions inside loops.
    """
    return functools.reduce(operator.add, terms)


def sum_of_many(terms: Float[Array, " n"]) -> Float[Array, ""]:
    """Sum the terms by repeated pairwise addition, without a reduction (see `_sum`).

    The rounding error grows with the logarithm of their number.
    """
    while terms.shape[0] > 1:
        half = terms.shape[0] // 2
        pairs = terms[:half] + terms[half : 2 * half]
        terms = jnp.concatenate([pairs, terms[2 * half :]])
    return terms[0]


def safe_norm(vector: Float[Array, " d"]) -> Float[Array, ""]:
    """Compute |v|, with derivative zero instead of NaN at v = 0."""
    square = dot(vector, vector)
    positive = square > 0
    # The inner `where` keeps the infinite derivative of √0 out of the product with zero.
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)


def spectral_radius(matrix: Float[Array, "d d"]) -> Float[Array, ""]:
    """Estimate the largest absolute eigenvalue to a few per cent, as ‖Aⁿ‖^{1/n} with n = 32.

    The estimate hardly depends on the units of the coordinates.
    """

    def squared(_, state):
        power, log_size = state
        size = jnp.max(jnp.abs(power))  # the scale is stored as a logarithm: powers may overflow
        size = jnp.where(size > 0, size, 1)
        power = power / size
        return matmul(power, power), 2 * (log_size + jnp.log(size))

    power, log_size = lax.fori_loop(0, 5, squared, (matrix, jnp.zeros((), matrix.dtype)))
    return jnp.exp((log_size + jnp.log(jnp.sum(power**2)) / 2) / 32)


def solve(matrix: Float[Array, "d d"], right: Float[Array, "d *m"]) -> Float[Array, "d *m"]:
    """Solve `matrix x = right`, by Cramer's rule for d ≤ 2, else by Gauss–Jordan elimination.

    Elimination uses partial pivoting. A singular matrix gives non-finite numbers, as a division by
    zero does.
    """
    d = matrix.shape[0]
    if d == 1:
        return right / matrix[0, 0]
    if d == 2:
        # Rows of size one, so that products of two entries are in range in all units.
        size = lax.stop_gradient(jnp.abs(matrix[:, 0]) + jnp.abs(matrix[:, 1]))
        size = jnp.where(size > 0, size, 1)
        (a, b), (c, e) = matrix / size[:, None]
        right = right / size.reshape(2, *[1] * (right.ndim - 1))
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
    """Compute `matrix⁻¹` by `solve`, unrolled."""
    return solve(matrix, jnp.eye(matrix.shape[0], dtype=matrix.dtype))


def cholesky(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Compute the lower triangular L with `L Lᵀ = matrix`; NaN if none exists.

    Up to 16 dimensions all entries are written out, which fuses. Beyond, a loop over columns
    compiles faster.
    """
    d = matrix.shape[0]
    if d > _UNROLLED:
        return _looped_cholesky(matrix)
    L: list[list[Array]] = [[] for _ in range(d)]
    for k in range(d):
        column = [_minus(matrix[i, k], [L[i][j] * L[k][j] for j in range(k)]) for i in range(k, d)]
        root = lax.rsqrt(column[0])
        for i in range(k, d):
            L[i].append(column[i - k] * root)
    return _lower(L)


def semidefinite_cholesky(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Compute `cholesky` of a covariance that may be singular.

    A pivot that is zero up to rounding gets a column of zeros.
    """
    d, remainder, columns = matrix.shape[0], matrix, []
    for k in range(d):
        pivot = remainder[k, k]
        tolerance = 10 * d * jnp.finfo(matrix.dtype).eps * jnp.abs(matrix[k, k])
        is_zero = jnp.abs(pivot) <= tolerance
        column = remainder[k] * jnp.where(is_zero, 0, lax.rsqrt(jnp.where(is_zero, 1, pivot)))
        columns.append(jnp.where(np.arange(d) < k, 0, column))
        remainder = remainder - columns[-1][:, None] * columns[-1]
    return jnp.stack(columns, axis=1)


def lower_factor(matrix: Float[Array, "d m"]) -> Float[Array, "d d"]:
    """Compute L of `matrix = L Q`, lower triangular with a positive diagonal, and Q orthogonal.

    L is the Cholesky factor of `matrix matrixᵀ`, without the squared condition number. It is
    computed by the modified Gram–Schmidt process on the rows, whose L is as accurate as that of
    Householder's method. A singular matrix gives non-finite numbers.
    """
    d = matrix.shape[0]
    if d > _UNROLLED:  # squares the condition number, but compiles fast
        return cholesky(matmul(matrix, matrix.T))
    L: list[list[Array]] = []
    directions: list[Array] = []
    for i in range(d):
        row, coefficients = matrix[i], []
        for direction in directions:
            coefficients.append(dot(row, direction))
            row = row - coefficients[-1] * direction
        square = dot(row, row)
        root = lax.rsqrt(square)
        directions.append(row * root)
        L.append([*coefficients, square * root])
    return _lower(L)


def semidefinite_factor(matrix: Float[Array, "d n"]) -> Float[Array, "d d"]:
    """Compute `lower_factor` of a matrix whose rows may be linearly dependent.

    The matrix may have more rows than columns. A row that depends on the rows above, up to
    rounding, gets a zero on the diagonal and below.
    """
    d = matrix.shape[0]
    if d > _UNROLLED:
        return _looped_factor(matrix)
    L: list[list[Array]] = []
    directions: list[Array] = []
    for i in range(d):
        row, coefficients, norm_squared = matrix[i], [], dot(matrix[i], matrix[i])
        for direction in directions:
            coefficients.append(dot(row, direction))
            row = row - coefficients[-1] * direction
        square = dot(row, row)
        is_zero = square <= (10 * d * jnp.finfo(matrix.dtype).eps) ** 2 * norm_squared
        root = jnp.where(is_zero, 0, lax.rsqrt(jnp.where(is_zero, 1, square)))
        directions.append(row * root)
        L.append([*coefficients, jnp.where(is_zero, 0, square * root)])
    return _lower(L)


def _minus(number: Float[Array, ""], terms: list[Float[Array, ""]]) -> Float[Array, ""]:
    """Subtract the sum of the terms, of which there may be none."""
    return number - _sum(terms) if terms else number


def _lower(rows: list[list[Float[Array, ""]]]) -> Float[Array, "d d"]:
    """Build a lower triangular matrix from its rows."""
    zero = jnp.zeros_like(rows[0][0])
    return jnp.stack([jnp.stack(row + [zero] * (len(rows) - len(row))) for row in rows])


def quadratic_form(
    matrix: Float[Array, "d d"], vector: Float[Array, " d"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Compute vᵀM⁻¹v and log det M of a positive definite matrix by elimination.

    The log determinant is NaN if a pivot is not positive. Elimination avoids the square roots of
    `cholesky`, which keep XLA from vectorising loops over lanes on a CPU. From five dimensions on,
    it runs in a loop: written out, it is slower by factors of 3 to 7.
    """
    d = matrix.shape[0]
    if d > _WRITTEN_FORM:
        return _looped_quadratic_form(matrix, vector)
    rows = [[matrix[i, j] for j in range(i + 1)] for i in range(d)]  # lower triangle
    remainder, terms, pivots = list(vector), [], []
    for k in range(d):
        pivot = rows[k][k]
        for i in range(k + 1, d):
            factor = rows[i][k] / pivot
            remainder[i] = remainder[i] - factor * remainder[k]
            for j in range(k + 1, i + 1):
                rows[i][j] = rows[i][j] - factor * rows[j][k]
        terms.append(remainder[k] * remainder[k] / pivot)
        pivots.append(pivot)
    return _sum(terms), log_of_product(pivots)


def solve_lower(matrix: Float[Array, "d d"], right: Float[Array, " d"]) -> Float[Array, " d"]:
    """Solve `L x = right` for a lower triangular L, by forward substitution."""
    if matrix.shape[0] > _UNROLLED:
        return _looped_substitution(matrix, right, range(matrix.shape[0]))
    solved = []
    for i in range(matrix.shape[0]):
        remainder = _minus(right[i], [matrix[i, j] * solved[j] for j in range(i)])
        solved.append(remainder / matrix[i, i])
    return jnp.stack(solved)


def solve_lower_transposed(
    matrix: Float[Array, "d d"], right: Float[Array, " d"]
) -> Float[Array, " d"]:
    """Solve `Lᵀ x = right` for a lower triangular L, by back substitution."""
    d = matrix.shape[0]
    if d > _UNROLLED:
        return _looped_substitution(matrix.T, right, range(d - 1, -1, -1))
    solved: dict[int, Array] = {}
    for i in reversed(range(d)):
        remainder = _minus(right[i], [matrix[j, i] * solved[j] for j in range(i + 1, d)])
        solved[i] = remainder / matrix[i, i]
    return jnp.stack([solved[i] for i in range(d)])


# Largest dimensions in which elimination is written out: in fifty dimensions it would take minutes
# to compile, and all memory.
_UNROLLED, _WRITTEN_FORM = 16, 4


def _looped_cholesky(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Compute `cholesky` in a loop over columns."""
    n = np.arange(matrix.shape[0])

    def eliminate(k, carry):
        remainder, L = carry
        column = jnp.where(n < k, 0, remainder[k] * lax.rsqrt(remainder[k, k]))
        return remainder - column[:, None] * column, jnp.where(n == k, column[:, None], L)

    return lax.fori_loop(0, len(n), eliminate, (matrix, jnp.zeros_like(matrix)))[1]


def _looped_factor(matrix: Float[Array, "d n"]) -> Float[Array, "d d"]:
    """Compute `semidefinite_factor` in a loop over columns."""
    d, eps = matrix.shape[0], jnp.finfo(matrix.dtype).eps

    def column(k, carry):
        rows, L = carry
        square = jnp.sum(rows[k] ** 2)
        is_zero = square <= (10 * d * eps) ** 2 * jnp.sum(matrix[k] ** 2)
        root = jnp.where(is_zero, 0, lax.rsqrt(jnp.where(is_zero, 1, square)))
        direction = rows[k] * root
        coefficients = jnp.where(jnp.arange(d) < k, 0, jnp.sum(rows * direction, axis=1))
        return rows - coefficients[:, None] * direction, L.at[:, k].set(coefficients)

    return lax.fori_loop(0, d, column, (matrix, jnp.zeros((d, d), matrix.dtype)))[1]


def _looped_quadratic_form(
    matrix: Float[Array, "d d"], vector: Float[Array, " d"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Compute `quadratic_form` in a loop.

    Elimination turns the last entry of the matrix [[M, v], [vᵀ, 0]] into -vᵀM⁻¹v.
    """
    d = matrix.shape[0]
    zeros = jnp.zeros_like(vector, shape=(d + 1, 1))
    remainder = jnp.concatenate([matrix, vector[None, :]], axis=0)
    remainder = jnp.concatenate([remainder, jnp.append(vector, 0)[:, None]], axis=1)

    def eliminate(_, carry):
        # Shift the remainder up and to the left, so that every step has its pivot at (0, 0).
        remainder, log_det = carry
        pivot = remainder[0, 0]
        remainder = remainder[1:, 1:] - remainder[1:, :1] * (remainder[:1, 1:] / pivot)
        remainder = jnp.concatenate([remainder, zeros[:d].T], axis=0)
        remainder = jnp.concatenate([remainder, zeros], axis=1)
        return remainder, log_det + jnp.log(jnp.where(pivot > 0, pivot, jnp.nan))

    remainder, log_det = lax.fori_loop(0, d, eliminate, (remainder, zeros[0, 0]))
    return -remainder[0, 0], log_det


def _looped_substitution(
    matrix: Float[Array, "d d"], right: Float[Array, " d"], order: range
) -> Float[Array, " d"]:
    """Solve `matrix x = right` for a triangular matrix, one unknown after the other in `order`."""
    n, unknowns = np.arange(len(order)), jnp.array(order)

    def substitute(i, carry):
        remainder, solved = carry
        k = unknowns[i]
        unknown = remainder[k] / matrix[k, k]
        # Entries of this column for solved unknowns are zero: the matrix is triangular.
        return remainder - matrix[:, k] * unknown, jnp.where(n == k, unknown, solved)

    return lax.fori_loop(0, len(n), substitute, (right, jnp.zeros_like(right)))[1]


def any_solve(matrix: Float[Array, "p p"], right: Float[Array, "p *m"]) -> Float[Array, "p *m"]:
    """Solve `matrix x = right`, with LAPACK beyond 16 rows. Do not call it in loops over lanes."""
    small = matrix.shape[0] <= _UNROLLED
    return solve(matrix, right) if small else jnp.linalg.solve(matrix, right)


def any_inverse(matrix: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """Compute `matrix⁻¹`, with LAPACK if it is large; use it outside of lane loops."""
    return inverse(matrix) if matrix.shape[0] <= _UNROLLED else jnp.linalg.inv(matrix)


def any_cholesky(matrix: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """Compute the Cholesky factor, with LAPACK if it is large; use it outside of lane loops."""
    return cholesky(matrix) if matrix.shape[0] <= _UNROLLED else jnp.linalg.cholesky(matrix)


def any_log_abs_det(matrix: Float[Array, "p p"]) -> Float[Array, ""]:
    """Compute log |det matrix|, with LAPACK if it is large; use it outside of lane loops."""
    small = matrix.shape[0] <= _UNROLLED
    return log_abs_det(matrix) if small else jnp.linalg.slogdet(matrix)[1]


def log_abs_det(matrix: Float[Array, "d d"]) -> Float[Array, ""]:
    """Compute log |det matrix| by elimination with partial pivoting."""
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
    """Return the orthogonal matrix closest to `matrix` in the Frobenius norm.

    It is `U Vᵀ` of the singular value decomposition `U Σ Vᵀ`, and differentiable wherever `matrix`
    is invertible, also with repeated singular values.

    In two dimensions the result is in closed form. Otherwise it is the limit of Newton's iteration
    `X ← (s X + X⁻ᵀ / s) / 2` (Higham 1986), where the scale s balances the norms of the two terms.
    """
    d = matrix.shape[0]
    if d == 1:
        return jnp.where(matrix < 0, -1, 1).astype(matrix.dtype)
    if d == 2:
        size = lax.stop_gradient(_sum([jnp.abs(x) for x in matrix.ravel()]))
        (a, b), (c, e) = matrix / jnp.where(size > 0, size, 1)
        sign = jnp.where(a * e - b * c < 0, -1, 1).astype(matrix.dtype)
        # matrix + sign × its cofactor matrix is a multiple of a rotation or reflection
        p, q = a + sign * e, c - sign * b
        length = safe_norm(jnp.stack([p, q]))
        p, q = p / length, q / length
        return jnp.stack([jnp.stack([p, -sign * q]), jnp.stack([q, sign * p])])

    def newton(_, factor):
        inverse_transpose = inverse(factor).T
        scale = jnp.sqrt(
            jnp.sqrt(
                sum_first_axis(sum_first_axis(inverse_transpose**2))
                / sum_first_axis(sum_first_axis(factor**2))
            )
        )
        return (scale * factor + inverse_transpose / scale) / 2

    return lax.fori_loop(0, _NEWTON_STEPS, newton, matrix)


# With this scaling, nine steps make a matrix of condition number 1e8 orthogonal to 1e-15.
_NEWTON_STEPS = 9
