"""Every form of σ against the dense matrix it stands for."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxbridge.models.sigma import Constant, Diagonal, Full, Identity, Triangular, root_of

rng = np.random.default_rng(0)


@pytest.fixture(autouse=True)
def same_numbers_in_any_order():
    """Reset the random numbers, so that they do not depend on the tests before."""
    global rng
    rng = np.random.default_rng(0)


def a_matrix(d):
    return jnp.asarray(rng.standard_normal((d, d)) + 3 * np.eye(d), jnp.float32)


def a_diagonal(d):
    return jnp.asarray(rng.uniform(1, 2, d), jnp.float32)


FORMS = {
    "identity": lambda d: Identity(),
    "constant": lambda d: Constant(a_matrix(d)),
    "diagonal": lambda d: Diagonal(a_diagonal(d)),
    "full": lambda d: Full(a_matrix(d)),
    "triangular": lambda d: Full(a_matrix(d)).root(),
}
# Averages are asked for between coefficients of one model; a constant one does not change.
VARYING = {"diagonal", "full", "triangular"}


@pytest.mark.parametrize("d", [1, 2, 3, 6])
@pytest.mark.parametrize("form", FORMS)
def test_products_and_solutions_are_those_of_the_dense_matrix(form, d):
    sigma = FORMS[form](d)
    vector = jnp.asarray(rng.standard_normal(d), jnp.float32)
    dense = np.asarray(sigma.as_matrix(d, jnp.float32), np.float64)
    assert dense.shape == (d, d)
    close = lambda ours, exact: np.testing.assert_allclose(ours, exact, rtol=1e-4, atol=1e-5)
    close(sigma.mv(vector), dense @ vector)
    close(sigma.mv_transpose(vector), dense.T @ vector)
    close(sigma.solve(vector), np.linalg.solve(dense, vector))
    close(sigma.log_abs_det(), np.linalg.slogdet(dense)[1])
    root = np.asarray(sigma.root().as_matrix(d, jnp.float32), np.float64)
    close(root @ root.T, dense @ dense.T)


@pytest.mark.parametrize("form", FORMS)
def test_the_average_is_that_of_the_dense_matrices(form):
    first = FORMS[form](3)
    second = FORMS[form](3) if form in VARYING else first
    dense = lambda sigma: np.asarray(sigma.as_matrix(3, jnp.float32))
    average = first.average(second)
    assert type(average) is type(first)
    np.testing.assert_allclose(dense(average), (dense(first) + dense(second)) / 2, rtol=1e-6)


def test_dense_forms_are_what_was_given():
    matrix, diagonal = a_matrix(3), a_diagonal(3)
    for form, given, dense in [
        (Constant, matrix, matrix),
        (Full, matrix, matrix),
        (Diagonal, diagonal, np.diag(diagonal)),
    ]:
        np.testing.assert_array_equal(form(given).as_matrix(3, jnp.float32), dense)
    np.testing.assert_array_equal(Identity().as_matrix(3, jnp.float32), np.eye(3))


def test_a_large_constant_matrix_is_inverted_as_well():
    matrix = a_matrix(20)
    vector = jnp.ones(20)
    np.testing.assert_allclose(
        Constant(matrix).solve(vector), np.linalg.solve(matrix, vector), rtol=1e-3, atol=1e-4
    )


def test_the_root_is_that_of_the_covariance_however_sigma_turns():
    matrix, turn = a_matrix(3), np.linalg.qr(rng.standard_normal((3, 3)))[0]
    roots = [Full(matrix).root(), Full(matrix @ turn).root(), root_of(matrix @ matrix.T)]
    assert all(isinstance(root, Triangular) for root in roots)
    for root in roots[1:]:
        np.testing.assert_allclose(root.matrix, roots[0].matrix, atol=2e-5)


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_the_determinant_is_that_of_coefficients_in_any_units(scale):
    """Products of four such numbers are beyond single precision."""
    sigma = Triangular(jnp.tril(a_matrix(5)) * scale)
    expected = np.log(np.diagonal(np.asarray(sigma.matrix, float))).sum()
    np.testing.assert_allclose(sigma.log_abs_det(), expected, rtol=1e-5)
