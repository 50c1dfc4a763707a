"""Written-out linear algebra against NumPy's LAPACK."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.engine.linalg import (
    all_finite,
    cholesky,
    dot,
    inverse,
    log_of_product,
    lower_factor,
    matmul,
    matvec,
    polar_factor,
    quadratic_form,
    safe_norm,
    semidefinite_cholesky,
    solve,
    solve_lower,
    solve_lower_transposed,
    spectral_radius,
)

DIMENSIONS = [1, 2, 3, 5]
COUNT = 24  # matrices in every batch, so that each function compiles once for each dimension
TOLERANCE = {"float32": 2e-4, "float64": 1e-11}

many_solve = jax.jit(jax.vmap(solve))
many_inverse = jax.jit(jax.vmap(inverse))
many_cholesky = jax.jit(jax.vmap(cholesky))
many_lower_factor = jax.jit(jax.vmap(lower_factor))
many_polar_factor = jax.jit(jax.vmap(polar_factor))


def random_orthogonal(rng, d):
    """Orthogonal matrices of both signs of the determinant."""
    orthogonal = np.linalg.qr(rng.standard_normal((COUNT, d, d)))[0]
    orthogonal[:, 0] *= rng.choice([-1, 1], (COUNT, 1))
    return orthogonal


def with_singular_values(rng, singular_values):
    """Matrices with these singular values, of both signs of the determinant."""
    d = len(singular_values)
    return random_orthogonal(rng, d) * singular_values @ random_orthogonal(rng, d)


def polar_factor_by_svd(matrices):
    u, _, vh = np.linalg.svd(matrices)
    return u @ vh


@pytest.mark.parametrize("d", [1, 2, 3, 5, 10])
def test_products_equal_numpys(d, precision):
    rng = np.random.default_rng(d)
    a, b = rng.standard_normal((2, d, d)).astype(precision)
    v, w = rng.standard_normal((2, d)).astype(precision)
    close = lambda ours, exact: np.testing.assert_allclose(ours, exact, rtol=1e-5, atol=1e-5)
    close(dot(jnp.asarray(v), jnp.asarray(w)), v @ w)
    close(matvec(jnp.asarray(a), jnp.asarray(v)), a @ v)
    close(matmul(jnp.asarray(a), jnp.asarray(b)), a @ b)


@pytest.mark.parametrize("d", DIMENSIONS)
def test_solve_and_inverse_equal_numpys(d, precision):
    rng = np.random.default_rng(d)
    matrices = with_singular_values(rng, np.linspace(1, 3, d)).astype(precision)
    vectors = rng.standard_normal((COUNT, d)).astype(precision)
    tolerance = TOLERANCE[precision]
    solved = many_solve(matrices, vectors)
    exact = np.linalg.solve(matrices, vectors[:, :, None])[:, :, 0]
    assert solved.dtype == precision
    np.testing.assert_allclose(solved, exact, atol=tolerance)
    np.testing.assert_allclose(many_inverse(matrices), np.linalg.inv(matrices), atol=tolerance)


@pytest.mark.parametrize("d", [3, 5])
def test_solve_takes_several_right_hand_sides(d, x64):
    rng = np.random.default_rng(d)
    matrices, right = rng.standard_normal((COUNT, d, d)), rng.standard_normal((COUNT, d, 2))
    np.testing.assert_allclose(
        many_solve(matrices, right), np.linalg.solve(matrices, right), rtol=1e-8
    )


@pytest.mark.parametrize("d", [2, 3, 5])
def test_solve_exchanges_rows_where_the_leading_entries_vanish(d, precision):
    # Without pivoting each of these divides by zero, or by nearly zero.
    cyclic = np.roll(np.eye(d), 1, axis=0)
    reversal = np.eye(d)[::-1]
    hollow = np.ones((d, d)) - np.eye(d)
    tiny_pivot = hollow + 1e-9 * np.eye(d)
    matrices = np.stack([cyclic, reversal, hollow, tiny_pivot]).astype(precision)
    matrices = np.resize(matrices, (COUNT, d, d))
    vectors = np.resize(np.arange(1, d + 1), (COUNT, d)).astype(precision)
    exact = np.linalg.solve(matrices, vectors[:, :, None])[:, :, 0]
    tolerance = TOLERANCE[precision]
    np.testing.assert_allclose(many_solve(matrices, vectors), exact, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("d", DIMENSIONS)
def test_a_singular_matrix_gives_nonfinite_numbers(d):
    matrices = np.zeros((COUNT, d, d), np.float32)
    matrices[:, : d - 1, : d - 1] = np.eye(d - 1)  # the last row and column vanish
    vectors = np.ones((COUNT, d), np.float32)
    assert not np.isfinite(many_solve(matrices, vectors)).all(1).any()


@pytest.mark.slow
def test_ten_dimensions(x64):
    rng = np.random.default_rng(10)
    matrices = with_singular_values(rng, np.geomspace(1e-6, 1, 10))
    vectors = rng.standard_normal((COUNT, 10))
    solved = np.asarray(many_solve(matrices, vectors))
    residual = np.einsum("nij,nj->ni", matrices, solved) - vectors
    np.testing.assert_allclose(residual, 0, atol=1e-8)
    np.testing.assert_allclose(
        many_polar_factor(matrices), polar_factor_by_svd(matrices), atol=1e-8
    )


@pytest.mark.parametrize("d", [*DIMENSIONS, 20])
def test_cholesky_equals_numpys(d, precision):
    rng = np.random.default_rng(d)
    roots = with_singular_values(rng, np.linspace(1, 3, d))
    matrices = (roots @ roots.swapaxes(1, 2)).astype(precision)
    np.testing.assert_allclose(
        many_cholesky(matrices), np.linalg.cholesky(matrices), atol=TOLERANCE[precision]
    )


@pytest.mark.parametrize("rank", [0, 1, 2, 3])
def test_semidefinite_cholesky_of_any_rank(rank):
    """As many columns are zero as there are pivots without a direction of their own."""
    factor = np.random.default_rng(0).normal(size=(3, rank)).astype(np.float32)
    factor[0] = 0 if rank < 3 else factor[0]
    matrix = factor @ factor.T
    L = np.asarray(semidefinite_cholesky(jnp.asarray(matrix)))
    np.testing.assert_allclose(L @ L.T, matrix, atol=1e-6)
    assert np.all(L == np.tril(L)) and np.sum(np.any(L, axis=0)) == rank
    assert np.isnan(semidefinite_cholesky(-jnp.eye(2))).any()


def test_cholesky_of_an_indefinite_matrix_is_nan():
    indefinite = np.resize([[1.0, 2.0], [2.0, 1.0]], (COUNT, 2, 2)).astype(np.float32)
    assert np.isnan(many_cholesky(indefinite)).any((1, 2)).all()


@pytest.mark.parametrize("d", [*DIMENSIONS, 20])
def test_lower_factor_equals_that_of_numpys_qr(d, precision):
    """A = L Q from Aᵀ = Qᵀ Lᵀ, with the signs that make the diagonal of L positive."""
    rng = np.random.default_rng(d)
    matrices = np.asarray(rng.standard_normal((COUNT, d, d)) + 2 * np.eye(d), precision)
    upper = np.linalg.qr(np.swapaxes(matrices, 1, 2).astype(float))[1]
    expected = np.swapaxes(upper * np.sign(np.diagonal(upper, axis1=1, axis2=2))[..., None], 1, 2)
    found = many_lower_factor(matrices)
    np.testing.assert_allclose(found, expected, atol=TOLERANCE[precision] * 20 * d)
    assert np.all(np.triu(found, 1) == 0)


def test_lower_factor_does_not_square_the_condition_number():
    """Rows that are nearly parallel, in single precision: the last of the diagonal is known to a
    part in a thousand, where the root of `A Aᵀ` has lost it."""
    apart = 1e-4
    matrix = np.array([[1.0, 1.0, 1.0], [1.0, 1.0 + apart, 1.0], [1.0, 1.0, 1.0 - apart]])
    exact = np.abs(np.diagonal(np.linalg.qr(matrix.T)[1]))
    single = jnp.asarray(matrix, jnp.float32)
    np.testing.assert_allclose(jnp.diagonal(lower_factor(single)), exact, rtol=5e-3)
    squared = jnp.diagonal(cholesky(matmul(single, single.T)))
    assert not np.allclose(squared, exact, rtol=5e-2)


@pytest.mark.parametrize("d", [*DIMENSIONS, 20])
def test_quadratic_form_equals_numpys(d, precision):
    rng = np.random.default_rng(d)
    roots = with_singular_values(rng, np.linspace(1, 3, d))
    matrices = (roots @ roots.swapaxes(1, 2)).astype(precision)
    vectors = rng.normal(size=(COUNT, d)).astype(precision)
    forms, log_dets = jax.vmap(quadratic_form)(matrices, vectors)
    solved = np.linalg.solve(matrices, vectors[..., None])[..., 0]
    tolerance = 20 * TOLERANCE[precision]
    np.testing.assert_allclose(forms, np.sum(vectors * solved, axis=1), atol=tolerance)
    np.testing.assert_allclose(log_dets, np.linalg.slogdet(matrices)[1], atol=tolerance)


@pytest.mark.parametrize("diagonal", [(-1.0, 1.0), (-1.0, -1.0), (0.0, 1.0)])
@pytest.mark.parametrize("d", [2, 6])  # written out, and in a loop
def test_quadratic_form_of_what_is_not_positive_definite_has_no_log(diagonal, d):
    matrix = jnp.diag(jnp.array([*diagonal, *np.ones(d - 2)]))
    assert np.isnan(quadratic_form(matrix, jnp.ones(d))[1])


@pytest.mark.parametrize("d", [3, 6, 20])
def test_derivatives_of_a_quadratic_form(d, x64):
    """-M⁻¹v vᵀM⁻¹ and M⁻¹ in M, 2 M⁻¹v in v."""
    rng = np.random.default_rng(d)
    root = with_singular_values(rng, np.linspace(1, 3, d))[0]
    matrix, vector = root @ root.T, rng.normal(size=d)
    (of_form, of_vector), (of_log_det, _) = jax.jacobian(quadratic_form, (0, 1))(matrix, vector)
    solved = np.linalg.solve(matrix, vector)
    symmetric = lambda slopes: (slopes + slopes.T) / 2
    np.testing.assert_allclose(symmetric(of_form), -np.outer(solved, solved), atol=1e-10)
    np.testing.assert_allclose(symmetric(of_log_det), np.linalg.inv(matrix), atol=1e-10)
    np.testing.assert_allclose(of_vector, 2 * solved, atol=1e-10)


@pytest.mark.parametrize("d", [*DIMENSIONS, 20])
def test_substitutions_equal_numpys(d, precision):
    rng = np.random.default_rng(d)
    roots = with_singular_values(rng, np.linspace(1, 3, d))
    lower = np.linalg.cholesky(roots @ roots.swapaxes(1, 2)).astype(precision)
    right = rng.normal(size=(COUNT, d)).astype(precision)
    for substitute, matrices in (
        (solve_lower, lower),
        (solve_lower_transposed, lower.swapaxes(1, 2)),
    ):
        expected = np.linalg.solve(matrices, right[..., None])[..., 0]
        found = jax.jit(jax.vmap(substitute))(lower, right)
        np.testing.assert_allclose(found, expected, atol=20 * TOLERANCE[precision])


@pytest.mark.parametrize("d", DIMENSIONS)
def test_polar_factor_equals_that_of_the_svd(d, precision):
    rng = np.random.default_rng(d)
    matrices = with_singular_values(rng, np.linspace(1, 3, d))
    assert {-1, 1} == set(np.sign(np.linalg.det(matrices)))
    factors = many_polar_factor(matrices.astype(precision))
    assert factors.dtype == precision
    np.testing.assert_allclose(factors, polar_factor_by_svd(matrices), atol=TOLERANCE[precision])


@pytest.mark.parametrize("d", [2, 3, 5])
def test_polar_factor_of_a_scaled_orthogonal_matrix_is_that_matrix(d, precision):
    # All singular values agree, where the derivative of an SVD does not exist.
    orthogonal = random_orthogonal(np.random.default_rng(d), d)
    scaled = np.resize([1e-3, 1, 1e3], (COUNT, 1, 1)) * orthogonal
    factors = many_polar_factor(scaled.astype(precision))
    np.testing.assert_allclose(factors, orthogonal, atol=1e-6)


@pytest.mark.parametrize("d", [2, 3, 5])
def test_polar_factor_of_an_ill_conditioned_matrix(d, x64):
    rng = np.random.default_rng(d)
    matrices = with_singular_values(rng, np.geomspace(1e-6, 1, d))
    factors = np.asarray(many_polar_factor(matrices))
    gram = factors @ factors.swapaxes(1, 2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(d), gram.shape), atol=1e-13)
    np.testing.assert_allclose(factors, polar_factor_by_svd(matrices), atol=1e-8)


@pytest.mark.parametrize("d", [2, 3, 5])
def test_the_derivative_of_polar_factor_is_the_limit_of_differences(d, x64):
    rng, step = np.random.default_rng(d), 1e-5
    matrices = with_singular_values(rng, np.linspace(1, 3, d))
    matrices[:4] = 2 * random_orthogonal(rng, d)[:4]  # repeated singular values
    directions = rng.standard_normal(matrices.shape)
    slope = lambda m, v: jnp.tensordot(jax.jacfwd(polar_factor)(m), v)
    differences = many_polar_factor(matrices + step * directions)
    differences -= many_polar_factor(matrices - step * directions)
    np.testing.assert_allclose(
        jax.jit(jax.vmap(slope))(matrices, directions), differences / (2 * step), atol=1e-7
    )


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("function", [inverse, polar_factor])
def test_reverse_mode_agrees_with_forward_mode(d, function, x64):
    rng = np.random.default_rng(d)
    matrix, weights = with_singular_values(rng, np.linspace(1, 3, d))[0], rng.random((d, d))
    direction = rng.standard_normal((d, d))
    value = lambda m: jnp.sum(weights * function(m))
    gradient = jax.jit(jax.grad(value))(matrix)
    _, slope = jax.jit(lambda m, v: jax.jvp(value, (m,), (v,)))(matrix, direction)
    assert np.all(np.isfinite(gradient))
    np.testing.assert_allclose(np.sum(gradient * direction), slope, atol=1e-10)


def test_safe_norm_is_the_norm_with_derivative_zero_at_zero():
    vectors = jnp.array([[3.0, 4.0], [0.0, 0.0]])
    norms, gradients = jax.vmap(jax.value_and_grad(safe_norm))(vectors)
    np.testing.assert_allclose(norms, [5, 0])
    np.testing.assert_allclose(gradients, [[0.6, 0.8], [0, 0]])


@pytest.mark.parametrize("d", [2, 6])
def test_all_finite_sees_every_coordinate(d):
    assert all_finite(jnp.ones(d))
    for value in [np.nan, np.inf, -np.inf, 2e18]:
        for i in range(d):
            assert not all_finite(jnp.ones(d).at[i].set(value))
    assert not all_finite(jnp.ones(d).at[0].set(np.inf).at[1].set(-np.inf))


@pytest.mark.parametrize("d", [3, 5])
def test_no_lapack_call_is_compiled(d):
    matrices = jnp.broadcast_to(jnp.eye(d), (4, d, d))
    text = lambda function: jax.jit(jax.vmap(function)).lower(matrices).as_text().lower()
    assert "custom_call" in text(jnp.linalg.inv)  # so the search would find one
    for function in [inverse, cholesky, polar_factor, jax.jacfwd(polar_factor)]:
        assert "custom_call" not in text(function)
        assert "lapack" not in text(function)


@pytest.mark.slow
@pytest.mark.parametrize("d", [3, 5, 7])
def test_many_lanes_inside_a_scan(d):
    """XLA's CPU compiler leaves part of some reductions inside loops uncomputed, from the
    32,768th number on; nothing here may be one of them."""
    num_lanes = 10_000
    rng = np.random.default_rng(0)
    matrix = (rng.normal(size=(d, d)) / d).astype(np.float32)
    start, noise = rng.normal(size=(2, d, num_lanes)).astype(np.float32)

    def step(x, _):
        def one_lane(x, w):
            full = matrix * (1 + 0.1 * jnp.tanh(x)) + 2 * jnp.eye(d, dtype=x.dtype)
            drift = solve(full, matvec(full.T, x) + matvec(jnp.asarray(matrix), x))
            return 0.5 * drift / (1 + dot(x, x)) + 0.1 * matmul(full, full)[0] + 0.2 * w

        return jax.vmap(one_lane, in_axes=-1, out_axes=-1)(x, noise), None

    out = jax.jit(lambda x: jax.lax.scan(step, x, None, length=4)[0])(jnp.asarray(start))
    x = np.asarray(start, float).T
    for _ in range(4):
        full = matrix * (1 + 0.1 * np.tanh(x))[:, None] + 2 * np.eye(d)
        right = np.einsum("lij,li->lj", full, x) + x @ matrix.T
        drift = np.linalg.solve(full, right[..., None])[..., 0]
        square = (x**2).sum(1, keepdims=True)
        x = 0.5 * drift / (1 + square) + 0.1 * (full @ full)[:, 0] + 0.2 * noise.T
    np.testing.assert_allclose(out, x.T, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["bridges", "chain", "guided"])
def test_no_simulation_calls_lapack(what):
    """In loops of compiled programs, where such calls can hang for ever; here all is in loops."""
    d = 3
    mix = lambda x: jnp.eye(d) + 0.1 * jnp.outer(jnp.tanh(x), jnp.cos(x))
    model = jb.Diffusion(lambda x, p: -x, lambda x, p: mix(x), lambda x, p: -x @ x, reversible=True)
    law = jb.GaussianLaw(jnp.zeros(d), jnp.eye(d))
    proposals = {"guided": jb.Guided(), "chain": jb.Coupling(0.5, start_law=law)}

    def simulate(key):
        arguments = (key, model, jnp.zeros(d), jnp.ones(d), 1.0)
        if what == "bridges":
            return jb.sample_bridges(*arguments, num_steps=4).paths
        return jb.sample_exact_bridges(
            *arguments, num_bridges=4, num_steps=4, proposal=proposals[what]
        ).paths

    compiled = jax.jit(simulate).lower(jax.random.key(0)).compile().as_text()
    assert "fusion" in compiled and 'custom_call_target="lapack' not in compiled


def test_spectral_radius():
    rng = np.random.default_rng(0)
    for matrix in (
        np.diag([1.0, -3e8]),
        rng.normal(size=(6, 6)),
        [[0.0, 10.0], [-10.0, 0.0]],
        [[-1.0, 1e3], [0.0, -2.0]],
    ):
        matrix = np.asarray(matrix)
        exact = np.abs(np.linalg.eigvals(matrix)).max()
        np.testing.assert_allclose(spectral_radius(jnp.asarray(matrix)), exact, rtol=0.3)
    assert spectral_radius(jnp.array([[0.0, 1.0], [0.0, 0.0]])) == 0
    assert spectral_radius(jnp.zeros((2, 2))) == 0


@pytest.mark.parametrize("scale", [1e-30, 1e-18, 1e18, 1e36])
def test_products_out_of_range(scale):
    """Determinants of such matrices under- or overflow; their logs, inverses and polar factors do
    not."""
    matrix = jnp.asarray([[2.0, -0.5], [0.3, 1.0]]) * jnp.float32(scale)
    exact = np.asarray(matrix, float)
    np.testing.assert_allclose(inverse(matrix), np.linalg.inv(exact), rtol=1e-5)
    np.testing.assert_allclose(
        polar_factor(matrix), polar_factor_by_svd(exact[None] / scale)[0], atol=1e-5
    )
    numbers = [jnp.float32(scale * x) for x in (0.7, 2.0, 1.3)]
    log = np.log(np.array([0.7, 2.0, 1.3]) * scale).sum()
    np.testing.assert_allclose(log_of_product(numbers), log, rtol=1e-6)
    slope = jax.grad(lambda x: log_of_product([x, *numbers[1:]]))(numbers[0])
    np.testing.assert_allclose(slope * numbers[0], 1, rtol=1e-6)
